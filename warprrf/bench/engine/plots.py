"""Pictures of the engine's evaluation: time against error of each knob, and how cost grows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warprrf.bench.pictures import figure_of
from warprrf.device import require

Row = dict[str, Any]
COLOUR, MARKED = "#0b6e99", "#b3123c"
LEAST_DB = 1e-6
"""Errors below this are drawn here: no error at all has no logarithm."""


def time_against_error(
    panels: dict[str, list[Row]], labels: dict[str, Callable[[Any], str]], chosen: dict[str, Any]
) -> Any:
    """A panel a knob: rms error [dB] over milliseconds, each setting named, the one chosen in red."""
    columns = 3
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(15.0, 4.4 * -(-len(panels) // columns)), layout="constrained"
    )
    axes = figure.subplots(-(-len(panels) // columns), columns, squeeze=False).ravel()
    for ax, (name, rows) in zip(axes, panels.items(), strict=False):
        x = np.array([1e3 * row["seconds"] for row in rows])
        y = np.array([max(row["error_rms_db"], LEAST_DB) for row in rows])
        ax.plot(x, y, color=COLOUR, linewidth=0.9, alpha=0.5)
        for k, row in enumerate(rows):
            picked = row["value"] == chosen.get(name)
            ax.plot(x[k], y[k], marker="o", markersize=9 if picked else 5, color=MARKED if picked else COLOUR)
            ax.annotate(
                labels[name](row["value"]), (x[k], y[k]), xytext=(5, 5 if k % 2 == 0 else -12),
                textcoords="offset points", fontsize=8, fontweight="bold" if picked else "normal",
            )  # fmt: skip
        ax.set_yscale("log")
        ax.margins(x=0.18, y=0.12)
        ax.set_title(name)
        ax.set_xlabel("milliseconds a receiver")
        ax.set_ylabel("rms error [dB]")
        ax.grid(alpha=0.3, which="both")
    for ax in axes[len(panels) :]:
        ax.axis("off")
    return figure


def growth(curves: dict[str, tuple[str, list[tuple[float, float]]]]) -> Any:
    """A panel a quantity: seconds over it, both axes logarithmic; {title: (axis label, [(amount, seconds)])}."""
    figure, axes = figure_of(len(curves), size=(4.8 * len(curves), 4.2))
    for ax, (title, (label, points)) in zip(axes, curves.items(), strict=True):
        x, y = np.array(points, dtype=float).T
        ax.loglog(x, y, color=COLOUR, marker="o", markersize=5, label="measured")
        ax.loglog(x, y[-1] * x / x[-1], color="#888888", linestyle=":", label="proportional")
        ax.set_title(title)
        ax.set_xlabel(label)
        ax.set_ylabel("seconds")
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=9)
    return figure


def counts(rows: list[Row]) -> Any:
    """What more Gaussians buy on a known surface: image error, range error and time."""
    figure, axes = figure_of(3, size=(14.4, 4.2))
    x = [row["gaussians"] for row in rows]
    for ax, key, label, factor in (
        (axes[0], "error_rms_db", "rms error of the image [dB]", 1.0),
        (axes[1], "range_error_median_m", "median range error of the peak [mm]", 1e3),
        (axes[2], "seconds", "milliseconds a spectrum", 1e3),
    ):
        ax.loglog(x, [factor * row[key] for row in rows], color=COLOUR, marker="o", markersize=5)
        ax.set_xlabel("discs on the room's mesh")
        ax.set_ylabel(label)
        ax.grid(alpha=0.3, which="both")
    return figure


def forms(responses: list[Row], exponentials: list[Row]) -> Any:
    """Mean error of the response over nanoseconds a pair, a panel a regime; last the exponentials, largest error."""
    regimes = list(dict.fromkeys(row["regime"] for row in responses))
    figure, axes = figure_of(len(regimes) + 1, size=(4.6 * (len(regimes) + 1), 4.4))
    groups: list[tuple[str, list[Row], str, str]] = [
        (regime, [r for r in responses if r["regime"] == regime], "error_mean", "ns_per_pair")
        for regime in regimes
    ]
    groups.append(("exp(-h), strips of 16", exponentials, "error_max", "ns_per_value"))
    for ax, (title, rows, error, cost) in zip(axes, groups, strict=True):
        for k, row in enumerate(rows):
            ax.plot(row[cost], max(row[error], 1e-9), marker="o", color=COLOUR, linestyle="none")
            ax.annotate(
                row["form"], (row[cost], max(row[error], 1e-9)), xytext=(5, 6 if k % 2 == 0 else -12),
                textcoords="offset points", fontsize=8,
            )  # fmt: skip
        ax.set_yscale("log")
        ax.set_xlim(left=0)
        ax.margins(x=0.3, y=0.15)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("nanoseconds a pair" if cost == "ns_per_pair" else "nanoseconds a value")
        ax.set_ylabel("mean error of the response" if error == "error_mean" else "largest error")
        ax.grid(alpha=0.3, which="both")
    return figure


def rays(rows: list[Row], asked: dict[str, float]) -> Any:
    """Speed over bare Embree, a group a mesh and kind of rays."""
    figure, (ax,) = figure_of(1, size=(11.0, 4.4))
    shown = [row for row in rows if "embree bare" in row]
    place = np.arange(len(shown))
    for k, (runner, name, colour) in enumerate(
        (("chosen", "what Mesh chooses", MARKED), ("warp", "Warp's hierarchy", COLOUR))
    ):
        ratio = [row[runner]["over_bare"] for row in shown]
        bars = ax.bar(place + 0.36 * (k - 0.5), ratio, width=0.34, color=colour, label=name)
        ax.bar_label(bars, [f"{v:.2f}" for v in ratio], fontsize=8, padding=2)
        ax.axhline(
            asked[runner], color=colour, linestyle="--", linewidth=1.0, label=f"asked: {asked[runner]:g}"
        )
    ax.set_xticks(place, [f"{row['mesh']}\n{row['kind']}" for row in shown], fontsize=8)
    ax.set_ylabel("rays per second over bare Embree's")
    ax.legend(fontsize=9, ncols=2)
    ax.set_ylim(0, 1.25 * max([1.0, *(row[r]["over_bare"] for row in shown for r in ("chosen", "warp"))]))
    return figure
