"""The full model of a scene at a few receivers, by parts that can be left out one by one.

All that a bistatic field can model is switched on; air, edges and walls are added as estimates. Path gains add up, so
each part is computed once and every reduced model is a sum of parts. Only light after a first bounce is no sum: its
parts are computed for each combination that is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warprrf.cache import cached_property
from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import gas_attenuation_db_per_m
from warprrf.rf.em.fresnel import fresnel_curves, lobe, slab_reflection, surface_table
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.materials import LOBES, Parameters, Terms
from warprrf.rf.fields.bistatic.render import path_powers
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.paths.blockage import LIFT_M, SidePaths, diffracted, transmitted
from warprrf.rf.spectra.beam import beam_operator
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
MIRRORS = ("line_of_sight", "mirror_1", "mirror_2")
FURTHER = ("mirror_scatter", "scatter_mirror", "diffuse_2")


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
    known = hasattr(geometry, "materials")
    if known:
        parameters, lobes = material_parameters(geometry.materials, frequency_hz)
        table = surface_table(list(geometry.materials), frequency_hz)
        face = np.asarray(geometry.face_material)
        reciprocal = bool(table.reciprocal[table.scattering > 0].any())  # a field's lobes are of one kind
        walls = Walls(geometry.mesh, table.permittivity[face], table.thickness_m[face], False)
    else:
        parameters, lobes, reciprocal = Parameters.prior(surface.groups, len(LOBES)), LOBES, False
        walls = _unknown_walls(surface.mesh)
    field = BistaticField(
        surface=surface,
        transmitter=transmitter,
        frequency_hz=frequency_hz,
        shape=shape,
        floor=1.0,
        range_db=(0.0, 1.0),
        beam_sigma_rad=beam_sigma_rad,
        terms=Terms(lobes=lobes, reciprocal=reciprocal, **further),
        parameters=parameters,
        material=surface.material,
        residual=np.zeros((2, surface.cells)),
        device=device,
    )
    return field, walls, "scene" if known else "assumed"


def _unknown_walls(mesh: Mesh) -> Walls:
    faces = len(mesh.faces)
    return Walls(mesh, np.full(faces, ASSUMED_PERMITTIVITY), np.full(faces, ASSUMED_THICKNESS_M), True)


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
        thickness_m=np.append(s.thickness_m, np.nan),
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
    return replace(field, surface=surface, parameters=parameters, material=material, errors=None)


class FullModel:
    """The full model at receivers.

    Args:
        field: with every term on.
        walls: what transmission goes through.
        receivers: positions [m], shape ``(R, 3)``.
        floor: N0; None for the default of the full model's spectra.
        gas_db_per_m: attenuation of air; None for that of standard air.
        progress: called with the stage ``"relevance"``.

    Attributes:
        effects: names of all parts, in the order of the table.
        blocked: whether each receiver has no line of sight, shape ``(R,)``.

    Raises:
        ValueError: if most receivers get no power at all.
    """

    def __init__(
        self,
        field: BistaticField,
        walls: Walls,
        receivers: np.ndarray,
        *,
        floor: float | None,
        gas_db_per_m: float | None,
        progress: Progress,
    ) -> None:
        self.field, self.walls, self.receivers = field, walls, receivers
        self.gas_db_per_m = (
            gas_attenuation_db_per_m(field.frequency_hz) if gas_db_per_m is None else gas_db_per_m
        )
        self.beam = beam_operator(field.shape, field.beam_sigma_rad, field.device)
        self._parts: dict[tuple[Any, ...], np.ndarray] = {}
        progress("relevance", 0, len(receivers) + 1)
        self.views: list[ReceiverView] = []
        self._mirror_power = []
        for r, receiver in enumerate(receivers):
            self.views.append(field.view(receiver))
            self._mirror_power.append(field.render(self.views[-1]).powers.mirror)
            progress("relevance", r + 1, len(receivers) + 1)
        self.blocked = np.array([not (v.paths.order == 0).any() for v in self.views])
        self.side = {"diffraction": self._diffracted(), "transmission": self._transmitted()}
        self.effects = self._names()
        self.all = frozenset(self.effects)
        solid_angle = pixel_solid_angles(field.shape)
        self._weight = solid_angle[:, None] / solid_angle.sum() / field.shape[1]
        full = self.image(self.all)
        if floor is None and not np.median(full.max(axis=(1, 2))) > 0:
            raise ValueError(
                "receivers: most of them get no power at all, expected places where something arrives"
            )
        self.floor = default_floor(full) if floor is None else float(floor)
        self._reference = self._db(full)

    def _names(self) -> tuple[str, ...]:
        t = self.field.terms
        learned = [name for name in ("indirect", "residual") if getattr(t, name)]
        lobes = [f"lobe_{n}" for n in t.lobes]
        return (
            *MIRRORS,
            "diffuse_1",
            *FURTHER,
            *learned,
            *lobes,
            "unseen",
            "gas",
            "diffraction",
            "transmission",
        )

    # -------------------------------------------------------------------------------------- images and losses

    def image(self, kept: frozenset[str]) -> np.ndarray:
        """Spectra (R, H, W) of the model with the effects ``kept``, path gain."""
        gas = "gas" in kept
        total = np.zeros((len(self.receivers), *self.field.shape))
        for order, name in enumerate(MIRRORS):
            if name in kept:
                total += self._part("specular", order, gas)
        for name in self.side:
            if name in kept:
                total += self._part("side", name, gas)
        diffuse = "diffuse_1" in kept
        if diffuse:
            lobes = tuple(n for n in self.field.terms.lobes if f"lobe_{n}" in kept)
            total += self._part("diffuse", lobes, "residual" in kept, gas)
        more = tuple(diffuse and name in kept for name in FURTHER)
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
        for view, power in zip(self.views, self._mirror_power, strict=True):
            beams = np.zeros(0) if view.beams is None else view.beams
            own, air = view.paths.order == order, self._air(view.paths.length_m, gas)
            images.append(np.tensordot(np.where(own, power * air, 0.0), beams, axes=1))
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
        reduced = replace(
            f,
            terms=replace(f.terms, **ONE_BOUNCE, residual=residual and f.terms.residual),
            parameters=with_lobes(f.parameters, f.terms.lobes, lobes),
        )
        images = []
        for view, length in zip(self.views, self.bounce_length_m, strict=True):
            rays = reduced.render(view).powers.single * self._air(length, gas)
            images.append(np.maximum(self.beam(rays.reshape(*f.shape, -1).sum(axis=-1)), 0.0))
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
        field = replace(base, terms=terms)
        return np.stack([np.maximum(self.beam(_further_image(field, view)), 0.0) for view in self.views])

    @cached_property
    def bounce_length_m(self) -> list[np.ndarray]:
        """Length transmitter-surface-receiver of each ray of each receiver [m]; 0 where it hits nothing or is dark."""
        lengths = []
        for view in self.views:
            length = np.zeros(len(view.hits.face))
            lit = np.flatnonzero((view.light.strength.numpy() > 0) & (view.hits.face.numpy() >= 0))
            way = view.hits.points(lit) - view.transport.transmitter
            length[lit] = view.hits.range_m.numpy()[lit] + np.linalg.norm(way, axis=1)
            lengths.append(length)
        return lengths

    @cached_property
    def unseen(self) -> np.ndarray:
        """Elements that no ray of any receiver meets, shape ``(E,)``, bool."""
        s = self.field.surface
        seen = np.zeros(len(s.element_area), bool)
        for view in self.views:
            face = view.hits.face.numpy()
            seen[s.element[face[face >= 0]]] = True
        return ~seen

    @cached_property
    def seen_only(self) -> BistaticField:
        """The field with every term on but for what elements that no receiver sees scatter."""
        return without_elements(self.field, self.unseen)

    # -------------------------------------------------------------------------------------- estimates

    def _diffracted(self) -> SidePaths:
        which = np.flatnonzero(self.blocked)
        f = self.field
        found = diffracted(
            self.walls.mesh, f.transmitter, self.receivers[which], f.wavelength_m,
            lift_m=max(LIFT_M, f.surface.skin_m), device=f.device,
        )  # fmt: skip
        return replace(found, receiver=which[found.receiver])

    def _transmitted(self) -> SidePaths:
        which = np.flatnonzero(self.blocked)
        f, w = self.field, self.walls
        found = transmitted(
            w.mesh, f.transmitter, self.receivers[which], f.wavelength_m, w.permittivity, w.thickness_m,
            skin_m=f.surface.skin_m, device=f.device,
        )  # fmt: skip
        return replace(found, receiver=which[found.receiver])


def _further_image(field: BistaticField, view: ReceiverView) -> np.ndarray:
    """Path gain per pixel (H, W) of what comes after a first bounce, before the beam; ``view`` may be of another
    division of the same mesh into groups."""
    transport = field.transport()
    own = transport.complete(replace(view, transport=transport), field.terms)
    found = path_powers(own, field.materials, field.sent_radiance(transport))
    return found.further.reshape(*field.shape, -1).sum(axis=-1)
