"""The bistatic field: laws it must obey, a fit to deterministic spectra of a furnished room, and hard cases."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from furnished import MATERIALS, RECEIVERS, ROOM, SHAPE, SIGMA, TX, F, spectra
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined, mirror_paths, observation

from warprrf.geometry.mesh import Mesh
from warprrf.rf.channel.array_spectra import UP, hemisphere
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.fresnel import fresnel_curves, slab_transmission
from warprrf.rf.em.materials import Material, itu_material
from warprrf.rf.em.waves import NEPER, SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic import fit as fitting
from warprrf.rf.fields.bistatic import gauss_newton as newton
from warprrf.rf.fields.bistatic import training
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.gauss_newton import Problem, layout_of
from warprrf.rf.fields.bistatic.measured import ArrayImage, SpectrumPixels, WeighedPaths
from warprrf.rf.fields.bistatic.merging import _mirror_changes
from warprrf.rf.fields.bistatic.observations import Columns
from warprrf.rf.fields.bistatic.options import FitOptions
from warprrf.rf.fields.bistatic.training import trace
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.lookups import nearest
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.spectra.spectrum import spread, sub_pixel_directions, to_db
from warprrf.rf.tracing.model import SETS, Effects, Layout, Parameters
from warprrf.rf.tracing.records import Materials
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import SPECULAR

WAVELENGTH = SPEED_OF_LIGHT / F


@pytest.fixture(scope="module")
def data(scene):
    return spectra(scene)


@pytest.fixture(scope="module")
def field(scene, data):
    return RadioField.fit(scene, data.subset(np.arange(6)))


def psnr(field, ds, transmitter=None):
    return evaluate(ds, lambda rx: field.spectrum(rx, transmitter))["psnr_db"]


def test_spectra_that_would_not_fit_into_memory_are_refused(scene, data, monkeypatch):
    monkeypatch.setattr(training, "MOST_RAYS", 10 * 24 * 48 * 4 - 1)
    with pytest.raises(ValueError, match="ds: 10 spectra of 24 x 48 pixels take 4.6e.04 rays"):
        RadioField.fit(scene, data, sub_pixels=2)
    RadioField.fit(scene, data.subset(np.arange(9)), sub_pixels=2, effects="single", iterations=1)


@pytest.mark.parametrize("turned", [None, "azimuths from 0", "transposed", "in another order"])
def test_spectra_whose_pixels_are_counted_in_another_way_are_questioned(scene, data, turned):
    gain = {
        None: data.path_gain,
        "azimuths from 0": np.roll(data.path_gain, 24, axis=2),
        "transposed": data.path_gain.swapaxes(1, 2),
        "in another order": np.roll(data.path_gain, 1, axis=0),
    }[turned]
    told = {
        name: getattr(data, name) for name in ("receivers", "transmitter", "frequency_hz", "beam_sigma_rad")
    }
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        RadioField.fit(
            scene,
            SpectrumDataset.from_spectra(path_gain=gain, **told),
            effects="single",
            quick=True,
            iterations=1,
        )
    assert any("rows by zenith from 0" in str(w.message) for w in said) == (turned is not None)


def test_what_was_learned_under_another_transmitter_than_its_own_a_field_does_not_use(scene, data):
    """A first data set without receivers says where the field's own stands; all that was read is of another."""
    own = np.array([4.2, 3.4, 2.3])
    nothing = replace(data.subset([]), transmitter=own)
    known = {"effects": SETS["room"], "quick": True}
    field = RadioField.fit(scene, [nothing, data.subset(np.arange(4))], **known)
    assert np.array_equal(field.transmitter, own) and np.abs(field.residual[0]).max() > 0.1
    assert not field.residual[1].any()
    assert np.abs(RadioField.fit(scene, data.subset(np.arange(4)), **known).residual[1]).max() > 0.1


def test_where_nothing_was_measured_a_field_was_not_fitted(scene, data):
    gain = data.path_gain[:5].copy()
    gain[2] = np.nan
    known = {"effects": "single", "quick": True, "iterations": 2}
    field = RadioField.fit(scene, replace(data.subset(np.arange(5)), path_gain=gain), **known)
    other = RadioField.fit(scene, data.subset([0, 1, 3, 4]), **known)
    np.testing.assert_array_equal(field.fitted_on, other.fitted_on)
    np.testing.assert_array_equal(field.residual, other.residual)
    with pytest.raises(ValueError, match="measured: got a spectrum of NaN alone"):
        field.locate(replace(data.subset([2]), path_gain=gain[2:3]))


