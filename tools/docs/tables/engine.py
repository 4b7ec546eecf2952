"""Splatting and ray queries: speed against error."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from tables.common import FOLDER, Row, entry, markdown, missing, read, show


@entry("engine-responses")
def _engine_responses() -> str:
    lines = [
        [
            r["regime"], r["form"], show(r["error_mean"], "{:.1e}"), show(r["error_max"], "{:.1e}"),
            show(r["negative"], "{:.1%}"), show(r["ns_per_pair"]),
        ]
        for r in read("renderer")["responses"]
    ]  # fmt: skip
    head = ("Gaussians", "form", "mean error", "largest", "negative squared distances", "ns a pair")
    return markdown(head, lines)


@entry("engine-points")
def _engine_points() -> str:
    lines = [
        [
            r["interaction_point"], show(1e3 * r["length_error_median_m"], "{:.3g}"),
            show(1e3 * r["length_error_p90_m"], "{:.3g}"), show(r["delay_error_median_ns"], "{:.2g}"),
            show(r["milliseconds_per_receiver"]),
        ]
        for r in read("renderer")["points"]
    ]  # fmt: skip
    head = (
        "`interaction_point=`", "length error, median [mm]", "90th percentile [mm]", "delay [ns]", "ms a receiver",
    )  # fmt: skip
    return markdown(head, lines)


@entry("engine-knobs")
def _engine_knobs() -> str:
    words = {
        "alpha_min": "least alpha that counts", "top_k": "Gaussians kept a pixel",
        "precision": "precision", "resolution": "grid, rows x columns",
    }  # fmt: skip
    lines = []
    for knob, name in words.items():
        for r in read("renderer")[knob]:
            value = " x ".join(map(str, r["value"])) if isinstance(r["value"], list) else _short(r["value"])
            lines.append([
                name, value, show(r["error_rms_db"], "{:.2g}"), show(r["error_worst_db"], "{:.2g}"),
                show(1e3 * r["seconds"]),
            ])  # fmt: skip
            name = ""
    return markdown(("setting", "value", "rms error [dB]", "worst pixel [dB]", "ms a receiver"), lines)


def _short(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"


@entry("engine-times")
def _engine_times() -> str:
    e, b = read("engine"), read("renderer")["blend"]
    size = f"{b['gaussians']} Gaussians, {b['shape'][1]} x {b['shape'][0]}"
    lines = []
    for run in b["runs"]:
        threads = "one thread" if run["threads"] == 1 else f"{run['threads']} threads"
        lines += [
            [f"forward and backward, {size}, {threads}", f"{1e3 * run['ours']['seconds']:.0f} ms"],
            ["the same, speed over a vectorised torch renderer", f"{run['speedup']:.1f} times"],
        ]
    lines += [
        ["largest difference of the images", f"{b['image_difference']['largest']:.0e}"],
        ["largest relative difference of the gradients", f"{max(b['gradient_difference'].values()):.0e}"],
    ]
    grid = " x ".join(map(str, e["shape"]))
    lines += [
        [f"panorama of {grid} from {r['gaussians']} Gaussians", f"{1e3 * r['seconds']:.0f} ms"]
        for r in e["growth"]
        if r["gaussians"] >= 10_000
    ]
    return markdown(("figure", "value"), lines)


@entry("engine-rays")
def _engine_rays() -> str:
    lines = [
        [
            "the lobby" if r["mesh"] == "scene" else r["mesh"], str(r["faces"]), r["kind"],
            show(r["chosen"]["rays_per_s"] / 1e6), show(r["warp"]["rays_per_s"] / 1e6),
            show(r["chosen"]["over_bare"], "{:.2f}"),
        ]
        for r in read("engine")["rays"]
    ]  # fmt: skip
    head = (
        "mesh", "faces", "rays", "million rays/s", "by Warp's hierarchy: million rays/s", "ratio to bare Embree",
    )  # fmt: skip
    return markdown(head, lines)


@entry("gpu")
def _gpu() -> str:
    files = sorted(FOLDER.glob("gpu-*.json"))
    if not files:
        return missing("make gpu")
    parts = []
    for file in files:
        found = json.loads(file.read_text())
        lines = [_in_unit(name, value) for name, value in _leaves(found) if "kernels" not in name]
        parts += [f"**{found['machine']['device']}**", markdown(("figure", "value"), lines)]
    return "\n\n".join(parts)


def _in_unit(name: str, value: float) -> list[str]:
    """A figure with the unit that its name ends in."""
    units = (
        (" per s", 1e-6, "million a second"),
        (" s", 1e3, "ms"),
        (": seconds", 1e3, "ms"),
        (" m", 1.0, "m"),
    )
    for end, scale, unit in units:
        if name.endswith(end):
            return [name.removesuffix(end), f"{scale * value:.4g} {unit}"]
    return [name, str(value) if isinstance(value, int) else f"{value:.3g}"]


def _leaves(found: Row, prefix: str = "") -> Iterable[tuple[str, float]]:
    for key, value in found.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, dict) and key not in ("machine", "sizes", "asked", "tests"):
            yield from _leaves(value, f"{name}: ")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name, value


@entry("truths")
def _truths() -> str:
    head = (
        "engine", "processor seconds of a spectrum", "noise, rms [dB]", "total power relative to the first row [dB]",
        "least time at the exact engine's noise, over its time",
    )  # fmt: skip
    lines = [
        [
            r["engine"], show(r["core_s"], "{:.1f}"), show(r["noise_db"], "{:.2f}"), show(r["total_db"], "{:+.2f}"),
            show(r.get("ratio"), "{:.0f}"),
        ]
        for r in read("truths")["rows"]
    ]  # fmt: skip
    return markdown(head, lines)
