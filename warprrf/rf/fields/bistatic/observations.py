"""What a fit learns from: data sets of any kind, taken apart into places, one receiver under one transmitter each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import Data, Measured
from warprrf.rf.fields.bistatic.fit import NEPER, OWN_GAIN, Target, gain_of
from warprrf.rf.fields.bistatic.materials import Parameters, Terms
from warprrf.rf.fields.bistatic.measured import (
    ArrayImage,
    Measurement,
    SpectrumPixels,
    WeighedPaths,
    pixel_means,
)
from warprrf.rf.fields.bistatic.response import predict, respond
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.positions import check_dataset, check_positions, question_unit, warn_of_unmodelled
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings, path_weights, question_readings
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, to_db

READINGS_SHAPE = (60, 120)
"""Rows and columns of the rays around a receiver of whom no spectrum is known, and of its field's spectra."""
PIXELS_PER_LAG = 4
"""Directions of an array's spectrum that a fit takes, per pair of elements that tells something of its own."""
READING_ERROR_DB = 1.0
"""Standard deviation of what a field cannot explain of a reading without noise [dB]."""
TOTAL_ERROR_DB = 0.5
"""The same of all power of a place: errors of single directions average out."""
MOST_POINTINGS_BYTES = 256_000_000
"""A table that the places of a data set share is no larger: 9,000 pointings of a horn."""
TAP_STEPS = 4.0  # that delays are told apart in, per tap


@dataclass(frozen=True)
class Place:
    """A receiver under a transmitter, and what was read there.

    Attributes:
        data: index of the data set.
        rows: its readings there, shape ``(N,)``; of spectra the one receiver's index.
        transmitter, receiver: positions [m], shape ``(3,)``.
        frequency_hz: carrier.
        shape: rows and columns of its rays' grid.
        beam_sigma_rad: width of the receiver's beam; None where no spectrum was read.
        air: whose absorption is in the readings.
        chain: name of the measuring chain, "" where its gain is known.
    """

    data: int
    rows: np.ndarray
    transmitter: np.ndarray
    receiver: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    beam_sigma_rad: float | None
    air: Air | None
    chain: str = ""

    @property
    def seen_from(self) -> tuple[object, ...]:
        """All that the geometry seen there depends on."""
        ends = self.transmitter.tobytes(), self.receiver.tobytes()
        return *ends, self.frequency_hz, self.shape, self.beam_sigma_rad, self.air


def as_list(data: Data) -> list[Measured]:
    """Data sets as a list; of several that have one name each gets a number after it.

    Raises:
        TypeError: for anything else.
        ValueError: for none.
    """
    several: list[Measured] = []
    for one in data if isinstance(data, list | tuple) else [data]:
        if not isinstance(one, Measured):
            raise TypeError(
                f"ds: got {type(one).__name__}, expected a SpectrumDataset, Readings, ArraySpectra, or a list of them"
            )
        several.append(one)
    if not several:
        raise ValueError("ds: got an empty list, expected a SpectrumDataset, Readings, or several of them")
    names = [None if isinstance(one, SpectrumDataset) else one.name for one in several]
    for k, one in enumerate(several):
        if not isinstance(one, SpectrumDataset) and names.count(one.name) > 1:
            several[k] = replace(one, name=f"{one.name} {names[: k + 1].count(one.name)}")
    return several


def transmitters_of(one: Measured) -> np.ndarray:
    """Position of the transmitter of each of its receivers [m], shape ``(R, 3)``."""
    if isinstance(one, SpectrumDataset):
        return np.broadcast_to(one.transmitter, one.receivers.shape)
    return one.transmitters


