"""Beams that a field chooses without a pilot, judged on the true channel.

The true channel has 2.16 GHz. Line of sight and mirrors come from the image method on the true scene with its materials,
every element at its own distance (spherical waves). Scattering is a set of plane waves, each with power and delay of one
ray of the exact engine and a phase drawn from a seed; so it is a truth of single bounces. The transmitter is one element,
the receiver a square array that looks level to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.channel.arrays import PlanarArray, orientation_towards
from warprrf.rf.channel.beams import Codebook, dft_codebook, select_beams
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase
from warprrf.rf.exact import ExactEngine
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.spectra.spectrum import angles_from_directions

OVERSAMPLING = 2
"""Of the codebooks: neighbouring beams cross 0.9 dB down instead of 3.9 dB, so that a wrong neighbour costs little."""
BANDWIDTH_HZ = 2.16e9  # the narrowest channel of IEEE Std 802.15.3d
OFFSETS_HZ = ((np.arange(8) + 0.5) / 8 - 0.5) * BANDWIDTH_HZ
NEGLIGIBLE = 3e-3  # the weakest rays are left out, up to this share of the scattered power
WITHIN_DB = 1.0
HELP = """\
Fields on the reconstruction of `make lobby` choose each test receiver's beam without pilots; so do the nearest training
receiver's best beam, pointing at the transmitter, our geometry without spectra, and the true powers of all paths. All are
compared with exhaustive search on the true channel. Each row is kept as soon as it is finished.

examples:
  python -m benchmarks beams
  python -m benchmarks beams --counts 10 --every 4 --sides 4     a first look
"""
COLUMNS = {
    "rows": (
        ("method", "method", "{}"), ("n_train", "spectra", "{}"), ("elements", "elements", "{}"),
        ("within", "within 1 dB", "{:.0%}"), ("within_blocked", "blocked", "{:.0%}"),
        ("loss_db", "median loss [dB]", "{:.2f}"), ("loss_db_blocked", "blocked", "{:.2f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the beams.

    Attributes:
        sides: elements along a side of the receiver's array.
        model: of the fields.
    """

    truths: tuple[str, ...] = ("exact",)
    sides: tuple[int, ...] = option((4, 16), "elements a side of the receiver's array")
    model: str = option("bistatic", "model of the fields", choices=("bistatic", "rf3dgs+"))


@dataclass(frozen=True, eq=False)
class Link:
    """The true channel of one receiver.

    Attributes:
        specular: line of sight and mirror paths.
        scattered: one path a ray, its gain the root of its power.
        phase: random phases of the rays as unit numbers, complex.
    """

    specular: Paths
    scattered: Paths
    phase: np.ndarray

    @property
    def powers(self) -> Paths:
        """All paths, for choices that know no phase."""
        return Paths.concatenate([self.specular, self.scattered])

    def channel(self, array: PlanarArray) -> np.ndarray:
        """The channel of every element at eight frequencies of the band, shape ``(8, M)``."""
        elements = Codebook(array, (np.eye(array.cols, dtype=complex), np.eye(array.rows, dtype=complex)))
        turned = self.scattered.gain * self.phase
        waves = turned * carrier_phase(OFFSETS_HZ[:, None], self.scattered.tau)
        sharp = self.specular.cfr(
            self.specular.carrier_hz + OFFSETS_HZ,
            rx_array=array,
            wave="spherical",
            squint=False,
            method="dense",
        )
        return elements.superposed(self.scattered.arrival, waves) + sharp[:, 0].T


class Links:
    """True channels of the receivers of a data set; ``seed`` is that of the phases."""

    def __init__(self, scene: Any, ds: wr.SpectrumDataset, seed: int = 0, device: Any = None) -> None:
        known = {"transmitter": ds.transmitter, "frequency_hz": ds.frequency_hz, "device": device}
        self.tracer, self.seed = MirrorTracer(scene, **known), seed
        self.engine = ExactEngine(scene, shape=ds.shape, sub_pixels=3, **known)

    def link(self, receiver: np.ndarray) -> Link:
        """The channel of a receiver."""
        specular, rays = self.tracer.trace(receiver, 1), self.engine.diffuse(receiver)
        weakest = np.argsort(rays.power)
        kept = weakest[np.cumsum(rays.power[weakest]) > NEGLIGIBLE * rays.power.sum()]
        (theta_r, phi_r), (theta_t, phi_t) = map(
            angles_from_directions, (rays.direction[kept], rays.departure[kept])
        )
        count = len(kept)
        scattered = replace(
            specular, gain=np.sqrt(rays.power[kept]).astype(complex), tau=rays.length_m[kept] / SPEED_OF_LIGHT,
            theta_r=theta_r, phi_r=phi_r, theta_t=theta_t, phi_t=phi_t, kind=np.full(count, "diffuse", dtype="<U7"),
            vertices=np.full((count, *specular.vertices.shape[1:]), np.nan), valid=np.ones(count, bool), jones=None,
            interactions=np.zeros((count, specular.vertices.shape[1]), np.int8),
        )  # fmt: skip
        place = np.round(1e6 * np.abs(receiver)).astype(int)
        turns = np.random.default_rng([self.seed, *place]).random(count)
        return Link(specular, scattered, np.exp(2j * np.pi * turns))


