"""The beams' figures as Markdown and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.beams.users import KNOWN
from benchmarks.beams.users import table as users_table
from benchmarks.pictures import figure_of
from benchmarks.report import Row, columns_table

SHOWN_TRAINING = 10  # training spectra of the curves, where there are such
METHODS = {
    "exhaustive": ("exhaustive search", "#222222"),
    "powers": ("true power of every path", "#888888"),
    "bistatic": ("our field", "#0b6e99"),
    "zero": ("our geometry, zero spectra", "#4fb3bf"),
    "rf3dgs+": ("RF-3DGS+", "#a8200d"),
    "nearest": ("nearest neighbour's beam", "#c4870f"),
    "transmitter": ("point at the transmitter", "#6a3d9a"),
    "hierarchical": ("hierarchical search", "#33883b"),
    "random": ("random", "#bbbbbb"),
}
"""Name and colour of each method, in the order of the tables."""
COLUMNS = (
    ("name", "method", "{}"), ("n_train", "spectra", "{}"), ("pilots", "pilots", "{}"),
    ("within", "within 1 dB, all", "{:.0%}"), ("within_blocked", "blocked", "{:.0%}"),
    ("tone_within", "at one frequency, all", "{:.0%}"), ("tone_within_blocked", "blocked", "{:.0%}"),
    ("loss_db_los", "median loss [dB], seen", "{:.1f}"), ("loss_db_blocked", "blocked", "{:.1f}"),
    ("snr_db_los", "SNR [dB], seen", "{:.1f}"), ("snr_db_blocked", "blocked", "{:.1f}"),
    ("efficiency_los", "efficiency [bit/s/Hz], seen", "{:.1f}"), ("efficiency_blocked", "blocked", "{:.1f}"),
    ("efficiency_without_pilots_los", "without pilots' time, seen", "{:.1f}"),
    ("efficiency_without_pilots_blocked", "blocked", "{:.1f}"),
)  # fmt: skip


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    parts = ["# Beams chosen from the field"]
    for truth, found in figures["truths"].items():
        parts += [
            f"## Truth: {truth}",
            f"{found['receivers']} test receivers, {found['blocked']} of them without line of sight. Transmitted "
            f"{figures['tx_power_dbm']:g} dBm, noise {figures['noise_dbm']:.1f} dBm over "
            f"{figures['bandwidth_hz'] / 1e9:g} GHz, {figures['frame_pilots']} pilots fill the time for which a beam "
            "holds.",
        ]
        for ends in dict.fromkeys(row["ends"] for row in found["links"]):
            rows = [
                {**row, "name": METHODS[row["method"]][0]} for row in found["links"] if row["ends"] == ends
            ]
            rows.sort(key=lambda r: (list(METHODS).index(r["method"]), r["n_train"] or 0))
            parts += [f"### {ends} elements", columns_table(COLUMNS, rows)]
        if "users" in found:
            names = {method: name for method, (name, _) in METHODS.items()}
            parts.append(
                "\n".join(users_table(found["users"], names | {KNOWN: "true channel of every element"}))
            )
    return "\n\n".join(parts)


def pictures(figures: dict[str, Any]) -> dict[str, tuple[Callable[[], Any], str]]:
    """What is drawn, by file name."""
    caption = "SNR and spectral efficiency over the size of one end's array, on the true channel."
    return {
        f"beams_{truth}_{swept}_{suffix}.png": (
            partial(over_elements, found["links"], swept, suffix, f"{name}, truth {truth}"),
            caption,
        )
        for truth, found in figures["truths"].items()
        for swept in ("rx", "tx")
        for suffix, name in (("los", "line of sight"), ("blocked", "blocked"))
    }


def over_elements(rows: list[Row], swept: str, suffix: str, title: str) -> Any:
    """SNR and spectral efficiency over the size of one end's array."""
    own = [r for r in rows if r["swept"] == swept]
    counts = sorted({r["n_train"] for r in own if r["n_train"] is not None})
    count = SHOWN_TRAINING if SHOWN_TRAINING in counts else counts[0]
    names = {
        "snr_db": "median received SNR [dB]",
        "efficiency": "mean efficiency less pilots [bit/s/Hz]",
    }
    figure, axes = figure_of(2, (11.0, 4.2))
    for ax, (quantity, label) in zip(axes, names.items(), strict=True):
        for method, (name, colour) in METHODS.items():
            chosen = [r for r in own if r["method"] == method and r["n_train"] in (None, count)]
            points = sorted((r["elements"], r[f"{quantity}_{suffix}"]) for r in chosen)
            if points and points[0][1] is not None:
                ax.plot(*zip(*points, strict=True), "o-", label=name, color=colour, markersize=4)
        ax.set_xscale("log", base=4)
        ax.set_xticks(sorted({r["elements"] for r in own}))
        ax.minorticks_off()
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.set_xlabel("elements")
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    figure.suptitle(f"Array at the {'receiver' if swept == 'rx' else 'transmitter'}: {title}", fontsize=11)
    return figure
