"""A field's digital twin against the truth: what a ray tracer makes of it, beside the field and the true scene.

Figures are those of :func:`warprrf.evaluate`. ``field`` is the field itself, ``twin`` a ray tracer on its twin,
``twin_lambertian`` the same without scattering patterns (what ``sionna.rt.load_scene`` alone opens), ``true_scene`` the
ray tracer on the true scene with another seed than the truth's: how far the truth repeats itself.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from warprrf.device import Progress
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.interop.twin import write_twin
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import simulate
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.spectrum import Spectrum


def compare_twin(
    field: BistaticField,
    test: SpectrumDataset,
    folder: str | os.PathLike[str],
    *,
    engine: str = "sionna",
    true_scene: Scene | None = None,
    depth: int = 3,
    samples: int = 1_000_000,
    seed: int = 1,
    progress: Progress | None = None,
    device: Any = None,
) -> dict[str, Any]:
    """Write the twin of ``field`` to ``folder`` and score ``engine``'s spectra of it on the receivers of ``test``.

    Returns:
        Figures by method (``true_scene`` only if one is given), and ``projection``: the twin's errors [dB], what was
        left out, groups and triangles.
    """
    twin = write_twin(field, folder)
    scene = Scene.load(twin.xml)
    even = [replace(material, pattern="lambertian") for material in scene.materials]
    scenes = {"twin": scene, "twin_lambertian": scene.with_materials(even)}
    if true_scene is not None:
        scenes["true_scene"] = true_scene
    figures: dict[str, Any] = {"field": evaluate(test, field.spectrum)}
    for name, one in scenes.items():
        start = time.perf_counter()
        spectra = simulate(
            one,
            transmitter=test.transmitter,
            receivers=test.receivers,
            frequency_hz=test.frequency_hz,
            shape=test.path_gain.shape[1:],
            engine=engine,
            depth=depth,
            samples=samples,
            beam_sigma_rad=test.beam_sigma_rad,
            seed=seed,
            progress=progress,
            device=device,
        )
        seconds = (time.perf_counter() - start) / len(spectra)
        answers = iter([spectra[k] for k in range(len(spectra))])  # receivers are asked for in order
        figures[name] = evaluate(test, partial(_next, answers))
        figures[name]["seconds_per_spectrum"] = seconds
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