def test_a_field_is_scored_under_the_transmitter_of_the_spectra(scene, data):
    field, other = BistaticField.prior(scene, data), np.array([4.2, 3.4, 2.3])
    gain = field.spectrum(RECEIVERS[1:3], other).path_gain
    there = replace(data.subset([1, 2]), transmitter=other, path_gain=gain)
    assert (
        evaluate(there, field.spectrum)["psnr_db"]
        == evaluate(there, lambda rx: field.spectrum(rx, other))["psnr_db"]
        > 100
    )
    assert evaluate(there, lambda rx: field.spectrum(rx))["psnr_db"] < 40
    with pytest.raises(ValueError, match=r"test: got 140 GHz, expected 300; field.at_frequency"):
        evaluate(replace(there, frequency_hz=140e9), field.spectrum)


def test_a_fit_to_many_keeps_no_records_and_is_the_same(scene, data, field, monkeypatch):
    """Of each ray 4 bytes of its face and 8 of its range; records alone would take 24."""
    monkeypatch.setattr(training, "MOST_KEPT", 0)
    traced = []
    monkeypatch.setattr(fitting, "trace", lambda *a, **o: traced.append(trace(*a, **o)) or traced[-1])
    again = RadioField.fit(scene, data.subset(np.arange(6)))
    ((seen, _),) = traced
    for _, view in seen:
        assert view.hits.face.nbytes + view.hits.range_m.nbytes == 12 * len(view.hits.face)
        assert set(view.records) == {SPECULAR}
    assert np.array_equal(again.residual, field.residual)
    for name in ("log_weight", "log_excess", "log_mirror"):
        assert np.array_equal(getattr(again.parameters, name), getattr(field.parameters, name))


def test_some_of_many_receivers_decide_and_all_are_learned_from(scene, data, field, monkeypatch):
    """Whether records are kept or traced again changes no bit; places that decide nothing are traced for what was chosen."""
    monkeypatch.setattr(training, "HELD_OUT", 0.4)
    monkeypatch.setattr(training, "MOST_TO_CHOOSE", 2)
    monkeypatch.setattr(training, "MOST_READINGS", 1500)
    seen, found = [], []
    for most in (training.MOST_KEPT, 0):
        monkeypatch.setattr(training, "MOST_KEPT", most)
        monkeypatch.setattr(fitting, "MOST_KEPT", most)
        traced = []
        monkeypatch.setattr(
            fitting, "trace", lambda *a, k=traced, **o: k.append((o, trace(*a, **o))) or k[-1][1]
        )
        found.append(RadioField.fit(scene, data))
        seen.append(traced)
    kept, again = found
    for (decide, (few, _)), (rest, (others, _)) in seen:
        assert (len(few), len(others)) == (8, 2)
        assert few[0][1].tracer is others[0][1].tracer  # what belongs to the transmitter is made once
        assert decide["effects"] is None and rest["effects"] == replace(kept.effects, residual=True)
    again_traced, kept_traced = (traced[1][1][0][0][1].records for traced in (seen[1], seen[0]))
    assert {SPECULAR} == set(again_traced) < set(kept_traced)
    assert np.array_equal(kept.residual, again.residual)
    assert kept.report["receivers"] == len(kept.fitted_on) == 10
    deciding, left = (np.concatenate([place.rows for place, _ in own]) for own in (few, others))
    alone = RadioField.fit(scene, data.subset(deciding))
    assert psnr(kept, data.subset(left)) > psnr(alone, data.subset(left)) + 0.5


def test_receivers_that_decide_are_spread_over_the_order_in_which_they_came():
    """A receiver that was carried along a line would else be known by the line's beginning."""
    place, held = SimpleNamespace(chain=""), np.arange(1, 100, 4)
    known = training.Training(FitOptions(), None, [], [place] * 100, held, [], None, None)
    for times in (1, 2):
        few = known.few(times)
        assert len(few) == times * training.MOST_TO_CHOOSE and not np.isin(few, held).any()
        assert few[0] == 0 and few[-1] == 99 and np.diff(few).max() <= 8


def test_of_seventy_receivers_some_decide(scene, data, field):
    """Trial fits ask for no receiver whose paths are not traced yet."""
    every = data.subset(np.tile(np.arange(6), 12)[:70])
    many = RadioField.fit(scene, every)
    assert many.report["receivers"] == 70
    assert psnr(many, data.subset(np.arange(6, 10))) > psnr(field, data.subset(np.arange(6, 10))) - 1.0


