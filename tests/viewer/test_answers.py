"""What the viewer says of a receiver is what the library says."""

import dataclasses

import numpy as np
import pytest
from golden import make

import warprrf as wr
from warprrf.rf.em.absorption import Air
from warprrf.rf.fields.bistatic.suggest import OWN, SHARED
from warprrf.viewer import answers, room
from warprrf.viewer.subject import Subject

RECEIVER = make.TRANSMITTER + [2.0, 0.3, -1.0]


@pytest.fixture(scope="module")
def field():
    return make.bistatic()


def asked(
    source, transmitters=(make.TRANSMITTER,), mirror_order=3, frequency_hz=make.CARRIER_HZ, walls=3, edges=1
):
    wish = answers.Asked(frequency_hz, mirror_order, walls, edges)
    return answers.answer(answers.as_asked(source, wish), RECEIVER, transmitters, wish)


@pytest.mark.parametrize("frequency_hz", [make.CARRIER_HZ, make.CARRIER_HZ + 1e6, 140e9])
def test_an_answer_is_the_fields_own_at_the_carrier_that_is_asked(field, frequency_hz):
    found = asked(field, frequency_hz=frequency_hz)
    # Within a slider's step it is the field's.
    own = field.at_frequency(140e9) if frequency_hz == 140e9 else field
    np.testing.assert_array_equal(found.spectrum.path_gain, own.spectrum(RECEIVER).path_gain)
    np.testing.assert_array_equal(found.paths[0].gain, own.paths(RECEIVER, max_paths=200).gain)
    assert found.total_db == pytest.approx(10 * np.log10(own.spectrum(RECEIVER).total_path_gain))
    assert found.frequency_hz == found.paths[0].frequency_hz == own.frequency_hz


def test_powers_of_two_transmitters_are_added_and_their_strongest_paths_listed_together(field):
    other = make.TRANSMITTER + [0.4, 0.2, -0.2]
    both = asked(field, [make.TRANSMITTER, other])
    wanted = field.spectrum(RECEIVER).path_gain + field.spectrum(RECEIVER, other).path_gain
    np.testing.assert_allclose(both.spectrum.path_gain, wanted, rtol=1e-6)
    listed = answers.strongest(both.paths, 10)
    powers = [p.power[k] for p, k in listed]
    assert powers == sorted(np.concatenate([p.power for p in both.paths]), reverse=True)[:10]
    kind, gain, delay, *_ = answers.described(*listed[0])
    assert kind == "los" and gain == f"{10 * np.log10(powers[0]):.1f} dB"
    length = np.linalg.norm(listed[0][0].transmitter - RECEIVER)
    assert delay == f"{length / 299792458.0 * 1e9:.2f} ns"


def test_fewer_mirrors_on_a_path_mean_fewer_paths(field):
    kinds = [asked(field, mirror_order=k).paths[0].kind for k in range(field.effects.mirrors + 1)]
    mirrors = [int((kind == "mirror").sum()) for kind in kinds]
    assert mirrors[0] == 0 and mirrors == sorted(mirrors) and mirrors[-1] > 0


@pytest.mark.parametrize(("walls", "edges"), [(0, 0), (2, 1)])
def test_paths_through_walls_and_over_edges_are_those_that_are_asked_for(field, walls, edges):
    scene = make.room()
    found = asked(scene, mirror_order=1, walls=walls, edges=edges)
    wanted = wr.trace_paths(
        scene, transmitter=make.TRANSMITTER, receivers=RECEIVER, frequency_hz=make.CARRIER_HZ, mirror_order=1,
        transmissions=walls, diffractions=edges,
    )  # fmt: skip
    np.testing.assert_array_equal(found.paths[0].gain, wanted.gain)
    assert found.spectrum is None
    whole = dataclasses.replace(field, effects=wr.Effects())
    effects = answers.as_asked(whole, answers.Asked(field.frequency_hz, 1, walls, edges)).effects
    assert (effects.mirrors, effects.transmissions, effects.diffractions) == (1, walls, edges)


def test_legs_of_a_path_are_as_long_as_its_delay_says(field):
    paths = asked(field).paths[0]
    for k in range(len(paths.gain)):
        legs = answers.legs(paths, k)
        length = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1).sum()
        assert length == pytest.approx(paths.tau[k] * 299792458.0, rel=1e-6)


def test_a_delay_profile_holds_all_power_and_the_best_beam_gains_what_select_beams_promises(field):
    paths = asked(field).paths
    for bandwidth_hz in (2e9, 40e9):  # 40: as many taps as a hall has at 2 GHz
        _, power_db = answers.delay_profile(paths, bandwidth_hz)
        assert (10 ** (power_db / 10)).sum() == pytest.approx(paths[0].power.sum(), rel=1e-6)
    beam, *_ = answers.best_beam(paths, 4, 0.3)
    choice = wr.channel.select_beams(paths[0], rx_array=wr.PlanarArray(4, 4, orientation=(0.3, 0.0, 0.0)))
    assert beam == pytest.approx(10 * np.log10(choice.gain[0] / paths[0].power.sum()), abs=1e-6)


def test_truth_is_told_only_where_it_was_measured(field):
    ds = make.spectra()
    assert answers.measured_here(ds, ds.receivers[2]) == 2
    assert answers.measured_here(ds, ds.receivers[2] + [0.0, 0.02, 0.0]) is None
    assert answers.measured_here(None, ds.receivers[2]) is None
    wrong = answers.errors(ds[2], ds[2])
    assert wrong["direction_deg"] == pytest.approx(0, abs=0.1)
    assert wrong["total_db"] == 0 and wrong["psnr_db"] > 100


