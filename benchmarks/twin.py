"""A field's digital twin against the truth: what a ray tracer makes of it, beside the field and the true scene.

Figures are those of :func:`warprrf.evaluate`. ``field`` is the field itself, ``twin`` a ray tracer on its twin,
``twin_lambertian`` the same without scattering patterns (what ``sionna.rt.load_scene`` alone opens), ``true_scene`` the
ray tracer on the true scene with another seed than the truth's: how far the truth repeats itself.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, checked, scene_of
from benchmarks.machine import machine
from benchmarks.pictures import METHODS
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.spectrum import Spectrum

HELP = """\
Writes the digital twin of a bistatic field, solves it with Sionna RT and compares with the data set's spectra.

examples:
  python -m benchmarks twin --field runs/lobby/field-bistatic-sionna.safetensors
"""
NAMES = {
    "field": METHODS["bistatic"][0],
    "twin": "its twin",
    "twin_lambertian": "its twin without scattering patterns",
    "true_scene": "the true scene, another seed",
}
COLUMNS = (
    ("name", "", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"), ("psnr_db_blocked", "blocked", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"), ("rmse_db", "RMSE [dB]", "{:.2f}"), ("direction_within_3deg", "within 3 deg", "{:.0%}"),
    ("seconds_per_spectrum", "a spectrum [s]", "{:.3f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the twin.

    Attributes:
        field: file of a bistatic field.
        spectra: data set whose test receivers are asked.
        scene: true scene (XML), solved with another seed; the one beside the data by default.
        every: each how-manieth test receiver counts.
        engine: what solves the twin.
        depth, samples: of the solver.
    """

    field: str = option("runs/lobby/field-bistatic-sionna.safetensors", "file of a bistatic field")
    spectra: str = option(f"{DATA}/spectra_sionna.nc", "data set whose test receivers are asked")
    scene: str | None = option(None, "true scene (XML): the one beside the data by default")
    every: int = option(1, "each K-th test receiver")
    engine: str = option("sionna", "what solves the twin", choices=("sionna", "exact"))
    depth: int = 3
    samples: int = 1_000_000


def run(options: Options, job: Job) -> Report:
    """Write the twin of the field to ``job.out`` and score the engine's spectra of it.

    Raises:
        FileNotFoundError: if there is no such field or data set.
        ImportError: if Sionna RT is asked for and missing.
    """
    test = SpectrumDataset.load(options.spectra).split(1)[1]
    test = test.subset(np.arange(0, len(test), checked("every", options.every, 1)))
    true = Scene.load(options.scene) if options.scene is not None else Scene.load(scene_of([options.spectra]))
    figures = compare(wr.RadioField.load(options.field, device=job.device), test, true, options, job)
    rows = [{"name": NAMES[key], **figures[key]} for key in NAMES]
    return Report("twin", {**figures, "machine": machine(job.device)}, columns_table(COLUMNS, rows))


def compare(
    field: Any, test: SpectrumDataset, true_scene: Scene | None, options: Options, job: Job
) -> dict[str, Any]:
    """Figures by method (``true_scene`` only if one is given), and ``projection``: the twin's errors [dB], what was
    left out, groups and triangles."""
    twin = wr.write_twin(field, job.out)
    scene = Scene.load(twin.xml)
    even = [replace(material, pattern="lambertian") for material in scene.materials]
    scenes = {"twin": scene, "twin_lambertian": scene.with_materials(even)}
    if true_scene is not None:
        scenes["true_scene"] = true_scene
    figures: dict[str, Any] = {"field": evaluate(test, field.spectrum)}
    for name, one in scenes.items():
        start = time.perf_counter()
        spectra = wr.simulate(
            one,
            transmitter=test.transmitter,
            receivers=test.receivers,
            frequency_hz=test.frequency_hz,
            shape=test.shape,
            engine=options.engine,
            depth=options.depth,
            samples=options.samples,
            beam_sigma_rad=test.beam_sigma_rad,
            seed=job.seed + 1,
            progress=job.progress,
            device=job.device,
        )
        seconds = (time.perf_counter() - start) / len(spectra)
        answers = iter([spectra[k] for k in range(len(spectra))])  # receivers are asked for in order
        figures[name] = {**evaluate(test, partial(_next, answers)), "seconds_per_spectrum": seconds}
    figures["projection"] = {
        "scattering_error_db": twin.scattering_error_db,
        "mirror_error_db": twin.mirror_error_db,
        "lobe_error_db": twin.lobe_error_db,
        "left_out": list(twin.left_out),
        "groups": len(twin.groups),
        "triangles": len(scene.mesh.faces),
    }
    return figures


def _next(answers: Iterator[Spectrum], _receiver: Any) -> Spectrum:
    return next(answers)


BENCHMARKS = {"twin": Benchmark("twin", Options, run, HELP)}
