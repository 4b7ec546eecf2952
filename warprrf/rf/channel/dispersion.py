"""How paths spread in delay and angle: delay spread, K-factor, angular spread, coherence bandwidth.

All are of path gains between isotropic antennas, diffuse paths included as the powers that they are. Sources: ITU-R
P.1407 for the mean delay, the rms delay spread and the correlation bandwidth (the frequency shift at which the
autocorrelation of the transfer function falls to a share of its maximum); 3GPP TR 38.901, annex A.1, eq. (A-1), for the
angular spread, and its section 7.5 for the K-factor: power of the line of sight over that of all other paths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from warprrf.checks import check_array, checked, one_line
from warprrf.rf.channel.path_arrays import PathArrays


@checked
@dataclass(frozen=True)
class Dispersion:
    """Spreads of the paths of one receiver, arrays ``()``, or of several, ``(R,)``; NaN where there is no path.

    Attributes:
        path_gain: Total path gain [linear].
        mean_delay_s: Power-weighted mean delay, from zero [s].
        delay_spread_s: Root mean square delay spread [s].
        k_factor: Power of the line of sight over that of the rest [linear]; 0 without one, inf with nothing else.
        azimuth_spread_arrival_rad, zenith_spread_arrival_rad, azimuth_spread_departure_rad, zenith_spread_departure_rad:
            Angular spreads [rad].
        coherence_bandwidth_hz: Frequency shift at which correlation first falls to one half [Hz]; inf if it never does.
    """

    __repr__ = one_line

    path_gain: np.ndarray
    mean_delay_s: np.ndarray
    delay_spread_s: np.ndarray
    k_factor: np.ndarray
    azimuth_spread_arrival_rad: np.ndarray
    zenith_spread_arrival_rad: np.ndarray
    azimuth_spread_departure_rad: np.ndarray
    zenith_spread_departure_rad: np.ndarray
    coherence_bandwidth_hz: np.ndarray


def dispersion(paths: PathArrays) -> Dispersion:
    """All measures of ``paths``.

    Raises:
        ValueError: if a path has no delay, or no angle.
    """
    paths.check_delays()
    mean, spread = delay_spread(paths.power, paths.tau)
    total = paths.power.sum(axis=-1)
    direct = np.where(paths.kind == "los", paths.power, 0.0).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        k_factor = np.where(total > 0, direct / (total - direct), np.nan)
    return Dispersion(
        path_gain=total,
        mean_delay_s=mean,
        delay_spread_s=spread,
        k_factor=k_factor,
        azimuth_spread_arrival_rad=_angular(paths.power, paths.phi_r, "paths: phi_r"),
        zenith_spread_arrival_rad=_angular(paths.power, paths.theta_r, "paths: theta_r"),
        azimuth_spread_departure_rad=_angular(paths.power, paths.phi_t, "paths: phi_t"),
        zenith_spread_departure_rad=_angular(paths.power, paths.theta_t, "paths: theta_t"),
        coherence_bandwidth_hz=coherence_bandwidth(paths.power, paths.tau),
    )


@checked
def delay_spread(power: ArrayLike, tau: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Mean delay and rms delay spread [s] of powers at delays ``tau`` (..., L) [s], each ``(...)``.

    Delays without power may be NaN; both are NaN where there is no power.
    """
    weight, delay = _weights(power, tau, "tau")
    mean = (weight * delay).sum(axis=-1)
    return mean, np.sqrt((weight * (delay - mean[..., None]) ** 2).sum(axis=-1))


@checked
def angular_spread(power: ArrayLike, angle: ArrayLike) -> np.ndarray:
    """sqrt(-2 ln |sum P exp(j angle)| / sum P) [rad] over the last axis; 3GPP TR 38.901, eq. (A-1)."""
    return _angular(power, angle, "angle")


@checked
def coherence_bandwidth(power: ArrayLike, tau: ArrayLike, level: float = 0.5) -> np.ndarray:
    """Least frequency shift at which |sum P exp(-j 2 pi shift tau)| falls to ``level`` of sum P [Hz], shape ``(...)``.

    inf where it does not within 4096 periods of the longest difference of delays; NaN where there is no power.

    Raises:
        ValueError: if ``level`` is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: got {level!r}, expected a share between 0 and 1")
    weight, delay = _weights(power, tau, "tau")
    found = np.zeros(weight.shape[:-1])
    for k in np.ndindex(found.shape):
        found[k] = _first_fall(weight[k], delay[k], level)
    return found


def _angular(power: ArrayLike, angle: ArrayLike, name: str) -> np.ndarray:
    weight, value = _weights(power, angle, name)
    resultant = np.abs((weight * np.exp(1j * value)).sum(axis=-1))
    with np.errstate(divide="ignore"):
        return np.sqrt(np.maximum(-2.0 * np.log(np.minimum(resultant, 1.0)), 0.0))


def _first_fall(weight: np.ndarray, tau: np.ndarray, level: float) -> float:
    if np.isnan(weight).any():
        return float("nan")
    tau, weight = tau[weight > 0], weight[weight > 0]
    tau = tau - tau.min()
    longest = tau.max()
    # |R| cannot fall below the strongest weight less all others; of delays nearer than that even the squares are zero.
    if longest < 1e-150 or 2.0 * weight.max() - 1.0 > level:
        return float("inf")

    def over(shift: ArrayLike) -> np.ndarray:
        waves = np.exp(-2j * np.pi * np.mod(np.multiply.outer(shift, tau), 1.0))
        return np.abs(waves @ weight) - level

    steps = 16  # trials of the correlation over the shortest period that it can have
    step = 1.0 / (longest * steps)
    # By no more it falls between trials, by its second derivative, and by its first.
    dip = min(0.005 * (1.0 + 1.0 / level), 0.1)
    most_periods = 4096  # searched for the first crossing
    for begin in range(0, most_periods * steps, 256):
        shifts = step * np.arange(begin, begin + 257)
        for k in np.flatnonzero(over(shifts) <= dip):
            fine = np.linspace(shifts[max(k - 1, 0)], shifts[min(k + 1, 256)], 33)
            below = np.flatnonzero(over(fine) <= 0)
            if len(below):
                return float(brentq(over, fine[below[0] - 1], fine[below[0]], xtol=1e-9))
    return float("inf")


def _weights(power: ArrayLike, values: ArrayLike, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Shares of power that sum to one over the last axis (NaN without power), and values with 0 where there is none."""
    p = check_array("power", power, least=0.0)
    v = check_array(name, values, finite=False)
    if p.shape != v.shape or p.ndim == 0:
        raise ValueError(f"power: got shape {p.shape} for {name} of shape {v.shape}, expected the same")
    if p.shape[-1] == 0:
        p, v = np.zeros((2, *p.shape[:-1], 1))
    positive = p > 0
    if not np.isfinite(v[positive]).all():
        raise ValueError(f"{name}: got NaN or infinite ones where there is power")
    total = p.sum(axis=-1, keepdims=True)
    share = np.divide(p, total, out=np.full(p.shape, np.nan), where=total > 0)
    return share, np.where(positive, v, 0.0)
