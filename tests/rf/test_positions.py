"""Positions: every verb refuses what lies in solids, outside rooms or in the near field; what is in the air passes."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import rooms
from radio_scenes import box_mesh, joined
from trimesh.remesh import subdivide, subdivide_to_size

import warprrf as wr
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.materials import Material
from warprrf.rf.positions import NEAR_FIELD, check_positions, is_free, parted
from warprrf.rf.scene import Scene

F = 300e9
WAVELENGTH = 299_792_458.0 / F
LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([6.0, 5.0, 3.0])
CUPBOARD = np.array([4.0, 3.0, 0.0]), np.array([5.0, 4.5, 2.0])  # stands on the floor, faces to faces
PILLAR = np.array([4.5, 3.5, 1.0]), np.array([5.5, 4.0, 2.5])  # reaches into the cupboard
TX = np.array([1.0, 1.0, 2.2])
IN_CUPBOARD, BEHIND, AIR = np.array([4.3, 3.3, 0.7]), np.array([5.4, 4.7, 0.5]), np.array([2.0, 3.0, 1.5])
STONE = Material.custom("stone", relative_permittivity=5.0, conductivity=0.5, scattering=0.5)


def room(*more, inward=True):
    return joined(box_mesh(LOW, HIGH, inward=inward), box_mesh(*CUPBOARD), *more)[0]


def scene():
    mesh = room()
    return Scene(mesh, [STONE], np.zeros(len(mesh.faces), int))


def sheet(a, b, c, d):
    return np.array([a, b, c, d], float), np.array([[0, 1, 2], [0, 2, 3]])


def with_a_face_without_area(mesh):
    """Along an edge of the last solid, one corner amid it."""
    a, b = mesh.faces[-1, :2]
    vertices = np.vstack([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0)])
    return Mesh(vertices, np.vstack([mesh.faces, [a, len(vertices) - 1, b]]))


def subdivided(mesh, noise_m, holes, seed=0):
    """Faces cut into many with noise on their corners, shared ones alike, and some faces missing."""
    vertices, faces = subdivide_to_size(mesh.vertices, mesh.faces, 0.4)
    place, index = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    rng = np.random.default_rng(seed)
    place = place + noise_m * rng.standard_normal(place.shape)
    return Mesh(place, index.reshape(-1)[faces][rng.random(len(faces)) > holes])


@pytest.fixture(scope="module")
def field():
    s = scene()
    ds = wr.simulate(
        s,
        transmitter=TX,
        receivers=[AIR, AIR + 0.7, AIR - 0.4],
        frequency_hz=F,
        shape=(16, 32),
        roles=["train"] * 3,
    )
    return wr.RadioField.fit(s, ds, quick=True, effects="single")


@pytest.mark.parametrize(
    "verb", ["spectrum", "paths", "links", "view", "relevance", "trace_paths", "simulate"]
)
@pytest.mark.parametrize(
    ("receiver", "transmitter", "words"),
    [
        (IN_CUPBOARD, TX, r"(rx|receivers).*inside a solid"),
        (AIR, IN_CUPBOARD, "transmitter.*inside a solid"),
        (AIR, TX + [1e6, 0, 0], "transmitter.*outside the scene"),
        (TX + 1e-6, TX, "wavelengths"),
    ],
)
def test_every_verb_refuses_the_same_places(field, verb, receiver, transmitter, words):
    traced = {"transmitter": transmitter, "receivers": [receiver], "frequency_hz": F}
    ask = {
        "links": lambda: field.links([receiver], transmitter),
        "relevance": lambda: wr.relevance(field, receivers=[receiver], transmitter=transmitter),
        "trace_paths": lambda: wr.trace_paths(scene(), **traced),
        "simulate": lambda: wr.simulate(scene(), shape=(16, 32), **traced),
    }.get(verb, lambda: getattr(field, verb)(receiver, transmitter))
    with pytest.raises(ValueError, match=words):
        ask()


def test_a_data_set_measured_in_a_solid_is_refused(field):
    s = scene()
    ds = wr.simulate(s, transmitter=TX, receivers=[AIR, AIR + 0.5], frequency_hz=F, shape=(16, 32))
    filled = joined(box_mesh(LOW, HIGH, inward=True), box_mesh(AIR - 0.2, AIR + 0.2))[0]
    for model in ("bistatic", "rf3dgs+"):
        with pytest.raises(ValueError, match=r"ds.receivers\[0\].*inside a solid"):
            wr.RadioField.fit(filled, ds, model=model)


def test_a_map_marks_what_it_does_not_answer(field):
    cells = field.radio_map(0.7, 0.5)
    inside = ((cells.positions > CUPBOARD[0]) & (cells.positions < CUPBOARD[1])).all(axis=-1)
    assert inside.any() and not cells.free[inside].any() and cells.free[~inside].all()
    assert (np.isnan(cells.total_path_gain) == inside).all() and (
        np.isnan(cells.best_beam_gain) == inside
    ).all()
    with pytest.raises(ValueError, match="transmitter.*inside a solid"):
        field.radio_map(0.7, 0.5, transmitter=IN_CUPBOARD)


@pytest.mark.parametrize(
    "mesh",
    [
        room(),
        room(inward=False),  # a shell wound outward
        room(box_mesh(*PILLAR)),  # solids that overlap
        Mesh(room().vertices, np.concatenate([room().faces, room().faces[:, ::-1]])),  # every face twice
        with_a_face_without_area(room()),
        subdivided(room(), 0.0, 0.05),  # holes
        subdivided(room(), 0.01, 0.03),  # a scan
    ],
    ids=["closed", "outward", "overlapping", "doubled", "flat face", "holes", "scan"],
)
def test_solids_are_known_and_air_passes_however_the_mesh_is(mesh):
    rng = np.random.default_rng(1)
    points = rng.uniform(LOW + 0.1, HIGH - 0.1, (600, 3))
    low, high = CUPBOARD
    solid = points[((points > low + 0.05) & (points < high - 0.05)).all(axis=1)]
    air = points[((points < low - 0.1) | (points > high + 0.1)).any(axis=1)]
    if mesh.is_closed and len(mesh.faces) > 24:  # the pillar's faces
        air = air[((air < PILLAR[0] - 0.05) | (air > PILLAR[1] + 0.05)).any(axis=1)]
    assert parted(mesh, solid, TX).mean() > (0.6 if len(mesh.faces) > 100 else 0.99)
    assert not parted(mesh, air, TX).any()


def wall(rng, x, over):
    """A sheet across the room at ``x``, from wall to wall, ``over`` [m] beyond, wound either way."""
    low, high = LOW - over, HIGH + over
    vertices, faces = sheet(
        *([x, y, z] for y, z in ((low[1], low[2]), (high[1], low[2]), (high[1], high[2]), (low[1], high[2])))
    )
    return vertices, faces[:, :: rng.choice([-1, 1])]


@pytest.mark.parametrize("seed", range(12))
def test_only_what_a_closed_surface_holds_is_no_air_however_surfaces_are_wound(seed):
    rng = np.random.default_rng(seed)
    places = rng.uniform(LOW + 0.05, HIGH - 0.05, (300, 3))
    parts, solid = [box_mesh(LOW, HIGH, inward=seed % 2 > 0)], np.zeros(len(places), bool)
    for _ in range(rng.integers(0, 4)):
        # Through the floor a little.
        low = rng.uniform(LOW, HIGH - 1.6) * [1, 1, rng.integers(2)] - [0, 0, 0.02]
        high = low + rng.uniform(0.3, 1.5, 3)
        parts.append(box_mesh(low, high, inward=rng.random() < 0.2))
        solid |= ((places > low) & (places < high)).all(axis=1)
    parts += [wall(rng, rng.uniform(1, 5), rng.choice([0.0, 0.01, -0.3])) for _ in range(rng.integers(0, 4))]
    mesh = joined(*parts)[0]
    off = mesh.distance(places) > 0.01
    for known in (places[~solid & off][0], None):
        np.testing.assert_array_equal(is_free(mesh, places, known)[off], ~solid[off])


@pytest.mark.parametrize("seed", range(3))
def test_a_room_is_one_whichever_way_each_face_is_wound(seed):
    """Of an L-shaped one, whose faces enclose next to nothing by their signs, places beyond the walls were free and none within."""
    known = rooms.l_shaped().mesh
    turned = np.random.default_rng(seed).random((len(known.faces), 1)) < 0.5
    mesh = Mesh(known.vertices, np.where(turned, known.faces[:, ::-1], known.faces))
    places = np.random.default_rng(1).uniform(*known.bounds, (500, 3))
    free = is_free(known, places)
    assert 0.5 < free.mean() < 0.9
    np.testing.assert_array_equal(is_free(mesh, places), free)


def test_beyond_the_walls_is_no_air_though_finer_faces_cover_them():
    """Two surfaces, one on the other, were walls with air beyond: in the corner of an L a receiver passed."""
    known = rooms.l_shaped()
    mesh, beyond = rooms.LAWS["covered by finer faces"](known).mesh, np.array([7.0, 5.5, 1.4])
    places = np.random.default_rng(1).uniform(*mesh.bounds, (500, 3))
    np.testing.assert_array_equal(is_free(mesh, places), is_free(known.mesh, places))
    with pytest.raises(ValueError, match=r"receivers.*expected a place in the air"):
        check_positions(mesh, known.transmitter, beyond, WAVELENGTH)


def test_a_room_is_closed_though_corners_of_its_sides_do_not_meet():
    """Each side is cut into pieces by itself, as exporters and remeshers do; with one side missing it is open."""
    sides = []
    for k in range(6):
        vertices, faces = box_mesh(LOW, HIGH, inward=True)
        sides.append((vertices, faces[2 * k : 2 * k + 2]))
        for _ in range(k // 2):
            sides[-1] = subdivide(*sides[-1])
    beyond = np.array([AIR, HIGH + 0.5])
    with pytest.raises(ValueError, match=r"receivers\[1\].*outside the scene"):
        check_positions(joined(*sides)[0], TX, beyond, WAVELENGTH)
    for k in range(6):
        mesh = joined(*sides[:k], *sides[k + 1 :])[0]
        assert not mesh.is_closed and (mesh.closed_part_of < 0).all()


def test_a_room_is_one_though_fragments_lie_beside_it():
    """As in a reconstruction, whose walls have pieces before and behind them."""
    fragment = sheet([6.1, 2, 1], [6.1, 3, 1], [6.1, 3, 2], [6.1, 2, 2])
    mesh = joined(box_mesh(LOW, HIGH, inward=True), fragment)[0]
    check_positions(mesh, TX, np.zeros((0, 3)), WAVELENGTH)
    assert is_free(mesh, np.array([AIR, TX])).all()


def test_a_room_whose_walls_have_two_sheets_is_one():
    """As where an exporter writes a wall's other side in finer faces: no place in it was free, unless one was known to be."""
    whole = room()
    vertices, faces = subdivide(whole.vertices, whole.faces)
    mesh = joined((whole.vertices, whole.faces), (vertices, faces[:, ::-1]))[0]
    places = np.random.default_rng(3).uniform(LOW + 0.05, HIGH - 0.05, (200, 3))
    held = ((places > CUPBOARD[0]) & (places < CUPBOARD[1])).all(axis=1)
    for known in (TX, None):
        np.testing.assert_array_equal(is_free(mesh, places, known), ~held)


