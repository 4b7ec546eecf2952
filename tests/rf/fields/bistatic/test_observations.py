"""What is read of paths, delay profiles and horns among it, as sums of records; and slopes of all of it by materials."""

import copy
import pickle
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import warp as wp
from furnished import RECEIVERS, SHAPE, SIGMA, TX, F, spectra
from radio_scenes import as_fits_predict, observation

from warprrf.rf.channel.array_spectra import UP, hemisphere
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic import gauss_newton as fitting
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.gauss_newton import Problem, _normal_equations
from warprrf.rf.fields.bistatic.measured import ArrayImage, SpectrumPixels, WeighedPaths, read
from warprrf.rf.fields.bistatic.measured import slopes as slopes_of
from warprrf.rf.fields.bistatic.merging import _costs
from warprrf.rf.fields.bistatic.observations import OWN_GAIN, Target, observe, places_of
from warprrf.rf.spectra.antenna import horn
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.readings import Readings, path_weights
from warprrf.rf.tracing.model import SETS, Effects, Layout
from warprrf.rf.tracing.records import Bins, Materials
from warprrf.rf.tracing.render import PathGains, irradiance, materials_of
from warprrf.rf.tracing.tracer import SPECULAR

RX = RECEIVERS[0]
SINGLE, EVERYTHING = replace(SETS["single"], residual=False), Effects(residual=False)


def delay_profile(view):
    """Power in windows of 2 ns, summed over all directions."""
    start = np.arange(0.0, 50e-9, 2e-9)

    def weigh(arrival, departure, delay_s):
        return (delay_s >= start[:, None]) & (delay_s < start[:, None] + 2e-9)

    return WeighedPaths.of(view, weigh, arrival=True, departure=False, delay_step_s=2e-9)


@pytest.fixture(scope="module")
def field(scene):
    return BistaticField.prior(scene, spectra(scene, RX[None]), effects=SINGLE)


def test_whatever_is_read_below_a_floor_says_that_there_was_no_more_than_that(field):
    """Another reading's floor may lie far below it."""
    view, floor = field.view(RX), np.array([1e-13, 1e-9, 1e-9, 1e-9])
    angles = np.column_stack([np.full(4, np.pi / 2), [0.0, 1.0, 2.0, 3.0]])
    errors = []
    for power in ([2e-10, 1e-9, 1e-9, 1e-9], [2e-10, 0.0, 1e-11, 0.9e-9]):
        one = Readings(
            TX, RX, np.array(power), F, floor, arrival=angles, receive_pattern=horn(np.radians(20.0))
        )
        (place,) = places_of([one], None, None)
        (o,) = observe([one], [(place, view)], F, [])
        assert o.target.censored.tolist() == [False, True, True, True]
        errors.append(o.target.error(np.array([2e-10, 5e-10, 9e-10, 4e-9]) / o.floor))
    np.testing.assert_array_equal(*errors)
    assert not errors[0][1:3].any() and errors[0][3] > 3.0


def test_a_delay_profile_is_the_sum_of_its_paths(field):
    view = field.view(RX)
    profile = delay_profile(view)
    found = as_fits_predict(observation(view, profile, field.floor), SINGLE, field.parameters) * field.floor
    gains = field.path_gains(view)
    ray = np.flatnonzero(view.hits.face >= 0)
    length = np.linalg.norm(view.hits.points(ray) - TX, axis=1) + view.hits.range_m[ray]
    edges = SPEED_OF_LIGHT * np.arange(0.0, 51e-9, 2e-9)
    expected = np.histogram(length, edges, weights=gains.single[ray])[0]
    expected += np.histogram(view.paths.length_m, edges, weights=gains.specular)[0]
    np.testing.assert_allclose(read(gains, profile), expected, rtol=1e-4)  # rays at a window's edge
    assert (expected > 0).sum() >= 5
    # three components resolve the Fresnel curves to a few parts in a thousand
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-3 * expected.max())
    assert found.sum() == pytest.approx(expected.sum(), rel=0.01)


