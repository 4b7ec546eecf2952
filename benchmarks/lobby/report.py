"""The main job's report: its figures as tables, and the pictures that explain them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures import METHODS, figure_of, name_of, spectrum_rows
from benchmarks.report import columns_table, table
from warprrf.device import require

FIGURES: tuple[tuple[str, str, str], ...] = (
    ("photo_psnr_db", "held-out photo PSNR of stage 1", "dB"),
    ("photo_noise_psnr_db", "PSNR between two renderings of one photo with different noise", "dB"),
    ("camera_rms_m", "camera positions, rms error", "m"),
    (
        "mesh_distance_median_m",
        "distance of the mesh to the true surface, where a photo sees it: median",
        "m",
    ),
    ("mesh_distance_p90_m", "the same, 90th percentile", "m"),
    ("mesh_normal_median_deg", "mesh normal error, median", "degrees"),
    ("pipeline_time_s", "photos to evaluation, set-up apart", "s"),
)
"""Key of report.json, its name and its unit."""

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("rmse_db", "RMSE [dB]", "{:.2f}"),
    ("direction_median_deg", "direction, median [deg]", "{:.2f}"),
    ("direction_within_3deg", "within 3 deg", "{:.0%}"),
    ("direction_within_3deg_blocked", "within 3 deg, blocked", "{:.0%}"),
    ("beam_gain_loss_db", "beam gain loss [dB]", "{:.2f}"),
    ("beam_gain_loss_db_blocked", "beam gain loss, blocked [dB]", "{:.2f}"),
    ("tof_error_median_ns", "ToF error [ns]", "{:.3f}"),
    ("aod_error_median_deg", "AoD error [deg]", "{:.2f}"),
    ("fit_s", "fit [s]", "{:.1f}"),
    ("spectrum_ms", "a spectrum [ms]", "{:.1f}"),
)


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    settings = figures["data"]["sionna"]["settings"]
    known = {"depth": "depth {}", "samples": "{:.0e} rays"}
    sionna = ", ".join(form.format(settings[name]) for name, form in known.items() if name in settings)
    shown = [(name, _value(figures.get(key), unit)) for key, name, unit in FIGURES]
    return "\n\n".join([
        _about(figures), "## Figures", table(("figure", "measured"), shown),
        "## Stage 2: the radio field on receivers that it never saw",
        "Truth: the exact engine (deterministic single bounce).", method_table(figures["methods"]),
        f"Truth: Sionna RT ({sionna}).", method_table(figures["methods_sionna"]),
        "Blocked: receivers without line of sight to the transmitter alone. Lookups know no geometry; the constant and the "
        "mean image know no receiver.",
    ])  # fmt: skip


def _value(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.4g} {unit}"


def _about(figures: dict[str, Any]) -> str:
    geometry, data, machine = figures["geometry"], figures["data"]["exact"], figures["machine"]
    reduced = " Reduced sizes: these figures only show that it runs." if figures["reduced"] else ""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    lost = [f"No pose, {name}: {why}." for name, why in geometry["unposed"].items()]
    said = " ".join([*lost, *(f"Guessed: {line}." for line in geometry["guessed"])])
    return (
        f"{geometry['photos']} photos ({geometry['held_out']} held out), {geometry['gaussians']} Gaussians, "
        f"{geometry['triangles']} triangles, {data['train']} training and {data['test']} test receivers "
        f"({data['blocked']} blocked) at {data['shape'][0]} x {data['shape'][1]} pixels, "
        f"{data['frequency_hz'] / 1e9:g} GHz. {machine['cores']} cores, {machine['processor']}, seed "
        f"{figures['seed']}; {versions}.{reduced}\n\n{said}"
    )


def method_table(methods: dict[str, dict[str, Any]]) -> str:
    """The figures of several methods as Markdown."""
    rows = [
        {"name": name_of(key), "spectrum_ms": 1e3 * row["seconds_per_spectrum"], **row}
        for key, row in methods.items()
    ]
    return columns_table([("name", "method", "{}"), *COLUMNS], rows)


def pictures(figures: dict[str, Any], file: Path) -> dict[str, tuple[Callable[[], Any], str]]:
    """What is drawn, by name, from the figures and the arrays in ``file``."""
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    drawn: dict[str, tuple[Callable[[], Any], str]] = {
        "time.png": (
            partial(time_bars, figures["stages"]),
            "Wall time per step, attempts that were killed included.",
        )
    }
    for k, name in enumerate(arrays["photo_names"]):
        drawn[f"photo_{k}.jpg"] = (
            partial(photo_row, arrays["photo_truth"][k], arrays["photo_render"][k]),
            f"{name}: held out of the optimisation. Photo, render from its reconstructed pose, absolute difference "
            f"(x 4). {float(arrays['photo_psnr_db'][k]):.1f} dB.",
        )
    drawn["mesh.png"] = (
        partial(mesh_error_map, arrays),
        (
            "Points on the reconstructed mesh, seen from above and from the south: distance to the true surface. Right: the "
            "share of points within a distance."
        ),
    )
    drawn["plan.png"] = (
        partial(floor_plan, arrays),
        (
            "Section through the room at 1.2 m. Test receivers are coloured by the PSNR of RF-3DGS+; squares are blocked."
        ),
    )
    drawn["psnr.png"] = (
        partial(psnr_curves, figures["methods"]),
        ("PSNR of every test receiver, sorted, one curve a method, truth: exact."),
    )
    low, high = (float(v) for v in arrays["range_db"])
    for k, blocked in enumerate(arrays["spectrum_blocked"]):
        place = ", ".join(f"{x:.2f}" for x in arrays["spectrum_receivers"][k])
        shown = {name_of(key): arrays[f"spectrum_{key}"][k] for key in ("bistatic", "rf3dgs+", "nearest")}
        drawn[f"spectrum_{k}.png"] = (
            partial(spectrum_rows, arrays["spectrum_truth"][k], shown, low, high),
            f"Receiver at ({place}) m, {'blocked' if blocked else 'line of sight'}. First row: truth; below: prediction "
            "and its difference from the truth.",
        )
    return drawn


def time_bars(stages: dict[str, dict[str, Any]]) -> Any:
    """Wall time of each stage as bars; one that takes most of all has a bar for each of its long steps."""
    bars: dict[str, float] = {}
    total = sum(stage["seconds"] for stage in stages.values())
    for name, stage in stages.items():
        if stage["seconds"] < 0.5 * total:
            bars[name] = stage["seconds"]
            continue
        steps = {step: s for step, s in stage["steps"].items() if s > 0.02 * total}
        bars |= {f"{name}: {step}": s for step, s in steps.items()}
        bars[f"{name}: rest"] = max(stage["seconds"] - sum(steps.values()), 0.0)
    figure, (ax,) = figure_of(1, size=(9.0, 0.34 * len(bars) + 0.8))
    drawn = ax.barh(list(bars), list(bars.values()), color=METHODS["rf3dgs+"][1])
    ax.bar_label(
        drawn, [f"{s:.0f} s" if s >= 10 else f"{s:.1f} s" for s in bars.values()], padding=4, fontsize=9
    )
    ax.invert_yaxis()
    ax.set_xlim(0, 1.12 * max([*bars.values(), 1.0]))
    ax.set_xlabel("wall time [s]")
    return figure


def photo_row(truth: np.ndarray, render: np.ndarray) -> Any:
    """Photo, render and four times their absolute difference, side by side; arrays (H, W, 3) in [0, 1] or uint8."""
    truth, render = (image / 255.0 if image.dtype == np.uint8 else image for image in (truth, render))
    figure, axes = figure_of(3, size=(13.0, 13.0 / 3 * truth.shape[0] / truth.shape[1] + 0.3))
    difference = np.clip(4.0 * np.abs(render - truth), 0.0, 1.0)
    for ax, image, title in zip(
        axes, (truth, render, difference), ("photo", "render", "difference x 4"), strict=True
    ):
        ax.imshow(np.clip(image, 0.0, 1.0))
        ax.set_title(title)
        ax.axis("off")
    return figure


def mesh_error_map(pictures: dict[str, np.ndarray]) -> Any:
    """Distance to the true surface of points on the mesh, from above and from the side, and its distribution."""
    points, error = pictures["mesh_points"], pictures["mesh_error_m"]
    order = np.argsort(error)
    figure, axes = figure_of(3, size=(14.0, 4.3), widths=(1.0, 1.0, 0.75))
    for ax, rows, labels in ((axes[0], (0, 1), "xy"), (axes[1], (0, 2), "xz")):
        shown = ax.scatter(
            *points[order][:, rows].T,
            c=100 * error[order],
            s=1.2,
            vmin=0.0,
            vmax=10.0,
            cmap="inferno",
            linewidths=0,
        )
        ax.set_aspect("equal")
        ax.set_xlabel(f"{labels[0]} [m]")
        ax.set_ylabel(f"{labels[1]} [m]")
    figure.colorbar(shown, ax=axes[:2], label="distance to the true surface [cm]", extend="max", shrink=0.8)
    ordered = np.sort(error)
    axes[2].plot(100 * ordered, np.linspace(0, 100, len(ordered)), color=METHODS["rf3dgs+"][1])
    axes[2].set_xlim(0, 16)
    axes[2].set_ylim(0, 100)
    axes[2].grid(alpha=0.3)
    axes[2].set_xlabel("distance [cm]")
    axes[2].set_ylabel("share of points [%]")
    return figure


def floor_plan(pictures: dict[str, np.ndarray]) -> Any:
    """Section of the room with transmitter, training and test receivers."""
    figure, (ax,) = figure_of(1, size=(10.0, 7.0))
    lines = require("matplotlib.collections", extra="plots").LineCollection
    ax.add_collection(lines(pictures["section"], colors="#444444", linewidths=1.0))
    train, test = pictures["train_receivers"], pictures["test_receivers"]
    ax.scatter(*train[:, :2].T, s=18, marker="+", color="#888888", label=f"{len(train)} training receivers")
    score, blocked = pictures["test_psnr_db"], pictures["test_blocked"].astype(bool)
    limits = {"vmin": np.percentile(score, 5), "vmax": np.percentile(score, 95), "cmap": "viridis"}
    for where, marker, name in ((~blocked, "o", "line of sight"), (blocked, "s", "blocked")):
        shown = ax.scatter(
            *test[where, :2].T, c=score[where], s=44, marker=marker, edgecolors="black", linewidths=0.5,
            label=f"{int(where.sum())} test receivers, {name}", **limits,
        )  # fmt: skip
    ax.scatter(
        *pictures["transmitter"][:2], s=220, marker="*", color="#a8200d", label="transmitter", zorder=4
    )
    figure.colorbar(shown, ax=ax, label="PSNR of RF-3DGS+ [dB]", shrink=0.8, extend="both")
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def psnr_curves(methods: dict[str, dict[str, Any]]) -> Any:
    """PSNR of every test receiver, sorted per method."""
    figure, (ax,) = figure_of(1, size=(9.0, 4.4))
    for key, row in methods.items():
        if key in METHODS:
            values = np.sort(np.array(row["per_receiver"]["psnr_db"], dtype=np.float64))
            ax.plot(values, color=METHODS[key][1], label=f"{name_of(key)}, mean {values.mean():.1f} dB")
    ax.set_ylim(top=ax.get_ylim()[1] + 9.0)  # room for the legend
    ax.set(xlabel="test receivers, sorted for each method", ylabel="PSNR [dB]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9, ncols=2)
    return figure
