"""Tables of received power: what a reading is, and fits to horns, powers and delays whose chain's gain is not known."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from furnished import RECEIVERS, SHAPE, SIGMA, TX, F, spectra
from radio_scenes import box_mesh

import warprrf as wr
from warprrf.rf.exact import ExactEngine
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic import training
from warprrf.rf.fields.bistatic.observations import Target
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.positions import is_free
from warprrf.rf.spectra.antenna import horn
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.readings import COLUMNS, NEEDED, Readings, path_weights
from warprrf.rf.spectra.spectrum import directions_from_angles
from warprrf.rf.tracing.model import SETS

CHAIN_DB = -23.7
WIDTH = np.radians(20.0)


@pytest.fixture(scope="module")
def test(scene):
    held = RECEIVERS[6:] + np.array([0.1, 0.1, 0.05])
    return spectra(scene, held)


def horn_readings(scene, side_lobes_db):
    """A horn at six receivers, turned through 18 azimuths at two elevations: read off narrow beams of the exact engine."""
    engine = ExactEngine(
        scene, transmitter=TX, frequency_hz=F, shape=(60, 120), beam_sigma_rad=np.radians(1.5), sub_pixels=2
    )
    zenith, azimuth = np.meshgrid(
        (np.arange(60) + 0.5) * np.pi / 60, -np.pi + (np.arange(120) + 0.5) * np.pi / 60, indexing="ij"
    )
    seen = directions_from_angles(zenith.ravel(), azimuth.ravel())
    pointing = np.array([(z, a) for z in (np.pi / 2, 2.0) for a in np.radians(np.arange(-180, 180, 20))])
    angle = np.arccos(np.clip(directions_from_angles(*pointing.T) @ seen.T, -1.0, 1.0))
    gain = horn(WIDTH, side_lobes_db).gain_off_boresight(angle)
    power = np.stack([gain @ engine.receive(r).path_gain.ravel() for r in RECEIVERS[:6]])
    floor = np.repeat(power.max(axis=1) * 1e-3, len(pointing)) * 10 ** (CHAIN_DB / 10)
    return Readings(
        TX, np.repeat(RECEIVERS[:6], len(pointing), axis=0),
        np.maximum(power.ravel() * 10 ** (CHAIN_DB / 10), floor), F, floor,
        arrival=np.tile(pointing, (6, 1)), receive_pattern=horn(WIDTH, side_lobes_db), chain=["horn"] * power.size,
    )  # fmt: skip


@pytest.fixture(scope="module")
def turned(scene):
    return horn_readings(scene, -60.0)


def score(field, test):
    """PSNR on the grid of ``test``."""
    return evaluate(test, replace(field, shape=SHAPE, beam_sigma_rad=SIGMA).spectrum)["psnr_db"]


def test_a_gain_that_hangs_on_side_lobes_is_said_to(scene, turned):
    """What 3 dB of their level move the gain by is in its error, as two fits with levels so far apart have it."""
    quick = {"quick": True, "effects": "single"}
    clear = RadioField.fit(scene, turned, **quick).report["chains"]["horn"]
    assert clear["side_lobe_share"] < 0.05 and clear["std_db"] < 0.5
    lobed = horn_readings(scene, -25.0)
    with pytest.warns(UserWarning, match=r"side lobes, .*'horn' \(8\d % of its readings") as told:
        found = RadioField.fit(scene, lobed, **quick).report["chains"]["horn"]
    assert told[0].filename == __file__
    lower = replace(lobed, receive_pattern=horn(WIDTH, -28.0))
    other = RadioField.fit(scene, lower, **quick).report["chains"]["horn"]
    moved = other["gain_db"] - found["gain_db"]
    assert moved > 2.0 and found["std_db"] == pytest.approx(moved, rel=0.25)


def test_wrong_readings_are_named_and_hardly_count(scene, turned, test):
    rng = np.random.default_rng(1)
    above = np.flatnonzero(turned.power > 3.0 * turned.floor)
    wrong = np.sort(rng.choice(above, len(above) // 10, replace=False))
    power = turned.power.copy()
    power[wrong] *= 100.0
    clean = RadioField.fit(scene, turned, quick=True)
    with pytest.warns(UserWarning, match=rf"of {len(turned)} readings .* left out .*rows {wrong[0]}, "):
        spoilt = RadioField.fit(scene, replace(turned, power=power), quick=True)
    named = spoilt.report["unexplained"]["readings"]
    assert np.isin(wrong, named).mean() >= 0.9
    assert len(named) < 2 * len(wrong) + 3
    assert score(spoilt, test) > score(clean, test) - 1.0


def test_data_sets_of_one_name_are_told_apart_in_a_report(scene, turned):
    power = turned.power.copy()
    power[[0, len(power) // 2]] *= 1e3  # a row of each half
    halves = [replace(turned, power=power).subset(part) for part in np.split(np.arange(len(turned)), 2)]
    report = RadioField.fit(scene, halves, quick=True).report
    assert report["noise_db"].keys() == {"readings 1", "readings 2"}
    assert all(0 in report["unexplained"][name] for name in ("readings 1", "readings 2"))


def test_the_noise_of_readings_is_estimated(scene, turned):
    """Noise and what the field cannot explain of clean readings add in power."""
    noise = 10.0 ** (0.3 * np.random.default_rng(3).normal(size=len(turned)))  # 3 dB
    power = np.maximum(np.where(turned.power > turned.floor, turned.power * noise, 0.0), turned.floor)
    noisy = replace(turned, power=power, std_db=3.0)
    clean, found = (
        RadioField.fit(scene, r, quick=True).report["noise_db"]["readings"] for r in (turned, noisy)
    )
    assert clean < 1.0
    assert found == pytest.approx(np.hypot(3.0, clean), rel=0.2)


def test_a_gain_errs_as_much_as_it_is_said_to(scene, turned):
    """Readings of line of sight alone count for more, but their noise is that of all."""
    rng, missed = np.random.default_rng(0), []
    for _ in range(8):
        noise = 10.0 ** (0.3 * rng.normal(size=len(turned)))  # 3 dB
        power = np.maximum(np.where(turned.power > turned.floor, turned.power * noise, 0.0), turned.floor)
        noisy = replace(turned, power=power, std_db=3.0)
        found = RadioField.fit(scene, noisy, quick=True, effects="single").report["chains"]["horn"]
        missed.append((found["gain_db"] - CHAIN_DB) / found["std_db"])
    assert np.sqrt(np.mean(np.square(missed))) < 1.6


def test_fading_is_as_deep_as_paths_make_it(scene):
    """Waves of random phases: in line of sight power fades less than Rayleigh's does, and no chain's gain is moved."""
    effects, rng = replace(SETS["single"], residual=False), np.random.default_rng(0)
    places = rng.uniform([0.3, 0.3, 0.3], [4.7, 3.7, 1.5], (60, 3))
    seen, free = scene.mesh.visible(places, TX[None]), is_free(scene.mesh, places, clearance_m=0.2)
    spectrum = spectra(scene, RECEIVERS[:4])
    truth = RadioField.fit(scene, spectrum, quick=True, effects=effects)
    known = replace(spectrum, path_gain=truth.spectra(spectrum.receivers).path_gain)
    for own, bound in ((seen, 0.3), (~seen, 0.5)):
        at = np.repeat(places[own & free][:12], 200, axis=0)
        wave = [np.abs(truth.paths(place).gain) for place in at[::200]]
        phased = [np.exp(2j * np.pi * rng.random((200, len(w)))) @ w for w in wave]
        power = np.abs(np.concatenate(phased)) ** 2 * 10 ** (CHAIN_DB / 10)
        faded = Readings(TX, at, power, F, 1e-15, chain=["meter"] * len(at), samples=1)
        found = RadioField.fit(scene, [known, faded], quick=True, effects=effects).report["chains"]["meter"]
        assert found["gain_db"] == pytest.approx(CHAIN_DB, abs=bound)


def test_several_transmitters_are_fitted_together_and_remembered(scene, tmp_path):
    second, third = np.array([4.3, 0.7, 2.0]), np.array([4.2, 3.4, 2.3])
    sets = [spectra(scene, RECEIVERS[k : k + 3], transmitter=t) for k, t in ((0, TX), (3, second))]
    field = RadioField.fit(scene, sets, quick=True)
    np.testing.assert_array_equal(field.transmitter, TX)
    np.testing.assert_array_equal(field.fitted_on, RECEIVERS[:6])
    assert [field.was_fitted_on(one).all() for one in sets] == [True, True]
    swapped = replace(sets[1], transmitter=TX)
    assert not field.was_fitted_on(swapped).any()  # fitted there under another transmitter
    field.save(tmp_path / "field.safetensors")
    assert RadioField.load(tmp_path / "field.safetensors").was_fitted_on(sets[1]).all()
    truth = spectra(scene, RECEIVERS[6:8], transmitter=third)
    both = evaluate(truth, lambda r: field.spectrum(r, third))["psnr_db"]
    one = RadioField.fit(scene, sets[0], quick=True)
    assert both > evaluate(truth, lambda r: one.spectrum(r, third))["psnr_db"] - 0.5
    assert both > 25.0


def test_rows_of_which_nothing_was_read_change_nothing(scene, turned):
    """Wherever they stand: a field whose first row was NaN, under a transmitter of its own, could not be made."""
    part = turned.subset(np.arange(36))
    ends = {"transmitters": np.vstack([TX + [0.3, 0.2, 0.0], part.transmitters])}
    ends["receivers"] = np.vstack([RECEIVERS[7], part.receivers])
    first = {"power": np.append(np.nan, part.power), "floor": np.append(1e-12, part.floor), "std_db": 0.0}
    arrival, chain = np.vstack([[1.5, 0.0], part.arrival]), ["horn"] * 37
    more = replace(part, **ends, **first, arrival=arrival, chain=chain)
    now, before = (RadioField.fit(scene, one, quick=True, effects="single") for one in (more, part))
    np.testing.assert_array_equal(now.transmitter, TX)
    np.testing.assert_array_equal(now.fitted_on, before.fitted_on)
    a, b = (field.spectrum(RECEIVERS[6]).path_gain for field in (now, before))
    np.testing.assert_allclose(a, b, rtol=1e-6)


def test_a_rotator_whose_zero_is_unknown_is_turned_to_the_room(scene, turned):
    assert turned.arrival is not None
    away = replace(
        turned, arrival=turned.arrival - [0.0, np.radians(137.0)], azimuth_known=False, name="away"
    )
    zero = RadioField.fit(scene, away, quick=True, iterations=2).report["azimuth_zero_deg"]
    assert zero["away"] == pytest.approx(137.0, abs=1.0)
    with pytest.raises(ValueError, match="azimuth_known: got False without arrival"):
        replace(turned, arrival=None, receive_pattern=None, azimuth_known=False)


def test_a_clock_whose_zero_is_unknown_is_set_by_line_of_sight_and_mirrors(scene):
    taps, count = np.arange(0.0, 60e-9, 0.5e-9), 4
    paths = trace_paths(scene, transmitter=TX, receivers=RECEIVERS[:count], frequency_hz=F)
    power = [
        np.sinc(2e9 * (taps[:, None] - tau[own])) ** 2 @ gain[own]
        for tau, gain, own in zip(paths.tau, paths.power, paths.valid, strict=True)
    ]
    late = Readings(
        TX, np.repeat(RECEIVERS[:count], len(taps), axis=0), np.concatenate(power), F, 1e-4 * np.max(power),
        delay_s=np.tile(taps, count) + 37.1e-9, bandwidth_hz=2e9, clock_known=False, name="late",
    )  # fmt: skip
    report = RadioField.fit(scene, late, quick=True, iterations=2).report
    assert report["clock_offset_s"]["late"] == pytest.approx(-37.1e-9, abs=0.01e-9)
    assert not report["azimuth_zero_deg"]
    with pytest.raises(ValueError, match="clock_known: got False without delay_s"):
        replace(late, delay_s=None, bandwidth_hz=None)


def test_receivers_that_stood_elsewhere_are_found(scene, turned):
    rng = np.random.default_rng(2)
    away = 0.08 * rng.normal(size=(6, 3)).clip(-1.5, 1.5)
    count = len(turned) // 6
    said = replace(turned, receivers=turned.receivers + np.repeat(away, count, axis=0))
    field = RadioField.fit(scene, replace(said, position_std_m=0.08, name="away"), quick=True)
    found = field.report["position_offset_m"]["away"]
    np.testing.assert_allclose([place for place, _ in found], RECEIVERS[:6] + away)
    left = away + [offset for _, offset in found]
    sight = RECEIVERS[:6] - TX
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)

    def across(error):  # powers say little of how far away a receiver is
        return float(np.sqrt(((error - (error * sight).sum(axis=1, keepdims=True) * sight) ** 2).mean()))

    assert across(left) < 0.5 * across(away)
    np.testing.assert_allclose(field.fitted_on, RECEIVERS[:6] + away)
    with pytest.raises(ValueError, match="position_std_m: got readings of power alone"):
        replace(turned, arrival=None, receive_pattern=None, position_std_m=0.05)


def test_a_receiver_stands_at_one_place_whoever_reads_it(scene, turned):
    """Every other pointing is of another chain: what both read tells of one place."""
    away = 0.08 * np.random.default_rng(2).normal(size=(6, 3)).clip(-1.5, 1.5)
    said = replace(turned, receivers=turned.receivers + np.repeat(away, len(turned) // 6, axis=0))
    known = {"quick": True, "effects": "single"}
    one, two = (
        RadioField.fit(scene, replace(said, chain=chain, position_std_m=0.08, name="away"), **known).report
        for chain in (turned.chain, np.resize(["horn", "other"], len(turned)))
    )
    places, offsets = np.moveaxis(np.array(two["position_offset_m"]["away"]), 1, 0)
    np.testing.assert_allclose(places, RECEIVERS[:6] + away)
    np.testing.assert_allclose(offsets, [offset for _, offset in one["position_offset_m"]["away"]], atol=0.01)


def test_roughness_counts_in_wavelengths_at_another_carrier(scene):
    """A mirror's share exp(-(4 pi sigma_h / lambda)^2) is found again, the sum of both shares stays, and so does what
    free space gives: the square of the wavelength."""
    truth = spectra(scene, RECEIVERS[:3])
    field = RadioField.fit(scene, truth, quick=True, iterations=3)
    other = field.at_frequency(F / 2)
    share, there = (np.exp(f.parameters.log_mirror) for f in (field, other))
    scattered, later = (f.parameters.weight.sum(axis=1) for f in (field, other))
    np.testing.assert_allclose(share + scattered, there + later, rtol=1e-9)
    np.testing.assert_allclose((share / (share + scattered)) ** 0.25, there / (there + later), rtol=1e-9)
    again = other.at_frequency(F)
    np.testing.assert_allclose(again.parameters.log_weight, field.parameters.log_weight, atol=1e-6)
    assert (again.floor, again.range_db) == (pytest.approx(field.floor), pytest.approx(field.range_db))
    direct = [f.view(RECEIVERS[0]).records["specular"].power[0] for f in (field, other)]  # line of sight
    assert direct[1] / direct[0] == pytest.approx(4.0, rel=1e-6)
    with pytest.raises(ValueError, match="frequency_hz"):
        field.at_frequency(-1.0)


def test_carriers_are_fitted_together(scene):
    """Roughness makes 1 - S^2 = exp(-(4 pi sigma_h / lambda)^2): half the carrier, its fourth root. What was measured at
    one carrier serves the other."""
    smoother = [replace(m, scattering=np.sqrt(1 - (1 - m.scattering**2) ** 0.25)) for m in scene.materials]
    rooms = {F: scene, F / 2: replace(scene, materials=smoother)}
    here, there = (
        spectra(room, RECEIVERS[own], frequency_hz=f)
        for own, (f, room) in zip((slice(1), slice(1, 6)), rooms.items(), strict=True)
    )
    alone, both = (RadioField.fit(scene, data, quick=True) for data in (here, [here, there]))
    assert both.frequency_hz == F
    for f, room in rooms.items():
        truth = spectra(room, RECEIVERS[6:], frequency_hz=f)
        one, two = (evaluate(truth, field.at_frequency(f).spectrum)["psnr_db"] for field in (alone, both))
        assert two > one + 1.0
        assert two > 36.0
    assert both.parameters.roughness == pytest.approx(2.0, abs=0.2)


def test_carriers_whose_scattering_does_not_follow_roughness_are_fitted_together(scene):
    """Sionna's S is one number at every carrier: a power of the carrier of 0 where Ament has 2."""
    carriers = 300e9, 140e9
    sets = [
        spectra(scene, RECEIVERS[own], frequency_hz=f)
        for own, f in zip((slice(3), slice(3, 6)), carriers, strict=True)
    ]
    field = RadioField.fit(scene, sets, quick=True)
    assert field.parameters.roughness == pytest.approx(0.0, abs=0.1)
    for f in carriers:
        truth, there = spectra(scene, RECEIVERS[6:], frequency_hz=f), field.at_frequency(f)
        found = [there.spectrum(place).total_path_gain for place in truth.receivers]
        ratio = np.array(found) / truth.path_gain.sum(axis=(1, 2))
        assert np.abs(10.0 * np.log10(ratio)).max() < 0.1