def test_places_refuse_a_choice_only_if_all_would(scene, data, monkeypatch):
    kept = []
    monkeypatch.setattr(
        fitting, "choose", lambda t, real=fitting.choose: kept.append((t, real(t))) or kept[-1][1]
    )
    RadioField.fit(scene, data)
    ((t, choice),) = kept
    for places in (t, replace(t, held=t.not_held[:2])):
        whole = places.choice_loss(choice)
        for share in (0.1, 0.5, 0.9, 0.999, 1.001, 1.1, 2.0):
            found = places.choice_loss(choice, share * whole)
            assert (found < share * whole) == (share > 1.0)
            assert found == whole or share < 1.0
        assert places.choice_loss(choice, 0.1 * whole) != whole  # of some places alone


def test_ten_times_better_than_the_nearest_measurement(field, data):
    test = data.subset(np.arange(6, 10))
    ours = evaluate(test, field.spectrum)
    copied = evaluate(test, nearest(data.subset(np.arange(6))))
    assert ours["psnr_db"] > copied["psnr_db"] + 10
    assert ours["psnr_db"] > 36
    assert ours["direction_within_3deg"] == 1.0
    assert ours["tof_error_median_ns"] < 0.1


def test_a_transmitter_never_seen_is_as_good(scene, field, data):
    other = np.array([4.3, 3.2, 2.4])
    moved = spectra(scene, RECEIVERS[[2, 4, 6, 8]], transmitter=other)
    assert psnr(field, moved, other) > psnr(field, data.subset(np.arange(6, 10))) - 4
    assert psnr(field, moved, other) > psnr(field, moved) + 8  # and it does depend on the transmitter


def test_a_view_is_of_its_link_and_of_no_fewer_mirrors(field):
    view = field.view(RECEIVERS[3])
    assert field.spectrum(RECEIVERS[3], TX, view=view).total_path_gain > 0
    for asked in ((RECEIVERS[2], TX), (RECEIVERS[3], TX + 0.1)):
        for ask in (field.spectrum, field.paths):
            with pytest.raises(ValueError, match=r"view: got one of (receivers|transmitter) \["):
                ask(*asked, view=view)
    fewer = replace(field, effects=replace(field.effects, mirrors=0))
    assert fewer.spectrum(RECEIVERS[3], view=view).total_path_gain > 0
    with pytest.raises(ValueError, match=r"view: got one of \[0, 0, 0\] mirrors, slabs and edges"):
        field.path_gains(fewer.view(RECEIVERS[3]))


def test_paths_carry_the_spectrum_and_line_of_sight_is_exact(field):
    paths, spectrum = field.paths(RECEIVERS[3]), field.spectrum(RECEIVERS[3])
    assert paths.power.sum() == pytest.approx(spectrum.total_path_gain, rel=1e-5)
    los = paths.kind == "los"
    distance = np.linalg.norm(RECEIVERS[3] - TX)
    assert los.sum() == 1
    assert paths.tau[los][0] == pytest.approx(distance / SPEED_OF_LIGHT, rel=1e-12)
    assert paths.power[los][0] == pytest.approx((WAVELENGTH / (4 * np.pi * distance)) ** 2, rel=1e-9)
    assert set(paths.kind) == {"los", "mirror", "diffuse"}
    several = field.paths(RECEIVERS[:2], max_paths=5)
    assert several.gain.shape == (2, 5)


def test_a_view_is_of_the_field_that_it_is_given_to(field):
    view, place = field.view(RECEIVERS[3]), RECEIVERS[3]
    assert np.array_equal(
        field.spectrum(place, view=view).path_gain,
        field.spectrum(place, shape=field.shape, view=view).path_gain,
    )
    box = Mesh(*box_mesh([1.0, 3.0, 0.5], [1.5, 3.5, 1.0]))
    others = [
        field.at_frequency(140e9), field.with_gas(), field.on_grid((12, 24)),
        field.with_objects({"box": box}, materials={"box": field.surface.group_names[0]}),
    ]  # fmt: skip
    for other in others:
        for ask in (other.spectrum, other.paths):
            with pytest.raises(ValueError, match="view: got one of another geometry, carrier, air or grid"):
                ask(place, view=view)
    with pytest.raises(ValueError, match="max_paths: got -1"):
        field.paths(place, max_paths=-1, view=view)


def test_before_any_spectrum_the_field_is_that_of_the_prior(scene, data):
    prior = BistaticField.prior(scene, data)
    unfitted = BistaticField.fit(scene, data.subset([0]), iterations=0)
    image = prior.spectrum(RECEIVERS[4]).path_gain
    assert np.allclose(image, unfitted.spectrum(RECEIVERS[4]).path_gain, rtol=1e-6)
    dark = replace(data, path_gain=np.zeros_like(data.path_gain))
    assert np.array_equal(image, BistaticField.prior(scene, dark).spectrum(RECEIVERS[4]).path_gain)
    bare = BistaticField.prior(scene, data, effects=Effects(False, 0, 0, transmissions=0, diffractions=0))
    assert bare.spectrum(RECEIVERS[4]).path_gain.max() == 0


