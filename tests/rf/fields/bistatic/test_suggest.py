"""Where to measure next, and fields of no measurement."""

from dataclasses import replace

import furnished
import numpy as np
import pytest
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined

import warprrf as wr
from warprrf.rf.em.materials import assumed_permittivity, itu_material
from warprrf.rf.fields.bistatic.suggest import Unknowns

CARRIER_HZ = 300e9
TX = np.array([1.0, 2.0, 2.4])
WEST = np.array([[1.2, 0.7, 1.2], [1.4, 3.2, 1.5], [1.2, 0.7, 1.21], [2.0, 1.0, 0.9]])
EAST = np.array([[4.2, 0.8, 1.2], [4.6, 3.3, 1.5]])
CANDIDATES = np.concatenate([WEST, EAST])


@pytest.fixture(scope="module")
def scene():
    """Two halves of a room, with a gap at the end of the wall between them."""
    mesh, part = joined(
        box_mesh([0, 0, 0], [6, 4, 3], inward=True), box_mesh([2.9, -0.01, -0.01], [3.1, 3.0, 3.01])
    )
    return RadioScene(
        mesh, part, [SlabMaterial("walls", 4.0, 0.5, np.inf, 0.7), SlabMaterial("block", 6.0, 0.5)]
    )


def spectra(scene, places):
    return furnished.spectra(scene, places, transmitter=TX, sub_pixels=2)


@pytest.fixture(scope="module")
def unmeasured(scene):
    return wr.RadioField.fit(scene, spectra(scene, CANDIDATES[:2]).subset([]))


def test_no_spectra_at_all_are_a_field_and_one_is_a_better_one(scene, unmeasured):
    ds = spectra(scene, CANDIDATES)
    assert unmeasured.report["receivers"] == 0 and len(unmeasured.fitted_on) == 0
    found = [
        wr.evaluate(ds.subset([1, 3, 5]), field.spectrum)["psnr_db"]
        for field in (unmeasured, wr.RadioField.fit(scene, ds.subset([0]), quick=True))
    ]
    assert found[0] + 1.0 < found[1]


def test_an_empty_data_set_is_enough_to_start(scene):
    nothing = wr.SpectrumDataset.empty(transmitter=TX, frequency_hz=CARRIER_HZ, shape=(24, 48))
    field = wr.RadioField.fit(scene, nothing)
    # 60 dB below free space over ten metres
    assert nothing.floor == pytest.approx(1e-6 * (299792458.0 / CARRIER_HZ / (4 * np.pi * 10.0)) ** 2)
    assert field.spectrum(EAST[0]).path_gain.sum() > 0 and field.shape == (24, 48)
    power = wr.Readings(TX, EAST[:1], np.array([1e-9]), CARRIER_HZ, 1e-14)
    both = wr.RadioField.fit(scene, [nothing, power], quick=True)
    assert both.shape == (24, 48) and both.floor == nothing.floor and np.array_equal(both.fitted_on, EAST[:1])
    with pytest.raises(ValueError, match=r"transmitter.*outside the scene"):
        wr.RadioField.fit(scene, wr.SpectrumDataset.empty(transmitter=[9, 9, 9], frequency_hz=CARRIER_HZ))
    with pytest.raises(ValueError, match="receivers: got none"):
        wr.RadioField.fit(scene.mesh, nothing, model="rf3dgs+")


def test_permittivities_before_any_measurement_are_those_of_p2040():
    # ITU-R P.2040-4, table 3, glass at 300 GHz: 5.79 - 0.0004 * 300^1.658 / (2 pi 300e9 eps_0) j
    assert assumed_permittivity("mat-itu_glass.001", CARRIER_HZ) == pytest.approx(5.79, abs=0.02)
    assert assumed_permittivity("group_3", CARRIER_HZ) == assumed_permittivity("anything", CARRIER_HZ)
    assert 2.5 < assumed_permittivity("group_3", CARRIER_HZ) < 4.0
    assert assumed_permittivity("metal", CARRIER_HZ) > 1e4


def test_both_sides_of_a_wall_are_measured_before_a_place_again(unmeasured):
    chosen = set(unmeasured.suggest(CANDIDATES, 3).tolist())
    assert chosen & {4, 5} and chosen & {0, 1, 2, 3} and not chosen >= {0, 2}


