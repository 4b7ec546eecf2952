"""One rasteriser for photos and panoramas: exact on every ray, differentiable through Warp's tape.

:class:`Rasterizer` works on Warp arrays, in float32 or float64, and records its hand-written adjoint on an active
``wp.Tape``; it is what :mod:`warprrf.geometry.photos.refine` trains with. :mod:`warprrf.geometry.splats.render` is its NumPy face.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import warp as wp

from warprrf.device import MIN_SPLIT, PIECES_PER_THREAD, launch, resolve, threads
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.tape import active_tape, gradient, with_gradients
from warprrf.kernels.raster import binning, entry_masks
from warprrf.kernels.raster import blend as blend_kernels
from warprrf.kernels.raster import blend_pixels as pixel_kernels
from warprrf.kernels.raster import project as kernels
from warprrf.kernels.raster import sh as sh_kernels
from warprrf.kernels.raster.warps import PIXELS

STRIPES = 4096  # partial sums
TILE_GRAIN = 8  # a tile or a block is work enough for few of them to be worth a thread
RULES = {"product": kernels.PRODUCT, "exp": kernels.EXPONENTIAL}


@dataclass(frozen=True)
class Blending:
    """How responses become an image; the defaults suit 8-bit photos.

    Attributes:
        alpha_min: a Gaussian contributes where ``opacity * response`` reaches this.
        alpha_max: clamp of alpha, so that no layer is fully opaque. With 1 allowed, a layer of alpha exactly one hides
            what is behind it from its own gradient as well (``product``).
        transmittance_min: a pixel is finished when less light than this is left.
        rule: ``"product"`` of (1 - alpha), or ``"exp"`` of minus the sum of alphas (the paper's equation for T_k, which
            can blend to more than one).
    """

    alpha_min: float = 1 / 255  # below this a Gaussian cannot change an 8-bit pixel
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    rule: str = "product"

    def __post_init__(self) -> None:
        for name, low, high in (("alpha_min", 0, 1), ("alpha_max", 0, 1), ("transmittance_min", -1, 1)):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f"{name}: got {value!r}, expected a number in ({low}, {high}]")
        if self.rule not in RULES:
            raise ValueError(f"rule: got {self.rule!r}, expected one of {sorted(RULES)}")


# An image 60 dB deep: a layer clamped at 0.99 would leak -20 dB, so alpha may come within 1e-6 of one.
RADIO = Blending(alpha_min=1e-4, alpha_max=1 - 1e-6, transmittance_min=1e-6)


@dataclass(frozen=True)
class Blocks:
    """What every block of pixels sees, near to far, and what each tile has to do, summed up."""

    ids: wp.array
    starts: wp.array
    work: np.ndarray


@dataclass(frozen=True)
class Prepared:
    """Gaussians projected for one camera: coefficients, and the lists of what tiles see, near to far, on the device;
    a bit of ``masks`` for each block of its tile that an entry can reach."""

    camera: Camera
    view: Any
    rays: Any
    inputs: tuple[wp.array, ...]
    rows: wp.array
    begins: wp.array
    count: wp.array
    slots: wp.array
    ids: wp.array
    masks: wp.array
    starts: wp.array
    counts: wp.array | None

    @cached_property
    def blocks(self) -> Blocks:
        """The lists shared out to blocks of pixels, which a CPU blends by."""
        if self.counts is None:
            raise RuntimeError(
                "blocks: a GPU blends without lists of blocks, so nothing was counted for them"
            )
        device, tiles = self.starts.device, len(self.starts) - 1
        sums = np.concatenate([[0], np.cumsum(self.counts.numpy().ravel(), dtype=np.int64)])
        starts = wp.array(sums.astype(np.int32), dtype=int, device=device)
        ids = wp.empty(max(int(sums[-1]), 1), dtype=int, device=device)
        launch(
            binning.fill_blocks,
            tiles,
            [self.ids, self.masks, self.starts, starts, ids],
            device=device,
            grain=TILE_GRAIN,
        )
        return Blocks(ids, starts, sums[:: kernels.LANES] + np.arange(tiles + 1))


@dataclass(frozen=True)
class Image:
    """A blended image on the device; ``depth`` is 0 where nothing is seen."""

    features: wp.array
    alpha: wp.array
    depth: wp.array
    dominant: wp.array
    peak: wp.array


class Rasterizer:
    """Projects, bins and blends on one device in one precision.

    Under an active ``wp.Tape`` :meth:`rasterize` and :meth:`colors` record their adjoints for the means, quaternions,
    scales, opacities, features, background and harmonics; losses may use ``features``, ``alpha`` and ``depth``.
    """

    def __init__(
        self, *, device: Any = None, blending: Blending | None = None, real: Any = wp.float32
    ) -> None:
        self.device = resolve(device)
        self.blending = blending or Blending()
        self.real = real
        self.project_kernels = kernels.build(real)
        self.rules = kernels.Rules()
        self.rules.alpha_min = self.blending.alpha_min
        self.rules.alpha_max = self.blending.alpha_max
        self.rules.transmittance_min = self.blending.transmittance_min
        self.on_gpu = self.device.is_cuda

    def vector(self, size: int) -> Any:
        """Warp's vector type of this precision."""
        return wp.types.vector(size, self.real)

    def upload(self, g: Gaussians) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """Means, quaternions, scales and opacities as arrays of this precision."""
        return (
            wp.array(g.means, dtype=self.vector(3), device=self.device),
            wp.array(g.quaternions, dtype=self.vector(4), device=self.device),
            wp.array(g.scales, dtype=self.vector(3), device=self.device),
            wp.array(g.opacities, dtype=self.real, device=self.device),
        )

    def rasterize(
        self,
        means: wp.array,
        quaternions: wp.array,
        scales: wp.array,
        opacities: wp.array,
        features: wp.array,
        cam: Camera,
        background: Any = None,
    ) -> Image:
        """Project and blend; differentiable on an active tape."""
        return self.blend(self.prepare(means, quaternions, scales, opacities, cam), features, background)

    def colors(self, means: wp.array, sh: wp.array, cam: Camera) -> wp.array:
        """Colours ``max(0, SH + 0.5)`` towards the camera, shape ``(N, C)``; differentiable on an active tape."""
        tape = active_tape()
        out = wp.zeros(
            (len(means), sh.shape[2]), dtype=self.real, device=self.device, requires_grad=tape is not None
        )
        origin = self.colors_into(means, sh, cam, out)
        if tape is not None:
            tape.record_func(
                lambda: self.colors_adjoint(means, sh, origin, out), with_gradients(means, sh, out)
            )
        return out

    def colors_into(self, means: wp.array, sh: wp.array, cam: Camera, out: wp.array) -> wp.array:
        """Write the colours to ``out``; returns the ray origin that :meth:`colors_adjoint` wants. Records nothing."""
        origin = wp.array([cam.position], dtype=self.vector(3), device=self.device)
        launch(sh_kernels.build(self.real).colors, len(means), [means, sh, origin, out], device=self.device)
        return origin

    def colors_adjoint(self, means: wp.array, sh: wp.array, origin: wp.array, out: wp.array) -> None:
        """Add the gradients of ``means`` and ``sh`` for ``out.grad``."""
        launch(
            sh_kernels.build(self.real).colors,
            len(means),
            [means, sh, origin, out],
            device=self.device,
            adjoint=True,
        )

    def prepare(
        self, means: wp.array, quaternions: wp.array, scales: wp.array, opacities: wp.array, cam: Camera
    ) -> Prepared:
        """Project every Gaussian and list those that each tile and each of its blocks sees, near to far."""
        n, device = len(means), self.device
        view = _view(cam)
        rays = _rays(
            cam.kind, cam.width, cam.height, cam.fx, cam.fy, cam.cx, cam.cy, self.real, self.device.alias
        )
        span = wp.empty(n, dtype=wp.vec4i, device=device)
        count = wp.empty(n, dtype=int, device=device)
        distance = wp.empty(n, dtype=float, device=device)
        rows = wp.empty(n, dtype=self.vector(kernels.ROW), device=device)
        centres = wp.empty(n, dtype=self.vector(3), device=device)
        begins = wp.empty(n, dtype=int, device=device)
        inputs = (means, quaternions, scales, opacities)
        launch(
            self.project_kernels.project,
            n,
            [*inputs, view, self.rules, span, count, distance, rows, centres],
            device=device,
        )
        order, ends, entries = _sorted_visible(count, distance, *self._totals(count))
        tiles = view.tiles_x * view.tiles_y
        keys = wp.empty(2 * max(entries, 1), dtype=int, device=device)
        slots = wp.empty(2 * max(entries, 1), dtype=int, device=device)
        whose, ids, masks = (wp.empty(max(entries, 1), dtype=int, device=device) for _ in range(3))
        starts = wp.zeros(tiles + 1, dtype=int, device=device)
        if entries:
            wp.utils.array_scan(count, begins, inclusive=False)
            launch(
                binning.emit_tiles,
                len(order),
                [order, span, ends, view.tiles_x, keys, begins, slots, whose],
                device=device,
            )
            wp.utils.radix_sort_pairs(keys, slots, entries, 0, tiles.bit_length())
            launch(binning.tile_starts, tiles + 1, [keys, entries, starts], device=device)
        counts = None
        if self.on_gpu:
            launch(
                entry_masks.build(self.real),
                entries,
                [rows, centres, keys, slots, whose, rays, view.tiles_x, ids, masks],
                device=device,
            )
        else:
            counts = wp.empty(tiles, dtype=self.vector(kernels.LANES), device=device)
            launch(
                self.project_kernels.block_masks,
                tiles,
                [rows, centres, whose, slots, starts, rays, view.tiles_x, ids, masks, counts],
                device=device,
                grain=TILE_GRAIN,
            )
        return Prepared(
            camera=cam,
            view=view,
            rays=rays,
            inputs=inputs,
            rows=rows,
            begins=begins,
            count=count,
            slots=slots,
            ids=ids,
            masks=masks,
            starts=starts,
            counts=counts,
        )

    def _totals(self, count: wp.array) -> tuple[int, int]:
        """How many Gaussians are seen, and how many tiles they cover in all."""
        if not self.on_gpu:
            return int(np.count_nonzero(count.numpy())), int(count.numpy().sum(dtype=np.int64))
        stripes = min(len(count), STRIPES)  # so that a few kilobytes come from the GPU, not all counts
        found = wp.empty(stripes, dtype=binning.long_pair, device=self.device)
        launch(binning.tally, stripes, [stripes, count, found], device=self.device)
        visible, total = found.numpy().sum(axis=0)
        return int(visible), int(total)

    def blend(self, prepared: Prepared, features: wp.array, background: Any = None) -> Image:
        """Blend ``features`` (N, C) front to back; differentiable on an active tape."""
        tape = active_tape()
        image, kept = self._blend(prepared, features, background, requires_grad=tape is not None)
        if tape is not None:
            outputs = (image.features, image.alpha, image.depth)

            def backward() -> None:
                self.blend_adjoint(prepared, features, image, *kept)
                for (
                    array
                ) in outputs:  # as Warp's own adjoints do: a second backward adds the same again, not more
                    if not array.retain_grad:
                        array.grad.zero_()

            tape.record_func(backward, with_gradients(*prepared.inputs, features, kept[1], *outputs))
        return image

    def blend_with_adjoint(
        self, prepared: Prepared, features: wp.array, background: Any = None, *, gradients: bool = True
    ) -> tuple[Image, Callable[[], wp.array]]:
        """Blend without a tape: the image, and the function that adds the inputs' gradients for the image's.

        With ``gradients`` the image gets gradients of zero to write to; without, assign those that there are (they are
        only read). An input without a gradient is left out.
        """
        image, kept = self._blend(prepared, features, background, requires_grad=gradients)
        return image, lambda: self.blend_adjoint(prepared, features, image, *kept)

    def _blend(
        self, prepared: Prepared, features: wp.array, background: Any, *, requires_grad: bool
    ) -> tuple[Image, tuple[wp.array, wp.array]]:
        """The image, and what its adjoint wants besides: the transmittance left and the background."""
        device, real, grad = self.device, self.real, requires_grad
        shape = (prepared.camera.height, prepared.camera.width)
        channels = features.shape[1]
        if background is None:
            background = wp.zeros(channels, dtype=real, device=device)
        elif not isinstance(background, wp.array):
            background = wp.array(np.asarray(background), dtype=real, device=device)
        image = wp.empty((*shape, channels), dtype=real, device=device, requires_grad=grad)
        alpha, depth = (wp.empty(shape, dtype=real, device=device, requires_grad=grad) for _ in range(2))
        left, peak = (wp.empty(shape, dtype=real, device=device) for _ in range(2))
        dominant = wp.empty(shape, dtype=int, device=device)
        flat = [a.flatten() for a in (image, alpha, depth, left, dominant, peak)]
        flat_features = _flat(features)
        if self.on_gpu:
            count, grain = (len(prepared.starts) - 1) * PIXELS, MIN_SPLIT
            lists = [prepared.ids, prepared.masks, prepared.starts]
        else:
            count, grain = len(prepared.blocks.starts) - 1, TILE_GRAIN
            lists = [prepared.blocks.ids, prepared.blocks.starts]
        for first in range(0, channels, kernels.CHANNELS):
            launch(
                self.kernels_for(channels - first).blend,
                count,
                [prepared.rows, flat_features, channels, first, background, *lists, prepared.rays, prepared.view,
                 self.rules, *flat],
                device=device,
                grain=grain,
            )  # fmt: skip
        return Image(image, alpha, depth, dominant, peak), (left, background)

    def kernels_for(self, channels: int) -> Any:
        """Kernels that blend so many channels at once, four at most."""
        source = pixel_kernels if self.on_gpu else blend_kernels
        return source.build(self.real, RULES[self.blending.rule], min(channels, kernels.CHANNELS))

    def blend_adjoint(
        self,
        prepared: Prepared,
        features: wp.array,
        out: Image,
        left: wp.array,
        background: wp.array,
    ) -> wp.array:
        """Add the gradients of every input for those of ``out``; returns each Gaussian's summed blending weight."""
        device, real = self.device, self.real
        channels, n = features.shape[1], len(features)
        means, quaternions, scales, opacities = prepared.inputs
        seen = wp.zeros(n, dtype=real, device=device)
        feature_grad = gradient(features)
        rows = features if features.is_contiguous else features.contiguous()
        slopes = [gradient(array) for array in (out.features, out.alpha, out.depth)]
        flat = [a.flatten() for a in (out.features, out.alpha, out.depth, left, *slopes)]
        add_sums = self._sums_of_pixels if self.on_gpu else self._sums_of_tiles
        with_range = int(out.depth.requires_grad and self._any(slopes[2]))
        for first in range(0, channels, kernels.CHANNELS):
            blend = self.kernels_for(channels - first)
            kernel = blend.blend_adjoint[with_range if first == 0 else 0]
            begins, sums = add_sums(blend, kernel, prepared, rows, first, flat, background)
            launch(
                self.project_kernels.chain,
                n,
                [means, quaternions, scales, opacities, prepared.view, first, begins, prepared.count, sums,
                 gradient(means), gradient(quaternions), gradient(scales), gradient(opacities), feature_grad, seen],
                device=device,
            )  # fmt: skip
        return seen

    def _any(self, values: wp.array) -> bool:
        """Whether a value is not zero; from a GPU comes one number, not all."""
        if not self.on_gpu:
            return bool(values.numpy().any())
        found = wp.zeros(1, dtype=int, device=self.device)
        launch(self.kernels_for(1).any_gradient, values.size, [values.flatten(), found], device=self.device)
        return bool(found.numpy()[0])

    def _sums_of_tiles(
        self,
        blend: Any,
        kernel: Any,
        prepared: Prepared,
        features: wp.array,
        first: int,
        flat: list[wp.array],
        background: wp.array,
    ) -> tuple[wp.array, wp.array]:
        """What `chain` adds up: a row of sums for every entry, and where each Gaussian's begin."""
        device, lanes, channels = self.device, self.vector(kernels.LANES), features.shape[1]
        # Cut into pieces of equal work, each with its own seeds.
        pieces = 1 if threads() == 1 else PIECES_PER_THREAD * threads()
        work = prepared.blocks.work
        cuts = np.searchsorted(work, work[-1] * np.arange(pieces + 1) / pieces).tolist()
        tiles = len(work) - 1
        seeds = wp.empty(len(cuts) * kernels.LANES * blend_kernels.PER_BLOCK, dtype=lanes, device=device)
        sums = wp.empty(len(prepared.ids), dtype=lanes, device=device)
        background_sums = wp.empty(tiles, dtype=lanes, device=device)
        launch(
            kernel,
            tiles,
            [wp.array(cuts, dtype=int, device=device), prepared.rows, features.flatten(), channels, first,
             prepared.ids, prepared.slots, prepared.masks, prepared.starts, prepared.rays, prepared.view, self.rules,
             *flat, seeds, sums, background_sums],
            device=device,
            cuts=cuts,
        )  # fmt: skip
        if background.requires_grad:
            launch(
                blend.background_adjoint,
                min(channels - first, kernels.CHANNELS),
                [first, background_sums, background.grad],
                device=device,
            )
        return prepared.begins, sums

    def _sums_of_pixels(
        self,
        blend: Any,
        kernel: Any,
        prepared: Prepared,
        features: wp.array,
        first: int,
        flat: list[wp.array],
        background: wp.array,
    ) -> tuple[wp.array, wp.array]:
        """The same on a GPU, where every Gaussian has one row."""
        device = self.device
        sums = wp.zeros(len(features), dtype=self.vector(kernels.LANES), device=device)
        nothing = wp.empty(0, dtype=self.real, device=device)
        launch(
            kernel,
            (len(prepared.starts) - 1) * PIXELS,
            [prepared.rows, features.flatten(), features.shape[1], first, prepared.ids, prepared.masks,
             prepared.starts, prepared.rays, prepared.view, self.rules, *flat, sums,
             background.grad if background.requires_grad else nothing],
            device=device,
        )  # fmt: skip
        return wp.empty(0, dtype=int, device=device), sums