def test_a_room_of_solid_walls_has_its_air_between_them():
    walls = []
    for axis, side in np.ndindex(3, 2):
        low, high = LOW - 0.2, HIGH + 0.2
        low[axis], high[axis] = (HIGH[axis], HIGH[axis] + 0.2) if side else (LOW[axis] - 0.2, LOW[axis])
        walls.append(box_mesh(low, high))
    mesh = joined(box_mesh(CUPBOARD[0] - [0, 0, 0.05], CUPBOARD[1]), *walls)[0]
    places = np.random.default_rng(3).uniform(LOW + 0.05, HIGH - 0.05, (200, 3))
    held = ((places > CUPBOARD[0]) & (places < CUPBOARD[1])).all(axis=1)
    clear = mesh.distance(places) > 0.01
    for known in (TX, None):
        np.testing.assert_array_equal(is_free(mesh, places, known)[clear], ~held[clear])


def test_places_round_open_walls_and_lone_boxes_pass_and_in_a_box_do_not():
    rng = np.random.default_rng(4)
    for side in range(6):  # a room without it
        vertices, faces = box_mesh(LOW, HIGH, inward=side % 2 > 0)
        without = Mesh(vertices, np.delete(faces, [2 * side, 2 * side + 1], axis=0))
        check_positions(without, AIR, rng.uniform(LOW - 2, HIGH + 2, (30, 3)), WAVELENGTH)
    walls = joined(
        *(wall(rng, x, 0.0) for x in (1, 2.5, 4)), sheet([1, 2, 0], [4, 2, 0], [4, 2, 3], [1, 2, 3])
    )[0]
    check_positions(walls, AIR, rng.uniform(LOW, HIGH, (60, 3)), WAVELENGTH)
    box, around = joined(box_mesh(*CUPBOARD))[0], rng.uniform(CUPBOARD[0] - 3, CUPBOARD[1] + 3, (60, 3))
    inside = ((around > CUPBOARD[0]) & (around < CUPBOARD[1])).all(axis=1)
    check_positions(box, TX, around[~inside], WAVELENGTH)
    check_positions(box, IN_CUPBOARD, around[inside], WAVELENGTH)
    with pytest.raises(ValueError, match=r"receivers\[0\].*inside a solid"):
        check_positions(box, TX, np.array([IN_CUPBOARD, TX - 1]), WAVELENGTH)