def test_an_uncalibrated_gain_is_found(scene, data):
    few = data.subset(np.arange(4))
    off = replace(few, path_gain=few.path_gain * np.float32(10**0.35), floor=few.floor * 10**0.35)
    found = RadioField.fit(scene, off, gain_offset=True)
    assert found.report["gain_offset_db"] == pytest.approx(3.5, abs=0.5)
    assert 0 < found.report["gain_offset_std_db"] < 0.5


def test_uncertainty_covers_the_error(field, data):
    errors, sigma = [], []
    for k in range(6, 10):
        found = field.spectrum(data.receivers[k], uncertainty=True)
        errors.append(found.path_gain_db - data[k].path_gain_db)
        sigma.append(found.std_db)
    ratio = np.abs(np.concatenate(errors) / np.concatenate(sigma))
    assert 0.45 < (ratio <= 1).mean() < 0.9
    assert (ratio <= 2).mean() > 0.75


def test_directions_that_were_not_measured_leave_the_others_their_errors(scene, field, data):
    """A single NaN pixel left a field without any."""
    part = data.path_gain[:6].copy()
    part[:, :5, ::3] = np.nan
    part = RadioField.fit(scene, replace(data.subset(np.arange(6)), path_gain=part))
    ratio = (
        part.spectrum(RECEIVERS[7], uncertainty=True).std_db
        / field.spectrum(RECEIVERS[7], uncertainty=True).std_db
    )
    assert 0.7 < np.median(ratio) < 1.4
    assert np.isfinite(ratio).all()


def test_what_parameters_leave_open_is_carried_to_the_pixels(field):
    """Of one material all lobes together: by differences of the spectrum."""
    bare = replace(field, effects=replace(SETS["single"], residual=False))
    place, step, p = RECEIVERS[3], 0.01, bare.parameters
    closed, lobes = np.zeros_like(field.errors.covariance), len(p.lobes)
    left_open = closed.copy()
    left_open[:lobes, :lobes] = 1.0

    def std_db(covariance):
        unsure = replace(bare, errors=replace(field.errors, covariance=covariance))
        return unsure.spectrum(place, uncertainty=True).std_db

    def db(by):
        weight = p.log_weight + by * (field.material == 0)[:, None]
        image = replace(bare, parameters=replace(p, log_weight=weight)).spectrum(place).path_gain
        return NEPER * np.log1p(image / field.floor)

    found = np.sqrt(std_db(left_open) ** 2 - std_db(closed) ** 2)
    slope = np.abs(db(step) - db(-step)) / (2.0 * step)
    assert slope.max() > 1.0
    np.testing.assert_allclose(found, slope, atol=0.02 * slope.max())


def test_the_beam_keeps_power_and_its_adjoint_is_one():
    beam = BeamOperator(SHAPE, SIGMA)
    rng = np.random.default_rng(1)
    x, y = rng.random((*SHAPE, 2)), rng.random((*SHAPE, 2))
    whole = beam(x)
    assert whole.sum() == pytest.approx(x.sum(), rel=1e-9)
    assert (whole * y).sum() == pytest.approx((x * beam.adjoint(y)).sum(), rel=1e-6)
    assert 0 < np.abs(beam(x, quick=True) - whole).max() < 3e-6 * whole.max()


def test_element_at_the_transmitter_is_bounded(field):
    near = field.spectrum([1.5, 1.0, 1.5], transmitter=[2.5, 2.0, 2.401]).path_gain  # 1 mm over the box
    assert np.isfinite(near).all()
    assert near.sum() < 1e-3  # not more than the source sends: (lambda / 4 pi d)^2 is 6e-9 at 1 m


def test_transmitter_in_a_patchs_plane_has_no_mirror_there(scene):
    surface = Surface.of(scene)
    found = mirror_paths(surface, np.array([0.5, 0.5, 2.4]), np.array([[4.0, 3.0, 2.0]]), WAVELENGTH, 1)
    top = np.flatnonzero((np.abs(surface.plane_offset - 2.4) < 1e-6) & (surface.plane_normal[:, 2] > 0.9))
    assert len(top) == 1
    assert not np.isin(found.patch[:, 0], top).any()


def test_a_receiver_one_millimetre_from_a_wall(scene, field):
    point = np.array([4.999, 2.0, 1.0])
    found = field.spectrum(point)
    truth = spectra(scene, point[None]).path_gain[0]
    assert np.isfinite(found.path_gain).all()
    error = to_db(found.path_gain, field.floor) - to_db(truth, field.floor)
    assert np.sqrt(np.mean(error**2)) < 3.0
    with pytest.raises(ValueError, match="surface"):
        field.spectrum([5.0, 2.0, 1.0])
    with pytest.raises(ValueError, match="transmitter"):
        field.spectrum(TX)


