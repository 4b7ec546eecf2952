"""The loss of photos, (1 - s) L1 + s (1 - SSIM), and its derivative with respect to the rendered image, in Warp.

Images are planes as :mod:`warprrf.kernels.photo_ssim` wants them: :meth:`PhotoLoss.plane` makes one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.device import DeviceLike, launch, resolve
from warprrf.kernels import photo_ssim as kernels


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
        device: Warp device.
        ssim_share: weight ``s`` of 1 - SSIM.
        real: scalar type of the images.
        lanes: numbers that a thread works on; default: one on a GPU, a vector register's worth on a CPU.
    """

    def __init__(
        self, device: DeviceLike, ssim_share: float, real: type = wp.float32, lanes: int | None = None
    ) -> None:
        self.device, self.ssim_share, self.real = resolve(device), ssim_share, real
        self.lanes = lanes or (1 if self.device.is_cuda else kernels.LANES)
        self.kernels = kernels.build(real, self.lanes)
        self.rooms: dict[tuple[int, int], _Room] = {}

    def plane(self, values: np.ndarray | None, shape: tuple[int, int]) -> wp.array:
        """An image ``(H, W, 3)`` of ``shape`` ``(H, W)`` as a plane, zero if None."""
        height, width = shape
        rows = np.zeros((height, kernels.stride_of(width)), dtype=wp.dtype_to_numpy(self.real))
        if values is not None:
            rows[:, kernels.MARGIN : kernels.MARGIN + 3 * width] = values.reshape(height, -1)
        return wp.array(rows.reshape(-1), dtype=self.real, device=self.device)

    def values(self, plane: wp.array, shape: tuple[int, int]) -> np.ndarray:
        """The image ``(H, W, 3)`` of a plane."""
        height, width = shape
        rows = plane.numpy().reshape(height, -1)
        return rows[:, kernels.MARGIN : kernels.MARGIN + 3 * width].reshape(height, width, 3)

    def moments(self, photo: wp.array, shape: tuple[int, int]) -> tuple[wp.array, wp.array]:
        """Window averages of a photo and its square, of ``shape`` ``(H, W)``."""
        columns = self._room(shape).averages
        self._launch(self.kernels.moments, shape, [photo, photo, *columns], height=True)
        mean, square = self.plane(None, shape), self.plane(None, shape)
        self._launch(self.kernels.filter_rows, shape, [columns[0], mean])
        self._launch(self.kernels.filter_rows, shape, [columns[1], square])
        return mean, square

    def canvas(self, shape: tuple[int, int]) -> wp.array:
        """The plane that a rendered image of ``shape`` ``(H, W)`` has to be written to before the loss is asked for."""
        return self._room(shape).canvas

    def __call__(
        self, photo: wp.array, moments: tuple[wp.array, wp.array], shape: tuple[int, int]
    ) -> tuple[wp.array, wp.array]:
        """SSIM of every number of the image on the canvas, and the derivative of the loss with respect to it, planes
        that the next call overwrites."""
        room, count = self._room(shape), 3 * shape[0] * shape[1]
        self._launch(self.kernels.moments, shape, [room.canvas, photo, *room.averages], height=True)
        inputs = [room.inside, *moments, *room.averages, room.score, *room.slopes]
        self._launch(self.kernels.slopes, shape, inputs)
        for source, out in zip(room.slopes, room.filtered, strict=True):
            self._launch(self.kernels.filter_columns, shape, [source, out], height=True)
        shares = [(1 - self.ssim_share) / count, self.ssim_share / count]
        inputs = [room.canvas, photo, *room.filtered, *shares, room.gradient]
        self._launch(self.kernels.adjoint, shape, inputs)
        return room.score, room.gradient

    def _launch(
        self, kernel: wp.Kernel, shape: tuple[int, int], inputs: list[object], *, height: bool = False
    ) -> None:
        """Launch a kernel over the blocks of planes."""
        blocks = kernels.blocks_of(shape[1], self.lanes)
        layout = [*shape[: int(height)], kernels.stride_of(shape[1]), blocks]
        launch(kernel, shape[0] * blocks, [*layout, *inputs], device=self.device)

    def _room(self, shape: tuple[int, int]) -> _Room:
        """Planes to work in; those of the size asked for last are kept."""
        if shape not in self.rooms:
            self.rooms.clear()
            inside = self.plane(np.ones((1, shape[1], 3)), (1, shape[1]))
            one, two, three, *others = (self.plane(None, shape) for _ in range(12))
            groups = ((others[k], others[k + 1], others[k + 2]) for k in (0, 3, 6))
            self.rooms[shape] = _Room(inside, one, two, three, *groups)
        return self.rooms[shape]