def test_directions_that_nobody_measured_do_not_count(scene, test):
    whole = spectra(scene, RECEIVERS[:5])
    gain = whole.path_gain.copy()
    gain[:, :6] = np.nan
    part = SpectrumDataset.from_spectra(
        receivers=whole.receivers,
        transmitter=TX,
        frequency_hz=F,
        path_gain=gain,
        beam_sigma_rad=SIGMA,
        floor=whole.floor,
    )
    np.testing.assert_array_equal(part.line_of_sight, whole.line_of_sight)
    field = RadioField.fit(scene, part, quick=True)
    spoilt = replace(part, path_gain=np.where(np.isnan(gain), 0.0, gain))
    worse = RadioField.fit(scene, spoilt, quick=True)
    found, other = (evaluate(test, f.spectrum)["psnr_db"] for f in (field, worse))
    assert found > evaluate(test, RadioField.fit(scene, whole, quick=True).spectrum)["psnr_db"] - 3.0
    assert found > other
    with pytest.raises(ValueError, match="test.path_gain: 1440 of 5760 pixels are NaN"):
        evaluate(part, field.spectrum)
    with pytest.raises(ValueError, match="path_gain"):
        RadioField.fit(scene, part, "rf3dgs+")


def test_power_that_the_model_does_not_explain_counts_less():
    """Walls of a room in which power does not fall with distance mirrored four times what reached them, and the gain of the
    chain was too low by far: readings counted as if they erred by half a decibel, and a quarter of them as wrong."""
    room, rng = wr.Mesh(*box_mesh([0, 0, 0], [7, 5, 3], inward=True)), np.random.default_rng(0)
    scene = wr.Scene(
        room, [wr.em.itu_material("brick", thickness_m=0.2)], np.zeros(len(room.faces), np.int32)
    )
    places = rng.uniform([0.5, 0.5, 0.5], [6.5, 4.5, 2.5], (60, 3))
    power = (0.125 / (4.0 * np.pi)) ** 2 * 10.0 ** (0.2 * rng.normal(size=60))  # as a metre away, everywhere
    sent = np.tile([1.0, 1.0, 2.6], (60, 1))
    readings = Readings(sent, places, power, 2.4e9, 1e-12, chain=["tag"] * 60)
    field = RadioField.fit(scene, readings, quick=True)
    assert np.exp(field.parameters.log_mirror[0]) < 4.0
    assert field.report["chains"]["tag"]["gain_db"] > -7.0
    assert 1.0 < field.report["noise_db"]["readings"] < 4.0
    assert not field.report["unexplained"]


