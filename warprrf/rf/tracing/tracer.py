"""The tracer: from a receiver backwards to records of paths, whatever the materials. Sequences are named here.

Rays fill the sphere around a receiver. What they hit is connected to the transmitter (``S``), and of some to those images
of it that light the piece of surface there (``MS``); some go on turned at a mirror and are connected there (``SM``,
``MSM``). Elements of the surface send on what they got of others (:mod:`warprrf.rf.tracing.render`), and are seen directly
(``E``) or in a mirror (``EM``). Slabs (``T``) may stand in the way of light to a surface (``TS``; ``MTS``, before or behind
the mirror), or of sight (``ST``, ``ET``), where rays go straight on. Paths without scattering, through slabs and over edges
too, come from :mod:`warprrf.rf.paths`. Tables hold geometry alone, but for two things that follow materials as they are taken to
be before any measurement, and are not fitted: through which slabs rays pass, and how strong paths over edges are.

A :class:`Tracer` belongs to a surface, a transmitter and a grid of rays; what it traced gives the :class:`View` of a receiver.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warprrf.cache import Cache, making
from warprrf.device import DeviceLike, Progress, resolve
from warprrf.geometry.mesh import headings
from warprrf.kernels.radio.records import MIRROR, SCATTER, SLAB, SOURCE
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.edge_paths import EdgeFinder
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.mirror_paths import MirrorPaths, ZoneRays, described, zone_paths
from warprrf.rf.paths.polarisation import turns
from warprrf.rf.paths.slabs import Slabs, Walls
from warprrf.rf.spectra.spectrum import unit_beams
from warprrf.rf.tracing.model import Effects
from warprrf.rf.tracing.rays import NEAREST_M, Hits, RayGrid, quasi_random
from warprrf.rf.tracing.records import Interactions, Records
from warprrf.rf.tracing.surface import Surface
from warprrf.rows import spans

MIRROR_SLACK_M = 0.1
"""How far beside its faces a patch may still mirror [m]: outlines of a reconstructed mesh are torn."""
UNMODELLED = {("MTS", "M"), ("MTS", "T")}
"""Ways of light and of sight that are not traced together."""
SPECULAR = "specular"
"""Name of the table of paths without scattering."""
_TRACED = Cache(6)  # tracers of a lobby take up to 90 MB each; the bound is the process's, not a surface's


def sequences(effects: Effects) -> dict[str, tuple[str, str]]:
    """How a surface is lit, and how it is seen, in the tables that ``effects`` want besides :data:`SPECULAR`, by their names: from
    the transmitter to the receiver and, where slabs may be passed, the most on either way (``"TS3"``).

    Lit: ``"S"`` by the transmitter, ``"MS"`` by its images in mirrors, ``"TS"`` through slabs, ``"MTS"`` through slabs before or
    behind a mirror; ``"E"``: it is an element that sends on what it got of others. Seen: ``""`` directly, ``"M"`` in a mirror,
    ``"T"`` through slabs.
    """
    e, found = effects, {}
    lights = {"S": True, "MS": e.mirror_scatter, "E": e.scatterings > 1}
    lights |= {"TS": e.transmissions > 0, "MTS": e.transmissions > 0 and e.mirror_scatter}
    sights = {"": True, "M": e.scatter_mirror, "T": e.transmissions > 0 and e.scatter_mirror}
    for light, lit in lights.items():
        for sight, seen in sights.items():
            slabs = str(e.transmissions) if "T" in light + sight else ""
            if lit and seen and e.scatterings > 0 and (light, sight) not in UNMODELLED:
                found[light + sight + slabs] = light, sight
    return found


@dataclass(frozen=True)
class View:
    """What R receivers see of the geometry under one transmitter; their rays, K each, stand one after another.

    Attributes:
        tracer: surface, transmitter and grid.
        receivers: positions [m], shape ``(R, 3)``.
        hits: what the rays hit.
        paths: those without scattering, L in all.
        effects: whose mirrors, slabs and edges ``paths`` were sought over.
        records: tables by sequence, of those that were asked for; under :data:`SPECULAR` one row for each of ``paths``.
        keeps: whether what is made when it is first asked for is kept.
    """

    tracer: Tracer
    receivers: np.ndarray
    hits: Hits
    paths: MirrorPaths
    effects: Effects
    records: dict[str, Records] = field(repr=False)
    keeps: bool = True
    _kept: Cache = field(init=False, repr=False, default_factory=lambda: Cache(2))

    def beams(self, sigma_rad: float) -> np.ndarray:
        """Unit beam of a receiver's width for each path over the pixels, shape ``(L, H, W)`` float32."""
        grid = self.tracer.grid
        make = partial(unit_beams, self.paths.arrival, grid.shape, sigma_rad, device=grid.device)
        return self._kept.get(sigma_rad, make) if self.keeps else make()

    def cell(self, ray: np.ndarray) -> np.ndarray:
        """Surface cell that each ray of index ``ray`` (N,) meets, shape ``(N,)``; all must meet something."""
        hits = self.hits if self.keeps else replace(self.hits)
        return self.tracer.surface.cells.cell[self.tracer.grid.tile(hits)[ray]]

    @property
    def outward(self) -> np.ndarray:
        """Vector from the transmitter to the first point of each path of one receiver [m], shape ``(L, 3)``."""
        first = self.paths.point[:, 0]
        return np.where(np.isnan(first), self.receivers[0], first) - self.tracer.transmitter

    def over_m(self, ray: np.ndarray, reach_m: np.ndarray | None = None) -> np.ndarray:
        """Length from the transmitter over what the rays ``ray`` (N,) see to the receiver [m], shape ``(N,)``: over what they meet
        first, or over what lies behind slabs, ``reach_m`` (N,) along them."""
        start, toward, _ = self.hits.rays(ray)
        reach = np.asarray(self.hits.range_m[ray] if reach_m is None else reach_m, float)
        point = start + reach[:, None] * toward
        return np.asarray(np.linalg.norm(point - self.tracer.transmitter, axis=1) + reach)

    def traced(self, effects: Effects) -> dict[str, Records]:
        """The tables that count under ``effects``; they are traced when they are first asked for."""
        wanted = sequences(effects)
        lacking = {name: own for name, own in wanted.items() if name not in self.records}
        made = self.tracer.trace(self, lacking, effects.transmissions)
        if made and self.keeps:
            with making:
                self.records.update(made)
        every = self.records | made
        return {name: every[name] for name in (SPECULAR, *wanted)}

    def of(self, k: int) -> View:
        """That of receiver ``k`` alone; nothing but its paths without scattering is known."""
        h, own = self.hits, self.paths.receiver == k
        rays = slice(k * len(h.directions), (k + 1) * len(h.directions))
        hits = replace(h, origins=h.origins[[k]], face=h.face[rays], range_m=h.range_m[rays])
        paths, direct = self.paths.of(np.array([k])), self.records[SPECULAR].take(own)
        direct = replace(direct, ray=np.arange(len(paths), dtype=np.int32))
        tables = {SPECULAR: direct}
        return View(self.tracer, self.receivers[[k]], hits, paths, self.effects, tables, self.keeps)

    def without_records(self) -> View:
        """The same that keeps no records but those of paths without scattering."""
        hits = replace(self.hits)
        return replace(self, hits=hits, records={SPECULAR: self.records[SPECULAR]}, keeps=False)

    def counted_paths(self, effects: Effects) -> np.ndarray:
        """Which ``paths`` count, shape ``(L,)`` bool."""
        mirrors, slabs = ((self.paths.code == kind).sum(axis=1) for kind in (MIRROR, SLAB))
        few = (mirrors <= effects.mirrors) & (slabs <= effects.transmissions)
        few &= ~self.paths.over_edge | (effects.diffractions > 0)
        return np.asarray(few & (~self.paths.in_sight | effects.line_of_sight))


