"""The lobby run as one HTML page: every figure, and the pictures that explain them.

The page needs nothing but itself: pictures are embedded. It is drawn from what the run left in its folder
(``report.json`` and ``pictures.npz``).
"""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures import METHODS, figure_of, spectrum_rows
from benchmarks.report import columns_table
from warprrf.device import require

FIGURES: tuple[tuple[str, str, str], ...] = (
    ("photo_psnr_db", "held-out photo PSNR of stage 1", "dB"),
    ("photo_noise_psnr_db", "PSNR between two render seeds of a view (the photos' own noise)", "dB"),
    ("camera_rms_m", "surveyed-scale camera positions, rms error", "m"),
    ("mesh_distance_median_m", "mesh to true surface where a photo sees it, median", "m"),
    ("mesh_distance_p90_m", "the same, 90th percentile", "m"),
    ("mesh_normal_median_deg", "mesh normal error, median", "degrees"),
    ("fit_time_s", "stage 2 fit of RF-3DGS+", "s"),
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
    ("fit_time_s", "fit [s]", "{:.1f}"),
    ("seconds_per_spectrum", "per spectrum [ms]", "ms"),
)

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; }
p.note, figcaption { color: #555; font-size: .92rem; } figure { margin: 1rem 0; } img { max-width: 100%; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; }
"""


def draw(folder: Path, figures: dict[str, Any]) -> str:
    """The page of a run, from its figures and from ``pictures.npz`` in ``folder``.

    Raises:
        ImportError: if matplotlib is missing.
    """
    with np.load(folder / "pictures.npz", allow_pickle=False) as stored:
        pictures = {name: stored[name] for name in stored.files}
    return _page(figures, pictures)


def _page(figures: dict[str, Any], pictures: dict[str, np.ndarray]) -> str:
    machine = figures["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>warprrf: the lobby</title>"
        f"<meta name='viewport' content='width=device-width, initial-scale=1'><style>{STYLE}</style></head><body>",
        "<h1>The lobby: from photos and a few spectra to a radio field</h1>",
        f"<p class='note'>{html.escape(_one_line(figures, machine))}</p>",
        "<h2>Figures</h2>",
        _figure_table(figures),
        _figure(
            time_bars(figures["stages"]),
            "Wall time per step, attempts that were killed included.",
            "time per step",
        ),
        *_geometry_part(pictures),
        *_radio_part(figures, pictures),
        *_spectra_part(pictures),
        f"<p class='note'>{html.escape(versions)}</p></body></html>",
    ]
    return "\n".join(parts)


def _geometry_part(pictures: dict[str, np.ndarray]) -> list[str]:
    parts = ["<h2>Stage 1: geometry from the photos</h2>"]
    for index, name in enumerate(pictures["photo_names"]):
        score = float(pictures["photo_psnr_db"][index])
        parts.append(
            _figure(
                photo_row(pictures["photo_truth"][index], pictures["photo_render"][index]),
                f"{name}: held out of the optimisation. Photo, render from its reconstructed pose, absolute "
                f"difference (x 4). {score:.1f} dB.",
                f"photo and render of {name}",
                jpeg=True,
            )
        )
    text = (
        "Points on the reconstructed mesh, seen from above and from the south: distance to the true surface. "
        "Right: the share of points within a distance, with the asked median and 90th percentile."
    )
    return [*parts, _figure(mesh_error_map(pictures), text, "mesh error")]


def _radio_part(figures: dict[str, Any], pictures: dict[str, np.ndarray]) -> list[str]:
    settings = _sionna(figures["data"]["sionna"]["settings"])
    return [
        "<h2>Stage 2: the radio field on receivers that it never saw</h2>",
        _method_table("Truth: exact (deterministic single bounce)", figures["methods"]),
        _method_table(f"Truth: Sionna RT ({settings})", figures["methods_sionna"]),
        "<p class='note'>Blocked: receivers without line of sight to the transmitter alone. Lookups know no geometry; "
        "the constant and the mean image know no receiver.</p>",
        _figure(
            floor_plan(pictures),
            "Section through the room at 1.2 m. Test receivers are coloured by the "
            "PSNR of RF-3DGS+; squares are blocked.",
            "floor plan",
        ),
        _figure(
            psnr_curves(figures["methods"]),
            "Left: PSNR of every test receiver, sorted, one curve a method. Right: against the distance to the "
            "nearest training receiver, for the bistatic field, RF-3DGS+ and the nearest-receiver lookup.",
            "PSNR per receiver",
        ),
    ]


def _spectra_part(pictures: dict[str, np.ndarray]) -> list[str]:
    low, high = (float(v) for v in pictures["range_db"])
    parts = []
    for index, blocked in enumerate(pictures["spectrum_blocked"]):
        position = ", ".join(f"{x:.2f}" for x in pictures["spectrum_receivers"][index])
        predictions = {
            METHODS[key][0]: pictures[f"spectrum_{key}"][index] for key in ("bistatic", "rf3dgs+", "nearest")
        }
        parts.append(
            _figure(
                spectrum_rows(pictures["spectrum_truth"][index], predictions, low, high),
                f"Receiver at ({position}) m, {'blocked' if blocked else 'line of sight'}. First row: truth; below: "
                "prediction and its difference from the truth.",
                f"spectra at {position}",
            )
        )
    return parts


def _one_line(figures: dict[str, Any], machine: dict[str, Any]) -> str:
    geometry, data = figures["geometry"], figures["data"]["exact"]
    reduced = " Reduced sizes: these figures only show that it runs." if figures.get("reduced") else ""
    return (
        f"{geometry['photos']} photos ({geometry['held_out']} held out), {geometry['gaussians']} Gaussians, "
        f"{geometry['triangles']} triangles, {data['train']} training and {data['test']} test receivers "
        f"({data['blocked']} blocked) at {data['shape'][0]} x {data['shape'][1]} pixels, "
        f"{data['frequency_hz'] / 1e9:g} GHz. {machine['cores']} cores, {machine['processor']}, seed "
        f"{figures['seed']}.{reduced}"
    )


def _sionna(settings: dict[str, Any]) -> str:
    known = {"depth": "depth {}", "samples": "{:.0e} rays", "refraction": "refraction {}"}
    return ", ".join(form.format(settings[name]) for name, form in known.items() if name in settings)


# ----------------------------------------------------------------------------------------------------- tables


def method_table(methods: dict[str, dict[str, Any]]) -> str:
    """The figures of several methods as Markdown."""
    columns = [("name", "method", "{}"), *((key, name, form) for key, name, form in COLUMNS if form != "ms")]
    return columns_table(columns, [{"name": METHODS[key][0], **row} for key, row in methods.items()])


def _figure_table(figures: dict[str, Any]) -> str:
    rows = []
    for key, name, unit in FIGURES:
        value = figures.get(key)
        shown = "-" if value is None else f"{value:.4g} {unit}"
        rows.append(f"<tr><td>{name}</td><td>{shown}</td></tr>")
    head = "<tr><th>figure</th><th>measured</th></tr>"
    return f"<div class='wide'><table>{head}{''.join(rows)}</table></div>"


def _method_table(title: str, methods: dict[str, dict[str, Any]]) -> str:
    shown = [c for c in COLUMNS if any(figures.get(c[0]) is not None for figures in methods.values())]
    head = "".join(f"<th>{name}</th>" for _, name, _ in shown)
    rows = []
    for key, figures in methods.items():
        cells = "".join(f"<td>{_cell(figures.get(column), form)}</td>" for column, _, form in shown)
        rows.append(f"<tr><td>{html.escape(METHODS.get(key, (key, ''))[0])}</td>{cells}</tr>")
    table = f"<table><tr><th>method</th>{head}</tr>{''.join(rows)}</table>"
    return f"<p><b>{html.escape(title)}</b></p><div class='wide'>{table}</div>"


def _cell(value: float | None, form: str) -> str:
    if value is None:
        return "-"
    return f"{value * 1e3:.1f}" if form == "ms" else form.format(value)


# --------------------------------------------------------------------------------------------------- pictures


def time_bars(stages: dict[str, dict[str, Any]]) -> Any:
    """Wall time of each stage as bars; a stage that reported several long steps has one bar a step."""
    bars: dict[str, float] = {}
    for name, stage in stages.items():
        steps = {step: s for step, s in stage.get("steps", {}).items() if s > 0.02 * stage["seconds"]}
        if len(steps) < 3:
            bars[name] = stage["seconds"]
            continue
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
    for share, limit in ((50, 2.0), (90, 6.0)):
        axes[2].plot([limit], [share], "x", color="#a8200d", markersize=8)
        axes[2].annotate(
            f"asked: {share} % within {limit:g} cm", (limit, share), (limit + 0.4, share - 6), fontsize=9
        )
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
    """PSNR of every test receiver: sorted per method, and against the distance to the nearest training receiver."""
    figure, axes = figure_of(2, size=(13.0, 4.4))
    for key, (name, colour) in METHODS.items():
        if key in methods:
            values = np.sort(np.array(methods[key]["per_receiver"]["psnr_db"], dtype=np.float64))
            axes[0].plot(
                np.arange(len(values)), values, color=colour, label=f"{name}, mean {values.mean():.1f} dB"
            )
    axes[0].set_xlabel("test receivers, sorted for each method")
    axes[0].set_ylim(top=axes[0].get_ylim()[1] + 9.0)  # room for the legend
    for key in ("nearest", "rf3dgs+", "bistatic"):
        if key in methods and "distance_to_training_m" in methods[key]["per_receiver"]:
            row = methods[key]["per_receiver"]
            axes[1].scatter(
                row["distance_to_training_m"], row["psnr_db"], s=20, color=METHODS[key][1], label=METHODS[key][0],
                alpha=0.75, linewidths=0,
            )  # fmt: skip
    axes[1].set_xlabel("distance to the nearest training receiver [m]")
    for ax in axes:
        ax.set_ylabel("PSNR [dB]")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=9)
    return figure


def _figure(figure: Any, caption: str, alternative: str, jpeg: bool = False) -> str:
    content = io.BytesIO()
    options: dict[str, Any] = {"format": "jpeg", "pil_kwargs": {"quality": 88}} if jpeg else {"format": "png"}
    figure.savefig(content, dpi=100, **options)
    data = base64.b64encode(content.getvalue()).decode()
    return (
        f"<figure><img alt='{html.escape(alternative, quote=True)}' src='data:image/{options['format']};base64,{data}'>"
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )
