"""From what receivers see and a model to the path gains that they get, and from those to spectra.

Surfaces light each other by radiosity: elements, half a metre wide in a room, get light and send it on in all directions alike,
whatever their lobes. Rays from every side of an element, density by the cosine, see what the transmitter lights; that is what
it gets of first scatterings. Each ray's light is reflected as its angle of incidence has it. Records of the sequence ``E`` start
at elements.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.tracing.model import Effects, Model, Parameters
from warprrf.rf.tracing.rays import quasi_random
from warprrf.rf.tracing.records import Materials, Records
from warprrf.rf.tracing.tracer import SPECULAR, Rays, Tracer, View

ELEMENT_RAYS = 128  # from each element, over its hemisphere


@dataclass(frozen=True)
class PathGains:
    """Path gain of all that receivers get, before any beam.

    Attributes:
        view: what they see.
        powers: of each record, by sequence, shape ``(N,)`` each.
        records: by sequence; see :class:`View`.
        parameters: under which they are.
    """

    view: View
    powers: dict[str, np.ndarray]
    records: dict[str, Records]
    parameters: Parameters

    @property
    def specular(self) -> np.ndarray:
        """Of each path without scattering, shape ``(L,)``."""
        return self.powers[SPECULAR]

    @property
    def apart(self) -> list[PathGains]:
        """Those of each receiver, all that is scattered in one table."""
        rays, found = self.by_ray().reshape(len(self.view.receivers), -1), list[PathGains]()
        index, none = np.arange(rays.shape[1]), np.zeros((rays.shape[1], 0), np.int32)
        for k, power in enumerate(rays):
            view, direct = self.view.of(k), self.specular[self.view.paths.receiver == k]
            every = Records(none, np.zeros((*none.shape, 3)), none, power, index)
            records = view.records | {"rays": every}
            found.append(PathGains(view, {SPECULAR: direct, "rays": power}, records, self.parameters))
        return found

    def by_ray(self, names: Iterable[str] | None = None) -> np.ndarray:
        """Power of the sequences ``names``, by default all but :data:`SPECULAR`, by the ray that sees it, shape ``(R K,)``."""
        count, records = len(self.view.hits.face), self.records
        chosen = [n for n in (self.powers if names is None else names) if n != SPECULAR and n in self.powers]
        return sum((np.bincount(records[n].ray, self.powers[n], count) for n in chosen), np.zeros(count))

    @property
    def total(self) -> np.ndarray:
        """All of it at each receiver, shape ``(R,)``."""
        count = len(self.view.receivers)
        direct = np.bincount(self.view.paths.receiver, self.specular, count)
        return np.asarray(direct + self.by_ray().reshape(count, -1).sum(axis=1))

    @property
    def strongest_single(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each ray the power of the strongest light that was scattered once, seen through slabs or not, and how far along the
        ray that was [m], shape ``(R K,)`` each."""
        power, range_m = self.single, self.view.hits.range_m
        for name, records in self.records.items():
            if records.is_single and records.reach_m is not None:
                order = np.argsort(self.powers[name], kind="stable")  # the strongest comes last, and stays
                ray, own = records.ray[order], np.zeros((2, len(power)))
                own[:, ray] = self.powers[name][order], records.reach_m[order]
                range_m = np.where(own[0] > power, own[1], range_m)
                power = np.maximum(own[0], power)
        return power, range_m

    @property
    def single(self) -> np.ndarray:
        """Of what the transmitter lights, through slabs too, and the receiver sees directly, by ray, shape ``(R K,)``."""
        return self.by_ray(n for n, r in self.records.items() if r.is_single and r.reach_m is None)


def materials_of(tracer: Tracer, p: Parameters, effects: Effects) -> Materials:
    """Parameters of groups under a transmitter as kernels take them, with what elements send by ``effects``: light between
    surfaces is found here (:func:`irradiance`). The last ones are kept."""
    surface = tracer.surface

    def make() -> Materials:
        got = irradiance(tracer, p, effects)
        if got is None:
            return Materials(p, tracer.slabs, device=tracer.grid.device)
        radiance = got * p.scattered_share[surface.side_group] / np.pi
        return Materials(p, tracer.slabs, None, surface.side_group, radiance, device=tracer.grid.device)

    further = effects.scatterings, effects.transmissions, effects.mirror_scatter, effects.scatter_mirror
    return tracer.materials.get((p.values, further), make)


def path_gains(view: View, model: Model) -> PathGains:
    """What the receivers of ``view`` get under a model of groups, residual and common gain included."""
    t, found = view.tracer, {}
    materials = materials_of(t, model.parameters, model.effects)
    learned = model.learned_rows(t.transmitter) if model.effects.residual else 0
    tables = view.traced(model.effects)
    for name, records in tables.items():
        found[name] = model.parameters.gain * records.powers(materials)
        if 0 <= records.residual_row < learned:
            found[name] *= np.exp(model.residual[records.residual_row, view.cell(records.ray)])
    found[SPECULAR] = np.where(view.counted_paths(model.effects), found[SPECULAR], 0.0)
    return PathGains(view, found, tables, model.parameters)


