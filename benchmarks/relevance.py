"""What each effect is worth in the lobby, and the reduced models beside the full one at receivers that did not choose.

Six cases: 140 and 300 GHz, with the surfaces' assumed roughness, three times it and a third of it. A handful of
receivers chooses the smallest model (:func:`warprrf.relevance`); other receivers judge it: rms difference of the dB
image, PSNR against the full model, change of the total path gain, time of a spectrum. Last, a field is fitted to
spectra with and without the choice.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stages import write_json
from warprrf.device import Progress, require
from warprrf.files import write_atomically, write_text
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.relevance.choice import rms
from warprrf.rf.relevance.model import full_field
from warprrf.rf.relevance.search import Relevance, relevances, title
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate, psnr, rmse_db, unit_image
from warprrf.rf.spectra.spectrum import to_db

DATA = "data/lobby"
CARRIERS_HZ = (140e9, 300e9)
ROUGHNESS = {"as assumed": 1.0, "rough (x3)": 3.0, "smooth (x1/3)": 1.0 / 3.0}
TOLERANCES_DB = (0.1, 1.0)
CHOOSERS = 12  # with 8 the few receivers that a mirror lights strongly may be missed
JUDGES = 12
TRAINING = 10
TEST = 20


def run(
    out: str | os.PathLike[str] = "runs/relevance",
    data: str | os.PathLike[str] = DATA,
    *,
    carriers_hz: tuple[float, ...] = CARRIERS_HZ,
    roughness: dict[str, float] | None = None,
    tolerances_db: tuple[float, ...] = TOLERANCES_DB,
    choosers: int = CHOOSERS,
    judges: int = JUDGES,
    shape: tuple[int, int] = (60, 120),
    fit: bool = True,
    seed: int = 0,
    device: Any = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Judge the choices and write ``relevance.json``, ``relevance.md`` and ``relevance.png`` into ``out``.

    Args:
        out: folder of the results.
        data: folder with ``scene.xml``, ``materials.json`` and ``spectra.nc``, whose receivers are used.
        carriers_hz: carriers; each inside the bands of all materials.
        roughness: factors of the rms roughness, by name.
        tolerances_db: tolerances of the choice.
        choosers, judges: how many receivers choose and how many others judge; half of each are blocked.
        shape: rows and columns of the spectra.
        fit: whether fields are fitted with and without the choice, too.
        seed: of the draw of receivers.

    Returns:
        ``cases``: one a carrier and roughness, with ``choices``: one a tolerance; ``fits``.

    Raises:
        FileNotFoundError, ValueError: for missing data or a carrier outside a material's band.
    """
    scene = Scene.load(Path(data) / "scene.xml")
    spectra = SpectrumDataset.load(Path(data) / "spectra.nc")
    tick = progress or (lambda stage, done, total: None)
    chosen, judging = _draw(spectra, choosers, judges, seed)
    factors = ROUGHNESS if roughness is None else roughness
    variants = [(hz, name) for hz in carriers_hz for name in factors]
    cases: list[dict[str, Any]] = []
    as_measured: list[Relevance] = []
    for done, (hz, name) in enumerate(variants):
        tick("cases", done, len(variants))
        other = _rougher(scene, factors[name])
        start = time.perf_counter()
        found = relevances(
            other, tolerances_db, transmitter=spectra.transmitter, receivers=spectra.receivers[chosen], frequency_hz=hz,
            shape=shape, beam_sigma_rad=spectra.beam_sigma_rad, device=device,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        full = full_field(
            other, transmitter=spectra.transmitter, frequency_hz=hz, shape=shape,
            beam_sigma_rad=spectra.beam_sigma_rad, device=device,
        )[0]  # fmt: skip
        choices = _judge(full, found, spectra.receivers[judging])
        cases.append(
            {
                "frequency_hz": hz, "roughness": name, "factor": factors[name], "seconds": seconds,
                "effects": found[0].to_dict()["effects"], "table": found[0].table(), "choices": choices,
            }
        )  # fmt: skip
        if factors[name] == 1.0 and hz == float(spectra.frequency_hz):
            as_measured = found
    tick("cases", len(variants), len(variants))
    report = {
        "receivers": {"choose": len(chosen), "judge": len(judging)},
        "shape": shape,
        "tolerances_db": tolerances_db,
        "cases": cases,
        "fits": _fits(scene, spectra, as_measured, tick, device) if fit and as_measured else [],
    }
    folder = Path(out)
    write_json(folder / "relevance.json", report)
    text = summary_text(report) + "\n"
    write_text(folder / "relevance.md", text)
    write_atomically(folder / "relevance.png", lambda name: _picture(report).savefig(name, dpi=130))
    return report


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


def _judge(full: BistaticField, found: list[Relevance], receivers: np.ndarray) -> list[dict[str, Any]]:
    """Each choice beside the full model; times are taken in turn, receiver by receiver, set-up apart."""
    fields = [full, *(one.reduce(full) for one in found)]
    images: list[list[np.ndarray]] = [[] for _ in fields]
    seconds = np.zeros((len(fields), len(receivers)))
    for field in fields:
        field.render(field.view(receivers[0]))
    for r, receiver in enumerate(receivers):
        for k, field in enumerate(fields):
            start = time.perf_counter()
            images[k].append(field.render(field.view(receiver)).image)
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
                "image_db": rms(np.array(error)), "total_db": rms(totals[0] - totals[1]),
                "psnr_db": float(np.mean(score)), "full_s": float(np.median(seconds[0])),
                "reduced_s": float(np.median(seconds[k])), "time_ratio": float(np.median(seconds[k] / seconds[0])),
            }
        )  # fmt: skip
    return rows