def test_a_censored_reading_says_only_that_there_was_no_more():
    target = Target(np.array([3.0, 3.0]), censored=np.array([True, False]))
    quiet, loud = np.full(2, 0.01), np.full(2, 100.0)
    assert target.error(quiet)[0] == 0 and target.slope(quiet)[0] == 0
    assert target.error(quiet)[1] < -2
    assert target.error(loud)[0] == target.error(loud)[1] > 10


def test_a_reading_weighs_paths_by_directions_and_delay():
    east, north = directions_from_angles([np.pi / 2] * 2, [0.0, np.pi / 2])
    one = Readings(
        TX, RECEIVERS[0], [1e-9, 1e-9], F, 1e-15, arrival=[[np.pi / 2, 0.0], [np.pi / 2, np.pi / 2]],
        receive_pattern=horn(0.2), delay_s=[10e-9, 10e-9], bandwidth_hz=2e9, window="hann",
    )  # fmt: skip
    arrival = np.stack([east, north])
    on_tap = path_weights(one, np.arange(2), arrival, arrival, np.array([10e-9, 10e-9]))
    assert on_tap[0, 0] == pytest.approx(on_tap[1, 1]) and on_tap[0, 1] < 1e-5 * on_tap[0, 0]
    taps = np.arange(40) / 2e9
    many = replace(
        one, arrival=None, receive_pattern=None, receivers=np.tile(RECEIVERS[0], (40, 1)), transmitters=TX,
        power=np.full(40, 1e-9), floor=1e-15, delay_s=taps, chain=None, std_db=0.0,
    )  # fmt: skip
    shares = path_weights(many, np.arange(40), arrival[:1], arrival[:1], np.array([9.83e-9]))
    assert shares.sum() == pytest.approx(1.0, abs=1e-3)  # all taps share the path's power


