"""Our image method and a fit of reflection coefficients on NeWRF's conference room, beside what NeWRF publishes.

Protocol: NeWRF's own (github.com/LuHaofan/NeWRF, `loaders.py`, `config/default.yaml`, `eval.py`): the last 20 % of the
receivers are held out, training takes from the first 80 %, and the figure is the channel prediction SNR
-10 log10(sum |prediction - truth|^2 / sum |truth|^2) over all held-out receivers. What each method is given differs
and is said in every row: NeWRF learns from channels and the directions of arrival of every receiver, held-out ones
included; ours has the room's mesh.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.newrf_rays import NewrfRays, load_newrf
from benchmarks.reflections import fit_reflections
from benchmarks.report import Report, cell, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.rf.paths.mirror_paths import MirrorPaths
from warprrf.rf.paths.trace import MirrorTracer

PUBLISHED = {
    "method": "NeWRF (published)",
    "given": "channels and directions of arrival",
    "n_train": 346,
    "snr_db": 22.0,
    "source": (
        "read off the curve 'Val Fine' in Figures/output.png of github.com/LuHaofan/NeWRF (its demo's outcome), to "
        "about 1 dB; no number is printed there. The channels drawn beside the curve are those of the same 86 held-out "
        "receivers. The paper's own figures (ICML 2024, arXiv:2403.03241) could not be read for this table."
    ),
}


def snr_db(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Channel prediction SNR [dB] over all receivers, complex ``(R,)`` each; minus the NMSE in decibels."""
    error = float(np.sum(np.abs(prediction - truth) ** 2) / np.sum(np.abs(truth) ** 2))
    return -10.0 * float(np.log10(max(error, 1e-30)))


MATCH_M = 1e-3
"""Rays of one order are the same if last points and lengths together differ by less [m]."""


@dataclass(frozen=True)
class RayMatch:
    """NeWRF's rays beside ours; arrays over their N rays, NaN where ours has none.

    Attributes:
        receiver: Index of the receiver, shape ``(N,)``.
        order: Reflections: 0, 1 or 2, shape ``(N,)``.
        found: Whether a ray of ours is the same, shape ``(N,)``, bool.
        length_error_m: Absolute difference of unfolded lengths [m].
        point_error_m: Distance between the last points [m].
        phase_error_rad: Absolute difference of the gains' phases [rad].
        gain_error: Relative difference of the complex gains, ``|ours - theirs| / |theirs|``.
        extra_receiver: Receivers of the rays that only we have, shape ``(E,)``.
        extra_order: Their orders, shape ``(E,)``.
        extra_point: Their last points [m], shape ``(E, 3)``.
        missing_point: Last points of the rays that only they have [m], shape ``(N - found, 3)``.
    """

    receiver: np.ndarray
    order: np.ndarray
    found: np.ndarray
    length_error_m: np.ndarray
    point_error_m: np.ndarray
    phase_error_rad: np.ndarray
    gain_error: np.ndarray
    extra_receiver: np.ndarray
    extra_order: np.ndarray
    extra_point: np.ndarray
    missing_point: np.ndarray

    def summary(self) -> dict[str, dict[str, float | int | None]]:
        """Figures per kind of ray ("line_of_sight", "once", "twice"): counts, share found, median and worst errors."""
        rows: dict[str, dict[str, float | int | None]] = {}
        for order, name in enumerate(("line_of_sight", "once", "twice")):
            mine = self.order == order
            if not mine.any():
                continue
            row: dict[str, float | int | None] = {
                "rays": int(mine.sum()),
                "found": int(self.found[mine].sum()),
                "share": float(self.found[mine].mean()),
                "only_ours": int((self.extra_order == order).sum()),
            }
            for error in ("length_error_m", "point_error_m", "phase_error_rad", "gain_error"):
                values = getattr(self, error)[mine & self.found]
                row[f"{error}_median"] = float(np.median(values)) if len(values) else None
                row[f"{error}_worst"] = float(values.max()) if len(values) else None
            rows[name] = row
        return rows


