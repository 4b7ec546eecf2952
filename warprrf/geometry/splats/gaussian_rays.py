"""Rays through Gaussians: ordered hits along any ray, and transmittance between two points, in metres.

The rasteriser blends what one point sees; here every ray has its own origin. A Gaussian's response is evaluated
exactly on the ray, as there (:mod:`warprrf.kernels.rays.gaussians`), in float64, and it counts where its peak lies
within the ray or segment and its alpha exceeds ``alpha_min``. Transmittance is a product over layers, so it needs no
order: the hierarchy's candidates are multiplied as they come.

:meth:`GaussianRays.hits` and :meth:`GaussianRays.transmittance` are the NumPy face. :meth:`GaussianRays.trace` and
:meth:`GaussianRays.transmit` return Warp arrays and record their adjoints on an active ``wp.Tape``;
:mod:`warprrf.geometry.splats.torch_functions` offers both to torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_choice, check_count, checked
from warprrf.device import DeviceLike, active_tape, gradient, launch, record, resolve
from warprrf.geometry.rays import check_rows
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import RADIO, Blending, Rasterizer, uploaded
from warprrf.kernels.rays import gaussians as kernels

CPU_PIECES = 4  # gradient sums on a CPU, one writer each: the result does not depend on the thread count
LARGEST = 1e15
"""Of coordinates and directions: squares and products of them stay finite, also in float32."""

ORDERS = {"peak": kernels.BY_PEAK, "range": kernels.BY_RANGE}
"""Of hits: by the peak's distance along the ray, or by the mean's from the origin, as the rasteriser blends."""


@dataclass(frozen=True)
class RayHits:
    """The first K Gaussians along each ray, in order; of :meth:`GaussianRays.trace` on the device, where under a tape all but
    ``index`` carry gradients.

    Attributes:
        index: Gaussian, shape ``(N, K)`` int32, -1 where fewer than K.
        t: distance of its peak along the unit direction [m], shape ``(N, K)`` float64, inf where none.
        alpha: opacity times response at the peak, clamped, shape ``(N, K)`` float64.
        weight: alpha times the transmittance in front, shape ``(N, K)`` float64.
        left: transmittance behind the last hit listed, shape ``(N,)`` float64. Where all K places are taken, more
            Gaussians may follow.
    """

    index: Any = field(repr=False)
    t: Any = field(repr=False)
    alpha: Any = field(repr=False)
    weight: Any = field(repr=False)
    left: Any = field(repr=False)

    @property
    def outputs(self) -> tuple[Any, ...]:
        """The arrays that a loss may use."""
        return self.t, self.alpha, self.weight, self.left


@checked
class GaussianRays:
    """Gaussians in a hierarchy, asked along arbitrary rays.

    Args:
        gaussians: the Gaussians; or their means, quaternions, scales and opacities as four Warp arrays of one
            precision, whose ``.grad`` the adjoints add to. The hierarchy holds them as they are now: after a change
            of parameters build another.
        blending: alpha cutoff, clamp and transmittance rule; default: those of radio. ``transmittance_min`` ends the
            hits of a ray; it does not apply to :meth:`transmittance`.
        device: where the hierarchy is searched; default: that of the arrays, else Warp's preferred one.

    Raises:
        TypeError: if ``gaussians`` is neither.
    """

    def __init__(
        self,
        gaussians: Gaussians | tuple[wp.array, wp.array, wp.array, wp.array],
        *,
        blending: Blending | None = None,
        device: DeviceLike = None,
    ) -> None:
        self.blending = blending or RADIO
        if isinstance(gaussians, Gaussians):
            self.device = resolve(device)
            self.inputs: tuple[wp.array, ...] = Rasterizer(device=self.device).upload(gaussians)
        elif len(gaussians) == 4 and all(isinstance(a, wp.array) for a in gaussians):
            self.device = gaussians[0].device if device is None else resolve(device)
            self.inputs = tuple(gaussians)
        else:
            raise TypeError(
                f"gaussians: got {type(gaussians).__name__}, expected warprrf.Gaussians or four Warp arrays"
            )
        self._kernels = kernels.build(self.inputs[3].dtype)
        self._rules = self.blending.rules
        self._build()

    def __len__(self) -> int:
        return len(self.inputs[0])

    def __reduce__(self) -> tuple[Callable[..., GaussianRays], tuple[Any, ...]]:
        return _rebuilt, (tuple(a.numpy() for a in self.inputs), self.blending, str(self.device))

    def _build(self) -> None:
        n, on = len(self), self.device
        scene = kernels.Scene()
        scene.means = wp.empty(n, dtype=wp.vec3d, device=on)
        scene.whitening = wp.empty(n, dtype=wp.mat33d, device=on)
        scene.opacities = wp.empty(n, dtype=wp.float64, device=on)
        scene.cuts = wp.empty(n, dtype=wp.float64, device=on)
        half = wp.empty(n, dtype=wp.vec3d, device=on)
        out = [scene.means, scene.whitening, scene.opacities, scene.cuts, half]
        launch(self._kernels.whiten, n, [*self.inputs, self._rules, *out], device=on)
        ids = np.flatnonzero(scene.cuts.numpy() > 0).astype(np.int32)
        scene.ids = wp.array(ids, dtype=int, device=on)
        if len(ids):
            middle, size = scene.means.numpy()[ids], half.numpy()[ids]
            low, high = (middle - size).min(axis=0), (middle + size).max(axis=0)
            center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
            pad = kernels.ROUNDING * 4 * radius
            scene.center, scene.radius = wp.vec3d(center), radius + 2 * pad
            self._bvh = wp.Bvh(
                wp.array(middle - size - center - pad, dtype=wp.vec3, device=on),
                wp.array(middle + size - center + pad, dtype=wp.vec3, device=on),
            )
            scene.bvh = self._bvh.id
        self._scene = scene

    def hits(self, origins: ArrayLike, directions: ArrayLike, k: int = 16, *, order: str = "peak") -> RayHits:
        """The first ``k`` Gaussians along each ray.

        Args:
            origins: ray starts [m], shape ``(N, 3)`` or ``(3,)`` for all.
            directions: of any length but zero, shape ``(N, 3)`` or ``(3,)`` for all.
            k: places for each ray.
            order: ``"peak"``: by distance of the peak along the ray; ``"range"``: by distance of the mean from the
                origin, in float32 as the rasteriser blends. Ties by index.

        Raises:
            TypeError, ValueError: naming the argument: wrong shape, NaN, a direction of length zero, ``k`` below 1.
        """
        found, _ = self.trace_with_adjoint(origins, directions, k, order=order, gradients=False)
        return RayHits(found.index.numpy(), *(array.numpy() for array in found.outputs))

    def transmittance(self, a: ArrayLike, b: ArrayLike) -> np.ndarray:
        """Share of light that passes from ``a`` to ``b``, (N, 3) or (3,) each [m]; shape ``(N,)`` float64.

        A Gaussian counts whose response peaks strictly between the points; between two equal points nothing does.

        Raises:
            TypeError, ValueError: naming the argument that does not fit.
        """
        return self.transmit_with_adjoint(a, b, gradients=False)[0].numpy()

    def trace(
        self, origins: ArrayLike, directions: ArrayLike, k: int = 16, *, order: str = "peak"
    ) -> RayHits:
        """:meth:`hits` as Warp arrays, differentiable on an active tape in the parameters (not in the rays)."""
        tape = active_tape()
        found, adjoint = self.trace_with_adjoint(
            origins, directions, k, order=order, gradients=tape is not None
        )
        if tape is not None:
            record(tape, adjoint, self.inputs, found.outputs)
        return found

    def transmit(self, a: ArrayLike, b: ArrayLike) -> wp.array:
        """:meth:`transmittance` as a Warp array, differentiable on an active tape in the parameters."""
        tape = active_tape()
        values, adjoint = self.transmit_with_adjoint(a, b, gradients=tape is not None)
        if tape is not None:
            record(tape, adjoint, self.inputs, (values,))
        return values

    def trace_with_adjoint(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        k: int = 16,
        *,
        order: str = "peak",
        gradients: bool = True,
    ) -> tuple[RayHits, Callable[[], None]]:
        """:meth:`trace` without a tape: the hits, and the function that adds the parameters' gradients, which only
        hits with ``gradients`` have."""
        start, toward = _pairs(("origins", origins), ("directions", directions))
        places = check_count("k", k)
        check_choice("order", order, ORDERS)
        still = int(np.count_nonzero(np.linalg.norm(toward, axis=1) == 0))
        if still:
            raise ValueError(f"directions: got {still} of length zero, expected directions")
        count, on = np.broadcast_shapes(start.shape, toward.shape)[0], self.device
        shape = (count, places)
        real = {"dtype": wp.float64, "device": on}
        found = RayHits(
            wp.full(shape, -1, dtype=int, device=on),
            wp.full(shape, np.inf, requires_grad=gradients, **real),
            wp.zeros(shape, requires_grad=gradients, **real),
            wp.zeros(shape, requires_grad=gradients, **real),
            wp.empty(count, requires_grad=gradients, **real),
        )
        rays = [wp.array(start, dtype=wp.vec3d, device=on), wp.array(toward, dtype=wp.vec3d, device=on)]
        launch(
            kernels.collect,
            count,
            [self._scene, self._rules, ORDERS[order], *rays, found.index, wp.empty(shape, **real),
             found.t, found.alpha, found.weight, found.left],
            device=on,
        )  # fmt: skip

        def adjoint() -> None:
            slopes = [array.grad for array in found.outputs]
            inputs = [self._scene, self._rules, *rays, found.index, found.alpha, found.weight, *slopes]
            self._chain(kernels.collect_adjoint, count, inputs)

        return found, adjoint

    def transmit_with_adjoint(
        self, a: ArrayLike, b: ArrayLike, *, gradients: bool = True
    ) -> tuple[wp.array, Callable[[], None]]:
        """:meth:`transmit` without a tape: the values, and the function that adds the parameters' gradients, which only
        values with ``gradients`` have."""
        start, end = _pairs(("a", a), ("b", b))
        count, on = np.broadcast_shapes(start.shape, end.shape)[0], self.device
        values = wp.empty(count, dtype=wp.float64, device=on, requires_grad=gradients)
        parts = [wp.empty(count, dtype=wp.float64, device=on), wp.empty(count, dtype=int, device=on)]
        ends = [wp.array(start, dtype=wp.vec3d, device=on), wp.array(end, dtype=wp.vec3d, device=on)]
        launch(kernels.transmit, count, [self._scene, self._rules, *ends, values, *parts], device=on)

        def adjoint() -> None:
            inputs = [self._scene, self._rules, *ends, *parts, values.grad]
            self._chain(kernels.transmit_adjoint, count, inputs)

        return values, adjoint

    def _chain(self, kernel: wp.Kernel, count: int, inputs: list[Any]) -> None:
        """Run a hit-wise adjoint, then add its sums to the gradients of the parameters."""
        if count == 0 or len(self) == 0:
            return
        pieces = 1 if self.device.is_cuda else min(CPU_PIECES, count)
        sums = wp.zeros((pieces, len(self), kernels.SUMS), dtype=wp.float64, device=self.device)
        launch(kernel, count, [count, pieces, *inputs, sums], device=self.device, pieces=pieces)
        _, quaternions, scales, _ = self.inputs
        gradients = [gradient(array) for array in self.inputs]
        launch(
            self._kernels.chain, len(self), [quaternions, scales, self._scene.whitening, sums, *gradients],
            device=self.device,
        )  # fmt: skip


def _pairs(first: tuple[str, ArrayLike], second: tuple[str, ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays of float64 rows, one or N of each."""
    rows = check_rows(first, second)
    for name, array in zip((first[0], second[0]), rows, strict=True):
        check_array(name, array)
        if np.abs(array).max(initial=0.0) > LARGEST:
            raise ValueError(f"{name}: got numbers above {LARGEST:g}, expected metres")
    return rows


def _rebuilt(arrays: tuple[np.ndarray, ...], blending: Blending, device: str) -> GaussianRays:
    """What was pickled or copied, with a hierarchy of its own."""
    real = wp.float64 if arrays[3].dtype == np.float64 else wp.float32
    return GaussianRays(uploaded(arrays, real, device), blending=blending)