@dataclass(frozen=True)
class Rays:
    """Rays and what they hit: ``ray`` of the receiver's grid that each belongs to, and the interactions between the hit and
    the receiver, if any; ``through_slabs``: those are slabs alone."""

    hits: Hits
    ray: np.ndarray
    after: Interactions | None = None
    through_slabs: bool = False


class Tracer:
    """Geometry under one transmitter.

    Args:
        walls: what may be passed, where that is known; else the surface tells.

    Attributes:
        wavelength_m: wavelength.
        cache: what belongs to the transmitter, by name.
        materials: last ones that light was sent on by, see :func:`~warprrf.rf.tracing.render.materials_of`.
    """

    def __init__(
        self,
        surface: Surface,
        transmitter: np.ndarray,
        frequency_hz: float,
        grid: RayGrid,
        walls: Walls | None = None,
    ) -> None:
        self.surface, self.grid, self._walls = surface, grid, walls
        self.transmitter = np.array(transmitter, np.float64)
        self.frequency_hz = frequency_hz
        self.wavelength_m = SPEED_OF_LIGHT / frequency_hz
        self._first_grid = grid
        self.cache = Cache(12)  # all kinds under two bounds of slabs and of bounces
        self.materials = Cache(2)

    @classmethod
    def of(
        cls,
        surface: Surface,
        transmitter: np.ndarray,
        frequency_hz: float,
        shape: tuple[int, int],
        sub_pixels: int,
        *,
        air: Air | None = None,
        device: DeviceLike = None,
    ) -> Tracer:
        """That of a grid of ``shape`` with ``sub_pixels`` squared rays a pixel; the last few are kept."""
        place = np.asarray(transmitter, np.float64).tobytes()
        where = str(resolve(device))
        key = surface, place, frequency_hz, shape, sub_pixels, air, where

        def make() -> Tracer:
            loss = 0.0 if air is None else air.loss_per_m(frequency_hz)
            grid = RayGrid(surface, shape, sub_pixels, loss_per_m=loss, device=device)
            return cls(surface, transmitter, frequency_hz, grid)

        return _TRACED.get(key, make)

    def on_grid(self, shape: tuple[int, int], sub_pixels: int) -> Tracer:
        """The same for receivers with other rays; what belongs to the transmitter is shared."""
        other, g = copy(self), self.grid
        other.grid = RayGrid(self.surface, shape, sub_pixels, loss_per_m=g.loss_per_m, device=g.device)
        return other

    @property
    def of_transmitter(self) -> Tracer:
        """The same on the grid that it was made with: what belongs to the transmitter does not depend on later grids."""
        first = copy(self)
        first.grid = self._first_grid
        return first

    def mirrored(self, most: int = 0) -> MirroredLight:
        """Images of the transmitter that light faces; with ``most`` those that need slabs to do so, up to that many."""
        return self.cache.get(("mirrored", most), lambda: MirroredLight(self, most))

    @property
    def images(self) -> MirrorImages:
        """Images of the transmitter in the surface's mirrors, whose outlines may be torn."""
        s, device = self.surface, self.grid.device
        make = partial(MirrorImages, s.patches, self.transmitter, slack_m=MIRROR_SLACK_M, device=device)
        return self.cache.get("images", make)

    def walls(self, most: int) -> Walls:
        """What may be passed, up to ``most`` slabs on one way."""
        make = partial(self.surface.walls, self.frequency_hz, most, self.grid.device)
        return self._walls or self.cache.get(("walls", most), make)

    @property
    def slabs(self) -> tuple[np.ndarray, np.ndarray]:
        """Permittivity and thickness in wavelengths of each group, as :class:`Materials` takes them."""
        return self.cache.get("slabs", lambda: self.surface.slab_properties(self.frequency_hz)[:2])

    def paths(self, receivers: np.ndarray, effects: Effects, progress: Progress | None = None) -> MirrorPaths:
        """Paths without scattering of ``receivers`` (R, 3) that ``effects`` want, through slabs and over edges too."""
        most = effects.transmissions
        walls = self.walls(most) if most else None
        found = zone_paths(self.images, receivers, effects.mirrors, self.wavelength_m, progress, walls)
        found = self._delayed(found)
        if not effects.diffractions:
            return found
        edges = self.cache.get(("edges", most), lambda: self._edges(walls))
        return edges.find(receivers, min(effects.mirrors, 1), progress).beside(found)

    def _delayed(self, found: MirrorPaths) -> MirrorPaths:
        """``found`` with what slabs of known materials make them longer by."""
        table, known = self.surface.table(self.frequency_hz), np.abs(self.slabs[0])[self.surface.group] > 0
        row, k = np.nonzero((found.slab >= 0) & known[found.slab])
        group, solid = self.surface.group[found.slab[row, k]], found.thickness_m[row, k]
        longer = table.passage(group, found.cosine[row, k], self.wavelength_m, solid)[2]
        return replace(found, excess_m=np.bincount(row, longer, minlength=len(found)))

    def _edges(self, walls: Walls | None) -> EdgeFinder:
        """Paths over edges and a slab, if there are ``walls``, between surfaces as they are taken to be before any measurement."""
        s = self.surface
        images = MirrorImages(s.patches, self.transmitter, device=self.grid.device)
        table = s.table(self.frequency_hz)
        return EdgeFinder(images, self.wavelength_m, table, walls=walls, group=s.group)

    def view(
        self, receivers: np.ndarray, effects: Effects, *, paths: MirrorPaths | None = None, keeps: bool = True
    ) -> View:
        """What ``receivers``, (3,) or (R, 3) [m], see.

        Args:
            receivers: positions, off the surface.
            effects: whose mirrors, slabs and edges paths without scattering are sought over.
            paths: paths without scattering, if they are known.
            keeps: whether the view keeps what is made when it is first asked for.
        """
        places = np.asarray(receivers, np.float64).reshape(-1, 3)
        found = self.paths(places, effects) if paths is None else paths
        tables = {SPECULAR: self.specular(found)}
        return View(self, places, self.grid.hit(places), found, effects, tables, keeps)

    def trace(self, view: View, wanted: dict[str, tuple[str, str]], most: int) -> dict[str, Records]:
        """Tables of the sequences ``wanted`` of what a receiver sees, with up to ``most`` slabs, by name; see :func:`sequences`."""
        first = Rays(view.hits if view.keeps else replace(view.hits), np.arange(len(view.hits.face)))
        seen, lit, made = {"": first}, dict[str, dict[str, Records]](), dict[str, Records]()
        for name, (light, sight) in wanted.items():
            if sight not in seen:
                seen[sight] = self.reflected(first) if sight == "M" else self.behind(first, most)
            rays = seen[sight]
            if light == "E":
                table = self.elements_seen(rays)
            elif light in ("MS", "MTS"):
                table = self.lit_by_mirrors(rays, most if light == "MTS" else 0)
            else:
                if sight not in lit:
                    lit[sight] = self.lit_straight(rays, most)
                table = lit[sight][light]
            made[name] = table
        return made

    def specular(self, p: MirrorPaths) -> Records:
        """Paths without scattering as records, in double precision."""
        friis = (self.wavelength_m / (4.0 * np.pi * p.length_m)) ** 2 * p.share**2
        mirrors, slabs = p.patch >= 0, p.slab >= 0
        group = np.append(self.surface.patch_group, -1)[p.patch]  # no patch has no group
        group = np.where(slabs, self.surface.group[p.slab], group)
        thickness = np.nan_to_num(p.thickness_m) / self.wavelength_m
        angle = np.stack([p.cosine, np.where(mirrors | slabs, p.turn, 0.0), thickness], axis=2)
        power = friis * self.grid.transmittance(p.length_m)
        kind = MIRROR * mirrors + SLAB * slabs
        row = np.arange(len(p), dtype=np.int32)
        return Records(group.astype(np.int32), angle, kind.astype(np.int8), power, row)

    def lit_straight(self, rays: Rays, most: int) -> dict[str, Records]:
        """What rays see of surfaces that the transmitter lights, ``"S"``, and, if ``most`` is not 0, through slabs, up to that
        many, ``"TS"``."""
        light, lit = self.grid.light(rays.hits, self.transmitter)
        found = {"S": self.scattered(rays, lit, light.strength[lit], light.angle[lit])}
        if most:
            row = np.setdiff1d(np.flatnonzero(light.strength > 0), lit)
            arrived, slabs = self.walls(most).between(self.transmitter, light.point[row])
            own = np.flatnonzero(slabs.count > 0)
            row, slabs = row[arrived[own]], slabs.take(own)
            before = self._through(slabs, light.point[row] - self.transmitter)
            found["TS"] = self.scattered(rays, row, light.strength[row], light.angle[row], before)
        return found

    def lit_by_mirrors(self, rays: Rays, most: int = 0) -> Records:
        """What some rays of each pixel see of surfaces that images of the transmitter light; with ``most`` those that they need
        slabs to light, up to that many."""
        most_rays = 3  # of a pixel
        places = ((np.arange(most_rays) + 0.5) * self.grid.per_pixel / most_rays).astype(int)
        places = np.unique(places)
        times = self.grid.per_pixel / len(places)
        chosen = np.flatnonzero((rays.hits.face >= 0) & np.isin(rays.ray % self.grid.per_pixel, places))
        m = self.mirrored(most)
        row, image = m.pairs(self.grid.tile(rays.hits)[chosen])
        before = m.before.take(image) if most else None
        return self.lit_by_images(rays, chosen[row], m.patch[image], before, times)[1]

    def lit_by_images(
        self, rays: Rays, row: np.ndarray, patch: np.ndarray, before: Interactions | None, times: float
    ) -> tuple[np.ndarray, Records]:
        """What the rays ``row`` (N,), each in place of ``times``, see by the transmitter's image in ``patch`` (N,): which of them
        see any, and records of those, after the interactions ``before``, by default the mirror alone."""
        images, s = self.surface.images(self.transmitter), self.surface
        light = self.grid.unshadowed(rays.hits, images[patch], row)
        k = np.flatnonzero(light.strength > 0)
        strength = light.strength[k] * self.grid.dtype.type(times)
        if before is None:
            way = headings(images[patch[k]] - light.point[k])[0]
            cosine = np.abs(np.einsum("ni,ni->n", way, s.plane_normal[patch[k]]))
            mirrors = Interactions.of_mirrors(s.patch_group[patch[k]], cosine)
        else:
            mirrors = before.take(k)
        return k, self.scattered(rays, row[k], strength, light.angle[k], mirrors)

    def elements_seen(self, rays: Rays) -> Records:
        """What rays see of elements."""
        row, tile = self.grid.tiles_met(rays.hits)
        side, friis = self.surface.tile_side[tile], (self.wavelength_m / (4.0 * np.pi)) ** 2
        power = friis * rays.hits.rays(row)[2] * self.grid.transmittance(rays.hits.range_m[row])
        own = Interactions.of_kind(side[:, None], np.zeros((len(row), 1, 3)), SOURCE)
        return self._records(rays, row, power, [own], 1)

    def scattered(
        self,
        rays: Rays,
        row: np.ndarray,
        strength: np.ndarray,
        angle: np.ndarray,
        before: Interactions | None = None,
    ) -> Records:
        """Records of scattering where the rays ``row`` hit, after the interactions ``before``."""
        group = self.surface.group[rays.hits.face[row]]
        own = Interactions.of_kind(group[:, None], angle[:, None], SCATTER)
        met = [own] if before is None else [before, own]
        return self._records(rays, row, self.wavelength_m**2 * strength, met, int(before is not None))

    def _records(
        self, rays: Rays, row: np.ndarray, power: np.ndarray, met: list[Interactions], residual_row: int
    ) -> Records:
        """Records of what the rays ``row`` see over ``met``, one after the other; the residual's row is that of direct sight."""
        dtype, behind = self.grid.dtype, [] if rays.after is None else [rays.after.take(row)]
        legs = [*met, *behind]
        names = "index", "angle", "kind"
        index, angle, kind = (np.concatenate([getattr(leg, n) for leg in legs], axis=1) for n in names)
        return Records(
            index.astype(np.int32), angle.astype(dtype), kind, np.asarray(power, dtype),
            rays.ray[row].astype(np.int32), -1 if behind else residual_row, self.grid.half_width,
            rays.hits.range_m[row].astype(np.float32) if rays.through_slabs else None,
        )  # fmt: skip

    def _through(self, slabs: Slabs, way: np.ndarray) -> Interactions:
        """Slabs that are passed along ``way`` (N, 3), not of unit length, in this order."""
        slabs = slabs.trimmed
        met, s = slabs.face >= 0, self.surface
        turn, more = np.zeros(met.shape), np.flatnonzero(met.sum(axis=1) > 1)
        normal = np.where(met[more, :, None], s.mesh.face_normals[slabs.face[more]], way[more, None])
        stops = np.arange(met.shape[1] + 2)[:, None] * way[more, None]
        turn[more] = np.where(met[more], turns(stops, normal), 0.0)
        thickness = np.nan_to_num(slabs.thickness_m) / self.wavelength_m
        index = np.where(met, s.group[slabs.face], -1)
        return Interactions.of_kind(index, np.stack([slabs.cosine, turn, thickness], axis=2), SLAB)

    def behind(self, rays: Rays, most: int) -> Rays:
        """``rays`` that go straight on through what they hit, and what they meet behind up to ``most`` slabs."""
        hits, walls = rays.hits, self.walls(most)
        ray = np.flatnonzero(hits.face >= 0)
        ray = ray[walls.passes[hits.face[ray]]]
        origins, directions, solid_angle = hits.rays(ray)
        row, face, range_m, slabs = walls.behind(origins, directions, hits.face[ray], hits.range_m[ray])
        after = self._through(slabs.reversed, -directions[row])
        found = Hits(origins[row], directions[row], solid_angle[row], face.astype(np.int32), range_m)
        return Rays(found, rays.ray[ray[row]], after, through_slabs=True)

    def reached(self, most: int) -> np.ndarray:
        """Where light from the transmitter reaches each side of a tile, over any number of bounces [m]: first sides, then second
        ones, shape ``((1 + two_sided) T, 3)``; NaN where it does not. With ``most`` sides of elements that it reaches nowhere
        in the air are reached through up to so many slabs between two bounces."""
        return self.cache.get(("reached", most), lambda: self.of_transmitter._reached(most))

    def _reached(self, most: int) -> np.ndarray:
        s, few = self.surface, 4  # rays of each tile
        point, hits = np.full((len(s.tile_side), 3), np.nan), self.grid.hit(self.transmitter)
        while True:
            found = [hits]
            if most:
                found.append(self.behind(Rays(hits, np.arange(len(hits.face))), most).hits)
            met = [self.grid.tiles_met(one) for one in found]
            place = np.concatenate([one.points(ray) for one, (ray, _) in zip(found, met, strict=True)])
            tile = np.concatenate([own for _, own in met])
            # Of what is met for the first time the place nearest to a tile's middle.
            middle = s.tiles.centre[tile % len(s.tiles.face)]
            first = np.lexsort((np.linalg.norm(place - middle, axis=1), tile))
            first = first[np.unique(tile[first], return_index=True)[1]]
            first = first[np.isnan(point[tile[first], 0])]
            if len(first) == 0:
                break
            point[tile[first]] = place[first]
            again = np.repeat(first, few)
            u, v = quasi_random(len(first), few)[1:].reshape(2, -1)
            hits = self.grid.hit_from(tile[again], place[again], u, v)
        if most:
            air = self.reached(0)
            own = np.isin(s.tile_side, s.tile_side[~np.isnan(air[:, 0])])
            point[own] = air[own]
        return point

    def reflected(self, rays: Rays) -> Rays:
        """``rays`` turned at the mirrors that they hit, and what they hit there."""
        s, grid, hits = self.surface, self.grid, rays.hits
        ray = np.flatnonzero((hits.face >= 0) & (s.patch[hits.face] >= 0))
        face, (_, direction, solid_angle) = hits.face[ray], hits.rays(ray)
        normal = s.plane_normal[s.patch[face]]
        normal = np.where((direction * normal).sum(axis=1, keepdims=True) > 0, -normal, normal)
        cosine = -(direction * normal).sum(axis=1)
        onward = direction + 2.0 * cosine[:, None] * normal
        start, left = hits.points(ray) + s.position_error_m * normal, grid.transmittance(hits.range_m[ray])
        found = grid.hit_along(start, onward, solid_angle * left)
        return Rays(found, rays.ray[ray], Interactions.of_mirrors(s.group[face], cosine))

    def adopted(self, view: View) -> View:
        """What :func:`view_of` found, as a view of this tracer."""
        own: dict[str, Any] = {"directions": self.grid.directions, "solid_angle": self.grid.solid_angle}
        return replace(view, tracer=self, hits=replace(view.hits, **own))


