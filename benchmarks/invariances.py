"""Invariances as laws: what a scene is written like must not change what it does, on rooms that no tolerance was made on.

A law changes a room's description, not the room: where it stands, how it is turned, its unit (with the wavelength's),
winding, order, cut and copies of faces, rounding and noise of vertices. Each is measured for mirror paths, exact
spectra and both kinds of field: the largest change of total path gain over the receivers [dB], and the rms change of the
dB image over 60 dB where that is not turned. Noise goes through all decades, so that a cliff would show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import warprrf as wr
from benchmarks.data import DATA
from benchmarks.report import Report, cell, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.materials import Terms

SHAPE = (18, 36)
BEAM_RAD = np.deg2rad(6.0)
ALL_TERMS = Terms(mirror_order=2, mirror_scatter=True, scatter_mirror=True, diffuse_order=3)


@dataclass(frozen=True)
class Room:
    """A scene with places in it.

    Attributes:
        vertices, faces, part: shapes ``(V, 3)`` [m], ``(F, 3)``, ``(F,)``: the material of each face.
        materials: of the parts.
        transmitter, receivers: shapes ``(3,)``, ``(R, 3)`` [m].
        frequency_hz: carrier.
        turned: columns of a spectrum that the room was turned by about z; None if about another axis.
        gaussians: on its surfaces.
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

    @property
    def mesh(self) -> wr.Mesh:
        """Its surfaces."""
        return wr.Mesh(self.vertices, self.faces)

    @property
    def scene(self) -> wr.Scene:
        """Its surfaces and materials."""
        return wr.Scene(self.mesh, list(self.materials), self.part)


Change = Callable[[Room], Room]


# ---------------------------------------------------------------------------------------------------- rooms


def materials() -> tuple[wr.Material, ...]:
    """Plaster, wood and a conductor, of 0.1 m."""
    return (
        wr.Material.custom("plaster", relative_permittivity=2.7, conductivity=0.5, scattering=0.6),
        wr.Material.custom("wood", relative_permittivity=2.0, conductivity=1.5, scattering=0.8),
        wr.Material.conductor(scattering=0.3, pattern="directive", alpha_r=10),
    )


