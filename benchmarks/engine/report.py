"""The engine's evaluation as Markdown: what was asked beside what was measured, the settings that follow, pictures.

Drawn from ``engine.json`` alone, so it can be drawn again without measuring anything.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engine import blend, plots, transport
from benchmarks.engine.form_kernels import STRIP
from benchmarks.engine.forms import RASTERISER
from benchmarks.markdown import table
from benchmarks.pictures import write_page
from warprrf.geometry.splats.rasterizer import RADIO
from warprrf.rf.fields.harmonic.single_bounce import FieldOptions
from warprrf.rf.fields.harmonic.transport import ALPHA_MIN, TOP_K

Row = dict[str, Any]

TOLERANCE_DB, WORST_DB = 0.05, 2.0
"""A setting will do if its rms error and its worst pixel stay within these: a tenth of the errors of the best fits."""
POINT_TOLERANCE_M = 1e-3  # a wavelength at 300 GHz
FORM_TOLERANCE = 1e-3  # mean error of a response in every regime: a step of alpha that no cutoff of ours sees
EXPONENTIAL_TOLERANCE = 1e-6  # what the deepest image, 60 dB, can show
ASKED_RAYS = {"chosen": 0.6, "warp": 0.25}
ASKED_SPECTRUM_S = {"gaussians": 100_000, "seconds": 0.150}

NAMES = {
    "alpha_min": "alpha cutoff",
    "alpha_max": "opacity clamp",
    "top_k": "top K",
    "precision": "precision",
    "resolution": "resolution",
}


def write(folder: str | os.PathLike[str]) -> Path:
    """Write ``engine.md`` and the pictures from ``engine.json`` in ``folder``; returns the Markdown's path.

    Raises:
        ValueError: if there is no ``engine.json``.
        ImportError: if matplotlib is missing.
    """
    folder = Path(folder)
    if not (folder / "engine.json").is_file():
        raise ValueError(
            f"folder: {folder / 'engine.json'} is missing, expected the folder of a finished run"
        )
    found = json.loads((folder / "engine.json").read_text())
    picks = {row["knob"]: row["value"] for row in choices(found)}
    pictures = {
        "knobs.png": plots.panels(_knob_panels(found, picks)),
        "counts.png": plots.counts(found["counts"]),
        "growth.png": plots.growth(
            {
                "Gaussians": ("Gaussians", [(r["gaussians"], r["seconds"]) for r in found["growth"]]),
                "pixels": ("pixels", [(r["pixels"], r["seconds"]) for r in found["resolution"]]),
                "receivers": ("receivers", [(r["receivers"], r["seconds"]) for r in found["receivers"]]),
            }
        ),
        "forms.png": plots.panels(_form_panels(found, picks), columns=2),
    }
    if any("embree bare" in row for row in found["rays"]):
        pictures["rays.png"] = plots.rays(found["rays"], ASKED_RAYS)
    captions = {
        "knobs.png": "Error and time of each setting; red: the cheapest that will do.",
        "counts.png": "Discs on the room's mesh against rays cast at it.",
        "growth.png": "Seconds of a spectrum over Gaussians and pixels, of blending weights over receivers.",
        "forms.png": "Forms of the exact response in three regimes and of exp; red: the cheapest that will do.",
        "rays.png": "Mesh rays and lines of sight over Embree called bare.",
    }
    shown = {name: (figure, captions[name]) for name, figure in pictures.items()}
    return write_page(folder / "engine.md", summary_text(found), shown)


def _knob_panels(found: Row, picks: Row) -> list[plots.Panel]:
    shown = []
    for key, name in NAMES.items():
        rows, values = found[key], [row["value"] for row in found[key]]
        shown.append(
            plots.Panel(
                name,
                [_shown(key, value) for value in values],
                [row["error_rms_db"] for row in rows],
                "rms error [dB]",
                [1e3 * row["seconds"] for row in rows],
                "ms a receiver",
                values.index(picks[key]) if picks.get(key) in values else None,
                ordered=key != "precision",
            )
        )
    kinds = [row["interaction_point"] for row in found["points"]]
    points = plots.Panel(
        "interaction point",
        kinds,
        [1e3 * row["length_error_median_m"] for row in found["points"]],
        "median length error [mm]",
        [row["milliseconds_per_receiver"] for row in found["points"]],
        "ms a receiver, blending apart",
        kinds.index(picks["points"]) if picks.get("points") in kinds else None,
        ordered=False,
    )
    return [*shown, points]


def _form_panels(found: Row, picks: Row) -> list[plots.Panel]:
    shown = []
    for regime in dict.fromkeys(row["regime"] for row in found["responses"]):
        rows = [row for row in found["responses"] if row["regime"] == regime]
        shown.append(
            plots.Panel(
                f"response, {regime}",
                [row["form"] for row in rows],
                [row["error_mean"] for row in rows],
                "mean error of the response",
                [row["ns_per_pair"] for row in rows],
                "ns a pair",
                next((k for k, row in enumerate(rows) if row["form"] == picks.get("responses")), None),
                ordered=False,
            )
        )
    rows = found["exponentials"]
    exponential = plots.Panel(
        f"exp(-h), strips of {STRIP}",
        [row["form"] for row in rows],
        [row["error_max"] for row in rows],
        "largest error",
        [row["ns_per_value"] for row in rows],
        "ns a value",
        next((k for k, row in enumerate(rows) if row["form"] == picks.get("exponentials")), None),
        ordered=False,
    )
    return [*shown, exponential]


def summary_text(found: Row) -> str:
    """All tables as Markdown."""
    machine = found["machine"]
    parts = [
        f"## The engine: speed against error\n\n{machine['processor']}, {found['threads']} threads, device "
        f"{machine['device']}. Knobs: {found['sizes']['gaussians']} Gaussians, "
        f"{found['sizes']['shape'][0]} x {found['sizes']['shape'][1]} pixels, dB images "
        "60 dB deep; time is the shortest of the repeats.",
        "### Asked and measured",
        table(("figure", "asked", "measured", ""), asked(found)),
        "### Settings that follow",
        f"The cheapest setting with an rms error of at most {TOLERANCE_DB} dB and no pixel off by more than "
        f"{WORST_DB} dB; for points, within {1e3 * POINT_TOLERANCE_M:g} mm.",
        table(
            ("setting", "will do", "the library's", "why"),
            [[r["name"], _shown(r["knob"], r["value"]), r["library"], r["why"]] for r in choices(found)],
        ),
    ]
    for key, name in NAMES.items():
        parts += [f"### {name[0].upper()}{name[1:]}", _knob_table(key, found[key])]
    parts += ["### Gaussians on a known surface", _counts_table(found["counts"])]
    parts += ["### Growth", _growth_text(found)]
    parts += ["### Interaction point", _points_table(found["points"])]
    parts += ["### Forms of the exact response, float32", _responses_table(found["responses"])]
    parts += [f"### Forms of exp(-h), strips of {STRIP}", _exponentials_table(found["exponentials"])]
    parts += ["### Forward and backward beside peers", _peers_text(found["blend"])]
    if found.get("gpu") is not None:
        parts += ["### Blending on a GPU", _gpu_text(found["gpu"])]
    parts += ["### Mesh rays", _rays_table(found["rays"])]
    parts += ["### Transport on disk", _transport_table(found["transport"])]
    return "\n\n".join(parts)


def asked(found: Row) -> list[list[str]]:
    """Rows of figure, asked, measured, verdict; what this run did not measure is left out."""
    lines: list[list[str]] = []

    def add(name: str, wanted: str, value: str, met: bool) -> None:
        lines.append([name, wanted, value, "met" if met else "NOT met"])

    shown = [row for row in found["rays"] if "embree bare" in row]
    for runner, wanted in ASKED_RAYS.items():
        for kinds, name in ((False, "mesh rays"), (True, "lines of sight")):
            ratios = [row[runner]["over_bare"] for row in shown if row["kind"].startswith("sight") == kinds]
            if ratios:
                who = "chosen back end" if runner == "chosen" else "Warp's own"
                add(
                    f"{name} over bare Embree, {who}", f"at least {wanted}",
                    f"{min(ratios):.2f} to {max(ratios):.2f}", min(ratios) >= wanted,
                )  # fmt: skip
    if found["blend"] is not None:
        b = found["blend"]
        wanted = blend.ASKED["speedup"]
        name = f"forward + backward over torch, {b['gaussians']} Gaussians, {b['shape'][1]} x {b['shape'][0]}"
        for run in b["runs"]:
            speedup = run["speedup"]["torch"]
            add(
                f"{name}, {_threads(run)}", f"at least {wanted:g}", f"{speedup:.1f}", speedup >= wanted
            )  # fmt: skip
        difference = b["image_difference"]["quantile_99.9"]
        add(
            "its images against torch's, 99.9 % of pixels", f"{blend.ASKED['image_difference']:g}",
            f"{difference:.1e}", difference <= blend.ASKED["image_difference"],
        )  # fmt: skip
    if found.get("gpu") is not None:
        g = found["gpu"]
        if "over_gsplat" in g:
            limit = g["asked"]["over_gsplat"]
            add(
                f"forward + backward over gsplat, {g['gaussians']} Gaussians, on {g['machine']['device']}",
                f"at most {limit:g}", f"{g['over_gsplat']:.2f}", g["over_gsplat"] <= limit,
            )  # fmt: skip
        limit = g["asked"]["spectrum_s"]
        add(
            f"spectrum of {g['gaussians']} Gaussians on {g['machine']['device']}", f"at most {1e3 * limit:g} ms",
            f"{1e3 * g['spectrum_s']:.2f} ms", g["spectrum_s"] <= limit,
        )  # fmt: skip
    for row in found["growth"]:
        if row["gaussians"] == ASKED_SPECTRUM_S["gaussians"]:
            limit = ASKED_SPECTRUM_S["seconds"]
            add(
                f"spectrum of {row['gaussians']} Gaussians", f"at most {1e3 * limit:.0f} ms",
                f"{1e3 * row['seconds']:.0f} ms", row["seconds"] <= limit,
            )  # fmt: skip
    t, limit = found["transport"], float(transport.ASKED["memory_gb"])  # type: ignore[arg-type]
    peak = max(t["store_peak_gb"], t["fit_peak_gb"])
    name = (
        f"memory, {t['receivers']} receivers, {t['gaussians']} Gaussians, {t['shape'][0]} x {t['shape'][1]}"
    )
    add(name, f"at most {limit:g} GB", f"{peak:.2f} GB", peak <= limit)
    return lines


def choices(found: Row) -> list[Row]:
    """What the curves say: ``knob, name, value`` (None if nothing will do), ``library`` (its default), ``why``."""
    rows = []
    for knob, library in (
        ("alpha_min", f"{ALPHA_MIN:g} (fields), {RADIO.alpha_min:g} (`RADIO`)"),
        ("alpha_max", f"one less the range's depth (fields), {RADIO.alpha_max:g} (`RADIO`)"),
        ("top_k", f"{TOP_K}"),
        ("precision", "float32"),
    ):
        good = [
            r for r in found[knob] if r["error_rms_db"] <= TOLERANCE_DB and r["error_worst_db"] <= WORST_DB
        ]
        if not good:
            rows.append(
                {
                    "knob": knob,
                    "name": NAMES[knob],
                    "value": None,
                    "library": library,
                    "why": "none is within",
                }
            )
            continue
        # Cutoffs and K order their settings by cost better than a clock does: the first good one from the cheap end.
        best = {"alpha_min": max, "alpha_max": min, "top_k": min}.get(knob)
        row = min(good, key=lambda r: r["seconds"]) if best is None else best(good, key=lambda r: r["value"])
        rows.append(
            {
                "knob": knob,
                "name": NAMES[knob],
                "value": row["value"],
                "library": library,
                "why": _figures(row)
                + _beside(found[knob], {"alpha_min": ALPHA_MIN, "top_k": TOP_K}.get(knob), row),
            }
        )
    near = [r for r in found["points"] if r["length_error_median_m"] <= POINT_TOLERANCE_M]
    if near:
        row = min(near, key=lambda r: r["milliseconds_per_receiver"])
        rows.append(
            {
                "knob": "points",
                "name": "interaction point",
                "value": row["interaction_point"],
                "library": f"{FieldOptions().interaction_point} (as the paper has it)",
                "why": f"{1e3 * row['length_error_median_m']:.2g} mm, {row['milliseconds_per_receiver']:.2g} ms "
                f"beside {row['weights_milliseconds_per_receiver']:.3g} ms of blending",
            }
        )
    responses: dict[str, list[Row]] = {}
    for r in found["responses"]:
        responses.setdefault(r["form"], []).append(r)
    worst = {form: max(r["error_mean"] for r in own) for form, own in responses.items()}
    cost = {form: float(np.mean([r["ns_per_pair"] for r in own])) for form, own in responses.items()}
    _add_cheapest(rows, "responses", "form of the response", "Gram, turned", worst, cost, FORM_TOLERANCE)
    worst = {r["form"]: r["error_max"] for r in found["exponentials"]}
    cost = {r["form"]: r["ns_per_value"] for r in found["exponentials"]}
    _add_cheapest(rows, "exponentials", "exponential", RASTERISER, worst, cost, EXPONENTIAL_TOLERANCE)
    return rows


def _figures(row: Row) -> str:
    return f"{row['error_rms_db']:.2g} dB rms, {row['error_worst_db']:.2g} dB at worst, {1e3 * row['seconds']:.3g} ms"


def _beside(rows: list[Row], default: Any, picked: Row) -> str:
    """The figures of the library's own setting, where it was measured and is another."""
    own = next((row for row in rows if row["value"] == default and row is not picked), None)
    return "" if own is None else f"; the library's: {_figures(own)}"