def match_rays(rays: NewrfRays, *, order: int = 1, device: Any = None) -> RayMatch:
    """Trace the same room by our image method and pair the rays, one to one, by order, last point and length.

    Args:
        rays: What :func:`load_newrf` read.
        order: Most reflections to compare: 0, 1 or 2 (theirs have no more).

    Raises:
        ValueError: on another order.
    """
    tracer = MirrorTracer(
        rays.mesh, transmitter=rays.transmitter, frequency_hz=rays.frequency_hz, device=device
    )
    ours = tracer.find(rays.receivers, order)
    our_gain = ours.gain(rays.wavelength_m)
    their_order, their_length = rays.order, rays.length_m
    receiver, column = np.nonzero((their_order >= 0) & (their_order <= order))
    partner = np.full(len(receiver), -1)
    taken = np.zeros(len(ours.receiver), dtype=bool)
    bounces = ours.order
    for k in range(len(rays.receivers)):
        theirs, mine = np.flatnonzero(receiver == k), np.flatnonzero(ours.receiver == k)
        c = column[theirs]
        gap = np.linalg.norm(rays.last_point[k, c][:, None] - ours.last_point[mine][None], axis=2)
        gap = gap + np.abs(their_length[k, c][:, None] - ours.length_m[mine][None])
        gap[their_order[k, c][:, None] != bounces[mine][None]] = np.inf
        while gap.size and gap.min() < MATCH_M:
            i, j = np.unravel_index(gap.argmin(), gap.shape)
            partner[theirs[i]] = mine[j]
            taken[mine[j]] = True
            gap[i], gap[:, j] = np.inf, np.inf
    found = partner >= 0
    gain, mirror = rays.gain[receiver, column], our_gain[partner]
    last = rays.last_point[receiver, column]

    def where_found(values: np.ndarray) -> np.ndarray:
        return np.where(found, values, np.nan)

    return RayMatch(
        receiver=receiver,
        order=their_order[receiver, column],
        found=found,
        length_error_m=where_found(np.abs(their_length[receiver, column] - ours.length_m[partner])),
        point_error_m=where_found(np.linalg.norm(last - ours.last_point[partner], axis=1)),
        phase_error_rad=where_found(np.abs(np.angle(gain / mirror))),
        gain_error=where_found(np.abs(mirror - gain) / np.abs(gain)),
        extra_receiver=ours.receiver[~taken],
        extra_order=bounces[~taken],
        extra_point=ours.last_point[~taken],
        missing_point=last[~found],
    )


HELP = """\
Rays of the image method beside NeWRF's, and channels predicted at held-out receivers from reflection coefficients that
are fitted to few of them. Needs NeWRF's files: see :func:`warprrf.load_newrf`.

examples:
  python -m benchmarks newrf --data external/newrf
"""


@dataclass(frozen=True)
class Options:
    """Options of the comparison with NeWRF.

    Attributes:
        data: folder that :func:`warprrf.load_newrf` reads.
        counts: training receivers; 346 is NeWRF's own 80 %.
    """

    data: str = option("external/newrf", "folder of NeWRF's files")
    counts: tuple[int, ...] = option((10, 50, 200, 346), "training receivers")


def run(options: Options, job: Job) -> Report:
    """Compare rays, fit and predict.

    Raises:
        FileNotFoundError, ValueError: as :func:`warprrf.load_newrf` does.
    """
    rays = load_newrf(options.data)
    job.progress("rays", 0, 2)
    start = time.perf_counter()
    match = match_rays(rays, order=2, device=job.device)
    matching_s = time.perf_counter() - start
    job.progress("rays", 1, 2)
    tracer = MirrorTracer(
        rays.mesh, transmitter=rays.transmitter, frequency_hz=rays.frequency_hz, device=job.device
    )
    start = time.perf_counter()
    chains = tracer.find(rays.receivers, 2)
    trace_s = time.perf_counter() - start
    job.progress("rays", 2, 2)
    other = np.concatenate([match.extra_receiver, match.receiver[~match.found]])
    figures = {
        "source": "NeWRF conference room (github.com/LuHaofan/NeWRF, MIT), MATLAB image method, up to 2 reflections",
        "receivers": len(rays.receivers),
        "frequency_hz": rays.frequency_hz,
        "rays": match.summary(),
        "matching_seconds": matching_s,
        "trace_seconds": trace_s,
        "held_out": len(rays.split()[1]),
        "held_out_same_rays": int((~np.isin(rays.split()[1], other)).sum()),
        "receivers_with_other_rays": np.unique(other),
        "prediction": _predictions(rays, chains, options.counts, other, job.progress),
    }
    return Report("newrf", figures, text(figures))