@pytest.mark.parametrize("name", ["box", "box_one_screen", "box_two_screens"])
def test_sionnas_boxes_of_sheets_are_rooms(name, rt):
    scene = wr.Scene.load(getattr(rt.scene, name))
    places = np.random.default_rng(0).uniform([-4.9, -4.9, 0.1], [4.9, 4.9, 4.9], (400, 3))
    assert scene.is_free(places).all()
    assert is_free(scene.mesh, places, np.array([-4.0, -4.0, 4.0])).all()
    assert len(wr.sample_receivers(scene, 50, seed=0)) == 50


def test_a_hole_in_the_floor_is_no_edge_of_the_room():
    whole = subdivided(room(), 0.0, 0.0)
    middle = whole.triangles.mean(axis=1)
    hole = (middle[:, 2] == 0.0) & (np.linalg.norm(middle - [2.5, 2.0, 0.0], axis=1) < 0.3)
    torn, over = Mesh(whole.vertices, whole.faces[~hole]), middle[hole] + [0.0, 0.0, 1.0]
    assert (torn.cast(over, np.tile([0.0, 0.0, -1.0], (len(over), 1))).face < 0).sum() > 2
    for known in (TX, None):
        assert is_free(torn, over, known).all()
        assert not is_free(torn, over - [0.0, 0.0, 1.1], known).any()
        assert not is_free(torn, over + [4.0, 0.0, 0.0], known).any()


