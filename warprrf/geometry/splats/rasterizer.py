"""One rasteriser for photos and panoramas: exact on every ray, differentiable through Warp's tape.

:class:`Rasterizer` works on Warp arrays, in float32 or float64, and records its hand-written adjoint on an active
``wp.Tape``; it is what :mod:`warprrf.geometry.photos.gaussians.refine` trains with. :mod:`warprrf.geometry.splats.render` is its
NumPy face.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_choice, check_count, checked
from warprrf.device import DeviceLike, active_tape, gradient, launch, record, resolve
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.kernels.raster import binning, blocks, reference
from warprrf.kernels.raster import project as projection
from warprrf.kernels.raster import sh as harmonics
from warprrf.kernels.raster.view import EXPONENTIAL, PINHOLE, PRODUCT, SPHERICAL, TILE, Rules, View

PARTS = 8  # partial sums of gradients on a CPU, one writer each: the thread count changes nothing
MOST_WEIGHTS = 1 << 16  # of a pixel that can be asked for
GRAIN = 32  # a tile is work enough for few of them to be worth a thread
WARP = 32  # threads, which all take part where a GPU's add up

RULES = {"product": PRODUCT, "exp": EXPONENTIAL}
Parameters = tuple[wp.array, wp.array, wp.array, wp.array]
"""Means, quaternions, scales and opacities."""


def uploaded(arrays: Sequence[np.ndarray], real: type, device: DeviceLike) -> Parameters:
    """Means, quaternions, scales and opacities as arrays of the precision ``real``."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    means, quaternions, scales, opacities = (
        wp.array(array, dtype=kind, device=device)
        for array, kind in zip(arrays, (vec3, vec4, vec3, real), strict=True)
    )
    return means, quaternions, scales, opacities


@checked
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

    Raises:
        ValueError: naming the setting that is out of range.
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
        check_choice("rule", self.rule, RULES)

    @property
    def rules(self) -> Rules:
        """As the kernels take it."""
        rules = Rules()
        rules.alpha_min, rules.alpha_max = self.alpha_min, self.alpha_max
        rules.transmittance_min, rules.rule = self.transmittance_min, RULES[self.rule]
        return rules


# An image 60 dB deep: a layer clamped at 0.99 would leak -20 dB, so alpha may come within 1e-6 of one.
RADIO = Blending(alpha_min=1e-4, alpha_max=1 - 1e-6, transmittance_min=1e-6)


@dataclass(frozen=True)
class Prepared:
    """Gaussians projected for one camera, on the device: tile t may see ``ids[starts[t]:starts[t + 1]]``, near to
    far."""

    view: View
    inputs: Parameters
    splats: wp.array
    ids: wp.array
    starts: wp.array

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return int(self.view.height), int(self.view.width)

    @property
    def tiles(self) -> int:
        """How many tiles the image has."""
        return len(self.starts) - 1


@dataclass(frozen=True)
class Image:
    """A blended image on the device.

    Attributes:
        features: shape ``(H, W, C)``.
        alpha: sum of blending weights, shape ``(H, W)``.
        depth: blended mean range [m], 0 where nothing is seen, shape ``(H, W)``.
        transmittance: what the background is seen through, shape ``(H, W)``.
        dominant: Gaussian of largest weight, int32, -1 where none, shape ``(H, W)``.
        peak: range of its peak [m], shape ``(H, W)``.
    """

    features: wp.array
    alpha: wp.array
    depth: wp.array
    transmittance: wp.array
    dominant: wp.array
    peak: wp.array

    @property
    def differentiable(self) -> tuple[wp.array, wp.array, wp.array]:
        """The arrays that a loss may use."""
        return self.features, self.alpha, self.depth


