"""Rooms, and ways to write one that must not change what it does.

A law changes a room's description, not the room: where it stands, how it is turned, its unit (with the wavelength's),
winding, order, cut and copies of faces, rounding and noise of vertices. Figures are what it is measured by: power of
mirror paths, exact spectra, spectra of both kinds of field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import office
from golden import make
from places import LOBBY
from radio_scenes import joined
from scipy.spatial.transform import Rotation

import warprrf as wr
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf import exact
from warprrf.rf.exact import SINGLE
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.tracing import rays
from warprrf.rf.tracing.model import Effects

SHAPE = (18, 36)
EVERY_EFFECT = Effects(mirrors=2, residual=False)


@dataclass(frozen=True)
class Room:
    """A scene with places in it.

    Attributes:
        vertices, faces, part: shapes ``(V, 3)`` [m], ``(F, 3)``, ``(F,)``: the material of each face.
        materials: of the parts.
        transmitter, receivers: shapes ``(3,)``, ``(R, 3)`` [m].
        frequency_hz: carrier.
        turned: columns of a spectrum that the room was turned by about z; None if about another axis.
        rotation: that it was turned by.
        gaussians: on its surfaces.
        behind: slabs on a path, and edges, that are modelled.
    """

    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    materials: tuple[wr.Material, ...]
    transmitter: np.ndarray
    receivers: np.ndarray
    frequency_hz: float = 300e9
    turned: int | None = 0
    gaussians: wr.Gaussians | None = None
    rotation: Rotation = Rotation.identity()
    behind: tuple[int, int] = (0, 0)

    @property
    def mesh(self) -> wr.Mesh:
        return wr.Mesh(self.vertices, self.faces)

    @property
    def scene(self) -> wr.Scene:
        return wr.Scene(self.mesh, list(self.materials), self.part)

    @property
    def link(self) -> dict[str, object]:
        return {
            "transmitter": self.transmitter,
            "receivers": self.receivers,
            "frequency_hz": self.frequency_hz,
        }

    def with_gaussians(self, count: int = 600) -> Room:
        """The room with discs on its surfaces."""
        return replace(self, gaussians=discs_on_mesh(self.mesh, count))


Change = Callable[[Room], Room]


def plain() -> Room:
    """The room of the goldens: a cupboard and a screen in a box."""
    mesh, part = make.room_mesh()
    scene = make.room()
    return Room(mesh.vertices, mesh.faces, part, tuple(scene.materials), make.TRANSMITTER, make.places(3))


def prism(
    outline: np.ndarray, height: float, caps: list[tuple[int, int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """An upright prism on an outline (N, 2) that turns left, normals outward; ``caps`` are the floor's triangles."""
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (0.0, height)])
    sides = [t for i in range(n) for t in ((i, (i + 1) % n, n + (i + 1) % n), (i, n + (i + 1) % n, n + i))]
    floor = [(a, c, b) for a, b, c in caps]
    return vertices, np.array(sides + floor + [(a + n, b + n, c + n) for a, b, c in caps])


def l_shaped() -> Room:
    """An L-shaped room with a slanted wall, a pillar of six sides and a desk that stands askew."""
    walls = np.array([(0, 0), (8.3, 0), (8.3, 3.1), (4.9, 3.7), (4.2, 7.4), (0, 6.6)])
    angle = np.arange(6) * np.pi / 3 + 0.2
    pillar = np.array([2.1, 2.4]) + 0.31 * np.column_stack([np.cos(angle), np.sin(angle)])
    turn = Rotation.from_euler("z", 0.3).as_matrix()[:2, :2]
    desk = np.array([(-0.8, -0.4), (0.8, -0.4), (0.8, 0.4), (-0.8, 0.4)]) @ turn.T + [6.3, 1.6]
    vertices, faces = prism(walls, 2.9, [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)])
    mesh, part = joined(
        (vertices, faces[:, ::-1]),  # the room is seen from within
        prism(pillar, 2.9, [(0, k, k + 1) for k in range(1, 5)]),
        prism(desk, 0.75, [(0, 1, 2), (0, 2, 3)]),
    )
    places = np.array([[6.9, 2.4, 1.3], [3.1, 5.6, 1.1], [3.0, 1.0, 1.7]])
    return Room(
        mesh.vertices, mesh.faces, part, tuple(make.room().materials), np.array([1.2, 1.1, 2.3]), places
    )


def lobby() -> Room:
    """The lobby's true mesh, and three places of its data set."""
    scene, ds = wr.Scene.load(LOBBY / "scene.xml"), wr.SpectrumDataset.load(LOBBY / "spectra.nc")
    return Room(
        scene.mesh.vertices, scene.mesh.faces, scene.face_material, tuple(scene.materials), np.array(ds.transmitter),
        np.array(ds.receivers[:3]), float(ds.frequency_hz),
    )  # fmt: skip


