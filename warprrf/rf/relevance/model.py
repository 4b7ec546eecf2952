"""The full model of a scene at a few receivers, with any of its effects left out.

All that a bistatic field can model is switched on; air is added. A reduced model is the
same field with fewer effects; path gains add up by sequence of interactions, so what has been computed is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.rf.em.absorption import gas_attenuation_db_per_m
from warprrf.rf.em.fresnel import fresnel_curves, lobe, slab_reflection, surface_table
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import default_floor, pixel_solid_angles, to_db
from warprrf.rf.tracing.model import Effects, Parameters
from warprrf.rf.tracing.render import spectra_of
from warprrf.rf.tracing.tracer import View

EVERYTHING = Effects(mirrors=2)


def material_parameters(materials: Sequence[Any], frequency_hz: float) -> Parameters:
    """Parameters of the bistatic model that stand for ``materials``; its lobes are reciprocal if any of theirs are.

    A slab's reflection over the angle of incidence is replaced by the half-space of one permittivity, times a factor,
    that is nearest to it in the least squares.
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
        return Parameters(
            np.log(own * (factor * scattering)[:, None]), curves.log_excess[member], np.log(factor * (1.0 - scattering)),
            lobes, bool(table.reciprocal[table.scattering > 0].any()),
        )  # fmt: skip


def full_field(geometry: Any, frame: SpectrumDataset, device: Any = None) -> tuple[BistaticField, str]:
    """A field with every effect on for a Scene, Reconstruction, Mesh or bistatic field, and where its materials come from:
    ``"scene"``, ``"fit"`` or ``"assumed"``.

    Of ``frame`` transmitter, carrier, grid and beam count; where a field is given, the transmitter alone."""
    if isinstance(geometry, BistaticField):
        effects = replace(EVERYTHING, residual=geometry.effects.residual)
        # Gains that were learned under its own transmitter stay with that. Air is judged by itself.
        learned = np.arange(len(geometry.residual)) < geometry.state.learned_rows(frame.transmitter)
        residual = np.where(learned[:, None], geometry.residual, 0.0)
        moved = replace(geometry, effects=effects, residual=residual, transmitter=frame.transmitter, air=None)
        return moved, "fit"
    field = BistaticField.prior(geometry, frame, effects=replace(EVERYTHING, residual=False), device=device)
    if not hasattr(geometry, "materials"):
        return field, "assumed"
    parameters = material_parameters(geometry.materials, frame.frequency_hz)
    scattering = surface_table(list(geometry.materials), frame.frequency_hz).scattering
    known = replace(parameters, log_through=field.parameters.log_through)
    return replace(field, parameters=known, surface=replace(field.surface, scattering=scattering)), "scene"


def with_lobes(p: Parameters, kept: tuple[int, ...]) -> Parameters:
    """``p`` with the lobes ``kept`` alone, the weights of the others moved to their neighbours among them.

    A lobe between two others becomes their mix that is nearest to it over the hemisphere (at 45 degrees of incidence),
    a lobe beyond the last becomes that one. Scattered power is kept.
    """
    zenith, azimuth = np.linspace(0.01, 0.5 * np.pi, 60), np.linspace(0, 2 * np.pi, 72, endpoint=False)
    theta, phi = np.meshgrid(zenith, azimuth)
    cos_in = np.sqrt(0.5)
    cos_mirror = cos_in * np.cos(theta) + np.sqrt(1 - cos_in**2) * np.sin(theta) * np.cos(phi)
    lobes = p.lobes
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
    with np.errstate(divide="ignore"):
        return replace(p, log_weight=np.log(weight[:, [lobes.index(n) for n in kept]]), lobes=kept)


