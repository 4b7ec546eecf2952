"""Where a receiver is: found again from what the field itself, and another engine, say is read there."""

from dataclasses import replace

import furnished
import numpy as np
import pytest
from furnished import RECEIVERS
from radio_scenes import box_mesh

import warprrf as wr
from warprrf.rf.fields.bistatic.field_map import coarse, maps_of
from warprrf.rf.fields.bistatic.locate import Question, as_data
from warprrf.rf.spectra.spectrum import directions_from_angles, pixel_solid_angles, sub_pixel_directions
from warprrf.rf.tracing.render import path_gains

UNSEEN = np.array([[3.9, 2.0, 1.4], [1.7, 3.1, 1.2]])
OFF_BORDERS = UNSEEN + [0.0013, 0.0007, 0.0011]
"""Places from which no ray hits the border of two faces, where either may be met."""
OTHERS = np.array([[4.4, 0.6, 2.3], [0.7, 3.5, 2.4], [4.5, 3.6, 2.5]])
TURN = np.radians(137.0)


@pytest.fixture(scope="module")
def field(scene):
    return wr.RadioField.fit(scene, furnished.spectra(scene), effects="single", quick=True)


@pytest.fixture(scope="module")
def horn(field):
    """A horn's readings at the second place, as the field has them; its rotator's zero and its gain are not told."""
    angles = np.array(
        [(np.pi / 2 - up, around) for up in (-0.4, 0.0, 0.4) for around in np.arange(-3.0, 3.2, 0.25)]
    )
    pattern = wr.horn(np.radians(12.0))
    paths = field.paths(UNSEEN[1])
    like = wr.Readings(
        field.transmitter, UNSEEN[1], np.ones(len(angles)), field.frequency_hz, 1e-14, arrival=angles + [0.0, TURN],
        receive_pattern=pattern, chain=["horn"] * len(angles), azimuth_known=False, name="scan",
    )  # fmt: skip
    toward = np.stack(
        [
            np.sin(angles[:, 0]) * np.cos(angles[:, 1]),
            np.sin(angles[:, 0]) * np.sin(angles[:, 1]),
            np.cos(angles[:, 0]),
        ],
        1,
    )
    gain = pattern.gain_off_boresight(np.arccos(np.clip(toward @ paths.arrival.T, -1.0, 1.0)))
    power = 0.02 * gain @ paths.power
    return replace(like, arrival=angles - [0.0, TURN], power=power, floor=1e-3 * power.max())


def test_a_receiver_is_found_from_another_engine_s_spectrum(scene, field):
    ds = furnished.spectra(scene, UNSEEN)
    for k, true in enumerate(UNSEEN):
        found = field.locate(ds.subset([k]))
        assert np.linalg.norm(found.position - true) < 0.05
        assert found.known and found.likelihoods[0] > 0.95 and found.std_m < 0.2


def test_what_is_said_of_the_place_does_not_count(scene, field):
    one = furnished.spectra(scene, UNSEEN[:1])
    elsewhere = replace(one, receivers=RECEIVERS[:1])
    np.testing.assert_array_equal(field.locate(one).position, field.locate(elsewhere).position)


@pytest.mark.parametrize(
    ("size", "told"), [([0.3, 0.3, 0.3], "none of the places"), ([900.0, 900.0, 30.0], "1.9e\\+08 places")]
)
def test_scenes_too_large_or_too_small_to_search_are_refused(size, told):
    room = wr.Mesh(*box_mesh([0, 0, 0], size, inward=True))
    ends = {"transmitter": 0.3 * np.array(size), "frequency_hz": 300e9}
    field = wr.RadioField.fit(room, wr.SpectrumDataset.empty(**ends), effects="single")
    read = wr.Readings(ends["transmitter"], 0.6 * np.array(size), [1e-8], 300e9, 1e-12)
    with pytest.raises(ValueError, match=f"field: {told}"):
        field.locate(read)


def test_where_nothing_arrives_no_place_is_known(scene, field):
    """In the shadow of a field of line of sight alone."""
    sight = wr.Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=0)
    direct, dark = replace(field, effects=sight), RECEIVERS[~field.mesh.visible(RECEIVERS, field.transmitter)]
    read = direct.spectrum(dark[0])
    assert read.path_gain.max() == 0
    found = direct.locate(read)
    assert not found.known and found.std_m == np.inf
    one = furnished.spectra(scene, UNSEEN).subset([0])
    assert not field.locate(
        replace(one, path_gain=0.0 * one.path_gain)
    ).known  # but a place on the floor is likeliest


