"""The methods that the benchmarks compare, each behind one function: fields on the reconstruction, lookups, networks, a
ray tracer, and what needs no data.

A method takes a :class:`Task` - training set, what may be known of the room, a time or a number of iterations - and
returns a :class:`Fitted`: what it predicts, what it cost, how large it is. The blending weights of receivers are
computed once and shared by the methods that need them (:class:`~benchmarks.data.Geometry`); their time is counted to
every one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import Geometry
from benchmarks.machine import VERSIONS
from benchmarks.report import Row
from warprrf.device import Progress
from warprrf.files import write_atomically
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.scene import Scene
from warprrf.rf.spectra import lookups, metrics
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import Spectrum, angles_from_directions, spread

PERMITTIVITY_OFF, ROUGHNESS_OFF = 1.2, 1.5
"""Factors by which assumed materials are wrong, up or down: what a table for another sample of the material gives."""
GAINS = ("exp", "linear")  # domains of a harmonic field's gain, which the paper leaves open


@dataclass(frozen=True)
class Effort:
    """How long methods may work that go on as long as they are let.

    Attributes:
        harmonic_iterations: steps of RF-3DGS+ and RF-3DGS; None: their own.
        network_steps: of NeRF2 and the GAN. As here, and with the next three, they train for a quarter of an hour or more on
            two cores; as published (30 000 steps, 8192 rays, 64 samples) for hours on a graphics card.
        nerf2_rays, nerf2_samples: rays a step, samples a ray.
        cgan_batch: spectra a step.
        calibration_s: seconds of Sionna's calibration where there is no bistatic run to take them from.
        sionna_samples: rays of Sionna's predictions.
    """

    harmonic_iterations: int | None = None
    network_steps: int = 4000
    nerf2_rays: int = 256
    nerf2_samples: int = 32
    cgan_batch: int = 2
    calibration_s: float = 60.0
    sionna_samples: int = 1_000_000


@dataclass(frozen=True)
class Task:
    """What a method is given.

    Attributes:
        train: training set; empty for methods that see no spectrum.
        test: receivers that will be asked for; their spectra are not looked at.
        geometry: what is known of the room.
        scratch: folder for files that a method needs meanwhile.
        progress: called with ``"transport"``, ``"fit"`` and ``"evaluate"``.
        variant: which of the method's variants.
        seed: of every random choice.
        effort: how long.
        depth: most bounces of Sionna's paths: those that the truth has.
        budget_s: seconds that the bistatic field took on the same spectra; None if it was not run.
    """

    train: SpectrumDataset
    test: SpectrumDataset
    geometry: Geometry
    scratch: Path
    progress: Progress
    variant: str = ""
    seed: int = 0
    effort: Effort = Effort()
    depth: int = 1
    budget_s: float | None = None


@dataclass(frozen=True)
class Fitted:
    """A method after it has learned what it can.

    Attributes:
        predict: from a receiver position (3,) [m] to a :class:`Spectrum`.
        transport_s: seconds that tracing the training receivers took; None where nothing is traced.
        fit_s: seconds that learning took; None where nothing is learned.
        field: what can be saved (anything with ``.save(path)``), or None.
        size_bytes: what a prediction needs, where there is nothing to save.
    """

    predict: Callable[[Any], Spectrum] = field(repr=False)
    transport_s: float | None = None
    fit_s: float | None = None
    field: Any = None
    size_bytes: int | None = None


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        fit: learns from a task.
        code: which of :data:`~benchmarks.machine.VERSIONS` its figures depend on, with that of the metrics.
        variants: of which the better one counts.
        network: whether it is a network, which trains for as many steps as it is given.
        untaught: whether it sees no spectrum: one run for all numbers of training receivers.
    """

    fit: Callable[[Task], Fitted]
    code: str
    variants: tuple[str, ...] = ("",)
    network: bool = False
    untaught: bool = False

    @property
    def version(self) -> int:
        """Grows when the method or the metrics compute something else."""
        return 1000 * VERSIONS["metrics"] + VERSIONS[self.code]