def prism(
    outline: np.ndarray, low: float, high: float, caps: list[tuple[int, int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """An upright prism over an outline (N, 2) that turns left, normals outward; ``caps`` are the floor's triangles."""
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (low, high)])
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
    parts = [
        prism(walls, 0.0, 2.9, [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]),
        prism(pillar, 0.0, 2.9, [(0, k, k + 1) for k in range(1, 5)]),
        prism(desk, 0.0, 0.75, [(0, 1, 2), (0, 2, 3)]),
    ]
    parts[0] = parts[0][0], parts[0][1][:, ::-1]  # the room is seen from within
    start = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    return Room(
        np.concatenate([v for v, _ in parts]), np.concatenate([f + s for (_, f), s in zip(parts, start, strict=True)]),
        np.repeat(np.arange(3), [len(f) for _, f in parts]), materials(), np.array([1.2, 1.1, 2.3]),
        np.array([[6.9, 2.4, 1.3], [3.1, 5.6, 1.1], [3.0, 1.0, 1.7]]),
    )  # fmt: skip


def lobby() -> Room:
    """The lobby's true mesh, and three places of its data set."""
    scene, ds = wr.Scene.load(f"{DATA}/scene.xml"), wr.SpectrumDataset.load(f"{DATA}/spectra.nc")
    return Room(
        scene.mesh.vertices, scene.mesh.faces, scene.face_material, tuple(scene.materials), np.array(ds.transmitter),
        np.array(ds.receivers[:3]), float(ds.frequency_hz),
    )  # fmt: skip


ROOMS = {"l-shaped": l_shaped, "lobby": lobby}


# ----------------------------------------------------------------------------------------------------- laws


def _moved(room: Room, rotation: Rotation, factor: float, shift: np.ndarray) -> Room:
    """Everything turned, then scaled, then shifted."""

    def place(points: np.ndarray) -> np.ndarray:
        return np.asarray(factor * (np.asarray(points, float) @ rotation.as_matrix().T) + shift)

    g = room.gaussians
    if g is not None:
        turn = (rotation * Rotation.from_quat(np.array(g.quaternions[:, [1, 2, 3, 0]]))).as_quat()[
            :, [3, 0, 1, 2]
        ]
        g = wr.Gaussians(place(g.means), turn, factor * g.scales, g.opacities, g.sh)
    return replace(
        room, vertices=place(room.vertices), transmitter=place(room.transmitter), receivers=place(room.receivers),
        gaussians=g,
    )  # fmt: skip


def shifted(*metres: float) -> Change:
    """Somewhere else."""
    return lambda room: _moved(room, Rotation.identity(), 1.0, np.array(metres))


def turned(columns: int) -> Change:
    """Turned about z by whole columns of a spectrum."""
    rotation = Rotation.from_euler("z", columns * 2.0 * np.pi / SHAPE[1])
    return lambda room: replace(_moved(room, rotation, 1.0, np.zeros(3)), turned=columns)


def turned_askew(room: Room) -> Room:
    """Turned about an axis that is none of the world's."""
    return replace(_moved(room, Rotation.from_rotvec([0.4, -0.7, 0.9]), 1.0, np.zeros(3)), turned=None)


def scaled(factor: float) -> Change:
    """As large by ``factor``, the wavelength too, and materials that are the same in wavelengths: another unit."""

    def change(room: Room) -> Room:
        f = room.frequency_hz
        same = [
            wr.Material.custom(
                m.name, relative_permittivity=m.relative_permittivity(f), conductivity=m.conductivity(f) / factor,
                thickness_m=m.thickness_m * factor, scattering=m.scattering_coefficient(f), pattern=m.pattern,
                alpha_r=m.alpha_r,
            )
            for m in room.materials
        ]  # fmt: skip
        larger = _moved(room, Rotation.identity(), factor, np.zeros(3))
        return replace(larger, frequency_hz=f / factor, materials=tuple(same))

    return change


def in_another_order(room: Room) -> Room:
    """Faces and Gaussians in another order, corners too."""
    rng, g = np.random.default_rng(1), room.gaussians
    order = rng.permutation(len(room.faces))
    if g is not None:
        k = rng.permutation(len(g.means))
        g = wr.Gaussians(g.means[k], g.quaternions[k], g.scales[k], g.opacities[k], g.sh[k])
    return replace(room, faces=np.roll(room.faces[order], 1, axis=1), part=room.part[order], gaussians=g)


def reversed_winding(room: Room) -> Room:
    """Every face wound the other way."""
    return replace(room, faces=room.faces[:, ::-1])


def mixed_winding(room: Room) -> Room:
    """Every other face, by chance, wound the other way."""
    some = np.random.default_rng(3).random(len(room.faces)) < 0.5
    return replace(room, faces=np.where(some[:, None], room.faces[:, ::-1], room.faces))


def unwelded(room: Room) -> Room:
    """Three vertices of its own for each face."""
    corners = room.vertices[room.faces].reshape(-1, 3)
    return replace(room, vertices=corners, faces=np.arange(len(corners)).reshape(-1, 3))


def _with(room: Room, copy: Room) -> Room:
    """Both rooms' faces in one mesh."""
    return replace(
        room, vertices=np.concatenate([room.vertices, copy.vertices]),
        faces=np.concatenate([room.faces, copy.faces + len(room.vertices)]), part=np.concatenate([room.part, copy.part]),
    )  # fmt: skip


def doubled(room: Room) -> Room:
    """Every face with both windings, a common export."""
    return _with(room, reversed_winding(room))


def doubled_of_another_material(room: Room) -> Room:
    """Every face again, of another material: the first counts."""
    copy = reversed_winding(room)
    return _with(room, replace(copy, part=(room.part + 1) % len(room.materials)))


def covered(room: Room) -> Room:
    """Every face again, cut into four: coplanar faces that overlap."""
    return _with(room, reversed_winding(subdivided(room)))


def in_two_sheets(metres: float) -> Change:
    """Every face again, so far before or behind it."""

    def change(room: Room) -> Room:
        normal = np.repeat(room.mesh.face_normals, 3, axis=0)
        sheet = reversed_winding(unwelded(room))
        return _with(room, replace(sheet, vertices=sheet.vertices + metres * normal))

    return change


def subdivided(room: Room) -> Room:
    """Every face cut into four at the middles of its edges."""
    corners = room.vertices[room.faces]
    middles = (corners + np.roll(corners, -1, axis=1)) / 2
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = np.moveaxis(middles, 1, 0)
    pieces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])  # (4, 3, F, 3)
    triangles = np.moveaxis(pieces, 2, 0).reshape(-1, 3)
    welded, index = np.unique(np.round(triangles, 9), axis=0, return_inverse=True)
    return replace(room, vertices=welded, faces=index.reshape(-1, 3), part=np.repeat(room.part, 4))


