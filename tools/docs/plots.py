"""Plots of the documentation, drawn from the files in ``benchmarks/results``, as SVG."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import warp as wp  # noqa: E402
from scipy.special import erfc  # noqa: E402
from tables.common import NAMES, TRUTHS, read  # noqa: E402
from tables.paper import PLACES, paper  # noqa: E402

import warprrf as wr  # noqa: E402
from warprrf.rf.em.diffraction import EdgeRays, diffraction_matrices  # noqa: E402

STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "warprrf", "font.family": "sans-serif", "font.size": 9, "axes.grid": True,
    "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False, "figure.constrained_layout.use": True,
}  # fmt: skip
COLOURS = {
    "bistatic": "#0b6e99", "bistatic-quick": "#5aa9c9", "rf3dgs+": "#c4570f", "rf3dgs": "#e0a458", "nearest": "#777777",
    "idw": "#aaaaaa", "sionna-calibrated": "#4b7f52", "nerf2": "#8a4f7d", "cgan": "#b794b4", "sionna": "#7bb17f",
}  # fmt: skip
CAPTIONS: dict[str, str] = {}
_DRAWN: dict[str, Callable[[], Any]] = {}


def figures() -> dict[str, str]:
    """Path below ``docs/`` to SVG."""
    found = {}
    with plt.rc_context(STYLE):
        for name, draw in _DRAWN.items():
            figure, text = draw(), io.StringIO()
            figure.savefig(text, format="svg", metadata={"Date": None})
            plt.close(figure)
            found[f"figures/{name}.svg"] = text.getvalue()
    return found


def entry(name: str, caption: str) -> Callable[[Callable[[], Any]], Callable[[], Any]]:
    """Enters a figure under its name."""

    def enter(function: Callable[[], Any]) -> Callable[[], Any]:
        _DRAWN[name], CAPTIONS[name] = function, caption
        return function

    return enter


def _name(method: str) -> str:
    return NAMES[method].replace("*", "")


@entry("psnr", "PSNR at held-out receivers against the number of training spectra")
def _psnr() -> Any:
    places = {t: name for (t, split), name in PLACES.items() if split == "random" and paper(t, split)}
    figure, axes = plt.subplots(1, len(places), figsize=(4.5 * len(places), 3.4), sharey=True)
    for ax, (truth, name) in zip(axes, places.items(), strict=True):
        rows = paper(truth, "random")
        for method, colour in COLOURS.items():
            chosen = sorted((r["count"], r["psnr_db"]) for r in rows if r["method"] == method and r["count"])
            if chosen:
                ax.semilogx(*zip(*chosen, strict=True), "o-", ms=3.5, color=colour, label=_name(method))
        counts = sorted({r["count"] for r in rows if r["count"]})
        ax.set(xlabel="training spectra", title=f"truth: {name}")
        ax.set_xticks(counts, list(map(str, counts)))
        ax.minorticks_off()
    axes[0].set_ylabel("PSNR [dB]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=7)
    return figure


@entry(
    "speed", "Error against the time of one spectrum and against training time, 100 spectra of our own engine"
)
def _speed() -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    rows = paper("exact", "random", 100)
    for ax, key, words in (
        (axes[0], "seconds_per_spectrum", "seconds a spectrum"),
        (axes[1], "train_s", "training [s]"),
    ):
        for r in rows:
            if r.get(key):
                ax.loglog(r[key], r["rmse_db"], "o", color=COLOURS.get(r["method"], "#444444"))
                ax.annotate(
                    _name(r["method"]),
                    (r[key], r["rmse_db"]),
                    fontsize=6.5,
                    xytext=(4, 3),
                    textcoords="offset points",
                )
        ax.set_xlabel(words)
        ax.margins(x=0.25)
    axes[0].set_ylabel("rms error of the dB image [dB]")
    return figure


@entry("learning", "Training loss of the networks against their training time")
def _learning() -> Any:
    rows = read("networks")["rows"]
    truths = {truth: f"C{k}" for k, truth in enumerate(TRUTHS)}
    figure, axes = plt.subplots(1, 2, figsize=(11.0, 4.0))
    for ax, method in zip(axes, ("nerf2", "cgan"), strict=True):
        for r in (r for r in rows if r["method"] == method):
            curve = [loss / r["loss_curve"][0] for loss in r["loss_curve"]]
            minutes = [k * r["fit_s"] / 60.0 / (len(curve) - 1) for k in range(len(curve))]
            style = {700: "-", 100: "--", 10: ":"}[r["count"]]
            label = f"{TRUTHS[r['truth']]}, {r['count']} spectra"
            ax.plot(minutes, curve, style, color=truths[r["truth"]], label=label)
        ax.set(title=_name(method), xlabel="training time [min]", ylabel="loss / loss of the first fortieth")
        ax.set_yscale("log")
        ax.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    return figure


@entry("knobs", "Error and time of each setting of the renderer")
def _knobs() -> Any:
    engine, growth = read("renderer"), read("engine")["growth"]
    words = {"alpha_min": "least alpha that counts", "top_k": "Gaussians kept a pixel"}
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2))
    for ax, (knob, title) in zip(axes, words.items(), strict=False):
        rows = engine[knob]
        ax.loglog([r["value"] for r in rows], [r["error_rms_db"] for r in rows], "o-", ms=3, color="#0b6e99")
        ax.set(title=title, ylabel="rms error [dB]")
        twin = ax.twinx()
        twin.plot(
            [r["value"] for r in rows], [1e3 * r["seconds"] for r in rows], "s--", ms=3, color="#c4570f"
        )
        twin.set_ylim(0)
        twin.set_ylabel("ms a receiver", color="#c4570f")
        twin.grid(False)
    axes[2].loglog(
        [r["gaussians"] for r in growth], [1e3 * r["seconds"] for r in growth], "o-", ms=3, color="#0b6e99"
    )
    axes[2].set(title="growth", xlabel="Gaussians", ylabel="ms a panorama")
    return figure


@entry("ablation", "PSNR with ten spectra, one part of the bistatic field changed at a time")
def _ablation() -> Any:
    rows = read("bistatic")["ablation"]
    names = [n for n in dict.fromkeys(r["model"] for r in rows) if not n.startswith("RF-3DGS")]
    figure, ax = plt.subplots(figsize=(8, 3.4))
    for shift, (truth, name), colour in zip((-0.2, 0.2), TRUTHS.items(), ("#0b6e99", "#c4570f"), strict=True):
        found = [next(r["psnr_db"] for r in rows if r["model"] == n and r["truth"] == truth) for n in names]
        ax.barh([i + shift for i in range(len(names))], found, 0.38, color=colour, label=name)
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set_xlabel("PSNR [dB]")
    ax.legend(fontsize=7, loc="lower right")
    return figure


@entry(
    "half-plane",
    "Field behind and before a metal half plane, a plane wave from 60 degrees, 5 wavelengths from its edge",
)
def _half_plane() -> Any:
    """Sommerfeld's closed form beside line of sight, mirror image and diffracted path."""
    source, phi, kr = np.radians(60.0), np.linspace(0.001, 2 * np.pi - 0.001, 1501), 2 * np.pi * 5.0
    rays = EdgeRays(2.0, source, phi, 0.0, np.inf, 5.0, 1.0)
    bent = diffraction_matrices(rays, [(-1.0, 1.0)] * 2) * np.exp(-1j * kr)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    for k, (ax, name, sign) in enumerate(zip(axes, ("along the edge", "across it"), (-1, 1), strict=True)):
        exact, paths = 0.0, bent[:, k, k]
        for angle, factor in ((phi - source, 1.0), (phi + source, sign)):
            wave = factor * np.exp(1j * kr * np.cos(angle))
            exact = exact + 0.5 * wave * erfc(-np.exp(0.25j * np.pi) * np.sqrt(2 * kr) * np.cos(angle / 2))
            paths = paths + np.where(angle < np.pi, wave, 0.0)
        for field, style, label in (
            (exact, "-", "closed form"), (paths, "--", "paths"), (paths - bent[:, k, k], ":", "paths without the edge"),
        ):  # fmt: skip
            level = 20 * np.log10(np.maximum(np.abs(field), 1e-9))
            width = 3.0 if style == "-" else 1.2
            ax.plot(
                np.degrees(phi),
                level,
                style,
                lw=width,
                color={"-": "#5aa9c9", "--": "#c4570f", ":": "#777777"}[style],
                label=label,
            )
        ax.set(title=f"electric field {name}", xlabel="angle about the edge [degrees]", ylim=(-40, 10))
        ax.set_xticks(range(0, 361, 60))
    axes[0].set_ylabel("over the incident field [dB]")
    axes[1].legend(fontsize=7, loc="lower left")
    return figure


