"""A field in a room that changed: a person walks across a link, a cabinet is moved.

The person is a screen of skin, 0.5 m wide and 1.8 m tall; beside the field stands the finite-width screen of ITU-R P.526: what
arrives over its two sides and its top, each as over a knife edge (Fresnel's integrals), added in power, which is the mean over
their interference. The link is 5 m long, 1.2 m above the floor, at 60 GHz.

The cabinet of the office moves by 2 m. Truth is the exact engine's; the old room's field with the new mesh stands beside one that
was fitted in the new room.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import fresnel

import warprrf as wr
from benchmarks.fits import Fits, experiment, rms
from benchmarks.office import SHEET_X, SIZE, TRANSMITTER, box_sides, material, office, quads_mesh
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.fields.bistatic.field import BistaticField

HELP = """\
A screen of skin crosses a 60 GHz link: power beside ITU-R P.526's screen, and core seconds of a step. A cabinet of the office is
moved: the old room's field with the new mesh beside a field that was fitted in the new room. A quarter of an hour on two cores.

examples:
  python -m benchmarks edited
  python -m benchmarks edited --tests 4 --counts 6     a first look
"""
CARRIER_HZ = 60e9
PERSON_M = 0.5, 1.8
"""Width and height of the screen."""
ENDS = np.array([[1.5, 3.0, 1.2], [6.5, 3.0, 1.2]])
PLACES_X = 2.5, 4.0
ACROSS = np.arange(-0.6, 0.6001, 0.025)
MOVED_M = -2.0
EFFECTS: dict[str, Any] = {
    "mirrors": 1,
    "scatterings": 1,
    "mirror_scatter": False,
    "scatter_mirror": False,
    "transmissions": 0,
}
COLUMNS = {
    "person": (
        ("x", "person from the transmitter [m]", "{:g}"), ("deepest_db", "deepest [dB]", "{:.1f}"),
        ("screen_db", "P.526 [dB]", "{:.1f}"), ("shadow_rms_db", "in the shadow, rms [dB]", "{:.2f}"),
        ("shadow_most_db", "largest [dB]", "{:.2f}"), ("lit_most_db", "beside it, largest [dB]", "{:.2f}"),
    ),
    "seconds": (
        ("what", "a step, 90 x 180 pixels", "{}"), ("edit_s", "edit [core s]", "{:.3f}"), ("step_s", "then [core s]", "{:.2f}"),
        ("whole_s", "whole spectrum, all effects [core s]", "{:.2f}"), ("share", "of that", "{:.2f}"),
    ),
    "rows": (
        ("field", "field", "{}"), ("n_train", "spectra", "{}"), ("test", "receivers", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
        ("total_rms_db", "total gain, rms [dB]", "{:.2f}"), ("direction_within_3deg", "strongest within 3 degrees", "{:.0%}"),
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the experiment.

    Attributes:
        counts: training receivers.
        tests: test receivers.
    """

    counts: tuple[int, ...] = option((10, 30), "training receivers")
    tests: int = option(20, "test receivers")

    @property
    def inputs(self) -> list[Any]:
        """What every row depends on."""
        return [self.tests]


def screen(x: float, y: float) -> wr.Mesh:
    """A person at x and y [m], standing across x."""
    width, height = PERSON_M
    sides = (y - width / 2, 0.01), (y + width / 2, 0.01), (y + width / 2, height), (y - width / 2, height)
    return quads_mesh(np.array([[(x, *corner) for corner in sides]]))


def knife_edges(x: float, y: float) -> np.ndarray:
    """Powers that arrive over the two sides and the top of a person at x and y, over those of the free link, shape ``(3,)``.

    Source: ITU-R P.526-15, "Finite-width screen" and eq. (30), |int_v^inf exp(-j pi t^2 / 2) dt|^2 / 2.
    """
    (start, _, height), end = ENDS[0], ENDS[1, 0]
    per_wavelength = 2.0 * CARRIER_HZ / 299792458.0
    scale = np.sqrt(per_wavelength * (1.0 / (x - start) + 1.0 / (end - x)))
    edge = PERSON_M[0] / 2
    sine, cosine = fresnel(
        scale * np.array([y + edge - ENDS[0, 1], ENDS[0, 1] - y + edge, PERSON_M[1] - height])
    )
    return np.asarray(0.5 * ((0.5 - cosine) ** 2 + (0.5 - sine) ** 2))


