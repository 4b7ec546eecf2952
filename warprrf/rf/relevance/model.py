"""The full model of a scene at a few receivers, and what of it is left without some of its effects.

All that a bistatic field can model is switched on; edges and walls are added as estimates. A reduced model is the field
with fewer terms, rendered from the same views. Mirror paths and all that is scattered are rendered apart and kept, since
most reduced models differ in one of them only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import gas_attenuation_db_per_m
from warprrf.rf.em.fresnel import lobe, slab_reflection, surface_table
from warprrf.rf.em.half_spaces import fresnel_curves
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.materials import Parameters
from warprrf.rf.fields.bistatic.render import render, sent_radiance
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import LOBES, Terms
from warprrf.rf.fields.bistatic.transport import ReceiverView, Transport
from warprrf.rf.paths.blockage import LIFT_M, SidePaths, diffracted, transmitted
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.spectrum import default_floor, pixel_solid_angles, spread, to_db

ASSUMED_PERMITTIVITY = 4.0 * (1.0 - 0.06j)
"""Of walls whose material is not known; loss as of plasterboard and wood at 300 GHz in ITU-R P.2040-4, table 3."""
ASSUMED_THICKNESS_M = 0.0125  # a plasterboard: thin walls let more through
MIRRORS = ("line_of_sight", "mirror_1", "mirror_2")
FURTHER = ("mirror_scatter", "scatter_mirror", "diffuse_2")
OUTSIDE = ("diffraction", "transmission")
"""Effects that a bistatic field has no term for: they are estimated beside it."""


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
        colour=np.vstack([s.colour, np.full(s.colour.shape[1], np.nan)]),
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


def reduced_terms(full: Terms, kept: frozenset[str]) -> Terms:
    """``full`` without the terms whose effects are not ``kept``."""
    diffuse = "diffuse_1" in kept
    switches = ("line_of_sight", "mirror_scatter", "scatter_mirror", "indirect", "residual")
    return replace(
        full,
        diffuse=diffuse,
        mirror_order=2 if "mirror_2" in kept else int("mirror_1" in kept),
        lobes=tuple(n for n in full.lobes if f"lobe_{n}" in kept) if diffuse else full.lobes[:1],
        diffuse_order=full.diffuse_order if "diffuse_2" in kept else 1,
        **{name: name in kept for name in switches},
    )


def reduced_field(full: BistaticField, terms: Terms) -> BistaticField:
    """``full`` with ``terms``, whose lobes are some of its own; see :func:`with_lobes`."""
    lobes = full.terms.lobes
    p = with_lobes(full.parameters, lobes, terms.lobes)
    p = replace(p, log_weight=p.log_weight[:, [lobes.index(n) for n in terms.lobes]])
    return replace(full, terms=terms, parameters=p, errors=None)


class FullModel:
    """The full model at receivers, and every model with some of its effects.

    Args:
        field: with every term on, in a vacuum.
        walls: what transmission goes through.
        receivers: positions [m], shape ``(R, 3)``.
        floor: N0; None for the default of the full model's spectra.
        gas_db_per_m: attenuation of air; None for that of standard air.
        progress: called with the stage ``"relevance"``.

    Attributes:
        effects: names of all effects, in the order of the table.
        all: the same as a set.
        blocked: whether each receiver has no line of sight, shape ``(R,)``.
        unseen: elements that no ray of any receiver meets, shape ``(E,)``, bool.

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
        own = gas_attenuation_db_per_m(field.frequency_hz)
        self.gas_db_per_m = float(own if gas_db_per_m is None else gas_db_per_m)
        self._images: dict[frozenset[str], np.ndarray] = {}
        self._views: dict[bool, list[ReceiverView]] = {False: [], True: []}  # by whether there is air
        for r, receiver in enumerate(receivers):
            dry = field.view(receiver)
            self._views[False].append(dry)
            self._views[True].append(
                self._transport(field, True).view(receiver, field.terms, paths=dry.paths)
            )
            progress("relevance", r, len(receivers) + 1)
        self.blocked = np.array([not (v.paths.order == 0).any() for v in self._views[False]])
        self.unseen = np.ones(len(field.surface.element_area), bool)
        for view in self._views[False]:
            self.unseen[field.surface.element[view.seen()[1]]] = False
        self._seen_only = without_elements(field, self.unseen)
        self._side = self._past_obstacles()
        learned = (name for name in ("indirect", "residual") if getattr(field.terms, name))
        lobes = (f"lobe_{n}" for n in field.terms.lobes)
        self.effects = (*MIRRORS, "diffuse_1", *FURTHER, *learned, *lobes, "unseen", "gas", *OUTSIDE)
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

    def image(self, kept: frozenset[str]) -> np.ndarray:
        """Spectra (R, H, W) of the model with the effects ``kept``, path gain."""
        gas = kept & {"gas"}
        total = self._rendered((kept & {*MIRRORS}) | gas | {"unseen"})
        total = total + self._rendered(kept - {*MIRRORS, *OUTSIDE})
        for name in OUTSIDE:
            if name in kept:
                total += self._beside(name, bool(gas))
        return total

    def power(self, lost: frozenset[str]) -> float:
        """Share of all receivers' power that goes with the effects ``lost``."""
        return float(1.0 - self.image(self.all - lost).sum() / self.image(self.all).sum())

    def loss(self, kept: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the dB image (rms over the sphere) and of the total path gain [dB] of each receiver, ``(R,)``,
        when of the full model only ``kept`` stays."""
        now, then = self._db(self.image(kept)), self._reference
        image = np.sqrt((self._weight * (now[0] - then[0]) ** 2).sum(axis=(1, 2)))
        return image, np.abs(now[1] - then[1])

    def _db(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return to_db(image, self.floor), to_db(image.sum(axis=(1, 2)), self.floor)

    def _transport(self, field: BistaticField, gas: bool) -> Transport:
        loss = 0.1 * np.log(10.0) * self.gas_db_per_m if gas else 0.0
        return Transport.of(
            field.surface, field.transmitter, field.frequency_hz, field.shape, field.terms.sub_pixels,
            beam_sigma_rad=field.beam_sigma_rad, loss_per_m=loss, device=field.device,
        )  # fmt: skip

    def _rendered(self, kept: frozenset[str]) -> np.ndarray:
        """Spectra (R, H, W) of the bistatic field with the effects ``kept``; each is computed once."""
        if kept not in self._images:
            base, gas = self.field if "unseen" in kept else self._seen_only, "gas" in kept
            materials = reduced_field(base, reduced_terms(base.terms, kept)).materials
            beam = beam_operator(base.shape, base.beam_sigma_rad, base.device)
            transport = self._transport(base, gas)
            sent = sent_radiance(transport, materials)
            views = (replace(view, transport=transport) for view in self._views[gas])
            self._images[kept] = np.stack([render(view, materials, beam, sent).image for view in views])
        return self._images[kept]

    def _beside(self, name: str, gas: bool) -> np.ndarray:
        """Spectra (R, H, W) of estimated paths."""
        found, f = self._side[name], self.field
        power = found.power * 10.0 ** (-0.1 * self.gas_db_per_m * found.length_m * gas)
        images = np.zeros((len(self.receivers), *f.shape))
        for r in np.unique(found.receiver):
            own = found.receiver == r
            images[r] = spread(found.arrival[own], power[own], f.shape, f.beam_sigma_rad, device=f.device)
        return images

    def _past_obstacles(self) -> dict[str, SidePaths]:
        """Estimated paths to receivers without line of sight."""
        which, f, w = np.flatnonzero(self.blocked), self.field, self.walls
        place = w.mesh, f.transmitter, self.receivers[which], f.wavelength_m
        skin = f.surface.skin_m
        found = {
            "diffraction": diffracted(*place, lift_m=max(LIFT_M, skin), device=f.device),
            "transmission": transmitted(*place, w.permittivity, w.thickness_m, skin_m=skin, device=f.device),
        }
        return {name: replace(paths, receiver=which[paths.receiver]) for name, paths in found.items()}