def spectra_of(gains: PathGains, beam: BeamOperator) -> np.ndarray:
    """Spectra (R, H, W) of the receivers: path gains through the receivers' beam."""
    view = gains.view
    count, shape = len(view.receivers), view.tracer.grid.shape
    pixels = np.einsum("...k->...", gains.by_ray().reshape(count, *shape, -1))
    found = np.moveaxis(beam(np.ascontiguousarray(np.moveaxis(pixels, 0, -1))), -1, 0)
    specular, beams = gains.specular.astype(np.float32), view.beams(beam.sigma_rad)
    for image, own in zip(found, (view.paths.receiver == k for k in range(count)), strict=True):
        image += np.tensordot(specular[own], beams[own], axes=1)
    return np.maximum(found, 0.0)


class Interreflection:
    """Geometry of light between the elements of a surface under one transmitter.

    Args:
        tracer: casts the rays.
        most: slabs that first scatterings may pass, at most.

    Attributes:
        side: of the element that each ray starts from, shape ``(K,)``; those that no light reaches have none.
        cosine: of each ray to the normal there, shape ``(K,)``.
        tables: what the rays see of first scatterings, by sequence: of surfaces that the transmitter lights, ``"S"``, of those
            that it lights through slabs, ``"TS"``, and of lit ones that are seen through slabs, ``"ST"``. Records of
            irradiance where the transmitter gives cos(theta_i) / d1^2 [1/m^2].
    """

    def __init__(self, tracer: Tracer, most: int) -> None:
        surface, grid, sides = tracer.surface, tracer.grid, tracer.surface.element_sides
        point = tracer.reached(most)
        tile = np.flatnonzero(~np.isnan(point[:, 0]))
        side, area = surface.tile_side[tile], np.tile(surface.tiles.area, 1 + surface.two_sided)[tile]
        open_m2 = np.bincount(side, area, sides)
        # Rays start everywhere on what is open of a side, strata of its area in their order.
        order, known = np.argsort(side, kind="stable"), np.flatnonzero(open_m2)
        upto = np.cumsum(area[order])
        place, *turn = quasi_random(len(known), ELEMENT_RAYS)
        below = (np.cumsum(open_m2) - open_m2)[known, None] + place * open_m2[known, None]
        first, last = (np.searchsorted(side[order], known, end)[:, None] for end in ("left", "right"))
        chosen = np.clip(np.searchsorted(upto, below), first, last - 1)
        start = tile[order[chosen]].ravel()
        hits = grid.hit_from(start, point[start], *(x.ravel() for x in turn))
        self.side, self.cosine = np.repeat(known, ELEMENT_RAYS), np.sqrt(1.0 - turn[0].ravel())
        rays = Rays(hits, np.arange(len(self.side)))
        self.tables = tracer.lit_straight(rays, most)
        if most:
            self.tables["ST"] = tracer.lit_straight(tracer.behind(rays, most), 0)["S"]
        scale = np.float32(np.pi / ELEMENT_RAYS * (4.0 * np.pi / tracer.wavelength_m) ** 2)
        self.tables = {name: replace(found, power=scale * found.power) for name, found in self.tables.items()}
        self._hit, met = grid.tiles_met(hits)
        self._met = surface.tile_side[met]
        passed = np.broadcast_to(grid.transmittance(hits.range_m[self._hit]), len(met))
        self._left = np.pi / ELEMENT_RAYS * passed

    def between(self, radiance: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Irradiance of sides by ``radiance`` (E,) of sides, shape ``(E,)``, by rays of ``weight`` (K,)."""
        power = self._left * weight[self._hit] * radiance[self._met]
        return np.bincount(self.side[self._hit], power, len(radiance))


def irradiance(tracer: Tracer, p: Parameters, effects: Effects) -> np.ndarray | None:
    """Irradiance of elements' sides by surfaces that scattered before, under parameters of groups, in units in which the
    transmitter gives cos(theta_i) / d1^2 [1/m^2], shape ``(E,)``: that of isotropic light of which they would scatter as much;
    None where ``effects`` hold no second scattering."""
    if effects.scatterings < 2:
        return None
    most, group, sides = effects.transmissions, tracer.surface.side_group, tracer.surface.element_sides
    light = tracer.cache.get(("interreflection", most), lambda: Interreflection(tracer.of_transmitter, most))
    materials = Materials(p, tracer.slabs, device=tracer.grid.device)
    share = p.scattered_share[group] / np.pi
    over_even = p.scattered_over_even(group[light.side], light.cosine)
    tables = [table for name, table in light.tables.items() if name != "ST" or effects.scatter_mirror]
    got = sum(np.bincount(light.side[r.ray], r.powers(materials) * over_even[r.ray], sides) for r in tables)
    if effects.mirror_scatter:
        for mirrored in (tracer.mirrored(slabs) for slabs in {0, most}):
            side = mirrored.onto.ray
            power = mirrored.onto.powers(materials) * p.scattered_over_even(group[side], mirrored.cosine)
            got = got + light.between(share * np.bincount(side, power, sides), over_even)
    first = got
    for _ in range(2, effects.scatterings):
        got = first + light.between(share * got, over_even)
    return np.asarray(got)
