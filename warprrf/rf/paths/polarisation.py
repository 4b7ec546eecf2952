"""What chains of mirrors do to polarisation: Jones matrices, and the power that they reflect of unpolarised light.

After one mirror light is polarised, so that the next one reflects more or less than its own mean, 7 dB less where a wall
follows a floor met at Brewster's angle: what lies across the plane of incidence of the one lies in that of the other.
Between two mirrors (TE, TM) turn by the angle between their planes. Along (TE, TM) before the first and behind the last

    J = D_n R_n ... D_2 R_2 D_1,    power = 1/2 ||J||^2 (Frobenius),    D = diag(TE, TM), R the rotation by that angle:

the mean over both transmitted, the sum over both received polarisations.
"""

from __future__ import annotations

import numpy as np

from warprrf.geometry.mesh import headings, vectors_across
from warprrf.rf.spectra.spectrum import transverse_basis


def turns(stops: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Angle from the plane of incidence of each mirror of a chain to that of the next [rad], shape ``(L, k)``.

    Args:
        stops: transmitter, mirror points and receiver of each chain [m], shape ``(L, k + 2, 3)``.
        normal: of the mirrors, shape ``(L, k, 3)``; either sign.

    Returns:
        0 for the first mirror, before which light has no polarisation.
    """
    along, across = _frames(stops, normal)
    after = np.cross(across, along[:, 1:])
    found = np.zeros(normal.shape[:2])
    for k in range(1, normal.shape[1]):
        own = across[:, k]
        found[:, k] = np.arctan2((own * after[:, k - 1]).sum(axis=1), (own * across[:, k - 1]).sum(axis=1))
    return found


def vertical_ends(stops: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fields of antennas along the zenith unit vectors of departure and arrival, in the (TE, TM) of the first mirror and
    behind the last, shape ``(L, 2)`` each; arguments as for :func:`turns`."""
    leg = np.diff(stops, axis=1)
    sent, heard = np.swapaxes(transverse_basis(leg[:, 0]), 1, 2), transverse_basis(-leg[:, -1])
    if normal.shape[1] == 0:
        both = (heard @ sent)[:, 0, 0]
        return np.stack([both, 0.0 * both], axis=1), np.broadcast_to([1.0, 0.0], (len(both), 2))
    along, across = _frames(stops, normal)
    first, last = across[:, 0], across[:, -1]
    before = np.stack([first, np.cross(first, along[:, 0])], axis=1)
    behind = np.stack([last, np.cross(last, along[:, -1])], axis=1)
    return (before @ sent)[:, :, 0], (heard @ np.swapaxes(behind, 1, 2))[:, 0, :]


def _frames(stops: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions of the legs ``(L, k + 1, 3)`` and, across each plane of incidence, of TE fields ``(L, k, 3)``.

    A mirror met head on keeps the plane of the one before.
    """
    along, across = headings(np.diff(stops, axis=1))[0], np.zeros(normal.shape)
    for k in range(normal.shape[1]):
        other = across[:, k - 1] if k else vectors_across(along[:, 0])[0]
        across[:, k] = across_incidence(along[:, k], normal[:, k], other)
    return along, across


def across_incidence(along: np.ndarray, normal: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Unit vectors across the plane of incidence of unit directions ``along`` (L, 3) on what has the unit ``normal`` (L, 3);
    ``other`` (L, 3) where that is met head on."""
    across = np.cross(along, normal)
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    least = 1e-6  # sine of incidence below which a mirror has no plane of incidence of its own
    return np.where(sine > least, across / np.maximum(sine, least), other)
