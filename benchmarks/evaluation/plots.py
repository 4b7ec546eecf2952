"""Pictures of the evaluation: sparsity curves with bands, spectra side by side, speed against error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.evaluation.protocol import FEW, TRUTHS
from benchmarks.pictures import METHODS, figure_of
from benchmarks.report import Row
from warprrf.device import require

BANDED = ("bistatic", "rf3dgs+", "rf3dgs")
"""Methods whose smallest and largest values are drawn as bands; more would hide each other."""


def sparsity_curves(rows: Sequence[Row]) -> Any:
    """PSNR and SSIM against training receivers, a row of panels a truth; bands from least to most over receivers."""
    truths = list(dict.fromkeys(row["truth"] for row in rows))
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(12.5, 4.4 * len(truths) + 0.6), layout="constrained"
    )
    axes = figure.subplots(len(truths), 2, squeeze=False)
    for truth, panels in zip(truths, axes, strict=True):
        for ax, (key, name) in zip(panels, (("psnr_db", "PSNR [dB]"), ("ssim", "SSIM")), strict=True):
            _curves(ax, [row for row in rows if row["truth"] == truth], key)
            ax.set_ylabel(name)
            ax.set_title(f"truth: {TRUTHS[truth]}", fontsize=10)
    handles: dict[str, Any] = {}
    for ax in axes.flat:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=9, frameon=False
    )
    return figure


def _curves(ax: Any, rows: Sequence[Row], key: str) -> None:
    for method, (name, colour) in METHODS.items():
        own = sorted((row for row in rows if row["method"] == method), key=lambda row: row["count"])
        own = [row for row in own if row.get(key) is not None]
        if not own:
            continue
        if own[0]["count"] == 0:
            ax.axhline(own[0][key], color=colour, linestyle="--", linewidth=1.3, label=name)
            continue
        counts = [row["count"] for row in own]
        ax.plot(counts, [row[key] for row in own], color=colour, marker="o", markersize=4, label=name)
        if method in BANDED:
            low, high = ([row[f"{key}_{end}"] for row in own] for end in ("min", "max"))
            ax.fill_between(counts, low, high, color=colour, alpha=0.13, linewidth=0)
    counts = sorted({row["count"] for row in rows if row["count"]})
    ax.set_xscale("log")
    ax.set_xticks(counts, [str(n) for n in counts])
    ax.minorticks_off()
    if len(counts) == 1:
        ax.set_xlim(0.7 * counts[0], 1.4 * counts[0])
    ax.set_xlabel("training receivers (bands: least and most over the test receivers)")
    ax.grid(alpha=0.3)


def spectra_grid(
    truth_db: np.ndarray, predictions: Sequence[tuple[str, np.ndarray]], titles: Sequence[str], range_db: Any
) -> Any:
    """Truth and each method's spectra; columns are receivers, dB images ``(S, H, W)``."""
    rows = [("truth", truth_db), *predictions]
    halves = 2 if len(rows) > 8 else 1  # two blocks beside each other keep the page square
    tall = -(-len(rows) // halves)
    wide = len(titles)
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(3.6 * wide * halves + 0.8, 1.75 * tall + 0.6), layout="constrained"
    )
    axes = figure.subplots(tall, wide * halves, sharex=True, sharey=True, squeeze=False)
    low, high = (float(v) for v in range_db)
    shown = None
    for place in range(tall * halves):
        block, row = divmod(place, tall)
        for k in range(wide):
            ax = axes[row, block * wide + k]
            if place >= len(rows):
                ax.axis("off")
                continue
            name, images = rows[place]
            shown = ax.imshow(
                images[k], vmin=low, vmax=high, cmap="viridis", aspect="auto", interpolation="nearest",
                extent=(-180.0, 180.0, 180.0, 0.0),
            )  # fmt: skip
            ax.set_title(f"{name}: {titles[k]}", fontsize=8)
            ax.tick_params(labelsize=7)
    figure.colorbar(shown, ax=axes, label="path gain [dB]", shrink=0.6, aspect=40, pad=0.01)
    figure.supxlabel("azimuth [degrees]", fontsize=9)
    figure.supylabel("zenith [degrees]", fontsize=9)
    return figure


