"""The evaluation as Markdown, what was asked beside what was measured, and its pictures.

Drawn from ``bistatic.json`` and the shown spectra alone, so it can be drawn again without computing anything.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bistatic.plots import (
    ASKED_WITHIN,
    TRUTH_NAMES,
    WHOLE,
    Row,
    ablation_bars,
    optimiser_curves,
    psnr_curves,
    reliability,
)
from benchmarks.markdown import cell, table
from benchmarks.pictures import METHODS, spectrum_rows, write_page
from warprrf.rf.fields.bistatic.uncertainty import OUTLIERS

ASKED_MARGIN_DB: dict[str, dict[str, dict[int, float]]] = {
    "exact": {"rf3dgs+": {10: 9.0, 50: 8.0, 400: 6.0}, "rf3dgs+los": {10: 7.0, 50: 6.0, 400: 5.0}},
    "sionna": {"rf3dgs+": {10: 6.0, 50: 4.0, 400: 3.0}, "rf3dgs+los": {}},
}
"""By truth, baseline and training receivers: PSNR of the bistatic field over it, at least."""
ASKED_PSNR_DB = {("sionna", 50): 28.0}
ASKED_FIT_S = {50: 15.0}

VARIANT_NAMES = {"exp": "gain exp", "linear": "gain linear"}
AVERAGE_NAMES = {"db": "in dB", "linear": "in linear power"}

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("psnr_db_blocked", "blocked", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("ssim_blocked", "blocked", "{:.3f}"),
    ("rmse_db", "RMSE [dB]", "{:.2f}"),
    ("rmse_db_blocked", "blocked", "{:.2f}"),
    ("direction_within_3deg", "within 3 deg", "{:.0%}"),
    ("direction_within_3deg_blocked", "blocked", "{:.0%}"),
    ("beam_gain_loss_db_blocked", "beam loss, blocked [dB]", "{:.2f}"),
    ("tof_error_median_ns", "ToF [ns]", "{:.3f}"),
    ("tof_error_median_ns_blocked", "blocked", "{:.3f}"),
    ("transport_s", "transport [s]", "{:.1f}"),
    ("fit_s", "fit [s]", "{:.1f}"),
    ("seconds_per_spectrum", "a spectrum [s]", "{:.3f}"),
)


def write(folder: str | os.PathLike[str]) -> Path:
    """Write ``bistatic.md`` and the pictures from ``bistatic.json`` in ``folder``; returns the Markdown's path.

    Raises:
        ValueError: if there is no ``bistatic.json``.
        ImportError: if matplotlib is missing.
    """
    folder = Path(folder)
    if not (folder / "bistatic.json").is_file():
        raise ValueError(
            f"folder: {folder / 'bistatic.json'} is missing, expected the folder of a finished evaluation"
        )
    found = json.loads((folder / "bistatic.json").read_text())
    pictures: dict[str, Any] = {
        "psnr.png": psnr_curves(found["rows"]),
        "ablation.png": ablation_bars(found["ablation"]),
    }
    if any(row.get("shares") for row in found["calibration"]):
        pictures["reliability.png"] = reliability(found["calibration"])
    pictures["optimisers.png"] = optimiser_curves(found["optimisers"])
    captions = {
        "psnr.png": "PSNR on the test receivers against the number of training receivers.",
        "ablation.png": "PSNR with parts of the model left out.",
        "reliability.png": "Share of test pixels within the stated interval, against the share that was stated.",
        "optimisers.png": "Objective over time of Gauss-Newton and Adam on the same cached views.",
    }
    for shown in found["shown"]:
        with np.load(folder / shown["file"], allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        low, high = (float(v) for v in arrays["range_db"])
        for index, blocked in enumerate(shown["blocked"]):
            state = "blocked" if blocked else "line of sight"
            name = f"spectra-{shown['truth']}-{state.replace(' ', '_')}.png"
            predictions = {
                _name({"method": m, "variant": v}): arrays[m][index] for m, v in shown["methods"].items()
            }
            pictures[name] = spectrum_rows(arrays["truth"][index], predictions, low, high)
            at = ", ".join(f"{x:.2f}" for x in shown["receivers"][index])
            captions[name] = (
                f"Receiver at ({at}) m, {state}: {TRUTH_NAMES[shown['truth']]} truth, predictions from "
                f"{shown['n_train']} spectra, and their differences from the truth."
            )
    shown = {name: (figure, captions[name]) for name, figure in pictures.items()}
    return write_page(folder / "bistatic.md", summary_text(found), shown)


# ----------------------------------------------------------------------------------------------------- tables


def summary_text(found: dict[str, Any]) -> str:
    """All tables as Markdown."""
    parts = [
        _about(found),
        "### Asked and measured",
        table(("figure", "asked", "measured", ""), asked(found)),
    ]
    for truth in found["data"]:
        rows = [row for row in found["rows"] if row["truth"] == truth]
        parts += [f"### Methods, truth: {TRUTH_NAMES[truth]}", _method_table(rows)]
    parts += ["### Margins of the bistatic field", _margin_table(found["rows"])]
    if found["repeat"]:
        parts += ["### The truth against itself", _repeat_text(found["repeat"])]
    if found["second"]:
        parts += ["### A transmitter never seen in training", _second_table(found["second"])]
    parts += ["### What each part is worth", _ablation_table(found["ablation"])]
    parts += ["### Stated uncertainty", _calibration_table(found["calibration"])]
    parts += ["### Gauss-Newton and Adam", _optimiser_table(found["optimisers"])]
    parts += ["### Delays", _delay_table(found["delays"])]
    return "\n\n".join(parts)


def asked(found: dict[str, Any]) -> list[list[str]]:
    """Rows of figure, asked, measured, verdict; what this run did not measure is left out."""
    lines: list[list[str]] = []

    def add(name: str, wanted: str, value: str, met: bool) -> None:
        lines.append([name, wanted, value, "met" if met else "NOT met"])

    for row in margins(found["rows"]):
        for base in ("rf3dgs+", "rf3dgs+los"):
            least = row[base]["asked_db"]
            if least is not None:
                margin = row[base]["margin_db"]
                add(
                    f"PSNR over {METHODS[base][0]}, {_case(row)}",
                    f"at least {least:+g} dB",
                    f"{margin:+.2f} dB",
                    margin >= least,
                )
    for row in found["rows"]:
        least = ASKED_PSNR_DB.get((row["truth"], row["n_train"]))
        if least is not None and row["method"] == "bistatic":
            value = row["psnr_db"]
            add(f"PSNR, {_case(row)}", f"at least {least:g} dB", f"{value:.2f} dB", value >= least)
    for row in found["rows"]:
        most = ASKED_FIT_S.get(row["n_train"])
        if most is not None and row["method"] == "bistatic":
            value = row["fit_s"]
            add(
                f"fit with transport cached, {_case(row)}",
                f"at most {most:g} s",
                f"{value:.1f} s",
                value <= most,
            )
    for row in found["calibration"]:
        for k, (low, high) in ASKED_WITHIN.items():
            share = row.get(f"within_{k}_sigma")
            if share is not None:
                add(
                    f"pixels within {k} sigma, {_case(row)}",
                    f"{low:.0%} to {high:.0%}",
                    f"{share:.1%}",
                    low <= share <= high,
                )
    return lines


def margins(rows: list[Row]) -> list[Row]:
    """PSNR of the bistatic field less that of each baseline, a row a truth and number of training receivers."""
    known = {(row["truth"], row["n_train"], row["method"]): row for row in rows}
    lines = []
    for (truth, count, method), ours in known.items():
        if method != "bistatic":
            continue
        line: Row = {"truth": truth, "n_train": count, "psnr_db": ours["psnr_db"]}
        for base in ("rf3dgs+", "rf3dgs+los"):
            other = known[truth, count, base]
            line[base] = {
                "psnr_db": other["psnr_db"],
                "variant": other["variant"],
                "margin_db": ours["psnr_db"] - other["psnr_db"],
                "asked_db": ASKED_MARGIN_DB[truth][base].get(count),
            }
        lines.append(line)
    return lines


def _about(found: dict[str, Any]) -> str:
    parts = []
    for name, data in found["data"].items():
        subset = f", each {data['every']}th of them" if data["every"] > 1 else ""
        left = f"; not held: {', '.join(map(str, data['left_out']))}" if data["left_out"] else ""
        parts.append(
            f"{TRUTH_NAMES[name]}: {data['test']} test receivers ({data['blocked']} without line of sight){subset}, "
            f"{data['shape'][0]} x {data['shape'][1]} pixels, {data['frequency_hz'] / 1e9:g} GHz, training receivers "
            f"{', '.join(map(str, data['counts']))}{left}."
        )
    machine = found["machine"]
    parts.append(
        f"{machine['cores']} cores, {machine['processor']}, {machine['device']}; {found['seconds']:.0f} s in all. "
        "Of RF-3DGS+ and IDW the better variant of each row stands here. `blocked`: receivers without line of sight "
        "alone. A spectrum's time is from nothing, a fit's is with transport cached."
    )
    return " ".join(parts)


def _method_table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        cells = [cell(row.get(key), form) for key, _, form in COLUMNS]
        lines.append([str(row["n_train"]), _name(row), *cells])
    return table(("receivers", "method", *(name for _, name, _ in COLUMNS)), lines)


def _margin_table(rows: list[Row]) -> str:
    lines = []
    for row in margins(rows):
        cells = []
        for base in ("rf3dgs+", "rf3dgs+los"):
            r = row[base]
            wanted = "-" if r["asked_db"] is None else f"{r['asked_db']:+g}"
            cells += [f"{r['psnr_db']:.2f} ({VARIANT_NAMES[r['variant']]})", f"{r['margin_db']:+.2f}", wanted]
        lines.append([TRUTH_NAMES[row["truth"]], str(row["n_train"]), f"{row['psnr_db']:.2f}", *cells])
    bases = [METHODS[base][0] for base in ("rf3dgs+", "rf3dgs+los")]
    head = [h for base in bases for h in (f"{base} [dB]", "margin [dB]", "asked")]
    return table(("truth", "receivers", "bistatic [dB]", *head), lines)


def _repeat_text(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        lines.append(
            [
                TRUTH_NAMES[row["truth"]],
                str(row["receivers"]),
                " and ".join(map(str, row["seeds"])),
                *(cell(row.get(key), form) for key, _, form in COLUMNS[:11]),
            ]
        )
    head = ("truth", "receivers", "seeds", *(name for _, name, _ in COLUMNS[:11]))
    return "Two solves with different seeds: no prediction can be expected to score better.\n\n" + table(
        head, lines
    )


def _second_table(rows: list[Row]) -> str:
    at = ", ".join(f"{x:g}" for x in rows[0]["transmitter"])
    text = (
        f"Transmitter at ({at}) m, exact engine, fields fitted to {rows[0]['n_train']} spectra of the first one, which "
        "`seen` scores. `first range`: by floor and range of the first data set, as `seen` is."
    )
    lines = [
        [
            _name(row),
            f"{row['seen']['psnr_db']:.2f}",
            f"{row['psnr_db']:.2f}",
            f"{row['first_range']['psnr_db']:.2f}",
            *(cell(row.get(key), form) for key, _, form in COLUMNS[1:11]),
        ]
        for row in rows
    ]
    head = (
        "method",
        "PSNR seen [dB]",
        "PSNR [dB]",
        "PSNR, first range [dB]",
        *(n for _, n, _ in COLUMNS[1:11]),
    )
    return f"{text}\n\n{table(head, lines)}"


def _ablation_table(rows: list[Row]) -> str:
    chosen = [c for c in COLUMNS if c[0] not in ("transport_s", "seconds_per_spectrum", "fit_s")]
    whole = {row["truth"]: row["psnr_db"] for row in rows if row["model"] == WHOLE}
    lines = []
    for row in rows:
        lines.append(
            [
                f"{TRUTH_NAMES[row['truth']]}, {row['n_train']}",
                "the whole model" if row["model"] == WHOLE else row["model"],
                f"{row['psnr_db'] - whole[row['truth']]:+.2f}",
                *(cell(row.get(key), form) for key, _, form in chosen),
            ]
        )
    return table(("truth, receivers", "model", "change [dB]", *(name for _, name, _ in chosen)), lines)


def _calibration_table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        lines.append(
            [
                TRUTH_NAMES[row["truth"]],
                str(row["n_train"]),
                *(
                    cell(row.get(f"within_{k}_sigma{b}"), "{:.1%}")
                    for k in (1, 2)
                    for b in ("", "_lit", "_blocked")
                ),
                cell(row.get("nll"), "{:.3f}"),
                cell(row.get("nll_constant"), "{:.3f}"),
                cell(row.get("nll_gaussian"), "{:.2f}")
                + " / "
                + cell(row.get("nll_gaussian_constant"), "{:.2f}"),
                cell(row.get("sigma_median_db"), "{:.2f}"),
                cell(row.get("rms_error_db"), "{:.2f}"),
            ]
        )
    wanted = "; ".join(f"{low:.0%} to {high:.0%} within {k} sigma" for k, (low, high) in ASKED_WITHIN.items())
    head = (
        "truth", "receivers", "within 1 sigma", "lit", "blocked", "within 2 sigma", "lit", "blocked",
        "negative log likelihood", "of the best constant sigma", "both as Gaussians", "median sigma [dB]",
        "rms error [dB]",
    )  # fmt: skip
    text = (
        f"Asked: {wanted}. `lit`: pixels whose truth or prediction is above the floor. Negative log likelihood of a "
        f"pixel [nat], a share of {OUTLIERS:g} of the pixels taken to be outliers."
    )
    return f"{text}\n\n{table(head, lines)}"


def _optimiser_table(found: Row) -> str:
    reaches = found["adam_reaches_s"]
    text = (
        f"{TRUTH_NAMES[found['truth']]}, {found['n_train']} receivers: {found['pixels']} pixels, {found['parameters']} "
        "parameters, the same cached views, start and objective. Adam "
        + (
            "never comes within 1 % of Gauss-Newton's objective."
            if reaches is None
            else f"comes within 1 % of Gauss-Newton's objective after {reaches:.1f} s."
        )
    )
    lines = [
        [name, str(r["steps"]), f"{r['seconds']:.2f}", f"{r['objective']:.4f}"]
        for name, r in (("Gauss-Newton", found["gauss_newton"]), ("Adam", found["adam"]))
    ]
    return f"{text}\n\n{table(('optimiser', 'steps', 'time [s]', 'objective a pixel [dB^2]'), lines)}"


def _delay_table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        cells = []
        for kind in ("line_of_sight", "mirror"):
            r = row[kind]
            cells += [f"{cell(r['found'], '{:.0%}')} of {r['paths']}", _pair(r)]
        cells += [str(row["scattering"]["pixels"]), _pair(row["scattering"])]
        cells.append(cell(row["scattering"]["median_by_power_ns"], "{:.2g}"))
        lines.append([TRUTH_NAMES[row["truth"]], str(row["n_train"]), *cells])
    head = (
        "truth", "receivers", "line of sight found", "median / 90 % [ns]", "mirror found", "median / 90 % [ns]",
        "pixels of scattering", "median / 90 % [ns]", "median by power [ns]",
    )  # fmt: skip
    return (
        "Paths of the true scene (image method, at most one reflection) above the floor, found within 3 degrees; "
        "pixels away from those, delay of the data set. `-`: no delay is predicted at that quantile.\n\n"
        + table(head, lines)
    )


def _pair(row: Row) -> str:
    return " / ".join("-" if row[key] is None else f"{row[key]:.2g}" for key in ("median_ns", "p90_ns"))


def _case(row: Row) -> str:
    return f"{TRUTH_NAMES[row['truth']]}, {row['n_train']} receivers"


def _name(row: Row) -> str:
    name = METHODS[row["method"]][0]
    variant = row.get("variant") or ""
    said = AVERAGE_NAMES if row["method"] == "idw" else VARIANT_NAMES
    return f"{name} ({said[variant]})" if variant else name
