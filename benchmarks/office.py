"""A field of an office of two rooms, behind its glass and its plasterboard: truth is Sionna RT's with refraction.

The room is 8 x 6 x 3 m. A single sheet parts it at x = 5 m: plasterboard 25 mm thick, from y = 2.4 m on glass of 10 mm.
There is no door, so that all that arrives beyond it has been through a sheet. Permittivities are of ITU-R P.2040,
scattering coefficients are assumed. The transmitter hangs in the larger room, the open one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import Fits, experiment, fit_seconds
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.em.materials import Material, itu_material

HELP = """\
Simulates spectra at places of both rooms with Sionna RT, refraction on, fits a field to some of them, and scores others in the
open room and behind the walls apart. Spectra are kept; scene and materials are made in code. Needs the extra sionna.

examples:
  python -m benchmarks office
  python -m benchmarks office --carriers-ghz 28 --counts 10      a first look
"""
SIZE, SHEET_X, GLASS_Y = (8.0, 6.0, 3.0), 5.0, 2.4
TRANSMITTER = (1.0, 5.2, 2.6)
SCATTERING = 0.4
MATERIALS = {
    "concrete": {"thickness_m": 0.2}, "ceiling_board": {"thickness_m": 0.02}, "brick": {"thickness_m": 0.2},
    "plasterboard": {"thickness_m": 0.025}, "glass": {"thickness_m": 0.01, "scattering": 0.1}, "wood": {"thickness_m": 0.03},
    "chipboard": {"thickness_m": 0.03},
}  # fmt: skip
FURNITURE = {
    "wood": [((1.4, 3.0, 0.7), (3.0, 3.8, 0.74)), ((6.2, 3.6, 0.7), (7.6, 4.4, 0.74))],
    "chipboard": [((2.6, 0.02, 0.01), (3.8, 0.45, 1.9)), ((7.5, 0.6, 0.01), (7.98, 1.8, 1.2))],
}
"""Desks and cabinets: two corners of each [m]."""
DRAWN = 400  # places, of which training and test receivers are the first
COLUMNS = {
    "rows": (
        ("carrier_ghz", "carrier [GHz]", "{:g}"), ("n_train", "spectra", "{}"), ("room", "room", "{}"), ("test", "receivers", "{}"),
        ("psnr_db", "PSNR [dB]", "{:.2f}"), ("total_rms_db", "total gain, rms [dB]", "{:.2f}"),
        ("direction_within_3deg", "strongest within 3 degrees", "{:.0%}"), ("fit_s", "fit [s]", "{:.0f}"),
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
    tests: int = option(20, "test receivers in either room")
    samples: int = option(500_000, "rays of Sionna RT's")

    @property
    def inputs(self) -> list[Any]:
        """What every row depends on."""
        return [self.tests, self.samples]


def office() -> wr.Scene:
    """The scene."""
    (x, y, z), names, parts = SIZE, list(MATERIALS), []

    def quad(name: str, *corners: tuple[float, float, float]) -> None:
        parts.append((names.index(name), np.array(corners)))

    def box(name: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            for end, across in ((low, (a, b)), (high, (b, a))):
                corner = np.tile(end, (4, 1))
                for k, (one, other) in enumerate(((low, low), (low, high), (high, high), (high, low))):
                    corner[k, across[0]], corner[k, across[1]] = one[across[0]], other[across[1]]
                parts.append((names.index(name), corner))

    quad("concrete", (0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0))
    quad("ceiling_board", (0, 0, z), (0, y, z), (x, y, z), (x, 0, z))
    quad("brick", (0, 0, 0), (0, 0, z), (x, 0, z), (x, 0, 0))
    quad("brick", (0, y, 0), (x, y, 0), (x, y, z), (0, y, z))
    quad("brick", (0, 0, 0), (0, y, 0), (0, y, z), (0, 0, z))
    quad("brick", (x, 0, 0), (x, 0, z), (x, y, z), (x, y, 0))
    for name, low, high in (("plasterboard", 0.0, GLASS_Y), ("glass", GLASS_Y, y)):
        quad(name, (SHEET_X, low, 0), (SHEET_X, high, 0), (SHEET_X, high, z), (SHEET_X, low, z))
    for name, boxes in FURNITURE.items():
        for low, high in boxes:
            box(name, low, high)
    first = 4 * np.arange(len(parts))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    of_face = np.repeat([part for part, _ in parts], 2)
    mesh = wr.Mesh(np.concatenate([corners for _, corners in parts]), faces)
    return wr.Scene(
        mesh, [material(name) for name in names], of_face, face_object=of_face, object_names=names
    )


def material(name: str) -> Material:
    """One of :data:`MATERIALS`."""
    known = itu_material(name, **{"scattering": SCATTERING, **MATERIALS[name]})
    return replace(known.extrapolated(), name=name)


def truth(options: Options, fits: Fits, carrier_ghz: float) -> tuple[wr.SpectrumDataset, float]:
    """Spectra of all receivers, and the seconds that they took; kept."""
    scene, file = office(), fits.steps.folder / f"truth-{carrier_ghz:g}.nc"
    drawn = np.round(wr.sample_receivers(scene, DRAWN, z=(0.8, 1.8), seed=fits.job.seed), 3)
    train, rest = drawn[: max(options.counts)], drawn[max(options.counts) :]
    tests = [rest[(rest[:, 0] > SHEET_X) == behind][: options.tests] for behind in (False, True)]
    places = np.concatenate([train, *tests])
    roles = np.where(np.arange(len(places)) < len(train), "train", "test")

    def make(attempt: Any) -> Row:
        start = time.perf_counter()
        wr.simulate(
            scene, transmitter=TRANSMITTER, receivers=places, frequency_hz=1e9 * carrier_ghz, engine="sionna", depth=3,
            samples=options.samples, refraction=True, seed=1, roles=roles, workspace=attempt.folder / "receivers",
            progress=attempt.progress,
        ).save(file)  # fmt: skip
        return {"truth_s": time.perf_counter() - start}

    what = [scene.mesh.triangles, scene.face_material, *map(repr, scene.materials)]
    inputs = [*what, [*TRANSMITTER], places, carrier_ghz, options.samples]
    spent = fits.steps.run(f"truth-{carrier_ghz:g}", make, version=1, inputs=inputs, outputs=[file.name])
    return wr.SpectrumDataset.load(file), spent["truth_s"]


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each carrier, number of spectra and room."""
    for carrier in options.carriers_ghz:
        data, seconds = truth(options, fits, carrier)
        test = data.split(1)[1]
        rooms = {"open": test.receivers[:, 0] < SHEET_X, "behind the walls": test.receivers[:, 0] > SHEET_X}
        for count in options.counts:
            make = partial(
                _scored, fits, data.split(count)[0], {name: test.subset(m) for name, m in rooms.items()}
            )
            found = fits.row(f"{carrier:g} GHz {count}", make)
            for room in rooms:
                yield {
                    "carrier_ghz": carrier,
                    "n_train": count,
                    "room": room,
                    "truth_s": seconds,
                    **found[room],
                }


def _scored(fits: Fits, train: wr.SpectrumDataset, rooms: dict[str, wr.SpectrumDataset]) -> Row:
    field = fits.fit(office(), train)
    spent = fit_seconds(field)
    return {name: {**fits.score(field, test), "fit_s": spent} for name, test in rooms.items()}


ABOUT = "An office of two rooms parted by glass and plasterboard; Sionna RT's spectra with refraction, unseen receivers."
BENCHMARKS = {"office": experiment("office", Options, rows, COLUMNS, ABOUT, HELP)}
