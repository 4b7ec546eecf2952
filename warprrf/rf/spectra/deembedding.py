"""Taking a receiver's antenna out of measured spectra.

Two ways to measure. *Scanned*: an antenna with a rotationally symmetric pattern G is steered to every pixel centre; the
value there is y(d) = sum over paths of path gain times G(angle between d and the path), a convolution on the sphere.
It is undone by Richardson-Lucy steps (Richardson 1972, Lucy 1974), weighted by the pixels' solid angles: estimates stay
non-negative, a known noise power is part of the model, and each step conserves the total
``sum_i Omega_i (y_i - noise) / integral of G``, which is the total path gain whatever the horn. *Fixed*: the antenna
does not turn and directions were distinguished by other means; its pattern over absolute directions divides out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Count, NotNegative, Positive, check_array, check_number, check_positive, checked
from warprrf.device import DeviceLike, Progress, silent
from warprrf.rf.spectra.antenna import Antenna, Pattern, as_antenna
from warprrf.rf.spectra.spectrum import (
    check_shape,
    pixel_angles,
    pixel_directions,
    pixel_solid_angles,
    spread_paths,
)

SCANNED = "scanned antenna: Richardson-Lucy on the sphere, then spread by the stated beam"
FIXED = "fixed antenna: divided by its gain in each direction"


@checked
@dataclass(frozen=True)
class Scan:
    """How a scanned antenna is taken out.

    Attributes:
        noise: Mean noise power in every measured value [linear, over transmitted power].
        snapshots: Over how many independent ones each value was averaged: noise power scatters by ``noise`` over the
            root of it.
        iterations: Most Richardson-Lucy steps for one receiver.
        tolerance: Steps stop when the misfit is this small against the measurement, both weighted by solid angle,
            after the first 50 when it is as small as the noise's scatter, or when it fell by less than 1 % over the
            last 50; paths between pixel centres leave a few percent, so that stalling ends most.
        device: Where estimates are spread by the beam.
    """

    noise: NotNegative = 0.0
    snapshots: Count = 1
    iterations: Count = 2000
    tolerance: Positive = 1e-3
    device: DeviceLike = None


class Deembedded(NamedTuple):
    """Spectra without the antenna.

    Attributes:
        path_gain: Path gain per pixel [linear], shape ``(R, H, W)``, float64.
        source: Index ``row * W + column`` of the measured pixel that each pixel's strongest path comes from, shape
            ``(R, H, W)``, int; -1 where empty.
        steps: Steps taken, shape ``(R,)``, int; 0 for a fixed antenna.
        misfit: Relative misfit of the measurement, weighted by solid angle, shape ``(R,)``; 0 for a fixed antenna.
        covered: Share of the sphere of which the spectrum is known.
        method: What was done, :data:`SCANNED` or :data:`FIXED`.
    """

    path_gain: np.ndarray
    source: np.ndarray
    steps: np.ndarray
    misfit: np.ndarray
    covered: float
    method: str


def deembed(
    path_gain: np.ndarray,
    pattern: Pattern,
    beam_sigma_rad: float,
    *,
    boresight_gain_dbi: float | None = None,
    noise: float = 0.0,
    progress: Progress | None = None,
    **options: Any,
) -> Deembedded:
    """``path_gain`` (R, H, W) without the antenna; see :meth:`warprrf.SpectrumDataset.deembed`.

    A pattern ``(H, W)`` is a fixed antenna's, which takes the option ``limit_db``; any other a scanned one's, with those
    of :class:`Scan`.

    Raises:
        TypeError: for an option of the other kind of antenna.
        ValueError: for noise with a fixed antenna, or naming another argument.
    """
    power = np.asarray(path_gain, np.float64)
    fixed = None
    if not callable(pattern) and not isinstance(pattern, Antenna | str):
        fixed = check_array("pattern", pattern, finite=False)
    if fixed is None or fixed.ndim != 2:
        kernel = scanned_kernel(pattern, check_shape(power.shape[1:]), boresight_gain_dbi)
        return _deembed_scanned(power, kernel, beam_sigma_rad, Scan(noise=noise, **options), progress)
    if noise != 0.0:
        raise ValueError("noise: a fixed antenna's spectra are divided as they are; take the noise off first")
    gain = _gains(check_array("pattern", fixed, power.shape[1:], least=0.0), boresight_gain_dbi)
    return _deembed_fixed(power, gain, **options)


def scanned_kernel(
    pattern: Pattern, shape: tuple[int, int], boresight_gain_dbi: float | None = None
) -> np.ndarray:
    """Azimuth spectrum of the response between rows, shape ``(W // 2 + 1, H, H)``; real, since patterns are even.

    Args:
        pattern: An antenna that is the same all round its boresight, or what stands for one as a pattern.
        shape: Rows and columns of the grid.
        boresight_gain_dbi: Scales the pattern to this gain at its strongest; None takes it as it is.

    Raises:
        TypeError: if ``pattern`` is neither.
        ValueError: if gains are negative, NaN, infinite, all zero or the same in all directions.
    """
    gain = _gains(as_antenna(pattern).gain_off_boresight(_angles_between(shape)), boresight_gain_dbi)
    flat_db = 0.1  # a pattern that varies less cannot tell directions apart
    if gain.min() > gain.max() * 10.0 ** (-flat_db / 10.0):
        raise ValueError(
            "pattern: got the same gain in all directions; scanning it tells nothing of directions, expected a "
            "directive antenna (a fixed isotropic one is an array of ones over the pixels)"
        )
    return np.fft.rfft(gain, axis=-1).real.transpose(2, 0, 1).copy()


def _angles_between(shape: tuple[int, int]) -> np.ndarray:
    """Angle [rad] between the pixels of column 0 and all others, shape ``(H, H, W)``."""
    rows, columns = check_shape(shape)
    zenith = pixel_angles(shape)[0]
    azimuth = np.arange(columns) * 2.0 * np.pi / columns
    # Half the chord, not the cosine: it does not cancel for small angles.
    apart = np.sin(0.5 * (zenith[:, None] - zenith[None, :]))[..., None] ** 2
    half = apart + np.sin(zenith)[:, None, None] * np.sin(zenith)[None, :, None] * np.sin(0.5 * azimuth) ** 2
    return 2.0 * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0)))


def respond(path_gain: ArrayLike, kernel: np.ndarray) -> np.ndarray:
    """What the scanned antenna measures of ``path_gain`` (..., H, W): power at each pixel it is steered to, same shape.

    ``kernel`` is what :func:`scanned_kernel` returned. Exact on the grid: rows are convolved in azimuth by FFT.
    """
    image = np.asarray(path_gain, dtype=np.float64)
    columns = image.shape[-1]
    waves = np.moveaxis(np.fft.rfft(image.reshape(-1, *image.shape[-2:]), axis=-1), 0, -1).transpose(1, 0, 2)
    waves = np.ascontiguousarray(waves)  # (W // 2 + 1, H, R), as pairs of real numbers below
    turned = (kernel @ waves.view(np.float64)).view(np.complex128)
    return np.fft.irfft(turned.transpose(2, 1, 0), n=columns, axis=-1).reshape(image.shape)


def _deembed_scanned(
    power: np.ndarray,
    kernel: np.ndarray,
    beam_sigma_rad: float,
    scan: Scan,
    progress: Progress | None,
) -> Deembedded:
    """Spectra by this package's conventions from the powers that a steered antenna measured, ``(R, H, W)``."""
    count, shape = len(power), check_shape(power.shape[1:])
    directions = pixel_directions(shape).reshape(-1, 3)
    path_gain, source = np.zeros(power.shape), np.full(power.shape, -1)
    steps, misfit = np.zeros(count, dtype=int), np.zeros(count)
    dynamic_range_db = 60.0  # what an estimate holds that far below its strongest direction is dropped [dB]
    together = 32  # receivers whose estimates are refined at once
    for first in range(0, count, together):
        part = slice(first, min(first + together, count))
        estimate, steps[part], misfit[part] = _richardson_lucy(power[part], kernel, scan)
        for k, one in enumerate(estimate, start=first):
            kept = np.where(one > one.max() * 10.0 ** (-dynamic_range_db / 10.0), one, 0.0)
            if kept.any():
                kept *= one.sum() / kept.sum()
                found = spread_paths(directions, kept.ravel(), shape, beam_sigma_rad, device=scan.device)
                path_gain[k], source[k] = found
            (progress or silent)("deembed", k + 1, count)
    return Deembedded(path_gain, source, steps, misfit, 1.0, SCANNED)


def _richardson_lucy(
    measured: np.ndarray, kernel: np.ndarray, scan: Scan
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Path gain per direction ``(R, H, W)``, steps ``(R,)`` and relative misfit ``(R,)``."""
    weight = np.broadcast_to(pixel_solid_angles(measured.shape[1:])[:, None], measured.shape[1:])
    back = respond(weight, kernel)  # what a path of unit gain adds to the weighted sum of the measurement
    signed = (weight * (measured - scan.noise)).sum(axis=(1, 2))
    # Uniform per solid angle to begin with: a pole's small pixels start with little.
    estimate = weight / (weight * back).sum() * np.maximum(signed, 0.0)[:, None, None]
    size = np.sqrt((weight * measured**2).sum(axis=(1, 2)))
    goal = scan.tolerance * size
    # The first steps only gather power where it is: they are safe whatever the noise, and never left out.
    noisy_goal = np.maximum(goal, scan.noise / np.sqrt(scan.snapshots) * np.sqrt(weight.sum()))
    steps, misfit = np.zeros(len(measured), dtype=int), np.where(size > 0, 1.0, 0.0)
    before = np.full(len(measured), np.inf)
    going = np.flatnonzero(signed > 0)
    together = 50  # steps
    for step in range(scan.iterations):
        expected = np.maximum(respond(estimate[going], kernel), 0.0) + scan.noise
        error = np.sqrt((weight * (measured[going] - expected) ** 2).sum(axis=(1, 2)))
        misfit[going] = error / size[going]
        left = error > (goal if step < together else noisy_goal)[going]
        if step % together == 0:
            left &= error < 0.99 * before[going]
            before[going] = error
        going, expected = going[left], expected[left]
        if len(going) == 0:
            break
        ratio = np.divide(measured[going], expected, out=np.zeros(expected.shape), where=expected > 0)
        estimate[going] *= np.maximum(respond(weight * ratio, kernel), 0.0) / back
        if scan.noise > 0:  # the noise takes its share of each value only on average: hold the total
            scale = signed[going] / (estimate[going] * back).sum(axis=(1, 2))
            estimate[going] *= scale[:, None, None]
        steps[going] = step + 1
    return estimate, steps, misfit


def _deembed_fixed(power: np.ndarray, gain: np.ndarray, limit_db: float = 20.0) -> Deembedded:
    """Spectra divided by the gain of an antenna that does not turn.

    Directions in which the antenna is more than ``limit_db`` below its peak come out empty: dividing there would only
    blow up noise and leakage. The total path gain is then that of the directions that are left.
    """
    check_positive("limit_db", limit_db, "number of decibels")
    known = gain >= gain.max() * 10.0 ** (-limit_db / 10.0)
    path_gain = np.divide(power, gain, out=np.zeros(power.shape), where=known)
    source = np.where(path_gain > 0, np.arange(gain.size).reshape(gain.shape), -1)
    weight = pixel_solid_angles(gain.shape)[:, None]
    covered = float((weight * known).sum() / (weight * np.ones_like(gain)).sum())
    none = np.zeros(len(power))
    return Deembedded(path_gain, source, none.astype(int), none, covered, FIXED)


def _gains(gain: np.ndarray, boresight_gain_dbi: float | None) -> np.ndarray:
    if not gain.max() > 0:
        raise ValueError("pattern: got a gain of zero in all directions, expected linear power gains")
    if boresight_gain_dbi is None:
        return gain
    largest_gain_dbi = 100.0  # an aperture of ten thousand wavelengths
    peak_db = check_number("boresight_gain_dbi", boresight_gain_dbi, -largest_gain_dbi, largest_gain_dbi)
    return gain / gain.max() * 10.0 ** (peak_db / 10.0)
