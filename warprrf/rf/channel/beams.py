"""Beams chosen from a predicted field: codebooks, single-link and multi-user choice, without pilots.

A beam is a vector of unit-norm weights w over an array's elements; between a beam at each end the received amplitude is
w_r^T H w_t (:func:`warprrf.rf.channel.response.frequency_response` for H). Steered along its own direction a beam of N
elements has gain N.

Choices are made from predicted *power* per direction. Scattering has no phase in a field, and those of mirrors and line
of sight turn once a wavelength (1 mm at 300 GHz), far below what geometry from photos knows. With phases independent
between paths the mean gain of a pair of beams is

    E |w_r^T H w_t|^2 = sum over paths of |gain|^2 g_r(w_r, arrival) g_t(w_t, departure),

g the gain of a beam on one element's. What it cannot foresee is how paths that one beam cannot tell apart add up.

Waves are plane: a beam of more than a thousand elements loses to that within a few metres
(:func:`warprrf.rf.channel.arrays.plane_wave_error`). :func:`steering_codebook` focuses on points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Count, check_array, check_count, check_positive, checked, one_line, positive
from warprrf.rf.channel.arrays import End, PlanarArray, array_of, check_unpolarised
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.em.waves import carrier_phase
from warprrf.rf.spectra.spectrum import Spectrum, directions_from_angles, pixel_directions, unit_vectors


@checked
@dataclass(frozen=True, eq=False)
class Codebook:
    """Beams of an array; make one with :func:`dft_codebook` or :func:`steering_codebook`.

    Attributes:
        array: The array.
        factors: Weights ``(B, N)``; or those across and down the array, ``(Bc, cols)`` and ``(Br, rows)``, whose
            products they are: beam ``c Br + r`` is the c-th across and the r-th down, as elements are numbered.
    """

    array: PlanarArray
    factors: tuple[np.ndarray, ...] = field(repr=False)

    def __post_init__(self) -> None:
        """Check that the weights are of the array's elements; TypeError or ValueError names them or the array."""
        check_unpolarised("array", self.array)
        axes = (self.array.cols, self.array.rows) if len(self.factors) == 2 else (self.array.elements,)
        if len(self.factors) != len(axes):
            raise ValueError(f"factors: got {len(self.factors)}, expected weights, or those across and down")
        sides = zip(self.factors, axes, strict=True)
        found = [check_array("factors", f, (None, n), complex) for f, n in sides]
        if any((np.abs(np.linalg.norm(f, axis=1) - 1.0) > 1e-3).any() for f in found):
            raise ValueError("factors: got weights of another norm than 1, which would count as gain")
        object.__setattr__(self, "factors", tuple(found))

    def __len__(self) -> int:
        return int(np.prod([len(f) for f in self.factors]))

    @property
    def weights(self) -> np.ndarray:
        """Weights of every beam, shape ``(B, N)``, complex, unit norm."""
        return self.factors[0] if len(self.factors) == 1 else np.kron(*self.factors)

    def beam(self, index: int) -> np.ndarray:
        """Weights of one beam, shape ``(N,)``."""
        return self.weights[check_count("index", index, 0, len(self) - 1)]

    def received(self, channel: ArrayLike) -> np.ndarray:
        """w^T h of every beam for channels ``(..., N)``, shape ``(..., B)``."""
        h = np.asarray(channel)
        if h.shape[-1:] != (self.array.elements,):
            raise ValueError(f"channel: got shape {h.shape}, expected (..., {self.array.elements})")
        if len(self.factors) == 1:
            return h @ self.factors[0].T
        across, down = self.factors
        grid = h.reshape(*h.shape[:-1], self.array.cols, self.array.rows)
        return (across @ grid @ down.T).reshape(*h.shape[:-1], len(self))

    def amplitude(self, directions: ArrayLike) -> np.ndarray:
        """w^T a of every beam for plane waves along world ``directions`` (L, 3), shape ``(B, L)``, complex.

        Elements' patterns count: |amplitude|^2 is the beam's power gain.
        """
        d = check_array("directions", directions, (None, 3), finite=False)
        size = np.sqrt(self.array.gain(d))
        parts = self._waves(d)
        if len(parts) == 1:
            return parts[0] * size
        return (parts[0][:, None] * (parts[1] * size)[None]).reshape(len(self), len(d))

    def superposed(self, directions: ArrayLike, gains: ArrayLike) -> np.ndarray:
        """w^T h of every beam for plane waves of complex ``gains`` (..., L) along ``directions`` (L, 3).

        Returns:
            Shape ``(..., B)``.
        """
        d = check_array("directions", directions, (None, 3), finite=False)
        values = check_array("gains", gains, (..., len(d)), complex, finite=False)
        size = np.sqrt(self.array.gain(d))
        return self._summed(d, values * size, lambda waves: waves)

    def power(self, directions: ArrayLike, powers: ArrayLike) -> np.ndarray:
        """Mean |w^T h|^2 of every beam for waves of ``powers`` (..., L) and independent phases, shape ``(..., B)``."""
        d = check_array("directions", directions, (None, 3), finite=False)
        values = check_array("powers", powers, (..., len(d)), finite=False)
        return self._summed(d, values * self.array.gain(d), squared)

    def _summed(
        self, d: np.ndarray, values: np.ndarray, measure: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Sum of ``values`` (..., L) times ``measure`` of what each beam receives of unit waves along ``d`` (L, 3)."""
        rows = values.reshape(int(np.prod(values.shape[:-1])), len(d))
        total = np.zeros((len(rows), len(self)), dtype=values.dtype)
        for part in chunks(len(d), sum(len(f) for f in self.factors)):
            waves = [measure(w) for w in self._waves(d[part])]
            for out, row in zip(total, rows, strict=True):
                weighted = waves[-1] * row[part]
                out += weighted.sum(axis=1) if len(waves) == 1 else (waves[0] @ weighted.T).ravel()
        return total.reshape(*values.shape[:-1], len(self))

    def _waves(self, d: np.ndarray) -> list[np.ndarray]:
        """What each factor receives of unit plane waves, shapes ``(B, L)``, without the elements' pattern."""
        if len(self.factors) == 1:
            return [self.factors[0] @ self.array.response(d, 1.0).T]
        across, down = np.broadcast_to(np.asarray(self.array.spacing, np.float64), (2,))[::-1]
        local = d @ self.array.rotation
        # Down the array z falls from element to element.
        return [
            self.factors[0] @ _steps(across * local[:, 1], self.array.cols),
            self.factors[1] @ _steps(-down * local[:, 2], self.array.rows),
        ]


@checked
def dft_codebook(array: PlanarArray, oversampling: Count = 1) -> Codebook:
    """Beams at equally spaced spatial frequencies, across and down the array; orthonormal without oversampling.

    Beam k of B along a side of n elements, B = ``oversampling`` n, looks along the cosine ((k + 1/2) / B - 1/2) /
    spacing to +y across the array and to -z down it. Beams 2 k and 2 k + 1 of a side twice as long halve what it
    covers. At half-wavelength spacing those of the corners, where both cosines are large, point nowhere.

    Raises:
        ValueError: for a polarised array, or oversampling below 1.
    """
    return Codebook(array, (_dft(array.cols, oversampling), _dft(array.rows, oversampling)))


@checked
def steering_codebook(
    array: PlanarArray,
    directions: ArrayLike | None = None,
    *,
    points: ArrayLike | None = None,
    wavelength_m: float | None = None,
) -> Codebook:
    """Beams conj(a) / |a| matched to plane waves along ``directions``, or to sources at ``points``.

    Args:
        directions: World directions away from the array, shape ``(B, 3)``, normalised here.
        points: Places [m] from the array's centre, shape ``(B, 3)``: spherical waves, for the near field.
        wavelength_m: Of the carrier; needed for points.

    Raises:
        ValueError: naming the argument; for a polarised array.
    """
    if (directions is None) == (points is None):
        raise ValueError("directions: expected either directions or points, and got both or neither")
    name, given = ("directions", directions) if points is None else ("points", points)
    toward = unit_vectors(name, given)  # type: ignore[arg-type]
    if points is None:
        response = array.response(toward, 1.0)
    else:
        wavelength = check_positive("wavelength_m", wavelength_m, "number of metres with points")
        response = array.spherical_response(points, wavelength)
    return Codebook(array, (response.conj() / np.linalg.norm(response, axis=1, keepdims=True),))


Source = PathArrays | Spectrum
"""Where predicted power comes from and how much: :class:`Paths` or a :class:`Spectrum` of one receiver or several."""
Noise: TypeAlias = Annotated[float, positive("share of the transmitted power")]
Ends = End | Codebook
"""Beams of one end: those given, an array's DFT codebook, an antenna as it stands, or a single isotropic element."""


@checked
@dataclass(frozen=True)
class BeamChoice:
    """Pairs of beams, best first, of one receiver ``(K,)`` or several ``(R, K)``.

    Attributes:
        tx: Index of the transmitter's beam.
        rx: Index of the receiver's beam.
        gain: Predicted mean |w_r^T H w_t|^2 [linear]; 0 for a receiver that no path reaches: any choice.
    """

    __repr__ = one_line

    tx: np.ndarray
    rx: np.ndarray
    gain: np.ndarray


@checked
def beam_gains(source: Source, tx_array: Ends = None, rx_array: Ends = None) -> np.ndarray:
    """Predicted mean |w_r^T H w_t|^2 of every pair of beams; arguments and errors as for :func:`select_beams`.

    Returns:
        Shape ``(Br, Bt)`` or ``(R, Br, Bt)``.
    """
    tx, rx = codebook_of("tx_array", tx_array), codebook_of("rx_array", rx_array)
    found = [_pair_gains(rays, tx, rx) for rays in rays_of(source, tx)]
    return np.stack(found) if source.batched else found[0]


@checked
def select_beams(
    source: Source, tx_array: Ends = None, rx_array: Ends = None, *, count: Count = 1
) -> BeamChoice:
    """The pairs of beams with the largest predicted mean gain: no pilot is sent.

    A spectrum is taken as powers at pixel centres. For beams narrower than its pixels give paths, whose line of sight
    and mirrors have their own directions. Its pixels without a departure angle count only where the transmitter has a
    single element.

    Args:
        source: A :class:`Spectrum` or :class:`Paths` of one receiver or several.
        tx_array: Transmitting :class:`PlanarArray`, whose DFT codebook is searched, or a :class:`Codebook`; a single
            isotropic element by default.
        rx_array: Of the receiver, likewise.
        count: Pairs to return, at most as many as there are.

    Raises:
        TypeError: for another source or array.
        ValueError: for a polarised array, a count below 1, or a spectrum without departure angles for a transmitting
            array.
    """
    tx, rx = codebook_of("tx_array", tx_array), codebook_of("rx_array", rx_array)
    rows = []
    for rays in rays_of(source, tx):
        gains = _pair_gains(rays, tx, rx)
        best = np.argsort(-gains, axis=None, kind="stable")[:count]
        rows.append((best % len(tx), best // len(tx), gains.ravel()[best]))
    return BeamChoice(*(np.stack(c) if source.batched else c[0] for c in zip(*rows, strict=True)))


@checked
@dataclass(frozen=True)
class MultiUserChoice:
    """One beam at each end for every user served at once.

    Attributes:
        tx: Index of the transmitter's beam of each user, shape ``(U,)``.
        rx: Index of the user's own beam, shape ``(U,)``.
        sinr: Predicted signal over interference and noise [linear], shape ``(U,)``.
    """

    __repr__ = one_line

    tx: np.ndarray
    rx: np.ndarray
    sinr: np.ndarray


@checked
def select_beams_multiuser(
    sources: Source | Iterable[Source], tx_array: Ends = None, rx_array: Ends = None, *, noise: Noise
) -> MultiUserChoice:
    """Beams for several users at once, so that the sum of their predicted rates is large.

    Power is shared equally; what one user's beam brings another is interference. Users choose one after another, the
    strongest first, the pair that adds most to the sum; then each in turn may change its pair while the others keep
    theirs, until nobody's change raises the sum (a local optimum: with one user the best pair).

    Args:
        sources: A sequence of spectra or paths, one a user, or those of several receivers.
        tx_array, rx_array: as for :func:`select_beams`; all users have the same array.
        noise: Noise power of a user over the total transmitted power [linear].

    Raises:
        TypeError, ValueError: as for :func:`select_beams`; without users, or for noise that is not positive.
    """
    tx, rx = codebook_of("tx_array", tx_array), codebook_of("rx_array", rx_array)
    gains = [_pair_gains(rays, tx, rx) for rays in rays_of_users(sources, tx)]
    served = _search(gains, noise * len(gains))
    received, transmitted = (np.array([served[u][k] for u in range(len(gains))]) for k in (0, 1))
    sinr = signal_over_interference(gains, transmitted, received, noise)
    return MultiUserChoice(transmitted, received, sinr)


@checked
def signal_over_interference(
    gains: Sequence[ArrayLike], tx: ArrayLike, rx: ArrayLike, noise: Noise
) -> np.ndarray:
    """SINR of users [linear], shape ``(U,)``, power shared equally.

    Args:
        gains: |w_r^T H w_t|^2 of every pair of beams of each user, ``(Br, Bt)``.
        tx, rx: Beams of the users, shape ``(U,)``.
        noise: Noise power over the total transmitted power.
    """
    users = len(gains)
    transmitted = check_array("tx", tx, (users,), np.int64)
    received = check_array("rx", rx, (users,), np.int64)
    tables = [check_array("gains", g, (None, None), least=0.0) for g in gains]
    for name, index, axis in (("rx", received, 0), ("tx", transmitted, 1)):
        fewest = min((table.shape[axis] for table in tables), default=0)
        if users and not -fewest <= index.min() <= index.max() < fewest:
            raise ValueError(f"{name}: got beams {index.min()} to {index.max()}, expected 0 to {fewest - 1}")
    own = zip(tables, received, strict=True)
    heard = np.array([table[r, transmitted] for table, r in own]).reshape(users, users)
    signal = np.diag(heard)
    return signal / (heard.sum(axis=1) - signal + noise * len(heard))


def _search(gains: list[np.ndarray], noise: float) -> dict[int, tuple[int, int]]:
    """Receiving and transmitting beam of each user, by ascent on the sum of rates."""
    served: dict[int, tuple[int, int]] = {}
    order = sorted(range(len(gains)), key=lambda u: -gains[u].max())
    max_rounds = 20  # of the multi-user search, which ends by itself once no user gains; a few are usual
    for _ in range(1 + max_rounds):
        before = dict(served)
        for u in order:
            others = {v: pair for v, pair in served.items() if v != u}
            rates = _sum_rates(gains, u, others, noise)
            best = int(rates.argmax())
            pair = int(best // rates.shape[1]), int(best % rates.shape[1])
            kept = served.get(u)
            # A change must gain more than rounding, or ties would go round for ever.
            if kept is None or rates[pair] > rates[kept] * (1.0 + 1e-12) + 1e-12:
                served[u] = pair
        if served == before:
            break
    return served


def _sum_rates(
    gains: list[np.ndarray], user: int, others: dict[int, tuple[int, int]], noise: float
) -> np.ndarray:
    """Sum of rates if ``user`` takes each pair of beams while ``others`` keep theirs, shape ``(Br, Bt)``."""
    own = gains[user]
    taken = [pair[1] for pair in others.values()]
    rates = np.log2(1.0 + own / (noise + own[:, taken].sum(axis=1, keepdims=True)))
    for v, (received, transmitted) in others.items():
        heard = gains[v][received]
        rest = noise + sum(heard[t] for w, (_, t) in others.items() if w != v)
        rates = rates + np.log2(1.0 + heard[transmitted] / (rest + heard))[None]
    return rates


Rays = tuple[np.ndarray, np.ndarray, np.ndarray]


def rays_of_users(sources: Source | Iterable[Source], tx: Codebook) -> list[Rays]:
    """:func:`rays_of` of every user."""
    given: Iterable[Source] = [sources] if isinstance(sources, Spectrum | PathArrays) else sources
    found = [rays for source in given for rays in rays_of(source, tx)]
    if not found:
        raise ValueError("sources: got none, expected a spectrum or paths for every user")
    return found


def rays_of(source: Source, tx: Codebook) -> Iterator[Rays]:
    """Departure (arrival, if it does not matter), arrival and power of what reaches each receiver of ``source``."""
    directed = tx.array.directed
    if isinstance(source, PathArrays):
        for paths in source.each():
            kept = paths.select(paths.power > 0)
            departure = kept.departure if directed else kept.arrival
            if directed and not np.isfinite(departure).all():
                raise ValueError("source: got paths without a departure angle, expected one with a tx_array")
            yield departure, kept.arrival, kept.power
    elif isinstance(source, Spectrum) and source.batched:
        for k in range(len(source.path_gain)):
            yield from rays_of(source[k], tx)
    elif isinstance(source, Spectrum):
        power = np.asarray(source.path_gain, np.float64)
        positive = power > 0
        departure = arrival = pixel_directions(source.shape)
        if directed:
            if source.aod is None:
                raise ValueError("source: got a spectrum without aod, expected departures with a tx_array")
            positive &= np.isfinite(source.aod).all(axis=-1)
            departure = directions_from_angles(source.aod[..., 0], source.aod[..., 1])
        yield departure[positive], arrival[positive], power[positive]
    else:
        raise TypeError(f"source: got {type(source).__name__}, expected a Spectrum or Paths")


def _pair_gains(rays: Rays, tx: Codebook, rx: Codebook) -> np.ndarray:
    departure, arrival, power = rays
    if tx.array.elements == 1:
        return rx.power(arrival, power * tx.array.gain(departure))[:, None] * squared(tx.weights[:, 0])
    if rx.array.elements == 1:
        return tx.power(departure, power * rx.array.gain(arrival))[None] * squared(rx.weights[:, :1])
    total = np.zeros((len(rx), len(tx)))
    for part in chunks(len(power), len(rx) + len(tx)):
        received = squared(rx.amplitude(arrival[part]))
        total += (received * power[part]) @ squared(tx.amplitude(departure[part])).T
    return total


def _steps(turns: np.ndarray, count: int) -> np.ndarray:
    """exp(2 pi j turns n) of ``count`` elements n about their middle, shape ``(count, L)``."""
    return carrier_phase(np.arange(count)[:, None] - 0.5 * (count - 1), -turns)


def _dft(count: int, oversampling: int) -> np.ndarray:
    """Beams ``(oversampling count, count)`` of a line of elements about its centre."""
    beams = oversampling * count
    frequency = (np.arange(beams) + 0.5) / beams - 0.5
    return _steps(-frequency, count).T / np.sqrt(count)


def codebook_of(name: str, value: Ends) -> Codebook:
    """The beams of an end; ``name`` is the argument that ``value`` came by."""
    if isinstance(value, Codebook):
        return value
    array = array_of(name, value)
    check_unpolarised(name, array)
    return dft_codebook(array)


def squared(values: np.ndarray) -> np.ndarray:
    """Squared moduli of complex ``values``."""
    return values.real**2 + values.imag**2


def chunks(count: int, width: int) -> Iterator[slice]:
    """Stretches of ``count`` paths whose ``width`` numbers each fit a cache together."""
    terms = 1 << 18  # numbers held at once while paths are summed: what fits a cache
    step = max(1, terms // max(width, 1))
    return (slice(k, k + step) for k in range(0, count, step))
