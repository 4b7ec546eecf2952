"""Streets: where there is sky, what stands in a building, what is warned of; whether buildings have floors or not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from radio_scenes import box_mesh, joined

import warprrf as wr
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.materials import Material
from warprrf.rf.positions import check_positions, ground_height, is_open_air, under_a_roof
from warprrf.rf.scene import Scene
from warprrf.rf.tracing.surface import ELEMENT_M, ELEMENTS, Surface

F = 3.5e9
WAVELENGTH = 299_792_458.0 / F
STONE = Material.custom("stone", relative_permittivity=5.0, conductivity=0.1, scattering=0.4)
HOUSES = ((-50.0, 10.0, 20.0), (30.0, 10.0, 15.0), (-50.0, -40.0, 25.0), (30.0, -40.0, 12.0))  # x, y, height
SMALL = 0.1  # of streets whose elements take no time
TX = np.array([0.0, 1.0, 30.0])
STREET = np.array([[-20.0, 0.0, 1.5], [40.0, 3.0, 1.5], [5.0, 30.0, 1.5], [5.0, -25.0, 2.0]])
BEHIND = np.array([[-30.0, 45.0, 1.5], [45.0, 45.0, 1.5]])  # houses stand between them and the transmitter
INDOORS = np.array([[-30.0, 20.0, 1.5], [45.0, 30.0, 8.0], [-20.0, -20.0, 20.0], [40.0, -15.0, 0.3]])
GROUND = (
    np.array([[-70, -60, 0], [70, -60, 0], [70, 60, 0], [-70, 60, 0]], float),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


def house(x, y, height, *, floor, inward=False):
    """Walls 40 by 30 m and a flat roof, with a floor or without."""
    vertices, faces = box_mesh([x, y, 0.0], [x + 40.0, y + 30.0, height], inward=inward)
    return vertices, faces if floor else faces[(vertices[faces][:, :, 2] > 0).any(axis=1)]


def street(*, floor=False, inward=False, more=()):
    return joined(GROUND, *(house(*h, floor=floor, inward=inward) for h in HOUSES), *more)[0]


def small(slope=0.0, height=0.0):
    """A street whose surface elements take no time, on a slope along x."""
    vertices = SMALL * street().vertices
    return Mesh(vertices + np.outer(slope * vertices[:, 0] + height, [0.0, 0.0, 1.0]), street().faces)


def scene(mesh=None):
    mesh = street() if mesh is None else mesh
    return Scene(mesh, [STONE], np.zeros(len(mesh.faces), int))


@pytest.fixture(scope="module")
def field():
    s = scene(small())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ds = wr.simulate(s, transmitter=SMALL * TX, receivers=SMALL * STREET, frequency_hz=F, shape=(16, 32))
        return wr.RadioField.fit(s, ds, quick=True, effects="single")


@pytest.mark.parametrize("inward", [False, True])
@pytest.mark.parametrize("floor", [False, True])
def test_houses_are_no_places_with_or_without_floors_and_however_wound(floor, inward):
    s = scene(street(floor=floor, inward=inward))
    assert is_open_air(s.mesh)
    assert s.is_free(np.concatenate([STREET, BEHIND])).all()
    assert not s.is_free(INDOORS).any()
    below = STREET - [0.0, 0.0, 3.0]
    assert not s.is_free(below).any()
    check_positions(s.mesh, TX, np.concatenate([STREET, BEHIND]), WAVELENGTH)
    for place in np.concatenate([INDOORS, below]):
        with pytest.raises(ValueError, match="receivers.*inside a solid"):
            check_positions(s.mesh, TX, place[None], WAVELENGTH)
        with pytest.raises(ValueError, match="transmitter.*inside a solid"):
            check_positions(s.mesh, place, STREET, WAVELENGTH)


def test_a_street_whose_faces_are_there_twice_is_a_street():
    """With both of their sides, as exporters write them, it counted as closed: houses without floors were air."""
    once = street()
    twice = Mesh(once.vertices, np.concatenate([once.faces, once.faces[:, ::-1]]))
    assert is_open_air(twice) and not twice.is_closed
    s = scene(twice)
    assert s.is_free(STREET).all() and not s.is_free(INDOORS).any()


def test_a_link_within_a_house_without_a_floor_passes():
    check_positions(street(), INDOORS[0], INDOORS[0] + [[2.0, 1.0, 0.5]], WAVELENGTH)


def test_courts_bridges_and_canopies_are_in_the_open():
    court = [house(0, 0, 30.0, floor=False)]
    vertices, faces = court[0]
    open_top = vertices, faces[(vertices[faces][:, :, 2] < 30.0).any(axis=1)]
    bridge = np.array([[-70, -4, 6], [70, -4, 6], [70, 4, 6], [-70, 4, 6]], float), GROUND[1]
    canopy = np.array([[-15, -15, 6], [15, -15, 6], [15, 15, 6], [-15, 15, 6]], float), GROUND[1]
    for more, place in ((open_top, [20.0, 15.0, 1.5]), (bridge, [10.0, 0.0, 1.5]), (canopy, [1.0, 2.0, 1.5])):
        mesh = joined(GROUND, more)[0]
        assert not under_a_roof(mesh, np.array([place])).any()


def test_a_ground_alone_is_open_air_and_rooms_are_not_even_with_holes():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert is_open_air(Mesh(*GROUND))
    vertices, faces = box_mesh([0, 0, 0], [6, 5, 3], inward=True)
    assert not is_open_air(Mesh(vertices, faces))
    assert not is_open_air(Mesh(vertices, faces[1:]))  # half a wall is missing
    corridors = joined(
        box_mesh([0, 0, 0], [30, 2, 3], inward=True), box_mesh([28, 2, 0], [30, 30, 3], inward=True)
    )[0]
    # Most of its box has sky, and no ground.
    assert not is_open_air(Mesh(corridors.vertices, corridors.faces[1:]))


def test_places_above_the_ground_follow_a_slope():
    places = wr.sample_receivers(
        scene(small(0.2, 7.0)), 100, z=(0.1, 0.2), clearance=0.05, above_ground=True, seed=1
    )
    height = places[:, 2] - 0.2 * places[:, 0] - 7.0
    assert (height > 0.1 - 1e-6).all() and (height < 0.2 + 1e-6).all()
    assert np.ptp(places[:, 0]) > 12.0


def test_a_map_of_a_street_masks_houses_and_nothing_else(field):
    found = field.radio_map(0.15, 0.4, bounds=[-6.9, -5.9, 6.9, 5.9], shape=(6, 12))
    x, y = found.positions[..., 0] / SMALL, found.positions[..., 1] / SMALL
    houses = np.zeros(x.shape, bool)
    for a, b, _ in HOUSES:
        houses |= (x > a) & (x < a + 40.0) & (y > b) & (y < b + 30.0)
    np.testing.assert_array_equal(found.free, ~houses)
    assert found.ground_m is None


def test_heights_above_the_ground_follow_a_slope(tmp_path):
    slope, places = small(0.2, 7.0), SMALL * STREET
    x, y = places[:, 0], places[:, 1]
    np.testing.assert_allclose(ground_height(slope, x, y), 0.2 * x + 7.0, atol=1e-6)
    assert np.isnan(ground_height(slope, np.array([100.0]), np.array([0.0]))).all()
    s = scene(slope)
    tx, rx = SMALL * TX + [0.0, 0.0, 7.0], places + np.outer(0.2 * x + 7.0, [0.0, 0.0, 1.0])
    with pytest.warns(UserWarning, match="not modelled"):
        ds = wr.simulate(s, transmitter=tx, receivers=rx, frequency_hz=F, shape=(16, 32))
        sloping = wr.RadioField.fit(s, ds, quick=True, effects="single")
    found = sloping.radio_map(0.15, 1.0, above_ground=True, shape=(6, 12))
    np.testing.assert_allclose(found.positions[..., 2], 0.2 * found.positions[..., 0] + 7.15, atol=1e-6)
    assert 0.5 < found.free.mean() < 0.9
    found.save(tmp_path / "map.nc")
    np.testing.assert_array_equal(wr.RadioMap.load(tmp_path / "map.nc").ground_m, found.ground_m)
    with pytest.raises(ValueError, match=r"height.*-1"):
        sloping.radio_map(-1.0, 10.0, above_ground=True)


def unmodelled(call):
    """Warnings of what is not modelled, and where they are shown."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return [(str(w.message), w.filename) for w in found if "not modelled" in str(w.message)]


