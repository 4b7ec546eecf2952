"""From paths to channels: impulse response, frequency response and taps between two antenna arrays.

The channel between receiving port m and transmitting port n at frequency f is

    H_mn(f) = sum over paths of a_mn exp(-j 2 pi (f - f_c) (tau + x_mn / c)),

with a_mn the complex gain at the carrier f_c times element amplitudes and the array's phases, and x_mn the length that
the elements' places add to the path. It is the passband transfer function, phase -2 pi f tau, in complex128: at 300 GHz
a wavelength is 1 mm. Three choices are the caller's:

- ``wave``: "plane" (Sionna RT's synthetic array) or "spherical", every element's own distance, see :mod:`.sums`. Element
  patterns and polarisations are those in the direction at the array's centre. :func:`plane_wave_error` says what the
  plane wave costs.
- ``squint``: whether x_mn counts as a delay, so that beams turn with frequency, or as a phase at the carrier alone, as
  Sionna RT has it.
- ``diffuse``: a diffuse path is the power of many scatterers, without a phase. "random_phase" turns each by a phase
  drawn from ``seed`` and from what the path is (:func:`random_turns`); "power" leaves them out of the sum, their power is
  :func:`diffuse_power`'s; "given" takes the phases that are in the gains (those of a ray tracer). It must be stated where
  there are diffuse paths.

Amplitudes hold at the carrier. Over a wide band, ``amplitude="friis"`` adds the factor f_c / f of free space between
isotropic antennas. Absorption that is in the gains (:meth:`Paths.with_gas`) follows its own frequency dependence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import factorial
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_choice, check_count, check_positive, check_seed
from warprrf.rf.channel.arrays import End, PlanarArray, array_of, check_unpolarised
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.channel.sums import (
    LEAST_FREQUENCIES,
    PairLengths,
    Sum,
    dense_sum,
    gridded_sum,
    plane_lengths,
    scattered_lengths,
    spherical_lengths,
    squint_sum,
)
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase


class LinkOptions(TypedDict, total=False):
    """What stands at the ends of the paths, and how waves cross the arrays.

    Attributes:
        tx_array: Transmitting array about the transmitter, or an antenna; one isotropic element by default.
        rx_array: Receiving array about every receiver, or an antenna; one isotropic element by default.
        wave: "plane" (default) or "spherical".
        squint: Whether elements differ in delay (default) or only in carrier phase.
        diffuse: "random_phase", "power" or "given"; must be stated if there are diffuse paths.
        seed: Of the random phases; 0 by default.
        normalize_delays: Count delays (and phases) from each receiver's first path; False by default.
    """

    tx_array: End
    rx_array: End
    wave: str
    squint: bool
    diffuse: str | None
    seed: int
    normalize_delays: bool


def frequency_response(
    paths: PathArrays,
    frequencies_hz: ArrayLike,
    *,
    amplitude: str = "carrier",
    method: str = "auto",
    **link: Unpack[LinkOptions],
) -> np.ndarray:
    """Channel frequency response at ``frequencies_hz`` (F,), absolute [Hz].

    Args:
        amplitude: "carrier", or "friis" for the factor carrier / f.
        method: "dense", exact to rounding; "grid" for equally spaced frequencies, errs by less than 1e-6 of the root of the
            paths' power; "auto" takes the grid where the dense sum has more than a million terms (pairs x paths x frequencies).
        **link: See :class:`LinkOptions`.

    Returns:
        Shape ``(M, N, F)`` for paths of one receiver, ``(R, M, N, F)`` for several, complex128: M receiving and N
        transmitting ports.

    Raises:
        ValueError: naming the argument; where ``diffuse`` or polarised amplitudes are needed and missing.
    """
    f = check_array("frequencies_hz", frequencies_hz, (None,))
    if not (len(f) and (f > 0).all()):
        raise ValueError("frequencies_hz: expected some, all positive (absolute, not about the carrier)")
    check_choice("amplitude", amplitude, ("carrier", "friis"))
    check_choice("method", method, ("auto", "dense", "grid"))
    even = len(f) >= LEAST_FREQUENCIES and _evenly_spaced(f)
    if method == "grid" and not even:
        raise ValueError(
            f"frequencies_hz: method 'grid' needs at least {LEAST_FREQUENCIES} equally spaced ones; use 'dense'"
        )
    found = []
    for one in _links(paths, **link):
        air_m = one.paths.air_m
        many = one.ports[0] * one.ports[1] * len(air_m) * len(f) > 1e6
        gridded = method == "grid" or (method == "auto" and even and many)
        h = np.zeros((*one.ports, len(f)), dtype=complex)
        for index, ports, job in one.jobs():
            h[ports] += _response(job, f, one.absorption(f), air_m[index], gridded)
        if amplitude == "friis":
            h = h * (one.paths.carrier_hz / f)
        found.append(h if one.shift_s == 0.0 else h * carrier_phase(-f, one.shift_s))
    return np.stack(found) if paths.batched else found[0]


def channel_taps(
    paths: PathArrays, bandwidth_hz: float, l_min: int, l_max: int, **link: Unpack[LinkOptions]
) -> np.ndarray:
    """Taps of the discrete baseband channel behind ideal low-pass filters of ``bandwidth_hz`` W.

    h_l = sum of a exp(-j 2 pi f_c tau) sinc(l - W tau) for l from ``l_min`` to ``l_max`` (Tse and Viswanath,
    Fundamentals of Wireless Communication, eq. (2.34)), f_c the carrier, which is the centre of the band: the
    coefficients of the channel sampled at W. Absorption is that at the carrier.

    Args:
        bandwidth_hz: Bandwidth W [Hz].
        l_min, l_max: First and last tap. A path of delay tau falls on tap W tau: count delays from the first path
            (``normalize_delays``) or let the taps reach that far.
        **link: See :class:`LinkOptions`.

    Returns:
        Shape ``(M, N, L)`` or ``(R, M, N, L)``, complex128.

    Raises:
        ValueError: naming the argument.
    """
    check_positive("bandwidth_hz", bandwidth_hz)
    check_count("l_max", l_max, check_count("l_min", l_min, -(2**31)))
    lags = np.arange(l_min, l_max + 1)

    def taps(one: _Link) -> np.ndarray:
        def basis(delay: np.ndarray, which: slice) -> np.ndarray:
            return np.sinc(lags[which] - bandwidth_hz * (delay - one.shift_s)[..., None])

        h = np.zeros((*one.ports, len(lags)), dtype=complex)
        for _, ports, job in one.jobs():
            h[ports] += dense_sum(job, basis, len(lags))
        return h * carrier_phase(-one.paths.carrier_hz, one.shift_s)

    found = [taps(one) for one in _links(paths, **link)]
    return np.stack(found) if paths.batched else found[0]


def impulse_response(paths: PathArrays, **link: Unpack[LinkOptions]) -> tuple[np.ndarray, np.ndarray]:
    """Baseband impulse response: one coefficient a path and pair of ports, and the delays.

    Args:
        **link: See :class:`LinkOptions`; without ``squint``, since every pair's own delays are returned.

    Returns:
        Coefficients, exp(-j 2 pi f_c tau) included, shape ``(M, N, L)`` or ``(R, M, N, L)``, complex128, 0 where padded
        and for diffuse paths left out by "power"; delays [s], shape ``(L,)`` or ``(R, L)`` for plane waves, with the
        elements' own, shape ``(M, N, L)`` or ``(R, M, N, L)``, for spherical ones, NaN where padded.

    Raises:
        ValueError: naming the argument.
    """
    count = paths.gain.shape[-1]
    spherical = link.get("wave") == "spherical"
    coefficients, delays = [], []
    for one in _links(paths, **link):
        carrier = one.paths.carrier_hz
        a = np.zeros((*one.ports, count), dtype=complex)
        each = np.full((*one.ports, count), np.nan)
        for index, (received, transmitted), job in one.jobs():
            factor, longer = job.pairs(carrier)
            place = received, transmitted, one.index[index]
            a[place] = job.amplitude * factor * carrier_phase(-carrier, one.shift_s)
            each[place] = longer / SPEED_OF_LIGHT + job.tau - one.shift_s
        tau = np.full(count, np.nan)
        tau[one.index] = one.paths.tau - one.shift_s
        coefficients.append(a)
        delays.append(each if spherical else tau)
    return (np.stack(coefficients), np.stack(delays)) if paths.batched else (coefficients[0], delays[0])


def diffuse_power(paths: PathArrays, *, tx_array: End = None, rx_array: End = None) -> np.ndarray:
    """Mean power that diffuse paths of random phase add to |H_mn|^2 of any pair of elements, shape ``()`` or ``(R,)``.

    For arrays without polarisation. It is flat in frequency.

    Raises:
        ValueError: if an array is polarised.
    """
    tx, rx = array_of("tx_array", tx_array), array_of("rx_array", rx_array)
    for name, array in (("tx_array", tx), ("rx_array", rx)):
        check_unpolarised(name, array)
    scattered = np.where(paths.kind == "diffuse", paths.power, 0.0)
    whole = scattered > 0
    gains = np.zeros(scattered.shape)
    gains[whole] = tx.gain(paths.departure[whole]) * rx.gain(paths.arrival[whole])
    return (scattered * gains).sum(axis=-1)


@dataclass(frozen=True)
class _Link:
    """Paths of one receiver between two arrays, ready to be summed.

    Attributes:
        index: Which of the receiver's paths are summed.
        paths: Those, P of them.
        amplitude: Between elements at the arrays' centres, shape ``(Kr, Kt, P)``, K polarisations at either end.
        lengths: What elements' places add, for groups of paths (indices into the P).
        shift_s: Delay that counts as zero.
        ports: Of the receiving and of the transmitting array.
    """

    index: np.ndarray
    paths: PathArrays
    amplitude: np.ndarray
    lengths: list[tuple[np.ndarray, PairLengths]]
    shift_s: float
    ports: tuple[int, int]
    squint: bool

    def jobs(self) -> Iterator[tuple[np.ndarray, tuple[slice, slice], Sum]]:
        """Sums to add up: the paths that they are over, the ports that they belong to."""
        for index, lengths in self.lengths:
            rows, columns = len(lengths.place), len(lengths.extra)
            for a, b in np.ndindex(self.amplitude.shape[:2]):
                ports = slice(a * rows, (a + 1) * rows), slice(b * columns, (b + 1) * columns)
                amplitude = self.amplitude[a, b, index]
                delay, carrier = self.paths.tau[index], self.paths.carrier_hz
                yield index, ports, Sum(amplitude, delay, lengths, carrier, self.squint)

    def absorption(self, f: np.ndarray) -> np.ndarray | None:
        """Loss per metre over that at the carrier [neper/m], shape ``(F,)``; None without air."""
        air, carrier = self.paths.air, self.paths.carrier_hz
        if air is None:
            return None
        return np.log(10.0) / 20.0 * (air.attenuation_db_per_m(f) - air.attenuation_db_per_m(carrier))


def random_turns(paths: PathArrays, seed: int) -> np.ndarray:
    """A phase [turns] for each path of one receiver, shape ``(L,)``, evenly distributed.

    It hangs on the receiver's position (to 1 um), the directions (1e-6 rad) and the delay (1 ps) of the path: on what it
    is, not on its place in a list, on others in it, or on which receivers are asked together.

    Source: the mixing function of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014).
    """
    state = np.full(len(paths.gain), check_seed(seed), dtype=np.uint64)
    place = np.zeros(3) if paths.receiver is None else paths.receiver
    angles = (paths.theta_r, paths.phi_r, paths.theta_t, paths.phi_t)
    for value, step in (*((x, 1e-6) for x in (*place, *angles)), (paths.tau, 1e-12)):
        steps = np.nan_to_num(np.round(np.asarray(value, dtype=np.float64) / step)) + 0.0  # no -0
        state ^= steps.view(np.uint64)
        state += np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return (state >> np.uint64(11)) * 2.0**-53


def _links(
    paths: PathArrays,
    tx_array: End = None,
    rx_array: End = None,
    wave: str = "plane",
    squint: bool = True,
    diffuse: str | None = None,
    seed: int = 0,
    normalize_delays: bool = False,
) -> Iterator[_Link]:
    """The link of each receiver; :class:`LinkOptions` says what the options mean."""
    check_choice("wave", wave, ("plane", "spherical"))
    if diffuse is not None:
        check_choice("diffuse", diffuse, ("random_phase", "power", "given"))
    elif (paths.valid & (paths.kind == "diffuse")).any():
        raise ValueError(
            "diffuse: got None with diffuse paths, which have no phase; expected 'random_phase' (with a seed), 'power' "
            "(left out of the sum) or 'given' (phases as they are)"
        )
    check_seed(seed)
    tx, rx = array_of("tx_array", tx_array), array_of("rx_array", rx_array)
    carrier = paths.carrier_hz
    places = [array.positions(SPEED_OF_LIGHT / carrier) for array in (tx, rx)]
    for k in range(len(paths.gain) if paths.batched else 1):
        own = paths.row(k) if paths.batched else paths
        scattered = own.kind == "diffuse"
        index = np.flatnonzero(own.valid & ~scattered if diffuse == "power" else own.valid)
        chosen = own.select(index)
        chosen.check_delays()
        for name, array, toward in (("tx_array", tx, chosen.departure), ("rx_array", rx, chosen.arrival)):
            if array.directed and np.isnan(toward).any():
                raise ValueError(f"{name}: got one for paths whose angles there are NaN, expected None")
        amplitude = _amplitudes(chosen, tx, rx)
        if diffuse == "random_phase":
            turns = np.zeros(len(own.gain))
            turns[scattered] = random_turns(own.select(scattered), seed)
            amplitude = amplitude * carrier_phase(-1.0, turns[index])
        if wave == "plane":
            groups = [(np.arange(len(index)), plane_lengths(chosen, *places))]
        else:
            split = (~scattered[index], spherical_lengths), (scattered[index], scattered_lengths)
            groups = [
                (np.flatnonzero(some), lengths(chosen.select(some), *places))
                for some, lengths in split
                if some.any()
            ]
        yield _Link(
            index=index,
            paths=chosen,
            amplitude=amplitude,
            lengths=groups,
            shift_s=float(chosen.tau.min()) if normalize_delays and len(index) else 0.0,
            ports=(rx.ports, tx.ports),
            squint=squint,
        )


def _response(
    job: Sum, f: np.ndarray, loss: np.ndarray | None, length_m: np.ndarray, gridded: bool
) -> np.ndarray:
    if len(job.tau) == 0:
        return np.zeros((*job.shape, len(f)), dtype=complex)
    # A series of more nepers loses paths to rounding.
    if gridded and (loss is None or np.abs(loss).max() * np.ptp(length_m) < 18.0):
        return gridded_sum(job, f) if loss is None else _gridded_with_air(job, f, loss, length_m)
    factor = None if loss is None else np.exp(-loss * length_m[:, None])
    if job.own_delays and job.lengths.separable:
        return squint_sum(job, f, factor)

    def basis(delay: np.ndarray, which: slice) -> np.ndarray:
        waves = carrier_phase(f[which] - job.carrier_hz, delay[..., None])
        return waves if factor is None else waves * factor[:, which]

    return dense_sum(job, basis, len(f))


def _gridded_with_air(job: Sum, f: np.ndarray, loss: np.ndarray, length_m: np.ndarray) -> np.ndarray:
    """exp(-loss L) as a series in L about its middle, cut at 1e-8 of its least value: one gridded sum a term."""
    middle = 0.5 * (length_m.min() + length_m.max())
    reach = max(0.5 * float(np.ptp(length_m)), 1e-12)
    size = reach * np.abs(loss).max()
    about = (length_m - middle) / reach
    total, k = np.zeros((*job.shape, len(f)), dtype=complex), 0
    while size**k / factorial(k) > 1e-8 * np.exp(-size):
        part = gridded_sum(replace(job, amplitude=job.amplitude * about**k), f)
        total += part * ((-loss * reach) ** k / factorial(k))
        k += 1
    return total * np.exp(-loss * middle)


def _amplitudes(paths: PathArrays, tx: PlanarArray, rx: PlanarArray) -> np.ndarray:
    """Amplitudes between elements at the arrays' centres, shape ``(Kr, Kt, P)``."""
    if not tx.element.polarised and not rx.element.polarised:
        return (paths.gain * np.sqrt(tx.gain(paths.departure) * rx.gain(paths.arrival)))[None, None]
    if not (tx.element.polarised and rx.element.polarised):
        known = [
            "of its own" if a.element.polarised and a.polarisation is None else a.polarisation
            for a in (rx, tx)
        ]
        raise ValueError(
            f"rx_array: got polarisation {known[0]!r} beside {known[1]!r} of the transmitting array, expected both polarised or "
            "neither (Antenna.unpolarised())"
        )
    if paths.jones is None or not np.isfinite(paths.jones).all():
        raise ValueError(
            "paths: polarised arrays need polarised amplitudes, but some paths hold powers alone; trace them in a "
            "scene with materials, or use arrays and antennas without polarisation"
        )
    received, transmitted = rx.field(paths.arrival), tx.field(paths.departure)
    return np.einsum("apx,pxy,bpy->abp", received, paths.jones, transmitted)


def _evenly_spaced(f: np.ndarray) -> bool:
    step = np.diff(f)
    mean = (f[-1] - f[0]) / (len(f) - 1)
    even = 1e-9  # frequencies are equally spaced if they are so to this share of their step
    return mean != 0 and bool(np.abs(step - mean).max() <= max(even * abs(mean), 4e-16 * np.abs(f).max() * 4))
