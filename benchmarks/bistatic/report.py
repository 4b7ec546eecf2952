"""The bistatic field's evaluation as Markdown and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.pictures import METHODS, figure_of
from benchmarks.report import Row, cell, columns_table, table
from warprrf.rf.fields.bistatic.uncertainty import OUTLIERS

ASKED_WITHIN = {1: (0.60, 0.76), 2: (0.90, 0.98)}
"""Share of pixels within so many standard deviations, drawn beside what was found."""
TRUTH_NAMES = {"exact": "exact", "sionna": "Sionna RT"}
WHOLE = "everything"  # the ablation's row that leaves nothing out
VARIANT_NAMES = {"exp": "gain exp", "linear": "gain linear"}

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


# ----------------------------------------------------------------------------------------------------- tables


def text(found: dict[str, Any]) -> str:
    """All tables as Markdown."""
    parts = [_about(found)]
    if found["second"]:
        parts += ["### A transmitter never seen in training", _second_table(found["second"])]
    parts += ["### What each part is worth", _ablation_table(found["ablation"])]
    parts += ["### Stated uncertainty", _calibration_table(found["calibration"])]
    parts += ["### Delays", _delay_table(found["delays"])]
    return "\n\n".join(parts)


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
        "Of RF-3DGS+ the better variant stands here. `blocked`: receivers without line of sight "
        "alone. A spectrum's time is from nothing, a fit's is with transport cached."
    )
    return " ".join(parts)


def _second_table(rows: list[Row]) -> str:
    at = ", ".join(f"{x:g}" for x in rows[0]["transmitter"])
    about = (
        f"Transmitter at ({at}) m, exact engine, fields fitted to {rows[0]['n_train']} spectra of the first one, which "
        "`seen` scores. `first range`: by floor and range of the first data set, as `seen` is."
    )
    shown = [
        {**row, "name": _name(row), "seen": row["seen"]["psnr_db"], "first": row["first_range"]["psnr_db"]}
        for row in rows
    ]
    head = (
        ("name", "method", "{}"),
        ("seen", "PSNR seen [dB]", "{:.2f}"),
        ("first", "PSNR, first range [dB]", "{:.2f}"),
    )
    return f"{about}\n\n{columns_table((*head, *COLUMNS), shown)}"


def _ablation_table(rows: list[Row]) -> str:
    whole = {row["truth"]: row["psnr_db"] for row in rows if row["model"] == WHOLE}
    shown = [
        {
            **row,
            "at": f"{TRUTH_NAMES[row['truth']]}, {row['n_train']}",
            "change": row["psnr_db"] - whole[row["truth"]],
        }
        for row in rows
    ]
    head = (
        ("at", "truth, receivers", "{}"),
        ("model", "model", "{}"),
        ("change", "change [dB]", "{:+.2f}"),
    )
    timed = ("transport_s", "seconds_per_spectrum", "fit_s")
    return columns_table((*head, *(c for c in COLUMNS if c[0] not in timed)), shown)


def _calibration_table(rows: list[Row]) -> str:
    shares = [
        (f"within_{k}_sigma{part}", name, "{:.1%}")
        for k in (1, 2)
        for part, name in (("", f"within {k} sigma"), ("_lit", "lit"), ("_blocked", "blocked"))
    ]
    columns = (
        ("name", "truth", "{}"), ("n_train", "receivers", "{}"), *shares, ("nll", "negative log likelihood", "{:.3f}"),
        ("nll_constant", "of the best constant sigma", "{:.3f}"), ("nll_gaussian", "as a Gaussian", "{:.2f}"),
        ("nll_gaussian_constant", "constant, as a Gaussian", "{:.2f}"), ("sigma_median_db", "median sigma [dB]", "{:.2f}"),
        ("rms_error_db", "rms error [dB]", "{:.2f}"),
    )  # fmt: skip
    about = (
        "`lit`: pixels whose truth or prediction is above the floor. Negative log likelihood of a pixel [nat], a share "
        f"of {OUTLIERS:g} of the pixels taken to be outliers."
    )
    shown = [{**row, "name": TRUTH_NAMES[row["truth"]]} for row in rows]
    return f"{about}\n\n{columns_table(columns, shown)}"


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


def _name(row: Row) -> str:
    name = METHODS[row["method"]][0]
    variant = row.get("variant") or ""
    return f"{name} ({VARIANT_NAMES[variant]})" if variant else name


# --------------------------------------------------------------------------------------------------- pictures


def pictures(found: dict[str, Any]) -> dict[str, tuple[Callable[[], Any], str]]:
    """What is drawn, by file name."""
    drawn: dict[str, tuple[Callable[[], Any], str]] = {
        "ablation.png": (partial(ablation_bars, found["ablation"]), "PSNR with parts of the model left out."),
    }
    if any(row.get("shares") for row in found["calibration"]):
        caption = "Share of test pixels within the stated interval, against the share that was stated."
        drawn["reliability.png"] = partial(reliability, found["calibration"]), caption
    return drawn


def ablation_bars(rows: list[Row]) -> Any:
    """PSNR of the model with parts left out, a panel a truth."""
    truths = list(dict.fromkeys(row["truth"] for row in rows))
    names = list(dict.fromkeys(row["model"] for row in rows))
    others = {
        "zero spectra": "zero",
        "RF-3DGS+ with line of sight": "rf3dgs+los",
    }  # last, in their own colours
    order = [WHOLE, *(n for n in names if n != WHOLE and n not in others), *others]
    figure, axes = figure_of(len(truths), size=(7.0 * len(truths), 0.42 * len(order) + 1.2))
    for ax, truth in zip(axes, truths, strict=True):
        own = {row["model"]: row for row in rows if row["truth"] == truth}
        shown = [name for name in order if name in own]
        values = [own[name]["psnr_db"] for name in shown]
        colours = [METHODS[others.get(name, "bistatic")][1] for name in shown]
        bars = ax.barh(
            ["the whole model" if name == WHOLE else name for name in shown], values, color=colours
        )
        bars[0].set_edgecolor("black")
        ax.bar_label(bars, [f"{v:.1f}" for v in values], padding=4, fontsize=9)
        ax.axvline(values[0], color="black", linewidth=0.8, linestyle=":", zorder=0)
        ax.invert_yaxis()
        ax.set_xlim(0, 1.12 * max(values))
        ax.set_title(
            f"truth: {TRUTH_NAMES[truth]}, {own[shown[0]]['n_train']} training receivers", fontsize=10
        )
        ax.set_xlabel("PSNR [dB]")
    return figure


def reliability(rows: list[Row]) -> Any:
    """Share of pixels inside the stated interval against the stated share, with what is asked at 1 and 2 sigma."""
    truths = [
        t
        for t in dict.fromkeys(r["truth"] for r in rows)
        if any(r["truth"] == t and r.get("shares") for r in rows)
    ]
    figure, axes = figure_of(len(truths), size=(5.2 * len(truths), 5.0))
    for ax, truth in zip(axes, truths, strict=True):
        ax.plot([0, 1], [0, 1], color="#888888", linewidth=1.0, label="as stated")
        own = [row for row in rows if row["truth"] == truth and row.get("shares")]
        shades = np.linspace(0.45, 1.0, len(own))
        for row, shade in zip(own, shades, strict=True):
            ax.plot(
                row["levels"], row["shares"], color=METHODS["bistatic"][1], alpha=float(shade), marker=".",
                label=f"{row['n_train']} training receivers",
            )  # fmt: skip
        for stated, (low, high) in zip((0.6827, 0.9545), ASKED_WITHIN.values(), strict=True):
            ax.plot(
                [stated, stated], [low, high], color="#0b6e99", linewidth=5, alpha=0.45, solid_capstyle="butt"
            )
        ax.plot([], [], color="#0b6e99", linewidth=5, alpha=0.45, label="asked within 1 and 2 sigma")
        ax.set_xlim(0, 1)
        ax.set_ylim(0, 1)
        ax.set_aspect("equal")
        ax.grid(alpha=0.3)
        ax.set_title(f"truth: {TRUTH_NAMES[truth]}")
        ax.set_xlabel("stated share of pixels")
        ax.set_ylabel("share found")
        ax.legend(fontsize=9, loc="upper left")
    return figure
