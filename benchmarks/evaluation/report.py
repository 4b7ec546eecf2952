"""The evaluation as tables and pictures, drawn from the kept runs alone: every method beside the published figures, the
paper's figure, and what :mod:`~benchmarks.evaluation.comparison` found."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.evaluation.plots import (
    law_bars,
    learning_curves,
    sparsity_curves,
    spectra_grid,
    speed_against_error,
)
from benchmarks.evaluation.protocol import TRUTHS, Run
from benchmarks.evaluation.runs import pictures_of
from benchmarks.methods import METHODS as KNOWN
from benchmarks.pictures import METHODS
from benchmarks.report import Row, cell, table

PUBLISHED: tuple[Row, ...] = tuple(
    {
        "method": method, "psnr_db": psnr, "ssim": ssim, "lpips": lpips, "train_s": train,
        "seconds_per_spectrum": seconds, "published": True,
    }
    for method, psnr, ssim, lpips, train, seconds in (
        ("rf3dgs+", 19.68, 0.635, 0.439, 222.0, 3.4e-3),
        ("rf3dgs", 13.50, 0.476, 0.456, 167.0, 2.0e-3),
        ("nerf2", 13.34, 0.463, 0.691, 9120.0, 0.7),
        ("cgan", 10.33, 0.212, 0.874, 5220.0, 5.0e-3),
    )
)  # fmt: skip
"""Table I of Song et al., "Terahertz Spatial Wireless Channel Modeling with Radio Radiance Field"."""
PUBLISHED_NOTE = (
    "Published rows: Table I of the RF-3DGS+ paper, on its own lobby, its own colour images and range, and an NVIDIA "
    "RTX 4090: other data and other hardware, so neither errors nor times compare with the rows measured here."
)
VARIANT_NAMES = {
    "exp": "gain exp",
    "linear": "gain linear",
    "db": "in dB",
}
LINEAR_AVERAGE = "in linear power"

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("psnr_db_std", "over seeds", "{:.2f}"),
    ("psnr_db_min", "min", "{:.1f}"),
    ("psnr_db_max", "max", "{:.1f}"),
    ("psnr_db_blocked", "blocked", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("ssim_min", "min", "{:.2f}"),
    ("ssim_max", "max", "{:.2f}"),
    ("ssim_blocked", "blocked", "{:.3f}"),
    ("lpips", "LPIPS", "{:.3f}"),
    ("rmse_db", "RMSE [dB]", "{:.2f}"),
    ("rmse_db_blocked", "blocked", "{:.2f}"),
    ("direction_median_deg", "direction, median [deg]", "{:.1f}"),
    ("direction_median_deg_blocked", "blocked", "{:.1f}"),
    ("direction_within_3deg", "within 3 deg", "{:.0%}"),
    ("direction_within_3deg_blocked", "blocked", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"),
    ("beam_gain_loss_db_blocked", "blocked", "{:.2f}"),
    ("tof_error_median_ns", "ToF [ns]", "{:.3g}"),
    ("aod_error_median_deg", "AoD [deg]", "{:.2g}"),
    ("loss_first", "loss, first tenth", "{:.3g}"),
    ("loss_last", "last tenth", "{:.3g}"),
    ("train_s", "train [s]", "{:.4g}"),
    ("seconds_per_spectrum", "a spectrum [s]", "{:.3g}"),
    ("peak_memory_gib", "peak memory [GiB]", "{:.2f}"),
    ("peak_gpu_gib", "peak GPU memory [GiB]", "{:.2f}"),
    ("model_mib", "model [MiB]", "{:.3g}"),
)
LAW_TEXT = """\
What decides is the distance law. Light that a surface scatters arrives with a power per solid angle that does not
fall with the distance to the receiver, because the footprint of a pixel grows as fast as the power falls: it goes as
1 / d1^2 alone, d1 from the transmitter to the surface. RF-3DGS has no distances: a Gaussian sends the same to every
receiver in a direction, which is this law. RF-3DGS+ multiplies by (d1 + d2)^-2, which holds for mirror reflections and
line of sight, and must unlearn it from receiver to receiver."""


# ------------------------------------------------------------------------------------------------------- the text


def markdown(found: dict[str, Any]) -> str:
    """Everything as Markdown."""
    rows = found["rows"]
    parts = [_statement(found), _about(found)]
    places = list(dict.fromkeys((row["truth"], row["split"]) for row in rows))
    for truth, split in places:
        own = [row for row in rows if (row["truth"], row["split"]) == (truth, split)]
        own.sort(key=lambda row: (row["count"], list(KNOWN).index(row["method"])))
        published = PUBLISHED if (truth, split) == places[0] else ()
        where = "" if split == "random" else ", a region held out"
        parts += [f"### Methods, truth: {TRUTHS[truth]}{where}", method_table([*own, *published])]
        if published:
            parts.append(PUBLISHED_NOTE)
    notes = {row["method"]: row["note"] for row in rows if row.get("note")}
    parts.append("\n".join(f"- {METHODS[m][0]}: {note}." for m, note in notes.items()))
    random = [row for row in rows if row["split"] == "random"]
    for key, name in (("psnr_db", "PSNR [dB]"), ("ssim", "SSIM")):
        parts += [f"### {name}: mean (least to most over the test receivers)", _curve_table(random, key)]
    if found["margins"]:
        parts += ["### The bistatic field less each other method", _margin_table(found["margins"])]
    if found["finding"]:
        parts += ["### RF-3DGS+ against RF-3DGS", _finding_text(found["finding"])]
    return "\n\n".join(part for part in parts if part)


def _statement(found: dict[str, Any]) -> str:
    """What the paper found, what is found here, and why."""
    lines = [line for line in found["finding"] if line["split"] == "random" and not line["opacity"]]
    own = [
        line["psnr_db"]["difference"] for line in lines if line["truth"] in ("exact", "sionna", "conference")
    ]
    law = [line["psnr_db"]["difference"] for line in lines if line["truth"] == "paper-law"]
    if not own:
        return ""
    published = {row["method"]: row["psnr_db"] for row in PUBLISHED}
    text = (
        f"The paper found RF-3DGS+ {published['rf3dgs+'] - published['rf3dgs']:+.1f} dB above RF-3DGS. Here it is "
        f"{np.mean(own):+.1f} dB in the mean ({min(own):+.1f} to {max(own):+.1f}) over {len(own)} sets. "
    )
    return text + LAW_TEXT + (
        f" On targets that are made by the paper's law path by path the difference is {np.mean(law):+.1f} dB: there the law "
        "holds for every path, but not for the blended Gaussians of a pixel alike." if law else ""
    )  # fmt: skip


def _margin_table(margins: Sequence[Row]) -> str:
    forms = {
        "psnr_db": "{:+.1f}", "ssim": "{:+.2f}", "rmse_db": "{:+.1f}", "direction_within_3deg": "{:+.0%}",
        "beam_gain_loss_db": "{:+.1f}",
    }  # fmt: skip
    lines = [
        [
            TRUTHS[r["truth"]] + ("" if r["split"] == "random" else ", region"), str(r["count"]), METHODS[r["method"]][0],
            *(f"{cell(r[k], form)} / {cell(r[f'{k}_blocked'], form)}" for k, form in forms.items()),
            cell(r["psnr_db_std"], "{:.2f}"), str(r["seeds"]),
        ]
        for r in margins
    ]  # fmt: skip
    names = ("PSNR [dB]", "SSIM", "RMSE [dB]", "within 3 deg", "beam loss [dB]")
    return table(
        ["truth", "spectra", "against", *(f"{n}, all / blocked" for n in names), "over seeds [dB]", "seeds"],
        lines,
    )


def method_table(rows: Sequence[Row]) -> str:
    """One line a method, as Markdown."""
    lines = []
    for row in rows:
        count = "published" if row.get("published") else str(row["count"]) if row["count"] else "none"
        lines.append([count, name_of(row), *(cell(row.get(key), form) for key, _, form in COLUMNS)])
    return table(["receivers", "method", *(name for _, name, _ in COLUMNS)], lines)


def name_of(row: Row) -> str:
    """A method's name with the variant that stands for it."""
    name = METHODS[row["method"]][0]
    if row.get("published"):
        return f"{name} (published)"
    said = [
        LINEAR_AVERAGE if (row["method"], v) == ("idw", "linear") else VARIANT_NAMES[v]
        for v in row["variants"]
        if v
    ]
    return f"{name} ({' or '.join(said)})" if said else name


