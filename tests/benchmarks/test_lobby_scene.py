"""The lobby: closed solids in a room of the stated size, committed files that the script builds, cameras where they say."""

import numpy as np
import pytest
from places import LOBBY
from radio_scenes import enclosed_volume, is_wound_alike

from benchmarks.lobby.photos import read_poses
from benchmarks.lobby.scene import ROOM, SOLIDS, build
from warprrf.geometry.mesh_files import read_mesh
from warprrf.geometry.splats.camera import Camera


def test_the_air_has_the_volume_of_the_room_less_its_furniture(lobby_scene):
    # Furniture does not overlap itself beyond the few centimetres it is sunk in: the prisms' volumes inside the room
    # follow from their profiles (shoelace formula).
    solid_volume = 0.0
    for solid in SOLIDS:
        if not solid.name.startswith(("wall", "floor", "ceiling")):
            x, y = np.array(solid.profile).T
            solid_volume += 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) * (solid.high - solid.low)
    points = np.random.default_rng(0).uniform(*ROOM, (20_000, 3))
    share = lobby_scene.is_free(points, device="cpu").mean()
    # Monte Carlo: three deviations are 0.5 % of the room; sunk parts are another 0.3 %.
    assert share == pytest.approx(1 - solid_volume / float(np.prod(ROOM[1] - ROOM[0])), abs=0.008)


@pytest.mark.long
def test_the_committed_files_are_what_the_script_builds(tmp_path):
    images = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    assert build(tmp_path).read_text() == (LOBBY / "scene.xml").read_text()
    for solid in SOLIDS:
        ours, theirs = (read_mesh(folder / f"meshes/{solid.name}.ply") for folder in (tmp_path, LOBBY))
        np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-6)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
        np.testing.assert_allclose(ours.uv, theirs.uv, atol=1e-6)
        assert is_wound_alike(ours.vertices, ours.faces) and enclosed_volume(ours.vertices, ours.faces) > 0.01
    for material in {solid.material for solid in SOLIDS}:
        ours, theirs = (np.asarray(images.open(f / f"textures/{material}.jpg")) for f in (tmp_path, LOBBY))
        # Transforms round differently from one machine to the next: a texel in a thousand may differ, by little.
        assert np.mean(np.abs(ours.astype(int) - theirs) > 2) < 1e-3


def test_mitsuba_sees_what_the_mesh_says_at_every_pixel(lobby_scene):
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    from benchmarks.lobby.photos import render_positions

    pose = read_poses(LOBBY / "poses_true.json")["view_010.jpg"].world_to_camera
    camera = Camera.pinhole(64, 48, fx=39.5, fy=39.5, cx=32, cy=24, world_to_camera=pose)
    theirs = render_positions(LOBBY / "scene.xml", camera, spp=16).reshape(-1, 3)
    directions = camera.directions().reshape(-1, 3)
    ours = lobby_scene.mesh.cast(np.tile(camera.position, (len(directions), 1)), directions, device="cpu")
    # A pixel's mean point lies within a pixel (1/39.5 rad) of its centre's; a wrong axis is metres off.
    error = np.linalg.norm(theirs - ours.point, axis=1) / ours.t
    assert np.median(error) < 0.3 / 39.5 and np.mean(error < 3 / 39.5) > 0.9
