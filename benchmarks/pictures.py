"""Pictures that several reports share, and the colour that a method has in all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from warprrf.device import require

METHODS = {
    "bistatic": ("bistatic (ours)", "#b3123c"),
    "bistatic-quick": ("bistatic, quick (ours)", "#e0567c"),
    "rf3dgs+": ("RF-3DGS+", "#0b6e99"),
    "rf3dgs+los": ("RF-3DGS+ with line of sight", "#4fb3d9"),
    "rf3dgs": ("RF-3DGS", "#c4570f"),
    "rf3dgs+alpha": ("RF-3DGS+, opacity trained", "#7db7d3"),
    "rf3dgs-alpha": ("RF-3DGS, opacity trained", "#e79a5b"),
    "nearest": ("nearest", "#6b4c9a"),
    "idw": ("IDW", "#3a7d44"),
    "mean": ("mean image", "#8c8c8c"),
    "constant": ("constant", "#bdbdbd"),
    "transmitter": ("point at the transmitter", "#c9a227"),
    "zero": ("our geometry, zero spectra", "#e58aa4"),
    "nerf2": ("NeRF2", "#2a9d8f"),
    "cgan": ("conditional GAN", "#7f4f24"),
    "sionna": ("Sionna RT, assumed materials", "#33415c"),
    "sionna-calibrated": ("Sionna RT, calibrated", "#5c7aea"),
    "sionna-again": ("Sionna RT, another seed", "#222222"),
}
"""Name and colour of each method."""


def name_of(key: str) -> str:
    """Name of a method, or of ``METHOD-COUNT``: one on another number of spectra."""
    method, _, count = key.rpartition("-")
    return METHODS[key][0] if key in METHODS else f"{METHODS[method][0]}, {count} spectra"


def figure_of(
    count: int, size: tuple[float, float], widths: Sequence[float] | None = None, sharey: bool = False
) -> tuple[Any, Any]:
    """A figure with ``count`` panels side by side, and its axes; ``size`` in inches, relative ``widths``."""
    figure = require("matplotlib.figure", extra="plots").Figure(figsize=size, layout="constrained")
    axes = figure.subplots(
        1, count, squeeze=False, sharey=sharey, gridspec_kw={"width_ratios": widths} if widths else None
    )
    return figure, axes[0]


def spectrum_rows(
    truth_db: np.ndarray, predictions_db: dict[str, np.ndarray], low: float, high: float
) -> Any:
    """Truth above, then each prediction beside its difference from the truth; dB images (H, W)."""
    count = len(predictions_db) + 1
    figure = require("matplotlib.figure", extra="plots").Figure(
        figsize=(13.0, 2.55 * count), layout="constrained"
    )
    axes = figure.subplots(count, 2, sharex=True, sharey=True, squeeze=False)
    box = {"extent": (-180.0, 180.0, 180.0, 0.0), "aspect": "auto", "interpolation": "nearest"}
    gain = {"vmin": low, "vmax": high, "cmap": "viridis", **box}
    shown = axes[0, 0].imshow(truth_db, **gain)
    axes[0, 0].set_title("truth", fontsize=10)
    axes[0, 1].axis("off")
    for (name, image), (left, right) in zip(predictions_db.items(), axes[1:], strict=True):
        left.imshow(image, **gain)
        left.set_title(name, fontsize=10)
        wrong = right.imshow(image - truth_db, vmin=-20.0, vmax=20.0, cmap="RdBu_r", **box)
        right.set_title(
            f"{name} - truth, rms {np.sqrt(np.mean((image - truth_db) ** 2)):.1f} dB", fontsize=10
        )
    for place, image, name, extend in (
        (0.72, shown, "path gain [dB]", "neither"),
        (0.28, wrong, "difference [dB]", "both"),
    ):
        bar = axes[0, 1].inset_axes((0.1, place, 0.8, 0.09))
        figure.colorbar(image, cax=bar, label=name, extend=extend, orientation="horizontal")
    figure.supxlabel("azimuth [degrees]", fontsize=10)
    figure.supylabel("zenith [degrees]", fontsize=10)
    return figure
