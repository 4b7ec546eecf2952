"""What a field gives at every place of a lattice in the air, once for all that is searched there later.

Each place holds all power that arrives between isotropic antennas by direction, and how long the strongest path in each is:
from both follows where that left. It is rough: few rays, single mirrors, no beam.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warprrf.cache import Cache
from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.netcdf_files import Variable
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import Measured
from warprrf.rf.fields.batches import Batch
from warprrf.rf.positions import Ends, is_free
from warprrf.rf.spectra.antenna import as_antenna, turned_gain
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings, path_weights, tap_share
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_of, sub_pixel_directions
from warprrf.rf.tracing.render import path_gains
from warprrf.rows import distinct_rows

SHAPE = (30, 60)
"""Rows and columns of the directions that are told apart, a ray for each."""
SPACING_M = 0.5
"""Of the lattice, along each axis. Smoothed by a beam of some degrees, spectra half as far apart are alike."""
PIXELS = SHAPE[0] * SHAPE[1]
BLUR_RAD = np.radians(7.0)
"""Of the beam through which spectra are compared: sharp peaks become wide valleys. Half the spacing at 3 m is 5 degrees."""
VARIABLES = {
    "image": Variable(("receiver", "zenith", "azimuth"), "1"),
    "length": Variable(("receiver", "zenith", "azimuth"), "m"),
}


@dataclass(frozen=True, eq=False)
class FieldMap:
    """Of one transmitter.

    Attributes:
        places: in the air [m], shape ``(P, 3)``.
        image: path gain by direction of arrival, shape ``(P, H, W)`` float32.
        length: of the strongest path from there [m], 0 for none, shape ``(P, H, W)`` float32.
    """

    places: np.ndarray
    image: np.ndarray
    length: np.ndarray
    _read: Cache = field(init=False, repr=False, default_factory=lambda: Cache(4))

    def decibels(self, key: Hashable, read: Callable[[], np.ndarray]) -> np.ndarray:
        """What ``read`` makes of the map, readings at every place ``(P, N)``, in decibels, float32; kept by ``key``."""
        return self._read.get(key, lambda: _decibels(read()))

    def weighed(self, weights: np.ndarray) -> np.ndarray:
        """Readings at every place [dB], shape ``(P, N)``, of which ``weights`` (N, H W) say what each takes of ``image``."""
        power = self.image.reshape(len(self.places), -1)
        return self.decibels(weights.tobytes(), lambda: power @ weights.T.astype(np.float32))

    @property
    def strongest(self) -> np.ndarray:
        """Length of each place's strongest path [m], shape ``(P,)``."""
        count = len(self.places)
        best = self.image.reshape(count, -1).argmax(axis=1)
        return np.asarray(self.length.reshape(count, -1)[np.arange(count), best])

    def departures(self, transmitter: np.ndarray) -> np.ndarray:
        """Unit vectors from ``transmitter`` (3,) in which paths left if they met one surface at most, shape ``(P, H W, 3)``."""
        toward, out = sub_pixel_directions(SHAPE, 1)[0], self.places - transmitter
        length = self.length.reshape(len(out), -1)
        # |out + r toward| = length - r, r the distance to where the surface was met.
        more = np.maximum(length**2 - (out**2).sum(axis=1)[:, None], 0.0)
        met = out[:, None] + (more / np.maximum(2.0 * (length + out @ toward.T), 1e-9))[..., None] * toward
        return np.asarray(met / np.maximum(np.linalg.norm(met, axis=2, keepdims=True), 1e-9))


def _decibels(power: np.ndarray) -> np.ndarray:
    least = 1e-12 * max(float(power.max(initial=0.0)), 1e-300)
    return np.asarray(10.0 * np.log10(np.maximum(power, least)), np.float32)


