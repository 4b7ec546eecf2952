"""The table of ITU-R P.2040 beside Sionna RT's, and materials beyond their bands."""

import numpy as np
import pytest

from warprrf.rf.em.materials import (
    ITU_BANDS,
    WIDEST_HZ,
    Band,
    Material,
    itu_material,
    itu_name,
)


def test_the_table_is_sionnas_row_by_row(rt):
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES as THEIRS

    assert ITU_BANDS.keys() == THEIRS.keys()
    for name, rows in THEIRS.items():
        ours = [((b.low_hz / 1e9, b.high_hz / 1e9), (b.a, b.b, b.c, b.d)) for b in ITU_BANDS[name]]
        np.testing.assert_allclose(
            [np.r_[ends, law] for ends, law in ours], [np.r_[ends, law] for ends, law in rows.items()]
        )
        assert all(b.source.startswith("ITU-R P.2040-") for b in ITU_BANDS[name])


def test_names_and_their_errors():
    assert itu_name("mat-itu_wet_ground") == "wet_ground" and itu_name("concrete.002") == "concrete"
    assert itu_name("mat-cheese") is None
    with pytest.raises(ValueError, match="^itu: got 'cheese'.*plywood"):
        itu_material("cheese")
    with pytest.raises(ValueError, match="^xpd"):
        itu_material("brick", xpd=1.5)


def test_out_of_band_the_error_names_the_nearest_band():
    brick = itu_material("brick")
    with pytest.raises(ValueError, match="'brick'.*60 GHz|60 GHz.*'brick'") as error:
        brick.permittivity(60e9)
    assert "nearest 1 to 40 GHz" in str(error.value)
    with pytest.raises(ValueError, match="nearest 110 to 330 GHz"):
        brick.permittivity(90e9)


@pytest.mark.parametrize("name", sorted(ITU_BANDS))
def test_extrapolated_materials_hold_everywhere_and_are_unchanged_inside(name):
    plain, held = itu_material(name), itu_material(name).extrapolated()
    for frequency in np.geomspace(*WIDEST_HZ, 200):
        if name == "wet_ground" and frequency > 4.9e12:  # its law falls below 1 there
            with pytest.raises(ValueError, match="wet_ground"):
                held.permittivity(frequency)
            continue
        inside = any(b.low_hz <= frequency <= b.high_hz for b in plain.bands)
        if inside:
            assert held.permittivity(frequency) == plain.permittivity(frequency)
        else:
            assert held.band(frequency).source.startswith("extrapolated from")
            assert held.relative_permittivity(frequency) >= 1
    with pytest.raises(ValueError, match="known for"):
        held.permittivity(2e13)


def test_between_bands_each_holds_up_to_the_geometric_mean():
    held = Material("m", (Band(4e9, 10e9, 2, 0, 0, 0), Band(1e9, 2.5e9, 3, 0, 0, 0))).extrapolated()
    middle = np.sqrt(2.5e9 * 4e9)
    assert held.relative_permittivity(middle * 0.999) == 3
    assert held.relative_permittivity(middle * 1.001) == 2
