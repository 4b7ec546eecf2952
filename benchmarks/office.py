"""A field of an office of two rooms, behind its glass and its plasterboard: truth is Sionna RT's with refraction.

The room is 8 x 6 x 3 m. Single sheets part it at x = 5 m: plasterboard 25 mm thick with an open door, from y = 2.4 m on glass
of 10 mm. Permittivities are of ITU-R P.2040, scattering coefficients are assumed. The transmitter hangs in the larger
room, the open one; receivers in the other one are behind the walls unless they see it through the door.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import Fits, experiment, fit_seconds
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.em.materials import Material, itu_material
from warprrf.rf.spectra.spectrum import to_db

HELP = """\
Simulates spectra at places of both rooms with Sionna RT, refraction on, fits a field to some of them, and scores others in the
open room and behind the walls apart. Spectra are kept; scene and materials are made in code. Needs the extra sionna.

examples:
  python -m benchmarks office
  python -m benchmarks office --carriers-ghz 28 --counts 10      a first look
"""
Corner = tuple[float, float, float]
SIZE, SHEET_X = (8.0, 6.0, 3.0), 5.0
TRANSMITTER = (1.0, 5.2, 2.6)
MATERIALS = {
    "concrete": (0.2, 0.4), "ceiling_board": (0.02, 0.4), "brick": (0.2, 0.4), "plasterboard": (0.025, 0.4), "glass": (0.01, 0.1),
    "wood": (0.03, 0.4), "chipboard": (0.03, 0.4),
}  # fmt: skip
"""Thickness [m] and scattering coefficient by P.2040's names."""
SHELL = ("brick", "brick", "brick", "brick", "concrete", "ceiling_board")
SHEETS = (
    ("plasterboard", (0.0, 0.7), (0.0, 3.0)), ("plasterboard", (0.7, 1.6), (2.1, 3.0)), ("plasterboard", (1.6, 2.4), (0.0, 3.0)),
    ("glass", (2.4, 6.0), (0.0, 3.0)),
)  # fmt: skip
"""Between the rooms: from where to where in y and z [m]; there is a door from 0.7 to 1.6 m."""
FURNITURE: tuple[tuple[str, Corner, Corner], ...] = (
    ("wood", (1.4, 3.0, 0.7), (3.0, 3.8, 0.74)), ("wood", (6.2, 3.6, 0.7), (7.6, 4.4, 0.74)),
    ("chipboard", (2.6, 0.02, 0.01), (3.8, 0.45, 1.9)), ("chipboard", (7.5, 0.6, 0.01), (7.98, 1.8, 1.2)),
)  # fmt: skip
"""Desks and cabinets: two corners of each [m]."""
DRAWN = 400  # places, of which training and test receivers are the first
COLUMNS = {
    "rows": (
        ("carrier_ghz", "carrier [GHz]", "{:g}"), ("n_train", "spectra", "{}"), ("room", "room", "{}"), ("test", "receivers", "{}"),
        ("psnr_db", "PSNR [dB]", "{:.2f}"), ("perfect_db", "of a model without error", "{:.1f}"),
        ("total_rms_db", "total gain, rms [dB]", "{:.2f}"), ("direction_within_3deg", "strongest within 3 degrees", "{:.0%}"),
        ("fit_s", "fit [s]", "{:.0f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the office.

    Attributes:
        carriers_ghz: carriers.
        counts: training receivers, of both rooms.
        tests: test receivers in either room.
        samples: rays of Sionna RT's.
    """

    carriers_ghz: tuple[float, ...] = option((28.0, 140.0), "carriers [GHz]")
    counts: tuple[int, ...] = option((10, 50), "training receivers of both rooms")
    tests: int = option(15, "test receivers in either room")
    samples: int = option(2_000_000, "rays of Sionna RT's")

    @property
    def inputs(self) -> list[Any]:
        """What every row depends on."""
        return [self.tests, self.samples]


def office() -> wr.Scene:
    """The scene: a shell seen from within, the sheets between the rooms, closed furniture."""
    names = list(MATERIALS)
    quads = [(name, side) for name, side in zip(SHELL, box_sides((0, 0, 0), SIZE), strict=True)]
    for name, (left, right), (low, high) in SHEETS:
        ends = [(left, low), (right, low), (right, high), (left, high)]
        quads.append((name, np.array([(SHEET_X, y, z) for y, z in ends])))
    for name, *corners in FURNITURE:
        quads += [(name, side[::-1]) for side in box_sides(*corners)]
    of_face = np.repeat([names.index(name) for name, _ in quads], 2)
    mesh = quads_mesh(np.stack([corners for _, corners in quads]))
    return wr.Scene(
        mesh, [material(name) for name in names], of_face, face_object=of_face, object_names=names
    )


def quads_mesh(corners: np.ndarray) -> wr.Mesh:
    """A mesh of rectangles, corners ``(N, 4, 3)`` [m]."""
    faces = (4 * np.arange(len(corners))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return wr.Mesh(corners.reshape(-1, 3), faces)


def box_sides(low: Corner, high: Corner) -> np.ndarray:
    """Corners of the sides of a box, wound inward, across x, y and z, shape ``(6, 4, 3)``."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners = np.array(low) + corners * np.subtract(high, low)
    return corners[[(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]]


def material(name: str) -> Material:
    """One of :data:`MATERIALS`."""
    thickness, scattering = MATERIALS[name]
    known = itu_material(name, thickness_m=thickness, scattering=scattering)
    return replace(known.extrapolated(), name=name)


class Office:
    """The scene at one carrier, and what Sionna RT finds in it; kept."""

    def __init__(self, options: Options, fits: Fits, carrier_ghz: float) -> None:
        self.options, self.fits, self.carrier_ghz, self.scene = options, fits, carrier_ghz, office()
        drawn = np.round(wr.sample_receivers(self.scene, DRAWN, z=(0.8, 1.8), seed=fits.job.seed), 3)
        train, rest = drawn[: max(options.counts)], drawn[max(options.counts) :]
        seen = self.scene.mesh.visible(rest, np.broadcast_to(TRANSMITTER, rest.shape))
        rooms = rest[:, 0] < SHEET_X, (rest[:, 0] > SHEET_X) & ~seen
        tests = [rest[room][: options.tests] for room in rooms]
        data, self.seconds, self.file = self.truth("truth", np.concatenate([train, *tests]), seed=1)
        self.train = data.subset(np.arange(len(train)))
        test = data.subset(np.arange(len(train), len(data)))
        self.rooms = {"open": test.subset(test.receivers[:, 0] < SHEET_X)}
        self.rooms["behind the walls"] = test.subset(test.receivers[:, 0] > SHEET_X)

    def truth(self, name: str, places: np.ndarray, seed: int) -> tuple[wr.SpectrumDataset, float, Path]:
        """Spectra at ``places``, the seconds that they took, and their file."""
        name = f"{name}-{self.carrier_ghz:g}"
        file = self.fits.steps.folder / f"{name}.nc"

        def make(attempt: Any) -> Row:
            start = time.perf_counter()
            wr.simulate(
                self.scene, transmitter=TRANSMITTER, receivers=places, frequency_hz=1e9 * self.carrier_ghz, engine="sionna",
                depth=3, samples=self.options.samples, refraction=True, seed=seed, workspace=attempt.folder / "receivers",
                progress=attempt.progress,
            ).save(file)  # fmt: skip
            return {"seconds": time.perf_counter() - start}

        scene = [self.scene.mesh.triangles, self.scene.face_material, *map(repr, self.scene.materials)]
        inputs = [*scene, [*TRANSMITTER], places, self.carrier_ghz, self.options.samples, seed]
        spent = self.fits.steps.run(name, make, version=1, inputs=inputs, outputs=[file.name])
        return wr.SpectrumDataset.load(file), spent["seconds"], file

    def perfect_db(self, room: str) -> float:
        """PSNR of a model without error: that of truth to itself with other rays, less the half of it that is theirs."""
        data = self.rooms[room]
        again = self.truth(f"again-{room.split()[0]}", data.receivers, seed=2)[0].path_gain
        (low, high), found = data.range_db, []
        for pair in zip(data.path_gain, again, strict=True):
            first, second = (np.clip((to_db(one, data.floor) - low) / (high - low), 0.0, 1.0) for one in pair)
            found.append(-10.0 * np.log10(np.mean((first - second) ** 2) / 2.0))
        return float(np.mean(found))

    def scored(self, count: int) -> Row:
        """Figures of a field fitted to ``count`` spectra, by room."""
        field = self.fits.fit(self.scene, self.train.subset(np.arange(count)))
        spent = {"fit_s": fit_seconds(field)}
        return {room: {**self.fits.score(field, test), **spent} for room, test in self.rooms.items()}


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each carrier, number of spectra and room."""
    for carrier in options.carriers_ghz:
        place = Office(options, fits, carrier)
        about = {"carrier_ghz": carrier, "truth_s": place.seconds}
        perfect = {room: place.perfect_db(room) for room in place.rooms}
        for count in options.counts:
            found = fits.row(f"{carrier:g} GHz {count}", partial(place.scored, count), place.file)
            for room in place.rooms:
                own = {"n_train": count, "room": room, "perfect_db": perfect[room]}
                yield {**about, **own, **found[room]}


ABOUT = "An office of two rooms parted by glass and plasterboard; Sionna RT's spectra with refraction, unseen receivers."
BENCHMARKS = {"office": experiment("office", Options, rows, COLUMNS, ABOUT, HELP)}
