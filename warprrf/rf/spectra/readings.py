"""Received powers as sounders deliver them: horns that turn, power alone, profiles of delay, of any transmitter.

A reading is linear in the powers of the paths between a transmitter and a receiver: each counts with the gain of the
antennas where it arrives and departs, and with what a window of delays lets through of it. All readings are one table,
one row each; what a column is missing does not weigh.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import digamma, polygamma

from warprrf.checks import (
    Count,
    Positive,
    check_array,
    check_chosen,
    check_each,
    checked,
    one_of,
    some_of,
    warn,
    within,
)
from warprrf.files import file_at
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import NEPER, Hertz
from warprrf.rf.spectra.antenna import Antenna, Pattern, as_antenna, main_lobe, turned_gain
from warprrf.rf.spectra.levels import MARGIN_DB, free_space_gain, question_levels

COLUMNS = {
    "transmitter": ("tx_x", "tx_y", "tx_z"),
    "receiver": ("rx_x", "rx_y", "rx_z"),
    "arrival": ("azimuth_deg", "elevation_deg"),
    "departure": ("tx_azimuth_deg", "tx_elevation_deg"),
}
"""Columns of a table of readings; beside them ``power_db``, ``delay_ns``, ``std_db`` and ``chain``."""
NEEDED = (*COLUMNS["transmitter"], *COLUMNS["receiver"], "power_db")
NUMBERS = (*NEEDED, *COLUMNS["arrival"], *COLUMNS["departure"], "delay_ns", "std_db")
NOT_MEASURED = ("", "na", "n/a", "#n/a", "<na>", "nan", "null", "none")
"""What stands in a file, in small letters, for a power that was not measured."""


@runtime_checkable
class Table(Protocol):
    """Columns by name: a dictionary of arrays, a pandas data frame, an xarray data set."""

    def __iter__(self) -> Iterator[Any]: ...

    def __getitem__(self, name: str, /) -> Any: ...


@checked
@dataclass(frozen=True, repr=False)
class PowerTable:
    """Received over transmitted powers, row by row, and the places that they are of: what :class:`Readings` and
    :class:`~warprrf.rf.channel.array_spectra.ArraySpectra` share."""

    transmitters: np.ndarray
    receivers: np.ndarray
    power: np.ndarray
    frequency_hz: Hertz

    _rows: ClassVar[tuple[str, ...]] = ("transmitters", "receivers", "power")

    def __len__(self) -> int:
        return len(self.power)

    def subset(self, rows: ArrayLike) -> Self:
        """Some of the rows, by index or mask."""
        index = check_chosen("rows", rows, len(self), 1)
        columns = {name: getattr(self, name) for name in self._rows}
        taken: dict[str, Any] = {name: value[index] for name, value in columns.items() if value is not None}
        return replace(self, **taken)

    def _checked(self, *shape: int) -> dict[str, Any]:
        """The columns, each row's powers of ``shape``; ValueError or TypeError names them."""
        power = check_array("power", self.power, (None, *shape), finite=False)
        count = len(power)
        if count == 0 or not (np.isnan(power) | (np.isfinite(power) & (power >= 0))).all():
            raise ValueError(
                f"power: got {count} rows, expected one or more, each of linear powers, or NaN where not measured"
            )
        ends = {name: check_each(name, getattr(self, name), count, 3) for name in self._rows[:2]}
        return {"power": power} | ends