@entry(
    "slopes",
    "A walk past a screen at 140 GHz: total path gain, and its slope with visibility frozen and retraced",
)
def _slopes() -> Any:
    where, (vertices, faces) = np.arange(-2.5, 2.5, 0.02), _room_with_a_screen()
    asked: dict[str, Any] = {"transmitter": [-3.0, 0.4, 1.6], "frequency_hz": 140e9, "mirror_order": 2}
    scene = wr.Scene(wr.Mesh(vertices, faces), [wr.em.itu_material("concrete")], np.zeros(len(faces), int))
    walk = np.column_stack([np.full(len(where), 2.0), where, np.full(len(where), 1.2)])

    def total_db(at: np.ndarray) -> Any:
        return 10.0 * np.log10(wr.trace_paths(scene, receivers=at, **asked).power.sum(axis=1))

    held, at = (
        wr.paths.trace_specular(scene, receivers=walk, **asked),
        wp.array(walk, dtype=wp.vec3d, requires_grad=True),
    )
    with wp.Tape() as tape:
        gain = held.evaluate(receivers=at).gain
    tape.backward(grads={gain: wp.array(2.0 * gain.numpy(), dtype=wp.vec2d)})  # of the sum of |gain|^2
    total = total_db(walk)
    frozen = 10.0 / np.log(10.0) * at.grad.numpy()[:, 1] / 10.0 ** (total / 10.0)
    retraced = wr.paths.retraced_slope(total_db, walk)[:, 1]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
    summed = total[0] + np.cumsum(frozen) * 0.02
    for line, style, label in ((total, "-", "traced"), (summed, "--", "first total, plus frozen slopes")):
        axes[0].plot(
            where, line, style, lw=1.2, color=COLOURS["bistatic" if style == "-" else "rf3dgs+"], label=label
        )
    for line, name, label in (
        (retraced, "bistatic", "retraced, 1 cm"),
        (frozen, "rf3dgs+", "visibility frozen"),
    ):
        axes[1].plot(
            where, line, "-" if name == "bistatic" else "--", lw=1.2, color=COLOURS[name], label=label
        )
    axes[0].set(xlabel="along the walk [m]", ylabel="total path gain [dB]")
    axes[1].set(xlabel="along the walk [m]", ylabel="slope [dB/m]", yscale="symlog")
    for ax in axes:
        ax.legend(fontsize=7)
    return figure


def _room_with_a_screen() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a room, faces inward, with a sheet that hides part of it."""
    corners = np.array([[x, y, z] for x in (-4, 4) for y in (-3, 3) for z in (0, 3)], float)
    sheet = np.array([[0, y, z] for y in (-0.8, 0.9) for z in (0, 2.2)], float)
    sides = [
        (0, 2, 3, 1),
        (4, 5, 7, 6),
        (0, 1, 5, 4),
        (2, 6, 7, 3),
        (0, 4, 6, 2),
        (1, 3, 7, 5),
        (8, 10, 11, 9),
    ]
    faces = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    return np.concatenate([corners, sheet]), np.array(faces)