def with_faces_without_area(room: Room) -> Room:
    """Faces with two equal corners, and with all three on a line."""
    face = room.faces[np.random.default_rng(4).integers(0, len(room.faces), 10)]
    middle = room.vertices[face[:, :2]].mean(axis=1)
    points = np.column_stack([face[:, 0], face[:, 1], face[:, 0]])
    lines = np.column_stack([face[:, 0], len(room.vertices) + np.arange(10), face[:, 1]])
    nothing = np.zeros(10, room.part.dtype)
    return replace(
        room, vertices=np.concatenate([room.vertices, middle]), faces=np.concatenate([points, room.faces, lines]),
        part=np.concatenate([nothing, room.part, nothing]),
    )  # fmt: skip


def in_float32(room: Room) -> Room:
    """Vertices rounded to single precision."""
    return replace(room, vertices=room.vertices.astype(np.float32).astype(float))


def turned_four_times_in_float32(room: Room) -> Room:
    """Four quarter turns about the vertical axis, computed in float32 as exporters do."""
    finer = subdivided(room)
    angle = np.float32(np.pi / 2)
    c, s = np.cos(angle), np.sin(angle)  # c is -4e-8
    v = finer.vertices.astype(np.float32)
    for _ in range(4):
        v = v @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    return replace(finer, vertices=v.astype(float))


def noisy(metres: float) -> Change:
    """Subdivided twice, and every vertex off by a normal error."""

    def change(room: Room) -> Room:
        fine = subdivided(subdivided(room))
        return replace(
            fine, vertices=fine.vertices + np.random.default_rng(0).normal(0, metres, fine.vertices.shape)
        )

    return change


LAWS: dict[str, Change] = {
    "shifted by metres": shifted(3.1234567, -2.7654321, 0.987654),
    "shifted by 1e3 m": shifted(1e3, -2e3, 5e2),
    "shifted by 1e6 m": shifted(1e6, -2e6, 3e5),
    "turned by a quarter": turned(9),
    "turned by five columns": turned(5),
    "turned askew": turned_askew,
    "scaled by 2": scaled(2.0),
    "scaled by 0.1": scaled(0.1),
    "in another order": in_another_order,
    "reversed winding": reversed_winding,
    "mixed winding": mixed_winding,
    "unwelded": unwelded,
    "doubled": doubled,
    "doubled, of another material": doubled_of_another_material,
    "covered by finer faces": covered,
    "in two sheets 1e-6 m apart": in_two_sheets(1e-6),
    "in two sheets 1e-5 m apart": in_two_sheets(1e-5),
    "in two sheets 1e-4 m apart": in_two_sheets(1e-4),
    "subdivided": subdivided,
    "with faces without area": with_faces_without_area,
    "in float32": in_float32,
    "turned four times in float32": turned_four_times_in_float32,
    **{f"noise of 1e{k} m": noisy(10.0**k) for k in range(-8, -1)},
}
"""What must not change a room: rounding and noise beyond what they are, the rest at all."""


# -------------------------------------------------------------------------------------------------- figures


def mirrors(room: Room, order: int = 2) -> np.ndarray:
    """Power of each receiver's line of sight and mirror paths, shape ``(R, 1, 1)``."""
    paths = wr.trace_paths(
        room.scene, transmitter=room.transmitter, receivers=room.receivers, frequency_hz=room.frequency_hz,
        mirror_order=order,
    )  # fmt: skip
    return np.asarray(np.where(paths.valid, np.abs(paths.gain) ** 2, 0.0).sum(axis=1)[:, None, None])


def simulated(room: Room) -> wr.SpectrumDataset:
    """Its spectra by the exact engine."""
    return wr.simulate(
        room.scene, transmitter=room.transmitter, receivers=room.receivers, frequency_hz=room.frequency_hz, shape=SHAPE,
        beam_sigma_rad=BEAM_RAD,
    )  # fmt: skip


def unturned(room: Room, images: Any) -> np.ndarray:
    """Images (R, H, W) as the room stood before."""
    return np.roll(np.asarray(images, float), -(room.turned or 0), axis=2)


def exact(room: Room) -> np.ndarray:
    """Exact spectra, shape ``(R, H, W)``."""
    return unturned(room, simulated(room).path_gain)


