"""The beams' figures as Markdown and pictures, drawn from ``beams.json`` alone."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from benchmarks.beams.users import KNOWN
from benchmarks.beams.users import table as users_table
from warprrf import device as _device
from warprrf.files import write_atomically, write_text

Row = dict[str, Any]
ASKED_WITHIN, ASKED_WITHIN_BLOCKED, ASKED_N_TRAIN = 0.90, 0.75, 10
NAMES = {
    "exhaustive": "exhaustive search",
    "powers": "true power of every path",
    "bistatic": "our field",
    "zero": "our geometry, zero spectra",
    "rf3dgs+": "RF-3DGS+",
    "nearest": "nearest neighbour's beam",
    "transmitter": "point at the transmitter",
    "hierarchical": "hierarchical search",
    "random": "random",
}
"""Methods in the order of the tables."""
COLOURS = {
    "exhaustive": "#222222",
    "powers": "#888888",
    "bistatic": "#0b6e99",
    "zero": "#4fb3bf",
    "rf3dgs+": "#a8200d",
    "nearest": "#c4870f",
    "transmitter": "#6a3d9a",
    "hierarchical": "#33883b",
    "random": "#bbbbbb",
}
SWEPT = {"rx": "receiver", "tx": "transmitter"}
RECEIVERS = {"_los": "line of sight", "_blocked": "blocked"}


def write(folder: str | os.PathLike[str]) -> Path:
    """Write ``beams.md`` and, with matplotlib, the pictures from ``beams.json`` in ``folder``.

    Raises:
        ValueError: if there is no ``beams.json``.
    """
    folder = Path(folder)
    if not (folder / "beams.json").is_file():
        raise ValueError(f"out: {folder} has no beams.json, expected the result of run_beams")
    report = json.loads((folder / "beams.json").read_text())
    text = "\n".join(_document(report)) + "\n"
    write_text(folder / "beams.md", text)
    try:
        figure_module = _device.require("matplotlib.figure", extra="plots")
    except ImportError:
        return folder / "beams.md"
    for truth, found in report["truths"].items():
        for swept in SWEPT:
            figure = over_elements(figure_module.Figure, found["links"], swept, truth)
            _save(figure, folder / f"beams_{truth}_{swept}.png")
        _save(
            over_training(figure_module.Figure, found["links"], truth), folder / f"beams_{truth}_training.png"
        )
    return folder / "beams.md"


def summary_text(report: dict[str, Any]) -> str:
    """What was asked beside what was measured, in plain text."""
    return "\n".join(_asked(report))


def _asked(report: dict[str, Any]) -> list[str]:
    lines = [
        f"| within 1 dB of exhaustive search, {ASKED_N_TRAIN} spectra, zero pilots | elements | all | blocked |",
        "|---|---|---|---|",
        f"| asked | | {ASKED_WITHIN:.0%} | {ASKED_WITHIN_BLOCKED:.0%} |",
    ]
    for truth, found in report["truths"].items():
        for method in ("bistatic", "zero", "transmitter", "powers"):
            for row in found["links"]:
                if row["method"] == method and row["n_train"] in (None, ASKED_N_TRAIN):
                    lines.append(
                        f"| {truth}: {NAMES[method]} | {row['ends']} | {_share(row['within'])} | "
                        f"{_share(row['within_blocked'])} |"
                    )
    return lines


def _document(report: dict[str, Any]) -> list[str]:
    lines = ["# Beams chosen from the field", "", *_asked(report), ""]
    for truth, found in report["truths"].items():
        lines += [
            f"## Truth: {truth}",
            "",
            f"{found['receivers']} test receivers, {found['blocked']} of them without line of sight. Transmitted "
            f"{report['tx_power_dbm']:g} dBm, noise {report['noise_dbm']:.1f} dBm over "
            f"{report['bandwidth_hz'] / 1e9:g} GHz, {report['frame_pilots']} pilots fill the time for which a beam "
            "holds. Line of sight / blocked.",
        ]
        for ends in dict.fromkeys(row["ends"] for row in found["links"]):
            rows = [row for row in found["links"] if row["ends"] == ends]
            lines += ["", f"### {ends} elements", ""]
            lines.append(
                "| method | spectra | pilots | within 1 dB, all | blocked | at one frequency, all | blocked | "
                "median loss [dB] | SNR [dB] | efficiency [bit/s/Hz] | without pilots' time |"
            )
            lines.append("|---|" + "---|" * 10)
            for row in sorted(rows, key=lambda r: (list(NAMES).index(r["method"]), r["n_train"] or 0)):
                lines.append(
                    f"| {NAMES[row['method']]} | {row['n_train'] or '-'} | {row['pilots']} | {_share(row['within'])} | "
                    f"{_share(row['within_blocked'])} | {_share(row['tone_within'])} | "
                    f"{_share(row['tone_within_blocked'])} | {_both(row, 'loss_db')} | {_both(row, 'snr_db')} | "
                    f"{_both(row, 'efficiency')} | {_both(row, 'efficiency_without_pilots')} |"
                )
        if "users" in found:
            lines += users_table(found["users"], NAMES | {KNOWN: "true channel of every element"})
        lines.append("")
    return lines


def over_elements(figure_class: Any, rows: list[Row], swept: str, truth: str) -> Any:
    """SNR and spectral efficiency over the size of one end's array."""
    figure = figure_class(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    counts = sorted({r["n_train"] for r in rows if r["n_train"] is not None})
    count = ASKED_N_TRAIN if ASKED_N_TRAIN in counts else counts[0]
    for column, (suffix, name) in enumerate(RECEIVERS.items()):
        for ax, quantity, label in (
            (axes[0, column], "snr_db", "median received SNR [dB]"),
            (axes[1, column], "efficiency", "mean efficiency less pilots [bit/s/Hz]"),
        ):
            for method in NAMES:
                chosen = [
                    r
                    for r in rows
                    if r["swept"] == swept and r["method"] == method and r["n_train"] in (None, count)
                ]
                points = sorted((r["elements"], r[quantity + suffix]) for r in chosen)
                if points and points[0][1] is not None:
                    ax.plot(*zip(*points, strict=True), label=NAMES[method], **_style(method))
            ax.set_xscale("log", base=4)
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
        axes[0, column].set_title(f"receivers: {name}", fontsize=11)
        axes[1, column].set_xlabel(f"elements of the {SWEPT[swept]}'s array")
    for ax in axes.flat:
        ax.set_xticks(sorted({r["elements"] for r in rows if r["swept"] == swept}))
        ax.minorticks_off()
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    figure.suptitle(f"Beams on the true channel ({truth}), {count} training receivers where any", fontsize=12)
    return figure


def over_training(figure_class: Any, rows: list[Row], truth: str) -> Any:
    """Spectral efficiency and shares within 1 dB over training receivers, for 256 elements at the receiver."""
    sizes = sorted({r["elements"] for r in rows if r["swept"] == "rx"})
    size = 256 if 256 in sizes else sizes[-1]
    of_size = [r for r in rows if r["swept"] == "rx" and r["elements"] == size]
    counts = sorted({r["n_train"] for r in of_size if r["n_train"] is not None})
    figure = figure_class(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for column, (suffix, name) in enumerate(RECEIVERS.items()):
        for ax, quantity, label in (
            (axes[0, column], "within", "share within 1 dB of exhaustive search"),
            (axes[1, column], "efficiency", "mean efficiency less pilots [bit/s/Hz]"),
        ):
            for method in NAMES:
                points = [(r["n_train"], r[quantity + suffix]) for r in of_size if r["method"] == method]
                if not points or points[0][1] is None:
                    continue
                if points[0][0] is None:
                    points = [(counts[0], points[0][1]), (counts[-1], points[0][1])]
                    ax.plot(
                        *zip(*points, strict=True), label=NAMES[method], **_style(method) | {"marker": ""}
                    )
                else:
                    ax.plot(*zip(*sorted(points), strict=True), label=NAMES[method], **_style(method))
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
        axes[0, column].set_ylim(-0.02, 1.04)
        axes[0, column].set_title(f"receivers: {name}", fontsize=11)
        axes[1, column].set_xlabel("training receivers")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    figure.suptitle(f"Beams of {size} elements at the receiver, true channel ({truth})", fontsize=12)
    return figure


def _style(method: str) -> dict[str, Any]:
    searched = method in ("exhaustive", "hierarchical", "powers")
    return {
        "color": COLOURS[method],
        "linestyle": "--" if searched else "-",
        "marker": "o",
        "markersize": 4,
        "linewidth": 2.2 if method == "bistatic" else 1.3,
        "zorder": 4 if searched else 3 if method == "bistatic" else 2,
    }


def _save(figure: Any, path: Path) -> None:
    write_atomically(path, lambda name: figure.savefig(name, dpi=110))


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _both(row: Row, name: str) -> str:
    values = (row[f"{name}_los"], row[f"{name}_blocked"])
    return " / ".join("-" if v is None else f"{v:.1f}" for v in values)