def maps_of(
    bistatic: Any,
    transmitters: Sequence[np.ndarray],
    store: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> dict[bytes, FieldMap]:
    """Maps of a :class:`BistaticField` by transmitter; ``store`` and ``progress`` as for :meth:`RadioField.spectra`."""
    places = lattice(bistatic.mesh, bistatic.transmitter, np.stack(transmitters), bistatic.device)
    every = np.tile(places, (len(transmitters), 1)), np.repeat(transmitters, len(places), axis=0)
    batch = Batch("map", Ends.of(*every), store, None, progress)
    known = bistatic._known_by(batch, SHAPE, list(VARIABLES))
    found = batch.gather(partial(_mapped, bistatic), VARIABLES, {}, known)
    shape = len(transmitters), len(places), *SHAPE
    parts = [np.asarray(found[name]).reshape(shape) for name in VARIABLES]
    return {
        source.tobytes(): FieldMap(places, *own) for source, *own in zip(transmitters, *parts, strict=True)
    }


def lattice(mesh: Mesh, known: np.ndarray, transmitters: np.ndarray, device: Any) -> np.ndarray:
    """Places in the air of ``known`` (3,), off surfaces and ``transmitters`` (T, 3), shape ``(P, 3)`` [m].

    Raises:
        ValueError: for a scene of more places than fit into memory, 14 kB each, or of none.
    """
    clearance_m, most = 0.1, 300_000
    low, high = mesh.bounds
    if (count := np.prod((high - low) / SPACING_M)) > most:
        raise ValueError(f"field: {count:.2g} places of its scene would be searched, expected at most {most}")
    axes = [np.arange(a + 0.5 * SPACING_M, b, SPACING_M) for a, b in zip(low, high, strict=True)]
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    far = (np.linalg.norm(every[:, None] - transmitters, axis=2) > clearance_m).all(axis=1)
    found = every[far][is_free(mesh, every[far], known, clearance_m=clearance_m, device=device)]
    if len(found) == 0:
        raise ValueError(
            f"field: none of the places {SPACING_M:g} m apart that would be searched is in the air"
        )
    return found


def _mapped(bistatic: Any, part: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Path gain and length by direction at receivers (K, 3) under a transmitter (3,)."""
    receivers, transmitter = part
    tracer, count = bistatic.tracer(transmitter), len(receivers)
    model = bistatic.state
    model = replace(model, effects=replace(model.effects, mirrors=min(model.effects.mirrors, 1)))
    view = tracer.on_grid(SHAPE, 1).view(receivers, model.effects, keeps=False)
    gains = path_gains(view, model)
    paths, rays = view.paths, gains.by_ray()
    pixel = np.ravel_multi_index((paths.receiver, *pixel_of(paths.arrival, SHAPE)), (count, *SHAPE))
    image = rays + np.bincount(pixel, gains.specular, len(rays))
    length, ray = np.zeros(len(rays)), np.flatnonzero(rays > 0)
    length[ray] = view.over_m(ray, gains.strongest_single[1][ray])
    stronger = np.flatnonzero(gains.specular > rays[pixel])
    stronger = stronger[np.argsort(gains.specular[stronger], kind="stable")]
    length[pixel[stronger]] = paths.delay_m[stronger]
    found = {"image": image, "length": length}
    return {name: own.reshape(count, *SHAPE).astype(np.float32) for name, own in found.items()}


def best_on_map(
    one: Measured, maps: dict[bytes, FieldMap], chains: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How well the places of a lattice suit a data set: mean absolute error [dB] ``(P,)`` under the turn and the gains of chains
    that suit each best, that turn ``(P,)`` [rad] and these ``(P, C)`` [dB]."""
    read: Callable[..., Rough] = (
        _spectrum if isinstance(one, SpectrumDataset) else _array if isinstance(one, ArraySpectra) else
        _table if one.departure is None and one.delay_s is None else _profiles
    )  # fmt: skip
    power, floor, chain, parts, columns, turns = read(one, maps, chains)
    floor_db, places = (10.0 * np.log10(floor)).astype(np.float32), len(parts[0][1])
    db = np.maximum(10.0 * np.log10(np.maximum(power, 1e-300)), floor_db).astype(np.float32)
    known, heard = np.full(len(db), -1) if chain is None else chain, db > floor_db
    least, turn, gains = np.full(places, np.inf), np.zeros(places), np.zeros((places, len(chains) + 1))
    for by, own in zip(turns, columns, strict=True):
        found, gain = np.empty((places, len(db)), np.float32), np.zeros_like(gains)
        for rows, table in parts:
            found[:, rows] = table[:, own[rows]]
        for c in np.unique(known[heard & (known >= 0)]):
            gain[:, c] = (db - found)[:, (known == c) & heard].mean(axis=1)
            found[:, known == c] += gain[:, c, None]
        np.maximum(found, floor_db, out=found)
        found -= db
        error = np.abs(found, out=found).mean(axis=1)
        better = error < least
        least[better], turn[better], gains[better] = error[better], by, gain[better]
    return least, turn, gains[:, : len(chains)]


Rough = tuple[
    np.ndarray, np.ndarray, np.ndarray | None, list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray
]
"""What was read as maps know it: powers and floors (N,); indices of unknown gains, -1 for none; for each transmitter which rows
are under it and what its map gives (P, M) [dB]; of those M the column of each reading, by turn (T, N); turns (T,) [rad]."""


def _spectrum(one: SpectrumDataset, maps: dict[bytes, FieldMap], *_: Any) -> Rough:
    own = np.ravel_multi_index(pixel_of(pixel_directions(one.shape), SHAPE), SHAPE).ravel()
    gain, m = one.path_gain[0].astype(float).ravel(), maps[one.transmitter.tobytes()]
    blur = beam_operator(SHAPE, BLUR_RAD)
    both = np.nan_to_num(gain), np.isfinite(gain) * 1.0
    power, measured = (blur(np.bincount(own, value, PIXELS).reshape(SHAPE)).ravel() for value in both)
    smaller = len(gain) / PIXELS
    kept = np.flatnonzero(measured > 0.9 * smaller)  # elsewhere nothing was measured
    table = m.decibels("blurred", lambda: blur(np.moveaxis(m.image, 0, -1)).reshape(PIXELS, -1).T)
    floor, parts = np.full(len(kept), one.floor * smaller), [(np.arange(len(kept)), table)]
    return power[kept], floor, None, parts, kept[None], np.zeros(1)


def _array(one: ArraySpectra, maps: dict[bytes, FieldMap], chains: Sequence[str]) -> Rough:
    """An array's beams hear powers: how paths' phases add up is left to the exact search."""
    toward, pixels = one.directions.reshape(-1, 3), pixel_directions(SHAPE).reshape(-1, 3)
    kept, most = np.flatnonzero(np.isfinite(one.power[0].ravel())), 400  # directions
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, min(len(kept), most)).astype(int))]
    steered, arriving = one.array.response(toward[kept], 1.0), one.array.response(pixels, 1.0)
    heard = steered.conj() @ arriving.T / one.array.elements
    table = maps[one.transmitters[0].tobytes()].weighed(np.abs(heard) ** 2 * one.array.gain(pixels))
    every, chain = np.arange(len(kept)), np.full(len(kept), len(chains)) if one.relative else None
    floor = np.full(len(kept), one.floor)
    return one.power[0].ravel()[kept], floor, chain, [(every, table)], every[None], np.zeros(1)


