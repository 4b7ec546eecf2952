"""A furnished flat at 2.4 GHz: Bluetooth power from six anchors at a tag that a robot carried about.

Measured by M. Kolakowski (Sensors 21, 6270, 2021; doi 10.5281/zenodo.5457591, CC BY 4.0): 4104 readings of each anchor, the
outline of the rooms' air, the anchors' places. Guessed: the ceiling's height, what the walls are made of and how thick the
outer ones are, and that nothing else stands there. Antennas' patterns, gains and the person who drove are not known.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.measured.links import Links, Place, crossings, mean_db, noise_db
from warprrf.rf.em.materials import itu_material

FREQUENCY_HZ = 2.44e9
CEILING_M, TAG_M = 2.7, 1.3  # guessed; stated
CELL_M = 0.5  # of a cell, several wavelengths
FEWEST, HEARD = (
    8,
    0.5,
)  # readings of a mean, and the share of them that must have been heard: else it is of the strong ones
FLOOR_DBM = -100.0
MATERIALS = {
    "thin wall": ("brick", 0.115),
    "thick wall": ("brick", 0.18),
    "outer wall": ("brick", 0.3),
    "slab": ("concrete", 0.2),
}
"""What is guessed of walls and of floor and ceiling: P.2040's name, thickness [m]; those of inner walls are the outline's gaps."""
OUTER = ((0, 0), (6.22, 0), (6.22, 2.12), (6.27, 2.12), (6.27, 4.19), (9.07, 4.19), (9.07, 7.1), (0, 7.1))
INNER = {
    "thin wall": (
        (2.64, 2.125, 2.64, 7.1), (0, 2.125, 0.73, 2.125), (1.52, 2.125, 2.64, 2.125), (1.985, 0, 1.985, 0.64),
        (6.32, 4.19, 6.32, 4.82), (1.61, 1.74, 2.05, 1.74), (1.61, 1.74, 1.61, 2.125), (2.05, 1.74, 2.05, 2.125),
    ),
    "thick wall": ((3.965, 0, 3.965, 0.6), (3.965, 1.42, 3.965, 2.025), (3.965, 2.025, 6.22, 2.025)),
}  # fmt: skip
"""Walls between rooms as sheets at the middle of the outline's gaps: x, y of both ends [m]; the last three thin ones are a duct."""
ROOMS = {
    "hall": (0, 0, 3.965, 2.1),
    "bathroom": (3.965, 0, 6.22, 2.0),
    "bedroom": (0, 2.1, 2.64, 7.1),
    "kitchen": (6.32, 4.19, 9.07, 7.1),
}
"""Lower and upper corner of each [m]; the rest is the living room. Names are guessed."""

EVERY = wr.Effects(mirrors=2, scatter_mirror=False)
FIELDS = {
    "field": EVERY, "field, without diffraction": replace(EVERY, diffractions=0),
    "field, without either": replace(EVERY, transmissions=0, diffractions=0),
}  # fmt: skip


