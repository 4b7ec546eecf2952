"""The plain lobby: photos of walls, ceiling and pillars without features, and a pane that mirrors.

The same geometry and the same photo poses as the main job's; only the floor, signs and furniture carry patterns. Its
photos become geometry, which is scored as the main job scores its own, and a bistatic field from ten exact spectra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import warprrf as wr
from benchmarks.data import VERSIONS
from benchmarks.lobby import pipeline
from benchmarks.machine import machine
from benchmarks.methods import fit_bistatic
from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.spectra import metrics
from warprrf.steps import Attempt, Steps

SHOWN = (
    ("geometry.posed", "photos with a pose", "{:.0f}"),
    ("geometry.camera_rms_m", "camera positions, rms error [m]", "{:.3f}"),
    ("geometry.mesh_distance_median_m", "mesh to true surface where a photo sees it, median [m]", "{:.3f}"),
    ("geometry.mesh_distance_p90_m", "the same, 90th percentile [m]", "{:.3f}"),
    ("geometry.mesh_missed", "photo rays that meet no mesh", "{:.3f}"),
    ("geometry.mesh_complete", "true surface with the mesh within 5 cm", "{:.3f}"),
    ("geometry.photo_psnr_db", "held-out photo PSNR [dB]", "{:.2f}"),
    ("bistatic.psnr_db", "bistatic field, 10 exact spectra, PSNR [dB]", "{:.2f}"),
    ("bistatic.psnr_db_blocked", "the same, blocked receivers [dB]", "{:.2f}"),
)

HELP = """\
Photos of the lobby with plain walls -> geometry -> a bistatic field from ten exact spectra, scored against the truth.
Continues where it was stopped; about ten minutes on two cores.

examples:
  python -m benchmarks lobby-plain
"""


@dataclass(frozen=True)
class Options:
    """Options of the plain lobby."""

    data: str = option("data/lobby_plain", "photos and scene of the plain lobby")
    spectra: str = option("data/lobby/spectra.nc", "exact spectra of the same geometry")
    train: int = option(10, "training spectra")


def run(options: Options, job: Job) -> Report:
    """Reconstruct the plain lobby and fit a field on it.

    Raises:
        ValueError: if data are missing or broken, or another run is at work in ``job.out``.
    """
    lobby = PlainLobby(Path(options.data), job, replace(pipeline.FULL, train=options.train))
    lobby.check_photos()
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        figures = lobby.plain_figures(steps, Path(options.spectra))
    figures |= {"seed": job.seed, "machine": machine(job.device)}
    return Report("lobby_plain", figures, summary(figures))


class PlainLobby(pipeline.Lobby):
    """A run of the plain lobby: the main job's steps of stage 1, and one field."""

    def plain_figures(self, steps: Steps, spectra: Path) -> dict[str, Any]:
        """Figures of geometry and field, from the steps."""
        geometry, errors = self.stage_1(steps)
        field = steps.run(
            "bistatic", partial(self.bistatic, spectra), version=VERSIONS["bistatic"],
            inputs=[steps.key("geometry"), spectra, self.sizes.train, VERSIONS["metrics"]],
        )  # fmt: skip
        return {"geometry": {**geometry, **errors}, "bistatic": field, "seconds": steps.seconds()}

    def bistatic(self, spectra: Path, attempt: Attempt) -> dict[str, Any]:
        """The field from a few exact spectra, on the test receivers."""
        train, test = pipeline.receivers(wr.SpectrumDataset.load(spectra), self.sizes, seed=self.job.seed)
        fitted = fit_bistatic(self.place, train, seed=self.job.seed, progress=attempt.progress)
        return metrics.evaluate(test, fitted.field.spectrum, progress=attempt.progress)


def summary(figures: dict[str, Any]) -> str:
    """The figures as a table, then what is not posed and what is guessed."""
    rows = []
    for path, name, form in SHOWN:
        value = figures
        for key in path.split("."):
            value = value[key]
        rows.append([name, form.format(value)])
    lost = [f"no pose, {name}: {why}" for name, why in figures["geometry"]["unposed"].items()]
    said = [f"- {line}" for line in (*lost, *figures["geometry"]["guessed"])]
    return "\n\n".join([table(["figure", "value"], rows), "\n".join(said)])


BENCHMARKS = {"lobby-plain": Benchmark("lobby-plain", Options, run, HELP, out="runs/lobby_plain")}
