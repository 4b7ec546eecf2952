"""Pictures of the evaluation: PSNR curves, ablation, reliability, optimisers."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.pictures import METHODS, figure_of
from warprrf.device import require

ASKED_WITHIN = {1: (0.60, 0.76), 2: (0.90, 0.98)}
"""Share of pixels within so many standard deviations."""
TRUTH_NAMES = {"exact": "exact", "sionna": "Sionna RT"}
WHOLE = "everything"  # the ablation's row that leaves nothing out

Row = dict[str, Any]


def psnr_curves(rows: list[Row]) -> Any:
    """PSNR against training receivers, a panel a truth, a curve a method; what sees no spectrum is a level."""
    truths = list(dict.fromkeys(row["truth"] for row in rows))
    figure, axes = figure_of(len(truths), size=(7.0 * len(truths), 5.2))
    for ax, truth in zip(axes, truths, strict=True):
        for method, (name, colour) in METHODS.items():
            own = sorted(
                (r["n_train"], r["psnr_db"]) for r in rows if (r["truth"], r["method"]) == (truth, method)
            )
            if not own:
                continue
            if own[0][0] == 0:
                ax.axhline(own[0][1], color=colour, linestyle="--", linewidth=1.4, label=name)
            else:
                ax.plot(*zip(*own, strict=True), color=colour, marker="o", markersize=5, label=name)
        counts = sorted({r["n_train"] for r in rows if r["truth"] == truth and r["n_train"]})
        ax.set_xscale("log")
        ax.set_xticks(counts, [str(n) for n in counts])
        ax.minorticks_off()
        if len(counts) == 1:
            ax.set_xlim(0.7 * counts[0], 1.4 * counts[0])
        ax.set_title(f"truth: {TRUTH_NAMES[truth]}")
        ax.set_xlabel("training receivers")
        ax.set_ylabel("PSNR [dB]")
        ax.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


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


def optimiser_curves(found: Row) -> Any:
    """Objective per pixel over time, both axes logarithmic."""
    figure, (ax,) = figure_of(1, size=(7.5, 4.6))
    for key, name, colour in (
        ("gauss_newton", "Gauss-Newton", METHODS["bistatic"][1]),
        ("adam", "Adam", METHODS["rf3dgs+"][1]),
    ):
        row = found[key]
        at, losses = np.array(row["at_s"]), np.array(row["losses"])
        marker = "o" if len(at) < 60 else None
        label = f"{name}: {row['objective']:.3f} dB$^2$ in {row['seconds']:.1f} s, {row['steps']} steps"
        ax.plot(at, losses, color=colour, marker=marker, markersize=4, label=label)
    ax.set_yscale("log")
    plain = require("matplotlib.ticker", extra="plots").ScalarFormatter
    ax.yaxis.set_major_formatter(plain())
    ax.yaxis.set_minor_formatter(plain())
    first = max(found["gauss_newton"]["at_s"][1] if len(found["gauss_newton"]["at_s"]) > 1 else 0.1, 1e-3)
    ax.set_xscale("symlog", linthresh=first)
    ax.set_xlim(left=0)
    ax.set_xlabel("time [s], linear up to the first Gauss-Newton step")
    ax.set_ylabel("objective a pixel [dB$^2$]")
    ax.set_title(f"{TRUTH_NAMES[found['truth']]}, {found['n_train']} training receivers", fontsize=10)
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=9)
    return figure
