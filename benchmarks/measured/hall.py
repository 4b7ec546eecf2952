"""A university's hall at 60 GHz: pairs of beams between a fixed transmitter and 45 places of a receiver along a walk.

Measured in Tampere in 2023 over 400 MHz (Rastorgueva-Foi et al., IEEE JSAC 2024, arXiv 2312.13741; Kaltiokallio et al., arXiv
2404.10291). Known: where the ends are, the plan in the same frame, and of each path that its authors extracted the length, the
azimuths of departure and arrival, and the power that the best pair of beams received. Guessed: heights, materials, that what the
plan draws dashed is no wall, and that beams are Gaussian and as wide as line of sight looks. Transmitted power and the gains
of the antennas are not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import warprrf as wr
from benchmarks.measured import beams
from benchmarks.measured.beams import Rays, Walk, apart, level, turn
from benchmarks.measured.links import Links, Place, crossings, db
from benchmarks.report import Row, columns_table
from benchmarks.runner import Job
from warprrf.rf.em.materials import itu_material
from warprrf.steps import Steps, digest

FREQUENCY_HZ = 60e9
PATHS, PLAN = Path("Kampusareena_slam_measurements_svd_p999.mat"), Path("kampusarena_map.fig")
TRANSMITTER = (2.25, 2.5)  # [m], as in the file
TURN_RAD = np.radians(-1.6)  # of the transmitter on its mount, as its authors calibrated it
FLOOR_DB = -53.0  # noise in every power, in the file's unit: no path is weaker
HEIGHT_M, CEILING_M = 1.5, 5.0  # of antennas and ceiling, guessed
REACH_M = 20.0  # of walls and columns from the transmitter
TWICE_M, SHORTEST_M = 0.03, 0.25  # apart: the same line, drawn again; shorter: no wall
COLUMN_M, SIDES = (0.3, 0.6), 12  # across a column; its sides in the scene
CASE = ((4.72, -1.02), (5.71, -1.02), (5.71, 0.0), (4.72, 0.0))
"""Corners of what only the picture of the plan beside the paths shows [m]."""
MATERIALS = {
    "wall": ("plasterboard", 0.0125), "column": ("concrete", 0.4), "case": ("metal", 0.001), "slab": ("concrete", 0.2),
}  # fmt: skip
"""What is guessed of each group: P.2040's name, thickness [m]. A wall is two sheets where the plan draws two lines."""
SHEETS = ("wall", "column", "case")
BLOCK = 9  # receivers one after the other that are held out together: 4.5 m of the walk
FADING = 5  # independent samples in a power, guessed: several paths, each of a narrow beam
EFFECTS = wr.Effects(
    mirrors=2, scatterings=1, mirror_scatter=False, scatter_mirror=False, transmissions=4, diffractions=0
)
NOISE = (
    ("part", "links", "{}"), ("links", "number", "{}"), ("found", "line of sight found", "{}"),
    ("length_m", "length error [m]", "{:+.3f}"), ("length_m_spread", "spread", "{:.3f}"),
    ("departure_deg", "departure error [degrees]", "{:+.1f}"), ("departure_deg_spread", "spread", "{:.1f}"),
    ("arrival_deg", "arrival error [degrees]", "{:+.1f}"), ("arrival_deg_spread", "spread", "{:.1f}"),
    ("gain_db", "power over free space, in the file's unit [dB]", "{:.1f}"), ("gain_db_spread", "spread", "{:.2f}"),
)  # fmt: skip
UNFITTED = (
    ("model", "nothing fitted but a gain", "{}"), ("met", "NLOS paths matched", "{:.0%}"), ("met_by_chance", "by chance", "{:.0%}"),
    ("power", "share of NLOS power matched", "{:.0%}"), ("power_by_chance", "by chance", "{:.0%}"),
    ("length_m", "length error [m]", "{:.2f}"),
    ("departure_deg", "departure error [degrees]", "{:.1f}"), ("arrival_deg", "arrival error [degrees]", "{:.1f}"),
    ("level_db", "power error [dB]", "{:.1f}"), ("strongest_db", "power of the strongest pair, rms error [dB]", "{:.1f}"),
)  # fmt: skip
BOUNCES = (
    ("at", "one bounce at", "{}"), ("paths", "NLOS paths", "{}"), ("power", "share of NLOS power", "{:.0%}"),
    ("met", "matched", "{:.0%}"),
)  # fmt: skip
FITTED = (
    ("model", "model", "{}"), ("rms_db", "power of pairs, rms error [dB]", "{:.1f}"), ("sight_db", "line of sight [dB]", "{:.1f}"),
    ("nlos_db", "NLOS [dB]", "{:.1f}"), ("nlos_mean_db", "NLOS, mean error [dB]", "{:+.1f}"),
    ("lit", "empty pairs predicted above noise", "{:.1%}"),
    ("found", "strongest pair found", "{:.0%}"), ("nlos_found", "the same if NLOS", "{:.0%}"),
    ("lost_db", "beam loss, median [dB]", "{:.1f}"),
    ("lost_most_db", "90th percentile [dB]", "{:.1f}"), ("nlos_lost_db", "median if NLOS [dB]", "{:.1f}"),
)  # fmt: skip