def test_one_power_leaves_ways_open(field):
    """Along which nothing says how far: that is no error of none."""
    total = field.spectrum(UNSEEN[0]).path_gain.sum()
    read = wr.Readings(field.transmitter, UNSEEN[0], [total], field.frequency_hz, 1e-3 * total)
    found = field.locate(read)
    assert not found.known and found.std_m == np.inf


def test_a_transmitter_may_stand_at_a_place_of_the_map(field):
    places = next(iter(maps_of(field, [field.transmitter]).values())).places
    other = places[np.linalg.norm(places - [1.2, 3.2, 1.2], axis=1).argmin()]
    read = wr.SpectrumDataset.from_spectra(
        receivers=UNSEEN[:1], transmitter=other, frequency_hz=field.frequency_hz, floor=field.floor,
        path_gain=field.spectrum(UNSEEN[:1], other).path_gain, beam_sigma_rad=field.beam_sigma_rad,
    )  # fmt: skip
    assert np.linalg.norm(field.locate(read).position - UNSEEN[0]) < 0.05


def test_powers_that_hold_absorption_are_looked_for_with_it(field):
    air = wr.Air(pressure_hpa=30_000.0, water_vapour_g_m3=100.0)
    humid = field.with_gas(air)
    read = wr.SpectrumDataset.from_spectra(
        receivers=UNSEEN[:1], transmitter=field.transmitter, frequency_hz=field.frequency_hz,
        path_gain=humid.spectrum(UNSEEN[:1]).path_gain, beam_sigma_rad=field.beam_sigma_rad, floor=field.floor,
        attributes=air.attributes,
    )  # fmt: skip
    found = field.locate(read)
    np.testing.assert_array_equal(found.position, humid.locate(read).position)
    assert np.linalg.norm(found.position - UNSEEN[0]) < 0.05 and field.locate(read).misfit == found.misfit
    other = replace(read, attributes=wr.Air().attributes)
    with pytest.raises(ValueError, match="measured: got the absorption of 2 kinds of air"):
        field.locate([read, other])


def test_a_spectrum_says_which_transmitter_carrier_and_air_it_is_of(scene, field):
    """As a data set of it does: a field's spectrum under another transmitter was looked for under the field's own."""
    other, air = field.transmitter - [0.5, 0.4, 0.3], wr.Air(pressure_hpa=30_000.0, water_vapour_g_m3=100.0)
    humid, sources = field.with_gas(air), np.array([field.transmitter, other])
    both = humid.spectrum(np.repeat(UNSEEN[:1], 2, axis=0), sources)
    for one, source in zip((both[0], both[1]), sources, strict=True):
        of = {
            "transmitter": source,
            "frequency_hz": field.frequency_hz,
            "beam_sigma_rad": field.beam_sigma_rad,
        }
        ds = wr.SpectrumDataset.from_spectra(
            receivers=UNSEEN[:1], path_gain=one.path_gain[None], floor=field.floor, attributes=air.attributes, **of
        )  # fmt: skip
        found = [field.locate(told) for told in (ds, ds[0], one)]
        assert len({place.position.tobytes() for place in found}) == 1 and found[0].known
    with pytest.raises(ValueError, match="measured: got 320 GHz, expected 300"):
        field.locate(field.at_frequency(320e9).spectrum(UNSEEN[0]))


def test_a_horn_of_unknown_gain_and_azimuth_finds_all_three(field, horn):
    found = field.locate(horn)
    assert np.linalg.norm(found.position - UNSEEN[1]) < 0.15
    assert found.gains_db["horn"] == pytest.approx(10.0 * np.log10(0.02), abs=0.5)
    assert abs(np.angle(np.exp(1j * (found.azimuth_zeros["scan"] - TURN)))) < np.radians(2.0)


def profiles(field, place, late_s, bandwidth_hz=2e9):
    """Taps from three transmitters at ``place``, as the field has them; the clock is ``late_s`` late."""
    sources, taps, power = [field.transmitter, *OTHERS[:2]], np.arange(0.0, 60e-9, 0.4e-9), []
    for source in sources:
        paths = field.paths(place, source)
        power.append(np.sinc(bandwidth_hz * (taps[:, None] - paths.tau)) ** 2 @ paths.power)
    return wr.Readings(
        np.repeat(sources, len(taps), axis=0), place, np.concatenate(power), field.frequency_hz, 1e-3 * np.max(power),
        delay_s=np.tile(taps + late_s, 3), bandwidth_hz=bandwidth_hz, clock_known=False, name="profiles",
    )  # fmt: skip