def _predictions(
    rays: NewrfRays, chains: MirrorPaths, counts: tuple[int, ...], other: np.ndarray, tick: Progress
) -> list[dict[str, Any]]:
    """Rows of the table; every method predicts the same held-out receivers."""
    held_out = rays.split()[1]
    truth = rays.csi[held_out]
    same = ~np.isin(held_out, other)
    later = _of(chains, held_out, len(rays.receivers))
    rows: list[dict[str, Any]] = [PUBLISHED]

    def add(method: str, given: str, n_train: int, prediction: np.ndarray, seconds: float) -> None:
        error = np.abs(prediction - truth) ** 2 / np.abs(truth) ** 2
        rows.append(
            {
                "method": method,
                "given": given,
                "n_train": n_train,
                "snr_db": snr_db(prediction, truth),
                "snr_same_rays_db": snr_db(prediction[same], truth[same]),
                "snr_median_db": -10.0 * float(np.log10(max(float(np.median(error)), 1e-30))),
                "solve_seconds": seconds,
            }
        )

    add("zero", "nothing", 0, np.zeros_like(truth), 0.0)
    direct = np.zeros(len(held_out), dtype=complex)
    alone = later.order == 0
    direct[later.receiver[alone]] = later.gain(rays.wavelength_m)[alone]
    add("line of sight alone", "mesh", 0, direct, 0.0)
    methods = (
        ("perfect reflectors, not fitted", "mesh, materials", "patch", 1.0),
        ("one coefficient a part, prior 0", "mesh, channels", "part", 0.0),
        ("one coefficient a patch, prior 0", "mesh, channels", "patch", 0.0),
        ("one coefficient a patch, prior 1", "mesh, materials, channels", "patch", 1.0),
    )
    for step, (method, given, groups, prior) in enumerate(methods):
        tick("fits", step, len(methods))
        for n in (0,) if "not fitted" in method else counts:
            chosen = rays.split(n)[0]
            fit = fit_reflections(
                rays.mesh,
                rays.transmitter,
                rays.receivers[chosen],
                rays.csi[chosen],
                rays.frequency_hz,
                groups=groups,
                prior=prior,
                chains=_of(chains, chosen, len(rays.receivers)),
            )
            add(method, given, n, fit.channel(later, len(held_out)), fit.solve_s)
    for n in counts:
        chosen = rays.split(n)[0]
        apart = np.linalg.norm(rays.receivers[held_out][:, None] - rays.receivers[chosen][None], axis=2)
        add("nearest measurement", "channels", n, rays.csi[chosen][apart.argmin(axis=1)], 0.0)
    tick("fits", len(methods), len(methods))
    return rows


def _of(chains: MirrorPaths, chosen: np.ndarray, count: int) -> MirrorPaths:
    """The chains of some receivers, numbered anew."""
    number = np.full(count, -1)
    number[chosen] = np.arange(len(chosen))
    kept = chains.subset(np.flatnonzero(number[chains.receiver] >= 0))
    return replace(kept, receiver=number[kept.receiver])


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    rays = [
        [
            name.replace("_", " "), str(row["rays"]), str(row["found"]), f"{100 * row['share']:.2f} %",
            str(row["only_ours"]), f"{row['length_error_m_median']:.1e} / {row['length_error_m_worst']:.1e}",
            f"{row['phase_error_rad_worst']:.1e}", f"{row['gain_error_worst']:.1e}",
        ]
        for name, row in figures["rays"].items()
    ]  # fmt: skip
    head = (
        "rays", "theirs", "found", "share", "only ours", "length error, median / worst [m]", "phase, worst [rad]",
        "relative gain, worst",
    )  # fmt: skip
    channels = [
        [row["method"], row["given"], str(row["n_train"]), f"{row['snr_db']:.1f}", cell(row.get("snr_same_rays_db"), "{:.1f}"),
         cell(row.get("snr_median_db"), "{:.1f}"), cell(row.get("solve_seconds"))]
        for row in figures["prediction"]
    ]  # fmt: skip
    columns = (
        "method", "given", "training receivers", "SNR [dB]", "same rays [dB]", "median of receivers [dB]", "fit [s]",
    )  # fmt: skip
    return "\n\n".join(
        [
            f"{figures['source']}; {figures['receivers']} receivers, {figures['frequency_hz'] / 1e9:g} GHz.",
            table(head, rays),
            f"Tracing takes {figures['trace_seconds']:.1f} s for all.",
            f"Held out: {figures['held_out']} receivers, of which {figures['held_out_same_rays']} have the same rays in "
            "both tracers; `same rays` is the SNR over those alone.",
            table(columns, channels),
            f"NeWRF's figure: {PUBLISHED['source']}",
        ]
    )


BENCHMARKS = {"newrf": Benchmark("newrf", Options, run, HELP)}