def gains(book: Codebook, channel: np.ndarray) -> np.ndarray:
    """Gain of every beam over the band, shape ``(B,)``."""
    return np.asarray(np.mean(np.abs(book.received(channel)) ** 2, axis=0))


def straight(ds: wr.SpectrumDataset, receiver: np.ndarray) -> Paths:
    """Line of sight and nothing else, whatever is in between: what knows the two positions only."""
    nothing, los = np.full((1, 1, 3), np.nan), np.array(["los"], dtype="<U7")
    return Paths.from_points(ds.transmitter, receiver, nothing, np.ones(1, complex), los, ds.frequency_hz)


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each method, number of spectra and array."""
    (truth,), place = options.load(), options.place(fits.job.device)
    test, few = truth.test, truth.train(max(truth.counts))
    level = (test.transmitter - truth.data.receivers.mean(axis=0)) * [1.0, 1.0, 0.0]
    arrays = [PlanarArray(n, n, orientation=orientation_towards(level)) for n in options.sides]
    books = [dft_codebook(array, OVERSAMPLING) for array in arrays]
    links = Links(place.scene, test, fits.job.seed, fits.job.device)
    one = PlanarArray(1, 1)

    def channels(ds: wr.SpectrumDataset) -> dict[str, np.ndarray]:
        """Gain of every beam at every receiver of ``ds``, by array."""
        found: list[list[np.ndarray]] = [[] for _ in books]
        for k, receiver in enumerate(ds.receivers):
            fits.job.progress("channels", k, len(ds))
            link = links.link(receiver)
            for own, array, book in zip(found, arrays, books, strict=True):
                own.append(gains(book, link.channel(array)))
        return {f"{len(book)}": np.stack(own) for book, own in zip(books, found, strict=True)}

    def chosen(paths: Callable[[np.ndarray], Paths]) -> Row:
        """The beam of every array at every test receiver, by predicted paths."""
        predicted = [paths(receiver) for receiver in test.receivers]
        beams = [[int(select_beams(p, one, book).rx[0]) for p in predicted] for book in books]
        return {"beams": {f"{len(book)}": own for book, own in zip(books, beams, strict=True)}}

    def fitted(count: int) -> Row:
        field = wr.RadioField.fit(
            place.reconstruction, truth.train(count), model=options.model, device=fits.job.device, progress=fits.job.progress
        )  # fmt: skip
        return chosen(field.paths)

    inputs = [fits.key, options.sides, fits.job.seed]
    # A receiver's matrices are small: on busy cores threads of BLAS wait for each other most of the time.
    with threadpool_limits(1, user_api="blas"):
        worth = fits.steps.arrays("test", partial(channels, test), version=1, inputs=inputs)
        known = fits.steps.arrays("train", partial(channels, few), version=1, inputs=[*inputs, len(few)])
        choices: dict[tuple[str, int], Row] = {}
        for method, paths in (
            ("powers", lambda rx: links.link(rx).powers),
            ("transmitter", partial(straight, test)),
            ("zero", fits.fit(place.reconstruction, truth.data.subset([])).paths),
        ):
            choices[method, 0] = fits.row(f"{method} {options.sides}", partial(chosen, paths))
        for count in truth.counts:
            choices[options.model, count] = fits.row(
                f"{options.model} {count} {options.sides}", partial(fitted, count)
            )
    for count in truth.counts:
        near = np.linalg.norm(test.receivers[:, None] - truth.train(count).receivers, axis=2).argmin(axis=1)
        best = {size: [int(beam) for beam in own.argmax(axis=1)[near]] for size, own in known.items()}
        choices["nearest", count] = {"beams": best}
    blocked = ~np.asarray(test.line_of_sight, bool)
    for (method, count), row in choices.items():
        for array, book in zip(arrays, books, strict=True):
            own = worth[f"{len(book)}"]
            loss = 10.0 * np.log10(own.max(axis=1) / own[np.arange(len(own)), row["beams"][f"{len(book)}"]])
            yield {
                "method": method, "n_train": count or None, "elements": array.elements, "within": _share(loss),
                "within_blocked": _share(loss[blocked]), "loss_db": float(np.median(loss)),
                "loss_db_blocked": float(np.median(loss[blocked])) if blocked.any() else None,
            }  # fmt: skip


def _share(loss_db: np.ndarray) -> float | None:
    return float(np.mean(loss_db <= WITHIN_DB)) if len(loss_db) else None


ABOUT = "Beams without pilots against exhaustive search, on the true channel over 2.16 GHz."
BENCHMARKS = {"beams": experiment("beams", Options, rows, COLUMNS, ABOUT, HELP)}