def place(folder: Path, seed: int) -> Place:
    """The hall as measured; ``seed`` decides nothing here.

    Raises:
        FileNotFoundError, ValueError: naming the file that is not there or does not fit.
    """
    walk, walls, full = measured(folder), scene(folder, *SHEETS), scene(folder, *MATERIALS)
    count = len(walk.receivers)
    ends = np.tile(walk.transmitter, (count, 1)), walk.receivers
    links = Links(
        *ends, db([one.power.sum() for one in walk.rays]), np.ones(count, int), np.arange(count),
        np.array([f"{k - k % BLOCK + 1} to {k - k % BLOCK + BLOCK}" for k in range(count)]),
        crossings(walls, *ends, walls.face_material),
    )  # fmt: skip
    through = {"mirror_order": 2, "transmissions": EFFECTS.transmissions}
    traced: dict[str, tuple[wr.Scene, Mapping[str, Any]]] = {
        "straight ray in air": (scene(folder, "slab"), {"mirror_order": 0}),
        "traced, one mirror": (walls, {"mirror_order": 1}), "traced, two mirrors": (walls, {"mirror_order": 2}),
        "traced, through walls too": (walls, through), "traced, floor and ceiling too": (full, through),
        "traced, through walls and over edges": (walls, through | {"diffractions": 1}),
        "traced, walls of glass": (scene(folder, *SHEETS, wall=("glass", 0.01)), through),
        "traced, walls of concrete": (scene(folder, *SHEETS, wall=("concrete", 0.2)), through),
    }  # fmt: skip
    fields = {"field": (full, EFFECTS), "field, without scattering": (full, replace(EFFECTS, scatterings=0))}
    noise: list[Row] = [
        {"part": part} | beams.sight(walk, own)
        for part, own in (("in sight", ~links.behind), ("behind walls", links.behind))
    ]
    asked: dict[str, Any] = {"transmitter": walk.transmitter, "receivers": walk.receivers}
    rays = {
        name: Rays.of(wr.trace_paths(seen, **asked, frequency_hz=FREQUENCY_HZ, **options))
        for name, (seen, options) in traced.items()
    }
    levelled = {name: [one.times(noise[0]["gain_db"]) for one in found] for name, found in rays.items()}
    rows = [{"model": name} | beams.compared(walk, found) for name, found in levelled.items()]
    at = beams.bounces(walk, plan(folder), levelled["traced, through walls and over edges"])
    files = folder / PATHS, folder / PLAN

    def pairs(job: Job, steps: Steps) -> tuple[dict[str, Any], str]:
        known, how = digest(*files), {"device": job.device, "progress": job.progress}
        models = {"nearest receiver": (partial(beams.nearest, walk), known)}
        models |= {
            name: (
                partial(beams.straight, walk, found),
                digest(known, *map(repr, (*traced[name][0].materials, traced[name][1]))),
            )
            for name, found in rays.items()
        }
        models |= {
            name: (partial(beams.fitted, walk, seen, effects=effects, **how), digest(known, seen.mesh.triangles, repr(effects)))
            for name, (seen, effects) in fields.items()
        }  # fmt: skip
        found = beams.predicted(walk, models, BLOCK, steps)
        return {"pairs": found}, columns_table(FITTED, found)

    said = "\n\n".join(columns_table(*table) for table in ((NOISE, noise), (UNFITTED, rows), (BOUNCES, at)))
    return Place(
        str(__doc__).split("\n")[0], files, links, FREQUENCY_HZ, FLOOR_DB, FADING, ("block",), traced, fields, {"rows": noise},
        said, {"paths": rows, "bounces": at}, pairs,
    )  # fmt: skip


