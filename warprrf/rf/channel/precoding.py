"""Precoders of several users served at once, made from what a field predicts: maximum ratio, zero forcing, SLNR.

One transmitting array of N elements sends to U users, each with one port: a single element, or the beam that it steers.
User u receives h_u^T w_v of what is sent to user v with weights w_v. All weights have unit norm, the transmitted power
is shared equally, and ``noise`` is a user's noise power over the whole transmitted power, as in
:func:`warprrf.rf.channel.beams.select_beams_multiuser`:

    SINR_u = |h_u^T w_u|^2 / (sum over v != u of |h_u^T w_v|^2 + U noise).

A field knows where power goes, not at which phase, so what it predicts of a user is the mean of h* h^T over independent
phases of its paths, the covariance R_u = sum over paths of power a* a^T, a the array's response to the departure. A
known channel is the covariance of rank one:

- ``"mr"``, maximum ratio: the largest eigenvector of R_u; conj(h) / |h|.
- ``"zf"``, zero forcing: the weights nearest to it that send nothing along the largest eigenvectors of the others; the
  columns of H^H (H H^H)^-1 (Spencer, Swindlehurst and Haardt, IEEE Trans. Signal Processing 52 (2004)).
- ``"slnr"``: the most signal over leakage and noise, w^H R_u w / w^H (sum over v != u of R_v + U noise I) w: a
  generalised eigenvector (Sadek, Tarighat and Sayed, IEEE Trans. Wireless Communications 6 (2007)). For known channels
  these are the columns of H^H (H H^H + U noise I)^-1, regularised zero forcing or the MMSE precoder (Peel, Hochwald and
  Swindlehurst, IEEE Trans. Communications 53 (2005)), each scaled to unit norm.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from warprrf.checks import check_array, checked, one_of
from warprrf.rf.channel.beams import Ends, Noise, Source, chunks, codebook_of, rays_of_users, squared


@checked
def transmit_covariance(
    sources: Source | Iterable[Source], tx_array: Ends, rx_array: Ends = None, *, rx: ArrayLike | None = None
) -> np.ndarray:
    """Mean of h* h^T of every user over independent phases of its paths, shape ``(U, N, N)``, complex.

    It takes 16 U N^2 bytes: 4 MB for four users of 256 elements.

    Args:
        sources: A sequence of spectra or paths, one a user, or those of several receivers; a single one is one user.
        tx_array: Transmitting :class:`PlanarArray`, or a :class:`Codebook`, whose array counts.
        rx_array: The users' array or codebook; a single isotropic element by default.
        rx: Index of the beam that each user receives with, shape ``(U,)``; needed where there are several.

    Raises:
        TypeError, ValueError: as for :func:`~warprrf.rf.channel.beams.select_beams`; for beams that do not fit the
            users.
    """
    sending, book = codebook_of("tx_array", tx_array), codebook_of("rx_array", rx_array)
    tx, rays = sending.array, rays_of_users(sources, sending)
    beams = np.zeros(len(rays), int) if rx is None and len(book) == 1 else np.asarray(rx)
    if beams.shape != (len(rays),) or beams.dtype.kind not in "iu":
        raise ValueError(f"rx: got {rx!r}, expected the index of a beam for each of {len(rays)} users")
    if ((beams < 0) | (beams >= len(book))).any():
        raise ValueError(f"rx: got {beams.tolist()}, expected beams 0 to {len(book) - 1}")
    found = np.zeros((len(rays), tx.elements, tx.elements), dtype=complex)
    for total, (departure, arrival, power), own in zip(found, rays, book.weights[beams], strict=True):
        for part in chunks(len(power), tx.elements):
            toward = arrival[part]
            received = squared(book.array.response(toward, 1.0) @ own) * book.array.gain(toward)
            away = departure[part]
            transmitted = tx.response(away, 1.0) * np.sqrt(received * power[part] * tx.gain(away))[:, None]
            total += transmitted.conj().T @ transmitted
    return found


@checked
def precoders(
    channels: ArrayLike, method: Annotated[str, one_of("mr", "zf", "slnr")] = "slnr", *, noise: Noise
) -> np.ndarray:
    """Weights that serve all users at once, unit norm each, shape ``(U, N)``, complex: user u is sent ``weights[u]``.

    Args:
        channels: Known channels h, shape ``(U, N)``, or covariances, shape ``(U, N, N)``.
        method: "mr", "zf" or "slnr": see the module.
        noise: Noise power of a user over the total transmitted power [linear]; "slnr" alone minds it.

    Raises:
        ValueError: naming the argument; for a user without power, and for "zf" with more users than elements or users
            whose channels are linearly dependent.
    """
    h = _checked(channels)
    if h.ndim == 2:
        if method == "slnr":
            left, size, right = np.linalg.svd(h.conj(), full_matrices=False)
            size = np.where(size > 1e-14 * size[0], size, 0.0)  # what is smaller is rounding
            return _unit(left * (size / (size**2 + len(h) * noise)) @ right)
        best = _unit(h.conj())
    elif method == "slnr":
        return _leakage(h, len(h) * noise)
    else:
        last = h.shape[1] - 1
        best = np.stack([eigh(r, subset_by_index=(last, last))[1][:, 0] for r in h])
    return _apart(best) if method == "zf" else best


@checked
def precoded_sinr(channels: ArrayLike, weights: ArrayLike, *, noise: Noise) -> np.ndarray:
    """SINR of every user [linear], shape ``(U,)``, the power shared equally.

    Args:
        channels: What they really get: channels ``(U, N)``, or covariances ``(U, N, N)``, of which mean powers count.
        weights: Of :func:`precoders`, shape ``(U, N)``; scaled to unit norm here.
        noise: As there.

    Raises:
        ValueError: naming the argument.
    """
    h = _checked(channels, allow_dark=True)
    w = np.asarray(weights, dtype=complex)
    if w.shape != h.shape[:2] or not (np.isfinite(w).all() and w.any(axis=1).all()):
        raise ValueError(f"weights: got shape {w.shape}, expected finite ones {h.shape[:2]}, none zero")
    w = _unit(w)
    if h.ndim == 2:
        heard = squared(h @ w.T)
    else:
        heard = np.einsum("vn,unm,vm->uv", w.conj(), h, w, optimize=True).real
    signal = np.diag(heard)
    return signal / (heard.sum(axis=1) - signal + noise * len(h))


def _leakage(covariances: np.ndarray, floor: float) -> np.ndarray:
    """Largest generalised eigenvector of each covariance and the sum of the others, ``floor`` on its diagonal."""
    count, size = covariances.shape[:2]
    everything = covariances.sum(axis=0)
    # Below rounding of what leaks the matrix of leakage is singular; noise so far down changes nothing.
    floor = max(floor, 1e-13 * float(np.abs(everything).max()))
    found = np.empty((count, size), dtype=complex)
    for u, own in enumerate(covariances):
        leaked = everything - own + floor * np.eye(size)
        found[u] = eigh(own, leaked, subset_by_index=(size - 1, size - 1))[1][:, 0]
    return _unit(found)


def _apart(best: np.ndarray) -> np.ndarray:
    """The unit vectors nearest to ``best`` (U, N), each orthogonal to all the others."""
    users, size = best.shape
    left, singular, right = np.linalg.svd(best.conj(), full_matrices=False)
    least_apart = 1e-9  # least singular value, over the largest, of users that can still be parted
    if users > size or singular[-1] < least_apart * singular[0]:
        rank = int((singular >= least_apart * singular[0]).sum())
        raise ValueError(
            f"method: 'zf' cannot part {users} users by {size} elements, whose channels have rank {rank}; expected "
            "linearly independent ones, or method 'slnr'"
        )
    return _unit((right.conj().T / singular @ left.conj().T).T)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _checked(channels: ArrayLike, allow_dark: bool = False) -> np.ndarray:
    h = check_array("channels", channels, dtype=complex)
    if h.ndim not in (2, 3) or 0 in h.shape or (h.ndim == 3 and h.shape[1] != h.shape[2]):
        raise ValueError(f"channels: got shape {h.shape}, expected channels (U, N) or covariances (U, N, N)")
    if h.ndim == 3:
        size = np.abs(h).max()
        if np.abs(h - np.swapaxes(h.conj(), 1, 2)).max() > 1e-9 * size:
            raise ValueError("channels: got covariances that are not Hermitian")
    dark = np.flatnonzero(~h.reshape(len(h), -1).any(axis=1))
    if len(dark) and not allow_dark:
        raise ValueError(f"channels: users {dark.tolist()} get no power; leave them out")
    return h
