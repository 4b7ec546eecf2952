"""Anything that is linear in path powers is predicted, with its Jacobian, by one function: here a delay profile."""

import copy
import pickle
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import warp as wp
from furnished import RECEIVERS, SHAPE, SIGMA, TX, F, spectra
from radio_scenes import RadioScene

from warprrf.rf.channel.array_spectra import UP, hemisphere
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.fit import OWN_GAIN, Reading, Target
from warprrf.rf.fields.bistatic.materials import Layout, Parameters, Terms
from warprrf.rf.fields.bistatic.measured import ArrayImage, SpectrumPixels, WeighedPaths, read
from warprrf.rf.fields.bistatic.observations import observe, places_of
from warprrf.rf.fields.bistatic.render import path_powers
from warprrf.rf.fields.bistatic.response import Response, jacobian, predict, respond
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.readings import Readings, horn, path_weights

RX = RECEIVERS[0]


def delay_profile(view: ReceiverView) -> WeighedPaths:
    """Power in windows of 2 ns, summed over all directions."""
    start = np.arange(0.0, 50e-9, 2e-9)

    def weigh(arrival: np.ndarray, departure: np.ndarray, delay_s: np.ndarray) -> np.ndarray:
        return (delay_s >= start[:, None]) & (delay_s < start[:, None] + 2e-9)

    return WeighedPaths.of(view, weigh, arrival=True, departure=False, delay_step_s=2e-9)


@pytest.fixture(scope="module")
def field(scene: RadioScene) -> BistaticField:
    return BistaticField.prior(scene, spectra(scene, RX[None]), terms=Terms(mirror_order=1))


def test_a_delay_profile_is_the_sum_of_its_paths(field: BistaticField) -> None:
    view = field.view(RX)
    profile = delay_profile(view)
    response = respond(view, profile, field.terms, field.floor)
    found = predict(response, field.parameters) * field.floor
    powers = path_powers(view, field.materials, None)
    ray = np.flatnonzero(view.hits.face.numpy() >= 0)
    length = np.linalg.norm(view.hits.points(ray) - TX, axis=1) + view.hits.range_m.numpy()[ray]
    edges = SPEED_OF_LIGHT * np.arange(0.0, 51e-9, 2e-9)
    expected = np.histogram(length, edges, weights=powers.single[ray])[0]
    expected += np.histogram(view.paths.length_m, edges, weights=powers.mirror)[0]
    np.testing.assert_allclose(read(view, profile, powers), expected, rtol=1e-4)  # rays at a window's edge
    assert (expected > 0).sum() >= 5
    # three components resolve the Fresnel curves to a few parts in a thousand
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-3 * expected.max())
    assert found.sum() == pytest.approx(expected.sum(), rel=0.01)


def test_places_where_a_horn_is_turned_alike_share_a_table(field: BistaticField) -> None:
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
    shared = [one.measured for one in observe(data, where, views, 1.0)[0]]
    assert shared[0].of_bin is shared[1].of_bin and shared[0].alike == shared[1].alike
    own = [
        WeighedPaths.of(
            view, partial(path_weights, horns, place.rows), arrival=True, departure=False, delay_step_s=None
        )
        for view, place in zip(views, where, strict=True)
    ]
    some = np.array([5, 2])
    for a, b, view in zip(shared, own, views, strict=True):
        powers = path_powers(view, field.materials, None)
        expected = read(view, b, powers)
        np.testing.assert_allclose(read(view, a, powers), expected, rtol=1e-3)
        np.testing.assert_allclose(read(view, a.part(some), powers), expected[some], rtol=1e-3)
        back = [m.to_bins(np.eye(7)[:, some])[m.bins(view)[0]] for m in (a, b)]
        back += [m.part(some).to_bins(np.eye(2))[m.bins(view)[0]] for m in (a, b)]
        for found in back[1:]:
            np.testing.assert_allclose(found, back[0], rtol=0.05, atol=1e-3 * back[0].max())


def differences(ask, x: np.ndarray, step: float) -> np.ndarray:
    """Slopes of the readings ``ask(x)`` by each parameter, shape (parameters, readings)."""
    steps = step * np.eye(len(x))
    return np.stack([(ask(x + s) - ask(x - s)) / (2.0 * step) for s in steps])


def dense(table: np.ndarray, index: np.ndarray, layout: Layout) -> np.ndarray:
    """A Jacobian with the rows of what is not seen: zeros."""
    whole = np.zeros((layout.size, table.shape[1]))
    whole[index] = table
    return whole


def array_image(view: ReceiverView) -> ArrayImage:
    """Half a hemisphere as an array of 4 x 4 elements sees it, whose paths' lengths are known to 0.4 mm."""
    array, directions = PlanarArray(4, 4, orientation=UP), hemisphere((18, 36)).reshape(-1, 3)
    return ArrayImage.of(view, array, directions, 0.0004).part(np.arange(0, len(directions), 13))


def pixels(view: ReceiverView) -> SpectrumPixels:
    return SpectrumPixels(BeamOperator(SHAPE, SIGMA), np.arange(0, SHAPE[0] * SHAPE[1], 7))