def test_a_horn_of_a_width_is_lossless():
    angle = np.linspace(0, np.pi, 100_001)
    for width in (0.05, 0.5, 2.0):
        gain = horn(width).gain_off_boresight(angle)
        assert 0.5 * np.trapezoid(gain * np.sin(angle), angle) == pytest.approx(1.0, rel=1e-3)
        assert horn(width).gain_off_boresight([width / 2])[0] == pytest.approx(0.5 * gain[0], rel=1e-3)
    with pytest.raises(ValueError, match=r"width_rad: got 10, expected radians.*np\.radians"):
        horn(10)


HEADER = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,azimuth_deg,elevation_deg,power_db,chain"
ROW = "0.8,0.9,2.2,4.2,3.1,1.2,-180,30,-93.1,horn"


def of_csv(text, path):
    path.write_text(text, encoding="utf-8")
    return Readings.load(path, frequency_hz=F, floor=1e-12, receive_pattern=horn(WIDTH))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"{HEADER}\n{ROW}\n\n{ROW},7", "line 4: got 11 values, expected 10"),
        (f"{HEADER}\n{ROW.replace('4.2', 'four')}", "line 2: rx_x: got 'four'"),
        (f"{HEADER.replace('_deg', '')}\n{ROW}", "'azimuth' for azimuth_deg, 'elevation' for elevation_deg"),
        (f"{HEADER},power_db\n{ROW},-60", "several columns power_db"),
    ],
)
def test_what_a_table_s_file_does_not_say_clearly_is_refused(text, told, tmp_path):
    with pytest.raises(ValueError, match=rf"horn\.csv: .*{told}"):
        of_csv(text, tmp_path / "horn.csv")