class FullModel:
    """The full model at receivers.

    Args:
        field: with every effect on.
        receivers: positions [m], shape ``(R, 3)``.
        floor: N0; None for the default of the full model's spectra.
        gas_db_per_m: attenuation of air; None for that of standard air.

    Attributes:
        effects: names of all parts, in the order of the table.
        blocked: whether each receiver has no line of sight, shape ``(R,)``.
    """

    def __init__(
        self,
        field: BistaticField,
        receivers: np.ndarray,
        *,
        floor: float | None,
        gas_db_per_m: float | None,
        progress: Progress,
    ) -> None:
        self.field, self.receivers = field, receivers
        self.gas_db_per_m = (
            gas_attenuation_db_per_m(field.frequency_hz) if gas_db_per_m is None else gas_db_per_m
        )
        self.beam = beam_operator(field.shape, field.beam_sigma_rad, field.device)
        self._parts: dict[Any, np.ndarray] = {}
        progress("relevance", 0, len(receivers) + 1)
        self.views: list[View] = []
        for r, receiver in enumerate(receivers):
            self.views.append(field.view(receiver))
            field.path_gains(self.views[-1])
            progress("relevance", r + 1, len(receivers) + 1)
        self.blocked = np.array([not v.paths.in_sight.any() for v in self.views])
        residual = ("residual",) if field.effects.residual else ()
        self.effects = (*NAMES, *residual, *map(lobe_name, field.parameters.lobes), "gas")
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

    def reduced(self, kept: frozenset[str]) -> BistaticField:
        """The field with the effects ``kept`` alone."""
        p = self.field.parameters
        lobes = tuple(n for n in p.lobes if lobe_name(n) in kept)
        parameters = p if len(lobes) in (0, len(p.lobes)) else with_lobes(p, lobes)
        return replace(self.field, effects=effects_of(kept), parameters=parameters, errors=None)

    def image(self, kept: frozenset[str]) -> np.ndarray:
        """Spectra (R, H, W) of the model with the effects ``kept``, path gain."""
        field, gas = self.reduced(kept), "gas" in kept
        key = field.effects, field.parameters.lobes, gas
        if key not in self._parts:
            self._parts[key] = np.stack([self._image(field, view, gas) for view in self.views])
        return self._parts[key]

    def _image(self, field: BistaticField, view: View, gas: bool) -> np.ndarray:
        """One spectrum; light over several surfaces is as long as what the same ray sees of single ones."""
        gains = field.path_gains(view)
        if gas:
            powers = {}
            for name, power in gains.powers.items():
                table, length = gains.records[name], view.paths.length_m
                if name != "specular":
                    length = view.over_m(table.ray, table.reach_m)
                powers[name] = power * 10.0 ** (-0.1 * self.gas_db_per_m * length)
            gains = replace(gains, powers=powers)
        return spectra_of(gains, self.beam)[0]

    def power(self, lost: frozenset[str]) -> float:
        """Share of all receivers' power that goes with the effects ``lost``."""
        return float(1.0 - self.image(self.all - lost).sum() / self.image(self.all).sum())

    def loss(self, kept: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the dB image (rms over the sphere) and of the total path gain [dB] of each receiver, ``(R,)``,
        when of the full model only ``kept`` stays."""
        now, then = self._db(self.image(kept)), self._reference
        image_db = np.sqrt((self._weight * (now[0] - then[0]) ** 2).sum(axis=(1, 2)))
        return image_db, np.abs(now[1] - then[1])

    def _db(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return to_db(image, self.floor), to_db(image.sum(axis=(1, 2)), self.floor)

    @property
    def longest_m(self) -> float:
        """Length of the longest path [m]."""
        lengths = [v.over_m(v.traced(effects_of(self.all))["S"].ray) for v in self.views]
        return max(float(np.max(x, initial=0.0)) for x in (*lengths, *(v.paths.length_m for v in self.views)))


NAMES = (
    "line_of_sight", "mirrors_1", "mirrors_2", "scatterings_1", "mirror_scatter", "scatter_mirror", "scatterings_2",
    "transmission", "diffraction",
)  # fmt: skip
"""Effects of every model, in the order of the table."""


def effects_of(kept: frozenset[str]) -> Effects:
    """What a field models that has the effects of these names alone."""
    scattering = "scatterings_1" in kept
    return Effects(
        line_of_sight="line_of_sight" in kept,
        mirrors=2 if "mirrors_2" in kept else int("mirrors_1" in kept),
        scatterings=scattering * (3 if "scatterings_2" in kept else 1),
        mirror_scatter=scattering and "mirror_scatter" in kept,
        scatter_mirror=scattering and "scatter_mirror" in kept,
        transmissions=3 if "transmission" in kept else 0,
        diffractions=int("diffraction" in kept),
        residual="residual" in kept,
    )


def lobe_name(exponent: int) -> str:
    """Name of a lobe among effects."""
    return f"lobe_{exponent}"