def bistatic(room: Room) -> np.ndarray:
    """Spectra of a bistatic field of given materials, light of several bounces included."""
    field = BistaticField.prior(room.scene, simulated(room), terms=ALL_TERMS)
    return unturned(room, np.stack([field.spectrum(rx).path_gain for rx in room.receivers]))


def fitted(room: Room) -> np.ndarray:
    """Spectra of a bistatic field that was fitted to the room's exact ones."""
    field = wr.RadioField.fit(room.scene, simulated(room))
    return unturned(room, np.stack([field.spectrum(rx).path_gain for rx in room.receivers]))


def harmonic(room: Room) -> np.ndarray:
    """Spectra of an RF-3DGS+ field on the room's Gaussians that was fitted to the room's exact ones."""
    if room.gaussians is None:
        raise ValueError("room: it has no Gaussians, expected some on its surfaces")
    field = wr.RadioField.fit(
        wr.Reconstruction(room.gaussians, room.mesh), simulated(room), model="rf3dgs+", iterations=40,
        interaction_point="mesh", line_of_sight="explicit",
    )  # fmt: skip
    return unturned(room, np.stack([field.spectrum(rx).path_gain for rx in room.receivers]))


FIGURES: dict[str, Callable[[Room], np.ndarray]] = {
    "mirrors": mirrors, "exact": exact, "bistatic": bistatic, "bistatic, fitted": fitted, "rf3dgs+": harmonic,
}  # fmt: skip


def with_gaussians(room: Room, count: int = 1500) -> Room:
    """The room with discs on its surfaces."""
    return replace(room, gaussians=discs_on_mesh(room.mesh, count))


def total_change_db(now: np.ndarray, before: np.ndarray) -> float:
    """Largest change of a receiver's total path gain [dB]."""
    return float(np.abs(10.0 * np.log10(now.sum(axis=(1, 2)) / before.sum(axis=(1, 2)))).max())


def rms_change_db(now: np.ndarray, before: np.ndarray, depth_db: float = 60.0) -> float:
    """Rms change of dB images, ``depth_db`` deep."""
    floor = max(now.max(), before.max()) * 10 ** (-depth_db / 10)
    return float(np.sqrt(np.mean((10.0 * np.log10((now + floor) / (before + floor))) ** 2)))


# ----------------------------------------------------------------------------------------------------- run


@dataclass(frozen=True)
class Options:
    """Options of the sweep."""

    rooms: tuple[str, ...] = option(tuple(ROOMS), "rooms", choices=tuple(ROOMS))
    figures: tuple[str, ...] = option(tuple(FIGURES), "what is measured", choices=tuple(FIGURES))
    laws: tuple[str, ...] = option(tuple(LAWS), "laws", choices=tuple(LAWS))


def run(options: Options, job: Job) -> Report:
    """Every law for every figure in every room."""
    rows, lines = [], []
    for name in options.rooms:
        room = with_gaussians(ROOMS[name]())
        before = {figure: FIGURES[figure](room) for figure in options.figures}
        for k, law in enumerate(options.laws):
            changed = LAWS[law](room)
            line = [name, law]
            for figure in options.figures:
                now = FIGURES[figure](changed)
                total, rms = total_change_db(now, before[figure]), None
                if changed.turned is not None and figure != "mirrors":
                    rms = rms_change_db(now, before[figure])
                rows.append({"room": name, "law": law, "figure": figure, "total_db": total, "rms_db": rms})
                line.append(f"{total:.1e} / {cell(rms, '{:.1e}')}" if figure != "mirrors" else f"{total:.1e}")
            lines.append(line)
            job.progress(name, k + 1, len(options.laws))
    text = (
        "Largest change of total path gain [dB] / rms change of the dB image over 60 dB.\n\n"
        + table(("room", "law", *options.figures), lines)
    )  # fmt: skip
    return Report("invariances", {"rows": rows}, text)


HELP = """\
What a room's description must not change: place, orientation, unit, winding, order, cut and copies of faces, rounding
and noise of vertices; for mirror paths, exact spectra and both kinds of field, on a room of slanted walls and the lobby.

examples:
  python -m benchmarks invariances --rooms l-shaped
  python -m benchmarks invariances --figures mirrors exact --laws subdivided "noise of 1e-5 m"
"""

BENCHMARKS = {"invariances": Benchmark("invariances", Options, run, HELP)}
