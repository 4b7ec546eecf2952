"""Complex channels from few measurements: known geometry by the image method, one reflection coefficient a surface.

The channel of a receiver is the sum over its mirror chains of Friis along the unfolded length, exp(-j 2 pi d / lambda)
included, times the coefficient of every surface that the chain meets. Coefficients are fitted to measured channels by
complex Gauss-Newton steps (the channel is a polynomial in them); a prior holds what no measurement tells.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_positive, checked
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh, components
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.mirror_paths import MirrorPaths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.positions import check_positions, check_receivers, question_unit

REGULARISATION = 1e-4
"""Default weight of the prior; see :func:`fit_reflections`."""

_STEPS = 30
_ENOUGH = 1e-10  # relative fall of the loss at which steps stop


@dataclass(frozen=True)
class Reflections:
    """Fitted reflection coefficients of a mesh's surfaces.

    Attributes:
        coefficient: Complex reflection coefficient of each group, shape ``(G,)``; the prior where nothing told it.
        patch_group: Group of each planar patch, shape ``(P,)``, int.
        lit: Whether a training chain met the group, shape ``(G,)``, bool.
        frequency_hz: Carrier frequency [Hz].
        order: Most reflections on a chain.
        training_nmse: Normalised mean square error on the training receivers [linear]; NaN without any.
        trace_s: Time spent on geometry [s].
        solve_s: Time spent on the coefficients [s].
    """

    coefficient: np.ndarray
    patch_group: np.ndarray
    lit: np.ndarray
    frequency_hz: float
    order: int
    training_nmse: float
    trace_s: float
    solve_s: float
    _tracer: MirrorTracer

    def predict(self, receivers: ArrayLike) -> np.ndarray:
        """Complex channel between isotropic antennas at ``receivers`` (R, 3) or (3,) [m], shape ``(R,)``.

        Raises:
            ValueError: on another shape, NaN, or a place where :func:`trace_paths` refuses to answer.
        """
        points, t = np.atleast_2d(check_receivers("receivers", receivers)), self._tracer
        check_positions(
            t.mesh, t.transmitter, points, t.wavelength_m, on_surfaces=True, device=t.images.device
        )
        return self.channel(self._tracer.find(points, self.order), len(points))

    def channel(self, paths: MirrorPaths, count: int) -> np.ndarray:
        """Complex channel ``(count,)`` of paths that are already traced."""
        return _Model(paths, self.patch_group, count, self._tracer.wavelength_m).channel(self.coefficient)


@checked
def fit_reflections(
    mesh: GeometryLike,
    transmitter: ArrayLike,
    receivers: ArrayLike,
    csi: ArrayLike,
    frequency_hz: float,
    order: int = 2,
    *,
    groups: str | Sequence[int] | np.ndarray = "patch",
    prior: complex = 1.0,
    regularisation: float = REGULARISATION,
    chains: MirrorPaths | None = None,
    device: DeviceLike = None,
) -> Reflections:
    """Fit one complex reflection coefficient a surface to complex channels.

    Minimised is ``sum |model - csi|^2 / mean |csi|^2 + regularisation sum_g |r_g - prior|^2``: the regularisation is
    the relative noise power of a measurement over the variance that a coefficient is expected to have about the prior.

    Args:
        mesh: :class:`Mesh` [m], or a scene, of which only the mesh is used.
        transmitter: Position [m], shape ``(3,)``.
        receivers: Positions of the measurements [m], shape ``(R, 3)``; R may be 0: then all stays at the prior.
        csi: Complex channels between isotropic antennas, phase -2 pi f tau, shape ``(R,)``.
        frequency_hz: Carrier frequency [Hz].
        order: Most reflections on a chain: 0 and up.
        groups: What shares a coefficient: ``"patch"``, each planar patch has its own; ``"part"``, connected faces share
            one; or an index from 0 for each face, shape ``(F,)`` (a material index, say).
        prior: Coefficient of surfaces that nothing is known of; 1 reflects perfectly, without a sign change.
        regularisation: Weight of the prior, positive.
        chains: What :meth:`MirrorTracer.find` returned for the same mesh, transmitter, receivers and order, to save time.
        device: Where rays are cast.

    Raises:
        TypeError: if ``mesh`` is neither a mesh nor a scene, or an argument does not read as numbers.
        ValueError: on a wrong shape, NaN, channels that are all zero, another order, or groups of another form.
    """
    surface = as_mesh(mesh)
    points = check_array("receivers", receivers, (None, 3))
    channel = check_array("csi", csi, (len(points),), dtype=np.complex128, finite=False)
    if not np.isfinite(channel).all():
        raise ValueError("csi: got NaN or infinite values, expected finite complex channels")
    if len(channel) and not channel.any():
        raise ValueError("csi: got channels that are all zero, expected some power")
    if check_positive("regularisation", regularisation) <= 0:
        raise ValueError(f"regularisation: got {regularisation!r}, expected a positive number")
    if not np.isfinite(prior):
        raise ValueError(f"prior: got {prior!r}, expected a finite complex number")
    begin = time.perf_counter()
    tracer = MirrorTracer(surface, transmitter=transmitter, frequency_hz=frequency_hz, device=device)
    question_unit(surface, tracer.wavelength_m)
    check_positions(surface, tracer.transmitter, points, tracer.wavelength_m, on_surfaces=True, device=device)
    patch_group, count = _patch_groups(surface, tracer.patches, groups)
    if chains is None:
        chains = tracer.find(points, order)
    elif len(chains.receiver) and chains.receiver.max() >= len(points):
        raise ValueError(
            f"chains: got receiver {chains.receiver.max()}, expected those of {len(points)} receivers"
        )
    traced = time.perf_counter()
    model = _Model(chains, patch_group, len(points), SPEED_OF_LIGHT / tracer.frequency_hz)
    coefficient = np.full(count, complex(prior))
    lit = np.zeros(count, dtype=bool)
    lit[model.group[model.group >= 0]] = True
    nmse = np.nan
    if len(points):
        coefficient = _gauss_newton(model, channel, coefficient, np.flatnonzero(lit), regularisation)
        nmse = float(np.sum(np.abs(model.channel(coefficient) - channel) ** 2) / np.sum(np.abs(channel) ** 2))
    return Reflections(
        coefficient=coefficient,
        patch_group=patch_group,
        lit=lit,
        frequency_hz=tracer.frequency_hz,
        order=order,
        training_nmse=nmse,
        trace_s=traced - begin,
        solve_s=time.perf_counter() - traced,
        _tracer=tracer,
    )


class _Model:
    """The channel as a polynomial in the coefficients: ``gain`` times one factor for each of ``group`` (N, K)."""

    def __init__(self, chains: MirrorPaths, patch_group: np.ndarray, count: int, wavelength_m: float) -> None:
        self.receiver, self.count = chains.receiver, count
        self.gain = chains.gain(wavelength_m)
        self.group = np.where(chains.patch >= 0, patch_group[chains.patch], -1)

    def _factors(self, coefficient: np.ndarray) -> np.ndarray:
        return np.where(self.group >= 0, coefficient[self.group], 1.0)

    def channel(self, coefficient: np.ndarray) -> np.ndarray:
        sums = np.zeros(self.count, dtype=complex)
        np.add.at(sums, self.receiver, self.gain * self._factors(coefficient).prod(axis=1))
        return sums

    def jacobian(self, coefficient: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        """Derivative of the channel by the ``unknown`` coefficients, shape ``(R, U)``."""
        factors = self._factors(coefficient)
        column = np.full(len(coefficient), -1)
        column[unknown] = np.arange(len(unknown))
        jacobian = np.zeros((self.count, len(unknown)), dtype=complex)
        for k in range(factors.shape[1]):
            there = np.flatnonzero(self.group[:, k] >= 0)
            place = self.receiver[there], column[self.group[there, k]]
            others = np.delete(factors[there], k, axis=1).prod(axis=1)
            np.add.at(jacobian, place, self.gain[there] * others)
        return jacobian


def _gauss_newton(
    model: _Model, channel: np.ndarray, start: np.ndarray, unknown: np.ndarray, regularisation: float
) -> np.ndarray:
    scale = 1.0 / np.sqrt(np.mean(np.abs(channel) ** 2))

    def loss(coefficient: np.ndarray) -> float:
        misfit = np.abs(scale * (model.channel(coefficient) - channel)) ** 2
        return float(misfit.sum() + regularisation * (np.abs(coefficient - start)[unknown] ** 2).sum())

    best, value = start, loss(start)
    for _ in range(_STEPS):
        jacobian = scale * model.jacobian(best, unknown)
        residual = scale * (channel - model.channel(best)) + jacobian @ (best - start)[unknown]
        # As many equations as receivers, however many surfaces: (J J^H + mu I) y = residual, r = prior + J^H y.
        gram = jacobian @ jacobian.conj().T + regularisation * np.eye(len(channel))
        goal = start.copy()
        goal[unknown] += jacobian.conj().T @ np.linalg.solve(gram, residual)
        step, fell = 1.0, False
        while step > 1e-3:
            trial = best + step * (goal - best)
            now = loss(trial)
            if now < value:
                fell = value - now > _ENOUGH * value
                best, value = trial, now
                break
            step *= 0.5
        if not fell:
            break
    return best


def _patch_groups(
    mesh: Mesh, patches: PlanarPatches, groups: str | Sequence[int] | np.ndarray
) -> tuple[np.ndarray, int]:
    """Group of each patch, and how many groups there are."""
    if isinstance(groups, str):
        if groups == "patch":
            return np.arange(len(patches)), len(patches)
        if groups != "part":
            raise ValueError(f"groups: got {groups!r}, expected 'patch', 'part' or an index for each face")
        face = mesh_parts(mesh)
    else:
        face = check_array("groups", groups, (len(mesh.faces),), dtype=np.int64)
    if (face < 0).any():
        raise ValueError("groups: got negative indices, expected whole numbers from 0")
    own = np.flatnonzero((patches.face_patch >= 0) & patches.once)
    group = np.zeros(len(patches), np.int64)
    group[patches.face_patch[own[::-1]]] = face[own[::-1]]
    mixed = len(np.unique(patches.face_patch[own][group[patches.face_patch[own]] != face[own]]))
    if mixed:
        raise ValueError(
            f"groups: {mixed} planar patches hold faces of several groups, expected one group a planar patch"
        )
    return group, int(face.max(initial=-1)) + 1


def mesh_parts(mesh: Mesh) -> np.ndarray:
    """Index of the connected part that each face belongs to, shape ``(F,)``: a room's shell, a table, a chair."""
    corner = mesh.welded_faces
    ends = corner[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = int(corner.max(initial=-1)) + 1
    label = components(count, ends)[corner[:, 0]]
    return np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1))