def behind_glass() -> Room:
    """An L-shaped office with a room behind glass, a table and a cabinet; places on both sides of the glass."""
    with TemporaryDirectory() as folder:
        scene = wr.Scene.load(office.office(Path(folder)))
    places = np.array([[7.23, 0.84, 1.22], [8.37, 1.73, 1.13], [4.21, 2.02, 1.41]])
    return Room(
        scene.mesh.vertices, scene.mesh.faces, scene.face_material, tuple(scene.materials), np.array([1.07, 5.93, 2.41]),
        places, office.CARRIER_HZ, behind=(3, 1),
    )  # fmt: skip


ROOMS = {"plain": plain, "l-shaped": l_shaped, "lobby": lobby, "behind glass": behind_glass}


def moved(
    rotation: Rotation, factor: float = 1.0, shift: tuple[float, ...] = (0, 0, 0), turn: int | None = 0
) -> Change:
    """Everything turned, then scaled, then shifted; ``turn`` says so in columns of a spectrum."""

    def place(points: np.ndarray) -> np.ndarray:
        return np.asarray(factor * (np.asarray(points, float) @ rotation.as_matrix().T) + shift)

    def change(room: Room) -> Room:
        g = room.gaussians
        if g is not None:
            q = rotation * Rotation.from_quat(g.quaternions, scalar_first=True)
            g = wr.Gaussians(
                place(g.means), q.as_quat(scalar_first=True), factor * g.scales, g.opacities, g.sh
            )
        turned = None if turn is None or room.turned is None else room.turned + turn
        return replace(
            room, vertices=place(room.vertices), transmitter=place(room.transmitter), receivers=place(room.receivers),
            gaussians=g, turned=turned, rotation=rotation * room.rotation,
        )  # fmt: skip

    return change


def shifted(*metres: float) -> Change:
    return moved(Rotation.identity(), shift=metres)


def turned(columns: int) -> Change:
    """Turned about z by whole columns of a spectrum."""
    return moved(Rotation.from_euler("z", columns * 2.0 * np.pi / SHAPE[1]), turn=columns)


def scaled(factor: float) -> Change:
    """As large by ``factor``, the wavelength too, and materials that are the same in wavelengths: another unit."""

    def change(room: Room) -> Room:
        f = room.frequency_hz
        same = tuple(
            wr.Material.custom(
                m.name, relative_permittivity=m.relative_permittivity(f), conductivity=m.conductivity(f) / factor,
                thickness_m=m.thickness_m * factor, scattering=m.scattering_coefficient(f), pattern=m.pattern,
                alpha_r=m.alpha_r,
            )
            for m in room.materials
        )  # fmt: skip
        return replace(moved(Rotation.identity(), factor)(room), frequency_hz=f / factor, materials=same)

    return change


def mirrored(room: Room) -> Room:
    """As seen in a mirror across x; without its Gaussians."""

    def place(points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) * [-1.0, 1.0, 1.0]

    return replace(
        room, vertices=place(room.vertices), faces=room.faces[:, ::-1], transmitter=place(room.transmitter),
        receivers=place(room.receivers), gaussians=None, turned=None,
    )  # fmt: skip


def in_another_order(room: Room) -> Room:
    """Faces and Gaussians in another order, corners too."""
    rng, g = np.random.default_rng(1), room.gaussians
    order = rng.permutation(len(room.faces))
    if g is not None:
        k = rng.permutation(len(g.means))
        g = wr.Gaussians(g.means[k], g.quaternions[k], g.scales[k], g.opacities[k], g.sh[k])
    return replace(room, faces=np.roll(room.faces[order], 1, axis=1), part=room.part[order], gaussians=g)


def reversed_winding(room: Room, share: float = 1.0) -> Room:
    """Every face, or a share by chance, wound the other way."""
    some = np.random.default_rng(3).random((len(room.faces), 1)) < share
    return replace(room, faces=np.where(some, room.faces[:, ::-1], room.faces))


def unwelded(room: Room) -> Room:
    """Three vertices of its own for each face."""
    corners = room.vertices[room.faces].reshape(-1, 3)
    return replace(room, vertices=corners, faces=np.arange(len(corners)).reshape(-1, 3))


def _with(room: Room, copy: Room) -> Room:
    """Both rooms' faces in one mesh, the copy's wound the other way, as exporters do."""
    mesh, _ = joined((room.vertices, room.faces), (copy.vertices, copy.faces[:, ::-1]))
    return replace(
        room, vertices=mesh.vertices, faces=mesh.faces, part=np.concatenate([room.part, copy.part])
    )