def _add_cheapest(
    rows: list[Row], knob: str, name: str, library: str, error: Row, cost: Row, tolerance: float
) -> None:
    good = [form for form in error if error[form] <= tolerance]
    if good:
        form = min(good, key=lambda f: cost[f])
        why = f"errs by {error[form]:.1e}, at most {tolerance:g} wanted; {cost[form]:.2f} ns"
        rows.append({"knob": knob, "name": name, "value": form, "library": library, "why": why})


LABELS: dict[str, Callable[[Any], str]] = {
    "alpha_min": lambda v: f"{v:.2g}",
    "alpha_max": lambda v: f"1 - {1 - v:.2g}" if v > 0.995 else f"{v:g}",
    "top_k": lambda v: f"K = {v}",
    "precision": str,
    "resolution": lambda v: f"{v[0]} x {v[1]}",
}


def _shown(knob: str, value: Any) -> str:
    return "-" if value is None else LABELS.get(knob, str)(value)


def _knob_table(knob: str, rows: list[Row]) -> str:
    head = ["setting", "ms", "rms error [dB]", "worst pixel [dB]", "sum over pixels [dB]"]
    more = knob == "top_k"
    body = [
        [
            _shown(knob, r["value"]), f"{1e3 * r['seconds']:.4g}", f"{r['error_rms_db']:.2g}",
            f"{r['error_worst_db']:.2g}", f"{r['error_total_db']:.2g}",
            *([f"{r['pairs_per_pixel']:.1f}", f"{r['dropped_mean']:.1e}"] if more else []),
        ]
        for r in rows
    ]  # fmt: skip
    return table([*head, *(["pairs a pixel", "weight dropped, mean"] if more else [])], body)


