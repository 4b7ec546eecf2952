"""Which beams each method picks at every test receiver, and what they are worth on the true channel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

import warprrf as wr
from benchmarks.beams import report
from benchmarks.beams.links import BANDWIDTH_HZ, Ends, Links, ends, gains
from benchmarks.beams.search import hierarchical
from benchmarks.beams.users import several_users
from benchmarks.data import TRUTHS, DataOptions, Geometry, Truth, checked, files
from benchmarks.machine import machine
from benchmarks.methods import METHODS
from benchmarks.report import Report, Row
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.files import write_atomically
from warprrf.rf.channel.beams import select_beams
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import Attempt, Steps

TX_POWER_DBM = 20.0
NOISE_FIGURE_DB = 10.0
NOISE_DBM = -173.98 + 10.0 * np.log10(BANDWIDTH_HZ) + NOISE_FIGURE_DB  # k T at 290 K
FRAME_PILOTS = 2000
"""Pilots that fill the time for which a beam holds: 10 us each (a sector sweep frame of IEEE 802.11ad takes 15) in 20
ms, in which a user walking at 1 m/s moves 2 cm."""
PILOT_SYMBOLS = 10e-6 * BANDWIDTH_HZ  # correlated over
MODELS = ("bistatic", "rf3dgs+")
MULTI_USER_SIDE = 16
WITHIN_DB = 1.0
VERSION = 1  # counted up by hand when something else is computed here

Predict = Callable[[np.ndarray], Paths]

HELP = """\
Fits the bistatic field and RF-3DGS+, picks each test receiver's beam without pilots, and compares received SNR and
spectral efficiency on the true channel with exhaustive and hierarchical search, the nearest training receiver's beam,
pointing at the transmitter, zero spectra and random beams. Fitted fields are kept: a killed run continues.

examples:
  python -m benchmarks beams
  python -m benchmarks beams --truths exact --counts 10 --every 4 --sides 4 16 --out runs/quick     a first look
  python -m benchmarks beams --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""


@dataclass(frozen=True, kw_only=True)
class Options(DataOptions):
    """Options of the beams.

    Attributes:
        counts: numbers of training receivers.
        truths: ``"exact"``, ``"sionna"`` or both.
        every: each how-manieth test receiver counts.
        sides: elements along a side of the swept array, powers of two.
        both: elements along a side of transmitter and receiver where beams are chosen at both ends, powers of two.
    """

    counts: tuple[int, ...] = option((5, 10, 50), "training receivers")
    truths: tuple[str, ...] = option(TRUTHS, "exact, sionna or both")
    every: int = option(1, "each K-th test receiver")
    sides: tuple[int, ...] = option((4, 8, 16, 32, 64), "elements a side of the swept array")
    both: tuple[int, int] = (8, 8)

    def __post_init__(self) -> None:
        for name in ("sides", "both"):
            given = getattr(self, name)
            if any(n < 2 or n & (n - 1) for n in given):
                raise ValueError(f"{name}: got {tuple(given)}, expected powers of two, at least 2")
        checked("every", self.every, 1)


def run(options: Options, job: Job) -> Report:
    """Fit the fields, pick beams by every method, and judge them; a killed run continues.

    Raises:
        ValueError: on missing or broken data, or another run at work in ``job.out``.
        FileNotFoundError: for a missing file.
    """
    place = options.place(job.device)
    figures: dict[str, Any] = {
        "machine": machine(job.device),
        "seed": job.seed,
        "every": options.every,
        "tx_power_dbm": TX_POWER_DBM,
        "noise_dbm": NOISE_DBM,
        "frame_pilots": FRAME_PILOTS,
        "bandwidth_hz": BANDWIDTH_HZ,
        "truths": {},
    }
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        for file in files(options.data, options.truths):
            truth = Truth.load(file, options.counts, options.every)
            fields = {
                (model, count): _fit(steps, truth, place, model, count)
                for model in MODELS
                for count in truth.counts
            }
            keys = [steps.key(f"fit {truth.name} {model} {count}") for model, count in fields]
            inputs = [
                keys,
                place.scene_key,
                truth.counts,
                options.sides,
                options.both,
                options.every,
                job.seed,
            ]
            # A receiver's matrices are small: on busy cores threads of BLAS wait for each other most of the time.
            with threadpool_limits(1, user_api="blas"):
                figures["truths"][truth.name] = steps.run(
                    f"beams {truth.name}",
                    partial(judge, truth, place, fields, options, job.seed),
                    version=VERSION,
                    inputs=inputs,
                )
    figures["within"] = {truth: _within(found["links"]) for truth, found in figures["truths"].items()}
    return Report("beams", figures, report.text(figures), report.pictures(figures), dpi=110)