def _flat(array: wp.array) -> wp.array:
    return (array if array.is_contiguous else array.contiguous()).flatten()


def _sorted_visible(
    count: wp.array, distance: wp.array, visible: int, total: int
) -> tuple[wp.array, wp.array, int]:
    """Visible Gaussians by range (as float32; ties by index), running ends of their tile entries, and the total."""
    device, n = count.device, len(count)
    if visible == 0:
        return wp.empty(0, dtype=int, device=device), wp.empty(0, dtype=int, device=device), 0
    if total > 2**30:
        raise ValueError(
            f"gaussians: they cover {total} tiles in all, more than 2^30; prune large Gaussians or render smaller"
        )
    keys, order = (wp.empty(2 * n, dtype=int, device=device) for _ in range(2))
    launch(binning.sort_keys, n, [count, distance, keys, order], device=device)
    wp.utils.radix_sort_pairs(keys, order, n)
    order = order[:visible]
    ends = wp.empty(visible, dtype=int, device=device)
    launch(binning.counts_in_order, visible, [order, count, ends], device=device)
    wp.utils.array_scan(ends, ends, inclusive=True)
    return order, ends, total


def _view(cam: Camera) -> Any:
    view = kernels.View()
    view.kind = kernels.SPHERICAL if cam.kind == "spherical" else kernels.PINHOLE
    view.width, view.height = cam.width, cam.height
    view.tiles_x = -(-cam.width // kernels.TILE)
    view.tiles_y = -(-cam.height // kernels.TILE)
    view.fx, view.fy, view.cx, view.cy = cam.fx, cam.fy, cam.cx, cam.cy
    view.rotation = wp.mat33d(cam.rotation)
    view.origin = wp.vec3d(cam.position)
    return view


@lru_cache(maxsize=64)
def _rays(
    kind: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float, real: Any, device: str
) -> Any:
    """Directions of the pixels of every column and row of blocks; beyond the image those of its border."""
    step, per_tile = kernels.BLOCK, kernels.TILE // kernels.BLOCK
    x = np.arange(-(-width // kernels.TILE) * kernels.TILE)
    y = np.arange(-(-height // kernels.TILE) * kernels.TILE)
    u, v = np.minimum(x, width - 1) + 0.5, np.minimum(y, height - 1) + 0.5
    if kind == "pinhole":
        across, along, down = (u - cx) / fx, np.ones(len(u)), (v - cy) / fy
        pitch = 1 / fx, 0.0, 1 / fy
    else:
        azimuth, zenith = u * 2 * np.pi / width - np.pi, v * np.pi / height
        across, along, down = np.cos(azimuth), np.sin(azimuth), 1 / np.tan(zenith)
        pitch = 2 * np.pi / width, 2 * np.pi / width, np.pi / height
    rounding = np.finfo(np.float32 if real is wp.float32 else np.float64).eps

    def spans(values: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray]:
        blocks = values.reshape(-1, per_tile, step)
        low, high = blocks.min(axis=2), blocks.max(axis=2)
        # Widened by a thousandth of a pixel and by rounding: what a block's pixels see is never left out.
        return (low + high) / 2, (high - low) / 2 + 1e-3 * pitch + 4 * rounding * np.abs(blocks).max(axis=2)

    def lanes(values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=kernels.lanes_of(real), device=device)

    rays = kernels.rays_of(real)()
    rays.across = lanes(np.tile(across.reshape(-1, step), (1, step)))
    rays.along = lanes(np.tile(along.reshape(-1, step), (1, step)))
    rays.down = lanes(np.repeat(down.reshape(-1, step), step, axis=1))
    columns = [*spans(across, pitch[0]), *spans(along, pitch[1])]
    rays.columns = lanes(np.stack([np.tile(c, (1, per_tile)) for c in columns], axis=1))
    rays.rows = lanes(np.stack([np.repeat(r, per_tile, axis=1) for r in spans(down, pitch[2])], axis=1))
    return rays