@checked
@dataclass(frozen=True)
class Readings(PowerTable):
    """N received powers over transmitted power.

    Attributes:
        transmitters: positions [m], shape ``(N, 3)``, or ``(3,)`` for one.
        receivers: positions [m], shape ``(N, 3)``, or ``(3,)``.
        power: received over transmitted power [linear], shape ``(N,)``; NaN where nothing was measured.
        frequency_hz: carrier [Hz].
        floor: noise floor [linear], one number or shape ``(N,)``: readings not above it only say that there was no more.
        arrival: zenith and azimuth [rad] that the receiving antenna is turned to, shape ``(N, 2)``; None for an isotropic
            one.
        departure: those of the transmitting antenna.
        receive_pattern, transmit_pattern: those antennas, of one port: an :class:`Antenna`, such as a :func:`horn`, or its gain
            [linear] over the angle off boresight: a function of angles [rad], or samples from 0 to pi. It is turned by yaw and
            pitch; what else it is turned by on its mount is its own :attr:`Antenna.orientation`. Powers hold both polarisations, so
            only its gain counts.
        delay_s: delay of the tap that a reading is [s], shape ``(N,)``; None where all delays are received together.
        bandwidth_hz: of the sounder, for taps.
        window: of its frequency response: ``"rectangular"`` or ``"hann"``.
        chain: name of the measuring chain of each reading whose gain is not known, "" where it is known, shape ``(N,)``.
        std_db: standard deviation of the noise of each reading [dB], shape ``(N,)`` or one number.
        samples: independent samples of fading that each reading is the mean of: 1 for narrowband power at one place,
            None where fading is averaged out. A fit knows how far line of sight and mirrors fade less; see :func:`fading_db`.
        air: whose absorption is in the powers; None for none.
        name: by which a report tells these readings from others; several of one name are numbered in the order given.
        azimuth_known: False where azimuths of ``arrival`` count from an unknown zero, one for all: a fit then finds it
            from line of sight and mirrors. Give readings whose zeros differ as several data sets.
        clock_known: False where ``delay_s`` counts from an unknown zero, one for all, found likewise; one of the two zeros
            has to be known.
        position_std_m: standard deviation of each coordinate of the receivers [m]; above 0 a fit finds where they stood.

    Raises:
        TypeError, ValueError: naming the argument.

    Example::

        horn = wr.Readings.load("horn.csv", frequency_hz=300e9, floor=1e-12, receive_pattern=wr.horn(np.radians(10)))
        field = wr.RadioField.fit(rec, horn)
    """

    floor: ArrayLike
    arrival: np.ndarray | None = None
    departure: np.ndarray | None = None
    receive_pattern: Pattern | None = None
    transmit_pattern: Pattern | None = None
    delay_s: np.ndarray | None = None
    bandwidth_hz: Positive | None = None
    window: Annotated[str, one_of("rectangular", "hann")] = "rectangular"
    chain: Sequence[str] | NDArray[np.str_] | None = None
    std_db: ArrayLike = 0.0
    samples: Count | None = None
    air: Air | None = None
    name: str = "readings"
    azimuth_known: bool = True
    clock_known: bool = True
    position_std_m: Annotated[float, within(0.0, 1.0)] = 0.0

    _rows = (*PowerTable._rows, "floor", "arrival", "departure", "delay_s", "chain", "std_db")

    def __post_init__(self) -> None:
        fields = self._checked()
        count = len(fields["power"])
        floor, std = (check_each(name, getattr(self, name), count) for name in ("floor", "std_db"))
        if not (floor > 0).all():
            raise ValueError(f"floor: got {floor.min():g}, expected linear noise floors above 0")
        if not (fields["power"] > floor).any():
            raise ValueError(f"power: got no value above the floor of {floor.min():g}")
        fields |= {"floor": floor, "std_db": std}
        ends = ("arrival", "receive_pattern"), ("departure", "transmit_pattern")
        for one, other in (*ends, ("delay_s", "bandwidth_hz")):
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise ValueError(f"{other}: got one of it and {one}; expected both or neither")
        for turned, pattern in ends:
            if getattr(self, turned) is not None:
                fields[turned] = check_turned(turned, getattr(self, turned), count)
                fields[pattern] = antenna_of(pattern, getattr(self, pattern))
        if self.delay_s is not None:
            fields["delay_s"] = check_array("delay_s", self.delay_s, (count,))
        for known, of in (("azimuth_known", "arrival"), ("clock_known", "delay_s")):
            if not getattr(self, known) and getattr(self, of) is None:
                raise ValueError(f"{known}: got False without {of}, whose zero is to be found")
        if not self.clock_known and not self.azimuth_known:
            raise ValueError("clock_known: got False, and azimuth_known too; expected one zero known")
        if self.position_std_m > 0 and self.total:
            raise ValueError(
                "position_std_m: got readings of power alone, which say nothing of where they were taken; expected "
                "directions or delays"
            )
        chain = np.full(count, "") if self.chain is None else np.asarray(self.chain, dtype=object)
        if chain.shape != (count,) or not all(isinstance(name, str) for name in chain):
            raise ValueError(f"chain: got {self.chain!r:.200}, expected a name for each of {count} readings")
        if (std < 0).any():
            raise ValueError(f"std_db: got {std.min():g}, expected numbers of at least 0")
        fields["chain"] = chain.astype(str)
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        places = len(np.unique(self.receivers, axis=0))
        return (
            f"Readings({len(self)} of {places} receivers and {len(np.unique(self.transmitters, axis=0))} transmitters at "
            f"{self.frequency_hz / 1e9:g} GHz, {int((self.power <= self.floor).sum())} at the floor)"
        )

    @property
    def total(self) -> bool:
        """Whether each holds all power of its place: no directions, no delays."""
        return self.arrival is None and self.departure is None and self.delay_s is None

    @property
    def zero_known(self) -> bool:
        """Whether azimuths and delays count from known zeros."""
        return self.azimuth_known and self.clock_known

    def without_side_lobes(self) -> Readings:
        """The same of antennas with nothing but their main lobes; see :func:`main_lobe`."""
        names = [n for n in ("receive_pattern", "transmit_pattern") if getattr(self, n) is not None]
        cut: dict[str, Any] = {name: main_lobe(as_antenna(getattr(self, name))) for name in names}
        return replace(self, **cut)

    @classmethod
    def from_table(cls, table: Table, **settings: Any) -> Readings:
        """Readings of a table by the names of its columns: a pandas data frame, an xarray data set, a dictionary.

        Args:
            table: :data:`COLUMNS` as far as they count, and ``power_db`` [dB], received over transmitted power; by choice
                ``delay_ns``, ``std_db`` and ``chain``. Azimuth counts from x to y, elevation from the horizon up.
            settings: other arguments of :class:`Readings`.

        Raises:
            ValueError: naming columns that are missing, misspelt or repeated, or calibrated readings of as much as was
                transmitted.

        Warns:
            UserWarning: naming columns that are none of these, or readings far above line of sight.
        """
        names = list(map(str, table))
        _check_columns(names)
        count = np.size(table["power_db"])

        def column(name: str) -> np.ndarray:
            values = np.asarray(table[name])
            return check_array(f"table[{name!r}]", values, (count,), finite=name != "power_db")

        found: dict[str, Any] = {
            "transmitters": np.column_stack([column(c) for c in COLUMNS["transmitter"]]),
            "receivers": np.column_stack([column(c) for c in COLUMNS["receiver"]]),
            "power": 10.0 ** (column("power_db") / 10.0),
        }
        for end in ("arrival", "departure"):
            azimuth, elevation = COLUMNS[end]
            if azimuth in names:
                up = column(elevation) if elevation in names else np.zeros(len(found["power"]))
                found[end] = np.radians(np.column_stack([90.0 - up, column(azimuth)]))
        if "delay_ns" in names:
            found["delay_s"] = 1e-9 * column("delay_ns")
        if "std_db" in names:
            found["std_db"] = column("std_db")
        if "chain" in names:
            cells = np.ravel(np.asarray(table["chain"], dtype=object))
            none = [str(c) in ("None", "nan", "<NA>") for c in cells]  # as pandas has it
            found["chain"] = np.where(none, "", cells.astype(str))
        readings = cls(**found, **settings)
        question_readings(readings)
        return readings

    @classmethod
    def load(cls, path: str | os.PathLike[str], **settings: Any) -> Readings:
        """Readings of a CSV file with a header line; see :meth:`from_table`.

        Values are separated by commas; spaces round them and empty lines do not count. ``power_db`` is left empty, or
        ``nan``, where nothing was measured, ``chain`` where powers are calibrated.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, the line and the column, if it is no such table.

        Warns:
            UserWarning: as :meth:`from_table`.
        """
        file = file_at(path)
        try:
            return cls.from_table(_read_csv(file), **settings)
        except (TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"path: {file}: {error}") from error


