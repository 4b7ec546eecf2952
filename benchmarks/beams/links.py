"""The true channels that beams are judged on: specular paths of the true scene, and its scattering with random phases.

A channel is that of a band of 2.16 GHz. Line of sight and mirrors come from the image method on the true scene with
its materials, every element at its own distance (spherical waves). Scattering is a set of plane waves, each with the
power and the delay of one ray and a phase drawn from a seed. For a data set of the exact engine they are the engine's
own diffuse rays and mirrors reflect once, as in its spectra. For one of Sionna RT mirrors reflect up to twice, and all
other power of the receiver's own spectrum is spread over 4 rays a pixel, which leave along the pixel's departure angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from warprrf.rf.channel.arrays import PlanarArray, orientation_towards
from warprrf.rf.channel.beams import Codebook, dft_codebook
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase
from warprrf.rf.exact import ExactEngine
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import (
    angles_from_directions,
    directions_from_angles,
    spread,
    sub_pixel_directions,
)

SUB_PIXELS = (
    3  # square root of the rays a pixel: 1 degree apart; beams of 64 x 64 elements are 1.8 degrees apart
)
NEGLIGIBLE = 3e-3  # the weakest rays are left out, up to this share of the scattered power
OVERSAMPLING = 2
"""Of the codebooks: neighbouring beams cross 0.9 dB down instead of 3.9 dB, so that a wrong neighbour costs little."""
BANDWIDTH_HZ = 2.16e9  # the narrowest channel of IEEE Std 802.15.3d
FREQUENCIES = 8  # over that band
_CHUNK = 1024


@dataclass(frozen=True, eq=False)
class Ends:
    """Two arrays between which beams are chosen.

    Attributes:
        name: of the row.
        swept: which end's size the row is about: "rx", "tx" or "both".
        tx, rx: the arrays.
    """

    name: str
    swept: str
    tx: PlanarArray
    rx: PlanarArray

    @cached_property
    def tx_book(self) -> Codebook:
        """Beams of the transmitter."""
        return _book(self.tx)

    @cached_property
    def rx_book(self) -> Codebook:
        """Beams of the receiver."""
        return _book(self.rx)

    @property
    def elements(self) -> int:
        """Elements of the swept end; of the receiver for both."""
        return self.tx.elements if self.swept == "tx" else self.rx.elements


def ends(ds: SpectrumDataset, sides: tuple[int, ...], both: tuple[int, int]) -> list[Ends]:
    """Square arrays of isotropic elements half a wavelength apart, upright, facing each other across the room.

    The receivers' array looks level from the middle of all receivers to the transmitter, that of the transmitter back:
    every receiver's array is mounted alike, so a beam's index means the same direction everywhere.

    Args:
        sides: Elements along a side of the array of one end, the other a single element.
        both: Those of transmitter and receiver for beams at both ends.
    """
    level = (ds.transmitter - ds.receivers.mean(axis=0)) * [1.0, 1.0, 0.0]
    facing = orientation_towards(-level), orientation_towards(level)
    one = [PlanarArray(1, 1, orientation=o) for o in facing]
    found = [Ends(f"rx {n * n}", "rx", one[0], PlanarArray(n, n, orientation=facing[1])) for n in sides]
    found += [Ends(f"tx {n * n}", "tx", PlanarArray(n, n, orientation=facing[0]), one[1]) for n in sides]
    pair = [PlanarArray(n, n, orientation=o) for n, o in zip(both, facing, strict=True)]
    return [*found, Ends(f"tx {both[0] ** 2}, rx {both[1] ** 2}", "both", *pair)]


@dataclass(frozen=True, eq=False)
class Link:
    """The true channel of one receiver.

    Attributes:
        specular: Line of sight and mirror paths.
        arrival, departure: Directions of the scattered waves, shape ``(L, 3)``.
        power: Their path gain, shape ``(L,)``.
        tau: Their delay [s], shape ``(L,)``.
        phase: Their random phase as unit numbers, complex, shape ``(L,)``.
    """

    specular: Paths
    arrival: np.ndarray
    departure: np.ndarray
    power: np.ndarray
    tau: np.ndarray
    phase: np.ndarray

    @property
    def line_of_sight(self) -> bool:
        """Whether the transmitter is seen."""
        return bool((self.specular.kind == "los").any())

    def channels(self, between: Sequence[Ends]) -> list[np.ndarray]:
        """The channel of each of ``between``, shapes ``(F, M, N)``, at :data:`FREQUENCIES` over :data:`BANDWIDTH_HZ`.

        Arrays in the middle of a larger one are cut out of its channel.
        """
        found: dict[str, np.ndarray] = {}
        whole: dict[str, tuple[Ends, np.ndarray]] = {}
        for e in sorted(between, key=lambda e: -e.tx.elements * e.rx.elements):
            if e.swept not in whole:
                whole[e.swept] = e, self._channel(e)
            larger, h = whole[e.swept]
            found[e.name] = h[:, _middle(larger.rx, e.rx)][:, :, _middle(larger.tx, e.tx)]
        return [found[e.name] for e in between]

    def _channel(self, between: Ends) -> np.ndarray:
        tx, rx = (
            Codebook(a, (np.eye(a.cols, dtype=complex), np.eye(a.rows, dtype=complex)))
            for a in (between.tx, between.rx)
        )
        offset = ((np.arange(FREQUENCIES) + 0.5) / FREQUENCIES - 0.5) * BANDWIDTH_HZ
        waves = np.sqrt(self.power) * self.phase * carrier_phase(offset[:, None], self.tau)
        if len(tx) == 1:
            scattered = rx.superposed(self.arrival, waves)[:, :, None]
        elif len(rx) == 1:
            scattered = tx.superposed(self.departure, waves)[:, None]
        else:
            scattered = np.zeros((FREQUENCIES, len(rx), len(tx)), dtype=complex)
            for k in range(0, len(self.power), _CHUNK):
                part = slice(k, k + _CHUNK)
                received, sent = rx.amplitude(self.arrival[part]), tx.amplitude(self.departure[part]).T
                for h, wave in zip(scattered, waves[:, part], strict=True):
                    h += (received * wave) @ sent
        frequencies = self.specular.carrier_hz + offset
        specular = self.specular.cfr(
            frequencies,
            tx_array=between.tx,
            rx_array=between.rx,
            wave="spherical",
            squint=False,
            method="dense",
        )
        return scattered + np.moveaxis(specular, -1, 0)

    def everything(self) -> Paths:
        """All paths with their true powers, for choices that know no phase."""
        theta_r, phi_r = angles_from_directions(self.arrival)
        theta_t, phi_t = angles_from_directions(self.departure)
        count = len(self.power)
        scattered = replace(
            self.specular,
            gain=np.sqrt(self.power).astype(complex),
            tau=self.tau,
            theta_r=theta_r,
            phi_r=phi_r,
            theta_t=theta_t,
            phi_t=phi_t,
            vertices=np.full((count, *self.specular.vertices.shape[1:]), np.nan),
            kind=np.full(count, "diffuse", dtype="<U7"),
            valid=np.ones(count, dtype=bool),
            jones=None,
        )
        return Paths.concatenate([self.specular, scattered])


def gains(between: Ends, channel: np.ndarray) -> np.ndarray:
    """|w_r^T H w_t|^2 of every pair of beams at every frequency, shape ``(F, Br, Bt)``."""
    received = between.rx_book.received(np.swapaxes(channel, 1, 2))
    return np.abs(between.tx_book.received(np.swapaxes(received, 1, 2))) ** 2


class Links:
    """True channels of any receiver of a data set.

    Args:
        scene: The true scene.
        ds: Data set; its engine decides how scattering is known.
        seed: Of the phases.
        device: Where rays are cast.
    """

    def __init__(self, scene: Any, ds: SpectrumDataset, *, seed: int = 0, device: Any = None) -> None:
        self.ds, self.seed, self.device = ds, seed, device
        known = {"transmitter": ds.transmitter, "frequency_hz": ds.frequency_hz, "device": device}
        self.tracer = MirrorTracer(scene, **known)
        self.engine = ExactEngine(scene, shape=ds.shape, sub_pixels=SUB_PIXELS, **known)
        self.single_bounce = ds.engine == "exact"

    def link(self, index: int) -> Link:
        """The channel of receiver ``index`` of the data set."""
        point = self.ds.receivers[index]
        specular = self.tracer.trace(point, 1 if self.single_bounce else 2)
        arrival, departure, power, tau = (
            self._rays(point) if self.single_bounce else self._of_spectrum(index, specular)
        )
        weakest = np.argsort(power)
        kept = weakest[np.cumsum(power[weakest]) > NEGLIGIBLE * power.sum()]
        turns = np.random.default_rng([self.seed, *np.round(1e6 * np.abs(point)).astype(int)])
        phase = np.exp(2j * np.pi * turns.random(len(kept)))
        return Link(specular, arrival[kept], departure[kept], power[kept], tau[kept], phase)

    def _rays(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        found = self.engine.diffuse(point)
        leg = point + found.range_m[:, None] * found.direction - self.ds.transmitter
        first_m = np.linalg.norm(leg, axis=1)
        tau = (first_m + found.range_m) / SPEED_OF_LIGHT
        return found.direction, leg / first_m[:, None], found.power, tau

    def _of_spectrum(
        self, index: int, specular: Paths
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        one = self.ds[index]
        if one.aod is None or one.delay_s is None:
            raise ValueError("data: got spectra without delay_s or aod, expected both")
        beams = spread(
            specular.arrival, specular.power, one.shape, self.ds.beam_sigma_rad, device=self.device
        )
        rest = np.maximum(np.asarray(one.path_gain, np.float64) - beams, 0.0).ravel()
        aod = np.asarray(one.aod, np.float64).reshape(-1, 2)
        tau = np.asarray(one.delay_s, np.float64).ravel()
        lit = np.flatnonzero((rest > 0) & np.isfinite(aod).all(axis=1) & np.isfinite(tau))
        count = SUB_PIXELS**2
        directions = sub_pixel_directions(one.shape, SUB_PIXELS)[0].reshape(-1, count, 3)[lit].reshape(-1, 3)
        departure = directions_from_angles(aod[lit, 0], aod[lit, 1])
        return (
            directions,
            np.repeat(departure, count, axis=0),
            np.repeat(rest[lit] / count, count),
            np.repeat(tau[lit], count),
        )


def _book(array: PlanarArray) -> Codebook:
    """The oversampled DFT codebook; the one beam of a single element."""
    return dft_codebook(array, OVERSAMPLING if array.elements > 1 else 1)


def _middle(whole: PlanarArray, part: PlanarArray) -> np.ndarray:
    """Elements of ``whole`` that a smaller array of the same spacing has about the same centre."""
    grid = np.arange(whole.elements).reshape(whole.cols, whole.rows)
    across, down = (whole.cols - part.cols) // 2, (whole.rows - part.rows) // 2
    return grid[across : across + part.cols, down : down + part.rows].ravel()