def test_places_where_a_horn_is_turned_alike_share_a_table(field):
    """It says what a table of each place's own says, and memory does not grow with the places."""
    places, azimuth = RX + [[0.0, 0, 0], [0.3, -0.4, 0.2]], np.linspace(-3.0, 3.0, 7)
    arrival = np.tile(np.column_stack([np.full(7, 1.5), azimuth]), (2, 1))
    horns = Readings(
        TX,
        np.repeat(places, 7, axis=0),
        np.full(14, 1e-9),
        F,
        1e-15,
        arrival=arrival,
        receive_pattern=horn(0.3),
    )
    views, data = [field.view(place) for place in places], [horns]
    where = places_of(data, field.mesh, None)
    shared = [one.measured for one in observe(data, list(zip(where, views, strict=True)), 1.0, [])]
    assert shared[0].of_bin is shared[1].of_bin and shared[0].batch_key == shared[1].batch_key
    own = [
        WeighedPaths.of(
            view, partial(path_weights, horns, place.rows), arrival=True, departure=False, delay_step_s=None
        )
        for view, place in zip(views, where, strict=True)
    ]
    some = np.array([5, 2])
    for a, b, view in zip(shared, own, views, strict=True):
        gains = field.path_gains(view)
        expected = read(gains, b)
        np.testing.assert_allclose(read(gains, a), expected, rtol=1e-3)
        np.testing.assert_allclose(read(gains, a.part(some)), expected[some], rtol=1e-3)
        back = [m.to_bins(np.eye(7)[:, some])[m.bins(view)[0]] for m in (a, b)]
        back += [m.part(some).to_bins(np.eye(2))[m.bins(view)[0]] for m in (a, b)]
        for found in back[1:]:
            np.testing.assert_allclose(found, back[0], rtol=0.05, atol=1e-3 * back[0].max())


def differences(ask, x, step):
    """Slopes of the readings ``ask(x)`` by each parameter, shape (parameters, readings)."""
    steps = step * np.eye(len(x))
    return np.stack([(ask(x + s) - ask(x - s)) / (2.0 * step) for s in steps])


def dense(table, index, layout):
    """A Jacobian with the rows of what is not seen: zeros."""
    whole = np.zeros((layout.size, table.shape[1]))
    whole[index] = table
    return whole


def array_image(view):
    """Half a hemisphere as an array of 4 x 4 elements sees it, whose paths' lengths are known to 0.4 mm."""
    array, directions = PlanarArray(4, 4, orientation=UP), hemisphere((18, 36)).reshape(-1, 3)
    return ArrayImage.of(view, array, directions, 0.0004).part(np.arange(0, len(directions), 13))


def pixels(view):
    return SpectrumPixels(BeamOperator(SHAPE, SIGMA), np.arange(0, SHAPE[0] * SHAPE[1], 7))


