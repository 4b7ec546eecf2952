"""The image method against brute force over all chains: pruning loses nothing, and what is found is a path."""

import itertools
import warnings

import numpy as np
import pytest
from radio_scenes import box_mesh, joined, tube

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planar_patches import PlanarPatches, planar_patches
from warprrf.rf.paths import images as images_module
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.mirror_paths import exact_paths
from warprrf.rf.paths.trace import MirrorTracer, trace_paths

TX = np.array([0.2, -0.1, 0.3])


def shards(seed, count, sizes=(0.3, 1.0, 3.0)):
    """Triangles and rectangles of all sizes and directions about the transmitter, each a patch of its own."""
    rng = np.random.default_rng(seed)
    vertices, faces = [], []
    for k in range(count):
        centre = rng.normal(0, 2.0, 3)
        a, b = rng.normal(0, rng.choice(sizes), (2, 3))
        corners = [centre - a - b, centre + a - b, centre + a + b, centre - a + b]
        vertices += corners
        faces += [[4 * k, 4 * k + 1, 4 * k + 2]] + ([[4 * k, 4 * k + 2, 4 * k + 3]] if k % 3 else [])
    return Mesh(np.array(vertices), np.array(faces))


def brute_force(patches, transmitter, receiver, order):
    """All chains, each image made and unfolded in NumPy: their patches and points where nothing stands between."""
    n, d, mesh = patches.normal, patches.offset, patches.mesh
    found = {}
    for chain in itertools.product(range(len(patches)), repeat=order):
        if any(a == b for a, b in itertools.pairwise(chain)):
            continue
        sources = [transmitter]
        for p in chain:
            sources.append(sources[-1] - 2 * (n[p] @ sources[-1] - d[p]) * n[p])
        points, here = [], receiver
        for p, image in zip(chain[::-1], sources[:0:-1], strict=True):
            side, depth = n[p] @ here - d[p], n[p] @ image - d[p]
            if side * depth >= 0:
                break
            here = here + side / (side - depth) * (image - here)
            points.append(here)
        else:
            points = np.array(points[::-1])
            if not patches.contains(np.array(chain), points).all():
                continue
            stops = np.concatenate([[transmitter], points, [receiver]])
            if mesh.visible(stops[:-1], stops[1:]).all():
                found[chain] = points
    return found


@pytest.mark.parametrize(("order", "count", "scenes"), [(1, 30, 4), (2, 14, 6), (3, 7, 6)])
@pytest.mark.parametrize("block", [None, 5], ids=["kept", "in-blocks"])
def test_pruning_loses_no_path_of_brute_force(order, count, scenes, block, monkeypatch):
    if block:
        monkeypatch.setattr(images_module, "MOST_KEPT", 0)
        monkeypatch.setattr(images_module, "BLOCK", block)
    total = 0
    for seed in range(scenes):
        patches = planar_patches(shards(seed, count, (0.3, 1.0, 3.0) if order < 3 else (2.0, 5.0)))
        assert len(patches) == count
        points = np.random.default_rng(seed + 100).normal(0, 1.5, (5, 3))
        images = MirrorImages(patches, TX)
        paths = exact_paths(images, points, order)
        for r, point in enumerate(points):
            expected = brute_force(patches, TX, point, order)
            mine = np.flatnonzero((paths.receiver == r) & (paths.order == order))
            assert {tuple(paths.patch[k, :order].tolist()) for k in mine} == set(expected)
            for k in mine:
                np.testing.assert_allclose(
                    paths.point[k, :order], expected[tuple(paths.patch[k, :order].tolist())], atol=1e-9
                )
            total += len(mine)
    assert total >= 5


def test_a_search_without_end_is_refused_before_it_begins():
    mesh = shards(4, 80, (0.3, 1.0, 3.0))
    words = {"transmitter": TX, "frequency_hz": 3e9}
    with pytest.raises(
        ValueError, match=r"mirror_order: order 12 .* chains of .* planar patches, some .*lower"
    ):
        trace_paths(mesh, receivers=[1.0, 0.2, 0.1], mirror_order=12, **words)
    with pytest.raises(ValueError, match="expected at most 10:.*max_chains"):
        MirrorTracer(mesh, max_chains=10, **words).find(np.array([[1.0, 0.2, 0.1]]), 1)


def test_patches_with_a_back_mirror_on_their_front_alone():
    mesh = Mesh(*box_mesh([-3, -2, -1], [4, 3, 2], inward=True))
    found = planar_patches(mesh)
    point = np.array([[1.0, 1.0, 0.0]])
    for sign, expected in ((1.0, 6), (-1.0, 0)):
        given = PlanarPatches.from_planes(
            mesh, found.face_patch, sign * found.normal, sign * found.offset, tolerance_m=1e-5
        )
        assert np.bincount(exact_paths(MirrorImages(given, TX), point, 1).order, minlength=2)[1] == expected


@pytest.mark.parametrize(("facets", "curved"), [(4, False), (8, False), (16, True), (64, True)])
def test_a_smooth_surface_that_was_cut_into_mirrors_is_told_of(facets, curved):
    vertices, faces = tube(facets, 0.3, 3.0)
    pillar = vertices + [2.0, 2.0, 0.0], faces
    mesh = joined(box_mesh([0, 0, 0], [6, 5, 3], inward=True), pillar)[0]
    assert planar_patches(mesh).curved_m2 == pytest.approx(
        curved * 2 * facets * 0.3 * np.sin(np.pi / facets) * 3.0
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        trace_paths(mesh, transmitter=[1, 1, 2], receivers=[4, 3, 1], frequency_hz=300e9)
    assert ["round pillar" in str(w.message) for w in told] == [True] * curved
    assert all(w.filename == __file__ for w in told)
