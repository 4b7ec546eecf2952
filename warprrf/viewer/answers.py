"""What is known at a receiver: spectrum, paths, truth where there is one, and the beam that an array would take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from warprrf.device import Progress, with_progress
from warprrf.geometry.mesh import Mesh
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.channel.beams import dft_codebook
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import angle_deg, psnr, strongest_direction, unit_image
from warprrf.rf.spectra.readings import Readings, fading_db, path_weights
from warprrf.rf.spectra.spectrum import Spectrum, directions_from_angles, to_db

Source = RadioField | Scene | Mesh
AT_M = 0.005
"""A receiver that stands no farther from a measured one has its truth."""
CARRIER_STEP_HZ = 0.1e9
"""Carriers that differ by less than half of it are one."""
MOST_PATHS = 200


@dataclass(frozen=True)
class Answer:
    """What arrives at one receiver.

    Attributes:
        receiver: position [m], shape ``(3,)``.
        paths: from each transmitter, strongest first.
        spectrum: of all transmitters, powers added; None without a field.
        frequency_hz: carrier [Hz].
        seconds: that it took.
    """

    receiver: np.ndarray
    paths: tuple[Paths, ...]
    spectrum: Spectrum | None
    frequency_hz: float
    seconds: float

    @property
    def total_db(self) -> float:
        """Path gain of everything that arrives [dB]; minus infinity of nothing."""
        each = [p.power.sum() for p in self.paths] if self.spectrum is None else self.spectrum.path_gain
        return float(to_db(np.sum(each, dtype=np.float64)))


@dataclass(frozen=True)
class Asked:
    """What is asked for.

    Attributes:
        frequency_hz: carrier [Hz].
        mirror_order: most reflections on a mirror path.
        transmissions: most slabs on a path.
        diffractions: most edges on a path.
        uncertainty: also ask how wrong the spectrum may be, where the field knows that.
    """

    frequency_hz: float
    mirror_order: int
    transmissions: int
    diffractions: int
    uncertainty: bool = False


def as_asked(source: Source, asked: Asked) -> Source:
    """A bistatic field with fewer mirrors, slabs or edges, or at another carrier; anything else as it is."""
    if not isinstance(source, BistaticField):
        return source
    if abs(asked.frequency_hz - source.frequency_hz) > 0.5 * CARRIER_STEP_HZ:
        source = source.at_frequency(asked.frequency_hz)
    e = source.effects
    fewer = replace(
        e,
        mirrors=min(asked.mirror_order, e.mirrors),
        transmissions=min(asked.transmissions, e.transmissions),
        diffractions=min(asked.diffractions, e.diffractions),
    )
    return replace(source, effects=fewer)


def answer(source: Source, receiver: np.ndarray, transmitters: Sequence[np.ndarray], asked: Asked) -> Answer:
    """Ask a field (:func:`as_asked`) for spectrum and paths, or trace the paths of a scene or a mesh that do not scatter."""
    start = time.perf_counter()
    spectra, paths = [], []
    for transmitter in transmitters:
        if isinstance(source, BistaticField):
            view = source.view(receiver, transmitter)
            wanted = asked.uncertainty and source.errors is not None and len(transmitters) == 1
            spectra.append(source.spectrum(receiver, transmitter, view=view, uncertainty=wanted))
            paths.append(source.paths(receiver, transmitter, MOST_PATHS, view=view))
        elif isinstance(source, RadioField):
            spectra.append(source.spectrum(receiver, transmitter))
            paths.append(source.paths(receiver, transmitter, MOST_PATHS))
        else:
            paths.append(
                trace_paths(
                    source, transmitter=transmitter, receivers=receiver, frequency_hz=asked.frequency_hz,
                    mirror_order=asked.mirror_order, transmissions=asked.transmissions, diffractions=asked.diffractions,
                )
            )  # fmt: skip
    spectrum = None
    if spectra:
        gains = np.stack([s.path_gain for s in spectra])
        spectrum = spectra[0] if len(spectra) == 1 else replace(
            spectra[0], path_gain=gains.sum(axis=0, dtype=np.float64), delay_s=None, aod=None
        )  # fmt: skip
    carrier = source.frequency_hz if isinstance(source, RadioField) else asked.frequency_hz
    return Answer(receiver, tuple(paths), spectrum, carrier, time.perf_counter() - start)


def measured_here(ds: SpectrumDataset | None, receiver: np.ndarray) -> int | None:
    """Which receiver of ``ds`` stands at ``receiver`` (3,) [m]; None if none does."""
    if ds is None or len(ds) == 0:
        return None
    distance = np.linalg.norm(ds.receivers - receiver, axis=1)
    nearest = int(distance.argmin())
    return nearest if distance[nearest] <= AT_M else None


def errors(predicted: Spectrum, truth: Spectrum) -> dict[str, float]:
    """How wrong a spectrum is: PSNR of the dB image [dB], direction of the strongest pixel [degrees], total [dB]."""
    if truth.range_db is None:
        raise ValueError("truth: its range_db is None, expected the dB range of its data set")
    images = [unit_image(s.path_gain, truth.floor, truth.range_db) for s in (predicted, truth)]
    peaks = [strongest_direction(s.path_gain) for s in (predicted, truth)]
    totals = [max(s.total_path_gain, 1e-300) for s in (predicted, truth)]
    return {
        "psnr_db": psnr(*images),
        "direction_deg": float(angle_deg(*peaks)),
        "total_db": 10.0 * float(np.log10(totals[0] / totals[1])),
    }


def legs(paths: Paths, index: int) -> np.ndarray:
    """Legs of one path from transmitter to receiver [m], shape ``(D + 1, 2, 3)``."""
    met = paths.vertices[index]
    points = np.array([paths.transmitter, *met[np.isfinite(met[:, 0])], paths.receiver], dtype=np.float64)
    return np.stack([points[:-1], points[1:]], axis=1)


def strongest(found: Sequence[Paths], count: int) -> list[tuple[Paths, int]]:
    """Up to ``count`` paths of all transmitters, each with its index, strongest first."""
    owner = np.repeat(np.arange(len(found)), [len(p.gain) for p in found])
    index = np.concatenate([np.arange(len(p.gain)) for p in found])
    order = np.argsort(-np.concatenate([p.power for p in found]), kind="stable")[:count]
    return [(found[owner[k]], int(index[k])) for k in order]


def described(paths: Paths, index: int) -> tuple[str, str, str, str, str]:
    """One path in words: kind, gain, delay, zenith and azimuth of arrival, and of departure."""
    degrees = [float(np.rad2deg(getattr(paths, n)[index])) for n in ("theta_r", "phi_r", "theta_t", "phi_t")]
    gain = float(to_db(paths.power[index], 1e-300))
    return (
        str(paths.kind[index]), f"{gain:.1f} dB", f"{paths.tau[index] * 1e9:.2f} ns",
        f"{degrees[0]:.0f}°, {degrees[1]:.0f}°", f"{degrees[2]:.0f}°, {degrees[3]:.0f}°",
    )  # fmt: skip


def nearest_path(each: Sequence[np.ndarray], origin: np.ndarray, direction: np.ndarray) -> tuple[int, float]:
    """Which of the paths with :func:`legs` ``each`` a ray passes nearest to as seen from its ``origin``, and the angle
    between the two [rad]."""
    unit, angles = direction / np.linalg.norm(direction), [np.inf]
    for start, end in ((own[:, :1], own[:, 1:]) for own in each):
        toward = start + np.linspace(0.0, 1.0, 200)[:, None] * (end - start) - origin
        along = toward @ unit
        angles.append(np.arctan2(np.linalg.norm(toward - along[..., None] * unit, axis=-1), along).min())
    nearest = int(np.argmin(angles))
    return nearest - 1, float(angles[nearest])


def reading_errors(field: RadioField, readings: Readings, progress: Progress | None = None) -> np.ndarray:
    """What ``field`` predicts over what was read [dB], shape ``(N,)``; NaN where nothing was, or both are below the floor.

    The gain of a measuring chain is not known: each chain's median error is taken off. The air is that of the readings.

    Raises:
        ValueError: for azimuths or delays that count from an unknown zero, or a place that ``field`` does not hold at.
    """
    if not readings.zero_known:
        raise ValueError("readings: their azimuths or delays count from an unknown zero, expected known ones")
    field, (power, steady) = field.with_gas(readings.air), np.empty((2, len(readings)))
    ends = np.column_stack([readings.transmitters, readings.receivers])
    links, own = np.unique(ends, axis=0, return_inverse=True)
    for k, link in enumerate(with_progress(links, "readings", progress)):
        rows, paths = np.flatnonzero(own.reshape(-1) == k), field.paths(link[3:], link[:3])
        weight = path_weights(readings, rows, paths.arrival, paths.departure, paths.tau) * paths.power
        power[rows] = weight.sum(axis=1)
        single = weight[:, paths.kind != "diffuse"] / np.maximum(power[rows], 1e-300)[:, None]
        steady[rows] = (single**2).sum(axis=1)
    floor, predicted = to_db(readings.floor), to_db(power)
    read = to_db(readings.power) - fading_db(readings.samples, steady)[0]
    error = np.maximum(predicted, floor) - np.maximum(read, floor)
    error[np.isnan(readings.power) | (predicted <= floor) & (readings.power <= readings.floor)] = np.nan
    chain = np.asarray(readings.chain)
    for name in np.unique(chain[chain != ""]):
        error[chain == name] -= np.nanmedian(error[chain == name])
    return error


def delay_profile(paths: Sequence[Paths], bandwidth_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Power of each tap [dB] over delay [ns], shapes ``(T,)``: those of ``bandwidth_hz``, from the first path to the last one;
    NaN where nothing arrives at all."""
    least, most = 256, 8192
    tau = np.concatenate([p.tau for p in paths])
    power = np.concatenate([p.power for p in paths])
    first = tau.min() - 4.0 / bandwidth_hz if len(tau) else 0.0
    index = np.round((tau - first) * bandwidth_hz).astype(int)
    taps = int(np.clip(index.max(initial=0) + 1, least, most))
    inside = index < taps
    total = np.bincount(index[inside], power[inside], minlength=taps)
    total_db = to_db(total, 1e-300) if total.any() else np.full(taps, np.nan)
    return (first + np.arange(taps) / bandwidth_hz) * 1e9, total_db


def best_beam(paths: Sequence[Paths], size: int, azimuth_rad: float) -> tuple[float, np.ndarray, np.ndarray]:
    """The best beam of the DFT codebook of an array of ``size`` squared that faces ``azimuth_rad``, without pilots.

    Returns:
        What it gains over one isotropic antenna [dB], and its power gain (K, M) along directions (K, M, 3).
    """
    codebook = dft_codebook(PlanarArray(size, size, orientation=(azimuth_rad, 0.0, 0.0)))
    arrival = np.concatenate([p.arrival for p in paths])
    power = np.concatenate([p.power for p in paths])
    received = codebook.power(arrival, power)
    best = int(received.argmax())
    zenith, azimuth = np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(-np.pi, np.pi, 121), indexing="ij")
    directions = directions_from_angles(zenith, azimuth)
    lobe = np.abs(codebook.amplitude(directions.reshape(-1, 3))[best]) ** 2
    gain_db = 10.0 * float(np.log10(max(received[best] / max(power.sum(), 1e-300), 1e-300)))
    return gain_db, lobe.reshape(zenith.shape), directions