def test_every_verb_warns_once_where_it_was_called():
    s = scene(small())
    where = {"transmitter": SMALL * TX, "receivers": SMALL * STREET, "frequency_hz": F}
    with pytest.warns(UserWarning, match="not modelled"):
        ds = wr.simulate(s, **where, shape=(16, 32))
    for call in (
        lambda: wr.simulate(s, **where, shape=(16, 32)),
        lambda: wr.trace_paths(s, **where),
        lambda: wr.trace_paths(s.mesh, **where),
        lambda: wr.RadioField.fit(s, ds, quick=True, effects="single"),
    ):
        (found,) = unmodelled(call)
        assert found[0].startswith("3.5 GHz: diffraction and transmission through walls are not modelled")
        assert "below 100 GHz and outdoors (under the sky)" in found[0]
        assert found[1] == __file__
    whole = wr.Effects(mirrors=1, scatterings=1, transmissions=1)
    assert unmodelled(lambda: wr.simulate(s, **where, shape=(16, 32), effects=whole)) == []


def test_frequency_and_sky_are_reasons_by_themselves():
    vertices, faces = box_mesh([0, 0, 0], [6, 5, 3], inward=True)
    room, hall = Mesh(vertices, faces), Mesh(40.0 * vertices, faces)
    inside = {"transmitter": [1.0, 1.0, 1.0], "receivers": [[4.0, 3.0, 1.5]]}
    assert unmodelled(lambda: wr.trace_paths(room, **inside, frequency_hz=300e9)) == []
    ((low, _),) = unmodelled(lambda: wr.trace_paths(room, **inside, frequency_hz=28e9))
    assert low.startswith("28 GHz")
    assert "outdoors" not in low
    ((sky, _),) = unmodelled(
        lambda: wr.trace_paths(street(), transmitter=TX, receivers=STREET, frequency_hz=140e9)
    )
    assert "matters outdoors (under the sky)" in sky
    assert unmodelled(lambda: wr.trace_paths(hall, **inside, frequency_hz=140e9)) == []