def measured(folder: Path) -> Walk:
    """The walk of the file in ``folder``.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: naming it, if it does not hold what is needed.
    """
    try:
        held = _load(folder / PATHS)["sim"]
        sent, received, rays = held["tx"].T, held["rx"].T, []
        for paths, power, a, b in zip(held["y"], held["power"], sent, received, strict=True):
            length, departure, arrival = np.reshape(paths, (3, -1))
            turned = level(turn(a[2] + TURN_RAD + departure)), level(turn(b[2] + arrival))
            rays.append(Rays(10.0 ** (np.ravel(power) / 10.0), length, *turned))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{folder / PATHS}: {error!r}: expected sim with tx, rx, y and power") from error
    if not np.allclose(sent[:, :2], TRANSMITTER):
        raise ValueError(f"{folder / PATHS}: got a transmitter at {sent[0, :2]}, expected {TRANSMITTER}")
    places = np.column_stack([received[:, :2], np.full(len(received), HEIGHT_M)])
    return Walk(np.array([*TRANSMITTER, HEIGHT_M]), places, rays, 10.0 ** (FLOOR_DB / 10.0), FREQUENCY_HZ)


def scene(folder: Path, *parts: str, wall: tuple[str, float] = MATERIALS["wall"]) -> wr.Scene:
    """Sheets of ``parts``, of "wall", "column", "case" and "slab" (floor and ceiling), walls of what ``wall`` says."""
    names, quads = list(MATERIALS), []
    drawn = plan(folder)
    for name, lines in drawn.items():
        if name in parts:
            quads += [
                (name, [(*a, 0.0), (*b, 0.0), (*b, CEILING_M), (*a, CEILING_M)]) for a, b in lines.tolist()
            ]
    if "slab" in parts:
        (x, y), (u, v) = drawn["wall"].min(axis=(0, 1)) - 1.0, drawn["wall"].max(axis=(0, 1)) + 1.0
        quads += [("slab", [(x, y, z), (u, y, z), (u, v, z), (x, v, z)]) for z in (0.0, CEILING_M)]
    faces = (4 * np.arange(len(quads))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    mesh = wr.Mesh(np.concatenate([np.array(quad) for _, quad in quads]), faces)
    of_face = np.repeat([names.index(name) for name, _ in quads], 2)
    known = MATERIALS | {"wall": wall}
    materials = [itu_material(itu, name=name, thickness_m=thick) for name, (itu, thick) in known.items()]
    return wr.Scene(mesh, materials, of_face, face_object=of_face, object_names=names)


def plan(folder: Path) -> dict[str, np.ndarray]:
    """Lines of the plan by what they are of, "wall", "column" or "case": both ends [m], shape ``(N, 2, 2)``."""
    lines = _lines(folder)
    corner, end = np.unique(np.round(lines.reshape(-1, 2), 2), axis=0, return_inverse=True)
    end = end.reshape(-1, 2)
    of = connected_components(coo_array((np.ones(len(end)), end.T), shape=(len(corner),) * 2))[1][end[:, 0]]
    columns: dict[tuple[float, ...], np.ndarray] = {}
    for part in np.unique(of):
        own = lines[of == part]
        low, high = own.min(axis=(0, 1)), own.max(axis=(0, 1))
        if (
            len(own) > 8
            and (high - low > COLUMN_M[0]).all()
            and (high - low < COLUMN_M[1]).all()
            and np.ptp(high - low) < TWICE_M
        ):
            angle = np.arange(SIDES) * 2.0 * np.pi / SIDES
            ring = (low + high) / 2 + (high - low) / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
            columns[tuple(np.round((low + high) / 2, 1))] = np.stack(
                [ring, np.roll(ring, -1, axis=0)], axis=1
            )
    walls: list[np.ndarray] = []
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    for line in lines[np.argsort(-length, kind="stable")[: (length >= SHORTEST_M).sum()]]:
        if not walls or (np.maximum(*(apart(np.stack(walls), end) for end in line)) > TWICE_M).all():
            walls.append(line)
    case = np.stack([CASE, np.roll(CASE, -1, axis=0)], axis=1)
    return {"wall": np.stack(walls), "column": np.concatenate(list(columns.values())), "case": case}


def _lines(folder: Path) -> np.ndarray:
    try:
        axes = _load(folder / PLAN)["hgS_070000"]["children"]
        drawn = [item["properties"] for item in axes["children"] if item["type"] == "graph2d.lineseries"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{folder / PLAN}: {error!r}: expected a figure with axes of lines") from error
    solid = [
        np.column_stack([one["XData"], one["YData"]]) for one in drawn if one.get("LineStyle", "-") == "-"
    ]
    lines = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in solid])
    return lines[np.linalg.norm(lines.mean(axis=1) - TRANSMITTER, axis=1) < REACH_M]


def _load(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise FileNotFoundError(
            f"{file}: there is no such file; --source is a folder with {PATHS} (repository github.com/okaltiok/"
            f"Robust-snapshot-radio-SLAM) and {PLAN} (github.com/BaiLiping/radio_SLAM)"
        )
    return dict(loadmat(file, simplify_cells=True))
