"""Pictures of the engine's evaluation: time and error of each knob, and how cost grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.pictures import figure_of
from warprrf.device import require

Row = dict[str, Any]
COLOUR, MARKED = "#0b6e99", "#b3123c"
LEAST = 1e-9  # where no setting errs at all


@dataclass(frozen=True)
class Panel:
    """Settings of one knob.

    Attributes:
        title: name of the knob.
        labels: name of each setting.
        errors, error_label: what each errs by, drawn on a logarithmic axis.
        costs, cost_label: what each costs.
        chosen: index of the setting that is picked, or None.
        ordered: whether the settings follow one another, so that a line between them means something.
    """

    title: str
    labels: list[str]
    errors: list[float]
    error_label: str
    costs: list[float]
    cost_label: str
    chosen: int | None = None
    ordered: bool = True


def panels(shown: list[Panel], columns: int = 3) -> Any:
    """A panel a knob: bars for cost on the right axis, points for error on the left; the setting picked in red."""
    rows = -(-len(shown) // columns)
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(5.2 * columns, 3.9 * rows), layout="constrained"
    )
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, panel in zip(axes, shown, strict=False):
        place = np.arange(len(panel.labels))
        picked = [MARKED if k == panel.chosen else COLOUR for k in place]
        cost = ax.twinx()
        bars = cost.bar(place, panel.costs, width=0.62, color=picked, alpha=0.25)
        cost.bar_label(bars, [f"{c:.3g}" for c in panel.costs], fontsize=7, color="#555555")
        cost.set_ylim(0, 1.25 * max(panel.costs))
        cost.set_ylabel(panel.cost_label + " (bars)", color="#555555")
        least = min([e for e in panel.errors if e > 0], default=LEAST) / 10
        errors = [max(e, least) for e in panel.errors]
        if panel.ordered:
            ax.plot(place, errors, color="black", linewidth=0.9, alpha=0.5)
        ax.scatter(place, errors, c=picked, s=34, zorder=3)
        for k, error in enumerate(panel.errors):
            if error <= 0:
                ax.annotate(
                    "none",
                    (place[k], least),
                    xytext=(0, 6),
                    textcoords="offset points",
                    ha="center",
                    fontsize=7,
                )
        ax.set_yscale("log")
        ax.margins(y=0.12)
        ax.set_zorder(cost.get_zorder() + 1)
        ax.patch.set_visible(False)
        ax.set_xticks(place, panel.labels, fontsize=8, rotation=30, ha="right", rotation_mode="anchor")
        ax.set_title(panel.title, fontsize=11)
        ax.set_ylabel(panel.error_label + " (points)")
        ax.grid(alpha=0.3, axis="y")
    for ax in axes[len(shown) :]:
        ax.axis("off")
    return figure


def growth(curves: dict[str, tuple[str, list[tuple[float, float]]]]) -> Any:
    """A panel a quantity: seconds over it, both axes logarithmic; {title: (axis label, [(amount, seconds)])}."""
    figure, axes = figure_of(len(curves), size=(4.8 * len(curves), 4.2))
    for ax, (title, (label, points)) in zip(axes, curves.items(), strict=True):
        x, y = np.array(points, dtype=float).T
        ax.loglog(x, y, color=COLOUR, marker="o", markersize=5, label="measured")
        ax.loglog(x, y[-1] * x / x[-1], color="#888888", linestyle=":", label="proportional")
        ax.xaxis.set_minor_formatter(require("matplotlib.ticker", extra="plots").NullFormatter())
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
    ax.legend(fontsize=9, ncols=2, loc="upper right")
    ax.set_ylim(0, 1.35 * max([1.0, *(row[r]["over_bare"] for row in shown for r in ("chosen", "warp"))]))
    return figure
