"""The paper's gap: RF-3DGS+ less RF-3DGS, with one thing changed at a time of what the paper leaves open.

The paper reports 19.68 dB for RF-3DGS+ and 13.50 dB for RF-3DGS, but not what is fitted, in which unit, or how pictures
are normalised. Here both are fitted to the same spectra on the same blending weights:

- ``db``: blended power, the loss on the dB image; the library's default.
- ``power``: blended power, the loss on linear power over the set's strongest pixel.
- ``amplitude``: blended amplitude, with the square root of the law's factor; the loss on amplitude.
- ``set``, ``image``: 8-bit pictures of dB, normalised over the set, or each by its own smallest and largest value,
  blended as colours, max(0, SH), to which the pixel's solid angle is added in dB. RF-3DGS is plain Gaussian splatting
  there. RF-3DGS+ multiplies the colour by (l_prev + l_vd)^-2 over its largest value, which is eq. (4) to the letter, or
  adds that factor in dB, which is what eq. (4) means for colours in dB. Pictures normalised one by one are read with
  the training set's median range.

All start from the mean, over the pixels that see a Gaussian, of what is fitted. The loss is 0.8 L1 + 0.2 (1 - SSIM).
``own`` figures compare pictures after each, truth and prediction, is mapped by its own smallest and largest value: what
a paper reports that normalises every picture by itself. (A model of such pictures predicts them as they are.)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.data import TRUTHS, DataOptions, Geometry, Truth, checked, files
from benchmarks.machine import machine
from benchmarks.methods import METHODS
from benchmarks.report import Report, Row, cell, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.kernels.radio.harmonics import COEFFICIENTS, PER_NEPER
from warprrf.rf.fields.harmonic.fitting import DARK, Y00, Target, fit_layer, targets, weighted_means
from warprrf.rf.fields.harmonic.options import FieldOptions, Rates, SingleBounce
from warprrf.rf.fields.harmonic.problem import Problem, harmonics
from warprrf.rf.fields.harmonic.transport import Lengths, Transport, interaction_points, path_lengths
from warprrf.rf.spectra import metrics
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_solid_angles, to_db
from warprrf.steps import Steps

HELP = """\
Fits RF-3DGS+ and RF-3DGS to the same spectra on the same blending weights, with one thing changed at a time of what the
paper leaves open: what is fitted, the harmonics' gain and degree, receivers at one distance. Finished rows are kept.

examples:
  python -m benchmarks gap
  python -m benchmarks gap --count 50 --iterations 100
  python -m benchmarks gap --truth sionna --choices db power
"""
PUBLISHED = {"rf3dgs+": 19.68, "rf3dgs": 13.50}
"""PSNR [dB] of the paper's table."""
NAMES = {"rf3dgs+": "RF-3DGS+", "rf3dgs": "RF-3DGS"}
FEW = 100  # receivers at one distance, and as many at random
SMALL = 0.01  # log(1 + x) of such an x is x within 0.5 %, and float32 keeps 6e-6 of it
BITS = 255  # levels of a picture


@dataclass(frozen=True)
class Choice:
    """One thing that is not as by default.

    Attributes:
        what: the table's line.
        fitted: ``"db"``, ``"power"``, ``"amplitude"``, ``"set"`` or ``"image"``; see the module.
        gain: of the harmonics, ``"exp"`` or ``"linear"``.
        degree: of the harmonics.
        receivers: ``"all"``; ``"random"``: :data:`FEW` of them; ``"shell"``: as many, about equally far from the
            transmitter.
        added: whether the law's factor is added to a picture's colour in dB, not multiplied.
    """

    what: str
    fitted: str = "db"
    gain: str = "exp"
    degree: int = 3
    receivers: str = "all"
    added: bool = False

    @property
    def picture(self) -> bool:
        """Whether colours are blended."""
        return self.fitted in ("set", "image")


