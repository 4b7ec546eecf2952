"""What each effect is worth in the lobby, and the reduced models beside the full one at receivers that did not choose.

Six cases: 140 and 300 GHz, with the surfaces' assumed roughness, three times it and a third of it. A handful of
receivers chooses the smallest model (:func:`warprrf.relevance`); other receivers judge it: rms difference of the dB
image, PSNR against the full model, change of the total path gain, time of a spectrum. Last, a field is fitted to
spectra with and without the choice.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures import figure_of
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.relevance.model import full_field
from warprrf.rf.relevance.search import Relevance, relevances, title
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate, psnr, rmse_db, unit_image
from warprrf.rf.spectra.spectrum import to_db

TRAINING = 10
TEST = 20

HELP = """\
Six cases: 140 and 300 GHz, with the surfaces' assumed roughness, three times it and a third of it. A handful of receivers
chooses the smallest model within a tolerance, others judge it; last, fields are fitted with and without the choice.

examples:
  python -m benchmarks relevance
  python -m benchmarks relevance --no-fit
"""


@dataclass(frozen=True)
class Options:
    """Options of the judgement.

    Attributes:
        data: folder with ``scene.xml``, ``materials.json`` and ``spectra.nc``, whose receivers are used.
        fit: whether fields are fitted with and without the choice, too.
        carriers_hz: carriers; each inside the bands of all materials.
        roughness: names and factors of the rms roughness.
        tolerances_db: tolerances of the choice.
        choosers, judges: how many receivers choose and how many others judge, half of each blocked; with 8 choosers
            the few receivers that a mirror lights strongly may be missed.
        shape: rows and columns of the spectra.
    """

    data: str = option("data/lobby", "folder of the scene and of spectra.nc")
    fit: bool = option(True, "fit fields with and without the choice, too")
    carriers_hz: tuple[float, ...] = (140e9, 300e9)
    roughness: tuple[tuple[str, float], ...] = (
        ("as assumed", 1.0),
        ("rough (x3)", 3.0),
        ("smooth (x1/3)", 1.0 / 3.0),
    )
    tolerances_db: tuple[float, ...] = (0.1, 1.0)
    choosers: int = 12
    judges: int = 12
    shape: tuple[int, int] = (60, 120)


def run(options: Options, job: Job) -> Report:
    """Judge the choices.

    The figures hold ``cases``, one a carrier and roughness, with ``choices``, one a tolerance; and ``fits``.

    Raises:
        FileNotFoundError, ValueError: for missing data or a carrier outside a material's band.
    """
    scene = Scene.load(Path(options.data) / "scene.xml")
    spectra = SpectrumDataset.load(Path(options.data) / "spectra.nc")
    chosen, judging = _draw(spectra, options.choosers, options.judges, job.seed)
    variants = [(hz, name, factor) for hz in options.carriers_hz for name, factor in options.roughness]
    cases: list[dict[str, Any]] = []
    as_measured: list[Relevance] = []
    for done, (hz, name, factor) in enumerate(variants):
        job.progress("cases", done, len(variants))
        other = _rougher(scene, factor)
        asked: dict[str, Any] = {
            "transmitter": spectra.transmitter, "frequency_hz": hz, "shape": options.shape,
            "beam_sigma_rad": spectra.beam_sigma_rad, "device": job.device,
        }  # fmt: skip
        start = time.perf_counter()
        found = relevances(other, options.tolerances_db, receivers=spectra.receivers[chosen], **asked)
        seconds = time.perf_counter() - start
        full = full_field(other, **asked)[0]
        cases.append(
            {
                "frequency_hz": hz, "roughness": name, "factor": factor, "seconds": seconds,
                "effects": found[0].to_dict()["effects"], "table": found[0].table(),
                "choices": _judge(full, found, spectra.receivers[judging]),
            }
        )  # fmt: skip
        if factor == 1.0 and hz == float(spectra.frequency_hz):
            as_measured = found
    job.progress("cases", len(variants), len(variants))
    figures = {
        "receivers": {"choose": len(chosen), "judge": len(judging)},
        "shape": options.shape,
        "tolerances_db": options.tolerances_db,
        "cases": cases,
        "fits": _fits(scene, spectra, as_measured, job) if options.fit and as_measured else [],
    }
    caption = "What each effect is worth in the lobby: larger of the changes of the dB image and the total path gain, rms."
    return Report(
        "relevance", figures, text(figures), {"relevance.png": (lambda: _picture(figures), caption)}, dpi=130
    )


def _draw(spectra: SpectrumDataset, choosers: int, judges: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Receivers that choose and others that judge, half of each blocked."""
    order = np.random.default_rng(seed).permutation(len(spectra.receivers))
    seen = np.asarray(spectra.line_of_sight, bool)[order]
    dark, lit = order[~seen], order[seen]
    a, b = choosers // 2, judges // 2
    if len(dark) < a + b or len(lit) < choosers - a + judges - b:
        raise ValueError(
            f"choosers, judges: got {choosers} and {judges}, but the data hold {len(lit)} receivers with line of sight "
            f"and {len(dark)} without; expected half of each"
        )
    first = np.concatenate([dark[:a], lit[: choosers - a]])
    return first, np.concatenate([dark[a : a + b], lit[choosers - a : choosers - a + judges - b]])


