"""Radio maps and links without spectra: closed forms, the field's own spectra, walls and air, files, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, SHAPE, SIGMA, TX, F, spectra
from radio_scenes import box_mesh
from trimesh.remesh import subdivide_to_size

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.links import best_beam_gain, directivity, links_of
from warprrf.rf.maps.radio_map import QUANTITIES, RadioMap, is_free
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_solid_angles
from warprrf.rf.tracing.model import Effects

WAVELENGTH = SPEED_OF_LIGHT / F
EVERYTHING = Effects(mirrors=2, scatterings=2, residual=False)
PLACES = RECEIVERS[[0, 1, 3, 5, 9]]


def prior(scene, effects, transmitter=TX):
    known = SpectrumDataset.empty(
        transmitter=transmitter, frequency_hz=F, shape=SHAPE, beam_sigma_rad=SIGMA, floor=1e-16
    )
    return BistaticField.prior(scene, known, effects=effects)


@pytest.fixture(scope="module")
def whole(scene):
    return prior(scene, EVERYTHING)


@pytest.fixture(scope="module")
def found(whole):
    return whole.radio_map(1.2, 0.5, beam_sigma_rad=SIGMA)


def db(ratio):
    return np.abs(10.0 * np.log10(ratio))


def test_an_empty_room_of_line_of_sight_alone_is_friis():
    room = Mesh(*box_mesh([0, 0, 0], [5, 4, 3], inward=True))
    m = prior(room, Effects(mirrors=0, scatterings=0, transmissions=0)).radio_map(
        1.5, 0.4, transmit_power_dbm=10.0
    )
    length = np.linalg.norm(m.positions - TX, axis=-1)
    friis = (WAVELENGTH / (4.0 * np.pi * length)) ** 2
    assert m.free.sum() == 12 * 10  # the thirteenth column's centre is at the wall
    assert db(m.total_path_gain[m.free] / friis[m.free]).max() < 1e-6
    np.testing.assert_array_equal(m.best_path_gain, m.total_path_gain)
    assert np.nanmax(m.delay_spread_s) < 1e-15
    # a beam of kappa has directivity 2 kappa, where kappa is large
    snr = 10.0 + 10.0 * np.log10(friis * 2.0 / m.beam_sigma_rad**2) - m.noise_power_dbm
    assert np.abs(m.best_beam_snr_db - snr)[m.free].max() < 1e-6
    assert m.noise_power_dbm == pytest.approx(-173.975 + 10.0 * np.log10(2.16e9) + 10.0, abs=1e-3)


def test_directivity_has_mean_one_over_the_sphere():
    shape = (400, 800)
    cosine = pixel_directions(shape) @ np.array([0.36, 0.48, 0.8])
    for sigma in (0.05, 0.3, 2.0):
        mean = (directivity(sigma, cosine) * pixel_solid_angles(shape)[:, None]).sum() / (4.0 * np.pi)
        assert mean == pytest.approx(1.0, rel=2e-3)


def test_two_paths_within_a_beam_add_up_and_apart_do_not():
    a, b = np.array([1.0, 0.0, 0.0]), np.array([np.cos(0.02), np.sin(0.02), 0.0])
    dark = np.zeros((1, 20, 40))
    peak = directivity(np.radians(5.0))
    one, sigma = np.zeros(2, int), np.radians(5.0)
    both = best_beam_gain(dark, one, np.stack([a, b]), np.array([1.0, 1.0]), sigma)[0]
    assert both == pytest.approx(peak * (1.0 + np.exp(-0.5 * (0.02 / np.radians(5.0)) ** 2)), rel=1e-3)
    apart = best_beam_gain(dark, one, np.stack([a, -a]), np.array([1.0, 0.7]), sigma)[0]
    assert apart == pytest.approx(peak, rel=1e-9)


def test_even_light_gives_any_beam_the_isotropic_gain():
    even = np.broadcast_to(pixel_solid_angles((20, 40))[:, None] / (4.0 * np.pi), (1, 20, 40)).copy()
    none = np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)
    assert best_beam_gain(even, *none, 0.1)[0] == pytest.approx(1.0, rel=0.02)


def test_map_is_what_the_spectra_sum_to(whole, found):
    rows, columns = np.nonzero(found.free)
    for k in range(0, len(rows), 11):
        cell = rows[k], columns[k]
        place = found.positions[cell]
        paths = whole.paths(place)
        truth = links_of(paths, SHAPE, SIGMA)
        total = float(whole.spectrum(place).total_path_gain)
        # 3200 rays a cell instead of 18,432: a mean over rays errs by a few per cent of what is diffuse
        assert db(found.total_path_gain[cell] / total) < 0.15
        assert db(found.best_path_gain[cell] / truth.best_path_gain[0]) < 0.5
        assert db(found.best_beam_gain[cell] / truth.best_beam_gain[0]) < 0.5
        # a diffuse path of `paths` stands for a pixel of 7.5 degrees, with one delay
        assert found.delay_spread_s[cell] == pytest.approx(truth.delay_spread_s[0], abs=0.2e-9)


def test_the_best_path_of_what_is_scattered_is_a_pixel_of_the_field_s_spectrum(scene):
    field = prior(scene, Effects(line_of_sight=False, mirrors=0, scatterings=1, residual=False))
    paths = field.paths(PLACES)
    best = (np.abs(paths.gain) ** 2 * paths.valid).max(axis=-1)
    assert db(field.links(PLACES, shape=SHAPE).best_path_gain / best).max() < 0.5
    # the mean of four pixels is no less than a quarter of the strongest, and no more than it
    coarse = field.links(PLACES, shape=(SHAPE[0] // 2, SHAPE[1] // 2)).best_path_gain / best
    assert (coarse > 0.25).all() and (coarse < 1.05).all()


def test_more_rays_come_closer(whole):
    truth = np.array([whole.spectrum(p).total_path_gain for p in PLACES])
    error = [
        np.sqrt(np.mean(db(whole.links(PLACES, shape=shape).total_path_gain / truth) ** 2))
        for shape in ((4, 8), (40, 80))
    ]
    assert error[1] < 0.5 * error[0]
    assert error[1] < 0.05


@pytest.mark.parametrize("order", [0, 1, 2])
def test_fewer_mirrors_are_those_of_a_field_with_fewer(whole, order):
    fewer = replace(whole, effects=replace(whole.effects, mirrors=order))
    expected, found = fewer.links(PLACES), whole.links(PLACES, mirror_order=order)
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
    lost = whole.links(PLACES).total_path_gain - found.total_path_gain
    assert (lost > 0).any() if order < 2 else (lost == 0).all()
    # more than the field has stay what it has
    np.testing.assert_array_equal(
        fewer.links(PLACES, mirror_order=3).total_path_gain, expected.total_path_gain
    )


def test_a_harmonic_field_has_maps_too(scene):
    ds = spectra(scene, PLACES, shape=(12, 24), sigma=np.radians(10.0), sub_pixels=2)
    field = RadioField.fit(scene, ds, model="rf3dgs+", iterations=3)
    with pytest.raises(
        ValueError, match=r"mirror_order: got 1, but a field of model 'rf3dgs\+' has no mirrors"
    ):
        field.links(PLACES, mirror_order=1)
    m = field.radio_map(1.2, 1.5)
    assert 3 <= m.free.sum() <= 12
    for row, column in np.argwhere(m.free):
        sum_ = field.spectrum(m.positions[row, column]).total_path_gain
        assert m.total_path_gain[row, column] == pytest.approx(sum_, rel=1e-5)


def test_solids_are_no_cells_even_of_a_torn_mesh(scene):
    rng = np.random.default_rng(0)
    surface = Mesh(*subdivide_to_size(scene.mesh.vertices, scene.mesh.faces, 0.2))
    torn = Mesh(surface.vertices, surface.faces[rng.random(len(surface.faces)) > 0.1])
    assert not torn.is_closed
    points = rng.uniform([-0.5, -0.5, 0.05], [5.5, 4.5, 2.95], (2000, 3))
    room = ((points > 0) & (points < [5, 4, 3])).all(axis=1)
    box = ((points > [2.2, 1.6, 0]) & (points < [3.0, 2.4, 2.4])).all(axis=1)
    clear = scene.mesh.distance(points) > 0.1  # nearer to a wall one missing face fills half the view
    clear &= ~(box & torn.visible(points, TX))  # what is seen through a hole is the transmitter's air
    for mesh in (scene.mesh, torn, Mesh(torn.vertices, torn.faces[:, ::-1])):
        np.testing.assert_array_equal(is_free(mesh, points, TX)[clear], (room & ~box)[clear])


def test_a_map_that_other_tools_turned_is_read_by_its_coordinates(found, tmp_path):
    xarray = pytest.importorskip("xarray")
    found.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_timedelta=False) as opened:
        turned = (
            opened.load().isel(y=slice(None, None, -1)).roll(x=3, roll_coords=True).transpose("x", "y", ...)
        )
        turned.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    again = RadioMap.load(tmp_path / "b.nc")
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


@pytest.mark.parametrize(
    ("name", "value"), [("total_path_gain", -1.0), ("best_beam_gain", np.inf), ("cell_m", 0.0)]
)
def test_fields_that_no_map_has_are_refused(found, name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        replace(found, **{name: np.full_like(getattr(found, name), value)})


def test_pictures_show_every_quantity(found, tmp_path):
    pytest.importorskip("matplotlib")
    found.picture(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    for quantity in QUANTITIES:
        ax = found.plot(quantity)
        shown = np.asarray(ax.images[0].get_array().filled(np.nan))
        np.testing.assert_allclose(shown, found.plot_values(quantity), equal_nan=True)


def test_height_above_ground_is_the_same_whatever_the_ground_s_own(scene, whole):
    down = np.array([0.0, 0.0, -100.0])
    mesh = Mesh(scene.mesh.vertices + down, scene.mesh.faces)
    sunk = prior(replace(scene, mesh=mesh), EVERYTHING, TX + down)
    asked = {"height": 1.2, "cell": 1.0, "above_ground": True}
    known, found = whole.radio_map(**asked), sunk.radio_map(**asked)
    np.testing.assert_allclose(found.best_path_gain, known.best_path_gain, rtol=1e-3)
    with pytest.raises(ValueError, match=r"height: got 3.5 m, expected 0 to 3 m"):
        sunk.radio_map(**asked | {"height": 3.5})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell": 1e-4}, "makes 2000000000 cells"),
        ({"cell": 0.2, "bounds": [2.3, 1.7, 2.9, 2.3]}, "bounds: no cell of the"),
        ({"mirror_order": 4}, "mirror_order: got 4, expected one of None, 0, 1, 2, 3"),
    ],
)
def test_bad_input_is_named(whole, change, message):
    with pytest.raises(ValueError, match=message):
        whole.radio_map(**({"height": 1.2, "cell": 0.5} | change))