def scene() -> wr.Scene:
    """The flat: walls as sheets, a floor and a ceiling."""
    names, parts = list(MATERIALS), []
    ends = [*zip(OUTER, [*OUTER[1:], OUTER[0]], strict=True)]
    upright = {"outer wall": [(*a, *b) for a, b in ends], **INNER}
    for name, walls in upright.items():
        for a, b, c, d in walls:
            parts.append((name, [(a, b, 0), (c, d, 0), (c, d, CEILING_M), (a, b, CEILING_M)]))
    for z in (0.0, CEILING_M):  # the outline's three parts
        for a, b, c, d in ((0, 0, 6.22, 2.12), (0, 2.12, 6.27, 7.1), (6.27, 4.19, 9.07, 7.1)):
            parts.append(("slab", [(a, b, z), (c, b, z), (c, d, z), (a, d, z)]))
    faces = (4 * np.arange(len(parts))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    mesh = wr.Mesh(np.concatenate([corners for _, corners in parts]).astype(float), faces)
    of_face = np.repeat([names.index(name) for name, _ in parts], 2)
    materials = [itu_material(itu, name=name, thickness_m=thick) for name, (itu, thick) in MATERIALS.items()]
    return wr.Scene(mesh, materials, of_face, face_object=of_face, object_names=names)


def place(folder: Path, seed: int) -> Place:
    """The flat as measured; ``seed`` is of the halves from whose difference the noise of means is known.

    Raises:
        FileNotFoundError, ValueError: naming the file that does not fit.
    """
    found, readings = links(folder)
    parts = {"all": np.ones(len(found), bool), "behind walls": found.behind, "in sight": ~found.behind}
    noise: dict[str, Any] = {"cells": len(np.unique(found.cell)), "links": len(found)} | {
        name: {"links": int(part.sum())} | noise_db([readings[k] for k in np.flatnonzero(part)], seed)
        for name, part in parts.items()
    }
    every, behind, flat = noise["all"], noise["behind walls"], scene()
    said = (
        f"{noise['links']} means of {noise['cells']} cells, {behind['links']} of them behind walls. Noise of a mean, from "
        f"halves in the order of time: {every['halves_by_time']:.2f} dB, behind walls {behind['halves_by_time']:.2f} dB; from "
        f"halves by chance: {every['halves_by_chance']:.2f} dB. A single reading scatters by {every['single_reading']:.2f} dB."
    )
    traced: dict[str, tuple[wr.Scene, Mapping[str, Any]]] = {
        "traced": (flat, {"mirror_order": 2, "transmissions": 3, "diffractions": 1}),
        "traced, without either": (flat, {"mirror_order": 2}),
    }
    return Place(
        str(__doc__).split("\n")[0], (folder,), found, FREQUENCY_HZ, FLOOR_DBM, FEWEST, ("anchor", "room"),
        traced, {name: (flat, effects) for name, effects in FIELDS.items()}, noise, said,
    )  # fmt: skip


def links(folder: Path) -> tuple[Links, list[np.ndarray]]:
    """Means over cells that lie clear of the walls, and the readings of each in the order of time [dBm]."""
    at, read = table(folder / "anchors.csv"), table(folder / "calibration_df.csv")
    anchors = np.column_stack([at[axis] for axis in "xyz"])
    spots = np.column_stack([read["x"], read["y"], np.full(len(read["x"]), TAG_M)])[np.argsort(read["ts"])]
    level = np.column_stack([read[f"rssi_{k + 1}"] for k in range(len(anchors))])[np.argsort(read["ts"])]
    cells, own = np.unique(np.floor(spots[:, :2] / CELL_M), axis=0, return_inverse=True)
    centre = np.stack([spots[own.reshape(-1) == c].mean(axis=0) for c in range(len(cells))])
    readings, rows = [], []
    for c in np.flatnonzero(scene().is_free(centre, clearance_m=0.15)):
        for k in range(len(anchors)):
            values = level[own.reshape(-1) == c, k]
            heard = values[np.isfinite(values)]
            if len(heard) >= max(FEWEST, HEARD * len(values)):
                readings.append(heard)
                rows.append((k, c))
    anchor, cell = np.array(rows).T
    flat = scene()
    walls = crossings(flat, anchors[anchor], centre[cell], flat.face_material)[:, : len(MATERIALS) - 1]
    room = np.array([_room(*place[:2]) for place in centre[cell]])
    return Links(
        anchors[anchor],
        centre[cell],
        np.array([mean_db(one) for one in readings]),
        anchor + 1,
        cell,
        room,
        walls,
    ), readings


def _room(x: float, y: float) -> str:
    inside = (name for name, (a, b, c, d) in ROOMS.items() if a <= x < c and b <= y < d)
    return next(inside, "living room")


def table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name; empty cells are NaN."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0] if name}