def test_a_receiver_in_full_shadow_gets_nothing_but_what_bounces(scene):
    # A closed shell around the receiver: nothing arrives.
    mesh, part = joined(
        ROOM,
        box_mesh([2.9, 1.9, 0.9], [4.1, 3.1, 2.1]),
        box_mesh([3.0, 2.0, 1.0], [4.0, 3.0, 2.0], inward=True),
    )
    part = np.minimum(part, 1)
    closed = RadioScene(mesh, part, MATERIALS)
    field = RadioField.fit(closed, spectra(closed, RECEIVERS[1:3]))
    dark = field.spectrum([3.5, 2.5, 1.5])
    assert dark.total_path_gain == 0.0
    assert np.isnan(dark.delay_s).all()
    assert len(field.paths([3.5, 2.5, 1.5]).gain) == 0


def test_an_empty_spectrum_is_refused_and_one_among_others_is_not(scene, data):
    nothing = replace(data.subset([0, 1]), path_gain=np.zeros((2, *SHAPE), np.float32))
    with pytest.raises(ValueError, match="no pixel above the floor"):
        RadioField.fit(scene, nothing)
    gain = data.subset([0, 1, 2]).path_gain.copy()
    gain[1] = 0
    assert np.isfinite(
        RadioField.fit(scene, replace(data.subset([0, 1, 2]), path_gain=gain))
        .spectrum(RECEIVERS[5])
        .path_gain
    ).all()


def glazed():
    """The room without its block, parted by a pane of 10 mm."""
    corner = [[2.6, y, z] for y, z in ((0, 0), (3, 0), (3, 3), (0, 3))]
    mesh, part = joined(ROOM, (np.array(corner), np.array([[0, 1, 2], [0, 2, 3]])))
    return RadioScene(mesh, part, [MATERIALS[0], SlabMaterial("glass", 6.31, 2.0, 0.01, 0.3)])


@pytest.mark.parametrize("most", [0, 3])
def test_a_fit_finds_whether_readings_have_what_slabs_let_through(most):
    scene = glazed()
    bare = spectra(scene, RECEIVERS, frequency_hz=140e9)
    effects = replace(SETS["single"], transmissions=most, residual=False)
    prior = BistaticField.prior(scene, bare, effects=effects)
    known = [prior.spectrum(receiver) for receiver in RECEIVERS]
    arrays = {
        name: np.stack([getattr(one, name) for one in known]) for name in ("path_gain", "delay_s", "aod")
    }
    field = RadioField.fit(scene, replace(bare, **arrays))
    assert field.effects.transmissions == most