def _within(rows: list[Row]) -> dict[str, float | None]:
    """The least shares within 1 dB of exhaustive search of our field from ten spectra, over all arrays."""
    own = [r for r in rows if (r["method"], r["n_train"]) == ("bistatic", 10)]
    found: dict[str, float | None] = {}
    for name, key in (("all", "within"), ("blocked", "within_blocked")):
        shares = [r[key] for r in own if r[key] is not None]
        found[name] = min(shares) if shares else None
    return found


def _fit(steps: Steps, truth: Truth, place: Geometry, model: str, count: int) -> Path:
    """The file of a fitted field."""
    name = f"field_{truth.name}_{model.replace('+', '_plus')}_{count}.safetensors"

    def make(attempt: Attempt) -> Row:
        field = wr.RadioField.fit(
            place.reconstruction,
            truth.train(count),
            model=model,
            device=place.device,
            progress=attempt.progress,
        )
        write_atomically(steps.folder / name, field.save)
        return {"fit_s": field.report["fit_time_s"]}

    inputs = [truth.key, place.key, count]
    steps.run(
        f"fit {truth.name} {model} {count}",
        make,
        version=METHODS[model].version,
        inputs=inputs,
        outputs=(name,),
    )
    return steps.folder / name


def judge(
    truth: Truth,
    place: Geometry,
    fields: dict[tuple[str, int], Path],
    options: Options,
    seed: int,
    attempt: Attempt,
) -> Row:
    """All rows of one truth: ``links`` (beams of one user) and ``users`` (several served at once)."""
    test, progress = truth.test, attempt.progress
    between = ends(truth.data, options.sides, options.both)
    predictors: dict[tuple[str, int | None], Predict] = {
        (model, count): wr.RadioField.load(file, device=place.device).paths
        for (model, count), file in fields.items()
    }
    predictors["zero", None] = BistaticField.prior(place.reconstruction, test, device=place.device).paths
    predictors["transmitter", None] = lambda rx: straight(test, rx)
    neighbours = _training_beams(truth, place, between, seed, progress)
    links = Links(place.scene, test, seed=seed, device=place.device)
    rng = np.random.default_rng(seed)
    ratio = 10.0 ** ((TX_POWER_DBM - NOISE_DBM) / 10.0)

    rows: dict[tuple[str, str, int | None], list[Outcome]] = {}
    blocked, shared, shared_worth, guesses = [], [], [], []
    group_ends = next((e for e in between if e.swept == "tx" and e.tx.rows == MULTI_USER_SIDE), None)
    for i, receiver in enumerate(test.receivers):
        link = links.link(i)
        blocked.append(not link.line_of_sight)
        predicted = {key: predict(receiver) for key, predict in predictors.items()}
        guesses.append(predicted)
        for e, channel in zip(between, link.channels(between), strict=True):
            worth = gains(e, channel)
            whole = worth.mean(axis=0)
            if e is group_ends:
                shared.append(channel)
                shared_worth.append(whole)
            found = hierarchical(e, channel, ratio * PILOT_SYMBOLS, rng)
            chosen: dict[tuple[str, int | None], tuple[int, int, int]] = {
                ("exhaustive", None): (*_best(whole), whole.size),
                ("hierarchical", None): (found.rx, found.tx, found.pilots),
                ("random", None): (int(rng.integers(len(whole))), int(rng.integers(whole.shape[1])), 0),
            }
            for count, lookup in neighbours.items():
                chosen["nearest", count] = (*lookup(receiver, e), 0)
            for key, paths in (predicted | {("powers", None): link.everything()}).items():
                choice = select_beams(paths, e.tx_book, e.rx_book)
                chosen[key] = int(choice.rx[0]), int(choice.tx[0]), 0
            for key, (received, sent, pilots) in chosen.items():
                at = worth[:, received, sent]
                outcome = Outcome(
                    gain=float(at.mean()),
                    best=float(whole.max()),
                    tone=float(at[0]),
                    best_tone=float(worth[0].max()),
                    rate=float(np.log2(1.0 + ratio * at).mean()),
                    pilots=pilots,
                )
                rows.setdefault((e.name, *key), []).append(outcome)
        progress("links", i + 1, len(test))
    found_rows: Row = {
        "links": _summaries(between, rows, np.array(blocked), ratio),
        "blocked": int(np.sum(blocked)),
    }
    found_rows |= {"receivers": len(test)}
    if group_ends is not None:
        found_rows["users"] = several_users(group_ends, shared, shared_worth, guesses, 1.0 / ratio, seed)
    return found_rows