def _table(one: Readings, maps: dict[bytes, FieldMap], chains: Sequence[str]) -> Rough:
    one = one.subset(np.isfinite(one.power))
    chain = _chains_of(one, chains)
    toward, ask = pixel_directions(SHAPE).reshape(-1, 3), dict[str, Any]()
    turns: np.ndarray = np.zeros(1)
    columns = np.zeros((1, len(one)), int)
    if one.arrival is not None and one.azimuth_known:
        ask["arrival"], columns = np.unique(one.arrival, axis=0, return_inverse=True)
        columns = columns.reshape(1, -1)
    elif one.arrival is not None:
        count = 120  # zeros that are tried, 3 degrees apart: half the width of a pixel
        turns = 2.0 * np.pi / count * np.arange(count)
        zenith, row = np.unique(one.arrival[:, 0], return_inverse=True)
        turn = np.round(one.arrival[:, 1] / turns[1]).astype(int)
        columns = count * row.reshape(-1) + (turn + np.arange(count)[:, None]) % count
        ask["arrival"] = np.column_stack([np.repeat(zenith, count), np.tile(turns, len(zenith))])
    count = int(columns.max()) + 1
    ask |= {"transmitters": one.transmitters[0], "receivers": one.receivers[0], "power": np.ones(count)}
    asked = replace(one, **ask, floor=0.5, chain=None, std_db=0.0, azimuth_known=True)
    weights, parts = path_weights(asked, np.arange(count), toward, toward, np.zeros(PIXELS)), []
    for source in np.unique(one.transmitters, axis=0):
        rows = np.flatnonzero((one.transmitters == source).all(axis=1))
        parts.append((rows, maps[source.tobytes()].weighed(weights)))
    return one.power, np.asarray(one.floor), chain, parts, columns, turns