def score(method: str, task: Task, keep: Path | None = None) -> tuple[Fitted, Row]:
    """Fit a method and ask it for every test receiver.

    Returns:
        What was fitted, and a row: ``transport_s``, ``fit_s`` and the figures of :func:`warprrf.evaluate`.

    Args:
        keep: file to leave the fitted field in, if it is one.
    """
    fitted = METHODS[method].fit(task)
    if keep is not None and fitted.field is not None:
        write_atomically(keep, fitted.field.save)
    row: Row = {"transport_s": fitted.transport_s, "fit_s": fitted.fit_s}
    row |= metrics.evaluate(task.test, fitted.predict, progress=task.progress)
    return fitted, row


def _bistatic(task: Task, quick: bool = False) -> Fitted:
    found = wr.RadioField.fit(
        task.geometry.reconstruction, task.train, model="bistatic", quick=quick, device=task.geometry.device,
        progress=task.progress,
    )  # fmt: skip
    spent = found.report
    return Fitted(
        found.spectrum, transport_s=spent["transport_time_s"], fit_s=spent["fit_time_s"], field=found
    )


def _harmonic(task: Task, model: str, **options: Any) -> Fitted:
    """RF-3DGS+ or RF-3DGS on the reconstruction.

    Blending weights of the training receivers are kept for all variants.
    """
    place, progress = task.geometry, task.progress
    if task.effort.harmonic_iterations is not None:
        options["iterations"] = task.effort.harmonic_iterations
    weights, seconds = place.weights(task.train, progress)
    learned: Any = wr.RadioField.fit(
        place.reconstruction, task.train, model=model, transport=weights, gain=task.variant, seed=task.seed,
        device=place.device, progress=progress, **options,
    )  # fmt: skip
    return Fitted(learned.spectrum, transport_s=seconds, fit_s=learned.report["fit_time_s"], field=learned)


def _lookup(task: Task, name: str) -> Fitted:
    """A lookup of :mod:`warprrf.rf.spectra.lookups`; the variant is what inverse-distance weighting averages."""
    options = {"domain": task.variant} if task.variant else {}
    size = {"constant": 4, "mean": task.train.path_gain[0].nbytes}.get(name, task.train.path_gain.nbytes)
    return Fitted(getattr(lookups, name)(task.train, **options), size_bytes=int(size))


def _zero(task: Task) -> Fitted:
    prior = BistaticField.prior(task.geometry.reconstruction, task.test, device=task.geometry.device)
    return Fitted(prior.spectrum, field=prior)


def _transmitter(task: Task) -> Fitted:
    """What knows where the transmitter is and nothing of the room: its beam, with Friis' gain."""
    ds = task.test

    def predict(receiver: Any) -> Spectrum:
        toward = ds.transmitter - np.asarray(receiver, np.float64)
        distance = float(np.linalg.norm(toward))
        friis = (SPEED_OF_LIGHT / ds.frequency_hz / (4.0 * np.pi * distance)) ** 2
        gain = spread(
            toward[None], np.array([friis]), ds.shape, ds.beam_sigma_rad, device=task.geometry.device
        )
        departure = np.stack(angles_from_directions(-toward)).astype(np.float32)
        has_power = gain > 0
        return Spectrum(
            path_gain=gain.astype(np.float32),
            delay_s=np.where(has_power, distance / SPEED_OF_LIGHT, np.nan),
            aod=np.where(has_power[..., None], departure, np.float32(np.nan)),
            floor=ds.floor,
            range_db=ds.range_db,
        )

    return Fitted(predict, size_bytes=24)


def _nerf2(task: Task) -> Fitted:
    from benchmarks.baselines.nerf2 import NeRF2Options, fit_nerf2

    low, high = task.geometry.reconstruction.mesh.bounds  # how far the room reaches, and nothing else of it
    options = NeRF2Options(
        far_m=float(np.linalg.norm(high - low)), scale_m=0.5 * float((high - low).max()),
        rays=task.effort.nerf2_rays, samples=task.effort.nerf2_samples,
    )  # fmt: skip
    return _network(fit_nerf2, options, task)


def _cgan(task: Task) -> Fitted:
    from benchmarks.baselines.cgan import CGANOptions, fit_cgan

    return _network(fit_cgan, CGANOptions(batch=task.effort.cgan_batch), task)


