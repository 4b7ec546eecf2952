"""What arrives over a wide band, and when: impulse responses of transfer functions, their first and their strong arrivals.

A transfer function in a Hann window over the band becomes a response in which a path of gain g peaks at g, half as high
at half the window's width; measured functions and those of traced paths are taken alike. Noise is what comes before any wave can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.fits import rms
from benchmarks.measured.links import db
from benchmarks.report import Row

STEP_NS = 0.01  # of a response: fine beside a pulse of 0.5 ns
CLEAR = (
    4.0  # amplitude of an arrival over the noise: of Rayleigh noise one sample in nine million is as large
)
SIDE_LOBES = 10 ** (
    -28.0 / 20.0
)  # what is weaker than the strongest by more is no arrival: a Hann window's are 31.5 dB down
STRONG_DB = 10.0  # below the strongest arrival
NEAR_NS = 0.5  # within which a traced arrival counts as a measured one: a pulse's width
SHIFTS_NS = (-7.0, -5.0, -3.0, 3.0, 5.0, 7.0)  # by which traced arrivals are moved to count chance hits


@dataclass(frozen=True)
class Response:
    """An impulse response.

    Attributes:
        delay_ns: shape ``(T,)`` [ns].
        amplitude: complex, of a path's gain where it peaks, shape ``(T,)``.
        noise: rms amplitude of the noise.
        bandwidth_ghz: of white noise in the window [GHz].
    """

    delay_ns: np.ndarray
    amplitude: np.ndarray
    noise: float
    bandwidth_ghz: float

    @classmethod
    def of(
        cls, frequency_hz: np.ndarray, transfer: np.ndarray, quiet_ns: float, noise: float | None = None
    ) -> Response:
        """That of a ``transfer`` function (F,) at even frequencies (F,), its noise from before ``quiet_ns`` unless it is given."""
        window, step = np.hanning(len(frequency_hz)), float(frequency_hz[1] - frequency_hz[0])
        size = int(round(1e9 / (step * STEP_NS)))
        amplitude = np.fft.ifft(transfer * window, size) * size / window.sum()
        delay = np.arange(size) * STEP_NS
        if noise is None:
            noise = float(np.sqrt(np.mean(np.abs(amplitude[delay < quiet_ns]) ** 2)))
        width = step * 1e-9 * float(window.sum() ** 2 / (window**2).sum())
        return cls(delay, amplitude, noise, width)

    @property
    def peaks(self) -> np.ndarray:
        """Numbers of the samples at which the envelope peaks clear of noise and side lobes, in the order of time."""
        size = np.abs(self.amplitude)
        least = max(CLEAR * self.noise, SIDE_LOBES * size.max())
        top = (size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:]) & (size[1:-1] > least)
        return np.flatnonzero(top) + 1

    def power(self, start_ns: float, end_ns: float) -> tuple[float, float]:
        """Power of all that arrives between two delays, less the noise, and that noise's power."""
        own = (self.delay_ns >= start_ns) & (self.delay_ns < end_ns)
        # A path's energy in the response is its gain over the bandwidth.
        each = STEP_NS * self.bandwidth_ghz
        noise = self.noise**2 * own.sum() * each
        return float((np.abs(self.amplitude[own]) ** 2).sum() * each - noise), float(noise)

    def noise_of(self, arrival: int) -> tuple[float, float]:
        """What the noise makes of the power [dB] and the delay [ns] of an arrival, one standard deviation each.

        A Hann window over B has a second moment of 0.181 B about its centre, its square one of 0.141 B.
        """
        share = self.noise / np.abs(self.amplitude[arrival]) / np.sqrt(2.0)
        band = self.bandwidth_ghz * 1.5  # the Hann window's noise bandwidth is two thirds of the band
        return 20.0 / np.log(10.0) * share, 0.1414 * share / (2.0 * np.pi * 0.1808**2 * band)


@dataclass(frozen=True)
class Arrivals:
    """First and strong arrivals of a link; NaN and empty if nothing is clear of the noise.

    Attributes:
        first_ns, first_db: delay [ns] and power [dB] of the first.
        strongest_ns, strongest_db: of the strongest.
        strong_ns: delays of those that are within ``STRONG_DB`` of it [ns].
        peaks_ns: delays of all [ns].
    """

    first_ns: float
    first_db: float
    strongest_ns: float
    strongest_db: float
    strong_ns: np.ndarray
    peaks_ns: np.ndarray

    @classmethod
    def of(cls, response: Response) -> Arrivals:
        """Those of a response."""
        peaks = response.peaks
        if not len(peaks):
            return cls(np.nan, np.nan, np.nan, np.nan, np.zeros(0), np.zeros(0))
        power, delay = db(np.abs(response.amplitude[peaks]) ** 2), response.delay_ns[peaks]
        top = int(power.argmax())
        first, strongest = ((float(delay[k]), float(power[k])) for k in (0, top))
        return cls(*first, *strongest, delay[power > power[top] - STRONG_DB], delay)


def compared(measured: Sequence[Arrivals], traced: Sequence[Arrivals], least_db: ArrayLike) -> Row:
    """How far traced arrivals are from measured ones, over the links at which something was measured.

    What was measured and not traced is late for ever, and as strong as ``least_db`` (L,), the least that is clear of the noise.

    Returns:
        ``links``; ``missed`` of them; median error of delay [ns], and of power its rms and mean [dB], of the ``first`` and the
        ``strongest`` arrival; ``met``: share of strong arrivals at which one was traced, ``by_chance``: the same of moved ones.
    """
    own = [k for k, one in enumerate(measured) if np.isfinite(one.first_ns)]
    row: Row = {"links": len(own), "missed": sum(np.isnan(traced[k].first_ns) for k in own)}
    for which in ("first", "strongest"):
        delay, power = (
            np.array([[getattr(side[k], f"{which}_{unit}") for side in (traced, measured)] for k in own])
            for unit in ("ns", "db")
        )
        late = np.where(np.isnan(delay[:, 0]), np.inf, np.abs(delay[:, 0] - delay[:, 1]))
        error = np.where(np.isnan(power[:, 0]), np.asarray(least_db)[own], power[:, 0]) - power[:, 1]
        row |= {
            f"{which}_ns": float(np.median(late)),
            f"{which}_db": rms(error),
            f"{which}_mean_db": float(error.mean()),
        }

    def met(shift_ns: float) -> float:
        gaps = [np.abs(measured[k].strong_ns[:, None] - traced[k].peaks_ns - shift_ns) for k in own]
        return float(np.concatenate([gap.min(axis=1, initial=np.inf) < NEAR_NS for gap in gaps]).mean())

    return row | {"met": met(0.0), "by_chance": float(np.mean([met(shift) for shift in SHIFTS_NS]))}
