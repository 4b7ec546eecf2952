"""Fields and coherent arrays: phases of line of sight and mirrors, scattered light in expectation, fits to pictures."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, TX, furnished
from radio_scenes import SlabMaterial, as_fits_predict, joined, observation

from warprrf.rf.channel.array_spectra import UP, ArraySpectra, hemisphere
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.measured import ArrayImage, read
from warprrf.rf.paths.trace import trace_paths
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import directions_from_angles
from warprrf.rf.tracing.model import SETS, Effects
from warprrf.rf.tracing.render import materials_of
from warprrf.rf.tracing.tracer import SPECULAR

F = 28e9  # of whose zones mirrors hold the whole, so that exact paths are the truth
RECEIVERS = RECEIVERS[:8]
ARRAY = PlanarArray(4, 4, orientation=UP)
DIRECTIONS = hemisphere((18, 36))
STEERED = ARRAY.response(DIRECTIONS, 1.0).conj() / ARRAY.elements
WALLS = SlabMaterial("walls", 5.0, 0.0, np.inf, 0.2)
SINGLE = replace(SETS["single"], mirrors=2, residual=False)
BOX = SlabMaterial("box", 12.0, 0.0, np.inf, 0.6)


@pytest.fixture(scope="module")
def scene():
    return furnished(WALLS, BOX)


@pytest.fixture(scope="module")
def field(scene):
    frame = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=(24, 48), beam_sigma_rad=np.radians(5.0), floor=1e-12
    )
    prior = BistaticField.prior(scene, frame, effects=SINGLE, sub_pixels=2)
    known = prior.parameters
    share = np.log([1.0 - m.scattering**2 for m in (WALLS, BOX)])
    excess = np.log([m.relative_permittivity - 1.0 for m in (WALLS, BOX)])
    group = np.array([0, 1])[: len(known.log_excess)]
    assert len(group) == len(known.log_excess) == 2
    return replace(prior, parameters=replace(known, log_excess=excess, log_mirror=share))


def heard(paths):
    """Channel (M,) of complex paths between vertical antennas."""
    toward = directions_from_angles(paths.theta_r, paths.phi_r)
    return ARRAY.response(toward, 1.0).T @ paths.jones[:, 0, 0]


def test_mirrors_and_line_of_sight_add_up_as_complex_paths_do(scene, field):
    """Of the exact paths of the scene with their Jones matrices; zones that a mirror's edge covers in part are left out."""
    alone = replace(field, effects=replace(SINGLE, scatterings=0))
    compared = 0
    for place in RECEIVERS:
        view = alone.view(place)
        exact = trace_paths(scene, transmitter=TX, receivers=place, frequency_hz=F, mirror_order=2)
        if len(exact.tau) != len(view.paths) or view.paths.share.min() < 1.0:
            continue
        found = alone.array_spectrum(place, ARRAY, DIRECTIONS)
        truth = np.abs(STEERED @ heard(exact)) ** 2
        np.testing.assert_allclose(found, truth, atol=1e-3 * truth.max())
        compared += 1
    assert compared >= 1