class Outcome(NamedTuple):
    """What a pair of beams is worth at a receiver.

    Attributes:
        gain, best: Its gain and that of the best pair, averaged over the band [linear].
        tone, best_tone: The same at the lowest frequency alone.
        rate: log2(1 + SNR), averaged over the band [bit/s/Hz].
        pilots: Sent to find it.
    """

    gain: float
    best: float
    tone: float
    best_tone: float
    rate: float
    pilots: int


def straight(ds: SpectrumDataset, receiver: np.ndarray) -> Paths:
    """Line of sight and nothing else, whatever is in between: what knows the two positions only."""
    nothing = np.full((1, 1, 3), np.nan)
    los = np.array(["los"], dtype="<U7")
    return Paths.from_points(ds.transmitter, receiver, nothing, np.ones(1, complex), los, ds.frequency_hz)


def _training_beams(
    truth: Truth, place: Geometry, between: list[Ends], seed: int, progress: Progress
) -> dict[int, Callable[[np.ndarray, Ends], tuple[int, int]]]:
    """By number of training receivers: the best beams, found by exhaustive search, of the nearest one."""
    largest = truth.train(max(truth.counts))
    links = Links(place.scene, largest, seed=seed, device=place.device)
    best: dict[bytes, dict[str, tuple[int, int]]] = {}
    for i, receiver in enumerate(largest.receivers):
        link = links.link(i)
        channels = zip(between, link.channels(between), strict=True)
        best[receiver.tobytes()] = {e.name: _best(gains(e, channel).mean(axis=0)) for e, channel in channels}
        progress("training links", i + 1, len(largest))

    def lookup(train: SpectrumDataset) -> Callable[[np.ndarray, Ends], tuple[int, int]]:
        def nearest(receiver: np.ndarray, e: Ends) -> tuple[int, int]:
            near = np.linalg.norm(train.receivers - receiver, axis=1).argmin()
            return best[train.receivers[near].tobytes()][e.name]

        return nearest

    return {count: lookup(truth.train(count)) for count in truth.counts}


def _best(gains: np.ndarray) -> tuple[int, int]:
    received, sent = np.unravel_index(gains.argmax(), gains.shape)
    return int(received), int(sent)


def _summaries(
    between: list[Ends],
    rows: dict[tuple[str, str, int | None], list[Outcome]],
    blocked: np.ndarray,
    ratio: float,
) -> list[dict[str, Any]]:
    found = []
    for e in between:
        for (name, method, count), outcomes in rows.items():
            if name != e.name:
                continue
            gain, best, tone, best_tone, rate, pilots = np.array(outcomes).T
            columns = {
                "loss_db": 10.0 * np.log10(best / gain),
                "tone_loss_db": 10.0 * np.log10(best_tone / tone),
                "snr_db": 10.0 * np.log10(ratio * gain),
                "efficiency": np.maximum(1.0 - pilots / FRAME_PILOTS, 0.0) * rate,
                "efficiency_without_pilots": rate,
            }
            row: dict[str, Any] = {"ends": name, "swept": e.swept, "elements": e.elements}
            row |= {"method": method, "n_train": count, "pilots": int(pilots.max())}
            for suffix, where in (
                ("", np.ones(len(blocked), bool)),
                ("_blocked", blocked),
                ("_los", ~blocked),
            ):
                row |= {
                    f"{k}{suffix}": v for k, v in _over({n: c[where] for n, c in columns.items()}).items()
                }
            row["losses_db"] = columns["loss_db"]
            found.append(row)
    return found


def _over(columns: dict[str, np.ndarray]) -> dict[str, float | None]:
    """Figures over some receivers; None where there are none."""
    if not len(columns["loss_db"]):
        names = ("within", "tone_within", "loss_db", "snr_db", "efficiency", "efficiency_without_pilots")
        return dict.fromkeys(names)
    return {
        "within": float((columns["loss_db"] <= WITHIN_DB).mean()),
        "tone_within": float((columns["tone_loss_db"] <= WITHIN_DB).mean()),
        "loss_db": float(np.median(columns["loss_db"])),
        "snr_db": float(np.median(columns["snr_db"])),
        "efficiency": float(columns["efficiency"].mean()),
        "efficiency_without_pilots": float(columns["efficiency_without_pilots"].mean()),
    }


BENCHMARKS = {"beams": Benchmark("beams", Options, run, HELP)}
