"""A fitted field in a room that changed: what stays is as it was, what is new brings its own, and what vanished is named."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS
from radio_scenes import RadioScene, box_mesh, joined
from scipy.special import fresnel
from twin_fields import BLOCKED, MATERIALS, SEES, known_field, room

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.materials import Material, itu_material, skin, skin_permittivity
from warprrf.rf.em.waves import NEPER, SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField
from warprrf.rf.scene import Scene
from warprrf.rf.tracing.model import SETS, Effects

EDGES = Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=1)
ROOM, BLOCK = box_mesh([0, 0, 0], [5, 4, 3], inward=True), box_mesh([2.2, 1.6, 0.0], [3.0, 2.4, 2.4])


@pytest.fixture(scope="module")
def field():
    """Of known parameters, with differences within its surfaces."""
    plain = known_field()
    spread = np.random.default_rng(0).normal(0.0, 0.3, plain.residual.shape)
    return replace(plain, residual=spread, effects=replace(SETS["single"], residual=True))


def box(low, high):
    return Mesh(*box_mesh(low, high))


def sheet(x, low, high):
    """A rectangle across x."""
    (y, z), (v, w) = low, high
    return Mesh([[x, y, z], [x, v, z], [x, v, w], [x, y, w]], [[0, 1, 2], [0, 2, 3]])


def gains(field, receiver=SEES):
    return field.spectrum(receiver).path_gain


def with_block_at(shift):
    mesh, part = joined(ROOM, (BLOCK[0] + shift, BLOCK[1]))
    return RadioScene(mesh, part, MATERIALS)


@pytest.mark.parametrize("what", ["scene", "bare mesh", "the field's own mesh", "the field's surface"])
def test_where_nothing_moved_nothing_changes(field, what):
    geometry = {
        "scene": room(),
        "bare mesh": room().mesh,
        "the field's own mesh": field.mesh,
        "the field's surface": field.surface,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same = field.with_geometry(geometry[what])
    assert np.array_equal(gains(same), gains(field))
    assert same.errors is field.errors


def test_the_same_room_cut_and_ordered_otherwise_answers_the_same(field):
    """Faces in another order, half of them wound the other way, and a wall of other triangles: groups and differences within them
    are found by place."""
    mesh = room().mesh
    order = np.random.default_rng(1).permutation(len(mesh.faces))
    faces = mesh.faces[order]
    faces[::2] = faces[::2, ::-1]
    found = gains(field.with_geometry(Mesh(mesh.vertices, faces)))
    assert np.allclose(found, gains(field), rtol=1e-4, atol=1e-3 * field.floor)
    first, middle = mesh.faces[0], len(mesh.vertices)
    fan = [[a, b, middle] for a, b in zip(first, np.roll(first, -1), strict=True)]
    centre = mesh.triangles[:1].mean(axis=1)
    four = Mesh(np.concatenate([mesh.vertices, centre]), np.concatenate([mesh.faces[1:], fan]))
    other = field.with_geometry(four)
    assert other.surface.groups == field.surface.groups
    plain, again = (replace(f, effects=replace(f.effects, residual=False)) for f in (field, other))
    assert np.allclose(gains(again), gains(plain), rtol=2e-3, atol=1e-2 * field.floor)


def test_what_comes_and_goes_leaves_no_trace(field):
    person = box([1.2, 3.0, 0.01], [1.7, 3.3, 1.8])
    there = field.with_objects({"person": person}, materials={"person": "skin"})
    assert not np.allclose(gains(there), gains(field), rtol=1e-2, atol=0)
    assert np.array_equal(gains(there.with_objects({"person": None})), gains(field))
    edges = replace(field, effects=replace(field.effects, diffractions=1))
    gone = edges.with_objects({"person": person}, materials={"person": "skin"}).with_objects({"person": None})
    assert np.array_equal(gains(gone), gains(edges))


def test_a_new_box_throws_its_shadow_and_no_more(field):
    direct = replace(field, effects=Effects(mirrors=0, scatterings=0, transmissions=0, diffractions=0))
    middle = 0.5 * (SEES + field.transmitter)
    there = direct.with_objects({"cabinet": box(middle - 0.2, middle + 0.2)}, materials={"cabinet": "metal"})
    beside = direct.with_objects(
        {"cabinet": box(middle + [0, 0.6, 0], middle + [0.4, 1.0, 0.4])}, materials={"cabinet": "metal"}
    )
    sees = RECEIVERS[1]
    assert gains(direct, sees).max() > 0
    between = 0.5 * (sees + field.transmitter)
    dark = direct.with_objects({"cabinet": box(between - 0.2, between + 0.2)}, materials={"cabinet": "metal"})
    assert gains(dark, sees).max() == 0
    assert np.array_equal(gains(beside, sees), gains(direct, sees))
    assert there.mesh.visible([sees], [field.transmitter]).all()


def test_a_moved_thing_keeps_its_material_and_a_moved_scene_says_the_same(field):
    shift = np.array([-0.6, 0.9, 0.0])
    moved = field.with_geometry(with_block_at(shift))
    assert moved.surface.groups == field.surface.groups
    assert np.array_equal(moved.parameters.log_weight, field.parameters.log_weight)
    by_hand = known_field(effects=moved.effects)
    surface = type(field.surface).of(with_block_at(shift))
    by_hand = replace(by_hand, surface=surface, residual=np.zeros((2, len(surface.cells))))
    plain = replace(moved, residual=np.zeros_like(moved.residual))
    assert np.allclose(gains(plain, BLOCKED), gains(by_hand, BLOCKED), rtol=1e-4, atol=1e-3 * field.floor)
    named = field.with_objects({"block/top <1>": Mesh(BLOCK[0] + shift, BLOCK[1])})
    assert np.allclose(gains(named, BLOCKED), gains(moved, BLOCKED), rtol=1e-4, atol=1e-3 * field.floor)
    tiles = moved.surface.tiles
    walls = moved.residual[:, np.unique(tiles.cell[moved.surface.group[tiles.face] == 0])]
    assert (walls != 0).all()  # what was learned of the walls stays


def test_a_material_becomes_its_lobe_its_mirror_and_its_permittivity(field):
    """Of a half-space of marble that scatters half its power: what the exact engine would reflect head on."""
    marble = itu_material("marble", scattering=np.sqrt(0.5), pattern="directive", alpha_r=5).extrapolated()
    there = field.with_objects({"slab": box([1, 3, 0.5], [1.5, 3.5, 1])}, materials={"slab": marble})
    p, g = there.parameters, there.surface.group_names.index("marble")
    root = np.sqrt(marble.permittivity(field.frequency_hz))
    head_on = abs((root - 1) / (root + 1)) ** 2
    assert p.mirrored_share[g] == pytest.approx(0.5 * head_on, rel=1e-6)
    assert p.weight[g] == pytest.approx([0, 0.5, 0], abs=1e-9)  # exponents 0, 4 and 12
    metal = field.with_objects(
        {"slab": box([1, 3, 0.5], [1.5, 3.5, 1])}, materials={"slab": "metal"}
    ).parameters
    assert -1.3 < NEPER * np.log(metal.mirrored_share[-1]) < 0


def test_a_name_of_the_fields_own_goes_before_the_librarys(field):
    there = field.with_objects({"shelf": box([1, 3, 0.5], [1.5, 3.5, 1])}, materials={"shelf": "walls"})
    assert there.surface.groups == field.surface.groups
    assert (there.surface.group[there.surface.faces_of("shelf")] == 0).all()


def test_a_vanished_surface_warns_and_says_which(field):
    mesh, part = joined(ROOM, ROOM)
    bare = RadioScene(Mesh(mesh.vertices, mesh.faces[:12]), part[:12], MATERIALS)
    with pytest.warns(
        UserWarning, match=r"of 8.96 m\^2 of the fitted surface 'block/top <1>', 8.96 m\^2 have vanished"
    ):
        gone = field.with_geometry(bare)
    assert gains(gone, BLOCKED).max() > gains(field, BLOCKED).max()


def test_something_new_that_nobody_knows_warns(field):
    scene = room()
    vertices, faces = box_mesh([0.5, 3.0, 0.3], [1.0, 3.5, 0.8])
    mesh = Mesh(
        np.concatenate([scene.mesh.vertices, vertices]),
        np.concatenate([scene.mesh.faces, faces + len(scene.mesh.vertices)]),
    )
    with pytest.warns(UserWarning, match=r"1.5 m\^2 are new, of 'new', a material that nobody knows"):
        there = field.with_geometry(mesh)
    assert there.surface.group_names[-1] == "new"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = there.with_geometry(mesh)
    assert np.array_equal(again.surface.group, there.surface.group)
    assert np.array_equal(gains(again), gains(there))


@pytest.mark.parametrize(
    ("objects", "materials", "message"),
    [
        ({"person": None}, None, r"objects: got None for 'person', expected one of 'walls'"),
        (
            {"person": box([1, 3, 0], [2, 4, 1])},
            None,
            r"materials\['person'\]: got None, expected a Material",
        ),
        (
            {"person": box([1, 3, 0], [2, 4, 1])},
            {"person": "skim"},
            r"materials\['person'\]: got 'skim'.* 'skin', ",
        ),
        (
            {"person": box([1, 3, 0], [2, 4, 1])},
            {"persn": "skin"},
            r"materials: got 'persn', expected among the objects 'person'",
        ),
        (
            {"person": box([1, 3, 0], [2, 4, 1])},
            {"person": itu_material("brick")},
            r"frequency_hz: got 300 GHz, but",
        ),
    ],
)
def test_wrong_names_are_refused(objects, materials, message):
    field = known_field(frequency_hz=300e9)
    if materials and isinstance(next(iter(materials.values())), Material):
        materials = {"person": itu_material("vinyl_tile")}
    with pytest.raises(ValueError, match=message):
        field.with_objects(objects, materials=materials)


def test_what_is_no_mesh_is_refused_by_name(field):
    with pytest.raises(TypeError, match=r"objects\['person'\]: got str, expected a Mesh"):
        field.with_objects({"person": "person.ply"}, materials={"person": "skin"})


def test_an_edited_field_is_saved_and_loaded(field, tmp_path):
    there = field.with_objects(
        {"person": box([1.2, 3.0, 0.01], [1.7, 3.3, 1.8])}, materials={"person": "skin"}
    )
    there.save(tmp_path / "field.safetensors")
    again = RadioField.load(tmp_path / "field.safetensors")
    assert np.array_equal(gains(again), gains(there))
    assert again.surface.object_names == ("person",)
    assert np.array_equal(gains(again.with_objects({"person": None})), gains(field))
    assert there.paths(SEES).power.sum() == pytest.approx(gains(there).sum(), rel=1e-5)
    links = there.links(RECEIVERS[:3])
    assert links is not None
    with pytest.raises(ValueError, match="uncertainty: .* it was edited"):
        there.spectrum(SEES, uncertainty=True)


def test_a_scene_of_named_objects_moves_one_of_them():
    """Two boxes of one material: each is an object of its own."""
    low = box_mesh([1, 1, 0], [1.5, 1.5, 1.0])
    mesh, part = joined(ROOM, low, box_mesh([3, 3, 0], [3.5, 3.5, 1.0]))
    scene = Scene(
        mesh, [itu_material(n, thickness_m=np.inf).extrapolated() for n in ("concrete", "wood")], np.minimum(part, 1),
        face_object=part, object_names=["room", "first", "second"],
    )  # fmt: skip
    surface = type(known_field().surface).of(scene)
    field = known_field(
        surface=surface, material=surface.material, residual=np.zeros((2, len(surface.cells))),
        parameters=known_field().parameters.take(np.array([0, 1])),
    )  # fmt: skip
    moved = field.with_objects({"first": Mesh(low[0] + [0, 1.5, 0], low[1])})
    centre = moved.mesh.triangles[moved.surface.group == 1].mean(axis=(0, 1))
    assert centre == pytest.approx([2.25, 3.0, 0.5], abs=0.01)
    assert moved.surface.groups == 2


def test_skin_is_that_of_gabriel():
    """60 GHz: 7.98 - 10.9j in the tables that follow Gabriel et al. 1996 (IFAC-CNR); 40.9 and 0.900 S/m at 1 GHz."""
    assert skin_permittivity(60e9) == pytest.approx(7.98 - 10.90j, abs=0.01)
    assert skin_permittivity(1e9).real == pytest.approx(40.9, abs=0.1)
    assert skin().conductivity(1e9) == pytest.approx(0.900, abs=0.002)
    for frequency_hz in (0.3e9, 2.45e9, 28e9, 60e9, 99e9, 300e9):
        assert skin().permittivity(frequency_hz) == pytest.approx(skin_permittivity(frequency_hz), rel=5e-3)
    assert skin().band(60e9).source == "Gabriel et al. 1996, dry skin"
    assert skin().band(300e9).source.startswith("extrapolated from 0.1 to 100 GHz")


@pytest.mark.parametrize("x", [1.9, 2.5, 3.3])
def test_a_person_across_a_link_shadows_as_a_screen_of_p526_does(x):
    """Finite-width screen of ITU-R P.526: both sides and the top as knife edges, added in power; in the middle of the link too."""
    walls = RadioScene(*joined(box_mesh([0, -2, -2], [5, 6, 5], inward=True)), MATERIALS)
    surface = type(known_field().surface).of(walls)
    ends, carrier = np.array([[0.5, 2.0, 1.2], [4.5, 2.0, 1.2]]), 60e9
    field = known_field(
        surface=surface, material=surface.material, residual=np.zeros((2, len(surface.cells))), effects=EDGES, transmitter=ends[0],
        frequency_hz=carrier,
    )  # fmt: skip
    free = field.paths(ends[1]).power.sum()
    scale = np.sqrt(2 * carrier / SPEED_OF_LIGHT * (1 / (x - 0.5) + 1 / (4.5 - x)))
    for y in (1.83, 1.9, 2.0, 2.04, 2.15):
        now = field.with_objects(
            {"person": sheet(x, (y - 0.25, 0.01), (y + 0.25, 1.8))}, materials={"person": "skin"}
        )
        sine, cosine = fresnel(scale * np.array([y + 0.25 - 2.0, 2.0 - y + 0.25, 1.8 - 1.2]))
        known = (0.5 * ((0.5 - cosine) ** 2 + (0.5 - sine) ** 2)).sum()
        assert NEPER * np.log(now.paths(ends[1]).power.sum() / free / known) == pytest.approx(0.0, abs=0.5)


def test_edges_are_made_of_what_their_faces_are(field):
    """A material that no edge is of does not change what arrives over edges."""
    edges = replace(field, effects=EDGES)
    last = replace(edges.surface, dispersion=edges.surface.dispersion.copy())
    last.dispersion[-1] = 5.0, 0.0, 10.0, 0.0
    last.thickness_m[-1] = np.inf
    other = replace(edges, surface=last)
    assert edges.paths(BLOCKED).power.sum() == other.paths(BLOCKED).power.sum() > 0


def test_a_new_pane_at_another_carrier_is_the_one_that_is_added_there(field):
    """A material of ITU-R P.2040 has a law for each band: that of 300 GHz does not hold at 28 GHz."""
    glass = itu_material("glass", thickness_m=0.006).extrapolated()
    pane = {"objects": {"pane": sheet(1.6, (0.1, 0.1), (3.9, 2.9))}, "materials": {"pane": glass}}
    first, then = field.with_objects(**pane).at_frequency(28e9), field.at_frequency(28e9).with_objects(**pane)
    for one in first, then:
        assert one.surface.slab_properties(28e9)[0][-1] == pytest.approx(glass.permittivity(28e9))
