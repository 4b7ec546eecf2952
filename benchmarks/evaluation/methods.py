"""Every method that the paper compares and every one that ours should be measured by, behind one function each.

A method takes a :class:`Task` - training set, what may be known of the room, a time or a number of iterations - and
returns a :class:`Fitted`: what it predicts, what it cost, how large it is.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.methods import (
    BISTATIC_CODE,
    HARMONIC_CODE,
    LOOKUPS_CODE,
    METRICS_CODE,
    Fitted,
    fit_bistatic,
    fit_harmonic,
    fit_lookup,
    method_mark,
    untaught,
)
from benchmarks.setting import Geometry
from warprrf.device import Progress
from warprrf.rf.em.materials import Material
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import Spectrum

PERMITTIVITY_OFF, ROUGHNESS_OFF = 1.2, 1.5
"""Factors by which assumed materials are wrong, up or down: what a table for another sample of the material gives."""
SIONNA_SAMPLES = 1_000_000
GAINS = ("exp", "linear")  # domains of a harmonic field's gain, which the paper leaves open


@dataclass(frozen=True)
class Effort:
    """How long methods may work that go on as long as they are let.

    Attributes:
        harmonic_iterations: steps of RF-3DGS+ and RF-3DGS; None: their own.
        nerf2_iterations, nerf2_rays, nerf2_samples: steps of NeRF2, rays a step, samples a ray.
        cgan_iterations, cgan_batch: steps of the GAN, spectra a step.
        calibration_s: seconds of Sionna's calibration where there is no bistatic run to take them from.
        sionna_samples: rays of Sionna's predictions.
    """

    harmonic_iterations: int | None = None
    nerf2_iterations: int = 30_000
    nerf2_rays: int = 8192
    nerf2_samples: int = 64
    cgan_iterations: int = 30_000
    cgan_batch: int = 8
    calibration_s: float = 60.0
    sionna_samples: int = SIONNA_SAMPLES


@dataclass(frozen=True)
class Task:
    """What a method is given.

    Attributes:
        train: training set; empty for methods that see no spectrum.
        test: receivers that will be asked for; their spectra are not looked at.
        slot: where the geometry keeps what the test receivers see.
        geometry: what is known of the room.
        variant: which of the method's variants.
        seed: of every random choice.
        effort: how long.
        depth: most bounces of Sionna's paths: those that the truth has.
        budget_s: seconds that the bistatic field took on the same spectra; None if it was not run.
        checkpoint: file for a half-done training.
        progress: told of ``"transport"`` and ``"fit"``.
    """

    train: SpectrumDataset
    test: SpectrumDataset
    slot: str
    geometry: Geometry
    variant: str
    seed: int
    effort: Effort
    depth: int
    budget_s: float | None
    checkpoint: Path
    progress: Progress


@dataclass(frozen=True)
class Method:
    """A method of the evaluation.

    Attributes:
        fit: learns from a task.
        variants: of which the better one counts.
        code: modules and packages that its figures depend on, with what these import.
        traces: what it asks of the geometry's kept rays: "rays", "weights" or nothing.
        network: whether it is a network, trained on fewer sets in a small evaluation.
        random: whether it differs by seed though it sees no spectrum.
        note: how it is to be read.
    """

    fit: Callable[[Task], Fitted]
    variants: tuple[str, ...] = ("",)
    code: tuple[str, ...] = ()
    traces: str = ""
    network: bool = False
    random: bool = False
    note: str = ""


def _bistatic(quick: bool = False) -> Callable[[Task], Fitted]:
    return lambda task: fit_bistatic(task.geometry, task.train, quick=quick, progress=task.progress)


def _harmonic(model: str, train_opacity: bool = False) -> Callable[[Task], Fitted]:
    def fit(task: Task) -> Fitted:
        options: dict[str, Any] = {"gain": task.variant, "seed": task.seed, "train_opacity": train_opacity}
        if task.effort.harmonic_iterations is not None:
            options["iterations"] = task.effort.harmonic_iterations
        return fit_harmonic(
            task.geometry, task.train, task.test, model, slot=task.slot, progress=task.progress, **options
        )

    return fit


def _lookup(name: str) -> Callable[[Task], Fitted]:
    return lambda task: fit_lookup(name, task.variant, task.train)


def _untaught(name: str) -> Callable[[Task], Fitted]:
    return lambda task: untaught(name, task.geometry, task.test)


def _torch_device(device: Any) -> str | None:
    """The torch device beside a Warp device: networks go to the GPU that everything else is on."""
    return None if device is None else str(device)


def _nerf2(task: Task) -> Fitted:
    from benchmarks.baselines import NeRF2, NeRF2Options

    low, high = task.geometry.reconstruction.mesh.bounds  # how far the room reaches, and nothing else of it
    diagonal = float(np.linalg.norm(high - low))
    options = NeRF2Options(
        far_m=diagonal, samples=task.effort.nerf2_samples, scale_m=0.5 * float((high - low).max())
    )
    model = NeRF2.fit(
        task.train, options, iterations=task.effort.nerf2_iterations, rays=task.effort.nerf2_rays,
        checkpoint=task.checkpoint, seed=task.seed, device=_torch_device(task.geometry.device),
        progress=task.progress,
    )  # fmt: skip
    return _network(model)


def _cgan(task: Task) -> Fitted:
    from benchmarks.baselines import CGAN

    model = CGAN.fit(
        task.train, iterations=task.effort.cgan_iterations, batch=task.effort.cgan_batch,
        checkpoint=task.checkpoint, seed=task.seed, device=_torch_device(task.geometry.device),
        progress=task.progress,
    )  # fmt: skip
    return _network(model)


def _network(model: Any) -> Fitted:
    return Fitted(
        model.spectrum,
        fit_s=model.report["fit_time_s"],
        size_bytes=model.model_bytes,
        losses=model.report["losses"],
    )


def _assumed(task: Task) -> Fitted:
    scene = task.geometry.scene
    rng = np.random.default_rng([task.seed, 2])
    wrong = [_misjudged(material, rng.choice((-1.0, 1.0), 2)) for material in scene.materials]
    return _sionna(scene.with_materials(wrong), task)


def _misjudged(material: Material, sign: np.ndarray) -> Material:
    """A material as one would assume it: permittivity and roughness off by the stated factors, up or down."""
    factor, rough = PERMITTIVITY_OFF ** sign[0], ROUGHNESS_OFF ** sign[1]
    bands = tuple(
        replace(b, a=b.a * factor) if b.a > PERMITTIVITY_OFF else b  # a metal's is 1, and stays
        for b in material.bands
    )
    share = None if material.scattering is None else float(np.clip(material.scattering * rough, 0.0, 1.0))
    return replace(material, bands=bands, roughness_m=float(material.roughness_m * rough), scattering=share)


def _calibrated(task: Task) -> Fitted:
    from benchmarks.baselines.sionna_calibration import calibrate_sionna
    from warprrf.rf.interop.twin import write_twin

    seconds = task.budget_s or task.effort.calibration_s
    prior = BistaticField.prior(task.geometry.reconstruction, task.train, device=task.geometry.device)
    task.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=task.checkpoint.parent) as folder:
        twin = write_twin(prior, Path(folder) / "twin")
        found = calibrate_sionna(
            Scene.load(twin.xml), task.train, seconds=seconds, depth=task.depth, seed=task.seed,
            device=task.geometry.device, progress=task.progress,
        )  # fmt: skip
        fitted = _sionna(found.scene, task)
    return replace(
        fitted, transport_s=found.start_s, fit_s=found.seconds, losses=found.losses,
        details={"budget_s": seconds, "steps": len(found.losses)},
    )  # fmt: skip


def _sionna(scene: Scene, task: Task) -> Fitted:
    """Sionna RT's PathSolver on ``scene``, which it has read when this returns."""
    from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine

    test = task.test
    engine = SionnaEngine(
        scene, transmitter=test.transmitter, frequency_hz=test.frequency_hz, shape=test.shape,
        beam_sigma_rad=test.beam_sigma_rad,
        sampling=Sampling(depth=task.depth, samples=task.effort.sionna_samples, seed=task.seed + 1), device=task.geometry.device,
    )  # fmt: skip

    def predict(receiver: Any) -> Spectrum:
        found = engine.receive(receiver)
        return Spectrum(
            path_gain=found.path_gain.astype(np.float32), delay_s=found.delay_s, aod=found.aod,
            floor=test.floor, range_db=test.range_db,
        )  # fmt: skip

    mesh = scene.mesh
    size = 4 * (mesh.vertices.size + mesh.faces.size) + 24 * len(scene.materials)
    return Fitted(predict, size_bytes=size, details={"depth": task.depth})