def speed_against_error(rows: Sequence[Row]) -> Any:
    """RMSE against the time of a spectrum and against training time, every method a point, a row of panels a count."""
    every = sorted({row["count"] for row in rows if row["count"]})
    counts = [n for n in every if n in FEW] or every[:3]
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(13.5, 4.6 * len(counts) + 0.4), layout="constrained"
    )
    axes = figure.subplots(len(counts), 2, squeeze=False)
    methods = [m for m in METHODS if any(row["method"] == m for row in rows)]
    number = {method: k + 1 for k, method in enumerate(methods)}
    for count, (left, right) in zip(counts, axes, strict=True):
        own = [row for row in rows if row["count"] in (0, count)]
        asked = [(row, row["seconds_per_spectrum"]) for row in own]
        _points(left, asked, number, "time of a spectrum [s]")
        taught = [(row, row["train_s"]) for row in own if row["train_s"]]
        _points(right, taught, number, "time to train, transport included [s]")
        for ax in (left, right):
            ax.set_title(f"truth: {TRUTHS[own[0]['truth']]}, {count} training receivers", fontsize=10)
    keys = [
        axes[0, 0].scatter([], [], color=METHODS[m][1], s=90, label=f"{number[m]}  {METHODS[m][0]}")
        for m in methods
    ]
    figure.legend(handles=keys, loc="outside right center", fontsize=9, frameon=False)
    return figure


def _points(ax: Any, rows: Sequence[tuple[Row, float]], number: dict[str, int], name: str) -> None:
    for row, seconds in rows:
        marker = "o" if row["count"] else "D"
        place = ([seconds], [row["rmse_db"]])
        ax.scatter(
            *place, color=METHODS[row["method"]][1], marker=marker, s=170, edgecolors="white", zorder=3
        )
        ax.text(
            seconds, row["rmse_db"], str(number[row["method"]]), color="white", fontsize=8, ha="center",
            va="center_baseline", zorder=4,
        )  # fmt: skip
    ax.set_xscale("log")
    ax.margins(x=0.12, y=0.12)
    ax.set_ylim(bottom=0)
    ax.set_xlabel(name)
    ax.set_ylabel("RMSE [dB]")
    ax.grid(alpha=0.3)


def law_bars(rows: Sequence[Row]) -> Any:
    """PSNR of RF-3DGS+ less that of RF-3DGS against training receivers, a curve a truth."""
    figure, (left, right) = figure_of(2, size=(11.0, 4.0))
    colours = {"exact": "#b3123c", "sionna": "#0b6e99", "conference": "#c77f00", "paper-law": "#3a7d44"}
    for ax, key, name in ((left, "psnr_db", "PSNR [dB]"), (right, "ssim", "SSIM")):
        for truth in dict.fromkeys(row["truth"] for row in rows):
            own = [row for row in rows if row["truth"] == truth]
            ax.plot(
                [row["count"] for row in own], [row[key]["difference"] for row in own], marker="o",
                color=colours[truth], label=f"truth: {TRUTHS[truth]}",
            )  # fmt: skip
        counts = sorted({row["count"] for row in rows})
        ax.axhline(0.0, color="black", linewidth=0.8)
        ax.set_xscale("log")
        ax.set_xticks(counts, [str(n) for n in counts])
        ax.minorticks_off()
        if len(counts) == 1:
            ax.set_xlim(0.7 * counts[0], 1.4 * counts[0])
        ax.set_xlabel("training receivers")
        ax.set_ylabel(f"RF-3DGS+ less RF-3DGS, {name}")
        ax.grid(alpha=0.3)
    left.legend(fontsize=9)
    return figure


def learning_curves(rows: Sequence[Row]) -> Any:
    """Loss of each network's steps over its training time, relative to the first; a panel a method, a colour a truth, a
    line style a number of spectra."""
    methods, truths, counts = (
        list(dict.fromkeys(row[k] for row in rows)) for k in ("method", "truth", "count")
    )
    styles = dict(zip(sorted(counts, reverse=True), ("-", "--", ":", "-."), strict=False))
    figure, axes = figure_of(len(methods), size=(5.5 * len(methods), 4.0))
    for ax, method in zip(axes, methods, strict=True):
        for row in (row for row in rows if row["method"] == method):
            curve = np.asarray(row["loss_curve"]) / row["loss_curve"][0]
            minutes = np.linspace(0.0, row["fit_s"] / 60.0, len(curve))
            ax.plot(
                minutes, curve, styles.get(row["count"], "-"), color=f"C{truths.index(row['truth'])}",
                label=f"{TRUTHS[row['truth']]}, {row['count']} spectra",
            )  # fmt: skip
        ax.set_title(METHODS[method][0], fontsize=10)
        ax.set_xlabel("training time [min]")
        ax.set_ylabel("loss over that of the first fortieth")
        ax.set_yscale("log")
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    return figure