def _rougher(scene: Scene, factor: float) -> Scene:
    materials = [replace(m, roughness_m=m.roughness_m * factor) for m in scene.materials]
    return Scene(
        scene.mesh,
        materials,
        scene.face_material,
        face_object=scene.face_object,
        object_names=scene.object_names,
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _judge(full: BistaticField, found: list[Relevance], receivers: np.ndarray) -> list[dict[str, Any]]:
    """Each choice beside the full model; times are taken in turn, receiver by receiver, set-up apart."""
    fields = [full, *(one.reduce(full) for one in found)]
    images: list[list[np.ndarray]] = [[] for _ in fields]
    seconds = np.zeros((len(fields), len(receivers)))
    for field in fields:
        field.spectrum(receivers[0])
    for r, receiver in enumerate(receivers):
        for k, field in enumerate(fields):
            start = time.perf_counter()
            images[k].append(np.asarray(field.spectrum(receiver).path_gain, np.float64))
            seconds[k, r] = time.perf_counter() - start
    truth, rows = np.stack(images[0]), []
    for k, one in enumerate(found, start=1):
        image, floor = np.stack(images[k]), one.floor
        span = (10 * np.log10(floor), float(to_db(truth.max(), floor)))
        totals = [10 * np.log10(x.sum(axis=(1, 2)) + floor) for x in (image, truth)]
        pairs = list(zip(image, truth, strict=True))
        error = [rmse_db(to_db(a, floor), to_db(b, floor)) for a, b in pairs]
        score = [psnr(unit_image(a, floor, span), unit_image(b, floor, span)) for a, b in pairs]
        rows.append(
            {
                "tolerance_db": one.tolerance_db, "kept": one.kept, "missing": one.missing,
                "terms": one.to_dict()["terms"], "own_image_db": one.image_db, "own_total_db": one.total_db,
                "image_db": _rms(np.array(error)), "total_db": _rms(totals[0] - totals[1]),
                "psnr_db": float(np.mean(score)), "full_s": float(np.median(seconds[0])),
                "reduced_s": float(np.median(seconds[k])), "time_ratio": float(np.median(seconds[k] / seconds[0])),
            }
        )  # fmt: skip
    return rows


def _fits(scene: Scene, spectra: SpectrumDataset, found: list[Relevance], job: Job) -> list[dict[str, Any]]:
    """A fit to measured spectra with every term free, and with those off that the choice rules out."""
    train, test = spectra.split(TRAINING)
    test = test.subset(np.arange(min(TEST, len(test))))
    rows = []
    options: list[tuple[str, dict[str, Any]]] = [("every term free", {})]
    options += [(f"relevance, {one.tolerance_db:g} dB", {"relevance": one}) for one in found]
    for done, (name, given) in enumerate(options):
        job.progress("fits", done, len(options))
        start = time.perf_counter()
        field = RadioField.fit(scene, train, device=job.device, **given)
        seconds = time.perf_counter() - start
        score = evaluate(test, field.spectrum)
        rows.append(
            {
                "fit": name, "receivers": len(train), "seconds": seconds, "psnr_db": score["psnr_db"],
                "rmse_db": score["rmse_db"], "seconds_per_spectrum": score["seconds_per_spectrum"],
                "tolerance_db": given["relevance"].tolerance_db if given else None,
            }
        )  # fmt: skip
    job.progress("fits", len(options), len(options))
    return rows


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    lines = []
    for case in figures["cases"]:
        names = [e["name"] for e in case["effects"] if e["kept"] is not None]
        for row in case["choices"]:
            gone = ", ".join(title(n) for n in names if n not in row["kept"]) or "nothing"
            lines.append(
                {**row, "ghz": case["frequency_hz"] / 1e9, "roughness": case["roughness"], "gone": gone}
            )
    columns = (
        ("ghz", "carrier", "{:g} GHz"), ("roughness", "roughness", "{}"), ("tolerance_db", "tolerance", "{:g} dB"),
        ("gone", "left out", "{}"), ("image_db", "image, rms", "{:.2f} dB"), ("total_db", "total, rms", "{:.3f} dB"),
        ("psnr_db", "PSNR", "{:.1f} dB"), ("full_s", "full spectrum [s]", "{:.3f}"),
        ("reduced_s", "reduced [s]", "{:.3f}"), ("time_ratio", "ratio", "{:.2f}"),
    )  # fmt: skip
    about = figures["receivers"]
    parts = [
        f"The lobby: {about['choose']} receivers choose, {about['judge']} others judge, half of them blocked.",
        columns_table(columns, lines),
    ]
    if figures["fits"]:
        fitted = (
            ("fit", "fit", "{}"), ("receivers", "training receivers", "{}"), ("seconds", "fit [s]", "{:.1f}"),
            ("psnr_db", "PSNR [dB]", "{:.2f}"), ("rmse_db", "RMSE [dB]", "{:.2f}"),
            ("seconds_per_spectrum", "query [s]", "{:.3f}"),
        )  # fmt: skip
        parts.append(columns_table(fitted, figures["fits"]))
    for case in figures["cases"]:
        parts += [f"### {case['frequency_hz'] / 1e9:g} GHz, {case['roughness']}", case["table"]]
    return "\n\n".join(parts)


def _picture(figures: dict[str, Any]) -> Any:
    """Bars of what each effect is worth, a panel for each carrier, a colour for each roughness."""
    carriers = list(dict.fromkeys(case["frequency_hz"] for case in figures["cases"]))
    names = list(
        dict.fromkeys(e["name"] for c in figures["cases"] for e in c["effects"] if e["worth_db"] is not None)
    )
    figure, axes = figure_of(len(carriers), (12.0, 5.6), sharey=True)
    least = 1e-3
    for ax, hz in zip(axes, carriers, strict=True):
        cases = [case for case in figures["cases"] if case["frequency_hz"] == hz]
        height = 0.8 / len(cases)
        for k, case in enumerate(cases):
            worth = {e["name"]: e["worth_db"] for e in case["effects"]}
            values = [max(worth.get(name) or 0.0, least) for name in names]
            place = np.arange(len(names)) + (k - 0.5 * (len(cases) - 1)) * height
            ax.barh(place, values, height, left=0.0, label=case["roughness"], color=f"C{k}")
        for tolerance, style in zip(figures["tolerances_db"], ("-", "--", ":", "-."), strict=False):
            ax.axvline(
                tolerance, color="black", linewidth=1.0, linestyle=style, label=f"tolerance {tolerance:g} dB"
            )
        ax.set(xscale="log", xlim=(least, 60.0), xlabel="change without it [dB]", title=f"{hz / 1e9:g} GHz")
        ax.set_yticks(np.arange(len(names)), [title(name) for name in names])
        ax.grid(axis="x", linewidth=0.4, alpha=0.5)
        ax.set_axisbelow(True)
    axes[0].invert_yaxis()
    axes[-1].legend(loc="lower right", fontsize=8)
    return figure


BENCHMARKS = {"relevance": Benchmark("relevance", Options, run, HELP)}