def _network(fit: Callable[..., Any], options: Any, task: Task) -> Fitted:
    """A network, trained on the GPU that everything else is on."""
    from benchmarks.baselines.training import Training

    device = None if task.geometry.device is None else str(task.geometry.device)
    found = fit(task.train, options, Training(task.effort.network_steps, task.seed, device, task.progress))
    return Fitted(found.spectrum, fit_s=found.seconds, size_bytes=found.size_bytes)


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
    from benchmarks.baselines.sionna_calibration import Calibration, calibrate_sionna
    from warprrf.rf.interop.twin import write_twin

    seconds = task.budget_s or task.effort.calibration_s
    prior = BistaticField.prior(task.geometry.reconstruction, task.train, device=task.geometry.device)
    twin = write_twin(prior, task.scratch / "twin")
    how = Calibration(seconds, depth=task.depth, seed=task.seed)
    found = calibrate_sionna(
        Scene.load(twin.xml), task.train, how, device=task.geometry.device, progress=task.progress
    )
    fitted = _sionna(found.scene, task)
    return replace(fitted, transport_s=found.start_s, fit_s=found.seconds)


def _sionna(scene: Scene, task: Task) -> Fitted:
    """Sionna RT's PathSolver on ``scene``, which it has read when this returns."""
    from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine

    test = task.test
    engine = SionnaEngine(
        scene, transmitter=test.transmitter, frequency_hz=test.frequency_hz, shape=test.shape,
        beam_sigma_rad=test.beam_sigma_rad, device=task.geometry.device,
        sampling=Sampling(depth=task.depth, samples=task.effort.sionna_samples, seed=task.seed + 1),
    )  # fmt: skip

    def predict(receiver: Any) -> Spectrum:
        found = engine.receive(receiver)
        return Spectrum(
            path_gain=found.path_gain.astype(np.float32), delay_s=found.delay_s, aod=found.aod,
            floor=test.floor, range_db=test.range_db,
        )  # fmt: skip

    mesh = scene.mesh
    size = 4 * (mesh.vertices.size + mesh.faces.size) + 24 * len(scene.materials)
    return Fitted(predict, size_bytes=size)


METHODS: dict[str, Method] = {
    "bistatic": Method(_bistatic, "bistatic"),
    "bistatic-quick": Method(partial(_bistatic, quick=True), "bistatic"),
    "rf3dgs+": Method(partial(_harmonic, model="rf3dgs+"), "harmonic", GAINS),
    "rf3dgs+los": Method(partial(_harmonic, model="rf3dgs+", line_of_sight="explicit"), "harmonic", GAINS),
    "rf3dgs": Method(partial(_harmonic, model="rf3dgs"), "harmonic", GAINS),
    "rf3dgs+alpha": Method(partial(_harmonic, model="rf3dgs+", train_opacity=True), "harmonic", ("exp",)),
    "rf3dgs-alpha": Method(partial(_harmonic, model="rf3dgs", train_opacity=True), "harmonic", ("exp",)),
    "nerf2": Method(_nerf2, "networks", network=True),
    "cgan": Method(_cgan, "networks", network=True),
    "sionna-calibrated": Method(_calibrated, "sionna"),
    "nearest": Method(partial(_lookup, name="nearest"), "lookups"),
    "idw": Method(partial(_lookup, name="idw"), "lookups", ("db", "linear")),
    "constant": Method(partial(_lookup, name="constant"), "lookups"),
    "mean": Method(partial(_lookup, name="mean"), "lookups"),
    "sionna": Method(_assumed, "sionna", untaught=True),
    "sionna-again": Method(lambda task: _sionna(task.geometry.scene, task), "sionna", untaught=True),
    "transmitter": Method(_transmitter, "metrics", untaught=True),
    "zero": Method(_zero, "bistatic", untaught=True),
}
"""Every method by its name. ``+alpha`` and ``-alpha`` train opacity as well, ``+los`` takes line of sight apart. NeRF2 is
ours after the published code, the GAN ours as none is public; neither knows geometry. ``sionna-calibrated`` follows
Sionna RT's gradients on the known mesh for as many seconds as the bistatic field took, ``sionna`` has the true mesh and
materials that are wrong by the factors above, ``sionna-again`` is the truth's own engine under another seed, ``zero``
the known mesh with every surface taken for the prior."""