def prior(scene: wr.Scene, **effects: Any) -> BistaticField:
    """A field of ``scene`` before any measurement, of the link."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of effects that are not modelled
        ds = wr.simulate(
            scene, transmitter=ENDS[0], receivers=ENDS[1], frequency_hz=CARRIER_HZ, shape=(20, 40)
        )
    return BistaticField.prior(scene, ds, effects=wr.Effects(**effects))


def walk(x: float) -> Row:
    """The field's power beside P.526's, as the person crosses at x."""
    sides = box_sides((0.0, 0.0, 0.0), SIZE)
    room = wr.Scene(quads_mesh(sides), [material("concrete")], np.zeros(12, int))
    field = prior(room, mirrors=0, scatterings=0, transmissions=0)
    free, found, known = field.paths(ENDS[1]).power.sum(), [], []
    for y in ENDS[0, 1] + ACROSS:
        now = field.with_objects({"person": screen(x, y)}, materials={"person": "skin"})
        found.append(10.0 * np.log10(now.paths(ENDS[1]).power.sum() / free))
        known.append(10.0 * np.log10(knife_edges(x, y).sum()))
    error, dark = np.array(found) - known, np.abs(ACROSS) < PERSON_M[0] / 2
    return {
        "x": x - ENDS[0, 0], "deepest_db": min(found), "screen_db": float(np.min(np.array(known)[dark])),
        "shadow_rms_db": rms(error[dark]), "shadow_most_db": float(np.abs(error[dark]).max()),
        "lit_most_db": float(np.abs(np.array(found)[~dark]).max()), "across_m": ACROSS.tolist(), "found_db": found,
        "known_db": known,
    }  # fmt: skip


def step_seconds(what: str, **effects: Any) -> Row:
    """Core seconds of a person's step through the office under ``effects``, and of a whole spectrum with all of them. A link alone,
    where nothing scatters, needs no grid of rays."""
    whole, field = (prior(office(), **e).on_grid((90, 180)) for e in ({}, effects))
    field = field if field.effects.scatterings else field.on_grid((10, 20))
    receiver, steps = ENDS[1] - [2.0, 1.5, 0.0], []

    def seconds(work: Callable[[], Any]) -> float:
        start = time.process_time()
        work()
        return time.process_time() - start

    for k in range(3):
        at = {"person": screen(2.5, 2.0 + 0.1 * k)}
        make = partial(field.with_objects, at, materials={"person": "skin"})
        now = make()
        ask = partial(now.spectrum if field.effects.scatterings else now.paths, receiver)
        steps.append(
            (seconds(make), seconds(ask), seconds(partial(whole.spectrum, receiver + [0.01 * k, 0.0, 0.0])))
        )
    edit, step, spectrum = np.median(steps, axis=0).tolist()
    return {
        "what": what,
        "edit_s": edit,
        "step_s": step,
        "whole_s": spectrum,
        "share": (edit + step) / spectrum,
    }


def moved(scene: wr.Scene) -> wr.Scene:
    """The office with its first cabinet moved."""
    vertices = scene.mesh.vertices.copy()
    vertices[-48:-24, 0] += MOVED_M  # the last but one of the boxes, each of 24 vertices
    mesh = wr.Mesh(vertices, scene.mesh.faces)
    return wr.Scene(mesh, scene.materials, scene.face_material)


class Cabinet:
    """The office before and after, and its spectra."""

    def __init__(self, options: Options, fits: Fits) -> None:
        self.fits, self.options = fits, options
        self.before = office()
        self.after = moved(self.before)
        self.effects = wr.Effects(**EFFECTS)

    @cached_property
    def data(self) -> dict[str, wr.SpectrumDataset]:
        """Training spectra before and after, and the test spectra after."""
        count = max(self.options.counts)
        places = wr.sample_receivers(self.after, 400, z=(0.8, 1.8), seed=self.fits.job.seed)
        places = places[self.before.is_free(places, clearance_m=0.1) & (places[:, 0] < SHEET_X)]
        asked = {
            "before": places[:count],
            "after": places[:count],
            "test": places[count : count + self.options.tests],
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # walls are passed by neither
            return {
                name: wr.simulate(
                    self.before if name == "before" else self.after, transmitter=TRANSMITTER, receivers=at, frequency_hz=CARRIER_HZ,
                    shape=(30, 60), effects=self.effects, progress=self.fits.job.progress,
                )
                for name, at in asked.items()
            }  # fmt: skip

    def scored(self, count: int) -> dict[str, Row]:
        """Figures in the new room, of the old room's field as it is and edited, and of one that was fitted there."""
        some = np.arange(count)
        old, new = (
            self.fits.fit(room, self.data[name].subset(some), effects=self.effects)
            for room, name in ((self.before, "before"), (self.after, "after"))
        )
        fields = {
            "of the old room, as it was": old, "of the old room, edited": old.with_geometry(self.after), "of the new room": new
        }  # fmt: skip
        return {name: self.fits.score(field, self.data["test"]) for name, field in fields.items()}


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """The person's walk, seconds of a step, and the cabinet."""
    for x in PLACES_X:
        yield {"part": "person", **fits.row(f"walk {x}", partial(walk, x))}
    steps = {
        "the link": {"scatterings": 0, "transmissions": 0},
        "a spectrum, single bounces and edges": EFFECTS,
    }
    for what, effects in {**steps, "a spectrum, all effects": {}}.items():
        yield {"part": "seconds", **fits.row(f"core seconds {what}", partial(step_seconds, what, **effects))}
    cabinet = Cabinet(options, fits)
    for count in options.counts:
        found = fits.row(f"cabinet {count}", partial(cabinet.scored, count))
        for name, figures in found.items():
            yield {"field": name, "n_train": count, **figures}


ABOUT = "A person of skin across a 60 GHz link beside ITU-R P.526's finite-width screen; a cabinet of the office moved by 2 m."
BENCHMARKS = {"edited": experiment("edited", Options, rows, COLUMNS, ABOUT, HELP)}
