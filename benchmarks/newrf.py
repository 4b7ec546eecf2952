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

from benchmarks.report import Report, cell, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.rf.interop.newrf import NewrfRays, load_newrf, match_rays
from warprrf.rf.paths.mirror_paths import MirrorPaths
from warprrf.rf.paths.reflections import fit_reflections
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