@pytest.mark.parametrize("swapped", [False, True])
def test_a_pane_of_nearly_air_changes_nothing(swapped):
    """A path over the floor and the pane, whose planes of incidence differ, is that over the floor."""
    floor = np.array([[-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    pane = np.array([[1, -6, 0.001], [1, 6, 0.001], [1, 6, 6], [1, -6, 6]]), np.array([[0, 1, 2], [0, 2, 3]])
    concrete = Material.custom("concrete", relative_permittivity=5.0, conductivity=0.1)
    air = Material.custom("air", relative_permittivity=1.0001, conductivity=0.0, thickness_m=0.01)
    effects = Effects(mirrors=1, scatterings=0, transmissions=1, diffractions=0)
    ends = np.array([[-2.0, 0.0, 1.5], [2.0, 2.4, 1.2]])[:: -1 if swapped else 1]
    nothing = SpectrumDataset.empty(transmitter=ends[0], frequency_hz=F, shape=(24, 48))
    found = []
    for parts, of in ([floor], [concrete]), ([floor, pane], [concrete, air]):
        mesh, part = joined(*parts)
        one = BistaticField.prior(Scene(mesh, of, part), nothing, effects=effects)
        assert len(one.view(ends[1]).paths) == 2
        found.append(one.array_spectrum(ends[1], ARRAY, DIRECTIONS))
    np.testing.assert_allclose(found[1], found[0], rtol=0.01, atol=0.001 * found[0].max())


def test_paths_over_edges_add_in_power():
    """By which phase an edge turns a field is in none of its records."""
    screen = np.array([[0, -6, 0], [0, 0.2, 0], [0, 0.2, 3], [0, -6, 3.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    mesh, part = joined(screen)
    scene, ends = Scene(mesh, [Material.conductor()], part), np.array([[-2.0, 0.0, 1.5], [2.0, 1.5, 1.2]])
    effects = Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=1)
    nothing = SpectrumDataset.empty(transmitter=ends[0], frequency_hz=F, shape=(24, 48))
    over = BistaticField.prior(scene, nothing, effects=effects)
    view = over.view(ends[1])
    power, edges = over.path_gains(view).specular, np.flatnonzero(view.paths.over_edge)
    assert len(edges) > 0 and view.paths.in_sight.sum() == 1 and power[edges].max() > 1e-3 * power.max()
    found = over.array_spectrum(ends[1], ARRAY, DIRECTIONS)
    sight = replace(over, effects=replace(effects, diffractions=0)).array_spectrum(ends[1], ARRAY, DIRECTIONS)
    beams = np.abs(STEERED @ ARRAY.response(view.paths.arrival[edges], 1.0).T) ** 2
    np.testing.assert_allclose(found - sight, beams @ power[edges], atol=1e-5 * found.max())


def test_one_path_alone_peaks_at_its_path_gain(field):
    alone = replace(field, effects=Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=0))
    place = RECEIVERS[1]
    toward = (TX - place) / np.linalg.norm(TX - place)
    found = alone.array_spectrum(place, ARRAY, toward[None])
    friis = (SPEED_OF_LIGHT / F / (4 * np.pi * np.linalg.norm(TX - place))) ** 2
    assert found[0] == pytest.approx(friis, rel=1e-5)
    assert alone.array_spectrum(place, ARRAY, DIRECTIONS).max() <= friis * (1 + 1e-5)


def test_scattered_light_is_the_mean_over_its_random_phases(field):
    alone = replace(field, effects=replace(SINGLE, line_of_sight=False, mirrors=0))
    place = RECEIVERS[0]
    view = alone.view(place)
    power = alone.path_gains(view).single
    lit = np.flatnonzero(power > 1e-4 * power.max())
    wave = ARRAY.response(view.tracer.grid.directions[lit], 1.0) * np.sqrt(power[lit])[:, None]
    rng = np.random.default_rng(0)
    phases = np.exp(2j * np.pi * rng.random((2000, len(lit))))
    drawn = (np.abs(np.einsum("hwm,sm->shw", STEERED, phases @ wave)) ** 2).mean(axis=0)
    found = alone.array_spectrum(place, ARRAY, DIRECTIONS)
    assert np.abs(found - drawn).max() < 0.12 * found.max()  # 2000 draws: 2 % each, the largest of hundreds


def test_paths_of_unknown_length_add_in_power(field):
    place = RECEIVERS[0]
    alone = replace(field, effects=replace(SINGLE, scatterings=0))
    view = alone.view(place)
    together = ArrayImage.of(view, ARRAY, DIRECTIONS.reshape(-1, 3), 0.0).together
    materials = materials_of(view.tracer, alone.parameters, alone.effects)
    amplitude = view.records[SPECULAR].fields(materials, together.sent, together.heard)[0]
    each = sum(np.abs(a * row) ** 2 for a, row in zip(amplitude, together.field, strict=True))
    found = alone.array_spectrum(place, ARRAY, DIRECTIONS, length_std_m=1.0).ravel()
    np.testing.assert_allclose(found, each, rtol=1e-4)
    mean = np.zeros(len(each))
    rng = np.random.default_rng(1)
    std = 0.25 * SPEED_OF_LIGHT / F / (2 * np.pi)
    for _ in range(400):
        turned = np.exp(2j * np.pi * F / SPEED_OF_LIGHT * std * rng.normal(size=len(amplitude)))
        mean += np.abs((turned * amplitude) @ together.field) ** 2 / 400
    found = alone.array_spectrum(place, ARRAY, DIRECTIONS, length_std_m=std).ravel()
    assert np.abs(found - mean).max() < 0.05 * found.max()


def test_what_a_fit_predicts_is_what_is_read(field):
    view = field.view(RECEIVERS[0])
    image = ArrayImage.of(view, ARRAY, DIRECTIONS.reshape(-1, 3), 0.0004)
    power = read(field.path_gains(view), image)
    found = as_fits_predict(observation(view, image, 1e-2 * power.max()), SINGLE, field.parameters)
    found *= 1e-2 * power.max()
    np.testing.assert_allclose(found, power, rtol=0.02, atol=0.01 * power.max())


def test_a_fit_to_normalised_pictures_beats_the_nearest(scene, field):
    """Readings of exact complex paths and of scattering with drawn phases, as pictures of 8 bits."""
    rng, truth = np.random.default_rng(5), []
    for place in RECEIVERS:
        exact = trace_paths(scene, transmitter=TX, receivers=place, frequency_hz=F, mirror_order=2)
        h = heard(exact)
        view = field.view(place)
        power = field.path_gains(view).single
        phase = np.exp(2j * np.pi * rng.random(len(power)))
        h = h + ARRAY.response(view.tracer.grid.directions, 1.0).T @ (np.sqrt(power) * phase)
        seen = np.abs(STEERED @ h) ** 2
        truth.append(np.round(255 * seen / seen.max()) / 255)
    pictures = np.array(truth)
    known = ArraySpectra(TX, RECEIVERS[:6], pictures[:6], F, ARRAY, DIRECTIONS)
    fitted = RadioField.fit(scene, known, quick=True, effects=replace(SETS["single"], mirrors=2))
    assert isinstance(fitted, BistaticField)

    def psnr(a, b):
        return float(-10 * np.log10(np.mean((a - b) ** 2)))

    for place, picture in zip(RECEIVERS[6:], pictures[6:], strict=True):
        nearest = pictures[np.linalg.norm(RECEIVERS[:6] - place, axis=1).argmin()]
        found = fitted.array_spectrum(place, ARRAY, DIRECTIONS)
        assert psnr(found / found.max(), picture) > psnr(nearest, picture) + 3.0
    with pytest.raises(ValueError, match="directions"):
        fitted.array_spectrum(RECEIVERS[0], ARRAY, 2.0 * DIRECTIONS)
