"""The main job over several seeds: how far its figures spread by what a seed decides.

A seed decides structure from motion's draws, the refinement's order of photos, which training receivers come first
and how fields start. Each seed has a run of its own, ``seed-N``, which continues where it was stopped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.lobby import pipeline
from benchmarks.lobby.report import FIGURES
from benchmarks.machine import machine
from benchmarks.pictures import name_of
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option

METHOD_FIGURES = (
    "psnr_db",
    "psnr_db_blocked",
    "ssim",
    "rmse_db",
    "direction_within_3deg",
    "direction_within_3deg_blocked",
)
COLUMNS = (("figure", "figure", "{}"), ("mean", "mean", "{:.4g}"), ("spread", "spread", "{:.2g}"),
           ("least", "least", "{:.4g}"), ("most", "most", "{:.4g}"))  # fmt: skip

HELP = """\
Runs the main job once a seed (six to eighteen minutes each) and writes mean, standard deviation, least and most of its
figures, with both truths at ten and fifty spectra.

examples:
  python -m benchmarks lobby-seeds
  python -m benchmarks lobby-seeds --seeds 0 1 2 3 4
"""


@dataclass(frozen=True)
class Options(pipeline.Options):
    """Options of the main job, and the seeds."""

    seeds: tuple[int, ...] = option((0, 1, 2), "seeds of the runs")


def run(options: Options, job: Job) -> Report:
    """Run the main job for each seed and gather its figures.

    Raises:
        ValueError: for fewer than two seeds, and as the main job does.
    """
    if len(set(options.seeds)) < 2:
        raise ValueError(f"seeds: got {list(options.seeds)}, expected at least two different ones")
    own = pipeline.Options(options.data, options.spectra, options.reduced)
    reports = []
    for seed in options.seeds:
        one = replace(job, out=job.out / f"seed-{seed}", seed=seed)
        reports.append(pipeline.run(own, one).write(one.out))
    rows = spread(reports)
    figures = {
        "seeds": options.seeds,
        "rows": rows,
        "machine": machine(job.device),
        "reduced": options.reduced,
    }
    text = f"Seeds {', '.join(map(str, options.seeds))}; spread: standard deviation.\n\n{columns_table(COLUMNS, rows)}"
    return Report("lobby_seeds", figures, text)


def spread(reports: list[dict[str, Any]]) -> list[Row]:
    """A row a figure of the main job's reports: ``key``, ``figure``, ``mean``, ``spread`` (standard deviation of a
    sample), ``least``, ``most`` and ``values``; those that a report lacks are left out."""
    rows = []
    for key, name, values in _figures(reports):
        if None in values:
            continue
        found = np.array(values, float)
        rows.append(
            {"key": key, "figure": name, "mean": found.mean(), "spread": found.std(ddof=1), "least": found.min(),
             "most": found.max(), "values": found}
        )  # fmt: skip
    return rows


def _figures(reports: list[dict[str, Any]]) -> list[tuple[str, str, list[float | None]]]:
    """Key, name and the value of each seed of every figure."""
    found = [(key, f"{name} [{unit}]", [r.get(key) for r in reports]) for key, name, unit in FIGURES]
    for group, truth in (("methods", "exact"), ("methods_sionna", "Sionna RT")):
        methods: Mapping[str, Any] = reports[0][group]
        found += [
            (f"{group}.{method}.{figure}", f"{name_of(method)}, truth {truth}: {figure}",
             [r[group][method].get(figure) for r in reports])
            for method in methods for figure in METHOD_FIGURES
        ]  # fmt: skip
    return found


BENCHMARKS = {"lobby-seeds": Benchmark("lobby-seeds", Options, run, HELP)}