def test_a_table_s_file_is_read_as_it_is_meant(tmp_path):
    """Spaces, empty lines, a byte-order mark, a chain called NA, a power that was not measured; other columns are named."""
    lines = [HEADER, ROW.replace("horn", "NA"), "", ROW.replace("-93.1", "n/a").replace("horn", "")]
    spaced = "\ufeff" + "\n".join(line.replace(",", " , ") for line in lines)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = of_csv(spaced, tmp_path / "horn.csv")
    assert read.chain.tolist() == ["NA", ""]
    np.testing.assert_allclose(read.power, [10**-9.31, np.nan])
    np.testing.assert_allclose(read.arrival, [[np.pi / 3, -np.pi]] * 2)
    np.testing.assert_array_equal(read.transmitters, [[0.8, 0.9, 2.2]] * 2)
    np.testing.assert_array_equal(read.receivers, [[4.2, 3.1, 1.2]] * 2)
    with pytest.warns(UserWarning, match="columns note are not read") as told:
        of_csv(f"{HEADER},note\n{ROW},any", tmp_path / "horn.csv")
    assert told[0].filename == __file__


def test_a_carrier_in_gigahertz_is_questioned():
    with pytest.raises(ValueError, match="expected hertz"):
        Readings(TX, RECEIVERS[:2], [1e-9, 1e-9], 28, 1e-15)


