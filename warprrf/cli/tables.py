"""Figures as aligned text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def table(methods: dict[str, dict[str, Any]]) -> str:
    """The figures of several methods as aligned text, one row a method."""
    columns = {
        "psnr_db": "PSNR dB",
        "ssim": "SSIM",
        "rmse_db": "RMSE dB",
        "direction_median_deg": "direction deg",
        "direction_within_3deg": "within 3 deg",
        "direction_within_3deg_blocked": "blocked",
        "beam_gain_loss_db": "beam loss dB",
        "tof_error_median_ns": "ToF ns",
        "aod_error_median_deg": "AoD deg",
    }
    shown = [key for key in columns if any(figures.get(key) is not None for figures in methods.values())]
    rows = [["method", *(columns[key] for key in shown)]]
    rows += [[name, *(_cell(figures.get(key)) for key in shown)] for name, figures in methods.items()]
    return aligned(rows)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 10 else f"{value:.2f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text with their columns flush right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    )