def test_two_rooms_with_a_door_are_one_air():
    """Each room a shell of its own, one wound the other way, with a doorway in both shells."""

    def shell(low, high, door_x, inward):
        fine = subdivided(joined(box_mesh(low, high, inward=inward))[0], 0.0, 0.0)
        vertices, faces = fine.vertices, fine.faces
        centre = vertices[faces].mean(axis=1)
        doorway = (np.abs(centre[:, 0] - door_x) < 1e-6) & (centre[:, 1] < 1.0) & (centre[:, 2] < 2.0)
        return vertices, faces[~doorway]

    for inward in (True, False):
        mesh = joined(shell(LOW, HIGH, 6.0, True), shell([6.2, 0, 0], [10.0, 5, 3], 6.2, inward))[0]
        points = np.random.default_rng(3).uniform([6.4, 0.2, 0.2], [9.8, 4.8, 2.8], (300, 3))
        assert (~mesh.visible(points, TX)).sum() > 50
        assert not parted(mesh, points, TX).any()


def test_an_open_scene_reaches_beyond_its_bounds_and_a_room_does_not():
    house = joined(
        box_mesh([0, 0, 0], [10, 8, 6]), sheet([-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0])
    )[0]
    mast, drone, indoors = np.array([15.0, 0, 20]), np.array([-30.0, 3, 40]), np.array([5.0, 4, 3])
    check_positions(house, mast, np.array([drone, [15.0, 15, 1.5]]), 0.1)
    with pytest.raises(ValueError, match=r"receivers\[1\].*inside a solid"):
        check_positions(house, np.array([14.0, 3, 3.5]), np.array([drone, indoors]), 0.1)
    with pytest.raises(ValueError, match=r"receivers\[0\].*outside"):
        check_positions(room(), TX, AIR[None] + [10, 0, 0], WAVELENGTH)