def view_of(
    make: Callable[[], Tracer], effects: Effects, keeps: bool, part: tuple[np.ndarray, MirrorPaths]
) -> View:
    """What a receiver (3,) of known paths without scattering sees, without what all receivers share; ``make`` makes their
    tracer, in another process too."""
    view = make().view(part[0], effects, paths=part[1], keeps=keeps)
    if keeps:
        view.traced(effects)
    none: dict[str, Any] = {"directions": None, "solid_angle": None}
    return replace(view, tracer=None, hits=replace(view.hits, **none))  # type: ignore[arg-type]


class MirroredLight:
    """Images of the transmitter in single mirrors that light pieces of the surface, found once at the middle of each: a piece
    is what faces one of six ways of a cell.

    Args:
        most: if not 0, the images are those whose light has to pass slabs, before or behind the mirror, up to that many.

    Attributes:
        patch: of each pair of a piece and an image that lights it the mirror, shape ``(N,)``.
        before: its light's way to the middle of the piece, of which interactions alone count.
        onto: its light on the sides of elements: records whose ray is the side, of irradiance where the transmitter gives
            cos(theta_i) / d1^2 [1/m^2].
        cosine: of incidence of each of those.
    """

    def __init__(self, tracer: Tracer, most: int = 0) -> None:
        s, grid, walls = tracer.surface, tracer.grid, tracer.walls(most) if most else None
        largest, tiles = np.abs(s.front_normal).argmax(axis=1), s.tiles
        way = 2 * largest + (np.take_along_axis(s.front_normal, largest[:, None], axis=1)[:, 0] < 0)
        own = self._piece = np.unique(6 * tiles.cell + way[tiles.face], return_inverse=True)[1]
        # A tile that lies in part under something is asked about where it is open, and what is hidden counts for nothing.
        sides = tracer.reached(most).reshape(-1, len(own), 3)
        place, is_open = np.where(np.isnan(sides[0]), sides[-1], sides[0]), ~np.isnan(sides[:, :, 0])
        hidden = ~is_open.any(axis=0)
        parted = s.parts.parted[tiles.cell[hidden], None]
        place[hidden] = np.where(parted, s.parts.tree.data[tiles.cell[hidden]], tiles.centre[hidden])
        tile, open_m2 = tiles.middles(own, ~hidden), tiles.area * is_open
        area = np.stack([np.bincount(own, one) for one in open_m2])
        centre, middle = place[tile], tiles.face[tile]
        shown = None
        if walls is None:  # through slabs mirrors are lit that the transmitter does not see
            clear = s.mesh.visible(tracer.transmitter, tiles.off_centre, clearance=s.position_error_m)
            shown = np.unique(s.patch[tiles.face[clear]])
        ways = tracer.images.candidates(centre, 1, first=shown)
        # Light must come from in front of the piece, of either side if it has two, and not from its own patch.
        face = middle[ways.row]
        normal = s.front_normal[face]
        side = ((ways.point[:, 0] - centre[ways.row]) * normal).sum(axis=1)
        normal = np.where(s.two_sided & (side < 0)[:, None], -normal, normal)
        own = np.flatnonzero((s.two_sided | (side > 0)) & (s.patch[face] != ways.patch[:, 0]))
        own = own[np.lexsort((ways.patch[own, 0], ways.row[own]))]
        ways, normal = ways.take(own), normal[own]
        off = ways.over(-1, centre[ways.row] + s.position_error_m * normal)
        rays = ZoneRays(tracer.images, 0.0)
        free = rays.reached(off)
        if walls is None:
            chosen, off = np.flatnonzero(free), off.take(free)
        else:
            chosen, off = rays.through(walls, off, free)
            order = np.argsort(off.row, kind="stable")  # before and behind the mirror together
            chosen, off = chosen[order], off.take(order)
        piece, patch, normal = off.row, off.patch[:, 0], normal[chosen]
        ways = off.over(-1, centre[piece])
        paths = tracer.specular(described(ways, 1, walls))
        self.before, self.patch = paths, patch
        self._first = np.searchsorted(piece, np.arange(len(middle) + 1))
        toward, length = headings(s.images(tracer.transmitter)[patch] - centre[piece])
        cos_in = self.cosine = np.maximum((toward * normal).sum(axis=1), 0.0)
        behind = s.is_behind(middle[piece], -normal).astype(int)
        ray = s.tile_side[tile[piece] + behind * len(tiles.face)]
        share = area[behind, piece] / np.maximum(np.bincount(s.tile_side, open_m2.ravel())[ray], 1e-12)
        power = share * cos_in / np.maximum(length, NEAREST_M) ** 2 * grid.transmittance(length)
        self.onto = replace(paths, power=power, ray=ray)

    def pairs(self, tile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of ``tile`` (N,), and images that light them, one for each pair."""
        piece = self._piece[tile]
        return spans(self._first[piece], np.diff(self._first)[piece])