@pytest.mark.parametrize("k", [1, pytest.param(0, marks=pytest.mark.long)])
def test_profiles_of_delay_tell_the_place_and_how_late_their_clock_is(field, k):
    found = field.locate(profiles(field, UNSEEN[k], 137e-9))
    assert np.linalg.norm(found.position - UNSEEN[k]) < 0.05
    assert found.clock_offsets_s["profiles"] == pytest.approx(-137e-9, abs=0.2e-9)
    assert not found.known and not found.azimuth_zeros  # valleys of 15 cm, places half a metre apart


def test_floors_do_not_add_up_to_what_looks_like_power():
    """A profile of gigahertz read more coarsely: a path keeps its power, and where no tap was heard none is."""
    taps, floor = np.arange(0.0, 100e-9, 0.25e-9), 1e-3
    power = np.sinc(2e9 * (taps - 20e-9)) ** 2
    one = wr.Readings(
        [0, 0, 2], [1, 1, 1], np.maximum(power, floor), 60e9, floor, delay_s=taps, bandwidth_hz=2e9
    )
    found = coarse(one)
    heard = found.power > found.floor
    assert found.bandwidth_hz < 1e9 and len(found) < len(one) / 2
    assert found.power.max() == pytest.approx(1.0 / 1.5, rel=0.2)  # of a Hann window
    assert heard.any() and (np.abs(found.delay_s[heard] - 20e-9) < 2.0 / found.bandwidth_hz).all()


def test_coarse_profiles_are_known(field):
    found = field.locate(profiles(field, UNSEEN[0], 137e-9, bandwidth_hz=0.4e9))
    assert found.known and np.linalg.norm(found.position - UNSEEN[0]) < 0.1


def test_pointings_of_the_transmitting_antenna_tell_the_place(field):
    """Of two transmitters; one alone tells a receiver's direction, and little of its distance."""
    angles = np.array([(np.pi / 2 - up, az) for up in (-0.5, 0.0, 0.5) for az in np.arange(-3.1, 3.1, 0.15)])
    pattern, power = wr.horn(np.radians(10.0)), []
    sources = [field.transmitter, OTHERS[0]]
    for source in sources:
        paths = field.paths(UNSEEN[0], source)
        toward = directions_from_angles(*angles.T) @ paths.departure.T
        power.append(pattern.gain_off_boresight(np.arccos(np.clip(toward, -1.0, 1.0))) @ paths.power)
    found = field.locate(
        wr.Readings(
            np.repeat(sources, len(angles), axis=0), UNSEEN[0], np.concatenate(power), field.frequency_hz,
            1e-3 * np.max(power), departure=np.tile(angles, (2, 1)), transmit_pattern=pattern,
        )
    )  # fmt: skip
    assert np.linalg.norm(found.position - UNSEEN[0]) < 0.15


def test_a_map_s_departures_are_those_of_paths_that_met_one_surface(field):
    m = maps_of(field, [field.transmitter])[field.transmitter.tobytes()]
    p = int(np.linalg.norm(m.places - UNSEEN[0], axis=1).argmin())
    found = m.departures(field.transmitter)[p].reshape(*m.image.shape[1:], 3)
    hit = field.mesh.cast(m.places[p], sub_pixel_directions(m.image.shape[1:], 1)[0])
    out = hit.point - field.transmitter
    diffuse = np.abs(np.linalg.norm(out, axis=1) + hit.t - m.length[p].ravel()) < 1e-3
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    assert diffuse.mean() > 0.5
    np.testing.assert_allclose(found.reshape(-1, 3)[diffuse], out[diffuse], atol=1e-3)
    line = m.places[p] - field.transmitter
    sight = np.unravel_index(m.image[p].argmax(), m.image.shape[1:])
    assert m.length[p][sight] == pytest.approx(np.linalg.norm(line), rel=1e-6)
    np.testing.assert_allclose(found[sight], line / np.linalg.norm(line), atol=1e-3)


def test_what_cannot_be_located_is_refused(scene, field, horn):
    ds = furnished.spectra(scene, UNSEEN)
    for what, text in (
        (ds, "of 2 receivers"), (replace(ds.subset([0]), frequency_hz=140e9), "at_frequency"),
        (replace(horn, receivers=horn.receivers + np.arange(len(horn))[:, None]), "Readings of"),
        (replace(horn, departure=horn.arrival, transmit_pattern=horn.receive_pattern), "beside departures"),
        (3, "measured: got int"), ([], "measured: got an empty list"), ([field.spectrum(UNSEEN[0])], "measured: got Spectrum"),
    ):  # fmt: skip
        with pytest.raises((TypeError, ValueError), match=text):
            as_data(field, what)