def in_two_sheets(metres: float) -> Change:
    """Every face again, so far before or behind it."""

    def change(room: Room) -> Room:
        sheet = unwelded(room)
        normal = np.repeat(room.mesh.face_normals, 3, axis=0)
        return _with(room, replace(sheet, vertices=sheet.vertices + metres * normal))

    return change


def subdivided(room: Room) -> Room:
    """Every face cut into four at the middles of its edges."""
    corners = room.vertices[room.faces]
    middles = (corners + np.roll(corners, -1, axis=1)) / 2
    (a, b, c), (ab, bc, ca) = np.moveaxis(corners, 1, 0), np.moveaxis(middles, 1, 0)
    pieces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])  # (4, 3, F, 3)
    triangles = np.moveaxis(pieces, 2, 0).reshape(-1, 3)
    welded, index = np.unique(np.round(triangles, 9), axis=0, return_inverse=True)
    return replace(room, vertices=welded, faces=index.reshape(-1, 3), part=np.repeat(room.part, 4))


def cut_in_part(room: Room) -> Room:
    """Every other face cut into four, so that corners of a seam do not meet."""
    fine, some = unwelded(subdivided(room)), np.arange(len(room.faces)) % 2 == 0
    mesh, _ = joined((room.vertices, room.faces[~some]), (fine.vertices, fine.faces[np.repeat(some, 4)]))
    part = np.concatenate([room.part[~some], np.repeat(room.part[some], 4)])
    return replace(room, vertices=mesh.vertices, faces=mesh.faces, part=part)


def with_faces_without_area(room: Room) -> Room:
    """Faces with two equal corners, and with all three on a line."""
    face = room.faces[np.random.default_rng(4).integers(0, len(room.faces), 10)]
    middle = room.vertices[face[:, :2]].mean(axis=1)
    points = np.column_stack([face[:, 0], face[:, 1], face[:, 0]])
    lines = np.column_stack([face[:, 0], len(room.vertices) + np.arange(10), face[:, 1]])
    vertices, nothing = np.concatenate([room.vertices, middle]), np.zeros(10, room.part.dtype)
    faces, part = np.concatenate([points, room.faces, lines]), np.concatenate([nothing, room.part, nothing])
    return replace(room, vertices=vertices, faces=faces, part=part)


def turned_four_times_in_float32(room: Room) -> Room:
    """Four quarter turns about the vertical axis, computed in float32 as exporters do."""
    finer = subdivided(room)
    c, s = np.cos(np.float32(np.pi / 2)), np.sin(np.float32(np.pi / 2))  # c is -4e-8
    v = finer.vertices.astype(np.float32)
    for _ in range(4):
        v = v @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    return replace(finer, vertices=v.astype(float))


def noisy(metres: float) -> Change:
    """Subdivided twice, and every vertex off by a normal error."""

    def change(room: Room) -> Room:
        fine = subdivided(subdivided(room))
        error = np.random.default_rng(0).normal(0, metres, fine.vertices.shape)
        return replace(fine, vertices=fine.vertices + error)

    return change


EXACT: dict[str, Change] = {
    "shifted by metres": shifted(3.1234567, -2.7654321, 0.987654),
    "shifted by 1e3 m": shifted(1e3, -2e3, 5e2),
    "shifted by 1e6 m": shifted(1e6, -2e6, 3e5),
    "turned by a quarter": turned(9),
    "turned by five columns": turned(5),
    "turned askew": moved(Rotation.from_rotvec([0.4, -0.7, 0.9]), turn=None),
    "scaled by 2": scaled(2.0),
    "scaled by 0.1": scaled(0.1),
    "mirrored": mirrored,
    "in another order": in_another_order,
    "reversed winding": reversed_winding,
    "mixed winding": lambda room: reversed_winding(room, 0.5),
    "unwelded": unwelded,
    "doubled": lambda room: _with(room, room),
    "doubled, of another material": lambda room: _with(
        room, replace(room, part=(room.part + 1) % len(room.materials))
    ),  # the first counts
    "covered by finer faces": lambda room: _with(room, subdivided(room)),
    "subdivided": subdivided,
    "cut in part": cut_in_part,
    "with faces without area": with_faces_without_area,
}
"""What must not change a room at all."""
ROUNDED: dict[str, Change] = {
    "in float32": lambda room: replace(room, vertices=room.vertices.astype(np.float32).astype(float)),
    "turned four times in float32": turned_four_times_in_float32,
    **{f"in two sheets 1e{k} m apart": in_two_sheets(10.0**k) for k in (-6, -5, -4)},
    **{f"noise of 1e{k} m": noisy(10.0**k) for k in range(-8, -2)},
}
"""What must not change it by more than rounding and noise are."""
LAWS = EXACT | ROUNDED


def traced(room: Room) -> wr.Paths:
    """Line of sight and mirror paths, and those through slabs and over edges."""
    slabs, edges = room.behind
    return wr.trace_paths(room.scene, **room.link, mirror_order=2, transmissions=slabs, diffractions=edges)