CHOICES = {
    "db": Choice("dB image (default)"),
    "power": Choice("linear power", fitted="power"),
    "amplitude": Choice("amplitude", fitted="amplitude"),
    "set-added": Choice("8-bit dB pictures, by the set; law added", fitted="set", gain="linear", added=True),
    "set": Choice("8-bit dB pictures, by the set; law multiplied", fitted="set", gain="linear"),
    "image-added": Choice("8-bit dB pictures, each by itself; law added", "image", gain="linear", added=True),
    "image": Choice("8-bit dB pictures, each by itself; law multiplied", "image", gain="linear"),
    "linear": Choice("gain linear, clamped at zero", gain="linear"),
    "degree-0": Choice("harmonics of degree 0", degree=0),
    "degree-1": Choice("harmonics of degree 1", degree=1),
    "degree-2": Choice("harmonics of degree 2", degree=2),
    "random": Choice("few receivers, at random", receivers="random"),
    "shell": Choice("as few, equally far from the transmitter", receivers="shell"),
}
"""Every choice by its name; the first is the default."""


@dataclass(frozen=True)
class Options(DataOptions):
    """Options of the comparison.

    Attributes:
        truth: ``"exact"`` or ``"sionna"``.
        count: training receivers; all by default.
        iterations: optimiser steps; the library's by default.
        choices: of :data:`CHOICES`.
    """

    truth: str = option("exact", "truth", choices=TRUTHS)
    count: int | None = option(None, "training receivers (default all)", kind=int)
    iterations: int | None = option(None, "optimiser steps (default: the library's)", kind=int)
    choices: tuple[str, ...] = option(tuple(CHOICES), "choices", choices=tuple(CHOICES))


@dataclass(frozen=True, eq=False)
class Task:
    """What a layer is fitted to, and the way back.

    Attributes:
        target: of the layer.
        rates: how fast and firmly.
        unseen: degree-0 coefficient of Gaussians that no training receiver sees.
        terms: from the lengths (R, H, W) [m] of pixels' paths to what multiplies the blended value and what is added.
        back: from a predicted image to path gain.
    """

    target: Target
    rates: Rates
    unseen: float
    terms: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | float]]
    back: Callable[[np.ndarray], np.ndarray]


