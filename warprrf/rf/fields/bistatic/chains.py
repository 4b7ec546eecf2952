"""Power that chains of mirrors reflect of unpolarised light.

One mirror reflects the mean of |TE|^2 and |TM|^2. After it light is polarised, so that the next one reflects more or
less than its own mean, 7 dB less where a wall follows a floor met at Brewster's angle: what lies across the plane of
incidence of the one lies in that of the other. Between two mirrors (TE, TM) turn by the angle between their planes:

    power = 1/2 ||D_n R_n ... D_2 R_2 D_1||^2 (Frobenius), D = diag(TE, TM), R the rotation by that angle,

half-spaces of real permittivity for D (ITU-R P.2040-4, eqs. (37a) and (37b)). The mean over both transmitted, the sum
over both received polarisations.
"""

from __future__ import annotations

import numpy as np

_PARALLEL = 1e-6  # sine of incidence below which a mirror has no plane of incidence of its own
_EXCESS = (0.05, 200.0)  # of epsilon_r - 1, the range of :func:`warprrf.rf.em.half_spaces.fresnel_curves`


def turns(stops: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Angle from the plane of incidence of each mirror of a chain to that of the next [rad], shape ``(L, k)``.

    Args:
        stops: transmitter, mirror points and receiver of each chain [m], shape ``(L, k + 2, 3)``.
        normal: of the mirrors, shape ``(L, k, 3)``; either sign.

    Returns:
        0 for the first mirror, before which light has no polarisation.
    """
    leg = np.diff(stops, axis=1)
    along = leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-12)
    found = np.zeros(normal.shape[:2])
    before = across = np.zeros((len(stops), 3))
    for k in range(normal.shape[1]):
        own = np.cross(along[:, k], normal[:, k])
        sine = np.linalg.norm(own, axis=1, keepdims=True)
        if k:
            other = across  # a mirror met head on keeps the plane of the one before
        else:
            other = np.cross(along[:, 0], np.eye(3)[np.abs(along[:, 0]).argmin(axis=1)])
            other = other / np.linalg.norm(other, axis=1, keepdims=True)
        own = np.where(sine > _PARALLEL, own / np.maximum(sine, _PARALLEL), other)
        if k:
            found[:, k] = np.arctan2((own * before).sum(axis=1), (own * across).sum(axis=1))
        across, before = own, np.cross(own, along[:, k + 1])
    return found


def chain_reflection(
    log_excess: np.ndarray, cosine: np.ndarray, turn: np.ndarray, met: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reflected share of unpolarised power.

    Args:
        log_excess: ln(epsilon_r - 1) of each mirror of each chain, shape ``(L, k)``.
        cosine: of incidence, shape ``(L, k)``.
        turn: as :func:`turns` gives them, shape ``(L, k)``.
        met: which mirrors there are, shape ``(L, k)``; the others let everything pass.

    Returns:
        The share, shape ``(L,)``, and its logarithmic derivatives to ``log_excess``, shape ``(L, k)``.
    """
    amplitude, rise = _half_space(log_excess, cosine)
    amplitude = np.where(met[..., None], amplitude, 1.0)
    rise = np.where(met[..., None], rise, 0.0)
    c, s = np.cos(np.where(met, turn, 0.0)), np.sin(np.where(met, turn, 0.0))
    rotation = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)
    count, mirrors = cosine.shape
    whole = np.broadcast_to(np.eye(2), (count, 2, 2))
    slopes = np.zeros((mirrors, count, 2, 2))
    for k in range(mirrors):
        turned = rotation[:, k] @ whole
        whole = amplitude[:, k, :, None] * turned
        slopes[:k] = amplitude[:, k, :, None] * (rotation[:, k] @ slopes[:k])
        slopes[k] = rise[:, k, :, None] * turned
    share = 0.5 * (whole**2).sum(axis=(1, 2))
    return share, (whole * slopes).sum(axis=(2, 3)).T / np.maximum(share, 1e-12)[:, None]


def _half_space(log_excess: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes (TE, TM) that a half-space reflects, shape ``(..., 2)``, and their derivatives to ``log_excess``."""
    excess = np.clip(np.exp(log_excess), *_EXCESS)
    cos = np.clip(cosine, 0.0, 1.0)
    root = np.maximum(np.sqrt(excess + cos**2), 1e-12)
    dense = (1.0 + excess) * cos
    te, tm = (cos - root) / (cos + root), (dense - root) / (dense + root)
    bend = 0.5 * excess / root  # of the root to ln(excess)
    rise_te = -2.0 * cos * bend / (cos + root) ** 2
    rise_tm = 2.0 * (excess * cos * root - dense * bend) / (dense + root) ** 2
    return np.stack([te, tm], axis=-1), np.stack([rise_te, rise_tm], axis=-1)