def mirrors(room: Room) -> np.ndarray:
    """Power of each receiver's paths, shape ``(R, 1, 1)``; of each kind apart where there are slabs and edges, ``(3 R, 1, 1)``."""
    paths = traced(room)
    power = np.where(paths.valid, np.abs(paths.gain) ** 2, 0.0)
    if not any(room.behind):
        return power.sum(axis=1)[:, None, None]
    every = np.isin(paths.kind, ("los", "mirror")), paths.kind == "slab", paths.kind == "edge"
    kinds = np.concatenate([(power * own).sum(axis=1) for own in every])
    return kinds[kinds > 0, None, None]


def simulated(room: Room) -> wr.SpectrumDataset:
    """Its spectra by the exact engine."""
    effects = replace(SINGLE, transmissions=room.behind[0], diffractions=room.behind[1])
    return wr.simulate(room.scene, **room.link, shape=SHAPE, beam_sigma_rad=np.deg2rad(6.0), effects=effects)


@contextmanager
def rays_turned(rotation: Rotation) -> Iterator[None]:
    """The exact engine's lattice of rays turned too: other rays meet what is small and bright now and then.

    A desk top 14 cm below a receiver is 0.1 degrees high and gives 3 % of all power in one of a pixel's 64 rays, or in none.
    """
    known = rays.sub_pixel_directions

    def turned(shape: tuple[int, int], sub_pixels: int) -> tuple[np.ndarray, np.ndarray]:
        directions, solid_angle = known(shape, sub_pixels)
        return rotation.apply(directions), solid_angle

    beams = exact._lattice_beams.__wrapped__  # kept ones are of the lattice as it was
    with (
        mock.patch.object(rays, "sub_pixel_directions", turned),
        mock.patch.multiple(exact, sub_pixel_directions=turned, _lattice_beams=beams),
    ):
        yield


def known_field(room: Room) -> BistaticField:
    """A field that takes every surface alike, with light of several bounces."""
    effects = replace(EVERY_EFFECT, transmissions=room.behind[0], diffractions=room.behind[1])
    grid = {"shape": SHAPE, "beam_sigma_rad": np.deg2rad(6.0), "floor": 1e-16}
    ds = wr.SpectrumDataset.empty(transmitter=room.transmitter, frequency_hz=room.frequency_hz, **grid)
    return BistaticField.prior(room.scene, ds, effects=effects)


def images(room: Room, source: wr.RadioField | wr.SpectrumDataset) -> np.ndarray:
    """Spectra of a field, or of a data set, as the room stood before; shape ``(R, H, W)``."""
    known = isinstance(source, wr.SpectrumDataset)
    found = source.path_gain if known else [source.spectrum(rx).path_gain for rx in room.receivers]
    return np.roll(np.asarray(found, float), -(room.turned or 0), axis=2)


def harmonic(room: Room) -> wr.RadioField:
    """An RF-3DGS+ field on the room's Gaussians."""
    return wr.RadioField.fit(
        wr.Reconstruction(room.gaussians, room.mesh), simulated(room), model="rf3dgs+", iterations=40,
        interaction_point="mesh", line_of_sight="explicit",
    )  # fmt: skip


FIGURES: dict[str, Callable[[Room], np.ndarray]] = {
    "mirrors": mirrors,
    "exact": lambda room: images(room, simulated(room)),
    "bistatic": lambda room: images(room, known_field(room)),
    "bistatic, fitted": lambda room: images(room, wr.RadioField.fit(room.scene, simulated(room))),
    "rf3dgs+": lambda room: images(room, harmonic(room)),
}
"""What is measured; ``bistatic`` is of given materials, with light of several bounces."""


def total_change_db(now: np.ndarray, before: np.ndarray) -> float:
    """Largest change of a receiver's total path gain [dB]."""
    return float(np.abs(10.0 * np.log10(now.sum(axis=(1, 2)) / before.sum(axis=(1, 2)))).max())


def rms_change_db(now: np.ndarray, before: np.ndarray) -> float:
    """Rms change of dB images, 60 dB deep."""
    floor = 1e-6 * max(now.max(), before.max())
    return float(np.sqrt(np.mean((10.0 * np.log10((now + floor) / (before + floor))) ** 2)))


def most_db(figure: str, law: str) -> float:
    """How much a law may change a figure's totals [dB]: place, winding, order and copies nothing but what rays that graze
    an edge do; micrometres, little; a mesh's error is not roughness."""
    rigid = {"mirrors": 1e-9, "exact": 0.01}.get(figure, 0.1)
    return 1.0 if law in ("noise of 1e-4 m", "noise of 1e-3 m") else 0.1 if law in ROUNDED else rigid