def _check_columns(names: Sequence[str]) -> None:
    """Refuse names of columns that are missing, repeated or misspelt; warn of others that are not read."""
    _check_once(names)
    known, unknown = (*NUMBERS, "chain"), [name for name in names if name not in (*NUMBERS, "chain")]
    alike = {name: get_close_matches(name.lower(), known, 2, 0.7) for name in unknown}
    meant = [
        f"{name!r} for {' or '.join(absent)}"
        for name, near in alike.items()
        if (absent := [other for other in near if other not in names]) and near[0] in absent
    ]
    missing = [name for name in NEEDED if name not in names]
    if missing or meant:
        lacking = f"lacks the columns {', '.join(missing)}; it has {', '.join(names)}" * bool(missing)
        misspelt = f"seems to have {', '.join(meant)}; correct the header" * bool(meant)
        raise ValueError(f"table: {'; it '.join(filter(None, (lacking, misspelt)))}")
    for azimuth, elevation in (COLUMNS["arrival"], COLUMNS["departure"]):
        if elevation in names and azimuth not in names:
            raise ValueError(f"table: got {elevation} without {azimuth}, expected both or neither")
    if unknown:
        warn(f"table: columns {', '.join(unknown)} are not read; those that are: {', '.join(known)}")


def question_readings(readings: Readings) -> None:
    """Question readings of too much power; see :func:`~warprrf.rf.spectra.levels.question_levels`.

    Of chains whose gain is not known only readings above what was transmitted can be found.
    """
    r, gain_db, known = readings, 0.0, readings.chain == ""
    for pattern in (r.receive_pattern, r.transmit_pattern):
        if pattern is not None:
            gain_db += 10.0 * np.log10(as_antenna(pattern).peak_gain)
    isotropic = free_space_gain(r.transmitters, r.receivers, r.frequency_hz)
    free_space = np.minimum(isotropic * 10.0 ** (gain_db / 10.0), 1.0)
    # a power at one place above the mean of its fading: 1 in 20,000, if Rayleigh's
    fading_db = 10.0 * (r.samples is not None)
    margin_db = MARGIN_DB + fading_db
    question_levels("power", np.where(known, r.power, np.nan), free_space, margin_db=margin_db)
    above = np.flatnonzero(~known & (r.power > 1.0))
    if len(above):
        warn(
            f"power: {len(above)} readings (rows {some_of(above)}) of chains of unknown gain are above 0 dB, more than was "
            "transmitted: were minus signs lost, or are they linear?"
        )