def test_paths_may_end_flush_with_a_wall():
    paths = wr.trace_paths(room(), transmitter=[0.0, 2.0, 1.5], receivers=AIR, frequency_hz=F)
    assert paths.kind[0] == "los"
    with pytest.raises(ValueError, match="on a surface"):
        wr.simulate(scene(), transmitter=[0.0, 2.0, 1.5], receivers=[AIR], frequency_hz=F, shape=(16, 32))


def test_a_gain_above_one_is_never_given():
    """Friis gives one at a distance of lambda / (4 pi): half of where positions are refused."""
    for apart in (0.1, 0.5 / NEAR_FIELD / 40):
        with pytest.raises(ValueError, match="reactive near field"):
            check_positions(None, TX, TX + [apart * WAVELENGTH, 0, 0], WAVELENGTH)
    with pytest.warns(UserWarning, match="receivers.*within a wavelength"):
        check_positions(None, TX, TX + [0.5 * WAVELENGTH, 0, 0], WAVELENGTH)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_positions(None, TX, TX + [1.01 * WAVELENGTH, 0, 0], WAVELENGTH)


@pytest.mark.parametrize(
    ("scale", "unit"), [(3e3, "millimetres"), (1e-3, "kilometres"), (1.0, None), (100.0, None)]
)
def test_sizes_that_are_no_metres_are_questioned(scale, unit):
    mesh = joined(box_mesh(scale * LOW, scale * HIGH, inward=True))[0]
    places = {"transmitter": scale * TX, "receivers": scale * AIR, "frequency_hz": F}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        wr.trace_paths(mesh, **places)
    assert [unit in str(w.message) for w in told if unit] == ([True] if unit else [])
    assert len(told) == (unit is not None)


def test_places_in_millimetres_beside_a_room_in_metres_are_questioned():
    with pytest.warns(UserWarning, match="transmitter: all places are .* in metres"):
        check_positions(room(), 1e3 * TX, 1e3 * AIR, WAVELENGTH)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_positions(room(), TX, AIR, WAVELENGTH)
        check_positions(room(), TX + 100.0, AIR + 100.0, WAVELENGTH)


def test_a_room_in_millimetres_is_refused_before_it_is_cut_to_elements():
    s = scene()
    ds = wr.simulate(s, transmitter=TX, receivers=[AIR], frequency_hz=F, shape=(16, 32))
    ds = replace(ds, receivers=1e3 * ds.receivers, transmitter=1e3 * ds.transmitter)
    mesh = Mesh(1e3 * s.mesh.vertices, s.mesh.faces)
    ends = {"transmitter": ds.transmitter, "receivers": ds.receivers, "frequency_hz": F}
    for ask in (lambda: wr.RadioField.fit(mesh, ds), lambda: wr.relevance(mesh, **ends)):
        with (
            pytest.warns(UserWarning, match="coordinates look like millimetres"),
            pytest.raises(ValueError, match="geometry.*elements.*millimetres"),
        ):
            ask()


def test_errors_name_the_row_of_a_link_whatever_else_is_under_its_transmitter(field):
    """A solid's receiver, the third of three under two transmitters; and in a table that has others twice."""
    other = TX + [0.3, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"receivers\[2\].*inside a solid"):
        field.spectrum([AIR, AIR, IN_CUPBOARD], [other, TX, other])
    with pytest.raises(ValueError, match=r"receivers\[2\].*inside a solid"):
        wr.trace_paths(
            scene(), transmitter=[other, TX, other], receivers=[AIR, AIR, IN_CUPBOARD], frequency_hz=F
        )
    table = wr.Readings(TX, [AIR, AIR, IN_CUPBOARD, AIR + 0.1], np.full(4, 1e-9), F, 1e-14)
    with pytest.raises(ValueError, match=r"ds.receivers\[2\].*inside a solid"):
        wr.RadioField.fit(scene(), table)
