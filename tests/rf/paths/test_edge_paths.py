"""Edges of meshes, and paths over them: what is an edge, however it is cut up, and that fields go on where others end."""

import numpy as np
import pytest
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined, square

import warprrf as wr
from warprrf.geometry.edges import mesh_edges
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import slab_passage
from warprrf.rf.em.materials import itu_material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.path_set import Paths

FENCE = np.array([[5.0, -6, 0], [5, 1, 0], [9, 1, 0], [5, -6, 2], [5, 1, 2], [9, 1, 2]])  # a bent sheet
LINK = {"transmitter": [-3.0, 4, 2], "frequency_hz": 3e9, "mirror_order": 2}


def house():
    """A house on the ground, beside a fence: four and five edges and the ground's border stand in the air, and the roof's."""
    fence = FENCE, np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    mesh, own = joined(square(60.0), box_mesh([-20, -20, 0], [0, 0, 30]), fence)
    return RadioScene(
        mesh, own, [SlabMaterial(scattering=0.3), SlabMaterial("b", 4.0, 0.02, 0.2), SlabMaterial("c")]
    )


def rewritten(scene, how):
    """The same surfaces, written otherwise, and how places are turned."""
    v, f, own, turn = scene.mesh.vertices, scene.mesh.faces, scene.face_material, np.eye(3)
    if how in ("cut", "half cut"):  # half: seams that don't match
        some = np.arange(len(f)) % (2 if how == "half cut" else 1) == 0
        a, b, c = np.moveaxis(v[f], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        small = np.stack([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]).transpose(2, 0, 1, 3)[some]
        corners = np.concatenate([v[f][~some], small.reshape(-1, 3, 3)])
        v, f = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
        own = np.concatenate([own[~some], np.repeat(own[some], 4)])
    elif how == "reversed":
        f = f[:, ::-1]
    elif how == "doubled":
        f, own = np.concatenate([f, f[:, ::-1]]), np.tile(own, 2)
    elif how == "turned":
        turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        v = v @ turn.T
    return RadioScene(Mesh(v, f), own, scene.materials), turn


@pytest.mark.parametrize("how", ["plain", "cut", "half cut", "reversed", "doubled", "turned"])
def test_edges_and_their_paths_do_not_depend_on_how_faces_are_written(how):
    scene, turn = rewritten(house(), how)
    edges = mesh_edges(scene.mesh, scene.mesh.face_normals, np.zeros(len(scene.mesh.faces), int))
    np.testing.assert_allclose(np.sort(edges.n), [1.5] * 9 + [2.0] * 8, atol=1e-9)
    np.testing.assert_allclose(
        np.sort(edges.length), sorted([2.0] * 3 + [4, 7] + [20.0] * 4 + [30.0] * 4 + [120.0] * 4)
    )
    receivers = np.array([[6.0, -4, 1.5], [3, -9, 1.5], [-25, -8, 3], [8.0, 5, 0.5]])
    link = LINK | {"transmitter": turn @ LINK["transmitter"], "receivers": receivers @ turn.T}
    total, known = (
        10 * np.log10(wr.trace_paths(s, **ends, diffractions=1).power.sum(axis=1))
        for s, ends in ((scene, link), (house(), LINK | {"receivers": receivers}))
    )
    assert np.abs(total - known).max() < 1e-9


@pytest.mark.parametrize("bare", [False, True])
def test_total_is_continuous_where_paths_and_their_mirror_images_end(bare):
    """Behind a house's corner the straight path and the ground's image end; on the other side the wall's image."""
    scene = house().mesh if bare else house()
    for turn in (-53.13010235, 53.13010235):
        azimuth = np.radians(turn + np.array([-1e-4, 1e-4]))
        receivers = np.column_stack([4 * np.cos(azimuth), 4 * np.sin(azimuth), [1.5, 1.5]])
        jumps = []
        for count in (0, 1):
            p = wr.trace_paths(scene, **LINK, receivers=receivers, diffractions=count)
            each = p.gain[..., None] if bare else p.jones.reshape(*p.gain.shape, 4)
            field = each.sum(axis=1)
            power = (np.abs(field) ** 2).sum(axis=1)
            jumps.append(abs(10 * np.log10(max(power[1], 1e-30) / max(power[0], 1e-30))))
        assert jumps[0] > 0.5 and jumps[1] < 0.01


@pytest.mark.parametrize("how", ["plain", "turned"])
@pytest.mark.parametrize("material", ["metal", "wood"])
@pytest.mark.parametrize(
    "ends", [([-5.0, 0, 0], [8.0, 0, 0]), ([-5.0, 0, -4], [-5.0, 0, 4])], ids=["straight", "mirrored"]
)
def test_total_is_continuous_on_the_boundary_itself(ends, material, how):
    """Both ends as high as a screen, or a mirror point on its border: half of the path's field is left."""
    corners = 90 * np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 0], [0, -1, 0]])
    screen = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    made_of = [itu_material(material, thickness_m=0.02)]
    scene, turn = rewritten(RadioScene(screen, np.zeros(2, np.int32), made_of), how)
    receivers = ends[1] + np.outer([0, -1, 1], [0, 0, 1e-5])
    link = {"frequency_hz": 3e9, "transmissions": 1, "diffractions": 1}
    p = wr.trace_paths(scene, transmitter=turn @ ends[0], receivers=receivers @ turn.T, **link)
    ending = (p.kind != "los") | (ends[1][0] > 0)  # line of sight does not end at a mirror's border
    power = (np.abs((p.jones * ending[..., None, None]).sum(axis=1)) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(power, power[1], rtol=1e-2)


@pytest.mark.parametrize("at_once", [0, 30])
def test_receivers_looked_at_together_get_what_each_gets_alone(monkeypatch, at_once):
    receivers = np.array([[6.0, -4, 1.5], [3, -9, 1.5], [6.0, -4, 1.5], [-25, -8, 3], [8.0, 5, 0.5]])
    ways = [LINK | {"receivers": r, "diffractions": 1} for r in (receivers, *receivers[:, None])]
    together, *alone = (wr.trace_paths(house(), **way) for way in ways)
    monkeypatch.setattr("warprrf.rf.paths.edge_paths.AT_ONCE", at_once)
    few = wr.trace_paths(house(), **ways[0])
    for k, own in enumerate(alone):
        count = int(own.valid.sum())
        assert count > 3
        for found in (together, few):
            assert np.array_equal(found.gain[k][found.valid[k]], own.gain[0][own.valid[0]])
            assert np.array_equal(found.vertices[k][:count], own.vertices[0][:count], equal_nan=True)


def test_what_a_path_over_an_edge_says_of_itself(tmp_path):
    receivers = np.array([[6.0, -4, 1.5], [-25.0, -8, 3]])
    p = wr.trace_paths(house(), **LINK, receivers=receivers, diffractions=1)
    one = p[0].select(p[0].kind == "edge")
    assert set(map(tuple, one.interactions[:, :2].tolist())) >= {(8, 0), (1, 8), (8, 1)}
    np.testing.assert_allclose(one.power, 0.5 * (np.abs(one.jones) ** 2).sum(axis=(1, 2)), rtol=1e-12)
    # Equal angles with an edge, which all are along an axis.
    for k in np.flatnonzero(one.interactions[:, 1] == 0):
        point = one.vertices[k, 0]
        legs = point - one.transmitter, one.receiver - point
        slopes = np.abs(legs[0] / np.linalg.norm(legs[0]) - legs[1] / np.linalg.norm(legs[1]))
        assert slopes.min() < 1e-12
    p.save(tmp_path / "paths.nc")
    np.testing.assert_array_equal(Paths.load(tmp_path / "paths.nc").interactions, p.interactions)


def test_a_slab_before_or_behind_an_edge_acts_as_on_any_way():
    """A metal half plane in the way, and a pane far from it: the path over the edge, through the pane, from both sides."""
    screen = np.array([[0.0, -9, -9], [0, 9, -9], [0, 9, 0], [0, -9, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    pane = screen[0] * [1, 3, 3] + [4.0, 0, 20], screen[1]
    mesh, own = joined(screen, pane)
    metal, glass = (itu_material(n, thickness_m=0.01) for n in ("metal", "glass"))
    ends, link = (
        ([-5.0, 0.5, -1], [8.0, -1, -2]),
        {"frequency_hz": 28e9, "mirror_order": 0, "diffractions": 1},
    )
    scene = wr.Scene(mesh, [metal, glass], own)
    open_air = wr.Scene(Mesh(*screen), [metal], np.zeros(2, np.int32))
    top = [
        p.select(np.flatnonzero((p.kind == "edge") & (np.abs(p.vertices[..., 2]) < 1e-9).any(axis=1)))
        for p in (
            wr.trace_paths(scene, transmitter=a, receivers=b, transmissions=1, **link)
            for a, b in (ends, ends[::-1])
        )
    ]
    free = wr.trace_paths(open_air, transmitter=ends[0], receivers=ends[1], **link)
    free = free.select(np.flatnonzero((free.kind == "edge") & (np.abs(free.vertices[:, 0, 2]) < 1e-9)))
    assert [p.interactions.tolist() for p in top] == [[[8, 4]], [[4, 8]]]
    np.testing.assert_allclose(top[0].jones[0], top[1].jones[0].T, rtol=1e-9, atol=1e-18)
    leg = ends[1] - free.vertices[0, 0]
    te, tm, longer = slab_passage(
        abs(leg[0]) / np.linalg.norm(leg), glass.permittivity(28e9), 0.01, SPEED_OF_LIGHT / 28e9
    )
    np.testing.assert_allclose((top[0].tau - free.tau) * SPEED_OF_LIGHT, longer, rtol=1e-9)
    ratio = np.linalg.norm(top[0].jones) / np.linalg.norm(free.jones)
    assert min(abs(te), abs(tm)) - 1e-9 <= ratio <= max(abs(te), abs(tm)) + 1e-9
