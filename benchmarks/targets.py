"""What was asked of the figures, as data: the library and the figures themselves know nothing of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Target:
    """One bound.

    Attributes:
        path: keys of the figure in the benchmark's JSON, with dots between; ``KEY=VALUE&...`` picks from a list the first
            row of these values.
        name: how it is called.
        limit: the bound.
        at_least: whether the figure has to be at least, or else at most, the limit.
        unit: of figure and limit.
    """

    path: str
    name: str
    limit: float
    at_least: bool = False
    unit: str = ""


def _margins() -> tuple[Target, ...]:
    asked = {
        ("exact", "rf3dgs+"): {10: 9.0, 50: 8.0, 400: 6.0},
        ("exact", "rf3dgs+los"): {10: 7.0, 50: 6.0, 400: 5.0},
        ("sionna", "rf3dgs+"): {10: 6.0, 50: 4.0, 400: 3.0},
    }
    return tuple(
        Target(
            f"margins.truth={truth}&split=random&count={count}&method={base}.psnr_db",
            f"PSNR over {base}, {truth}, {count} spectra",
            least,
            True,
            "dB",
        )
        for (truth, base), counts in asked.items()
        for count, least in counts.items()
    )


TARGETS: dict[str, tuple[Target, ...]] = {
    "arrays": (
        Target("rows.carrier_ghz=2.4&method=field.gained_db", "2.4 GHz, over the nearest", 3.0, True, "dB"),
    ),
    "batches": (
        Target("rows.figure=spectra, exact truth.over", "spectra over one by one, exact truth", 0.5),
        Target("rows.figure=spectra, sionna truth.over", "spectra over one by one, Sionna RT's truth", 0.5),
        Target("rows.figure=spectra, exact truth, two workers.faster", "two workers over one", 1.7, True),
        Target("rows.receivers=10000.peak_gb", "memory of 10 000 responses", 4.0, unit="GB"),
        Target(
            "rows.figure=single spectra, one ray a pixel.growth_mb",
            "memory after 2000 queries",
            10.0,
            unit="MB",
        ),
    ),
    "report": (  # the lobby's
        Target("photo_psnr_db", "held-out photo PSNR of stage 1", 25.0, True, "dB"),
        Target("camera_rms_m", "camera positions, rms error", 0.02, unit="m"),
        Target(
            "mesh_distance_median_m", "mesh to true surface where a photo sees it, median", 0.02, unit="m"
        ),
        Target("mesh_distance_p90_m", "the same, 90th percentile", 0.06, unit="m"),
        Target("mesh_normal_median_deg", "mesh normal error, median", 4.0, unit="degrees"),
        Target("fit_time_s", "stage 2 fit of RF-3DGS+", 60.0, unit="s"),
        Target("pipeline_time_s", "photos to evaluation, set-up apart", 900.0, unit="s"),
    ),
    "lobby_plain": (
        Target(
            "geometry.mesh_distance_median_m",
            "mesh to true surface where a photo sees it, median",
            0.02,
            unit="m",
        ),
        Target("geometry.mesh_distance_p90_m", "the same, 90th percentile", 0.15, unit="m"),
        Target("bistatic.psnr_db", "bistatic field, 10 exact spectra", 33.0, True, "dB"),
    ),
    "paper": (
        *_margins(),
        Target(
            "rows.truth=sionna&split=random&count=50&method=bistatic.psnr_db",
            "PSNR, Sionna RT, 50 spectra",
            28.0,
            True,
            "dB",
        ),
    ),
    "bistatic": (
        *(
            Target(
                f"calibration.truth={truth}&n_train={count}.within_{k}_sigma",
                f"pixels within {k} sigma, {truth}, {count} spectra",
                low,
                True,
            )
            for truth in ("exact", "sionna")
            for count in (10, 50, 400)
            for k, low in ((1, 0.60), (2, 0.90))
        ),
    ),  # fmt: skip
    "channel": (
        *(
            Target(f"closed_forms.{form}.{key}", f"{form}, 100 m, {name}", limit, unit=unit)
            for form in ("friis", "two_ray", "images")
            for key, name, limit, unit in (
                ("gain", "relative gain", 1e-6, ""),
                ("phase_rad", "phase", 1e-3, "rad"),
            )
        ),
        Target("lobby.gain_db", "beside Sionna RT, gain", 0.05, unit="dB"),
        Target("lobby.tau_s", "beside Sionna RT, delay", 1e-12, unit="s"),
        Target("lobby.arrival_rad", "beside Sionna RT, arrival", 1e-4, unit="rad"),
        Target("lobby.departure_rad", "beside Sionna RT, departure", 1e-4, unit="rad"),
        Target("small.times_faster", "frequency response over Sionna's, times faster", 5.0, True),
        Target("small.grid_error", "frequency response, error", 1e-5),
        Target(
            "large.squint=False.seconds", "1e5 paths, 1024 x 16 elements, 2048 frequencies", 60.0, unit="s"
        ),
        Target("large.squint=False.error_in_largest_entries", "the same, error in the largest entries", 1e-3),
    ),
    "newrf": tuple(
        target
        for kind, name in (("line_of_sight", "line of sight"), ("once", "reflected once"))
        for target in (
            Target(f"rays.{kind}.share", f"{name}: share of NeWRF's rays found", 0.99, True),
            Target(f"rays.{kind}.length_error_m_worst", f"{name}: worst length error", 1e-4, unit="m"),
            Target(f"rays.{kind}.phase_error_rad_worst", f"{name}: worst phase error", 0.02, unit="rad"),
        )
    ),
    "engine": (
        Target("blend.speedup", "forward and backward over torch's renderer, times faster", 20.0, True),
        Target("blend.image_difference.quantile_99.9", "difference of the two images, 99.9 %", 1e-4),
        Target("growth.gaussians=100000.seconds", "spectrum of 100 000 Gaussians", 0.150, unit="s"),
    ),
    "filmed": (
        Target("back_median_m", "reference surface to mesh, median", 0.03, unit="m"),
        Target("back_p90_m", "the same, 90th percentile", 0.15, unit="m"),
        Target("back_within_5_cm", "share of it within 5 cm", 0.65, True),
    ),
    "beams": tuple(
        Target(f"within.{truth}.{which}", f"within 1 dB of exhaustive search, {truth}, {name}", share, True)
        for truth in ("exact", "sionna")
        for which, name, share in (("all", "all receivers", 0.90), ("blocked", "blocked", 0.75))
    ),
}
"""Bounds by the name of the report."""


def compared(name: str, figures: Mapping[str, Any]) -> list[list[str]]:
    """What was asked of report ``name`` beside what was measured: figure, bound, value and verdict; what this run did
    not measure is left out."""
    lines = []
    for target in TARGETS.get(name, ()):
        value = found(figures, target.path)
        if value is None:
            continue
        met = value >= target.limit if target.at_least else value <= target.limit
        bound = f"at {'least' if target.at_least else 'most'} {target.limit:g} {target.unit}".strip()
        lines.append([target.name, bound, f"{value:.4g} {target.unit}".strip(), "met" if met else "NOT met"])
    return lines


def found(figures: Any, path: str) -> float | None:
    """The figure at ``path``, or None where there is none."""
    at, rest = figures, path
    while rest and at is not None:
        if isinstance(at, Mapping):  # a key may hold a dot itself
            names = [str(k) for k in at if rest == str(k) or rest.startswith(f"{k}.")]
            if not names:
                return None
            name = max(names, key=len)
            at = next(value for key, value in at.items() if str(key) == name)
        elif isinstance(at, list):
            name = rest.split(".")[0]
            wanted = dict(pair.split("=") for pair in name.split("&"))
            at = next((row for row in at if all(str(row.get(k)) == v for k, v in wanted.items())), None)
        else:
            return None
        rest = rest[len(name) + 1 :]
    return float(at) if isinstance(at, (int, float)) and not isinstance(at, bool) else None