def places_of(data: Sequence[Measured], mesh: Mesh | None, device: DeviceLike) -> list[Place]:
    """The places of data sets, in their order.

    Raises:
        ValueError: for a place where no field can hold; see :func:`warprrf.rf.positions.check_positions`.
    """
    found = []
    for k, one in enumerate(data):
        if isinstance(one, SpectrumDataset):
            receivers, transmitter = check_dataset(mesh, one, device=device)
            found += [
                Place(
                    k,
                    np.array([r]),
                    transmitter,
                    receiver,
                    one.frequency_hz,
                    one.shape,
                    one.beam_sigma_rad,
                    one.air,
                )
                for r, receiver in enumerate(receivers)
            ]
            continue
        _check_readings(mesh, one, device)
        if isinstance(one, ArraySpectra):
            found += [
                Place(k, np.array([r]), *ends, one.frequency_hz, READINGS_SHAPE, None, one.air)
                for r, ends in enumerate(zip(one.transmitters, one.receivers, strict=True))
            ]
            continue
        names, chain = np.unique(np.asarray(one.chain), return_inverse=True)
        key = np.column_stack([one.transmitters, one.receivers, chain])
        first, own, count = np.unique(
            key, axis=0, return_index=True, return_inverse=True, return_counts=True
        )[1:]
        every = np.split(np.argsort(own.reshape(-1), kind="stable"), np.cumsum(count)[:-1])
        for number in np.argsort(first):
            rows = every[number][np.isfinite(one.power[every[number]])]
            if len(rows):
                at = int(first[number])
                found.append(
                    Place(
                        k, rows, one.transmitters[at], one.receivers[at], one.frequency_hz, READINGS_SHAPE, None,
                        one.air, str(names[chain[at]]),
                    )
                )  # fmt: skip
    return found


def _check_readings(mesh: Mesh | None, one: Readings | ArraySpectra, device: DeviceLike) -> None:
    wavelength_m = SPEED_OF_LIGHT / one.frequency_hz
    if isinstance(one, Readings):
        question_readings(one)
    if mesh is not None:
        question_unit(mesh, wavelength_m)
    transmitters, under = np.unique(one.transmitters, axis=0, return_inverse=True)
    for k, transmitter in enumerate(transmitters):
        receivers = np.unique(one.receivers[under.reshape(-1) == k], axis=0)
        names = "ds.transmitters", "ds.receivers"
        check_positions(mesh, transmitter, receivers, wavelength_m, names=names, device=device)
        warn_of_unmodelled(mesh, transmitter, receivers, frequency_hz=one.frequency_hz, device=device)


@dataclass(frozen=True)
class Observed:
    """What was read at a place.

    Attributes:
        place: where.
        measured: how readings come from paths.
        target: what was read.
        floor: path gain that readings are in units of.
        chain: index of the measuring chain whose gain is unknown, -1 where it is known, or :data:`OWN_GAIN`.
    """

    place: Place
    measured: Measurement = field(repr=False)
    target: Target = field(repr=False)
    floor: float
    chain: int


def observe(
    data: Sequence[Measured],
    places: Sequence[Place],
    views: Sequence[ReceiverView],
    noise_db: float,
) -> tuple[list[Observed], list[str]]:
    """What was read at each of ``places``, and the names of the chains whose gain is unknown.

    Args:
        views: what is seen at each place.
        noise_db: standard deviation of errors that are not noise [dB].
    """
    chains = sorted({p.chain for p in places} - {""})
    index = {name: k for k, name in enumerate(chains)}
    found: list[Observed] = []
    whole: dict[tuple[tuple[int, int], float], SpectrumPixels] = {}
    pointings: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}
    for place, view in zip(places, views, strict=True):
        one = data[place.data]
        if isinstance(one, SpectrumDataset):
            key = one.shape, one.beam_sigma_rad
            if key not in whole:
                whole[key] = SpectrumPixels(beam_operator(*key, view.transport.grid.device))
            gain = one.path_gain[place.rows[0]].ravel()
            known = np.isfinite(gain)
            above = to_db(np.where(known, gain, 0.0), one.floor) - 10.0 * np.log10(one.floor)
            target = Target(above, None if known.all() else known.astype(float))
            found.append(Observed(place, whole[key], target, float(one.floor), -1))
            continue
        if isinstance(one, ArraySpectra):
            found.append(_observe_array(one, place, view, noise_db))
            continue
        rows, floors = place.rows, np.asarray(one.floor)[place.rows]
        floor = float(floors.min())
        expected = one.expected_db[rows] - 10.0 * np.log10(floor)
        above = NEPER * np.log1p(10.0 ** (expected / 10.0))
        step = None if one.bandwidth_hz is None else 1.0 / (TAP_STEPS * one.bandwidth_hz)
        weigh = partial(path_weights, one, rows, dtype=np.float32)
        if place.data not in pointings:
            pointings[place.data] = _pointings(one, view)
        if (known := pointings[place.data]) is not None:
            measured = WeighedPaths.turned(view, weigh, known[0], known[1][rows])
        else:
            measured = WeighedPaths.of(
                view,
                weigh,
                arrival=one.arrival is not None,
                departure=one.departure is not None,
                delay_step_s=step,
            )
        unexplained = TOTAL_ERROR_DB if one.total else READING_ERROR_DB
        trust = noise_db / np.hypot(unexplained, one.noise_db[rows])
        target = Target(above, trust, one.power[rows] <= floors)
        found.append(Observed(place, measured, target, floor, index.get(place.chain, -1)))
    return found, chains