def csv_text(rows: Sequence[Row]) -> str:
    """All figures as comma-separated values, published rows last."""
    head = ["truth", "split", "count", "method", "variants", "seeds", *(key for key, _, _ in COLUMNS)]
    out = io.StringIO()
    writer = csv.DictWriter(out, [*head, "published"], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in [*rows, *PUBLISHED]:
        shown = {**row, "variants": " or ".join(row.get("variants", []))}
        writer.writerow({**shown, "published": int(bool(row.get("published")))})
    return out.getvalue()


def _about(found: dict[str, Any]) -> str:
    lines = []
    for name, data in found["data"].items():
        truth, split = name.split("/")
        where = "scattered" if split == "random" else "in the region that is held out"
        lines.append(
            f"{TRUTHS[truth]}, {split}: {data['test']} test receivers {where} ({data['blocked']} without line of "
            f"sight), {data['shape'][0]} x {data['shape'][1]} pixels, {data['frequency_hz'] / 1e9:g} GHz, range "
            f"{data['range_db'][0]:.1f} to {data['range_db'][1]:.1f} dB, data {data['content']}."
        )
    rooms = sorted({name for row in found["rows"] for name in row["rooms"]})
    if found["missing"]:
        lines.append(f"{len(found['missing'])} runs are missing.")
    devices = sorted({d for row in found["rows"] for d in row["devices"]})
    lines.append(
        f"{_seeds(found)}; reconstructions: {', '.join(rooms)}. Computed on {'; '.join(devices)}, "
        f"{found['seconds'] / 3600.0:.1f} h."
    )
    unseen = [row for row in found["rows"] if row["lpips"] is None]
    if unseen:
        lines.append(
            f"LPIPS: not computed for {len(unseen)} of {len(found['rows'])} rows, {unseen[0]['lpips_reason']}."
        )
    lines.append(
        "Training time is from raw spectra, transport included; a spectrum's is from nothing. Peak memory is that of "
        "the whole process. `blocked`: receivers without line of sight alone. Of variants the better one stands here."
    )
    return "\n".join(f"- {line}" for line in lines)


def _seeds(found: dict[str, Any]) -> str:
    count = max(row["seeds"] for row in found["rows"])
    return "One seed" if count == 1 else f"Means over up to {count} seeds"


def _curve_table(rows: Sequence[Row], key: str) -> str:
    rows = [row for row in rows if row["count"]]
    counts = sorted({row["count"] for row in rows if row["count"]})
    lines = []
    for truth in dict.fromkeys(row["truth"] for row in rows):
        own = [row for row in rows if row["truth"] == truth]
        for method in dict.fromkeys(row["method"] for row in own):
            cells = []
            for count in counts:
                row = next((r for r in own if (r["method"], r["count"]) == (method, count)), None)
                form = "{:.2f} ({:.1f} to {:.1f})" if key == "psnr_db" else "{:.3f} ({:.2f} to {:.2f})"
                ready = row is not None and row.get(key) is not None
                cells.append(
                    form.format(row[key], row[f"{key}_min"], row[f"{key}_max"]) if ready and row else "-"
                )
            lines.append([TRUTHS[truth], METHODS[method][0], *cells])
    return table(["truth", "method", *map(str, counts)], lines)


def _finding_text(finding: Sequence[Row]) -> str:
    lines = []
    for row in finding:
        psnr, blocked, ssim = row["psnr_db"], row["psnr_db_blocked"], row["ssim"]
        lines.append(
            [
                TRUTHS[row["truth"]] + ("" if row["split"] == "random" else ", region"),
                "trained" if row["opacity"] else "frozen",
                str(row["count"]),
                cell(psnr["rf3dgs+"], "{:.2f}"),
                cell(psnr["rf3dgs"], "{:.2f}"),
                cell(psnr["difference"], "{:+.2f}"),
                cell(blocked["difference"], "{:+.2f}"),
                cell(ssim["difference"], "{:+.3f}"),
                cell(row["rmse_db"]["difference"], "{:+.2f}"),
            ]
        )
    head = [
        "truth", "opacity", "receivers", "RF-3DGS+, PSNR [dB]", "RF-3DGS", "difference", "blocked", "SSIM", "RMSE [dB]",
    ]  # fmt: skip
    said = []
    for truth in dict.fromkeys(row["truth"] for row in finding):
        own = [row["psnr_db"]["difference"] for row in finding if row["truth"] == truth]
        ahead = sum(d > 0 for d in own)
        said.append(
            f"Truth {TRUTHS[truth]}: RF-3DGS+ is ahead on {ahead} of {len(own)} sets, {np.mean(own):+.2f} dB in the "
            f"mean ({min(own):+.2f} to {max(own):+.2f})."
        )
    verdict = " ".join(said) + " Published: ahead on all of them."
    return "\n\n".join([table(head, lines), verdict, LAW_TEXT])


# ------------------------------------------------------------------------------------------------------ pictures


def pictures(
    figures: dict[str, Any], folder: Path, runs: Mapping[str, Run]
) -> dict[str, tuple[Callable[[], Any], str]]:
    """What is drawn, by file name; the spectra of ``runs`` (by key) are read from ``folder``, where they are there."""
    found: dict[str, tuple[Callable[[], Any], str]] = {}
    random = [row for row in figures["rows"] if row["split"] == "random"]
    rooms = [row for row in random if row["truth"] != "paper-law"]
    if any(row["count"] for row in rooms):
        text = "PSNR and SSIM against the number of training receivers: mean, and bands from least to most over the test receivers."
        found["sparsity.png"] = partial(sparsity_curves, rooms), text
    for truth in dict.fromkeys(row["truth"] for row in rooms):
        own = [row for row in rooms if row["truth"] == truth]
        if any(row["count"] for row in own):
            found[f"speed-{truth}.png"] = (
                partial(speed_against_error, own),
                "Error against the time of a spectrum and against training time; diamonds see no spectrum.",
            )
        drawn = _grid(own, runs, folder)
        if drawn is not None:
            found[f"spectra-{truth}.png"] = drawn
    learned = [row for row in random if row.get("loss_curve")]
    if learned:
        found["learning.png"] = partial(learning_curves, learned), "Loss of the networks over their steps."
    if figures["finding"]:
        lines = [line for line in figures["finding"] if line["split"] == "random" and not line["opacity"]]
        text = "RF-3DGS+ less RF-3DGS, by the law that the truth's scattering obeys."
        found["law.png"] = partial(law_bars, lines), text
    return found


def _grid(rows: Sequence[Row], runs: Mapping[str, Run], folder: Path) -> tuple[Callable[[], Any], str] | None:
    """Spectra of the shown receivers by every method, at a number of training receivers that all have."""
    rows = [row for row in rows if (folder / pictures_of(runs[row["keys"][0]])).is_file()]
    counts = sorted({row["count"] for row in rows if row["count"]})
    most = max(counts, key=lambda n: (sum(row["count"] == n for row in rows), -n), default=None)
    if most is None:
        return None
    own = [row for row in rows if row["count"] in (0, most)]
    own.sort(key=lambda row: list(KNOWN).index(row["method"]))
    predictions = []
    for row in own:
        with np.load(folder / pictures_of(runs[row["keys"][0]]), allow_pickle=False) as stored:
            predictions.append((METHODS[row["method"]][0], stored["prediction_db"]))
            truth_db, limits = stored["truth_db"], stored["range_db"]
    titles = ["line of sight", "blocked"][: len(truth_db)]
    text = (
        f"Spectra of the receivers of median path gain with and without line of sight: truth, and predictions from "
        f"{most} spectra."
    )
    return partial(spectra_grid, truth_db, predictions, titles, limits), text
