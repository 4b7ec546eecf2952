"""What a field gives at every place of a lattice in the air, once for all that is searched there later.

Each place holds all power that arrives, by direction and by length, between isotropic antennas: whatever a receiver weighs
directions or delays by is linear in one of the two. It is rough: few rays, single mirrors, no beam.
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
from warprrf.rf.fields.base import Measured
from warprrf.rf.fields.batches import Batch
from warprrf.rf.positions import Ends, is_free
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings, path_weights
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_of
from warprrf.rf.tracing.render import path_gains

SHAPE = (30, 60)
"""Rows and columns of the directions that are told apart, a ray for each."""
SPACING_M = 0.5
"""Of the lattice, along each axis. Smoothed by a beam of some degrees, spectra half as far apart are alike."""
PIXELS = SHAPE[0] * SHAPE[1]
BLUR_RAD = np.radians(7.0)
"""Of the beam through which spectra are compared: sharp peaks become wide valleys. Half the spacing at 3 m is 5 degrees."""
TURNS = 120  # azimuths' zeros that are tried
MOST_DIRECTIONS = 400  # of an array's spectrum
CLEARANCE_M = 0.1  # of its places from surfaces
VARIABLES = {"image": Variable(("receiver", "zenith", "azimuth"), "1")}


@dataclass(frozen=True, eq=False)
class FieldMap:
    """Of one transmitter.

    Attributes:
        places: in the air [m], shape ``(P, 3)``.
        image: path gain by direction of arrival, shape ``(P, H, W)`` float32.
    """

    places: np.ndarray
    image: np.ndarray
    _read: Cache = field(init=False, repr=False, default_factory=lambda: Cache(4))

    def decibels(self, key: Hashable, read: Callable[[], np.ndarray]) -> np.ndarray:
        """What ``read`` makes of the map, readings at every place ``(P, N)``, in decibels, float32; kept by ``key``."""

        def made() -> np.ndarray:
            power = read()
            least = 1e-12 * max(float(power.max(initial=0.0)), 1e-300)
            return np.asarray(10.0 * np.log10(np.maximum(power, least)), np.float32)

        return self._read.get(key, made)

    def weighed(self, weights: np.ndarray) -> np.ndarray:
        """Readings at every place [dB], shape ``(P, N)``, of which ``weights`` (N, H W) say what each takes of ``image``."""
        power = self.image.reshape(len(self.places), -1)
        return self.decibels(weights.tobytes(), lambda: power @ weights.T.astype(np.float32))


def maps_of(
    bistatic: Any,
    transmitters: Sequence[np.ndarray],
    store: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> dict[bytes, FieldMap]:
    """Maps of a :class:`BistaticField` by transmitter; ``store`` and ``progress`` as for :meth:`RadioField.spectra`."""
    places = lattice(bistatic.mesh, bistatic.transmitter, bistatic.device)
    every = np.tile(places, (len(transmitters), 1)), np.repeat(transmitters, len(places), axis=0)
    batch = Batch("map", Ends.of(*every), store, None, progress)
    found = batch.gather(partial(_mapped, bistatic), VARIABLES, {}, bistatic._known_by(batch, SHAPE))
    parts = [
        np.asarray(found[name]).reshape(len(transmitters), len(places), *found[name].shape[1:])
        for name in VARIABLES
    ]
    return {
        source.tobytes(): FieldMap(places, *own) for source, *own in zip(transmitters, *parts, strict=True)
    }


def lattice(mesh: Mesh, transmitter: np.ndarray, device: Any, spacing_m: float = SPACING_M) -> np.ndarray:
    """Places in the air of ``transmitter`` (3,), ``spacing_m`` apart [m], shape ``(P, 3)``."""
    low, high = mesh.bounds
    axes = [np.arange(a + 0.5 * spacing_m, b, spacing_m) for a, b in zip(low, high, strict=True)]
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    far = np.linalg.norm(every - transmitter, axis=1) > CLEARANCE_M
    return every[far][is_free(mesh, every[far], transmitter, clearance_m=CLEARANCE_M, device=device)]


def _mapped(bistatic: Any, part: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Path gain by direction at receivers (K, 3) under a transmitter (3,)."""
    receivers, transmitter = part
    tracer, count = bistatic.tracer(transmitter), len(receivers)
    model = bistatic.state
    model = replace(model, effects=replace(model.effects, mirrors=min(model.effects.mirrors, 1)))
    view = tracer.on_grid(SHAPE, 1).view(receivers, model.effects, keeps=False)
    gains = path_gains(view, model, bistatic.materials_of(tracer))
    paths, rays = view.paths, gains.by_ray()
    pixel = np.ravel_multi_index((paths.receiver, *pixel_of(paths.arrival, SHAPE)), (count, *SHAPE))
    image = rays + np.bincount(pixel, gains.specular, len(rays))
    return {"image": image.reshape(count, *SHAPE).astype(np.float32)}