def test_a_cell_without_a_chain_is_a_calibrated_reading():
    table = pd.DataFrame({name: [1.0, 2.0] for end in ("transmitter", "receiver") for name in COLUMNS[end]})
    table["power_db"] = -80.0
    for cells in (["horn", None], ["horn", np.nan], pd.array(["horn", None], dtype="string")):
        read = Readings.from_table(table.assign(chain=cells), frequency_hz=F, floor=1e-12)
        assert read.chain.tolist() == ["horn", ""]


def test_a_column_of_another_length_is_named():
    table = dict.fromkeys(NEEDED, [1.0, 2.0]) | {"power_db": [-80.0, -80.0]}
    with pytest.raises(ValueError, match=re.escape("table['rx_y']: got shape (3,), expected (2)")):
        Readings.from_table(table | {"rx_y": [1.0, 2.0, 3.0]}, frequency_hz=F, floor=1e-12)


def test_a_chain_of_which_nothing_was_heard_has_no_gain(scene, turned):
    """It was said to be known to 1.4 dB, by the floor."""
    dark = replace(turned, chain=["other"] * 36 + ["horn"] * 180)
    power = np.where(dark.chain == "other", dark.floor, dark.power)
    with pytest.raises(ValueError, match=r"chain: got no reading of \['other'\] above its floor"):
        RadioField.fit(scene, replace(dark, power=power), quick=True)


def test_the_only_place_of_a_chain_is_not_held_out(scene, turned, monkeypatch):
    """Its gain would be known from nothing: a horn at one place beside spectra at seven, whichever place it is."""
    several = spectra(scene, RECEIVERS[1:8])
    alone = turned.subset(np.flatnonzero((turned.receivers == RECEIVERS[0]).all(axis=1)))
    for data in ([several, alone], [alone, several]):
        for seed in range(2):
            field = RadioField.fit(scene, data, effects="single", sub_pixels=1, seed=seed)
            assert field.report["held_out"] == 2
            assert field.report["chains"]["horn"]["gain_db"] == pytest.approx(CHAIN_DB, abs=1.0)
    # readings that come after more spectra than effects are chosen by
    monkeypatch.setattr(training, "MOST_TO_CHOOSE", 4)
    field = RadioField.fit(scene, [several, turned.subset(np.arange(72))], sub_pixels=1)
    assert field.report["chains"]["horn"]["gain_db"] == pytest.approx(CHAIN_DB, abs=1.0)
