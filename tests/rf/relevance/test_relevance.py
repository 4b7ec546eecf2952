"""What a scene needs: choices that physics dictates, order among tolerances, and a fit that obeys."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, ROOM, SHAPE, SIGMA, TX, F, furnished, spectra
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined

from warprrf.rf.em.absorption import gas_attenuation_db_per_m
from warprrf.rf.em.materials import Band, Material, roughness_scattering
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.relevance.model import full_field, material_parameters, with_lobes
from warprrf.rf.relevance.search import Relevance, choose, full_model, relevance
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.tracing.model import SETS, Effects

RECEIVERS = RECEIVERS[:4]
NOTHING = Material(  # reflects nothing: as good as empty space
    "nothing", (Band(1e9, 1e12, 1.0, 0.0, 0.0, 0.0, "made up"),), thickness_m=np.inf, scattering=0.0
)
OPTIONS = {"transmitter": TX, "frequency_hz": F, "shape": SHAPE, "beam_sigma_rad": SIGMA}


def plated(material):
    """An empty room but for a plate of one material on the floor."""
    mesh, part = joined(ROOM, box_mesh([0.2, 0.2, 0.01], [4.8, 3.8, 0.05]))
    return RadioScene(mesh, part, [NOTHING, material])


def metal(roughness_m):
    return replace(
        Material.conductor(pattern="directive", alpha_r=4), scattering=roughness_scattering(roughness_m, F)
    )


def at_each(tolerances_db, geometry, receivers=RECEIVERS):
    """What is kept within each tolerance."""
    found = full_model(geometry, receivers, progress=lambda *_: None, **OPTIONS)
    return [choose(*found, tolerance) for tolerance in tolerances_db]


@pytest.fixture(scope="module")
def slabs():
    walls = SlabMaterial("walls", 3.0, 0.5, 0.1, 0.5, "directive", 4)
    return furnished(walls, SlabMaterial("box", 6.0, 0.5, 0.1, 0.8))


@pytest.fixture(scope="module")
def data(slabs):
    return spectra(slabs, RECEIVERS, sub_pixels=4)


@pytest.fixture(scope="module")
def several(slabs):
    return at_each((1e-6, 0.1, 0.5, 2.0, 1000.0), slabs)


def test_an_empty_room_has_line_of_sight_and_nothing_else():
    found = relevance(furnished(NOTHING, NOTHING), receivers=RECEIVERS[1:2], **OPTIONS)
    assert [name for name in found.kept if name not in ("diffraction", "transmission")] == ["line_of_sight"]
    assert found.model.mirrors == 0
    assert not found.model.scatterings
    assert found["line_of_sight"].total_db > 10


def test_a_smooth_plate_is_a_mirror_and_a_rough_one_scatters():
    seen = RECEIVERS[:1]
    smooth = relevance(plated(metal(1e-7)), receivers=seen, **OPTIONS)
    assert smooth.model.mirrors == 1
    assert not smooth.model.scatterings
    rough = relevance(plated(metal(1e-3)), receivers=seen, **OPTIONS)
    assert rough.model.mirrors == 0
    assert rough.model.scatterings
    assert rough["scatterings_1"].worth_db > 1 > 0.1 > rough["mirrors_1"].worth_db


def test_the_worth_of_a_mirror_is_its_power():
    """Line of sight and one mirror image over a metal floor: the total falls by 10 log10(1 + (d / d')^2)."""
    receiver = np.array([4.0, 3.0, 1.0])
    plate = plated(metal(0.0))
    found = relevance(plate, receivers=receiver, **OPTIONS, gas_db_per_m=0.0)
    image = TX * [1, 1, -1] + [0, 0, 2 * 0.05]
    ratio = (np.linalg.norm(TX - receiver) / np.linalg.norm(image - receiver)) ** 2
    # A half-space of permittivity 201, scaled, stands for metal: a few percent over the angle of incidence.
    assert found["mirrors_1"].total_db == pytest.approx(10 * np.log10(1 + ratio), abs=0.1)


def test_lambertian_materials_leave_one_lobe():
    scene = furnished(SlabMaterial("a", 4.0, 0.5, 0.1, 0.7), SlabMaterial("b", 3.0, 0.5, 0.1, 0.9))
    assert relevance(scene, receivers=RECEIVERS[:1], **OPTIONS).lobes == (0,)


def test_a_lobe_that_hardly_differs_is_replaced_and_power_is_kept():
    scene = furnished(
        SlabMaterial("a", 4.0, 0.5, 0.1, 0.7, "directive", 5),
        SlabMaterial("b", 4.0, 0.5, 0.1, 0.7, "directive", 6),
    )
    strict, loose = at_each((1e-4, 1.0), scene, RECEIVERS[:1])
    assert strict.lobes == (5, 6)
    assert len(loose.lobes) == 1
    p = material_parameters(scene.materials, F)
    moved = with_lobes(p, (5,))
    np.testing.assert_allclose(moved.weight.sum(axis=1), p.weight.sum(axis=1))
    assert moved.lobes == (5,)
    third = SlabMaterial("c", 4.0, 0.5, 0.1, 0.7)
    mixed = with_lobes(material_parameters([*scene.materials, third], F), (0, 6))
    assert 0 < mixed.weight[0, 0] < mixed.weight[0, 1]  # exponent 5 is nearer to 6 than to Lambertian


def test_what_a_field_learned_under_its_transmitter_is_not_judged_under_another(slabs, data):
    field = BistaticField.prior(slabs, data, effects=SETS["room"])
    field = replace(field, residual=np.full_like(field.residual, np.log(4.0)))
    for source in (TX, np.array([4.0, 0.7, 2.3])):
        full, _ = full_model(field, RECEIVERS[:1], progress=lambda *_: None, transmitter=source)
        expected = replace(field, effects=full.field.effects).spectrum(RECEIVERS[:1], source).path_gain
        np.testing.assert_allclose(full.image(full.all - {"gas"}), expected, rtol=1e-5)


def test_gas_matters_over_a_kilometre_and_not_over_ten_metres():
    def air(length):
        """Two boxes as far apart as that, of nothing: only the air between them counts."""
        mesh, part = joined(
            box_mesh([0, 0, 0], [0.5, 0.5, 0.5]), box_mesh([length - 0.5, 7, 7], [length, 8, 8])
        )
        scene = RadioScene(mesh, np.zeros_like(part), [NOTHING])
        ends = {"transmitter": [0.5, 4, 4], "receivers": [[length - 0.5, 4, 4]]}
        return relevance(scene, **{**OPTIONS, **ends, "shape": (12, 24)})

    short, long = air(11.0), air(1001.0)
    assert short["gas"].kept is False
    assert short["gas"].total_db == pytest.approx(10 * gas_attenuation_db_per_m(F), rel=1e-3)
    assert long["gas"].kept
    assert "gas" in long.kept
    assert long["gas"].total_db == pytest.approx(1000 * gas_attenuation_db_per_m(F), rel=1e-3)


@pytest.mark.parametrize("gas_db_per_m", [-1.0, np.nan])
def test_air_that_is_no_absorber_is_refused(slabs, gas_db_per_m):
    with pytest.raises(ValueError, match="gas_db_per_m: got"):
        relevance(slabs, receivers=RECEIVERS, gas_db_per_m=gas_db_per_m, **OPTIONS)


def test_a_larger_tolerance_never_keeps_more(several):
    for tight, loose in zip(several[:-1], several[1:], strict=True):
        assert set(loose.kept) <= set(tight.kept)
    assert len(several[0].kept) > len(several[2].kept) > len(several[-1].kept)
    assert several[-1].kept == ()


def test_the_choice_stays_within_its_tolerance(slabs, several):
    """Checked on spectra made anew, not on what the choice was made with."""
    full = full_field(slabs, SpectrumDataset.empty(**OPTIONS))[0]
    for found in several[1:4]:
        assert max(found.image_db, found.total_db) <= found.tolerance_db
        smallest = with_lobes(full.parameters, found.lobes)
        reduced, change = replace(full, effects=found.model, parameters=smallest, errors=None), []
        for receiver in RECEIVERS:
            then, now = (10 * np.log10(f.spectrum(receiver).total_path_gain) for f in (full, reduced))
            change.append(now - then)
        assert np.sqrt(np.mean(np.square(change))) <= found.tolerance_db + several[1]["gas"].total_db


def test_blocked_receivers_have_no_line_of_sight_to_lose(several):
    found = several[1]
    assert found.blocked == 1
    assert found["line_of_sight"].image_blocked_db == 0.0
    assert found["line_of_sight"].total_db > 1
    assert found["diffraction"].total_db < found["diffraction"].total_blocked_db


def test_table_and_file_say_the_same(several, tmp_path):
    found = several[1]
    table = found.table()
    assert table.count("\n| ") == len(found.effects) + 1
    assert "| mirrors, order 1 |" in table
    found.save(tmp_path / "r.json")
    assert Relevance.load(tmp_path / "r.json") == found
    text = (tmp_path / "r.json").read_text()
    (tmp_path / "r.json").write_text(text.replace('"tolerance_db": 0', '"tolerance_db": 1'))
    with pytest.raises(ValueError, match=r"r\.json"):  # not what was saved
        Relevance.load(tmp_path / "r.json")


def test_a_bare_mesh_assumes_materials_and_leaves_lobes_to_the_fit(slabs):
    found = relevance(slabs.mesh, receivers=RECEIVERS[:2], **OPTIONS)
    assert found.materials == "assumed"
    assert found["lobes"].kept is None
    assert found.needs(F)[1] is None
    assert "assumed" in found.table()


def test_a_fit_leaves_out_what_is_ruled_out(slabs, data):
    ruled = relevance(plated(metal(1e-7)), receivers=RECEIVERS[:1], **OPTIONS)
    field = RadioField.fit(slabs, data, relevance=ruled)
    assert isinstance(field, BistaticField)
    assert field.effects == replace(ruled.model, residual=field.effects.residual)
    assert field.effects.mirrors == 1 and not field.effects.scatterings
    given = RadioField.fit(slabs, data, relevance=ruled, effects=Effects(mirrors=0))
    assert given.effects == Effects(mirrors=0)  # what the caller says counts for more
    with pytest.raises(ValueError, match="relevance"):
        RadioField.fit(slabs, replace(data, frequency_hz=140e9), relevance=ruled)


def test_a_fitted_field_is_judged_by_its_parameters(slabs, data):
    field = RadioField.fit(slabs, data, effects=SETS["single"])
    found = relevance(field, receivers=RECEIVERS, tolerance_db=0.5)
    assert found.materials == "fit"
    assert found.floor == field.floor
    assert found["residual"].image_db > 0
    assert set(found.lobes) <= set(field.parameters.lobes)
    with pytest.raises(ValueError, match="frequency_hz"):
        relevance(field, receivers=RECEIVERS, frequency_hz=140e9)


def test_a_fit_passes_slabs_and_goes_over_edges_where_that_was_found_relevant(slabs, data):
    found = relevance(slabs, receivers=RECEIVERS[:1], **OPTIONS)
    field = RadioField.fit(slabs, data, relevance=replace(found, model=Effects(transmissions=2)))
    assert (field.effects.transmissions, field.effects.diffractions) == (2, 1)
