"""What follows a first bounce: mirrors of mirrors, surfaces lit by mirrors; and materials that spectra tell apart."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, ROOM, SHAPE, TX, F, spectra
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined, mirror_paths, observation, seen
from trimesh.creation import icosphere

import warprrf as wr
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.gauss_newton import Problem, gauss_newton
from warprrf.rf.fields.bistatic.measured import SpectrumPixels
from warprrf.rf.fields.bistatic.merging import merge
from warprrf.rf.fields.bistatic.observations import columns_of
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.spectrum import to_db
from warprrf.rf.tracing.model import SETS, Effects, Parameters
from warprrf.rf.tracing.render import Interreflection, materials_of
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Rays, Tracer

WAVELENGTH = SPEED_OF_LIGHT / F
RECEIVERS = RECEIVERS[:6]


def test_facets_too_small_for_mirrors_leave_line_of_sight_alone():
    ball = icosphere(subdivisions=4, radius=0.3)
    surface = Surface.of(
        RadioScene(Mesh(ball.vertices, ball.faces), np.zeros(len(ball.faces), int), [SlabMaterial()])
    )
    assert len(surface.plane_offset) == 0
    assert len(mirror_paths(surface, TX, np.array([[1.0, 1, 1]]), WAVELENGTH, 3)) == 1


def test_a_mirror_lights_the_sides_of_a_thin_board_that_face_it():
    """All of the board lies in one cell of one group; what faces another way is lit apart."""
    mirror = np.array([[0.0, -2, -2], [0, 2, -2], [0, 2, 2], [0, -2, 2]]), np.array([[0, 1, 2], [0, 2, 3]])
    low = np.array([3.04, 0.0, 0.0])  # off the cells' borders
    board = box_mesh(low, low + [0.02, 0.1, 0.1])
    mesh, _ = joined(mirror, board)
    surface = Surface.of(RadioScene(mesh, np.zeros(len(mesh.faces), int), [SlabMaterial()]), element_m=0.9)
    tracer = Tracer.of(surface, np.array([1.0, 0.8, 0.5]), F, SHAPE, 1)
    of_board = np.flatnonzero(surface.mesh.triangles[:, :, 0].min(axis=1) > 1)
    centre = surface.mesh.triangles.mean(axis=1)
    cell = surface.cells.at(of_board, centre[of_board])
    assert len(np.unique(cell)) == 1
    lit = np.zeros(len(surface.mesh.faces), bool)
    rows, images = tracer.mirrored().pairs(surface.cells.square_at(of_board, centre[of_board]))
    lit[of_board[rows]] = True
    image = surface.images(tracer.transmitter)[tracer.mirrored().patch[images]]
    np.testing.assert_allclose(image, np.tile([-1.0, 0.8, 0.5], (len(images), 1)))
    normal = surface.mesh.face_normals
    toward = np.array([-1.0, 0.8, 0.5]) - centre
    np.testing.assert_array_equal(lit[of_board], ((normal * toward).sum(axis=1) > 0)[of_board])
    assert 0 < lit[of_board].sum() < len(of_board)


def test_an_image_lights_those_of_some_rays_that_meet_a_face_turned_to_it(scene):
    """Every ray of a receiver is asked about the image in one wall: what is seen is of the rays that meet other surfaces."""
    surface = Surface.of(scene)
    tracer = Tracer.of(surface, np.asarray(TX, float), F, SHAPE, 1)
    view = tracer.view(RECEIVERS[0], SETS["single"])
    patch = int(np.bincount(surface.patch[surface.patch >= 0]).argmax())
    image = surface.images(tracer.transmitter)[patch]
    row = np.flatnonzero(view.hits.face >= 0)[::-1]
    rays = Rays(view.hits, 10 + np.arange(len(view.hits.face)))
    seen_by, records = tracer.lit_by_images(rays, row, np.full(len(row), patch), None, 1.0)
    normal, direction = surface.mesh.face_normals[view.hits.face[row]], view.hits.directions[row]
    normal = np.where((normal * direction).sum(axis=1, keepdims=True) > 0, -normal, normal)
    lit = np.flatnonzero(((image - view.hits.points(row)) * normal).sum(axis=1) > 1e-6)
    assert 0 < len(lit) < len(row)
    np.testing.assert_array_equal(seen_by, lit)
    np.testing.assert_array_equal(records.ray, 10 + row[lit])
    np.testing.assert_array_equal(records.index[:, -1], surface.group[view.hits.face[row[lit]]])


def test_materials_under_a_transmitter_are_made_once(scene):
    """The same for equal parameters and effects, others for any that differ."""
    field = BistaticField.prior(scene, spectra(scene, RECEIVERS[:1]), effects=EVERYTHING)
    tracer, p = field.view(RECEIVERS[0]).tracer, field.parameters
    first = materials_of(tracer, p, EVERYTHING)
    alike = replace(p, log_weight=p.log_weight.copy(), log_mirror=p.log_mirror.copy())
    fewer = replace(EVERYTHING, residual=not EVERYTHING.residual, mirrors=1, diffractions=0)
    assert materials_of(tracer, alike, EVERYTHING) is materials_of(tracer, p, fewer) is first
    changed = [
        replace(p, **{name: getattr(p, name) + 0.1}) for name in ("log_weight", "log_excess", "log_mirror")
    ]
    changed += [replace(p, log_gain=0.1), replace(p, log_through=p.log_through - 0.1)]
    others = [(q, EVERYTHING) for q in changed]
    off = {"scatterings": 2, "mirror_scatter": False, "scatter_mirror": False, "transmissions": 1}
    others += [(p, replace(EVERYTHING, **{name: value})) for name, value in off.items()]
    for other in others:
        assert materials_of(tracer, *other) is not materials_of(tracer, p, EVERYTHING), other
    radiance = [materials_of(tracer, *m)._radiance for m in ((p, EVERYTHING), others[0])]
    assert not np.allclose(*radiance)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("reciprocal", [False, True])
def test_columns_are_the_sums_of_their_records(scene, reciprocal):
    """What a fit is made on: light over several surfaces exactly, single scattering with Fresnel curves of three components."""
    field = BistaticField.prior(
        scene, spectra(scene, RECEIVERS[:1]), effects=EVERYTHING, reciprocal=reciprocal
    )
    view, beam, p = field.view(RECEIVERS[0]), BeamOperator(SHAPE, np.radians(5.0)), field.parameters
    gains, o = field.path_gains(view), observation(view, SpectrumPixels(beam), field.floor)
    columns = columns_of(o, EVERYTHING, p)
    single = replace(columns, senders=columns.senders[:0], further=columns.further[:0]).power(p)

    def image(by_ray):
        return beam(by_ray.reshape(*SHAPE, -1).sum(axis=-1, keepdims=True)).ravel() / field.floor

    further = image(gains.by_ray([name for name in gains.powers if name not in ("specular", "S")]))
    np.testing.assert_allclose(columns.power(p) - single, further, rtol=1e-3, atol=1e-6 * single.max())
    curves, records = fresnel_curves(), view.records["S"]
    components = curves.at(curves.coordinates, p.log_excess[:1])[0][0] @ curves.moments  # groups are alike
    cosine = records.angle[:, 0, : 1 + reciprocal].astype(float)
    root = np.sqrt(p.excess[0] + cosine**2)
    exact = sum(0.5 * ((a - root) / (a + root)) ** 2 for a in (cosine, (1.0 + p.excess[0]) * cosine))
    share = np.interp(cosine, np.linspace(0.0, 1.0, len(components)), components).mean(axis=1) / exact.mean(
        axis=1
    )
    assert np.abs(share - 1.0).max() < 0.13
    weighed = image(np.bincount(records.ray, gains.powers["S"] * share, minlength=len(view.hits.face)))
    np.testing.assert_allclose(single, weighed, rtol=1e-3, atol=1e-5 * single.max())


SINGLE, EVERYTHING = SETS["single"], Effects(residual=False)
MATERIALS = [
    SlabMaterial("walls", 3.0, 0.5, np.inf, 0.4, "directive", 5),
    SlabMaterial("one", 6.0, 0.5, np.inf, 0.8),
    SlabMaterial("two", 6.0, 0.5, np.inf, 0.8),
]


@pytest.fixture(scope="module")
def scene():
    mesh, part = joined(
        ROOM,
        box_mesh([2.2, 1.6, 0.0], [3.0, 2.4, 1.4]),
        box_mesh([3.4, 0.8, 0.0], [4.0, 1.4, 1.0]),
    )
    return RadioScene(mesh, part, MATERIALS)


@pytest.fixture(scope="module")
def problem(scene):
    ds = spectra(scene, RECEIVERS)
    target = to_db(ds.path_gain, ds.floor) - 10 * np.log10(ds.floor)
    measured = SpectrumPixels(BeamOperator(SHAPE, np.radians(5.0)))
    observations = [
        observation(view, measured, ds.floor, t.ravel())
        for (_, view), t in zip(seen(scene, ds), target, strict=True)
    ]
    return Problem.of(observations, SINGLE, np.arange(3), Parameters.prior(3))


def test_spectra_join_groups_of_one_material_and_no_others(problem, scene):
    area = np.bincount(scene.face_material, scene.mesh.areas)
    separate = gauss_newton(problem, Parameters.prior(3), 40)
    alike = np.zeros((3, 4))  # all appear the same
    material, parameters = merge(problem, separate.parameters, alike, area)
    assert material[1] == material[2] != material[0]
    assert len(parameters.log_excess) == 2
    # and a group that was put with the wrong material goes over
    mixed = replace(problem, material=np.array([0, 1, 0]))
    again = gauss_newton(mixed, parameters, 40)
    moved, _ = merge(mixed, again.parameters, alike, area)
    assert moved[2] == moved[1] != moved[0]


def test_looks_that_differ_keep_apart_what_spectra_cannot_tell(problem, scene):
    dark = replace(
        problem, columns=[replace(c, single=0 * c.single) for c in problem.columns],
        observations=[observation(o.view, o.measured, o.floor) for o in problem.observations],
    )  # fmt: skip
    area = np.bincount(scene.face_material, scene.mesh.areas)
    look = np.array([[0.0, 0, 0, 0], [0.1, 0, 0, 0], [9.0, 0, 0, 0]])
    material, _ = merge(dark, Parameters.prior(3), look, area)
    assert material[0] == material[1]  # nothing speaks against it


def test_columns_of_materials_predict_what_those_of_their_groups_do(problem):
    rng = np.random.default_rng(0)
    owner = np.array([0, 1, 1])
    p = Parameters(rng.normal(-2, 0.5, (2, 5)), rng.normal(1, 0.3, 2), rng.normal(-1, 0.3, 2))
    for columns in problem.columns:
        light = rng.uniform(0, 5, (2, columns.single.shape[-1])).astype(np.float32)
        groups = replace(columns, senders=np.array([0, 2]), further=light)
        assert np.allclose(groups.power(p.take(owner)), groups.by_materials(owner).power(p), rtol=1e-5)


def test_light_reaches_what_is_open_and_from_there_elements_are_lit():
    """A box stands on a part of the floor, and hides some: no light is said to reach its inside or the floor under it, and what
    the rest of such an element gets is what its places get, not less for what is hidden."""
    low, high = np.array([2.1, 1.6, 0.0]), np.array([2.85, 2.3, 0.9])
    mesh, _ = joined(box_mesh(np.zeros(3), np.array([5.0, 4.0, 3.0])), box_mesh(low, high))
    scene = RadioScene(mesh, np.zeros(len(mesh.faces), int), [SlabMaterial("walls", 3.0, 0.0, np.inf, 1.0)])
    surface = Surface.of(scene)
    tracer = Tracer.of(surface, np.array([1.0, 0.8, 2.0]), F, SHAPE, 1)
    place, tiles = tracer.reached(0), surface.tiles
    there = ~np.isnan(place[:, 0])
    assert there.sum() > 0.9 * len(tiles.face)
    inside = (place[there] > low + 1e-3).all(axis=1) & (place[there] < high - 1e-3).all(axis=1)
    under = (np.abs(place[there][:, 2]) < 1e-6) & (place[there][:, :2] > low[:2] + 1e-3).all(axis=1)
    under &= (place[there][:, :2] < high[:2] - 1e-3).all(axis=1)
    assert not inside.any() and not under.any()
    open_m2 = np.bincount(surface.tile_side, np.tile(tiles.area, 2) * there)
    open_share = open_m2 / np.tile(surface.element_area, 2)
    hidden = np.unique(surface.tile_side[~there])
    partly = [side for side in hidden if 0.0 < open_share[side] < 0.9]
    assert len(partly) > 4
    # Whatever surrounds it sends the same: each place gets all of it.
    light, sides = Interreflection(tracer, 0), surface.element_sides
    even = light.between(np.ones(sides), np.ones(len(light.side)))
    np.testing.assert_allclose(even[open_share > 0], np.pi, rtol=1e-6)
    # What one flat element sends comes to others, not to itself.
    for sender in np.flatnonzero(even)[::50]:
        got = light.between(np.eye(1, sides, sender)[0], np.ones(len(light.side)))
        assert got[sender] == 0.0 and got.sum() > 0.0


def test_no_light_gets_behind_a_wall_of_metal_wherever_it_stands():
    """A wall in the middle of cells, or anywhere in elements, parts them: they were lit on both sides, 36 dB below the room.

    A ray that ends within 0.1 mm of a corner may count as on either side.
    """
    sealed, lit = [[6.03, 2.31, 1.23], [7.12, 4.03, 1.63]], [[2.0, 2.0, 1.0]]
    ds = wr.SpectrumDataset.empty(transmitter=[1.2, 1.9, 2.2], frequency_hz=28e9, shape=(12, 24), floor=1e-20)
    room = box_mesh([0, 0, 0], [8, 5, 3], inward=True)
    stone = wr.Material.custom("stone", relative_permittivity=5.0, scattering=0.4, thickness_m=0.2)
    steel = wr.Material.custom("steel", relative_permittivity=1.0, conductivity=1e7, thickness_m=0.002)
    empty = wr.Scene(Mesh(*room), [stone, steel], np.zeros(12, int))

    def wall(x, turn=0.0):
        across = 2.5 * np.array([np.sin(turn), np.cos(turn)]) / np.cos(turn)  # from wall to wall
        ends = [[x, 2.5] - across, [x, 2.5] + across]
        corners = np.array([[*end, z] for end, z in zip((*ends, *ends[::-1]), (0.0, 0, 3, 3), strict=True)])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])

    for where in ((4.1,), (4.25,), (3.87, 0.2), (4.4, -0.35)):
        mesh, part = joined(room, wall(*where))
        parted = BistaticField.prior(
            wr.Scene(mesh, [stone, steel], part), ds, effects=Effects(residual=False)
        )
        built = BistaticField.prior(empty, ds, effects=Effects(residual=False)).with_objects(
            {"wall": Mesh(*wall(*where))}, materials={"wall": "steel"}
        )
        for field in (parted, built):
            behind, before = (field.spectra(places).path_gain.sum() for places in (sealed, lit))
            assert behind < 1e-5 * before
            assert before > 1e-7


@pytest.mark.parametrize("reciprocal", [False, True])
def test_what_groups_scatter_at_an_angle_is_told_from_what_they_do_of_even_light(reciprocal):
    """By quadrature of a Lambertian surface's |Gamma|^2, of reciprocal lobes the mean of that at both angles."""
    node, weight = np.polynomial.legendre.leggauss(64)
    cosine, weight = 0.5 * (node + 1.0), 0.5 * weight
    p = replace(Parameters.prior(2, (0,), reciprocal=reciprocal), log_excess=np.log([2.0, 200.0]))
    for group, eta in enumerate((3.0, 201.0)):
        root = np.sqrt(eta - 1.0 + cosine**2)
        te, tm = (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)
        reflected = np.tile(0.5 * (te**2 + tm**2), (64, 1))  # at cosines of incidence, the columns
        if reciprocal:
            reflected = 0.5 * (reflected + reflected.T)
        scattered = 2.0 * (cosine * weight) @ reflected
        even = 2.0 * (cosine * weight) @ scattered
        found = p.scattered_over_even(np.full(64, group), cosine)
        np.testing.assert_allclose(found, scattered / even, rtol=0.06)  # of a table in steps of 1 / 256
        assert 2.0 * (cosine * weight) @ found == pytest.approx(1.0, rel=2e-3)
        np.testing.assert_allclose(0.5 * even, p.scattered_share[group], rtol=2e-3)


