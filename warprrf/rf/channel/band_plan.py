"""Channel plan of IEEE Std 802.15.3d-2017, 252.72 to 321.84 GHz, as data.

69 channels of eight bandwidths, all multiples of 2.16 GHz, numbered by bandwidth and, within one, from 252.72 GHz
upwards without gaps: 1 to 32 (2.16 GHz), 33 to 48 (4.32), 49 to 56 (8.64), 57 to 61 (12.96), 62 to 65 (17.28), 66 and
67 (25.92), 68 (51.84), 69 (69.12). The numbering agrees with the channels named in published transceivers: 13 to 23, 39
to 43, 52, 53 and 59 above 278.64 GHz (I. Abdo et al., "A 300 GHz wireless transceiver in 65 nm CMOS for IEEE802.15.3d",
IEEE IMS 2019), 49 to 51 and 66 below it (S. Lee et al., IEEE JSSC 54(12), 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.checks import Count, checked


@checked
@dataclass(frozen=True)
class ThzChannel:
    """A channel of IEEE Std 802.15.3d-2017.

    Attributes:
        number: CHNL_ID, 1 to 69.
        low_hz: Lower edge [Hz].
        high_hz: Upper edge [Hz].
    """

    number: int
    low_hz: float
    high_hz: float

    @property
    def bandwidth_hz(self) -> float:
        """Bandwidth [Hz]."""
        return self.high_hz - self.low_hz

    @property
    def center_hz(self) -> float:
        """Centre frequency [Hz]."""
        return 0.5 * (self.low_hz + self.high_hz)

    def frequencies_hz(self, count: Count) -> np.ndarray:
        """``count`` equally spaced frequencies [Hz], the middles of as many equal parts of the channel.

        Raises:
            ValueError: if ``count`` is not a whole number of at least 1.
        """
        return self.low_hz + (np.arange(count) + 0.5) * (self.bandwidth_hz / count)


def _plan() -> dict[int, ThzChannel]:
    plan: dict[int, ThzChannel] = {}
    for units in (1, 2, 4, 6, 8, 12, 24, 32):  # bandwidths in 2.16 GHz, in the order of the numbering
        for k in range(32 // units):
            number = len(plan) + 1
            # In steps of 10 MHz, so that edges are those of the standard to the last bit.
            low, high = (25272 + 216 * units * (k + end) for end in (0, 1))
            plan[number] = ThzChannel(number, low * 1e7, high * 1e7)
    return plan


THZ_CHANNELS: dict[int, ThzChannel] = _plan()
"""All channels by number."""


@checked
def thz_channel(number: int) -> ThzChannel:
    """The channel of CHNL_ID ``number``.

    Raises:
        ValueError: if there is none.
    """
    if number not in THZ_CHANNELS:
        raise ValueError(f"number: got {number!r}, expected a CHNL_ID of IEEE Std 802.15.3d-2017, 1 to 69")
    return THZ_CHANNELS[number]