def test_what_readings_would_change_by_is_known_of_slabs_too():
    """If glass became another material, whose slab it stays, its mirror paths and what it lets through change at once."""
    scene, carrier_hz = glazed(), 140e9
    effects = replace(SETS["single"], transmissions=3, residual=False)
    field = BistaticField.prior(scene, spectra(scene, RECEIVERS, frequency_hz=carrier_hz), effects=effects)
    view = field.view(RECEIVERS[3])
    assert (view.paths.slabs > 0).any()
    p = replace(field.parameters, log_excess=np.log([1.5, 6.0]), log_through=np.array([-0.7, -0.2]))
    o = observation(view, SpectrumPixels(field._beam), field.floor)
    ((batch, materials, _),) = Problem.of([o], effects, np.arange(2), p).evaluated(p)
    changed = _mirror_changes(batch, materials, np.arange(2))
    before, after = (Materials(p, view.tracer.slabs, np.array(material)) for material in ([0, 1], [0, 0]))
    powers = [view.records[SPECULAR].powers(own) for own in (after, before)]
    expected = (powers[0] - powers[1])[view.counted_paths(effects)] @ o.path[view.counted_paths(effects)]
    np.testing.assert_allclose(changed[1][0], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_an_array_s_slopes_are_those_of_what_counts_where_more_slabs_were_sought():
    """What its field passes is no parameter then: a path through glass, the last material, counts nothing."""
    scene, array = glazed(), PlanarArray(4, 4, orientation=UP)
    sought = replace(SETS["single"], transmissions=3, residual=False)
    field = BistaticField.prior(scene, spectra(scene, RECEIVERS, frequency_hz=140e9), effects=sought)
    view, fewer = field.view(RECEIVERS[3]), replace(sought, transmissions=0)
    assert 0 < view.counted_paths(fewer).sum() < view.counted_paths(sought).sum()
    o = observation(view, ArrayImage.of(view, array, hemisphere((18, 36)).reshape(-1, 3), 0.0), field.floor)
    problem = Problem.of([o], fewer, np.arange(2), field.parameters)
    layout = layout_of(problem, field.parameters)
    x, step = layout.pack(field.parameters), 1e-3

    def error(x):
        return next(problem.linearised(layout.unpack(x, field.parameters), layout))[0]

    ((_, table, index),) = problem.linearised(field.parameters, layout)
    for k, row in zip(index, table, strict=True):
        if k % layout.stride != layout.lobes:  # that of permittivity is a table's
            ends = [error(x + sign * step * (np.arange(layout.size) == k)) for sign in (1.0, -1.0)]
            slope = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(row, slope, atol=0.02 * np.abs(table).max())


def test_what_glass_lets_through_is_found_at_any_carrier_or_said_to_be_left_out():
    """Line of sight behind a pane is Friis's power less the slab's transmission."""
    scene, carrier_hz = glazed(), 140e9
    known = spectra(scene, RECEIVERS[[1, 3, 4, 7]], frequency_hz=carrier_hz)
    with pytest.warns(UserWarning, match="transmission is not modelled.* 2 of 2 blocked receivers") as told:
        RadioField.fit(scene, known, quick=True, effects=SETS["single"])
    assert told[0].filename == __file__
    assert RadioField.fit(scene, known, quick=True).effects.transmissions == 0  # these spectra have none
    field = RadioField.fit(scene, known, quick=True, effects=replace(SETS["single"], transmissions=3))
    before = replace(field, parameters=replace(field.parameters, log_through=np.zeros(2)))
    for receiver in RECEIVERS[[3, 4]]:
        way = TX - receiver
        friis = field.wavelength_m / (4 * np.pi * np.linalg.norm(way))
        eta = itu_material("glass").extrapolated().permittivity(carrier_hz)
        waves = slab_transmission(abs(way[0]) / np.linalg.norm(way), eta, 0.01, field.wavelength_m)
        view = before.view(receiver)
        sight = before.path_gains(view).specular[(view.paths.order == 0) & (view.paths.slabs == 1)]
        assert sight == pytest.approx(friis**2 * np.mean(np.abs(waves) ** 2), rel=1e-6)


@pytest.mark.parametrize("carrier_hz", [28e9, 140e9, 300e9])
def test_what_a_slab_is_made_of_does_not_hang_on_what_it_is_called(carrier_hz):
    """A material of ITU-R P.2040 under a name of its own, and one of several bands that is in no recommendation."""
    glass = itu_material("glass", thickness_m=0.01)
    mesh, part = joined(ROOM, box_mesh([2.5, 0.0, 0.0], [2.51, 4.0, 3.0]))
    frame = SpectrumDataset.empty(transmitter=TX, frequency_hz=carrier_hz, shape=(12, 24))
    effects, found = Effects(mirrors=0, scatterings=0, transmissions=1, diffractions=0), []
    for one in glass, replace(glass, name="window"), replace(glass, name="screen", itu=None):
        scene = Scene(mesh, [Material("walls", ()), one], part)
        field = BistaticField.prior(scene, frame, effects=effects)
        assert field.surface.slab_properties(carrier_hz)[0][1] == pytest.approx(
            glass.permittivity(carrier_hz)
        )
        found.append(field.links(RECEIVERS[3]).total_path_gain)
    np.testing.assert_allclose(found, found[0], rtol=1e-6)


@pytest.mark.parametrize("known", [True, False])
def test_walls_let_through_at_another_carrier_what_they_are_taken_to_there(known):
    """Of a fit to nothing: slabs count in wavelengths, whether their material is known or assumed."""
    glass = itu_material("glass", thickness_m=0.01) if known else Material("pane", ())
    mesh, part = joined(ROOM, box_mesh([2.5, 0.0, 0.0], [2.51, 4.0, 3.0]))
    scene = Scene(mesh, [itu_material("concrete"), glass], part)
    effects = Effects(mirrors=0, scatterings=0, transmissions=1, diffractions=0, residual=False)
    carriers = np.array([3.5e9, 28e9, 140e9, 300e9])
    frames = [SpectrumDataset.empty(transmitter=TX, frequency_hz=f, shape=(12, 24)) for f in carriers]
    fields = [BistaticField.prior(scene, frame, effects=effects) for frame in frames]
    total = np.array([one.links(RECEIVERS[3]).total_path_gain for one in fields])
    assert (np.diff(NEPER * np.log(total * carriers**2)) < -3.0).any()  # more than free space takes
    for one in fields:
        found = [one.at_frequency(f).links(RECEIVERS[3]).total_path_gain for f in carriers]
        np.testing.assert_allclose(found, total, rtol=1e-6)


@pytest.mark.parametrize("ratio", [0.4, 3.0])
def test_slopes_at_another_carrier_are_those_of_differences(ratio):
    p = replace(Parameters.prior(3, (0, 4)), log_through=np.array([-0.7, -0.05, 0.1]))
    layout = Layout(3, 2, through=True, gain=True, roughness=True)
    x, step = layout.pack(p), 1e-5
    ends = [x + sign * step * np.eye(layout.size) for sign in (1.0, -1.0)]
    there = [[layout.pack(layout.unpack(row, p).at_ratio(ratio)) for row in end] for end in ends]
    slopes = (np.array(there[0]) - np.array(there[1])).T / (2.0 * step)
    np.testing.assert_allclose(layout.slopes_at_ratio(p, ratio).toarray(), slopes, atol=1e-8)


def test_an_open_room_s_fit_leaves_nothing_out(scene, data):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        field = RadioField.fit(scene, spectra(scene, RECEIVERS, frequency_hz=140e9), quick=True)
    estimate = field.report["left_out"]
    assert len(estimate["receivers"]) == 3 and max(estimate["diffraction"] + estimate["transmission"]) < 0.5


def test_effects_may_change_after_the_fit(field):
    place = RECEIVERS[3]
    all_on, bare = (replace(field, effects=e) for e in (Effects(), Effects(True, 0, 0)))
    more, less = (one.spectrum(place, uncertainty=True) for one in (all_on, bare))
    assert more.total_path_gain > field.spectrum(place).total_path_gain > less.total_path_gain > 0
    assert np.isfinite(more.std_db).all()
    assert (all_on.at_frequency(F).spectrum(place, uncertainty=True).std_db == more.std_db).all()


def test_one_training_receiver_is_enough_for_a_field(scene, data):
    single = RadioField.fit(scene, data.subset([0]))
    assert psnr(single, data.subset(np.arange(6, 10))) > 30
    with pytest.raises(ValueError, match="no receiver was held out of this field's fit to 1,"):
        single.spectrum(RECEIVERS[5], uncertainty=True)


def test_duplicate_receivers_change_little(scene, data):
    once = RadioField.fit(scene, data.subset([0, 1]))
    twice = RadioField.fit(scene, data.subset([0, 1, 0, 1][:3]))
    a, b = (to_db(f.spectrum(RECEIVERS[8]).path_gain, data.floor) for f in (once, twice))
    assert np.sqrt(np.mean((a - b) ** 2)) < 0.5


def test_the_beam_operator_is_the_beam_of_every_pixel():
    beam = BeamOperator(SHAPE, SIGMA)
    rng = np.random.default_rng(6)
    directions = sub_pixel_directions(SHAPE, 4)[0].reshape(*SHAPE, -1, 3)[:, 0]
    images = 10.0 ** rng.uniform(-12, -4, (*SHAPE, 2))
    images[:3] = 0.0
    expected = np.zeros_like(images)
    for i in range(SHAPE[0]):
        one = spread(directions[i], np.full(16, 1.0 / 16.0), SHAPE, SIGMA)  # of the row's first pixel
        for j in range(SHAPE[1]):
            expected += np.roll(one, j, axis=1)[..., None] * images[i, j]
    found = beam(images)
    np.testing.assert_allclose(found, expected, atol=1e-13 * expected.max())
    pixels = np.array([5, 400, 777])
    some = beam.at(pixels) @ images.reshape(-1, 2)
    np.testing.assert_allclose(some, expected.reshape(-1, 2)[pixels], rtol=1e-5)


def test_a_set_keeps_its_name_with_other_mirrors_and_edges(scene, data):
    with_edges = replace(SETS["single"], mirrors=2, diffractions=1, residual=False)
    for effects, name in (with_edges, "Effects"), (replace(with_edges, residual=True), "single"):
        field = RadioField.fit(scene, data.subset(np.arange(8)), effects=effects, sub_pixels=1, iterations=1)
        assert field.report["choices"][0]["term"].startswith(name)


def test_receivers_held_out_choose_effects_alone(scene, data):
    """Two of them refuse a residual, or fewer materials, by chance."""
    wrong = np.random.default_rng(3).uniform(0.1, 10.0, data.path_gain.shape)
    noisy = replace(
        data, path_gain=data.path_gain * wrong
    )  # nothing that is learned of places is true elsewhere
    field = RadioField.fit(scene, noisy.subset(np.arange(8)), sub_pixels=1, iterations=1)
    assert field.effects.residual and np.ptp(field.residual) > 0.1
    others = [
        choice
        for choice in field.report["choices"]
        if choice["term"] not in (*SETS, "no diffraction", "no transmission")
    ]
    assert all("materials as" in choice["term"] and choice["kept"] for choice in others)


@pytest.mark.parametrize(
    ("effects", "count", "joined"), [("auto", 5, False), ("room", 5, False), ("room", 8, True)]
)
def test_few_receivers_join_no_materials(scene, data, effects, count, joined):
    few = data.subset(np.arange(count))
    field = RadioField.fit(scene.mesh, few, effects=effects, sub_pixels=1, iterations=1)
    assert any("materials as" in choice["term"] for choice in field.report["choices"]) == joined


def test_a_quick_fit_tries_nothing_and_is_near(scene, data):
    few, test = data.subset(np.arange(6)), data.subset(np.arange(6, 10))
    quick = RadioField.fit(scene, few, quick=True)
    assert quick.sub_pixels == 1
    assert quick.effects in (SETS["single"], SETS["room"])
    assert {choice["term"] for choice in quick.report["choices"]} <= {"single", "room"}
    assert psnr(quick, test) > evaluate(test, nearest(few))["psnr_db"] + 8
    finer = RadioField.fit(scene, few, quick=True, sub_pixels=2, effects=Effects(mirrors=2))
    assert (finer.sub_pixels, finer.effects) == (2, Effects(mirrors=2))
    with pytest.raises(ValueError, match="sub_pixels"):
        RadioField.fit(scene, few, sub_pixels=0)


@pytest.mark.parametrize(
    ("effects", "slabs_count"), [("single", False), (Effects(mirrors=1, scatterings=1), True)]
)
def test_of_materials_a_fit_uses_their_names_and_what_makes_slabs_of_them(data, effects, slabs_count):
    """Permittivity and thickness, and these only for transmission and diffraction."""
    known = [itu_material("plasterboard"), itu_material("wood", thickness_m=0.02)]
    others = [replace(m, scattering=0.7, pattern="directive", alpha_r=7, xpd=0.2) for m in known]
    pane = np.array([[3.4, 0.01, 0.01], [3.4, 3.9, 0.01], [3.4, 3.9, 2.9], [3.4, 0.01, 2.9]])
    mesh, part = joined(ROOM, (pane, np.array([[0, 1, 2], [0, 2, 3]])))
    found = [
        RadioField.fit(Scene(mesh, materials, part), data.subset([0, 5]), quick=True, effects=effects)
        .spectrum(RECEIVERS[0])
        .path_gain
        for materials in (known, others, [replace(m, thickness_m=0.3) for m in known])
    ]
    np.testing.assert_array_equal(found[1], found[0])
    assert np.array_equal(found[2], found[0]) != slabs_count


def test_a_fit_goes_on_after_steps_that_were_cut_short(field, monkeypatch):
    """One weight has 9 nepers to go, 1.5 a step, while pixels that nothing explains hide how much each step gains."""
    lit, count = 20, 4020
    true = Parameters.prior(1, (0,))
    curves = fresnel_curves()
    single = np.zeros((1, 1, 3, count), np.float32)
    single[0, 0, :, :lit] = 200.0 * curves.at(curves.coordinates, true.log_excess)[0][0][:, None]
    columns = Columns(np.zeros(1, int), single, np.zeros(0, int), np.zeros((0, count), np.float32))
    target = np.full(count, 40.0)
    target[:lit] = NEPER * np.log1p(columns.power(true)[:lit])
    view = field.view(RECEIVERS[0])
    nowhere = np.full(len(view.hits.face), -1)  # the bin of each ray
    unlit = np.zeros((count, 1), np.float32), np.arange(count), np.zeros((len(view.paths), count), np.float32)
    o = observation(view, WeighedPaths(nowhere, *unlit), 1.0, target)
    problem = newton.Problem([o], [columns], Effects(True, 0, 0), np.zeros(1, int), energy_std=1e6)
    for name, loose in {"WEIGHT_STD": 1e3, "EXCESS_STD": 1e-3, "MIRROR_STD": 1e3}.items():
        monkeypatch.setattr(newton, name, loose)
    found = newton.gauss_newton(problem, replace(true, log_weight=true.log_weight - 9.0), 40)
    ((now, *_),) = problem.linearised(found.parameters, newton.layout_of(problem, true))
    assert len(found.losses) > 5
    assert np.abs(now[:lit]).max() < 0.1
    # Steps that go too far, as where light is no quadratic function of a parameter, end where they bring nothing.
    exact = newton._normal_equations
    monkeypatch.setattr(newton, "_normal_equations", lambda *own: (0.55 * exact(*own)[0], exact(*own)[1]))
    close = replace(true, log_weight=true.log_weight - 0.02)
    assert len(newton.gauss_newton(problem, close, 40).losses) < 3