@pytest.mark.parametrize("count", [24, 6])
def test_slabs_that_the_data_lack_hide_no_bounces(count):
    """Sets were compared with slabs and edges that no reading has, which erred more than bounces bring: single ones were kept. Of
    few receivers these stayed."""
    wall = box_mesh([3.4, 0, 0], [3.42, 3.2, 3])
    mesh, part = joined(box_mesh([0, 0, 0], [7, 5, 3], inward=True), wall)
    bright = wr.Material.custom("bright", relative_permittivity=5.0, scattering=0.9, thickness_m=0.02)
    scene, rng = wr.Scene(mesh, [bright, bright], part), np.random.default_rng(2)
    rooms = ([3.8, 0.5, 0.5], [6.5, 4.5, 2.5]), ([0.5, 0.5, 0.5], [3.1, 4.5, 2.5])
    places = np.concatenate([rng.uniform(*room, (12, 3)) for room in rooms])
    with pytest.warns(UserWarning, match="diffraction and transmission"):
        ds = wr.simulate(
            scene, transmitter=[6.2, 4.3, 2.6], receivers=places, frequency_hz=60e9, shape=(12, 24),
            effects=replace(SETS["room"], residual=False),
        )  # fmt: skip
    ds = ds.subset(np.arange(0, 24, 24 // count))
    field = wr.RadioField.fit(scene, ds, model="bistatic", sub_pixels=1)
    tried = {choice["term"]: choice["kept"] for choice in field.report["choices"]}
    assert tried["room"] and tried["no transmission"] and field.effects.scatterings > 1
    assert field.effects.transmissions == 0


def test_light_between_bright_surfaces_is_wanted_where_there_is_some():
    """Fitted from what single bounces alone found, too bright by far, it was given up."""
    mesh, part = joined(box_mesh([0, 0, 0], [7, 5, 3], inward=True), box_mesh([2, 1.5, 0], [3.2, 2.6, 0.8]))
    bright = wr.Material.custom("bright", relative_permittivity=5.0, scattering=0.9, thickness_m=0.3)
    scene = wr.Scene(mesh, [bright, bright], part)
    places = np.random.default_rng(0).uniform([3.7, 0.5, 0.5], [6.5, 4.5, 2.5], (16, 3))
    ds = wr.simulate(
        scene, transmitter=[6.2, 4.3, 2.6], receivers=places, frequency_hz=140e9, shape=(12, 24),
        effects=replace(SETS["room"], residual=False),
    )  # fmt: skip
    field = wr.RadioField.fit(scene, ds, model="bistatic", sub_pixels=1)
    kept = {choice["term"]: choice["kept"] for choice in field.report["choices"]}
    assert kept["room"] and field.effects.scatterings > 1