@checked
class Rasterizer:
    """Projects, bins and blends on one device in one precision.

    Under an active ``wp.Tape`` :meth:`rasterize` and :meth:`colors` record their adjoints for the means, quaternions,
    scales, opacities, features, background and harmonics; losses may use ``features``, ``alpha`` and ``depth``.

    Args:
        device: where; default: Warp's preferred device.
        blending: cutoffs and transmittance rule; default: those of photos.
        real: ``wp.float32`` or ``wp.float64``.
        per_pixel: blend with a thread per pixel on a CPU too, as a GPU does: several times slower, the reference that
            tests compare with.
    """

    def __init__(
        self,
        *,
        device: DeviceLike = None,
        blending: Blending | None = None,
        real: type = wp.float32,
        per_pixel: bool = False,
    ) -> None:
        self.device = resolve(device)
        self.blending = blending or Blending()
        self.real = real
        self.per_pixel = per_pixel or self.device.is_cuda
        self.kernels = reference if self.per_pixel else blocks
        self.threads_per_tile = reference.LANES if self.per_pixel else 1

    def __reduce__(self) -> tuple[Callable[..., Rasterizer], tuple[()]]:
        device, blending, real = str(self.device), self.blending, self.real
        return partial(Rasterizer, device=device, blending=blending, real=real, per_pixel=self.per_pixel), ()

    def _vector(self, size: int) -> Any:
        return wp.types.vector(size, self.real)

    def upload(self, g: Gaussians) -> Parameters:
        """Means, quaternions, scales and opacities as arrays of this precision."""
        return uploaded((g.means, g.quaternions, g.scales, g.opacities), self.real, self.device)

    def rasterize(
        self,
        means: wp.array,
        quaternions: wp.array,
        scales: wp.array,
        opacities: wp.array,
        features: wp.array,
        cam: Camera,
        background: ArrayLike | wp.array | None = None,
    ) -> Image:
        """Project and blend; differentiable on an active tape."""
        return self.blend(self.prepare(means, quaternions, scales, opacities, cam), features, background)

    def colors(self, means: wp.array, sh: wp.array, cam: Camera) -> wp.array:
        """Colours ``max(0, SH + 0.5)`` towards the camera, shape ``(N, C)``; differentiable on an active tape."""
        tape = active_tape()
        self._fits("sh", sh, self.real, (None, None, None))
        shape = (len(means), sh.shape[2])
        out = wp.zeros(shape, dtype=self.real, device=self.device, requires_grad=tape is not None)
        origin = self.colors_into(means, sh, cam, out)

        def adjoint() -> None:
            whole, out.grad = out.grad, wp.zeros_like(out, requires_grad=False)
            kernel = harmonics.build(self.real).uncut
            launch(kernel, len(means), [out, whole, out.grad], device=self.device)
            self.colors_adjoint(means, sh, origin, out)
            out.grad = whole

        if tape is not None:
            record(tape, adjoint, (means, sh), (out,))
        return out

    def colors_into(self, means: wp.array, sh: wp.array, cam: Camera, out: wp.array) -> wp.array:
        """Write the colours to ``out``; returns the ray origin that :meth:`colors_adjoint` wants. Records nothing."""
        self._check_colors(means, sh, out)
        origin = wp.array([cam.position], dtype=self._vector(3), device=self.device)
        launch(harmonics.build(self.real).colors, len(means), [means, sh, origin, out], device=self.device)
        return origin

    def colors_adjoint(self, means: wp.array, sh: wp.array, origin: wp.array, out: wp.array) -> None:
        """Add the gradients of ``means`` and ``sh`` for ``out.grad``, also of colours that are cut off at zero: so black
        ones can become brighter again while they are fitted."""
        self._check_colors(means, sh, out)
        self._fits("origin", origin, self._vector(3), (1,))
        kernel = harmonics.build(self.real).colors
        launch(kernel, len(means), [means, sh, origin, out], device=self.device, adjoint=True)

    def prepare(
        self, means: wp.array, quaternions: wp.array, scales: wp.array, opacities: wp.array, cam: Camera
    ) -> Prepared:
        """Project every Gaussian and list those that each tile may see, near to far.

        Raises:
            ValueError: if the Gaussians cover more than 2^30 tiles in all, or an array is not of this device and
                precision.
        """
        n, device = len(means), self.device
        self._fits("means", means, self._vector(3), (n,))
        self._fits("quaternions", quaternions, self._vector(4), (n,))
        self._fits("scales", scales, self._vector(3), (n,))
        self._fits("opacities", opacities, self.real, (n,))
        view = _view(cam)
        inputs = (means, quaternions, scales, opacities)
        span = wp.empty(n, dtype=wp.vec4i, device=device)
        # Sorting wants room for two.
        keys, order = (wp.empty(2 * n, dtype=int, device=device) for _ in range(2))
        splats = wp.empty(n, dtype=projection.splat_of(self.real), device=device)
        project = projection.build_project(self.real)
        launch(project, n, [*inputs, view, self.blending.rules, span, keys, order, splats], device=device)
        ids, starts = _listed(span, keys, order, view)
        return Prepared(view, inputs, splats, ids, starts)

    def blend(
        self, prepared: Prepared, features: wp.array, background: ArrayLike | wp.array | None = None
    ) -> Image:
        """Blend ``features`` (N, C) front to back; differentiable on an active tape."""
        tape = active_tape()
        behind = self._background(prepared, features, background)
        image = self._blend(prepared, features, behind, requires_grad=tape is not None)
        if tape is not None:
            inputs = (*prepared.inputs, features, behind)
            record(
                tape, lambda: self._adjoint(prepared, features, image, behind), inputs, image.differentiable
            )
        return image

    def blend_with_adjoint(
        self,
        prepared: Prepared,
        features: wp.array,
        background: ArrayLike | wp.array | None = None,
        *,
        gradients: bool = True,
    ) -> tuple[Image, Callable[[], wp.array]]:
        """Blend without a tape: the image, and the function that adds the inputs' gradients for the image's. It
        returns each Gaussian's summed blending weight.

        With ``gradients`` the image gets gradients of zero to write to; without, assign those that there are (they are
        only read). An input without a gradient is left out.
        """
        behind = self._background(prepared, features, background)
        image = self._blend(prepared, features, behind, requires_grad=gradients)
        return image, lambda: self._adjoint(prepared, features, image, behind)

    def strongest(self, prepared: Prepared, top_k: int) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """The ``top_k`` largest blending weights of every pixel, front to back: Gaussian (-1 where fewer), weight and
        range of the peak [m], shape ``(H, W, K)`` each, and the sum of all weights ``(H, W)``."""
        shape = *prepared.shape, check_count("top_k", top_k, most=MOST_WEIGHTS)
        out = (
            wp.full(shape, -1, dtype=int, device=self.device),
            wp.zeros(shape, dtype=self.real, device=self.device),
            wp.zeros(shape, dtype=self.real, device=self.device),
            wp.zeros(shape[:2], dtype=self.real, device=self.device),
        )
        kernel = self.kernels.build_strongest(self.real)
        self._launch_tiles(kernel, prepared, [*self._scene(prepared), *out])
        return out

    def _background(
        self, prepared: Prepared, features: wp.array, background: ArrayLike | wp.array | None
    ) -> wp.array:
        """What lies behind ``features``, which are checked with it."""
        self._fits("features", features, self.real, (len(prepared.splats), None))
        channels = features.shape[1]
        if isinstance(background, wp.array):
            self._fits("background", background, self.real, (channels,))
            return background
        if background is None:
            return wp.zeros(channels, dtype=self.real, device=self.device)
        values = check_array("background", background, (channels,))
        return wp.array(values, dtype=self.real, device=self.device)

    def _check_colors(self, means: wp.array, sh: wp.array, out: wp.array) -> None:
        self._fits("means", means, self._vector(3), (None,))
        self._fits("sh", sh, self.real, (len(means), None, None))
        if sh.shape[1] not in harmonics.COEFFICIENTS.values():
            raise ValueError(
                f"sh: got {sh.shape[1]} coefficients, expected {[*harmonics.COEFFICIENTS.values()]}"
            )
        self._fits("out", out, self.real, (len(means), sh.shape[2]))

    def _fits(self, name: str, array: wp.array, kind: type, shape: tuple[int | None, ...]) -> None:
        """Raise ValueError unless an array is of this device, ``kind`` and ``shape``, None for any length."""
        fits = array.ndim == len(shape) and all(
            n in (None, own) for n, own in zip(shape, array.shape, strict=True)
        )
        if not fits or not wp.types.types_equal(array.dtype, kind) or array.device != self.device:
            wanted = tuple("any" if n is None else n for n in shape)
            raise ValueError(
                f"{name}: got {array.shape} of {array.dtype.__name__} on {array.device}, expected {wanted} of "
                f"{kind.__name__} on {self.device}"
            )

    def _scene(self, prepared: Prepared) -> list[Any]:
        """What kernels that walk the lists take first."""
        return [prepared.splats, prepared.ids, prepared.starts, prepared.view, self.blending.rules]

    def _launch_tiles(
        self, kernel: wp.Kernel, prepared: Prepared, inputs: list[Any], cuts: list[int] | None = None
    ) -> None:
        """Launch a kernel over all tiles, cut at the tiles ``cuts``."""
        each = self.threads_per_tile
        bounds = None if cuts is None else [each * tile for tile in cuts]
        count = each * prepared.tiles
        if self.device.is_cuda:
            count += -count % WARP
        launch(kernel, count, inputs, device=self.device, grain=each * GRAIN, cuts=bounds)

    def _blend(
        self, prepared: Prepared, features: wp.array, background: wp.array, *, requires_grad: bool
    ) -> Image:
        shape, channels = prepared.shape, features.shape[1]
        real: dict[str, Any] = {"dtype": self.real, "device": self.device}
        image = Image(
            features=wp.empty((*shape, channels), requires_grad=requires_grad, **real),
            alpha=wp.empty(shape, requires_grad=requires_grad, **real),
            depth=wp.empty(shape, requires_grad=requires_grad, **real),
            transmittance=wp.empty(shape, **real),
            dominant=wp.empty(shape, dtype=int, device=self.device),
            peak=wp.empty(shape, **real),
        )
        outputs = [image.features, image.alpha, image.depth, image.transmittance, image.dominant, image.peak]
        for first in range(0, channels, projection.CHANNELS):
            width = min(channels - first, projection.CHANNELS)
            inputs = [*self._scene(prepared), features, first]
            if self.per_pixel:
                inputs.append(self._stretches(width, inputs))
            self._launch_tiles(
                self.kernels.build_blend(self.real, width), prepared, [*inputs, background, *outputs]
            )
        return image

    def _stretches(self, width: int, inputs: list[Any]) -> wp.array:
        """Whole stretches of the lists, each blended by itself."""
        count, lanes = len(inputs[1]) // reference.STRETCH, reference.LANES
        kind = reference.layers(self.real, width).Layers
        found = wp.empty((count, lanes), dtype=kind, device=self.device)
        kernel = reference.build_stretches(self.real, width)
        launch(kernel, count * lanes, [*inputs, found], device=self.device, grain=lanes * GRAIN)
        return found

    def _adjoint(
        self, prepared: Prepared, features: wp.array, image: Image, background: wp.array
    ) -> wp.array:
        """Add the gradients of every input for those of ``image``; returns each Gaussian's summed blending weight."""
        channels, n = features.shape[1], len(features)
        parts, cuts = self._parts(prepared)
        slopes = [gradient(array) for array in image.differentiable]
        parameter_gradients = [gradient(array) for array in prepared.inputs]
        feature_gradient = gradient(features)
        sums_of_one = self._vector(projection.SUMS)
        seen = wp.zeros(n, dtype=self.real, device=self.device)
        for first in range(0, channels, projection.CHANNELS):
            kernel = self.kernels.build_adjoint(self.real, min(channels - first, projection.CHANNELS))
            sums = wp.zeros((len(cuts) - 1, n), dtype=sums_of_one, device=self.device)
            pixels = [*image.differentiable, *slopes]
            inputs = [*self._scene(prepared), parts, features, first, *pixels, sums]
            self._launch_tiles(kernel, prepared, inputs, cuts)
            launch(
                projection.build_chain(self.real),
                n,
                [*prepared.inputs, prepared.view, first, sums, *parameter_gradients, feature_gradient, seen],
                device=self.device,
            )
        if background.requires_grad:
            kernel = reference.build_background(self.real)
            launch(kernel, channels, [image.transmittance, slopes[0], background.grad], device=self.device)
        return seen

    def _parts(self, prepared: Prepared) -> tuple[wp.array, list[int]]:
        """Which partial sum each tile adds to, and the tiles where the parts end: parts of equal work on a CPU, which
        launches each on one thread; a GPU adds atomically to one."""
        tiles = prepared.tiles
        if self.device.is_cuda:
            return wp.zeros(tiles, dtype=int, device=self.device), [0, tiles]
        work = prepared.starts.numpy() + np.arange(tiles + 1)
        cuts = np.searchsorted(work, work[-1] * np.arange(PARTS + 1) / PARTS)
        parts = np.repeat(np.arange(PARTS), np.diff(cuts))
        return wp.array(parts, dtype=int, device=self.device), cuts.tolist()


