"""The full model of a scene at a few receivers, by parts that can be left out one by one.

All that a bistatic field can model is switched on; air, edges and walls are added as estimates. Path gains add up, so
each part is computed once and every reduced model is a sum of parts. Only light after a first bounce is no sum: its
parts are computed for each combination that is asked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import gas_attenuation_db_per_m
from warprrf.rf.em.fresnel import lobe, slab_reflection, surface_table
from warprrf.rf.em.half_spaces import fresnel_curves
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.bounces import LOBES
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.fit import Parameters
from warprrf.rf.fields.bistatic.sight import Sight
from warprrf.rf.fields.bistatic.specular import specular_paths
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import Terms
from warprrf.rf.paths.blockage import LIFT_M, SidePaths, diffracted, transmitted
from warprrf.rf.spectra.spectrum import default_floor, pixel_solid_angles, spread, to_db

ASSUMED_PERMITTIVITY = 4.0 * (1.0 - 0.06j)
"""Of walls whose material is not known; loss as of plasterboard and wood at 300 GHz in ITU-R P.2040-4, table 3."""
ASSUMED_THICKNESS_M = 0.0125  # a plasterboard: thin walls let more through
ONE_BOUNCE: dict[str, Any] = {
    "mirror_scatter": False,
    "scatter_mirror": False,
    "diffuse_order": 1,
    "indirect": False,
}
"""Terms without anything after a first bounce."""


@dataclass(frozen=True)
class Walls:
    """What transmission goes through: mesh, and complex permittivity and thickness [m] of each face ``(F,)``."""

    mesh: Mesh
    permittivity: np.ndarray
    thickness_m: np.ndarray
    assumed: bool


def material_parameters(materials: Sequence[Any], frequency_hz: float) -> tuple[Parameters, tuple[int, ...]]:
    """Parameters of the bistatic model that stand for ``materials``, and the exponents of their lobes.

    A slab's reflection over the angle of incidence is replaced by the half-space of one permittivity, times a factor,
    that is nearest to it in the least squares.

    Raises:
        ValueError: outside the band of a material.
    """
    table = surface_table(list(materials), frequency_hz)
    scattering = table.scattering**2
    lobes = tuple(sorted({int(a) for a, s in zip(table.alpha_r, scattering, strict=True) if s > 0})) or (0,)
    curves = fresnel_curves()
    cosine = np.linspace(0.0, 1.0, curves.curves.shape[1])[1:]  # at grazing all reflect all
    family = curves.curves[:, 1:]
    wavelength_m = SPEED_OF_LIGHT / frequency_hz
    slab = [
        0.5 * sum(np.abs(r) ** 2 for r in slab_reflection(cosine, eta, d, wavelength_m))
        for eta, d in zip(table.permittivity, table.thickness_m, strict=True)
    ]
    target = np.stack(slab)[:, None]
    scale = (target * family).sum(axis=-1) / (family**2).sum(axis=-1)
    member = ((target - scale[..., None] * family) ** 2).sum(axis=-1).argmin(axis=1)
    factor = scale[np.arange(len(member)), member]
    own = np.array([[a == n for n in lobes] for a in table.alpha_r])
    with np.errstate(divide="ignore"):
        return (
            Parameters(
                np.log(own * (factor * scattering)[:, None]),
                curves.log_excess[member],
                np.log(factor * (1.0 - scattering)),
                np.full(len(factor), -np.inf),
            ),
            lobes,
        )


def full_field(
    geometry: Any,
    *,
    transmitter: np.ndarray,
    frequency_hz: float,
    shape: tuple[int, int],
    beam_sigma_rad: float,
    device: Any = None,
) -> tuple[BistaticField, Walls, str]:
    """A field with every term on for a Scene, Reconstruction, Mesh or bistatic field; its walls; and where its
    materials come from: ``"scene"``, ``"fit"`` or ``"assumed"``."""
    further: dict[str, Any] = {
        "mirror_scatter": True,
        "scatter_mirror": True,
        "diffuse_order": 3,
        "mirror_order": 2,
    }
    if isinstance(geometry, BistaticField):
        terms = replace(geometry.terms, line_of_sight=True, diffuse=True, **further)
        return (
            replace(geometry, terms=terms, transmitter=transmitter, air=None),  # judged as a part of its own
            _unknown_walls(geometry.surface.mesh),
            "fit",
        )
    surface = Surface.of(geometry)
    known = hasattr(geometry, "face_material")
    if known:
        parameters, lobes = material_parameters(geometry.materials, frequency_hz)
        table = surface_table(list(geometry.materials), frequency_hz)
        face = np.asarray(geometry.face_material)
        walls = Walls(geometry.mesh, table.permittivity[face], table.thickness_m[face], False)
    else:
        parameters, lobes = Parameters.prior(surface.groups, len(LOBES)), LOBES
        walls = _unknown_walls(surface.mesh)
    field = BistaticField(
        surface=surface,
        transmitter=transmitter,
        frequency_hz=frequency_hz,
        shape=shape,
        floor=1.0,
        range_db=(0.0, 1.0),
        beam_sigma_rad=beam_sigma_rad,
        terms=Terms(lobes=lobes, **further),
        parameters=parameters,
        material=surface.material,
        residual=np.zeros(len(surface.element_area)),
        device=device,
    )
    return field, walls, "scene" if known else "assumed"


def _unknown_walls(mesh: Mesh) -> Walls:
    faces = len(mesh.faces)
    return Walls(mesh, np.full(faces, ASSUMED_PERMITTIVITY), np.full(faces, ASSUMED_THICKNESS_M), True)


def variant(field: BistaticField, **changes: Any) -> BistaticField:
    """``field`` with changes that leave its geometry and lobes as they are: what was traced is kept."""
    other = replace(field, **changes)
    for name in ("tracer", "beam", "_mirror_tracer", "_element_light"):
        other.__dict__[name] = getattr(field, name)
    return other


def with_lobes(p: Parameters, lobes: tuple[int, ...], kept: tuple[int, ...]) -> Parameters:
    """``p`` with the weights of all ``lobes`` that are not ``kept`` moved to their kept neighbours.

    A lobe between two others becomes their mix that is nearest to it over the hemisphere (at 45 degrees of incidence),
    a lobe beyond the last becomes that one. Scattered power is kept.
    """
    theta, phi = np.meshgrid(
        np.linspace(0.01, 0.5 * np.pi, 60), np.linspace(0, 2 * np.pi, 72, endpoint=False)
    )
    cos_in = np.sqrt(0.5)
    cos_mirror = cos_in * np.cos(theta) + np.sqrt(1 - cos_in**2) * np.sin(theta) * np.cos(phi)
    shape = {n: lobe(n, cos_in, np.cos(theta), cos_mirror) for n in lobes}
    weight, area = p.weight.copy(), np.sin(theta)
    for j, n in enumerate(lobes):
        if n in kept:
            continue
        below, above = [k for k in kept if k < n], [k for k in kept if k > n]
        ends = [max(below), min(above)] if below and above else [max(below) if below else min(above)]
        shares = [1.0]
        if len(ends) == 2:
            step = shape[ends[1]] - shape[ends[0]]
            s = float((area * step * (shape[n] - shape[ends[0]])).sum() / (area * step**2).sum())
            shares = [1.0 - np.clip(s, 0.0, 1.0), np.clip(s, 0.0, 1.0)]
        for end, share in zip(ends, shares, strict=True):
            weight[:, lobes.index(end)] += share * weight[:, j]
        weight[:, j] = 0.0
    with np.errstate(divide="ignore"):
        return replace(p, log_weight=np.log(weight))


def without_elements(field: BistaticField, dropped: np.ndarray) -> BistaticField:
    """``field`` in which the elements ``dropped`` (E,), bool, scatter nothing; they still cast shadows and mirror."""
    s, p = field.surface, field.parameters
    none = s.groups
    surface = replace(
        s,
        group=np.where(dropped[s.element], none, s.group).astype(np.int32),
        element_group=np.where(dropped, none, s.element_group).astype(np.int32),
        material=np.append(s.material, s.material.max() + 1),
        look=np.vstack([s.look, np.full(s.look.shape[1], np.nan)]),
        group_names=(*s.group_names, "unseen"),
    )
    parameters = replace(
        p,
        log_weight=np.vstack([p.log_weight, np.full(p.log_weight.shape[1], -np.inf)]),
        log_excess=np.append(p.log_excess, 0.0),
        log_mirror=np.append(p.log_mirror, -np.inf),
        log_indirect=np.append(p.log_indirect, -np.inf),
    )
    material = np.append(field.material, field.material.max() + 1)
    return replace(field, surface=surface, parameters=parameters, material=material)


class FullModel:
    """The full model at receivers.

    Args:
        field: with every term on.
        walls: what transmission goes through.
        receivers: positions [m], shape ``(R, 3)``.
        floor: N0; None for the default of the full model's spectra.
        gas_db_per_m: attenuation of air; None for that of standard air.

    Attributes:
        effects: names of all parts, in the order of the table.
        blocked: whether each receiver has no line of sight, shape ``(R,)``.
        seconds: what an effect takes by itself [s] per spectrum, for those that take a time of their own.
        spectrum_s: what a spectrum with every term takes [s].
    """

    def __init__(
        self,
        field: BistaticField,
        walls: Walls,
        receivers: np.ndarray,
        *,
        floor: float | None = None,
        gas_db_per_m: float | None = None,
        progress: Callable[[str, int, int], None],
    ) -> None:
        self.field, self.walls, self.receivers = field, walls, receivers
        self.gas_db_per_m = (
            gas_attenuation_db_per_m(field.frequency_hz) if gas_db_per_m is None else gas_db_per_m
        )
        self._parts: dict[tuple[Any, ...], np.ndarray] = {}
        self.seconds: dict[str, float] = {}
        field.see(receivers[0])  # compile and set up outside the clock
        start = time.perf_counter()
        field.element_light(field.transmitter)
        setup_s = (time.perf_counter() - start) / len(receivers)
        self.sights: list[Sight] = []
        composed, seconds = [], []
        for r, receiver in enumerate(receivers):
            start = time.perf_counter()
            self.sights.append(field.see(receiver))
            composed.append(field.compose(self.sights[-1]))
            seconds.append(time.perf_counter() - start)
            progress("relevance", r, len(receivers) + 1)
        self.spectrum_s = float(np.median(seconds))
        self._specular_power = [c.specular for c in composed]
        self.blocked = np.array([not (s.paths.order == 0).any() for s in self.sights])
        self._time(setup_s)
        self.side = {"diffraction": self._diffracted(), "transmission": self._transmitted()}
        self.effects = self._names()
        self.all = frozenset(self.effects)
        self._weight = (
            pixel_solid_angles(field.shape)[:, None] / pixel_solid_angles(field.shape).sum() / field.shape[1]
        )
        full = self.image(self.all)
        if floor is None and not np.median(full.max(axis=(1, 2))) > 0:
            raise ValueError(
                "receivers: most of them get no power at all, expected places where something arrives"
            )
        self.floor = default_floor(full) if floor is None else float(floor)
        self._reference = self._db(full)

    def _names(self) -> tuple[str, ...]:
        t = self.field.terms
        names = [
            "line_of_sight",
            "mirror_1",
            "mirror_2",
            "diffuse_1",
            "mirror_scatter",
            "scatter_mirror",
            "diffuse_2",
        ]
        names += [name for name in ("indirect", "residual") if getattr(t, name)]
        names += [f"lobe_{n}" for n in t.lobes]
        return (*names, "unseen", "gas", "diffraction", "transmission")

    # -------------------------------------------------------------------------------------- images and losses

    def image(self, kept: frozenset[str]) -> np.ndarray:
        """Spectra (R, H, W) of the model with the effects ``kept``, path gain."""
        gas = "gas" in kept
        names = ("line_of_sight", "mirror_1", "mirror_2")
        total = np.zeros((len(self.receivers), *self.field.shape))
        for order, name in enumerate(names):
            if name in kept:
                total += self._part("specular", order, gas)
        for name in self.side:
            if name in kept:
                total += self._part("side", name, gas)
        diffuse = "diffuse_1" in kept
        if diffuse:
            lobes = tuple(n for n in self.field.terms.lobes if f"lobe_{n}" in kept)
            total += self._part("diffuse", lobes, "residual" in kept, gas)
        more = tuple(diffuse and name in kept for name in ("mirror_scatter", "scatter_mirror", "diffuse_2"))
        if any(more) or "indirect" in kept:
            further = self._part("further", diffuse, *more, "indirect" in kept, "unseen" in kept)
            # No length of its own is known of this light: it counts as the longest single bounce.
            longest = np.array([x.max(initial=0.0) for x in self.bounce_length_m])
            total += further * np.broadcast_to(self._air(longest, gas), len(longest))[:, None, None]
        return total

    def power(self, lost: frozenset[str]) -> float:
        """Share of all receivers' power that goes with the effects ``lost``."""
        return float(1.0 - self.image(self.all - lost).sum() / self.image(self.all).sum())

    def loss(self, kept: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the dB image (rms over the sphere) and of the total path gain [dB] of each receiver, ``(R,)``,
        when of the full model only ``kept`` stays."""
        return self.difference(self.image(kept))

    def difference(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for given spectra (R, H, W)."""
        now, then = self._db(image), self._reference
        return (
            np.sqrt((self._weight * (now[0] - then[0]) ** 2).sum(axis=(1, 2))),
            np.abs(now[1] - then[1]),
        )

    def _db(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return to_db(image, self.floor), to_db(image.sum(axis=(1, 2)), self.floor)

    # -------------------------------------------------------------------------------------- parts

    def _part(self, kind: str, *key: Any) -> np.ndarray:
        if (kind, *key) not in self._parts:
            self._parts[kind, *key] = getattr(self, f"_{kind}")(*key)
        return self._parts[kind, *key]

    def _air(self, length_m: np.ndarray, gas: bool) -> np.ndarray | float:
        return 10.0 ** (-0.1 * self.gas_db_per_m * length_m) if gas else 1.0

    def _specular(self, order: int, gas: bool) -> np.ndarray:
        images = []
        for sight, power in zip(self.sights, self._specular_power, strict=True):
            strength = np.where(sight.paths.order == order, power * self._air(sight.paths.length_m, gas), 0.0)
            images.append(np.tensordot(strength, sight.beams.astype(np.float64), axes=1))
        return np.stack(images)

    def _side(self, name: str, gas: bool) -> np.ndarray:
        found, f = self.side[name], self.field
        power = found.power * self._air(found.length_m, gas)
        images = np.zeros((len(self.receivers), *f.shape))
        for r in np.unique(found.receiver):
            own = found.receiver == r
            images[r] = spread(found.arrival[own], power[own], f.shape, f.beam_sigma_rad, device=f.device)
        return images

    def _diffuse(self, lobes: tuple[int, ...], residual: bool, gas: bool) -> np.ndarray:
        f = self.field
        reduced = variant(
            f,
            terms=replace(f.terms, **ONE_BOUNCE, residual=residual and f.terms.residual),
            parameters=with_lobes(f.parameters, f.terms.lobes, lobes),
        )
        images = []
        for sight, length in zip(self.sights, self.bounce_length_m, strict=True):
            rays = reduced.compose(sight).rays * self._air(length, gas)
            images.append(np.maximum(f.beam(rays.reshape(*f.shape, -1).sum(axis=-1)), 0.0))
        return np.stack(images)

    def _further(
        self,
        diffuse: bool,
        mirror_scatter: bool,
        scatter_mirror: bool,
        diffuse_2: bool,
        indirect: bool,
        unseen: bool,
    ) -> np.ndarray:
        base = self.field if unseen else self.seen_only
        terms = replace(
            base.terms, diffuse=diffuse, mirror_scatter=mirror_scatter, scatter_mirror=scatter_mirror,
            diffuse_order=3 if diffuse_2 else 1, indirect=indirect,
        )  # fmt: skip
        field, gain = variant(base, terms=terms), np.exp(base.parameters.log_gain)
        return np.stack([np.maximum(field.beam(gain * field.further(sight)), 0.0) for sight in self.sights])

    @cached_property
    def bounce_length_m(self) -> list[np.ndarray]:
        """Length transmitter-surface-receiver of each ray of each receiver [m]; 0 where it meets nothing or is dark."""
        lengths = []
        for sight in self.sights:
            t = sight.met.range_m.numpy()
            lit = (sight.lit.strength.numpy() > 0) & np.isfinite(t)
            point = sight.receiver + np.where(lit, t, 0.0)[:, None] * self.field.tracer.directions
            lengths.append(np.where(lit, t + np.linalg.norm(point - sight.transmitter, axis=1), 0.0))
        return lengths

    @cached_property
    def unseen(self) -> np.ndarray:
        """Elements that no ray of any receiver meets, shape ``(E,)``, bool."""
        s = self.field.surface
        seen = np.zeros(len(s.element_area), bool)
        for sight in self.sights:
            face = sight.met.face.numpy()
            seen[s.element[face[face >= 0]]] = True
        return ~seen

    @cached_property
    def seen_only(self) -> BistaticField:
        """The field with every term on but for what elements that no receiver sees scatter."""
        return without_elements(self.field, self.unseen)

    # -------------------------------------------------------------------------------------- estimates and times

    def _diffracted(self) -> SidePaths:
        start = time.perf_counter()
        which = np.flatnonzero(self.blocked)
        f = self.field
        found = diffracted(
            self.walls.mesh, f.transmitter, self.receivers[which], f.wavelength_m,
            lift_m=max(LIFT_M, f.surface.skin_m), device=f.device,
        )  # fmt: skip
        self.seconds["diffraction"] = (time.perf_counter() - start) / len(self.receivers)
        return replace(found, receiver=which[found.receiver])

    def _transmitted(self) -> SidePaths:
        start = time.perf_counter()
        which = np.flatnonzero(self.blocked)
        f, w = self.field, self.walls
        found = transmitted(
            w.mesh, f.transmitter, self.receivers[which], f.wavelength_m, w.permittivity, w.thickness_m,
            skin_m=f.surface.skin_m, device=f.device,
        )  # fmt: skip
        self.seconds["transmission"] = (time.perf_counter() - start) / len(self.receivers)
        return replace(found, receiver=which[found.receiver])

    def _time(self, setup_s: float) -> None:
        """Seconds per spectrum of the terms, each by itself; ``setup_s`` is a receiver's share of lighting elements."""
        f, count = self.field, len(self.receivers)

        def clock(work: Callable[[], Any]) -> float:
            start = time.perf_counter()
            work()
            return time.perf_counter() - start

        trace = partial(
            specular_paths, f.surface, f.transmitter, self.receivers, f.wavelength_m, device=f.device
        )
        orders = [clock(partial(trace, order=order)) / count for order in (0, 1, 2)]
        self.seconds |= {
            "line_of_sight": orders[0],
            "mirror_1": max(orders[1] - orders[0], 0.0),
            "mirror_2": max(orders[2] - orders[1], 0.0),
        }
        sight = self.sights[0]
        single = variant(f, terms=replace(f.terms, **ONE_BOUNCE))

        def bounce() -> None:
            f.tracer.light(f.tracer.meet(sight.receiver), sight.transmitter)
            single.compose(sight)

        self.seconds["diffuse_1"] = clock(bounce)
        for name, share, terms in (
            ("mirror_scatter", setup_s, {"mirror_scatter": True}),
            ("scatter_mirror", 0.0, {"scatter_mirror": True}),
            ("diffuse_2", setup_s, {"diffuse_order": 3}),
        ):
            alone = variant(f, terms=replace(f.terms, **{**ONE_BOUNCE, **terms}))
            self.seconds[name] = share + clock(partial(alone.further, sight))
