"""The systems that the table compares, each as one row: fitted if it learns, then asked for every test receiver.

What receivers see of the frozen geometry is computed once and shared by the rows that need it; its time is counted to
every one of them. A system that has options which its source leaves open stands in the table with the better of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.methods import (
    BISTATIC_CODE,
    HARMONIC_CODE,
    LOOKUPS_CODE,
    fit_bistatic,
    fit_harmonic,
    fit_lookup,
    method_mark,
    point_at_transmitter,
    untaught,
    view_of,
)
from benchmarks.setting import Geometry, Truth
from warprrf.device import Progress
from warprrf.files import write_atomically
from warprrf.rf.spectra import metrics

__all__ = ["HARMONIC", "UNTAUGHT", "VARIANTS", "point_at_transmitter", "score", "view_of", "source_of"]

HARMONIC: dict[str, dict[str, Any]] = {
    "rf3dgs+": {},
    "rf3dgs+los": {"line_of_sight": "explicit"},
}
VARIANTS: dict[str, tuple[str, ...]] = {
    "bistatic": ("",),
    "rf3dgs+": ("exp", "linear"),
    "rf3dgs+los": ("exp", "linear"),
    "nearest": ("",),
    "idw": ("db", "linear"),
    "constant": ("",),
    "mean": ("",),
    "transmitter": ("",),
    "zero": ("",),
}
"""Methods and the variants of which the better one counts: the gain's domain, or what is averaged."""
UNTAUGHT = ("transmitter", "zero")
"""Methods that see no spectrum: one row for all numbers of training receivers."""
RAY_METHODS = ("bistatic", "zero")


def source_of(method: str) -> str:
    """Fingerprint of the code that a method's rows depend on."""
    if method in RAY_METHODS:
        return method_mark(BISTATIC_CODE, __file__)
    return method_mark(HARMONIC_CODE if method in HARMONIC else LOOKUPS_CODE, __file__)


def score(
    method: str,
    variant: str,
    truth: Truth,
    count: int,
    geometry: Geometry,
    keep: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """One row: what :func:`evaluate` finds, and the seconds that transport and fit took.

    Args:
        method, variant: of :data:`VARIANTS`.
        truth: what is learned from and asked for.
        count: training receivers.
        geometry: what is known of the room.
        keep: file to leave the fitted field in, if it is one.
        progress: told of ``"transport"``, ``"fit"`` and ``"evaluate"``.
    """
    test = truth.test
    if method == "bistatic":
        fitted = fit_bistatic(geometry, truth.train(count), progress=progress)
    elif method in HARMONIC:
        fitted = fit_harmonic(
            geometry, truth.train(count), test, "rf3dgs+", gain=variant, slot=truth.name, progress=progress,
            **HARMONIC[method],
        )  # fmt: skip
    elif method in UNTAUGHT:
        fitted = untaught(method, geometry, test)
    else:
        fitted = fit_lookup(method, variant, truth.train(count))
    row: dict[str, Any] = {"transport_s": fitted.transport_s, "fit_s": fitted.fit_s}
    if method == "bistatic":
        row["fit"] = _how(fitted.field.report)
    if keep is not None and fitted.field is not None:
        write_atomically(keep, fitted.field.save)
    row |= metrics.evaluate(test, fitted.predict, progress=progress)
    row["seconds_per_spectrum"] += fitted.before_s
    return row


def _how(report: dict[str, Any]) -> dict[str, Any]:
    return {name: report[name] for name in ("held_out", "groups", "elements", "steps", "choices")}
