"""Sums over paths between two arrays: dense, and on a grid of delays.

The sum for a receiving element m, a transmitting element n and a function B of delay (a complex exponential for
frequencies, a sinc for taps) is
sum over p of A_p exp(-j 2 pi f_c x_mnp / c) r_mnp B(tau_p + x_mnp / c), with x the length that the elements' places add
to the path and r the change of its amplitude (1 for plane waves). Without beam squint B is taken at tau_p: elements
then differ by a carrier phase alone.

Dense sums cost pairs x paths x frequencies. The gridded one, for equally spaced frequencies, costs pairs x (8 paths +
grid log grid): each path is spread to 8 cells of a twice oversampled grid of delays by a smooth window, a fast Fourier
transform follows, and the window's transform is divided out (Dutt and Rokhlin, SIAM J. Sci. Comput. 14, 1993; the
window exp(beta sqrt(1 - z^2)) is that of Barnett, Magland and af Klinteberg, SIAM J. Sci. Comput. 41, 2019). It treats
arrays exactly, whatever their shape, and errs by less than 1e-6 of the root of the paths' total power.

Lengths are those of plane waves, or of spherical waves about exact points. For line of sight, mirrors, slabs and edges a
spherical wave comes from the transmitting element's image: the transmitter's lies one path length away along the arrival, and
its array is turned by the reflections of the way. For diffuse paths it runs from the element to the first interaction
point, and from the last to the receiving element.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from scipy.sparse import csr_array

from warprrf.device import threads
from warprrf.geometry.mesh import headings
from warprrf.kernels.radio.records import EDGE, MIRROR
from warprrf.rf.channel.path_arrays import PathArrays, length_along, points_along
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase

TAPS = 8
"""Cells that a path is spread to."""
LEAST_FREQUENCIES = 2 * TAPS
"""Fewer frequencies are summed densely: the window would wrap round the grid."""

_BLOCK = 4_000_000  # numbers that an intermediate array may hold, about


@dataclass(frozen=True)
class PairLengths:
    """Lengths that the places of elements add to paths, and what they make of amplitudes.

    Attributes:
        place: Receiving elements about their centre [m], shape ``(M, 3)``.
        target: Plane waves: unit directions of arrival, shape ``(1, P, 3)``. Spherical waves: the source that the
            receiving elements see, from their centre [m], shape ``(1, P, 3)``, or ``(N, P, 3)`` if every transmitting
            element is a source of its own.
        extra: Length to add for transmitting elements [m], shape ``(N, P)``.
        scale: Factor of amplitudes for transmitting elements, shape ``(N, P)`` or ``(N, 1)``.
        spherical: Whether waves are.
    """

    place: np.ndarray
    target: np.ndarray
    extra: np.ndarray
    scale: np.ndarray
    spherical: bool

    @property
    def separable(self) -> bool:
        """Whether a length is that of a receiving element plus that of a transmitting one."""
        return len(self.target) == 1

    def received(self) -> tuple[np.ndarray, np.ndarray]:
        """Of separable ones: length [m] that receiving elements add, ``(M, P)``, and factor of amplitudes."""
        if not self.spherical:
            return -(self.place @ self.target[0].T), np.ones((1, 1))
        reach, far = self._reach(self.target[0], self.place[:, None])
        return reach - far, far / reach

    def longer(self) -> tuple[np.ndarray, np.ndarray]:
        """Of others: added length [m] and factor of amplitudes, each ``(M, N, P)``."""
        reach, far = self._reach(self.target, self.place[:, None, None])
        return self.extra + (reach - far), self.scale * (far / reach)

    @staticmethod
    def _reach(source: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.linalg.norm(source - place, axis=-1), np.linalg.norm(source, axis=-1)

    def between(self, m: slice, n: slice) -> PairLengths:
        """Those of receiving elements ``m`` and transmitting ones ``n``."""
        target = self.target if self.separable else self.target[n]
        return replace(self, place=self.place[m], target=target, extra=self.extra[n], scale=self.scale[n])


@dataclass(frozen=True)
class Sum:
    """Paths between two arrays, to be summed.

    Attributes:
        amplitude: Complex amplitude at the carrier between the arrays' centres, shape ``(P,)``.
        tau: Delays [s], shape ``(P,)``.
        lengths: What the elements' places add.
        carrier_hz: Carrier [Hz].
        squint: Whether delays differ between elements, not just carrier phases.
    """

    amplitude: np.ndarray
    tau: np.ndarray
    lengths: PairLengths
    carrier_hz: float
    squint: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of receiving and of transmitting elements."""
        return len(self.lengths.place), len(self.lengths.extra)

    @property
    def own_delays(self) -> bool:
        """Whether pairs of elements have delays of their own."""
        return self.squint and self.shape != (1, 1)

    def blocks(self, per_pair: int) -> Iterator[tuple[slice, slice, Sum]]:
        """The sum in pieces of elements whose ``per_pair`` numbers a pair are held at once."""
        rows, columns = self.shape
        wide = max(1, min(columns, _BLOCK // max(per_pair, 1)))
        high = max(1, _BLOCK // max(per_pair * wide, 1))
        for k in range(0, columns, wide):
            n = slice(k, min(k + wide, columns))
            for j in range(0, rows, high):
                m = slice(j, min(j + high, rows))
                yield m, n, replace(self, lengths=self.lengths.between(m, n))

    def pairs(self, frequency_hz: float) -> tuple[np.ndarray, np.ndarray]:
        """Factors of the elements at a frequency, and lengths that they add [m], each ``(M, N, P)``."""
        own = self.lengths
        if own.separable:
            added = own.received()[0]
            factor = self.received(frequency_hz)[:, None] * self.transmitted(frequency_hz)
            return factor, added[:, None] + own.extra
        longer, ratio = own.longer()
        return ratio * _turn(frequency_hz, longer), longer

    def received(self, frequency_hz: float) -> np.ndarray:
        """Of separable lengths: factors of receiving elements at a frequency, shape ``(M, P)``."""
        added, ratio = self.lengths.received()
        return ratio * _turn(frequency_hz, added)

    def transmitted(self, frequency_hz: float) -> np.ndarray:
        """Of separable lengths: factors of transmitting elements at a frequency, shape ``(N, P)``."""
        return self.lengths.scale * _turn(frequency_hz, self.lengths.extra)


def dense_sum(job: Sum, basis: Callable[[np.ndarray, slice], np.ndarray], count: int) -> np.ndarray:
    """The sum for ``count`` values of ``basis``, shape ``(M, N, count)``.

    ``basis(delay, which)`` returns B at ``delay`` (..., P) [s], shape ``(..., P, values)``, of the values ``which``.
    """
    out = np.zeros((*job.shape, count), dtype=complex)
    paths = len(job.tau)
    if paths == 0:
        return out
    for m, n, block in job.blocks(paths):
        factor, longer = block.pairs(job.carrier_hz)
        carried = job.amplitude * factor
        if not job.own_delays:
            out[m, n] = carried @ basis(job.tau, slice(0, count))
            continue
        delay = job.tau + longer / SPEED_OF_LIGHT
        each = max(1, _BLOCK // delay.size)
        for j in range(0, count, each):
            which = slice(j, min(j + each, count))
            out[m, n, which] = np.einsum("mnp,mnpj->mnj", carried, basis(delay, which))
    return out


def squint_sum(job: Sum, frequencies_hz: np.ndarray, factor: np.ndarray | None) -> np.ndarray:
    """Separable lengths with beam squint at any frequencies, shape ``(M, N, F)``: a matrix product for each.

    ``factor`` (P, F) multiplies the amplitudes.
    """
    out = np.zeros((*job.shape, len(frequencies_hz)), dtype=complex)
    for m, n, block in job.blocks(len(job.tau)):
        for j, f in enumerate(frequencies_hz):
            weight = job.amplitude * carrier_phase(f - job.carrier_hz, job.tau)
            if factor is not None:
                weight = weight * factor[:, j]
            out[m, n, j] = block.received(f) @ (block.transmitted(f) * weight).T
    return out


def gridded_sum(job: Sum, frequencies_hz: np.ndarray) -> np.ndarray:
    """The sum at equally spaced frequencies, at least :data:`LEAST_FREQUENCIES`, shape ``(M, N, F)``."""
    count, paths = len(frequencies_hz), len(job.tau)
    harmonic = np.arange(count) - count // 2
    middle_hz = frequencies_hz[count // 2]
    step_hz = (frequencies_hz[-1] - frequencies_hz[0]) / (count - 1)
    oversampling = 2
    cells = scipy.fft.next_fast_len(oversampling * count)
    amplitude = job.amplitude * carrier_phase(middle_hz - job.carrier_hz, job.tau)
    correction = 1.0 / _window_transform(harmonic / cells)
    out = np.empty((*job.shape, count), dtype=complex)
    for m, n, block in job.blocks(max(cells, paths * (TAPS if job.own_delays else 1))):
        factor, longer = block.pairs(middle_hz if job.squint else job.carrier_hz)
        delay = job.tau + longer / SPEED_OF_LIGHT if job.own_delays else job.tau
        place = step_hz * cells * delay.reshape(-1, paths)
        grid = _spread(place, (amplitude * factor).reshape(-1, paths), cells)
        waves = scipy.fft.fft(grid, axis=1, workers=threads(), overwrite_x=True)
        out[m, n] = (waves[:, harmonic] * correction).reshape(*factor.shape[:2], count)
    return out


def _spread(place: np.ndarray, values: np.ndarray, cells: int) -> np.ndarray:
    """``values`` (K, P) at ``place`` (K, P), or (1, P) for all alike, on grids of ``cells``, shape ``(K, cells)``."""
    first = np.ceil(place - TAPS / 2)
    taps = np.arange(TAPS)
    weight = _window((first - place)[..., None] + taps)
    cell = np.mod(first, cells).astype(np.int64)[..., None] + taps
    cell[cell >= cells] -= cells
    if len(place) == 1:
        count = place.shape[1]
        ends = TAPS * np.arange(count + 1)
        return values @ csr_array((weight.ravel(), cell.ravel(), ends), shape=(count, cells))
    cell += cells * np.arange(len(place))[:, None, None]
    index, size = cell.ravel(), len(place) * cells
    grid = np.empty(size, dtype=complex)
    grid.real = np.bincount(index, (weight * values.real[..., None]).ravel(), size)
    grid.imag = np.bincount(index, (weight * values.imag[..., None]).ravel(), size)
    return grid.reshape(-1, cells)


def _window(x: np.ndarray) -> np.ndarray:
    """The window at ``x`` cells from its middle; nothing outside."""
    z = 1.0 - (2.0 / TAPS * x) ** 2
    beta = 2.3 * TAPS  # width of the window for this oversampling: Barnett et al., eq. (1.8)
    return np.where(z > 0.0, np.exp(beta * (np.sqrt(np.maximum(z, 0.0)) - 1.0)), 0.0)


def _window_transform(cycles_per_cell: np.ndarray) -> np.ndarray:
    """The window's Fourier transform, by quadrature."""
    node, weight = np.polynomial.legendre.leggauss(64)
    x = 0.5 * TAPS * node
    waves = np.cos(2.0 * np.pi * cycles_per_cell[:, None] * x)
    return waves @ (0.5 * TAPS * weight * _window(x))


def _turn(frequency_hz: float, length_m: np.ndarray) -> np.ndarray:
    """exp(-j 2 pi f x / c) of lengths x, whole turns dropped first; cosine and sine take half an exponential's time."""
    turns = frequency_hz / SPEED_OF_LIGHT * length_m
    turns -= np.rint(turns)
    turns *= -2.0 * np.pi
    out = np.empty(turns.shape, dtype=complex)
    np.cos(turns, out=out.real)
    np.sin(turns, out=out.imag)
    return out


def plane_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Plane waves: projections on the directions of departure and arrival.

    Args:
        sending, receiving: Elements about their array's centre [m], shapes ``(N, 3)`` and ``(M, 3)``.
    """
    return PairLengths(
        place=receiving,
        target=np.nan_to_num(paths.arrival)[None],  # where not known, there is one element at the centre
        extra=-(sending @ np.nan_to_num(paths.departure).T),
        scale=np.ones((len(sending), 1)),
        spherical=False,
    )


def spherical_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Paths that do not scatter: distances from the transmitting elements' images. An edge counts as the mirror that turns
    the way as it does: right to first order in the elements' places, but for the waves' bend across the edge."""
    tx, rx, bounces = _ends(paths)
    points = points_along(tx, paths.vertices, rx)
    last, length = points[np.arange(len(points)), bounces], length_along(points)
    toward = headings(last - rx)[0]
    # The image lies ``length`` away along the arrival; its array is mirrored at every turn of the way.
    mirrored = np.einsum("pij,nj->npi", _mirrorings(points, paths.interactions), sending)
    target = length[:, None] * toward + mirrored
    far = np.linalg.norm(target, axis=2)
    return PairLengths(receiving, target, extra=far - length, scale=length / far, spherical=True)


def scattered_lengths(paths: PathArrays, sending: np.ndarray, receiving: np.ndarray) -> PairLengths:
    """Diffuse paths: distances to the first interaction point and from the last."""
    tx, rx, bounces = _ends(paths)
    first = paths.vertices[:, 0] - tx
    last = paths.vertices[np.arange(len(bounces)), bounces - 1] - rx
    near = np.linalg.norm(first, axis=1)
    each = np.linalg.norm(first - sending[:, None], axis=2)
    return PairLengths(receiving, last[None], extra=each - near, scale=near / each, spherical=True)


def _ends(paths: PathArrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmitter, receiver and numbers of interactions, which spherical waves need."""
    if paths.transmitter is None or paths.receiver is None:
        raise ValueError("paths: got ones without transmitter and receiver, which spherical waves need")
    bounces = np.isfinite(paths.vertices[..., 0]).sum(axis=1)
    if (bounces[paths.kind != "los"] == 0).any():
        raise ValueError("paths: got some without the interaction points that spherical waves need")
    return paths.transmitter, paths.receiver, bounces


def _mirrorings(points: np.ndarray, interactions: np.ndarray) -> np.ndarray:
    """What mirrors and edges do to directions, shape ``(P, 3, 3)``: a product of reflections; slabs do nothing."""
    legs = headings(np.diff(points, axis=1))[0]
    turned = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    turns = np.isin(interactions, (MIRROR, EDGE))
    for k in range(turns.shape[1]):
        unit, size = headings(np.nan_to_num(legs[:, k + 1] - legs[:, k]))
        there = turns[:, k] & (size > 1e-9)
        mirror = np.eye(3) - 2.0 * np.where(there[:, None, None], unit[:, :, None] * unit[:, None, :], 0.0)
        turned = mirror @ turned
    return turned