def best_on_map(
    one: Measured, maps: dict[bytes, FieldMap], chains: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How well the places of a lattice suit a data set: mean absolute error [dB] ``(P,)`` under the turn and the gains of chains
    that suit each best, that turn ``(P,)`` [rad] and these ``(P, C)`` [dB]."""
    read: Callable[..., Rough] = (
        _spectrum if isinstance(one, SpectrumDataset) else _array if isinstance(one, ArraySpectra) else _table
    )
    power, floor, chain, parts, columns, turns = read(one, maps, chains)
    floor_db, places = 10.0 * np.log10(floor), len(parts[0][1])
    db = np.maximum(10.0 * np.log10(np.maximum(power, 1e-300)), floor_db)
    known, heard = np.full(len(db), -1) if chain is None else chain, db > floor_db
    least, turn, gains = np.full(places, np.inf), np.zeros(places), np.zeros((places, len(chains) + 1))
    for by, own in zip(turns, columns, strict=True):
        found, gain = np.empty((places, len(db)), np.float32), np.zeros_like(gains)
        for rows, table in parts:
            found[:, rows] = table[:, own[rows]]
        for c in np.unique(known[heard & (known >= 0)]):
            gain[:, c] = (db - found)[:, (known == c) & heard].mean(axis=1)
            found[:, known == c] += gain[:, c, None]
        error = np.abs(np.maximum(found, floor_db) - db).mean(axis=1)
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
    gain, m, blur = (
        one.path_gain[0].astype(float).ravel(),
        maps[one.transmitter.tobytes()],
        beam_operator(SHAPE, BLUR_RAD),
    )
    power, measured = (
        blur(np.bincount(own, value, PIXELS).reshape(SHAPE)).ravel()
        for value in (np.nan_to_num(gain), np.isfinite(gain) * 1.0)
    )
    smaller = len(gain) / PIXELS
    kept = np.flatnonzero(measured > 0.9 * smaller)  # elsewhere nothing was measured
    table = m.decibels("blurred", lambda: blur(np.moveaxis(m.image, 0, -1)).reshape(PIXELS, -1).T)
    return (
        power[kept],
        np.full(len(kept), one.floor * smaller),
        None,
        [(np.arange(len(kept)), table)],
        kept[None],
        np.zeros(1),
    )


def _array(one: ArraySpectra, maps: dict[bytes, FieldMap], chains: Sequence[str]) -> Rough:
    """An array's beams hear powers: how paths' phases add up is left to the exact search."""
    toward, pixels = one.directions.reshape(-1, 3), pixel_directions(SHAPE).reshape(-1, 3)
    kept = np.flatnonzero(np.isfinite(one.power[0].ravel()))
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_DIRECTIONS)).astype(int))]
    heard = (
        one.array.response(toward[kept], 1.0).conj() @ one.array.response(pixels, 1.0).T / one.array.elements
    )
    table = maps[one.transmitters[0].tobytes()].weighed(np.abs(heard) ** 2 * one.array.gain(pixels))
    every, chain = np.arange(len(kept)), np.full(len(kept), len(chains)) if one.relative else None
    return (
        one.power[0].ravel()[kept],
        np.full(len(kept), one.floor),
        chain,
        [(every, table)],
        every[None],
        np.zeros(1),
    )


def _table(one: Readings, maps: dict[bytes, FieldMap], chains: Sequence[str]) -> Rough:
    one = one.subset(np.isfinite(one.power))
    index = {name: c for c, name in enumerate(chains)}
    chain = np.array([index.get(str(name), -1) for name in np.asarray(one.chain)])
    toward, ask = pixel_directions(SHAPE).reshape(-1, 3), dict[str, Any]()
    turns: np.ndarray = np.zeros(1)
    columns = np.zeros((1, len(one)), int)
    if one.arrival is not None and one.azimuth_known:
        ask["arrival"], columns = np.unique(one.arrival, axis=0, return_inverse=True)
        columns = columns.reshape(1, -1)
    elif one.arrival is not None:
        turns = 2.0 * np.pi / TURNS * np.arange(TURNS)
        zenith, row = np.unique(one.arrival[:, 0], return_inverse=True)
        turn = np.round(one.arrival[:, 1] / turns[1]).astype(int)
        columns = TURNS * row.reshape(-1) + (turn + np.arange(TURNS)[:, None]) % TURNS
        ask["arrival"] = np.column_stack([np.repeat(zenith, TURNS), np.tile(turns, len(zenith))])
    count = int(columns.max()) + 1
    ask |= {
        "transmitters": one.transmitters[0],
        "receivers": one.receivers[0],
        "power": np.ones(count),
        "floor": 0.5,
    }
    asked = replace(one, **ask, chain=None, std_db=0.0, azimuth_known=True)
    weights, parts = path_weights(asked, np.arange(count), toward, toward, np.zeros(PIXELS)), []
    for source in np.unique(one.transmitters, axis=0):
        rows = np.flatnonzero((one.transmitters == source).all(axis=1))
        parts.append((rows, maps[source.tobytes()].weighed(weights)))
    return one.power, np.asarray(one.floor), chain, parts, columns, turns
