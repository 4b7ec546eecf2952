"""Gas attenuation against the values that ITU-R publishes for validating P.676, and what air must do."""

import numpy as np

from warprrf.rf.em.absorption import gas_attenuation_db_per_m

# f [GHz], oxygen and water vapour [dB/km] at 288.15 K, 1013.25 hPa of dry air, 7.5 g/m^3: validation examples of
# P.676-13 (ITU-R Study Group 3), and beyond 130 GHz of P.676-12, whose lines are the same.
PUBLISHED = np.array(
    [
        [12, 0.00869826406877357, 0.00953538822024593],
        [20, 0.0118835504778076, 0.0970473048151117],
        [60, 14.6234747964861, 0.154841841],
        [90, 0.0388697110724235, 0.341973394],
        [130, 0.0415090835995228, 0.751844704],
        [140, 0.01906005, 0.90412935],
        [183, 0.012733909, 27.66500831],
        [220, 0.015443603, 2.471370748],
        [300, 0.025759576, 5.221329041],
        [325, 0.030098959, 37.86211053],
        [350, 0.036805627, 10.12267314],
    ]
)


def test_published_values_are_met():
    frequency, expected = PUBLISHED[:, 0] * 1e9, PUBLISHED[:, 1:].sum(axis=1)
    np.testing.assert_allclose(1e3 * gas_attenuation_db_per_m(frequency), expected, rtol=1e-6)


def test_one_frequency_gives_a_float_and_several_their_shape():
    assert isinstance(gas_attenuation_db_per_m(300e9), float)
    assert gas_attenuation_db_per_m(np.full((2, 3), 300e9)).shape == (2, 3)


def test_dry_air_and_vapour_alone_lose_less_and_vacuum_nothing():
    both = gas_attenuation_db_per_m(300e9)
    dry = gas_attenuation_db_per_m(300e9, water_vapour_g_m3=0.0)
    assert 0 < dry < 0.1 * both  # vapour rules at 300 GHz
    assert gas_attenuation_db_per_m(300e9, water_vapour_g_m3=15.0) > 1.9 * both
    assert gas_attenuation_db_per_m(300e9, pressure_hpa=0.0, water_vapour_g_m3=0.0) == 0.0
    # Thin air narrows the lines: less between them, as much at 325.153 GHz and more right there for the same vapour.
    assert gas_attenuation_db_per_m(300e9, pressure_hpa=500.0) < both
    line = gas_attenuation_db_per_m(325.152888e9)
    assert gas_attenuation_db_per_m(325.152888e9, pressure_hpa=500.0) > 1.5 * line
