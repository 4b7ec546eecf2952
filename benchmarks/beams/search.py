"""Beam search with pilots: hierarchical, over ever larger parts of the array, with noise on every pilot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.beams.links import OVERSAMPLING, Ends
from warprrf.rf.channel.arrays import PlanarArray


class Found(NamedTuple):
    """Beams that a search ended at, and the pilots that it sent."""

    tx: int
    rx: int
    pilots: int


def hierarchical(between: Ends, channel: np.ndarray, pilot_snr: float, rng: np.random.Generator) -> Found:
    """Halve directions in both axes at a time: the middle 2 x 2 elements first, then 4 x 4, up to all.

    A level sends four pilots and keeps the strongest beam; its four quarters are beams of the next. Once all elements
    are active, the levels of an oversampled codebook follow. The receiver searches first, while the transmitter sends
    from one element; then the transmitter, to the beam that was found.

    Args:
        channel: Between elements at some frequencies, shape ``(F, M, N)``; a pilot spans them all.
        pilot_snr: Signal to noise of a pilot, after correlation, per unit of gain [linear].
        rng: Of the noise.
    """
    middle = _middle(between.tx)
    rx, first = _descend(between.rx, channel[:, :, middle], pilot_snr, rng)
    toward = np.einsum("m,fmn->fn", between.rx_book.beam(rx), channel)
    tx, second = _descend(between.tx, toward, pilot_snr, rng)
    return Found(tx, rx, first + second)


def _descend(
    array: PlanarArray, h: np.ndarray, pilot_snr: float, rng: np.random.Generator
) -> tuple[int, int]:
    """Beam of a square array with 2^k elements a side, and the pilots it took."""
    side = array.rows
    if array.cols != side or side & (side - 1):
        raise ValueError(f"array: got {side} x {array.cols}, expected a square with 2^k elements a side")
    grid = h.reshape(len(h), side, side)
    across = down = pilots = 0
    beams = 1
    while beams < (OVERSAMPLING * side if side > 1 else 1):
        beams *= 2
        active = min(beams, side)
        start = (side - active) // 2
        part = grid[:, start : start + active, start : start + active]
        options = [(2 * across + a, 2 * down + b) for a in (0, 1) for b in (0, 1)]
        heard = np.array([_beam(beams, a, active) @ part @ _beam(beams, b, active) for a, b in options])
        # Each frequency is a share of the pilot's symbols.
        noise = rng.normal(size=(*heard.shape, 2)) @ [1.0, 1j] / np.sqrt(2.0)
        seen = np.abs(np.sqrt(pilot_snr / len(h)) * heard + noise) ** 2
        across, down = options[int(seen.sum(axis=1).argmax())]
        pilots += 4
    return across * max(beams, 1) + down, pilots


def _beam(beams: int, k: int, active: int) -> np.ndarray:
    """Beam k of ``beams`` of a line of ``active`` elements, as :func:`warprrf.rf.channel.beams.dft_codebook` has it."""
    frequency = (k + 0.5) / beams - 0.5
    return np.exp(-2j * np.pi * frequency * (np.arange(active) - 0.5 * (active - 1))) / np.sqrt(active)


def _middle(array: PlanarArray) -> int:
    return (array.cols // 2) * array.rows + array.rows // 2