class Lab:
    """What the rows share: spectra, blending weights, and the latest problem and task.

    Args:
        train, test: spectra.
        geometry: what is known of the room.
        job: device, seed and progress.
        iterations: optimiser steps.
    """

    def __init__(
        self, train: SpectrumDataset, test: SpectrumDataset, geometry: Geometry, job: Job, iterations: int
    ) -> None:
        self.train, self.test, self.geometry = train, test, geometry
        self.job, self.iterations = job, iterations
        away = np.linalg.norm(train.receivers - train.transmitter, axis=1)
        few = min(FEW, max(1, len(train) // 2))
        shell = np.argsort(np.abs(away - np.median(away)), kind="stable")[:few]
        self.chosen = {"all": np.arange(len(train)), "random": np.arange(few), "shell": np.sort(shell)}
        """Indices of training receivers by the choice of receivers; those of ``train`` lie in random order."""
        self._kept: dict[str, tuple[Any, Any]] = {}

    def kept(self, what: str, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` returns, or the latest of it if its ``key`` is the same: hundreds of receivers fill gigabytes."""
        if self._kept.get(what, (None,))[0] != key:
            self._kept.pop(what, None)
            self._kept[what] = key, make()
        return self._kept[what][1]

    def spectra(self, receivers: str) -> SpectrumDataset:
        """Training spectra, without delays: no channel of delay is fitted."""
        part = self.train if receivers == "all" else self.train.subset(self.chosen[receivers])
        return replace(part, delay_s=np.full(part.path_gain.shape, np.nan))

    def seen(self, receivers: str) -> Transport:
        """Blending weights of training receivers."""
        return self.geometry.weights(self.spectra(receivers), progress=self.job.progress)[0]

    @cached_property
    def seen_by_test(self) -> Transport:
        """Blending weights of the test receivers."""
        return self.geometry.weights(self.test, slot="test", progress=self.job.progress)[0]

    def law(self, model: str, gain: str) -> SingleBounce:
        """The law of a model."""
        ds, options = self.train, FieldOptions(model=model, gain=gain)
        gaussians, sigma = self.geometry.reconstruction.gaussians, ds.beam_sigma_rad
        return SingleBounce(
            gaussians, None, options, ds.shape, ds.frequency_hz, sigma, ds.air, self.job.device
        )

    def lengths(self, seen: Transport) -> np.ndarray:
        """Lengths of the paths of all pixels [m], shape ``(R, H, W)``; NaN where a ray meets nothing."""
        parts = []
        for r in range(len(seen.receivers)):  # one at a time: points are thrice as large
            part = replace(seen, receivers=seen.receivers[[r]], dominant=seen.dominant[[r]])
            points = interaction_points(part, self.geometry.reconstruction.gaussians, "centre")
            parts.append(path_lengths(points, self.train.transmitter, part.receivers).total)
        return np.concatenate(parts)

    def task(self, choice: Choice, model: str) -> Task:
        """What ``model`` is fitted to by ``choice``."""
        key = model, choice.fitted, choice.gain, choice.receivers, choice.added
        make = _default_task if choice.fitted == "db" else _task
        return self.kept("task", key, lambda: make(self, choice, model))  # type: ignore[no-any-return]

    def problem(self, choice: Choice) -> Problem:
        """Batches of the training receivers. Linear power spans more than float32 keeps of log(1 + x)."""
        precision = np.float64 if choice.fitted == "power" else np.float32
        batch, seed = FieldOptions().batch, self.job.seed
        return self.kept(  # type: ignore[no-any-return]
            "problem",
            (choice.receivers, precision),
            lambda: Problem(
                self.seen(choice.receivers),
                batch=batch,
                seed=seed,
                device=self.job.device,
                precision=precision,
            ),
        )


def _default_task(lab: Lab, choice: Choice, model: str) -> Task:
    """The library's own."""
    ds, law = lab.spectra(choice.receivers), lab.law(model, choice.gain)
    plan = targets(law, ds, np.asarray(ds.path_gain, np.float64), lab.seen(choice.receivers))

    def terms(lengths: np.ndarray) -> tuple[np.ndarray, float]:
        return plan.gain_unit * _factor(law, lengths), 0.0

    return Task(plan.layers["gain"], Rates(), plan.unseen["gain"], terms, lambda image: image)


def _task(lab: Lab, choice: Choice, model: str) -> Task:
    """Another image than that of dB, by the same kernels: log(1 + x) of a small x is x."""
    ds, seen, law = lab.spectra(choice.receivers), lab.seen(choice.receivers), lab.law(model, choice.gain)
    lengths = lab.lengths(seen)
    image, least, back, span_db = pictures(choice.fitted, ds)
    solid_angle = pixel_solid_angles(ds.shape)[:, None]
    largest = float(np.max(_factor(law, lengths) / solid_angle))

    def terms(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        factor = _factor(law, lengths) / largest
        if choice.fitted == "amplitude":
            return np.sqrt(factor), 0.0
        if not choice.picture:
            return factor, 0.0
        met, grid = factor > 0, 10 * np.log10(solid_angle / solid_angle.max()) / span_db
        loss = np.where(met, factor / solid_angle, 1.0)
        if choice.added:
            return met.astype(float), grid + 10 * np.log10(loss) / span_db
        return met * loss, np.broadcast_to(grid, met.shape)

    factor, added = terms(lengths)
    blended, lit = factor * seen.pixel_weight, image > least
    met = blended > 0
    values = np.maximum(image - added, least) / np.where(met, blended, 1.0)
    start = weighted_means(seen, values, met)[1]
    # A pixel pulls with the change of its image by a neper of gain, about its value; see fit_layer.
    low, high = math.log1p(SMALL), math.log1p(2 * SMALL)
    pull = (high - low) * float(np.median(image[lit]))
    rates = Rates()
    exponential = choice.gain == "exp"
    target = Target(
        image=(np.log1p(SMALL * (1 + image)) - low) / (high - low),
        initial=np.log(start) / Y00 if exponential else np.full(len(start), 1.0 / Y00),
        kind=choice.gain,
        unit=None if exponential else start,
        factor=SMALL * factor,
        extra=np.broadcast_to(SMALL * (1 + added), image.shape),  # what lies below zero pulls, too
        low=PER_NEPER * low,
        high=PER_NEPER * high,
    )
    middle = float(np.median(start))
    return Task(
        target,
        replace(rates, ridge=rates.ridge * pull, ridge_directional=rates.ridge_directional * pull),
        math.log(middle) / Y00 if exponential else middle / Y00,
        terms,
        back,
    )


def pictures(
    fitted: str, ds: SpectrumDataset
) -> tuple[np.ndarray, float, Callable[[np.ndarray], np.ndarray], float]:
    """Images to fit that are not the library's.

    Returns:
        Images of about 0 to 1, shape ``(R, H, W)``; the least value that counts; the way back to path gain; and how
        many dB a picture spans (1 for what is not in dB).
    """
    gain, floor = np.asarray(ds.path_gain, np.float64), float(ds.floor)
    peak = float(gain.max())
    least = DARK * floor / peak
    if fitted == "power":
        return gain / peak, least, lambda image: peak * np.maximum(image, 0.0), 1.0
    if fitted == "amplitude":
        return np.sqrt(gain / peak), math.sqrt(least), lambda image: peak * np.maximum(image, 0.0) ** 2, 1.0
    decibels = to_db(gain, floor)
    low, high = (np.full((len(ds), 1, 1), float(end)) for end in ds.range_db)
    if fitted == "image":
        low, high = decibels.min(axis=(1, 2), keepdims=True), decibels.max(axis=(1, 2), keepdims=True)
    image = np.rint(BITS * np.clip((decibels - low) / (high - low), 0.0, 1.0)) / BITS
    start, span = float(np.median(low)), float(np.median(high - low))

    def back(image: np.ndarray) -> np.ndarray:
        return np.asarray(np.maximum(10 ** ((start + span * np.clip(image, 0.0, 1.0)) / 10) - floor, 0.0))

    return image, 1.0 / BITS, back, span


def _factor(law: SingleBounce, lengths: np.ndarray) -> np.ndarray:
    """What multiplies a pixel's gain by the library's law for paths of ``lengths`` [m]."""
    return law.factor(Lengths(point=lengths, total=lengths, departure=lengths))


def blend(seen: Transport, coefficients: np.ndarray, gain: str, device: Any = None) -> np.ndarray:
    """Blended values of all pixels by coefficients (N, 16) of the Gaussians, shape ``(R, H, W)``."""
    basis = harmonics(seen.shape, wp.float32, device).numpy()
    images = []
    for r in range(len(seen.receivers)):
        part = seen.subset([r])
        summed = np.einsum("ek,ek->e", coefficients[part.gaussian], basis[part.pixel])
        value = np.exp(summed) if gain == "exp" else np.maximum(summed, 0.0)
        images.append(np.bincount(part.pixel, weights=part.weight * value, minlength=len(basis)))
    return np.stack(images).reshape(-1, *seen.shape)


def fit_and_score(lab: Lab, choice: Choice, model: str, progress: Progress) -> Row:
    """Figures of one model by one choice."""
    task, problem = lab.task(choice, model), lab.problem(choice)
    start = time.perf_counter()
    state = fit_layer(
        problem, task.target, steps=lab.iterations, rates=task.rates, degree=choice.degree,
        each=lambda done, _: progress("fit", done, lab.iterations),
    )  # fmt: skip
    seconds = time.perf_counter() - start
    unit = 1.0 if task.target.unit is None else task.target.unit[:, None]
    everyone = np.zeros((len(lab.geometry.reconstruction.gaussians), COEFFICIENTS))
    everyone[:, 0] = task.unseen
    everyone[problem.seen] = state.coefficients * unit
    factor, added = task.terms(lab.lengths(lab.seen_by_test))
    image = factor * blend(lab.seen_by_test, everyone, choice.gain, lab.job.device) + added
    epoch = len(problem.batches)
    return {
        **scores(lab.test, task.back(image), np.clip(image, 0.0, 1.0) if choice.fitted == "image" else None),
        "train": len(lab.chosen[choice.receivers]),
        "loss": float(np.mean(state.losses[-epoch:])),
        "fit_s": seconds,
    }


KEPT = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "beam_gain_loss_db")


def scores(test: SpectrumDataset, path_gain: np.ndarray, image: np.ndarray | None = None) -> Row:
    """Figures of predictions (R, H, W), over all receivers and over the blocked ones, and ``own`` ones by picture.

    Args:
        image: predicted pictures, where these were learned normalised one by one.
    """
    answers = iter(path_gain)
    found = metrics.evaluate(test, lambda _: next(answers))  # receivers are asked for in order
    row: Row = {f"{name}{end}": found[f"{name}{end}"] for name in KEPT for end in ("", "_blocked")}
    own = own_range(to_db(np.asarray(test.path_gain, np.float64), test.floor))
    shown = own_range(to_db(path_gain, test.floor)) if image is None else image
    pairs = list(zip(shown, own, strict=True))
    each = {
        "own_psnr_db": np.array([metrics.psnr(*pair) for pair in pairs]),
        "own_ssim": np.array([metrics.ssim(*pair) for pair in pairs]),
    }
    blocked = ~np.asarray(test.line_of_sight, bool)
    for name, values in each.items():
        row[name] = float(values.mean())
        row[f"{name}_blocked"] = float(values[blocked].mean()) if blocked.any() else None
    return row


def own_range(decibels: np.ndarray) -> np.ndarray:
    """Images (R, H, W), each mapped to [0, 1] by its own smallest and largest value."""
    low, high = decibels.min(axis=(1, 2), keepdims=True), decibels.max(axis=(1, 2), keepdims=True)
    return np.asarray((decibels - low) / np.maximum(high - low, 1e-12))


def run(options: Options, job: Job) -> Report:
    """Fit what is not fitted yet, and compare.

    Raises:
        ValueError, FileNotFoundError: for data or geometry that is not there, or an option that does not fit them.
    """
    data = files(options.data, [options.truth])[0]
    truth = Truth.load(data, (1,))
    held = int(np.count_nonzero(truth.data.role == "train"))
    count = checked("count", held if options.count is None else options.count, 2)
    if count > held:
        raise ValueError(f"count: got {count}, expected at most the {held} training receivers of {data}")
    default = FieldOptions().iterations
    iterations = checked("iterations", default if options.iterations is None else options.iterations, 1)
    geometry = options.place(job.device)
    lab = Lab(truth.train(count, job.seed), truth.test, geometry, job, iterations)
    known = [truth.key, geometry.key, count, iterations, job.seed]
    rows: list[Row] = []
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        for name, model in _order(options.choices):
            choice = CHOICES[name]
            found = steps.run(
                f"{name}-{model}",
                lambda attempt, c=choice, m=model: fit_and_score(lab, c, m, attempt.progress),  # type: ignore[misc]
                version=METHODS[model].version,
                inputs=[*known, model, choice],
            )
            rows.append({"choice": name, "model": model, "data": truth.key, **found})
    # Without a law it does not matter how the law is applied.
    same = [{**row, "choice": f"{row['choice']}-added"} for row in rows if row["model"] == "rf3dgs"]
    rows += [row for row in same if row["choice"] in options.choices]
    order = list(CHOICES)
    rows.sort(key=lambda row: (order.index(row["choice"]), row["model"] == "rf3dgs"))
    figures = {
        "truth": {"name": truth.name, "key": truth.key, **truth.about},
        "geometry": geometry.key,
        "train": count,
        "iterations": iterations,
        "seed": job.seed,
        "published": PUBLISHED,
        "rows": rows,
        "differences": differences(rows),
        "machine": machine(job.device),
    }
    return Report("gap", figures, text_of(figures))


def _order(choices: tuple[str, ...]) -> list[tuple[str, str]]:
    """Choices and models, those that share a problem and a task side by side."""
    pairs = [(name, model) for name in choices for model in NAMES]
    pairs += [
        (name.removesuffix("-added"), "rf3dgs")
        for name in choices
        if name.removesuffix("-added") not in choices
    ]
    pairs = [
        (name, model)
        for name, model in dict.fromkeys(pairs)
        if not (CHOICES[name].added and model == "rf3dgs")
    ]

    def place(pair: tuple[str, str]) -> tuple[Any, ...]:
        choice = CHOICES[pair[0]]
        return choice.receivers, choice.fitted == "power", choice.degree != 3, pair[1] == "rf3dgs"

    return sorted(pairs, key=place)


def differences(rows: list[Row]) -> list[Row]:
    """Both models and RF-3DGS+ less RF-3DGS, a row a choice."""
    known = {(row["choice"], row["model"]): row for row in rows}
    found = []
    for name in CHOICES:
        both = {model: known.get((name, model)) for model in NAMES}
        plus, plain = both["rf3dgs+"], both["rf3dgs"]
        if plus is None or plain is None:
            continue
        line: Row = {"choice": name, "what": CHOICES[name].what, "train": plus["train"]}
        for key in (
            f"{k}{end}" for k in ("psnr_db", "ssim", "own_psnr_db", "own_ssim") for end in ("", "_blocked")
        ):
            a, b = plus[key], plain[key]
            line[key] = {"rf3dgs+": a, "rf3dgs": b, "difference": None if a is None or b is None else a - b}
        found.append(line)
    return found


COLUMNS = (
    ("psnr_db", "PSNR", "{:.2f}"), ("psnr_db_blocked", "PSNR, blocked", "{:.2f}"), ("ssim", "SSIM", "{:.3f}"),
    ("own_psnr_db", "PSNR, own range", "{:.2f}"),
)  # fmt: skip


def text_of(figures: Row) -> str:
    """The table, and what it says."""
    found, published = figures["differences"], figures["published"]
    gap = published["rf3dgs+"] - published["rf3dgs"]
    head = ["what is changed", "spectra"]
    for _, title, _ in COLUMNS:
        head += [f"{title}: RF-3DGS+", "RF-3DGS", "difference"]
    lines = []
    for row in found:
        cells = [CHOICES[row["choice"]].what, str(row["train"])]
        for key, _, form in COLUMNS:
            one = row[key]
            signed = form.replace(":", ":+")
            cells += [cell(one["rf3dgs+"], form), cell(one["rf3dgs"], form), cell(one["difference"], signed)]
        lines.append(cells)
    said = [table(head, lines)]
    whole = [row for row in found if row["train"] == figures["train"]]
    for key, name in (("psnr_db", "dB images"), ("own_psnr_db", "pictures, each by its own range")):
        if whole:
            said.append(f"PSNR of {name}. {_extremes(found, whole, key)} Published: {gap:+.2f} dB.")
    about = figures["truth"]
    said.append(
        f"Truth: {about['name']}, {about['test']} test receivers, {about['blocked']} blocked, "
        f"{about['shape'][0]} x {about['shape'][1]} pixels; data {about['key'][:12]}; {figures['iterations']} steps."
    )
    return "\n\n".join(said)


def _extremes(found: list[Row], whole: list[Row], key: str) -> str:
    """Which choice each model likes best, and how far apart choices can bring the two models."""

    def of(row: Row, end: str) -> float:
        return float(row[key][end])

    best = {m: max(whole, key=partial(of, end=m)) for m in NAMES}
    worst, widest = min(whole, key=partial(of, end="rf3dgs")), max(found, key=partial(of, end="difference"))
    likes = "; ".join(f"{NAMES[m]} likes best: {_named(row, m)}" for m, row in best.items())
    apart = of(best["rf3dgs+"], "rf3dgs+") - of(worst, "rf3dgs")
    return (
        f"{likes}. Largest difference: {of(widest, 'difference'):+.2f} dB ({CHOICES[widest['choice']].what}). "
        f"RF-3DGS+ as it likes it best, less RF-3DGS as it likes it least "
        f"({_named(worst, 'rf3dgs')}): {apart:+.2f} dB."
    )


def _named(row: Row, model: str) -> str:
    """The choice of a row, for a model that has a law or has none."""
    what = CHOICES[row["choice"]].what
    return what if model == "rf3dgs+" else what.partition("; law")[0]


BENCHMARKS = {"gap": Benchmark("gap", Options, run, HELP)}