_NETWORKS = ("benchmarks.baselines", *METRICS_CODE)
_SIONNA = ("warprrf.rf.interop.sionna_engine", *METRICS_CODE)
_MISJUDGED = f"permittivity off by a factor {PERMITTIVITY_OFF}, roughness by {ROUGHNESS_OFF}, up or down"

METHODS: dict[str, Method] = {
    "bistatic": Method(_bistatic(), code=BISTATIC_CODE, traces="rays"),
    "bistatic-quick": Method(
        _bistatic(quick=True),
        code=BISTATIC_CODE,
        note="no term is tried: single bounces and even light, one ray a pixel",
    ),
    "rf3dgs+": Method(_harmonic("rf3dgs+"), GAINS, HARMONIC_CODE, "weights", note="opacity frozen"),
    "rf3dgs": Method(
        _harmonic("rf3dgs"),
        GAINS,
        HARMONIC_CODE,
        "weights",
        note="opacity frozen, delay and AoD channels trained",
    ),
    "rf3dgs+alpha": Method(
        _harmonic("rf3dgs+", True), ("exp",), HARMONIC_CODE, "weights", note="opacity trained with the gain"
    ),
    "rf3dgs-alpha": Method(
        _harmonic("rf3dgs", True),
        ("exp",),
        HARMONIC_CODE,
        "weights",
        note="opacity trained with the gain, as published; delay and AoD channels trained",
    ),
    "nerf2": Method(_nerf2, code=_NETWORKS, network=True, note="ours, after the published code; no geometry"),
    "cgan": Method(_cgan, code=_NETWORKS, network=True, note="ours: none is public; no geometry"),
    "sionna-calibrated": Method(
        _calibrated,
        code=("benchmarks.baselines.sionna_calibration", "warprrf.rf.interop.twin", *_SIONNA, *BISTATIC_CODE),
        note="Sionna RT's gradients on our reconstructed mesh, as many seconds as bistatic took",
    ),
    "nearest": Method(_lookup("nearest"), code=LOOKUPS_CODE),
    "idw": Method(_lookup("idw"), ("db", "linear"), LOOKUPS_CODE),
    "constant": Method(_lookup("constant"), code=LOOKUPS_CODE),
    "mean": Method(_lookup("mean"), code=LOOKUPS_CODE),
    "sionna": Method(_assumed, code=_SIONNA, random=True, note=f"Sionna RT on the true mesh, {_MISJUDGED}"),
    "transmitter": Method(_untaught("transmitter"), code=METRICS_CODE),
    "zero": Method(_untaught("zero"), code=BISTATIC_CODE, note="our mesh, every surface taken for the prior"),
}
UNTAUGHT = ("sionna", "transmitter", "zero")
"""Methods that see no spectrum: one run for all numbers of training receivers."""
OURS = ("bistatic", "bistatic-quick")
"""Our own model."""
AFTER = {"sionna-calibrated": "bistatic"}
"""Methods that are given the seconds of another one's run, and so come after it."""


@cache
def code_of(method: str) -> str:
    """Fingerprint of the code that a method's figures depend on."""
    return method_mark(METHODS[method].code, __file__)