@pytest.mark.parametrize(
    ("measured", "effects", "how"),
    [
        (delay_profile, SINGLE, {}), (array_image, SINGLE, {}), (pixels, SINGLE, {}),
        (pixels, replace(EVERYTHING, line_of_sight=False, mirrors=0), {}),  # without beams of single paths, that drown it
        (delay_profile, SINGLE, {"ratio": 0.6}), (array_image, SINGLE, {"chain": OWN_GAIN}),
    ],
)  # fmt: skip
def test_errors_of_a_fit_have_the_slopes_of_differences(field, measured, effects, how):
    """Also at another carrier, and where the readings' common gain is unknown."""
    view, rng = field.view(RX), np.random.default_rng(5)
    o = observation(view, measured(view), field.floor, **how)
    power = as_fits_predict(o, effects, field.parameters)
    o = observation(view, measured(view), field.floor, 10 * np.log10(1 + np.roll(power, 3)), **how)
    groups, lobes = field.parameters.log_weight.shape
    layout = Layout(groups, lobes, gain=True, roughness="ratio" in how)
    x = layout.pack(replace(field.parameters, log_gain=0.1)) + rng.normal(0.0, 0.3, layout.size)
    p = layout.unpack(x, field.parameters)
    problem = Problem.of([o], effects, np.arange(groups), p, gain_offset=True)
    ((_, table, index),) = problem.linearised(p, layout)
    slopes = differences(lambda x: next(problem.linearised(layout.unpack(x, p), layout))[0], x, 0.02)
    caught = []
    for place, (row, slope) in enumerate(zip(dense(table, index, layout), slopes, strict=True)):
        allowed = 0.1 if place % layout.stride == layout.lobes else 0.01  # that of permittivity is a table's
        bound = allowed * np.abs(slope).max() + 1e-4
        assert np.abs(row - slope).max() <= bound
        caught.append(np.abs(1.2 * row - slope).max() > bound)
    assert np.mean(np.array(caught)[index]) > 0.7  # planted errors, but those of what is hardly seen


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("reciprocal", [False, True])
def test_slopes_of_records_of_every_sequence_are_those_of_differences(scene, reciprocal):
    """In float64 and summed by pixels; what comes to the elements that send is held. And, in float32, what is read of
    all. What Warp's tape says is in tests/gradients."""
    field = BistaticField.prior(scene, spectra(scene, RX[None]), effects=EVERYTHING, reciprocal=reciprocal)
    view, side = field.view(RX), field.surface.side_group
    got = irradiance(view.tracer, field.parameters, EVERYTHING)
    groups, lobes = field.parameters.log_weight.shape
    layout = Layout(groups, lobes, through=True)
    x = layout.pack(field.parameters) + np.random.default_rng(1).normal(0.0, 0.3, layout.size)

    def materials(x):
        p = layout.unpack(x, field.parameters)
        return Materials(p, view.tracer.slabs, None, side, got * p.scattered_share[side] / np.pi)

    def sums(records, own, x):
        return np.bincount(own, records.powers(materials(x)))

    where = layout.stride * np.arange(groups)
    for name, records in view.traced(EVERYTHING).items():
        exact = replace(records, power=records.power.astype(float))
        own = records.ray if name == SPECULAR else records.ray // view.tracer.grid.per_pixel
        bins = Bins.of(own, int(own.max()) + 1)
        found = np.zeros((bins.count, layout.size))
        exact.add_slopes(materials(x), bins, where, found)
        slopes = differences(partial(sums, exact, own), x, 1e-5)
        largest = np.abs(slopes).max(axis=1)
        seen = largest > 1e-9 * largest.max()
        rounding = (
            np.finfo(float).eps * sums(exact, own, x).max() / 1e-5
        )  # all that differences tell of the others
        bound = np.where(seen, 1e-7 * largest, rounding)
        assert (np.abs(found.T - slopes).max(axis=1) <= bound).all(), name
        assert (np.abs((1 + 1e-6) * found.T - slopes).max(axis=1) > bound)[seen].all() and seen.any(), name
    o = observation(view, pixels(view), field.floor)
    table, index = slopes_of(view, o.measured, EVERYTHING, materials(x), layout)
    table = table / field.floor
    tables = view.traced(EVERYTHING)

    def predicted(x):
        powers = {name: records.powers(materials(x)) for name, records in tables.items()}
        return o.of_gains(PathGains(view, powers, tables, field.parameters))

    slopes = differences(predicted, x, 0.02)
    rounding = np.finfo(np.float32).eps * predicted(x).max() / 0.02
    bound = 5e-3 * np.abs(slopes).max(axis=1) + rounding
    assert (np.abs(dense(table, index, layout) - slopes).max(axis=1) <= bound).all()