def _counts_table(rows: list[Row]) -> str:
    head = (
        "Gaussians",
        "ms a spectrum",
        "rms error [dB]",
        "range error, median [mm]",
        "segments per s",
        "hierarchy [s]",
    )
    return table(
        head,
        [
            [
                f"{r['gaussians']}", f"{1e3 * r['seconds']:.3g}", f"{r['error_rms_db']:.2g}",
                f"{1e3 * r['range_error_median_m']:.2g}", f"{r['transmittances_per_s']:.2g}",
                f"{r['hierarchy_s']:.2g}",
            ]
            for r in rows
        ],
    )  # fmt: skip


def _growth_text(found: Row) -> str:
    def slope(points: list[tuple[float, float]]) -> float:
        x, y = np.log(np.array(points, dtype=float)).T
        return float(np.polyfit(x[-3:], y[-3:], 1)[0]) if len(x) > 1 else float("nan")

    lines = []
    kinds = {"Gaussians": ("growth", "gaussians"), "pixels": ("resolution", "pixels")}
    for name, (key, amount) in {**kinds, "receivers": ("receivers", "receivers")}.items():
        points = [(r[amount], r["seconds"]) for r in found[key]]
        lines.append(
            [
                name, f"{points[0][0]:g} to {points[-1][0]:g}",
                f"{1e3 * points[0][1]:.3g} to {1e3 * points[-1][1]:.4g}", f"{slope(points):.2f}",
            ]
        )  # fmt: skip
    return table(("over", "from, to", "ms", "exponent of the last three"), lines)