def test_the_order_of_candidates_does_not_matter(unmeasured):
    turned = np.array([3, 5, 0, 4, 1, 2])
    assert (
        turned[unmeasured.suggest(CANDIDATES[turned], 3)].tolist()
        == unmeasured.suggest(CANDIDATES, 3).tolist()
    )


def test_what_was_measured_is_not_measured_again(scene, unmeasured):
    first = int(unmeasured.suggest(CANDIDATES)[0])
    field = wr.RadioField.fit(scene, spectra(scene, CANDIDATES).subset([first]), quick=True)
    assert field.suggest(CANDIDATES)[0] != first


def test_what_was_measured_under_another_transmitter_tells_what_that_one_lights(unmeasured):
    other, place = EAST[:1] + [0.3, 0.2, 0.9], WEST[3:4]
    field = replace(unmeasured, fitted_on=place, fitted_under=other)
    moved = replace(unmeasured, fitted_on=place, transmitter=other[0])
    alike = replace(unmeasured, fitted_on=place, fitted_under=TX[None])
    np.testing.assert_array_equal(field.gain_std_db(), moved.gain_std_db())
    np.testing.assert_array_equal(alike.gain_std_db(), replace(unmeasured, fitted_on=place).gain_std_db())
    assert np.abs(field.gain_std_db() - alike.gain_std_db()).max() > 0.5
    candidates = np.concatenate([WEST[1:], WEST[3:]])  # the last two are one
    assert alike.suggest(candidates)[0] not in (2, 3) and field.suggest(candidates)[0] in (2, 3)


def test_a_horn_is_not_pointed_twice_at_one_place(unmeasured):
    angles = np.column_stack([np.full(6, np.pi / 2), [0.0, 0.0, 0.01, 2.0, 2.01, -2.0]])
    place = np.tile(WEST[0], (6, 1))
    chosen = unmeasured.suggest(place, 3, arrival=angles, receive_pattern=wr.horn(np.radians(10.0)))
    assert len({(0, 0, 0, 1, 1, 2)[k] for k in chosen}) == 3
    with pytest.raises(ValueError, match="receive_pattern: it goes with arrival"):
        unmeasured.suggest(place, 3, arrival=angles)


def test_variances_are_those_of_the_joint_posterior():
    rng = np.random.default_rng(0)
    material = np.array([0, 0, 0, 1, 1])
    unknowns = Unknowns(material, np.array([1.0, 0.3]), np.array([0.5, 0.5, 0.2, 0.3, 0.3]))
    precision = np.array([0.0, 3.0, 0.7, 1.2, 0.0])
    prior = np.diag(unknowns.own**2) + np.where(
        material[:, None] == material, np.outer(*2 * [unknowns.shared[material]]), 0.0
    )
    posterior = np.linalg.inv(np.linalg.inv(prior) + np.diag(precision))
    assert unknowns.variance(precision) == pytest.approx(np.diag(posterior))
    assert (unknowns.variance(precision + rng.random(5)) < unknowns.variance(precision)).all()


@pytest.mark.parametrize("swapped", [False, True])
def test_what_passes_a_slab_tells_nothing_of_how_the_slab_mirrors(swapped):
    """Line of sight through a pane is due to no mirror; the floor's mirror is the floor's, before or behind the pane."""
    floor = np.array([[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    pane = np.array([[1, -6, 0.001], [1, 6, 0.001], [1, 6, 6], [1, -6, 6]]), np.array([[0, 1, 2], [0, 2, 3]])
    mesh, part = joined(floor, pane)
    scene = wr.Scene(mesh, [itu_material("concrete"), itu_material("glass", thickness_m=0.01)], part)
    ends = np.array([[-2.0, 0.0, 1.5], [2.0, 0.4, 1.2]])[:: -1 if swapped else 1]
    effects = wr.Effects(mirrors=1, transmissions=1, diffractions=0)
    nothing = wr.SpectrumDataset.empty(transmitter=ends[0], frequency_hz=28e9, shape=(24, 48))
    field = wr.RadioField.fit(scene, nothing, effects=effects)
    sensitivity, _ = field._sensitivity()
    paths = sensitivity.tracer.view(ends[1], effects).paths
    assert (paths.slab >= 0).any(axis=1).all() and sorted(paths.order) == [0, 1]
    table, _ = sensitivity.powers(ends[1])
    by_mirror = np.asarray(table.sum(axis=0)).ravel()[-field.surface.groups :]
    assert np.flatnonzero(by_mirror).tolist() == [field.surface.group[0]]
