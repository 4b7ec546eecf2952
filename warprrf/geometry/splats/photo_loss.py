"""The loss of images, (1 - s) L1 + s (1 - SSIM), and its derivative with respect to the rendered image, in Warp.

Images are planes as :mod:`warprrf.kernels.ssim` wants them: :meth:`PhotoLoss.plane` makes one. A ``shape`` is
``(H, W)``, or ``(R, H, W)`` for several images in one plane. A panorama goes on beyond its left and right end: its
rows are longer by :data:`WRAPPED` columns on either side, which repeat those of the other end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.cache import Cache
from warprrf.device import DeviceLike, launch, resolve
from warprrf.kernels import ssim as kernels

WRAPPED = 2 * kernels.RADIUS  # the window reaches half as far, and slopes are filtered once more
SIZES = 2  # of images whose working planes are kept: batches have two


@dataclass(frozen=True)
class _Room:
    """Planes of one size to work in: ``inside`` is one row, 1 at its numbers and 0 beyond."""

    inside: wp.array
    canvas: wp.array
    gradient: wp.array
    score: wp.array
    averages: tuple[wp.array, wp.array, wp.array]
    slopes: tuple[wp.array, wp.array, wp.array]
    filtered: tuple[wp.array, wp.array, wp.array]


class PhotoLoss:
    """Loss of rendered images.

    Args:
        ssim_share: weight ``s`` of 1 - SSIM.
        real: scalar type of the images.
        panorama: images of one number a pixel that wrap around, not photos.
        lanes: numbers that a thread works on; default: one on a GPU, a vector register's worth on a CPU.
    """

    def __init__(
        self,
        device: DeviceLike,
        ssim_share: float,
        *,
        real: type = wp.float32,
        panorama: bool = False,
        lanes: int | None = None,
    ) -> None:
        self.device, self.ssim_share, self.real = resolve(device), ssim_share, real
        self.lanes = lanes or (1 if self.device.is_cuda else kernels.LANES)
        self.channels, self.wrapped = (1, WRAPPED) if panorama else (3, 0)
        self.kernels = kernels.build(real, self.lanes, self.channels)
        self.rooms = Cache(SIZES)

    def plane(self, values: np.ndarray | None, shape: tuple[int, ...]) -> wp.array:
        """An image ``(*shape, 3)``, or panorama ``shape``, as a plane, zero if None."""
        count = self._numbers(shape)
        rows = np.zeros((math.prod(shape[:-1]), kernels.stride_of(count)), wp.dtype_to_numpy(self.real))
        if values is not None:
            image = values.reshape(len(rows), -1)
            image = np.pad(image, ((0, 0), (self.wrapped, self.wrapped)), mode="wrap")
            rows[:, kernels.MARGIN : kernels.MARGIN + count] = image
        return wp.array(rows.reshape(-1), dtype=self.real, device=self.device)

    def moments(self, photo: wp.array, shape: tuple[int, ...]) -> tuple[wp.array, wp.array]:
        """Window averages of a photo and its square, of ``shape``."""
        columns = self._room(shape).averages
        self._launch(self.kernels.moments, shape, [photo, photo, *columns], height=True)
        mean, square = self.plane(None, shape), self.plane(None, shape)
        self._launch(self.kernels.filter_rows, shape, [columns[0], mean])
        self._launch(self.kernels.filter_rows, shape, [columns[1], square])
        return mean, square

    def canvas(self, shape: tuple[int, ...]) -> wp.array:
        """The plane that a rendered image of ``shape`` has to be written to before the loss is asked for."""
        return self._room(shape).canvas

    def __call__(
        self, photo: wp.array, moments: tuple[wp.array, wp.array], shape: tuple[int, ...]
    ) -> tuple[wp.array, wp.array]:
        """SSIM of every number of the image on the canvas, and the derivative of the loss with respect to it, planes
        that the next call overwrites."""
        room, count = self._room(shape), self.channels * math.prod(shape)
        self._launch(self.kernels.moments, shape, [room.canvas, photo, *room.averages], height=True)
        inputs = [room.inside, *moments, *room.averages, room.score, *room.slopes]
        self._launch(self.kernels.slopes, shape, inputs)
        for source, out in zip(room.slopes, room.filtered, strict=True):
            self._launch(self.kernels.filter_columns, shape, [source, out], height=True)
        shares = [(1 - self.ssim_share) / count, self.ssim_share / count]
        inputs = [room.canvas, photo, *room.filtered, *shares, room.gradient]
        self._launch(self.kernels.adjoint, shape, inputs)
        return room.score, room.gradient

    def _numbers(self, shape: tuple[int, ...]) -> int:
        return self.channels * shape[-1] + 2 * self.wrapped

    def _launch(
        self, kernel: wp.Kernel, shape: tuple[int, ...], inputs: list[object], *, height: bool = False
    ) -> None:
        count = self._numbers(shape)
        blocks = kernels.blocks_of(count, self.lanes)
        layout = [*shape[-2:-1][: int(height)], kernels.stride_of(count), blocks]
        launch(kernel, math.prod(shape[:-1]) * blocks, [*layout, *inputs], device=self.device)

    def _room(self, shape: tuple[int, ...]) -> _Room:
        """Planes to work in; those of the sizes asked for last are kept."""

        def room() -> _Room:
            row = 1, shape[-1]
            inside = self.plane(np.ones((*row, self.channels)), row)
            one, two, three, *others = (self.plane(None, shape) for _ in range(12))
            groups = ((others[k], others[k + 1], others[k + 2]) for k in (0, 3, 6))
            return _Room(inside, one, two, three, *groups)

        return self.rooms.get(shape, room)