def _listed(span: wp.array, keys: wp.array, order: wp.array, view: View) -> tuple[wp.array, wp.array]:
    """Gaussians of every tile by range (as float32; ties by index), and where each tile's begin."""
    device, n = span.device, len(span)
    tiles = view.tiles_x * view.tiles_y
    if n == 0:
        return _nothing(tiles, device)
    wp.utils.radix_sort_pairs(keys, order, n)
    ends = wp.empty(n, dtype=wp.int64, device=device)
    launch(binning.counts_in_order, n, [order, span, ends], device=device)
    wp.utils.array_scan(ends, ends, inclusive=True)
    entries = int(ends[n - 1 :].numpy()[0])  # one number, where the counts may be millions
    if entries == 0:
        return _nothing(tiles, device)
    if entries > 2**30:
        raise ValueError(
            f"gaussians: they cover {entries} tiles in all, more than 2^30; prune large Gaussians or render smaller"
        )
    keys, ids = (wp.empty(2 * entries, dtype=int, device=device) for _ in range(2))
    launch(binning.emit_entries, n, [order, span, ends, view.tiles_x, keys, ids], device=device)
    wp.utils.radix_sort_pairs(keys, ids, entries, 0, tiles.bit_length())
    starts = wp.empty(tiles + 1, dtype=int, device=device)
    launch(binning.tile_starts, tiles + 1, [keys, entries, starts], device=device)
    return ids[:entries], starts


def _nothing(tiles: int, device: wp.Device) -> tuple[wp.array, wp.array]:
    """Lists of a view in which there is nothing to see."""
    return wp.empty(1, dtype=int, device=device), wp.zeros(tiles + 1, dtype=int, device=device)


def _view(cam: Camera) -> View:
    view = View()
    view.kind = SPHERICAL if cam.kind == "spherical" else PINHOLE
    view.width, view.height = cam.width, cam.height
    view.tile, view.tiles_x, view.tiles_y = TILE, -(-cam.width // TILE), -(-cam.height // TILE)
    view.fx, view.fy, view.cx, view.cy = cam.fx, cam.fy, cam.cx, cam.cy
    view.rotation = wp.mat33d(cam.rotation if cam.kind == "spherical" else cam.rotation[[0, 2, 1]])
    view.origin = wp.vec3d(cam.position)
    return view