def _points_table(rows: list[Row]) -> str:
    return table(
        ("point", "length error, median [mm]", "90 % [mm]", "delay error, median [ns]", "ms a receiver"),
        [
            [
                r["interaction_point"], f"{1e3 * r['length_error_median_m']:.3g}",
                f"{1e3 * r['length_error_p90_m']:.3g}", f"{r['delay_error_median_ns']:.2g}",
                f"{r['milliseconds_per_receiver']:.3g}",
            ]
            for r in rows
        ],
    )  # fmt: skip


def _responses_table(rows: list[Row]) -> str:
    return table(
        ("regime", "form", "mean error", "largest error", "q below zero", "ns a pair"),
        [
            [
                r["regime"], r["form"], f"{r['error_mean']:.1e}", f"{r['error_max']:.1e}", f"{r['negative']:.1%}",
                f"{r['ns_per_pair']:.2f}",
            ]
            for r in rows
        ],
    )  # fmt: skip


def _exponentials_table(rows: list[Row]) -> str:
    return table(
        ("form", "largest error", "largest relative error", "ns a value"),
        [
            [
                r["form"] + (" (the rasteriser's)" if r["form"] == RASTERISER else ""), f"{r['error_max']:.1e}",
                f"{r['relative_max']:.1e}", f"{r['ns_per_value']:.2f}",
            ]
            for r in rows
        ],
    )  # fmt: skip