def test_a_used_field_is_copied_and_pickled(field):
    field = replace(field, device=wp.get_device("cpu"))
    expected, kept = field.spectrum(RX).path_gain, field.surface.parts
    assert len(kept.parted)
    for again in (copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
        assert (
            not {"tiles", "parts"} & vars(again.surface).keys()
        )  # these made a pickle of an office 20 times as large
        np.testing.assert_array_equal(again.spectrum(RX).path_gain, expected)


def test_what_was_traced_for_old_transmitters_and_dropped_fields_goes(field):
    traced = []
    for x in np.linspace(0.5, 1.5, 10):
        again = copy.deepcopy(field)
        traced.append(weakref.ref(again.tracer([x, 0.9, 2.2])))
        again.spectrum(RX, [x, 0.9, 2.2])
        del again  # no reference cycle: nothing waits for the garbage collector
        assert sum(t() is not None for t in traced) <= 6


@pytest.mark.parametrize(
    "kinds",
    [
        [
            (pixels, {}),
            (delay_profile, {"chain": 0}),
            (pixels, {"chain": OWN_GAIN}),
            (delay_profile, {"chain": 1}),
        ],
        [(array_image, {"chain": OWN_GAIN}), (array_image, {})],
        [(pixels, {"ratio": 0.6}), (pixels, {}), (array_image, {})],
    ],
    ids=["chains", "phases", "carriers"],
)
def test_many_places_are_fitted_to_as_each_alone(scene, kinds, monkeypatch):
    """Objective, slopes and what merging asks of observations together are the sums of what each has, however they are put
    into tables, with trust, censored readings and gains of their own."""
    rng = np.random.default_rng(8)
    field = BistaticField.prior(scene, spectra(scene, RX[None]), effects=SINGLE)
    groups, lobes = field.parameters.log_weight.shape
    observations = []
    for k, (measured, how) in enumerate(kinds):
        view = field.view(RECEIVERS[k])
        o = observation(view, measured(view), field.floor, **how)
        count = len(o.target.db)
        target = Target(rng.uniform(0.0, 40.0, count), rng.uniform(0.1, 2.0, count) if k % 2 else None)
        target = replace(target, censored=rng.random(count) < 0.3) if k == 0 else target
        observations.append(replace(o, target=target, huber_db=3.0 + k))
    chains = 1 + max(o.chain for o in observations)
    p = replace(field.parameters, log_gains=rng.normal(0.0, 0.3, max(chains, 0)), log_gain=0.1)
    p = replace(p, log_weight=p.log_weight + rng.normal(0.0, 0.5, p.log_weight.shape))
    layout = Layout(groups, lobes, gain=True, roughness=True, chains=max(chains, 0))
    material = np.arange(groups)

    def asked(some):
        problem = Problem.of(some, SINGLE, material, p, chains=max(chains, 0), gain_offset=True)
        losses = [batch.fit_loss(batch.gain(p, x) * x).sum() for batch, _, x in problem.evaluated(p)]
        return sum(losses), *_normal_equations(problem, p, layout), _costs(problem, p, material, material)

    alone = [sum(parts) for parts in zip(*(asked([o]) for o in observations), strict=True)]
    together = asked(observations)
    monkeypatch.setattr(fitting, "MOST_NUMBERS", 1)
    for found in (together, asked(observations)):
        for mine, theirs in zip(found, alone, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-5 * np.abs(theirs).max())
    assert np.abs(together[0] - asked(observations[1:])[0]) > 1.0


def test_light_over_several_surfaces_is_kept_apart_by_its_most_scatterings(field):
    view = field.view(RECEIVERS[0])
    o = observation(view, pixels(view), field.floor)
    twice, thrice = (
        o.further(effects, materials_of(view.tracer, field.parameters, effects))[1].sum()
        for effects in (replace(SETS["room"], scatterings=count) for count in (2, 3))
    )
    assert thrice > 1.01 * twice > 0
