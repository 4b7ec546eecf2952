"""The systems that the table compares, each as one row: fitted if it learns, then asked for every test receiver.

What receivers see of the frozen geometry is computed once and shared by the rows that need it; its time is counted to
every one of them. A system that has options which its source leaves open stands in the table with the better of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.bench.bistatic.setting import Geometry, Truth
from warprrf.bench.stages import source, write_atomically
from warprrf.device import Progress
from warprrf.rf import lookups, metrics
from warprrf.rf.bistatic import BistaticField, Sight
from warprrf.rf.bistatic_training import BistaticTransport
from warprrf.rf.dataset import SpectrumDataset
from warprrf.rf.fresnel import SPEED_OF_LIGHT
from warprrf.rf.harmonic import HarmonicField
from warprrf.rf.spectrum import Spectrum, angles_from_directions, spread

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

# Files of one model alone: changing them leaves the other's rows as they are.
_BISTATIC = (
    "bistatic", "bistatic_fit", "bistatic_training", "bounces", "grouping", "mirror_light", "mirror_tree", "residuals",
    "second_bounce", "specular", "surface", "uncertainty",
)  # fmt: skip
_HARMONIC = ("harmonic", "fitting", "field_paths", "field_targets", "single_bounce", "transport")
_NEITHER = (
    "absorption", "antenna", "blockage", "llvm", "mirror_chains", "mitsuba_photos", "newrf", "reflections",
    "relevance", "relevance_choice", "relevance_model", "sionna_engine", "twin",
)  # fmt: skip


def source_of(method: str) -> str:
    """Fingerprint of the code that a method's rows depend on."""
    other = set(_NEITHER)
    other |= set() if method in RAY_METHODS else set(_BISTATIC)
    other |= set() if method in HARMONIC else set(_HARMONIC)
    folder = Path(wr.__file__).parent / "rf"
    files = [f"rf/{file.name}" for file in sorted(folder.glob("*.py")) if file.stem not in other]
    return source(
        "device.py", "kernels", "geometry", *files, "bench/bistatic/methods.py", "bench/bistatic/setting.py"
    )


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
    row: dict[str, Any] = {"transport_s": None, "fit_s": None}
    test = truth.test
    if method == "bistatic":
        train = truth.train(count)
        rays = geometry.rays(train, progress=progress)
        field = wr.RadioField.fit(
            geometry.reconstruction, train, transport=rays, device=geometry.device, progress=progress
        )
        row |= {"transport_s": rays.seconds, "fit_s": field.report["fit_time_s"], "fit": _how(field.report)}
        if keep is not None:
            write_atomically(keep, field.save)
        return row | metrics.evaluate(test, field.spectrum, progress=progress)
    if method in HARMONIC:
        train = truth.train(count)
        weights, seconds = geometry.weights(train, progress=progress)
        learned = HarmonicField.fit(
            geometry.reconstruction,
            train,
            "rf3dgs+",
            gain=variant,
            transport=weights,
            device=geometry.device,
            progress=progress,
            **HARMONIC[method],
        )
        row |= {"transport_s": seconds, "fit_s": learned.report["fit_time_s"]}
        if keep is not None:
            write_atomically(keep, learned.save)
        seen, seconds = geometry.weights(test, slot=truth.name, progress=progress)
        row |= metrics.evaluate(
            test, lambda rx: learned.spectrum(rx, transport=seen.at(rx)), progress=progress
        )
        # Weights were computed beforehand for all variants: the time of a spectrum from nothing includes them.
        row["seconds_per_spectrum"] += seconds / len(test)
        return row
    predict: Callable[[Any], Spectrum]
    if method == "zero":
        predict = BistaticField.prior(geometry.reconstruction, test, device=geometry.device).spectrum
    elif method == "transmitter":
        predict = point_at_transmitter(test, geometry.device)
    elif method == "idw":
        predict = lookups.idw(truth.train(count), domain=variant)
    else:
        predict = getattr(lookups, method)(truth.train(count))
    return row | metrics.evaluate(test, predict, progress=progress)


def point_at_transmitter(ds: SpectrumDataset, device: Any = None) -> Callable[[Any], Spectrum]:
    """A predictor that knows where the transmitter is and nothing of the room: its beam, with Friis' gain."""

    def predict(receiver: Any) -> Spectrum:
        toward = ds.transmitter - np.asarray(receiver, np.float64)
        distance = float(np.linalg.norm(toward))
        friis = (SPEED_OF_LIGHT / ds.frequency_hz / (4.0 * np.pi * distance)) ** 2
        gain = spread(toward[None], np.array([friis]), ds.shape, ds.beam_sigma_rad, device=device)
        departure = np.stack(angles_from_directions(-toward)).astype(np.float32)
        lit = gain > 0
        return Spectrum(
            path_gain=gain.astype(np.float32),
            delay_s=np.where(lit, distance / SPEED_OF_LIGHT, np.nan),
            aod=np.where(lit[..., None], departure, np.float32(np.nan)),
            floor=ds.floor,
            range_db=ds.range_db,
        )

    return predict


def sight_of(rays: BistaticTransport) -> Callable[[Any], Sight]:
    """What was traced for a receiver, by its position."""
    known = {s.receiver.tobytes(): s for s in rays.sights}
    return lambda receiver: known[np.asarray(receiver, np.float64).tobytes()]


def _how(report: dict[str, Any]) -> dict[str, Any]:
    return {name: report[name] for name in ("held_out", "groups", "elements", "steps", "choices")}