@pytest.mark.parametrize("quantity", ["total", "spectrum"])
def test_slopes_of_a_field_are_differences_of_spectra_traced_beside(field, quantity):
    found = field.slope(OFF_BORDERS, quantity=quantity, step_m=0.02)
    for k, place in enumerate(OFF_BORDERS):
        for axis, step in enumerate(0.02 * np.eye(3)):
            sides = [field.spectrum(place + way * step).path_gain.astype(float) for way in (1, -1)]
            up, down = (g if quantity == "spectrum" else g.sum() for g in sides)
            expected = 10 * np.log10((up + field.floor) / (down + field.floor)) / 0.04
            np.testing.assert_allclose(found[k, ..., axis], expected, rtol=1e-3, atol=1e-3)
    assert np.abs(found).max() > 1.0
    one = field.slope(OFF_BORDERS[0], quantity=quantity, step_m=0.02)
    assert one.shape == ((3,) if quantity == "total" else (*field.shape, 3))
    np.testing.assert_allclose(one, found[0], rtol=1e-5, atol=1e-3)


def test_slopes_of_what_no_field_has_are_refused(field):
    with pytest.raises(ValueError, match="quantity"):
        field.slope(UNSEEN[0], quantity="delay")
    with pytest.raises(ValueError, match="step_m"):
        field.slope(UNSEEN[0], step_m=-0.01)


def test_receivers_traced_at_once_get_what_each_gets_alone(field):
    tracer = field.tracer().on_grid((20, 40), 1)
    places = np.concatenate([OFF_BORDERS, OTHERS[:1]])
    together = path_gains(tracer.view(places, field.effects), field.state).apart
    for place, found in zip(places, together, strict=True):
        alone = path_gains(tracer.view(place, field.effects), field.state)
        assert len(alone.specular) > 1 and alone.by_ray().max() > 0
        np.testing.assert_allclose(found.specular, alone.specular, rtol=1e-12)
        np.testing.assert_allclose(found.by_ray(), alone.by_ray(), rtol=1e-6)
        np.testing.assert_array_equal(found.view.receivers, alone.view.receivers)
        np.testing.assert_array_equal(found.view.hits.face, alone.view.hits.face)
        np.testing.assert_allclose(found.view.paths.arrival, alone.view.paths.arrival, atol=1e-12)


def test_squares_of_pixels_count_by_solid_angle(scene, field):
    one = furnished.spectra(scene, UNSEEN[:1])
    even = replace(one, path_gain=np.full_like(one.path_gain, 1e-12))
    (weight,) = Question(field, as_data(field, even)).weights
    share = weight.reshape(one.shape) ** 2 / pixel_solid_angles(one.shape)[:, None]
    np.testing.assert_allclose(share, share.mean(), rtol=1e-6)


def test_slopes_hold_near_where_they_were_taken(scene, field):
    question = Question(field, as_data(field, furnished.spectra(scene, UNSEEN[:1])))
    there = question.errors(UNSEEN[0] + 0.05, 0.1, quick=True)
    near = question.errors(UNSEEN[0] + 0.02, 0.1, quick=True, near=there)
    anew = question.errors(UNSEEN[0] + 0.02, 0.1, quick=True)
    np.testing.assert_array_equal(near.rise, there.rise)
    np.testing.assert_allclose(near.error, anew.error, atol=1e-5)
    np.testing.assert_array_equal(near.sloped, there.unknown)
    assert not np.allclose(anew.rise, there.rise)


def test_slopes_are_taken_anew_farther_away_than_they_were_taken_over(scene, field, monkeypatch):
    errors, gone = Question.errors, []

    def watched(question, unknown, step_m, *, quick, near=None):
        if near is not None:
            gone.append(np.linalg.norm((unknown - near.sloped)[:3]) / near.step_m)
        return errors(question, unknown, step_m, quick=quick, near=near)

    monkeypatch.setattr(Question, "errors", watched)
    field.locate(furnished.spectra(scene, UNSEEN[:1]))
    Question(field, as_data(field, furnished.spectra(scene, UNSEEN[:1]))).descend(UNSEEN[0] + 0.6, quick=True)
    assert gone and max(gone) < 1.0


def test_most_places_lie_within_their_ellipsoid(scene, field):
    """Of 95 %, from another engine's spectra; nor is it many times too large."""
    places = np.concatenate([UNSEEN, OTHERS, [[2.6, 1.1, 1.0], [3.4, 3.2, 1.8], [1.2, 1.9, 2.1]]])
    ds, squares = furnished.spectra(scene, places), []
    for k, true in enumerate(places):
        found = field.locate(ds.subset([k]))
        off = found.position - true
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert np.mean(np.array(squares) < 7.81) > 0.6 and np.median(squares) > 0.5