def _fits(
    scene: Scene, spectra: SpectrumDataset, found: list[Relevance], tick: Progress, device: Any
) -> list[dict[str, Any]]:
    """A fit to measured spectra with every term free, and with those off that the choice rules out."""
    train, test = spectra.split(TRAINING)
    test = test.subset(np.arange(min(TEST, len(test))))
    rows = []
    options: list[tuple[str, dict[str, Any]]] = [("every term free", {})]
    options += [(f"relevance, {one.tolerance_db:g} dB", {"relevance": one}) for one in found]
    for done, (name, option) in enumerate(options):
        tick("fits", done, len(options))
        start = time.perf_counter()
        field = RadioField.fit(scene, train, device=device, **option)
        seconds = time.perf_counter() - start
        score = evaluate(test, field.spectrum)
        rows.append(
            {
                "fit": name, "receivers": len(train), "seconds": seconds, "psnr_db": score["psnr_db"],
                "rmse_db": score["rmse_db"], "seconds_per_spectrum": score["seconds_per_spectrum"],
                "tolerance_db": option["relevance"].tolerance_db if option else None,
            }
        )  # fmt: skip
    tick("fits", len(options), len(options))
    return rows


def summary_text(report: dict[str, Any]) -> str:
    """The report as Markdown tables."""
    lines = [
        f"The lobby: {report['receivers']['choose']} receivers choose, {report['receivers']['judge']} others judge, "
        "half of them blocked.",
        "",
        "| carrier | roughness | tolerance | left out | image, rms | total, rms | PSNR | time of a spectrum |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case in report["cases"]:
        names = [e["name"] for e in case["effects"] if e["kept"] is not None]
        for row in case["choices"]:
            gone = ", ".join(title(n) for n in names if n not in row["kept"]) or "nothing"
            lines.append(
                f"| {case['frequency_hz'] / 1e9:g} GHz | {case['roughness']} | {row['tolerance_db']:g} dB | {gone} | "
                f"{row['image_db']:.2f} dB | {row['total_db']:.3f} dB | {row['psnr_db']:.1f} dB | "
                f"{1e3 * row['reduced_s']:.0f} of {1e3 * row['full_s']:.0f} ms ({row['time_ratio']:.2f}) |"
            )
    if report["fits"]:
        lines += [
            "",
            "| fit | training receivers | fit [s] | PSNR [dB] | RMSE [dB] | query [ms] |",
            "|---|---|---|---|---|---|",
        ]
        for row in report["fits"]:
            lines.append(
                f"| {row['fit']} | "
                f"{row['receivers']} | {row['seconds']:.1f} | {row['psnr_db']:.2f} | {row['rmse_db']:.2f} | "
                f"{1e3 * row['seconds_per_spectrum']:.0f} |"
            )
    for case in report["cases"]:
        lines += ["", f"### {case['frequency_hz'] / 1e9:g} GHz, {case['roughness']}", "", case["table"]]
    return "\n".join(lines)


def _picture(report: dict[str, Any]) -> Any:
    """Bars of what each effect is worth, a panel for each carrier, a colour for each roughness."""
    carriers = list(dict.fromkeys(case["frequency_hz"] for case in report["cases"]))
    names = list(
        dict.fromkeys(e["name"] for c in report["cases"] for e in c["effects"] if e["worth_db"] is not None)
    )
    figure = require("matplotlib.figure", extra="plots").Figure(figsize=(12.0, 5.6), layout="constrained")
    axes = figure.subplots(1, len(carriers), sharey=True, squeeze=False)[0]
    least = 1e-3
    for ax, hz in zip(axes, carriers, strict=True):
        cases = [case for case in report["cases"] if case["frequency_hz"] == hz]
        height = 0.8 / len(cases)
        for k, case in enumerate(cases):
            worth = {e["name"]: e["worth_db"] for e in case["effects"]}
            values = [max(worth.get(name) or 0.0, least) for name in names]
            place = np.arange(len(names)) + (k - 0.5 * (len(cases) - 1)) * height
            ax.barh(place, values, height, left=0.0, label=case["roughness"], color=f"C{k}")
        for tolerance, style in zip(report["tolerances_db"], ("-", "--", ":", "-."), strict=False):
            ax.axvline(
                tolerance, color="black", linewidth=1.0, linestyle=style, label=f"tolerance {tolerance:g} dB"
            )
        ax.set(xscale="log", xlim=(least, 60.0), xlabel="change without it [dB]", title=f"{hz / 1e9:g} GHz")
        ax.set_yticks(np.arange(len(names)), [title(name) for name in names])
        ax.grid(axis="x", linewidth=0.4, alpha=0.5)
        ax.set_axisbelow(True)
    axes[0].invert_yaxis()
    axes[-1].legend(loc="lower right", fontsize=8)
    figure.suptitle(
        "What each effect is worth in the lobby: larger of the changes of the dB image and the total path gain, rms",
        fontsize=11,
    )
    return figure
