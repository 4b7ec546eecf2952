"""Sums over paths for every pair of elements: dense, exact to rounding, or gridded in delay.

What is summed, for elements m and n and a function B of delay (a complex exponential for frequencies, a sinc for taps):
sum over p of A_p exp(-j 2 pi f_c x_mnp / c) r_mnp B(tau_p + x_mnp / c), with x the length that the elements' places add
to the path and r the change of its amplitude (1 for plane waves). Without beam squint B is taken at tau_p: elements
then differ by a carrier phase alone.

Lengths are separable, a receiving element's plus a transmitting one's, for plane waves and for spherical ones about an
interaction point; they are not for spherical waves of a mirrored array.

Dense sums cost pairs x paths x frequencies. The gridded one, for equally spaced frequencies, costs pairs x (8 paths +
grid log grid): each path is spread to 8 cells of a twice oversampled grid of delays by a Kaiser-Bessel window, a fast
Fourier transform follows, and the window's transform is divided out (Dutt and Rokhlin, SIAM J. Sci. Comput. 14, 1993;
Beatty et al., IEEE Trans. Med. Imaging 24, 2005, for the window's width). It treats arrays exactly, whatever their
shape, and errs by about 1e-7 of the root of the paths' total power.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft
import warp as wp
from scipy.special import i0

from warprrf import device as _device
from warprrf.kernels.radio.delays import (
    DEGREE,
    TAPS,
    join_cells,
    spread_common_delays,
    spread_pair_delays,
    spread_separable_delays,
    taps_vector,
)
from warprrf.rf.channel.lengths import PairLengths
from warprrf.rf.em.waves import SPEED_OF_LIGHT

OVERSAMPLING = 2
LEAST_FREQUENCIES = 2 * TAPS
"""Fewer frequencies are summed densely: the window would wrap round the grid."""

_BETA = np.pi * np.sqrt(
    (TAPS / OVERSAMPLING) ** 2 * (OVERSAMPLING - 0.5) ** 2 - 0.8
)  # Beatty et al., eq. (5)
_IN_CACHE = 16_384  # numbers turned at once
_BLOCK = 8_000_000  # complex numbers that an intermediate array may hold, about


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

    def received(self, m: slice, frequency_hz: float) -> np.ndarray:
        """Of separable lengths: factors of receiving elements ``m`` at a frequency, shape ``(m, P)``."""
        added, ratio = self.lengths.received(m)
        turned = _turn(frequency_hz / SPEED_OF_LIGHT * added)
        return turned * ratio if self.lengths.spherical else turned

    def sent(self, frequency_hz: float) -> np.ndarray:
        """Of separable lengths: factors of transmitting elements at a frequency, shape ``(N, P)``."""
        return self.lengths.scale * _turn(frequency_hz / SPEED_OF_LIGHT * self.lengths.extra)

    def columns(self, n: slice) -> Sum:
        """The sum for transmitting elements ``n`` alone."""
        own = self.lengths
        target = own.target if own.separable else own.target[n]
        scale = own.scale if len(own.scale) == 1 else own.scale[n]
        return replace(self, lengths=replace(own, target=target, extra=own.extra[n], scale=scale))


def dense_sum(job: Sum, basis: Callable[[np.ndarray, slice], np.ndarray], count: int) -> np.ndarray:
    """The sum for ``count`` values of ``basis``, shape ``(M, N, count)``.

    ``basis(delay, which)`` returns B at ``delay`` (..., P) [s], shape ``(..., P, values)``, of the values ``which``.
    """
    rows, columns = job.shape
    paths = len(job.tau)
    out = np.zeros((rows, columns, count), dtype=complex)
    if paths == 0:
        return out
    own = job.squint and not job.lengths.alone
    if job.lengths.separable and not own:
        return _separable(job, basis(job.tau, slice(0, count)))
    step = max(1, _BLOCK // (columns * paths))
    for k in range(0, rows, step):
        m = slice(k, min(k + step, rows))
        longer, ratio = job.lengths.longer(m)
        carried = job.amplitude * ratio * _turn(job.carrier_hz / SPEED_OF_LIGHT * longer)
        if not own:
            out[m] = carried @ basis(job.tau, slice(0, count))
            continue
        delay = job.tau + longer / SPEED_OF_LIGHT
        each = max(1, _BLOCK // delay.size)
        for j in range(0, count, each):
            which = slice(j, min(j + each, count))
            out[m, :, which] = np.einsum("mnp,mnpj->mnj", carried, basis(delay, which))
    return out


def _separable(job: Sum, basis: np.ndarray) -> np.ndarray:
    """Sum with the same delays for all elements; ``basis`` is ``(P, count)``."""
    rows, columns = job.shape
    paths, count = basis.shape
    right = job.sent(job.carrier_hz) * job.amplitude
    few = count < min(rows, columns)
    out = np.empty((rows, columns, count), dtype=complex)
    step = max(1, _BLOCK // (paths * (1 if few else columns)))
    for k in range(0, rows, step):
        m = slice(k, k + step)
        left = job.received(m, job.carrier_hz)
        if few:
            for j in range(count):
                out[m, :, j] = (left * basis[:, j]) @ right.T
        else:
            out[m] = ((left[:, None] * right).reshape(-1, paths) @ basis).reshape(-1, columns, count)
    return out


def squint_sum(job: Sum, frequencies_hz: np.ndarray, factor: np.ndarray | None) -> np.ndarray:
    """Separable lengths with beam squint at any frequencies, shape ``(M, N, F)``: a matrix product for each.

    ``factor`` (P, F) multiplies the amplitudes.
    """
    out = np.zeros((*job.shape, len(frequencies_hz)), dtype=complex)
    if len(job.tau) == 0:
        return out
    step = max(1, _BLOCK // len(job.tau))
    for j, f in enumerate(frequencies_hz):
        weight = job.amplitude * _turn((f - job.carrier_hz) * job.tau)
        if factor is not None:
            weight = weight * factor[:, j]
        right = (job.sent(f) * weight).T
        for k in range(0, job.shape[0], step):
            m = slice(k, k + step)
            out[m, :, j] = job.received(m, f) @ right
    return out


def gridded_sum(job: Sum, frequencies_hz: np.ndarray, device: Any = None) -> np.ndarray:
    """The sum at equally spaced frequencies, at least :data:`LEAST_FREQUENCIES`, shape ``(M, N, F)``."""
    count = len(frequencies_hz)
    most = max(1, 4 * _BLOCK // len(job.tau))  # transmitting elements whose tables are held at once
    if job.shape[1] > most:
        pieces = [job.columns(slice(k, k + most)) for k in range(0, job.shape[1], most)]
        return np.concatenate([gridded_sum(piece, frequencies_hz, device) for piece in pieces], axis=1)
    middle = count // 2
    step_hz = (frequencies_hz[-1] - frequencies_hz[0]) / (count - 1)
    middle_hz = frequencies_hz[middle]
    cells = scipy.fft.next_fast_len(OVERSAMPLING * count)
    cell = np.mod(step_hz * job.tau, 1.0) * cells
    amplitude = job.amplitude * _turn((middle_hz - job.carrier_hz) * job.tau)
    # The window's transform at the frequencies' places on the grid.
    harmonic = np.arange(count) - middle
    root = np.sqrt(_BETA**2 - (np.pi * TAPS * harmonic / cells) ** 2)
    correction = i0(_BETA) * root / (TAPS * np.sinh(root))
    setup = (job, amplitude, cell, cells, step_hz, middle_hz, _device.resolve(device))
    own = job.squint or not job.lengths.separable
    fill = _own_delays(*setup) if own else _common_delays(*setup)
    rows, columns = job.shape
    out = np.empty((rows, columns, count), dtype=complex)
    each = columns * cells * (TAPS if own else 1)
    together = max(1, _BLOCK // max(each, len(cell)))
    for k in range(0, rows, together):
        m = slice(k, min(k + together, rows))
        waves = scipy.fft.fft(fill(m), axis=1, workers=_device.threads(), overwrite_x=True)
        out[m] = (waves[:, harmonic] * correction).reshape(-1, columns, count)
    return out


Filler = Callable[[slice], np.ndarray]
"""Makes the grids of receiving elements ``m``, shape ``(m N, cells)``, complex."""


def _common_delays(
    job: Sum,
    amplitude: np.ndarray,
    cell: np.ndarray,
    cells: int,
    step_hz: float,
    middle_hz: float,
    where: Any,
) -> Filler:
    """Separable lengths without squint."""
    start = np.ceil(cell - TAPS / 2)
    order = np.argsort(start, kind="stable")
    at = (start + TAPS // 2).astype(np.int64)[order]
    window = _window((start[order] - cell[order])[:, None] + np.arange(TAPS))
    first = np.searchsorted(at, np.arange(cells + 2)).astype(np.int32)
    job = replace(job, lengths=job.lengths.taken(order))
    right = job.sent(job.carrier_hz) * amplitude[order]
    shared = [
        wp.array(_pairs_of_reals(right), dtype=wp.vec2d, device=where),
        wp.array(window, dtype=taps_vector, device=where),
        wp.array(first, dtype=int, device=where),
    ]

    def fill(m: slice) -> np.ndarray:
        left = job.received(m, job.carrier_hz)
        block = wp.array(_pairs_of_reals(left), dtype=wp.vec2d, device=where)
        pairs = len(left) * len(right)
        real = wp.zeros((pairs, cells + TAPS), dtype=wp.float64, device=where)
        imag = wp.zeros((pairs, cells + TAPS), dtype=wp.float64, device=where)
        _device.launch(spread_common_delays, pairs, [len(right), block, *shared, real, imag], device=where)
        padded = _complex(real, imag)
        grid = padded[:, TAPS // 2 : TAPS // 2 + cells]
        grid[:, : TAPS // 2] += padded[:, cells + TAPS // 2 :]
        grid[:, cells - TAPS // 2 :] += padded[:, : TAPS // 2]
        return grid

    return fill


def _own_delays(
    job: Sum,
    amplitude: np.ndarray,
    cell: np.ndarray,
    cells: int,
    step_hz: float,
    middle_hz: float,
    where: Any,
) -> Filler:
    """Pairs with delays of their own: beam squint, lengths that are not separable."""
    number_hz = middle_hz if job.squint else job.carrier_hz
    per_m = abs(step_hz) * cells / SPEED_OF_LIGHT if job.squint else 0.0
    order = np.argsort(cell, kind="stable")  # neighbours in the grid follow each other
    cell, amplitude = cell[order], amplitude[order]
    lengths = job.lengths.taken(order)
    job = replace(job, lengths=lengths)
    # Cells that elements' places move a path by, at most: the grid reaches so far past its ends.
    reach = np.linalg.norm(lengths.place, axis=1).max() + np.abs(lengths.extra).max()
    margin = int(np.ceil(reach * per_m)) + 1
    width = cells + 2 * margin
    window = wp.array(_window_polynomials(), dtype=taps_vector, device=where)
    sign = -1.0 if step_hz < 0 else 1.0

    def join(kernel: Any, rows: int, inputs: list[Any]) -> np.ndarray:
        columns = len(lengths.extra)
        pairs = rows * columns
        grid = wp.zeros((pairs, 2 * width), dtype=taps_vector, device=where)
        real = wp.zeros((pairs, cells), dtype=wp.float64, device=where)
        imag = wp.zeros((pairs, cells), dtype=wp.float64, device=where)
        _device.launch(kernel, pairs, [columns, *inputs, window, grid], device=where)
        shift = (margin + TAPS // 2 - 1) % cells
        _device.launch(join_cells, pairs, [cells, shift, grid, real, imag], device=where)
        return _complex(real, imag)

    if not lengths.separable:
        far = np.linalg.norm(lengths.target, axis=2)
        shared = [
            wp.array(np.ascontiguousarray(lengths.target), dtype=wp.vec3d, device=where),
            wp.array(lengths.extra - far, dtype=wp.float64, device=where),
            wp.array(lengths.scale * far, dtype=wp.float64, device=where),
            wp.array(_pairs_of_reals(amplitude), dtype=wp.vec2d, device=where),
            wp.array(cell + margin, dtype=wp.float64, device=where),
            wp.float64(number_hz / SPEED_OF_LIGHT),
            wp.float64(sign * per_m),
        ]

        def fill_pairs(m: slice) -> np.ndarray:
            place = wp.array(np.ascontiguousarray(lengths.place[m]), dtype=wp.vec3d, device=where)
            return join(spread_pair_delays, len(place), [place, *shared])

        return fill_pairs

    sent = [
        wp.array(_pairs_of_reals(job.sent(number_hz) * amplitude), dtype=wp.vec2d, device=where),
        wp.array(cell + margin + sign * per_m * lengths.extra, dtype=wp.float64, device=where),
    ]

    def fill(m: slice) -> np.ndarray:
        added, ratio = lengths.received(m)
        factors = ratio * _turn(number_hz / SPEED_OF_LIGHT * added)
        left = wp.array(_pairs_of_reals(factors), dtype=wp.vec2d, device=where)
        later = wp.array(sign * per_m * added, dtype=wp.float64, device=where)
        return join(spread_separable_delays, len(added), [left, later, *sent])

    return fill


def _complex(real: wp.array, imag: wp.array) -> np.ndarray:
    both = np.empty(real.shape, dtype=complex)
    both.real, both.imag = real.numpy(), imag.numpy()
    return both


def _turn(turns: np.ndarray) -> np.ndarray:
    """exp(-j 2 pi turns), whole turns dropped first; in pieces that stay in cache, on all threads."""
    flat = np.ascontiguousarray(turns, dtype=np.float64).reshape(-1)
    out = np.empty(flat.shape, dtype=complex)

    def piece(begin: int) -> None:
        part = slice(begin, begin + _IN_CACHE)
        angle = flat[part] - np.rint(flat[part])
        angle *= 2.0 * np.pi
        np.cos(angle, out=out.real[part])
        np.negative(np.sin(angle, out=angle), out=out.imag[part])

    starts = range(0, len(flat), _IN_CACHE)
    if len(starts) < 4 or _device.threads() == 1:
        for begin in starts:
            piece(begin)
    else:
        with ThreadPoolExecutor(_device.threads()) as pool:
            list(pool.map(piece, starts))
    return out.reshape(np.shape(turns))


def _window(x: np.ndarray) -> np.ndarray:
    """Kaiser-Bessel window at ``x`` cells from its middle; zero outside."""
    return i0(_BETA * np.sqrt(np.maximum(1.0 - (2.0 * x / TAPS) ** 2, 0.0))) / i0(_BETA)


def _window_polynomials() -> np.ndarray:
    """Windows of the taps over the first one's place in [0, 1]: coefficients ``(DEGREE + 1, TAPS)``, highest first."""
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(4 * DEGREE) + 0.5) / (4 * DEGREE))
    columns = [
        np.polynomial.Chebyshev.fit(nodes, _window(nodes - TAPS / 2 + j), DEGREE, domain=[0, 1])
        .convert(kind=np.polynomial.Polynomial)
        .coef
        for j in range(TAPS)
    ]
    return np.ascontiguousarray(np.stack(columns, axis=1)[::-1])


def _pairs_of_reals(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64).reshape(*values.shape, 2)