@pytest.mark.parametrize(
    ("measured", "lit"), [(delay_profile, False), (array_image, False), (pixels, False), (pixels, True)]
)
def test_its_jacobian_is_that_of_differences(field: BistaticField, measured, lit: bool) -> None:
    """Also of light that surfaces send on, ``lit``: without beams of single paths, which would drown it."""
    view, rng = field.view(RX), np.random.default_rng(0)
    response = respond(view, measured(view), field.terms, field.floor)
    if lit:
        sent = rng.uniform(0.0, 1e6, (2, len(response.offset))).astype(np.float32)
        response = replace(response, sender=np.array([0, 1]), sent=sent)
        response = response.limited(Terms(line_of_sight=False, mirror_order=0))
    groups, lobes = field.parameters.log_weight.shape
    layout = Layout(groups, lobes, indirect=True, gain=True)
    x = layout.pack(replace(field.parameters, log_gain=0.1, log_indirect=np.full(groups, -1.0)))
    x += rng.normal(0.0, 0.2, layout.size)
    values, table, index = jacobian(response, layout.unpack(x), layout)
    np.testing.assert_allclose(values, predict(response, layout.unpack(x)), rtol=1e-4)
    slopes = differences(lambda x: predict(response, layout.unpack(x)), x, 0.02)
    caught = []
    for place, (row, slope) in enumerate(zip(dense(table, index, layout), slopes, strict=True)):
        allowed = 0.1 if place % layout.stride == layout.lobes else 0.02  # that of permittivity is a table's
        bound = allowed * np.abs(slope).max() + 1e-5 * values.max()
        assert np.abs(row - slope).max() <= bound
        caught.append(np.abs(1.2 * row - slope).max() > bound)
    assert np.mean(np.array(caught)[index]) > 0.7  # planted errors, but those of what is hardly seen


@pytest.mark.parametrize(
    ("measured", "how"), [(delay_profile, {"ratio": 0.6}), (array_image, {"chain": OWN_GAIN})]
)
def test_errors_at_another_carrier_or_of_unknown_gain_have_the_slopes_of_differences(
    field: BistaticField, measured, how: dict
) -> None:
    view = field.view(RX)
    response = respond(view, measured(view), field.terms, field.floor)
    target = 10 * np.log10(1 + np.roll(predict(response, field.parameters), 3))
    reading = Reading(response, Target(target), **how)
    groups, lobes = field.parameters.log_weight.shape
    layout = Layout(groups, lobes, indirect=True, gain=True)
    rng = np.random.default_rng(5)
    x = layout.pack(replace(field.parameters, log_indirect=np.full(groups, -3.0)))
    x += rng.normal(0.0, 0.4, layout.size)
    error, table, index = reading.linearised(layout.unpack(x), layout)
    slopes = differences(lambda x: reading.error_db(layout.unpack(x)), x, 0.02)
    for place, (row, slope) in enumerate(zip(dense(table, index, layout), slopes, strict=True)):
        allowed = 0.1 if place % layout.stride == layout.lobes else 0.01  # that of permittivity is a table's
        assert np.abs(row - slope).max() <= allowed * np.abs(slope).max() + 1e-4


def test_the_jacobian_of_chains_over_several_materials_is_that_of_differences() -> None:
    """One reading a path, so that what one mirror of a chain changes is not hidden by others."""
    rng = np.random.default_rng(3)
    groups = np.array([[0, 1, 2], [2, 0, -1], [1, -1, -1], [-1, -1, -1]])
    none, count = np.zeros(0, int), len(groups)
    response = Response(
        group=none, bounce=np.zeros((0, 2, 3, count), np.float32), seen=none, indirect=np.zeros((0, count), np.float32),
        sender=none, sent=np.zeros((0, count), np.float32), path_group=groups,
        cosine=rng.uniform(0.2, 0.9, groups.shape), turn=rng.uniform(-1.0, 1.0, groups.shape),
        path_power=np.ones(count), path=np.eye(count, dtype=np.float32), offset=np.zeros(count, np.float32),
    )  # fmt: skip
    layout = Layout(3, 2, indirect=False, gain=False)
    x = layout.pack(Parameters.prior(3, 2)) + rng.normal(0.0, 0.3, layout.size)
    values, table, index = jacobian(response, layout.unpack(x), layout)
    slopes = differences(lambda x: predict(response, layout.unpack(x)), x, 1e-2)
    assert (np.abs(dense(table, index, layout) - slopes) <= 1e-3 * np.abs(slopes) + 1e-4 * values).all()


def test_a_used_field_is_copied_and_pickled(field: BistaticField) -> None:
    field = replace(field, device=wp.get_device("cpu"))
    expected = field.spectrum(RX).path_gain
    for again in (copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
        np.testing.assert_array_equal(again.spectrum(RX).path_gain, expected)


def test_what_was_traced_for_old_transmitters_and_dropped_fields_goes(field: BistaticField) -> None:
    traced = []
    for x in np.linspace(0.5, 1.5, 10):
        again = copy.deepcopy(field)
        traced.append(weakref.ref(again.transport([x, 0.9, 2.2])))
        again.spectrum(RX, [x, 0.9, 2.2])
        del again  # no reference cycle: nothing waits for the garbage collector
        assert sum(t() is not None for t in traced) <= 6
