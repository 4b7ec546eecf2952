"""The channel plan of IEEE Std 802.15.3d-2017."""

import numpy as np
import pytest

from warprrf.rf.channel.band_plan import THZ_CHANNELS, thz_channel


def test_69_channels_of_eight_bandwidths_lie_in_the_band_side_by_side():
    assert list(THZ_CHANNELS) == list(range(1, 70))
    widths = [c.bandwidth_hz / 1e9 for c in THZ_CHANNELS.values()]
    counts = {2.16: 32, 4.32: 16, 8.64: 8, 12.96: 5, 17.28: 4, 25.92: 2, 51.84: 1, 69.12: 1}
    for width, count in counts.items():
        assert np.isclose(widths, width).sum() == count
    for number, c in THZ_CHANNELS.items():
        assert c.number == number and c.low_hz >= 252.72e9 and c.high_hz <= 321.84e9
        units = (c.low_hz - 252.72e9) / 2.16e9
        assert units == pytest.approx(round(units), abs=1e-6)
        after = THZ_CHANNELS.get(number + 1)
        if after is not None and np.isclose(after.bandwidth_hz, c.bandwidth_hz):
            assert after.low_hz == c.high_hz
    assert (thz_channel(69).low_hz, thz_channel(69).high_hz) == (252.72e9, 321.84e9)


@pytest.mark.parametrize(
    ("first", "last", "width_ghz", "low_ghz"),
    # Abdo et al., IMS 2019: everything from 278.64 GHz on; Lee et al., JSSC 2019: everything up to it, centre 265.68.
    [
        (13, 23, 2.16, 278.64),
        (39, 43, 4.32, 278.64),
        (52, 53, 8.64, 278.64),
        (59, 59, 12.96, 278.64),
        (49, 51, 8.64, 252.72),
    ],
)
def test_channels_named_in_the_literature(first, last, width_ghz, low_ghz):
    assert thz_channel(first).low_hz == pytest.approx(low_ghz * 1e9)
    for number in range(first, last + 1):
        assert thz_channel(number).bandwidth_hz == pytest.approx(width_ghz * 1e9)
    assert thz_channel(66).center_hz == pytest.approx(265.68e9)
    assert thz_channel(51).high_hz == thz_channel(66).high_hz


def test_frequencies_fill_the_channel():
    c = thz_channel(33)
    f = c.frequencies_hz(8)
    assert np.allclose(np.diff(f), c.bandwidth_hz / 8) and f.mean() == pytest.approx(c.center_hz)
