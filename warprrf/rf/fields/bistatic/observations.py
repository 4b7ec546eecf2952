"""What a fit learns from: data sets of any kind, taken apart into places, one receiver under one transmitter each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.fit import NEPER, Target
from warprrf.rf.fields.bistatic.measured import Measurement, SpectrumPixels, WeighedPaths
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.open_air import warn_of_unmodelled
from warprrf.rf.positions import check_dataset, check_positions, question_unit
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Data, Readings, path_weights
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, to_db

READINGS_SHAPE = (60, 120)
"""Rows and columns of the rays around a receiver of whom no spectrum is known, and of its field's spectra."""
READING_ERROR_DB = 1.0
"""Standard deviation of what a field cannot explain of a reading without noise [dB]."""
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


def as_list(data: Data) -> list[SpectrumDataset | Readings]:
    """Data sets as a list.

    Raises:
        TypeError: for anything else.
        ValueError: for none, or different carriers.
    """
    several: list[SpectrumDataset | Readings] = []
    for one in data if isinstance(data, list | tuple) else [data]:
        if not isinstance(one, SpectrumDataset | Readings):
            raise TypeError(
                f"ds: got {type(one).__name__}, expected a SpectrumDataset, Readings, or a list of them"
            )
        several.append(one)
    if not several:
        raise ValueError("ds: got an empty list, expected a SpectrumDataset, Readings, or several of them")
    carriers = sorted({float(one.frequency_hz) for one in several})
    if len(carriers) > 1:
        raise ValueError(
            f"ds: got carriers of {', '.join(f'{f / 1e9:g}' for f in carriers)} GHz, expected one: fit a field for each"
        )
    return several


def transmitters_of(one: SpectrumDataset | Readings) -> np.ndarray:
    """Position of the transmitter of each of its receivers [m], shape ``(R, 3)``."""
    if isinstance(one, Readings):
        return one.transmitters
    return np.broadcast_to(one.transmitter, one.receivers.shape)


def places_of(
    data: Sequence[SpectrumDataset | Readings], mesh: Mesh | None, device: DeviceLike
) -> list[Place]:
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
        names, chain = np.unique(np.asarray(one.chain), return_inverse=True)
        key = np.column_stack([one.transmitters, one.receivers, chain])
        first, own = np.unique(key, axis=0, return_index=True, return_inverse=True)[1:]
        for number in np.argsort(first):
            rows = np.flatnonzero((own.reshape(-1) == number) & np.isfinite(one.power))
            if len(rows):
                at = int(first[number])
                found.append(
                    Place(
                        k, rows, one.transmitters[at], one.receivers[at], one.frequency_hz, READINGS_SHAPE, None,
                        one.air, str(names[chain[at]]),
                    )
                )  # fmt: skip
        _check_readings(mesh, one, device)
    return found


def _check_readings(mesh: Mesh | None, one: Readings, device: DeviceLike) -> None:
    wavelength_m = SPEED_OF_LIGHT / one.frequency_hz
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
        chain: index of the measuring chain whose gain is unknown, -1 where it is known.
    """

    place: Place
    measured: Measurement = field(repr=False)
    target: Target = field(repr=False)
    floor: float
    chain: int


def observe(
    data: Sequence[SpectrumDataset | Readings],
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
        rows, floors = place.rows, np.asarray(one.floor)[place.rows]
        floor = float(floors.min())
        expected = one.expected_db[rows] - 10.0 * np.log10(floor)
        above = NEPER * np.log1p(10.0 ** (expected / 10.0))
        step = None if one.bandwidth_hz is None else 1.0 / (TAP_STEPS * one.bandwidth_hz)
        measured = WeighedPaths.of(
            view, partial(path_weights, one, rows), departure=one.departure is not None, delay_step_s=step
        )
        trust = noise_db / np.hypot(READING_ERROR_DB, one.noise_db[rows])
        target = Target(above, trust, one.power[rows] <= floors)
        found.append(Observed(place, measured, target, floor, index.get(place.chain, -1)))
    return found, chains


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
    def of(cls, data: Sequence[SpectrumDataset | Readings]) -> Frame:
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
        if not isinstance(first, Readings):
            raise TypeError(f"ds: got {type(first).__name__}, expected a SpectrumDataset or Readings")
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