def _pointings(one: Readings, view: ReceiverView) -> tuple[np.ndarray, np.ndarray] | None:
    """What each pointing of a receiving antenna reads of unit power in each pixel, shape ``(D, P)`` float32, and which one
    each reading is, shape ``(N,)``; None where arrival is not all that counts, or too many pointings differ."""
    if one.arrival is None or one.departure is not None or one.delay_s is not None:
        return None
    first, row = np.unique(one.arrival, axis=0, return_index=True, return_inverse=True)[1:]
    toward = pixel_means(view.transport.grid)
    if len(first) * len(toward) * np.dtype(np.float32).itemsize > MOST_POINTINGS_BYTES:
        return None
    return path_weights(one, first, toward, toward, np.zeros(len(toward)), dtype=np.float32), row.reshape(-1)


def _observe_array(one: ArraySpectra, place: Place, view: ReceiverView, noise_db: float) -> Observed:
    """An array's spectrum: evenly chosen directions, some times as many as it can tell apart, each trusted the less the
    more of it is scattered.

    Random phases give |c + n|^2, n complex Gaussian of power s, the variance s^2 + 2 s |c|^2.
    """
    measured = ArrayImage.of(view, one.array, one.directions.reshape(-1, 3), one.length_std_m)
    power = one.power[place.rows[0]].ravel()
    known = np.flatnonzero(np.isfinite(power))
    most = PIXELS_PER_LAG * measured.steered.shape[1]
    if len(known) > most:
        known = known[np.round(np.linspace(0, len(known) - 1, most)).astype(int)]
    unit = 1.0
    if one.relative:  # of a size that prediction's is comparable to
        distance = float(np.linalg.norm(place.receiver - place.transmitter))
        unit = (SPEED_OF_LIGHT / one.frequency_hz / (4.0 * np.pi * distance)) ** 2
    target, measured = Target(NEPER * np.log1p(power[known] / one.floor)), measured.part(known)
    chain, floor, terms = OWN_GAIN if one.relative else -1, unit * one.floor, Terms()
    response = respond(view, measured, terms, floor)
    start = Parameters.prior(view.transport.surface.groups, len(terms.lobes))
    total = predict(response, start)
    scattered = predict(replace(response, path_power=np.zeros(len(response.path_power))), start)
    gain = gain_of(chain, start, target, total)
    std_db = (
        NEPER * gain * np.sqrt(scattered * np.maximum(2.0 * total - scattered, 0.0)) / (1.0 + gain * total)
    )
    return Observed(place, measured, target.trusted(noise_db / np.hypot(noise_db, std_db)), floor, chain)


@dataclass(frozen=True)
class Frame:
    """What a field's spectra are made with: those of the first data set of spectra, else defaults; and its transmitter.

    Attributes:
        transmitter: position [m], shape ``(3,)``.
        frequency_hz, shape, floor, range_db, beam_sigma_rad, air: see :class:`SpectrumDataset`.
    """

    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    floor: float
    range_db: tuple[float, float]
    beam_sigma_rad: float
    air: Air | None

    @classmethod
    def of(cls, data: Sequence[Measured]) -> Frame:
        """That of data sets; floor and range of readings are those of their powers."""
        for one in data:
            if isinstance(one, SpectrumDataset):
                return cls(
                    one.transmitter,
                    one.frequency_hz,
                    one.shape,
                    one.floor,
                    one.range_db,
                    one.beam_sigma_rad,
                    one.air,
                )
        first = data[0]
        if isinstance(first, SpectrumDataset):
            raise TypeError(f"ds: got {type(first).__name__}, expected Readings or ArraySpectra")
        floor = float(np.min(first.floor))
        levels = 10.0 * float(np.log10(floor)), 10.0 * float(np.log10(np.nanmax(first.power)))
        return cls(
            first.transmitters[0],
            first.frequency_hz,
            READINGS_SHAPE,
            floor,
            levels,
            BEAM_SIGMA_RAD,
            first.air,
        )