def coarse(one: Measured) -> Measured:
    """Profiles of delay as a sounder of 0.5 GHz reads them, half a tap of 60 cm apart, with a Hann window and 30 dB of range;
    anything else as it is.

    Taps of gigahertz are shorter than a lattice's spacing: a place's neighbours would be no more like it than any other.
    """
    coarse_hz, range_db = 0.5e9, 30.0
    if (
        not isinstance(one, Readings)
        or one.delay_s is None
        or float(one.bandwidth_hz or 0.0) < 2.0 * coarse_hz
    ):
        return one
    one = one.subset(np.isfinite(one.power))
    delay, wider = np.asarray(one.delay_s), float(one.bandwidth_hz or 0.0) / coarse_hz
    power, floor, kept = np.empty(len(one)), np.empty(len(one)), list[np.ndarray]()
    heard = np.where(one.power > one.floor, one.power, 0.0)  # floors would add up to what looks like power
    own = _pointing(one, np.unique(np.asarray(one.chain), return_inverse=True)[1].reshape(-1))
    for rows in (np.flatnonzero(own == k) for k in range(own.max() + 1)):
        near = tap_share(coarse_hz * (delay[rows, None] - delay[rows]), "hann")
        near *= wider / near.sum(axis=1, keepdims=True)
        power[rows], floor[rows] = near @ heard[rows], near @ np.asarray(one.floor)[rows]
        kept.append(rows[np.unique(np.round(2.0 * coarse_hz * delay[rows]), return_index=True)[1]])
    some = np.sort(np.concatenate(kept))
    least = np.maximum(floor, 10.0 ** (-range_db / 10.0) * power.max())[some]
    told: dict[str, Any] = {"power": np.maximum(power[some], least), "floor": least}
    return replace(one.subset(some), **told, bandwidth_hz=coarse_hz, window="hann")


def _pointing(one: Readings, *more: np.ndarray) -> np.ndarray:
    """Equal for readings of one transmitter and one turn of the antennas, shape ``(N,)``, from 0."""
    turned = [a for a in (one.transmitters, one.arrival, one.departure) if a is not None]
    return distinct_rows(np.column_stack([*turned, *more]))[1]


def _profiles(one: Readings, maps: dict[bytes, FieldMap], chains: Sequence[str]) -> Rough:
    """Readings by departure, or by delay, those of some of the pointings."""
    one = one.subset(np.isfinite(one.power))
    pointing, most = _pointing(one), 24  # each is a table of its own
    few = np.isin(pointing, np.linspace(0, pointing.max(), most).astype(int))
    one, pointing = one.subset(few), pointing[few]
    used = [maps[source.tobytes()] for source in np.unique(one.transmitters, axis=0)]
    toward, step = pixel_directions(SHAPE).reshape(-1, 3), 0.25 * SPACING_M
    taps = step * (np.arange(int(max(float(m.length.max()) for m in used) / step) + 1) + 0.5)
    turns: np.ndarray = np.zeros(1)
    columns, window = np.zeros((1, len(one)), int), None
    if one.delay_s is not None and one.bandwidth_hz is not None:
        per_m = one.bandwidth_hz / SPEED_OF_LIGHT
        window = tap_share(per_m * (taps - taps[:, None]), one.window).astype(np.float32)
        length = SPEED_OF_LIGHT * one.delay_s
        if not one.clock_known:  # the strongest tap is some place's strongest path
            latest = max(float(m.strongest.max()) for m in used)
            turns = np.arange(0.0, latest, 0.5 * SPACING_M) - length[one.power.argmax()]
        columns = np.clip((length + turns[:, None]) / step, 0, len(taps) - 1).astype(int)
    parts = []
    for rows in (np.flatnonzero(pointing == k) for k in np.unique(pointing)):
        source = one.transmitters[rows[0]]
        m = maps[source.tobytes()]
        count = len(m.places)
        power = m.image.reshape(count, -1)
        if one.arrival is not None and one.receive_pattern is not None:
            power = power * turned_gain(as_antenna(one.receive_pattern), one.arrival[rows[:1]], toward)
        if one.departure is not None and one.transmit_pattern is not None:
            out = m.departures(source).reshape(-1, 3)
            gain = turned_gain(as_antenna(one.transmit_pattern), one.departure[rows[:1]], out)
            power = power * gain.reshape(power.shape)
        table = power.sum(axis=1, keepdims=True)
        if window is not None:
            tap = (m.length.reshape(count, -1) / step).astype(int) + len(taps) * np.arange(count)[:, None]
            late = np.bincount(tap.ravel(), power.ravel(), len(taps) * count).reshape(count, -1)
            table = late.astype(np.float32) @ window
        parts.append((rows, _decibels(table)))
    return one.power, np.asarray(one.floor), _chains_of(one, chains), parts, columns, turns


def _chains_of(one: Readings, chains: Sequence[str]) -> np.ndarray:
    """Index of each reading's chain, -1 for one of known gain, shape ``(N,)``."""
    index = {name: c for c, name in enumerate(chains)}
    return np.array([index.get(str(name), -1) for name in np.asarray(one.chain)])