def test_places_without_any_path_are_empty_spectra_not_an_error():
    mirror = replace(STONE, scattering=0.0)
    mesh = small()
    s = Scene(mesh, [mirror], np.zeros(len(mesh.faces), int))
    tx, dark, lit = SMALL * TX, SMALL * BEHIND, SMALL * STREET[:1]
    where = {"transmitter": tx, "frequency_hz": F, "shape": (16, 32)}
    with pytest.warns(UserWarning, match="not modelled"):
        ds = wr.simulate(s, receivers=np.concatenate([dark, lit]), **where)
        assert (ds.path_gain[:2] == 0).all()
        np.testing.assert_allclose(ds.floor, ds.path_gain[2].max() * 1e-6, rtol=1e-5)
        with pytest.raises(ValueError, match="path_gain: all spectra are empty"):
            wr.simulate(s, receivers=dark, **where)
    found = wr.relevance(s, receivers=np.concatenate([dark, lit]), **where)
    assert found["transmission"].kept and "of the power of a blocked receiver" in found["transmission"].reason


def test_elements_grow_with_the_scene():
    few, large = Surface.of(small()), Surface.of(street())
    assert np.sqrt(large.mesh.areas.sum() / ELEMENTS) > ELEMENT_M
    assert len(large.element_area) < 2.0 * ELEMENTS
    assert few.element_area.max() < 2.0 * ELEMENT_M**2
    assert large.element_area.sum() == pytest.approx(large.mesh.areas.sum())


def test_a_receiver_that_sees_nothing_lit_says_nothing_of_materials(capfd):
    """Nor does the linear algebra complain of a matrix without columns."""
    s, corner = scene(small()), np.array([-6.9, -5.9, 0.3])
    dark = np.array([[6.42, 5.11, 0.25]])
    ds = wr.simulate(
        s,
        transmitter=corner,
        receivers=np.concatenate([SMALL * STREET, dark]),
        frequency_hz=F,
        shape=(16, 32),
    )
    assert ds.path_gain[:-1].reshape(4, -1).any(axis=1).all()
    assert not ds.path_gain[-1].any()
    field = wr.RadioField.fit(s, ds, quick=True, effects="single")
    assert "illegal" not in "".join(capfd.readouterr())
    assert field.spectrum(dark[0]).path_gain.max() < field.floor
