"""Line of sight and mirror paths against float64 geometry and the Fresnel limits."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from radio_scenes import METAL, RadioScene, SlabMaterial, box_mesh, joined, square
from scipy.spatial.transform import Rotation

from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import trace_paths

F = 300e9
WAVELENGTH = SPEED_OF_LIGHT / F
LOW, HIGH = np.array([-7.0, -6, 0]), np.array([8.0, 6, 4])
TX = np.array([-5.123, 3.456, 2.789])


def room():
    return Mesh(*box_mesh(LOW, HIGH, inward=True))


def receivers(n, seed=0):
    return np.random.default_rng(seed).uniform(LOW + 0.3, HIGH - 0.3, (n, 3))


def box_images(order):
    """Images of the transmitter in an empty box with exactly ``order`` reflections: each wall sequence that differs."""
    images = []
    for n in itertools.product(range(-order, order + 1), repeat=3):
        if np.abs(n).sum() == order:
            even = np.array(n) % 2 == 0
            # |n| reflections in one axis: shift by whole double rooms, flip when odd.
            size = HIGH - LOW
            local = np.where(even, TX - LOW, HIGH - TX)
            images.append(LOW + np.array(n) * size + local)
    return np.array(images)


def test_anything_with_a_mesh_is_traced_as_that_mesh():
    settings = {"transmitter": TX, "receivers": [1.0, -2, 1.5], "frequency_hz": F, "mirror_order": 1}
    bare, carried = trace_paths(room(), **settings), trace_paths(SimpleNamespace(mesh=room()), **settings)
    np.testing.assert_array_equal(carried.gain, bare.gain)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_box_paths_are_the_image_lattice_to_1e_9(order):
    points = receivers(20)
    paths = trace_paths(room(), transmitter=TX, receivers=points, frequency_hz=F, mirror_order=order)
    for k, point in enumerate(points):
        expected = [np.linalg.norm(box_images(m) - point, axis=1) for m in range(order + 1)]
        found = np.sort(paths.length_m[k][paths.valid[k]])
        np.testing.assert_allclose(found, np.sort(np.concatenate(expected)), rtol=1e-12)


@pytest.mark.parametrize("point", [LOW + 0.5 * (TX - LOW), TX * [1, 1, 0.5], TX * [0.5, 1, 1] - [3.5, 0, 0]])
def test_paths_through_the_edges_of_a_room_are_the_image_lattice(point):
    """Ends on a plane through an edge, a corner, or above each other: paths meet two or three walls at one place."""
    paths = trace_paths(room(), transmitter=TX, receivers=point, frequency_hz=F, mirror_order=3)
    expected = np.concatenate([np.linalg.norm(box_images(m) - point, axis=1) for m in range(4)])
    np.testing.assert_allclose(np.sort(paths.length_m), np.sort(expected), rtol=1e-12)
    outside = Mesh(*box_mesh(LOW, HIGH))
    away = LOW + 2.0 * (LOW - TX) * [1, 1, 0.5], LOW + (LOW - TX) * [1, 1, -1]
    assert trace_paths(
        outside, transmitter=away[0], receivers=away[1], frequency_hz=F, mirror_order=2
    ).kind.tolist() == ["los"]


def test_angles_and_vertices_describe_the_same_polyline():
    paths = trace_paths(room(), transmitter=TX, receivers=receivers(5), frequency_hz=F, mirror_order=2)
    for r, point in enumerate(receivers(5)):
        for k in np.flatnonzero(paths.valid[r]):
            v = paths.vertices[r, k]
            v = v[np.isfinite(v[:, 0])]
            chain = np.concatenate([[TX], v, [point]])
            steps = np.diff(chain, axis=0)
            lengths = np.linalg.norm(steps, axis=1)
            assert lengths.sum() == pytest.approx(paths.length_m[r, k], rel=1e-13)
            np.testing.assert_allclose(paths.departure[r, k], steps[0] / lengths[0], atol=1e-12)
            np.testing.assert_allclose(paths.arrival[r, k], -steps[-1] / lengths[-1], atol=1e-12)
            for a, b in itertools.pairwise(steps / lengths[:, None]):
                # An axis-aligned mirror only flips a sign.
                assert (np.abs(np.abs(a) - np.abs(b)) < 1e-9).all()


def test_paths_of_several_receivers_do_not_become_those_of_one():
    paths = trace_paths(room(), transmitter=TX, receivers=receivers(2), frequency_hz=F)
    for join, parts, said in (
        (Paths.concatenate, [paths[0], paths[1]], "of several receivers, expected those of one"),
        (Paths.concatenate, [paths, paths], "lists of several receivers"),
        (Paths.stack, [paths, paths], "lists of several receivers"),
    ):
        with pytest.raises(ValueError, match=f"parts: got (paths )?{said}"):
            join(parts)
    assert [one.gain.shape for one in paths] == [paths[0].gain.shape, paths[1].gain.shape]
    np.testing.assert_array_equal(Paths.concatenate([paths[0], paths[0]]).receiver, paths[0].receiver)
    here, there, anywhere = (replace(paths[0], transmitter=at) for at in (TX, TX + 1.0, None))
    assert Paths.stack([here, there, anywhere]).transmitter is None  # it was said to be the first one's
    np.testing.assert_array_equal(Paths.stack([here, anywhere]).transmitter, TX)


def test_swapping_the_ends_keeps_gain_and_delay():
    blocker = box_mesh([-1, -1, 0], [0.5, 1.5, 2.2])
    mesh, part = joined(box_mesh(LOW, HIGH, inward=True), blocker)
    scene = RadioScene(mesh, part, [SlabMaterial(scattering=0.3), SlabMaterial(relative_permittivity=2.0)])
    for point in receivers(8, 3):
        if mesh.distance(point[None])[0] < 0.01 or np.all((point > [-1, -1, 0]) & (point < [0.5, 1.5, 2.2])):
            continue
        there, back = (
            trace_paths(scene, transmitter=a, receivers=b, frequency_hz=F, mirror_order=2, diffractions=1)
            for a, b in ((TX, point), (point, TX))
        )
        assert len(there.tau) == len(back.tau)
        a, b = np.argsort(there.tau), np.argsort(back.tau)
        np.testing.assert_allclose(there.tau[a], back.tau[b], rtol=1e-12)
        np.testing.assert_allclose(there.power[a], back.power[b], rtol=1e-9)
        np.testing.assert_allclose(there.theta_r[a], back.theta_t[b], atol=1e-9)


@pytest.mark.usefixtures("device")
def test_a_screen_takes_away_what_it_hides():
    floor, screen = (
        square(50.0),
        (np.array([[0, -3, 0.0], [0, 3, 0], [0, 3, 2], [0, -3, 2]]), np.array([[0, 1, 2], [0, 2, 3]])),
    )
    mesh, _ = joined(floor, screen)
    hidden = trace_paths(mesh, transmitter=[-2, 0, 1], receivers=[2, 0, 1.2], frequency_hz=F)
    assert len(hidden.gain) == 0
    over = trace_paths(mesh, transmitter=[-2, 0, 3], receivers=[2, 0, 3.4], frequency_hz=F)
    assert over.kind.tolist() == ["los"]
    beside = trace_paths(mesh, transmitter=[-2, 5, 1], receivers=[2, 5, 1.2], frequency_hz=F)
    assert beside.kind.tolist() == ["los", "mirror"]


@pytest.mark.parametrize("turn", range(4))
def test_a_partition_in_the_very_middle_stops_what_the_floor_mirrors_at_its_foot(turn):
    half = np.array([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1.0]])
    mesh, _ = joined(square(5.0), (half, np.array([[0, 1, 2], [0, 2, 3]])))
    turned = Rotation.random(random_state=turn).as_matrix().T if turn else np.eye(3)
    ends = np.array([[-2.0, 0, 0.5], [2.0, 0, 0.5]]) @ turned
    found = trace_paths(
        Mesh(mesh.vertices @ turned, mesh.faces), transmitter=ends[0], receivers=ends[1], frequency_hz=F
    )
    assert len(found.gain) == 0


def test_ends_on_one_surface_are_refused():
    """Ways between them lie in it; an end on a surface and one off it is an antenna mounted flush."""
    ask = {"transmitter": [-5.0, 3, 0], "frequency_hz": F, "mirror_order": 1}
    with pytest.raises(ValueError, match="receivers: .* lies on the same surface as the transmitter"):
        trace_paths(room(), receivers=[2.0, 1, 0], **ask)
    assert len(trace_paths(room(), receivers=[2.0, 1, 0.001], **ask).gain) == 6


def test_a_path_over_the_seam_of_two_faces_counts_once():
    mesh = Mesh(*square(1.0))
    p = trace_paths(mesh, transmitter=[-0.5, -0.5, 1], receivers=[0.5, 0.5, 1], frequency_hz=F)
    assert p.kind.tolist() == ["los", "mirror"]


def test_a_bare_mesh_reflects_perfectly_and_metal_does_almost():
    mesh = Mesh(*square(10.0))
    ends = dict(transmitter=[-1, 0, 2.0], receivers=[2, 1, 1.0], frequency_hz=F)
    bare = trace_paths(mesh, **ends)
    d = np.linalg.norm([3, 1, 3])
    np.testing.assert_allclose(
        bare.gain[1], WAVELENGTH / (4 * np.pi * d) * np.exp(-2j * np.pi * F * bare.tau[1]), rtol=1e-9
    )
    metal = trace_paths(RadioScene(mesh, np.zeros(2, int), [METAL]), **ends)
    np.testing.assert_allclose(metal.gain[1], -bare.gain[1], rtol=5e-3)
    rough = trace_paths(
        RadioScene(mesh, np.zeros(2, int), [SlabMaterial(conductivity=1e7, scattering=0.6)]), **ends
    )
    np.testing.assert_allclose(rough.power[1] / metal.power[1], 1 - 0.36, rtol=1e-3)