def _threads(run: Row) -> str:
    return "one thread each" if run["threads"] == 1 else f"{run['threads']} threads each"


def _peers_text(found: Row | None) -> str:
    if found is None:
        return 'Not measured: torch is not installed (`pip install "warprrf[baselines]"`).'
    names = {
        "ours": "ours",
        "torch": "vectorised torch renderer, the same image",
        "opensplat": "OpenSplat's CPU rasteriser",
    }
    body = []
    for run in found["runs"]:
        for key, name in names.items():
            if key in run:
                times = [f"{1e3 * run[key][part]:.1f}" for part in ("forward_s", "backward_s", "seconds")]
                ratios = [f"{run[r][key]:.1f}" if key in run[r] else "" for r in ("speedup", "cpu_speedup")]
                body.append([_threads(run), name, *times, *ratios])
    head = (
        "threads",
        "renderer",
        "forward [ms]",
        "backward [ms]",
        "both [ms]",
        "over ours",
        "by processor time",
    )
    lines = [
        table(head, body),
        "Each renderer has a process of its own and they take turns, after a rest in which the threads of the others "
        "fall asleep. The fastest run counts.",
        f"OpenSplat blends on one thread; its ellipses are affine and blurred: its image is at "
        f"{found['opensplat_psnr_db']:.1f} dB PSNR from ours."
        if "opensplat_psnr_db" in found
        else "OpenSplat's CPU rasteriser was not measured: no checkout was given (`--opensplat FOLDER`).",
    ]
    return "\n\n".join(lines)


def _gpu_text(found: Row) -> str:
    body = [
        [name, *(f"{1e3 * found[key][part]:.2f}" for part in ("forward_s", "backward_s", "seconds"))]
        for key, name in (("ours", "ours"), ("gsplat", "gsplat"))
        if found[key] is not None
    ]
    lines = [table(("renderer", "forward [ms]", "backward [ms]", "both [ms]"), body)]
    if found["gsplat"] is None:
        lines.append("gsplat was not measured: it is not installed.")
    lines.append(f"A spectrum of {found['spectrum_shape']} pixels takes {1e3 * found['spectrum_s']:.2f} ms.")
    for name, times in found["kernels"].items():
        longest = [[key, f"{value:.3f}"] for key, value in list(times.items())[:12]]
        if longest:
            lines.append(table((f"activity, {name}", "[ms]"), longest))
    return "\n\n".join(lines)


def _rays_table(rows: list[Row]) -> str:
    body = []
    for r in rows:
        line = [r["mesh"], f"{r['faces']}", r["kind"]]
        for runner in ("chosen", "warp", "embree bare"):
            line.append(f"{r[runner]['rays_per_s'] / 1e6:.2f}" if runner in r else "-")
        for runner, key in (("chosen", "over_bare"), ("chosen", "over_arrays"), ("warp", "over_bare")):
            line.append(f"{r[runner][key]:.2f}" if key in r[runner] else "-")
        body.append(line)
    return table(
        (
            "mesh", "faces", "rays", "Mesh [M/s]", "Warp's [M/s]", "bare Embree [M/s]", "Mesh over bare",
            "Mesh over Embree from arrays", "Warp's over bare",
        ),
        body,
    )  # fmt: skip


def _transport_table(t: Row) -> str:
    rows = [
        [
            "measured",
            f"{t['measured']} of {t['receivers']} receivers, {t['pairs_per_pixel']:.1f} pairs a pixel",
        ],
        [
            "time to store",
            f"{t['seconds_per_receiver']:.2f} s a receiver, {t['hours_to_store']:.2f} h in all",
        ],
        [
            "disk",
            f"{t['disk_gb']:.2f} GB, {t['bytes_per_pair']:.1f} bytes a pair; {t['batches_gb']:.2f} GB of batches",
        ],
        ["memory", f"{t['store_peak_gb']:.2f} GB storing, {t['fit_peak_gb']:.2f} GB fitting"],
        [
            "fit",
            f"{t['first_pass_s']:.1f} s until the first step, then {t['seconds_per_step']:.3f} s a step; "
            f"{t['gaussians_seen']} Gaussians",
        ],
        [
            "error",
            f"weights to {t['weight_error']:.1e} of themselves; top K drops {t['dropped_mean']:.1e} of a pixel on "
            f"average, {t['dropped_max']:.2f} at worst",
        ],
    ]
    return table(("", ""), rows)