def test_readings_made_of_a_fields_own_paths_have_no_error_but_the_one_put_in(field):
    places = np.array([RECEIVER, RECEIVER + [0.3, 0.1, 0.0]])
    power = np.array([field.paths(place).power.sum() for place in places])
    wrong = np.array([2.0, -3.0])
    readings = wr.Readings(field.transmitter, places, power / 10 ** (wrong / 10), field.frequency_hz, 1e-20)
    np.testing.assert_allclose(answers.reading_errors(field, readings), wrong, atol=1e-6)
    unknown = dataclasses.replace(readings, chain=["a", "a"])
    np.testing.assert_allclose(answers.reading_errors(field, unknown), [2.5, -2.5], atol=1e-6)
    wet = field.with_gas(Air(water_vapour_g_m3=30.0))
    power = np.array([wet.paths(place).power.sum() for place in places])
    damp = dataclasses.replace(readings, power=power, air=wet.air)
    np.testing.assert_allclose(answers.reading_errors(field, damp), 0.0, atol=1e-6)
    quiet = wr.Readings(field.transmitter, places, power, field.frequency_hz, [1e-20, 10 * power[1]])
    assert np.isnan(answers.reading_errors(field, quiet)).tolist() == [False, True]


def test_what_is_learned_of_surfaces_is_shown_on_them(field):
    surface, p = field.surface, field.parameters
    group = surface.group[surface.tiles.face]
    smooth = np.exp(p.log_mirror) / (np.exp(p.log_mirror) + p.weight.sum(axis=1))
    height_m = 1e-3 * room.learned(field, "roughness")
    loss = np.exp(-((4 * np.pi * height_m / field.wavelength_m) ** 2))
    np.testing.assert_allclose(loss, smooth[group], rtol=1e-6)
    gamma = (1 - np.sqrt(1 + np.exp(p.log_excess))) / (1 + np.sqrt(1 + np.exp(p.log_excess)))
    wanted = 10 * np.log10(np.exp(p.log_mirror) * gamma**2)
    np.testing.assert_allclose(room.learned(field, "reflection"), wanted[group], atol=0.05)
    known = field.gain_std_db()
    unmeasured = dataclasses.replace(field, fitted_on=np.zeros((0, 3)), fitted_under=None).gain_std_db()
    prior = 10 / np.log(10) * np.hypot(SHARED[0], OWN[0])
    np.testing.assert_allclose(unmeasured, prior)
    assert (known <= unmeasured).all() and known.min() < 0.5 * prior
    assert room.learned(field, "uncertainty").shape == (len(surface.tiles.face),)


def test_things_are_sorted_by_what_they_are(tmp_path, field):
    ds, (mesh, _) = make.spectra(), make.room_mesh()
    field.save(tmp_path / "field.safetensors")
    ds.save(tmp_path / "spectra.nc")
    found = Subject.of([mesh, tmp_path / "field.safetensors", str(tmp_path / "spectra.nc")])
    assert found.mesh is mesh and found.spectra.receivers.shape == ds.receivers.shape
    np.testing.assert_array_equal(found.transmitter, field.transmitter)
    rec = wr.Reconstruction(None, mesh)
    rec.save(tmp_path / "room")
    field.save(tmp_path / "room" / "field.safetensors")
    both = Subject.of([tmp_path / "room"])
    assert both.field is not None and len(both.mesh.faces) == len(mesh.faces)
    finer = Subject.of([field.on_grid((44, 88)), ds]).field  # compared with the truth on its grid
    assert finer.shape == ds.path_gain.shape[1:]


def test_a_field_of_gaussians_alone_says_where_it_is():
    ds, gaussians = make.spectra().subset([0, 3]), make.gaussians()
    field = wr.RadioField.fit(wr.Reconstruction(gaussians), ds, model="rf3dgs", iterations=1)
    np.testing.assert_array_equal(Subject.of([field]).bounds, Subject.of([gaussians]).bounds)


@pytest.mark.parametrize(
    ("things", "error", "said"),
    [
        ((), TypeError, "got nothing to show"),
        ((3.0,), TypeError, "got float, expected a Reconstruction"),
        (("none/such",), ValueError, "no such file"),
        ((make.room_mesh()[0], make.room_mesh()[0]), ValueError, "two for mesh"),
        ((wr.SpectrumDataset.empty(transmitter=[1, 1, 1], frequency_hz=3e11),), ValueError, "of no receiver"),
    ],
)
def test_what_cannot_be_shown_is_refused(things, error, said):
    with pytest.raises(error, match=said):
        np.asarray(Subject.of(things).bounds)


def test_a_file_of_splats_is_shown_as_gaussians(tmp_path):
    count = 3
    splats = wr.Gaussians(
        np.eye(3), np.tile([1.0, 0, 0, 0], (count, 1)), np.ones((count, 3)), np.full(count, 0.5), np.zeros((count, 1, 3))
    )  # fmt: skip
    splats.save_ply(tmp_path / "splats.PLY")
    found = Subject.of([tmp_path / "splats.PLY"])
    assert found.mesh is None
    np.testing.assert_allclose(found.gaussians.means, np.eye(3))