def _check_once(names: Sequence[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"table: got several columns {', '.join(twice)}, expected one of each name")


def _read_csv(file: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name: numbers, and text where they are not known."""
    with file.open(newline="", encoding="utf-8-sig") as text:
        rows = csv.reader(text, skipinitialspace=True, strict=True)
        header = [name.strip() or f"(column {k} without a name)" for k, name in enumerate(next(rows, []), 1)]
        if not header:
            raise ValueError("line 1: got nothing, expected names of columns")
        table, lines = [], []
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if len(cells) != len(header):
                raise ValueError(
                    f"line {rows.line_num}: got {len(cells)} values, expected {len(header)}, one for each column of the "
                    "header"
                )
            table.append(cells)
            lines.append(rows.line_num)
    _check_once(header)
    found = dict(zip(header, np.array(table, dtype=str).reshape(-1, len(header)).T, strict=True))
    for name in found.keys() & NUMBERS:
        found[name] = np.array([_number(name, *one) for one in zip(found[name].tolist(), lines, strict=True)])
    return found


def _number(name: str, cell: str, line: int) -> float:
    if name == "power_db" and cell.lower() in NOT_MEASURED:
        return np.nan
    try:
        number = float(cell)
    except ValueError:
        number = np.nan
    if np.isnan(number) or (np.isinf(number) and name != "power_db"):
        raise ValueError(f"line {line}: {name}: got {cell!r}, expected a finite number")
    return number


def fading_db(samples: int | None, steady: ArrayLike = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of what fading adds to a reading's decibels [dB], each of the shape of ``steady``.

    Power is taken for gamma distributed with the shape m that has its variance (Nakagami 1960): that of waves of
    independent phases is 1 - sum s_i^2 of its mean's square, s_i the share of each. One wave of K-factor K over many weak
    ones has m = (K + 1)^2 / (2 K + 1), and a mean that is at most 0.26 dB off that of a Rician power; Rayleigh fading is m = 1.

    Args:
        samples: independent ones that a reading is the mean of; None where fading is averaged out.
        steady: sum of the squared shares of single waves, 0 to 1.
    """
    steadiest = 1e-6  # relative variance of the power of a single wave
    left = np.maximum(1.0 - np.asarray(steady, float), steadiest)
    if samples is None:
        return np.zeros_like(left), np.zeros_like(left)
    shape = samples / left
    return NEPER * (digamma(shape) - np.log(shape)), NEPER * np.sqrt(polygamma(1, shape))


def path_weights(
    readings: Readings,
    rows: np.ndarray,
    arrival: np.ndarray,
    departure: np.ndarray,
    delay_s: np.ndarray,
    *,
    dtype: type[np.floating] = np.float64,
) -> np.ndarray:
    """What ``rows`` (M,) of ``readings`` take of unit power on paths, shape ``(M, K)``, in ``dtype``.

    Args:
        arrival: unit vectors from the receiver, shape ``(K, 3)``.
        departure: unit vectors from the transmitter, shape ``(K, 3)``.
        delay_s: delays [s], shape ``(K,)``.
    """
    r, weight = readings, np.empty((len(rows), len(delay_s)), dtype)
    ends = (r.arrival, r.receive_pattern, arrival), (r.departure, r.transmit_pattern, departure)
    weights_at_once = 1_000_000  # of readings and paths: some MB of temporary arrays
    at_once = max(1, weights_at_once // max(1, len(delay_s)))
    for first in range(0, len(rows), at_once):
        some = rows[first : first + at_once]
        own = np.ones((len(some), len(delay_s)))
        for turned, pattern, path in ends:
            if turned is not None and pattern is not None:
                once, which = np.unique(turned[some], axis=0, return_inverse=True)
                own *= turned_gain(as_antenna(pattern), once, path)[which.reshape(-1)]
        if r.delay_s is not None and r.bandwidth_hz is not None:
            own *= tap_share(r.bandwidth_hz * (r.delay_s[some, None] - delay_s), r.window)
        weight[first : first + at_once] = own
    return weight


def check_turned(name: str, value: ArrayLike, count: int) -> np.ndarray:
    """Zeniths and azimuths (count, 2) [rad] that antennas are turned to."""
    angles = check_array(name, value, (count, 2))
    wrong = angles[np.abs(angles[:, 0] - np.pi / 2) > np.pi / 2 + 1e-6, 0]
    if len(wrong):
        raise ValueError(f"{name}: got a zenith of {wrong[0]:g}, expected 0 to pi (elevations: -90 to 90)")
    return angles


def antenna_of(name: str, pattern: Pattern) -> Antenna:
    """The antenna that readings are taken with; ValueError or TypeError names the argument if it is none, or of several ports."""
    found = as_antenna(pattern, name=name)
    if found.ports > 1:
        raise ValueError(
            f"{name}: got an antenna of {found.ports} ports, expected one of a single port (Antenna.unpolarised())"
        )
    return found


def tap_share(place: np.ndarray, window: str) -> np.ndarray:
    """Share of a path's power in a tap ``place`` (in units of 1 / bandwidth) from it; over all taps they add up to 1."""
    if window == "rectangular":
        return np.sinc(place) ** 2
    return (np.sinc(place) + 0.5 * (np.sinc(place - 1.0) + np.sinc(place + 1.0))) ** 2 / 1.5
