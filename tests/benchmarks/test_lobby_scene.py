"""The lobby: closed solids in a room of the stated size, what the XML says, and cameras that look where they say."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from places import LOBBY
from radio_scenes import enclosed_volume, is_wound_alike

from benchmarks.lobby.photos import HELD_OUT_EVERY, look, read_poses, shown, surface_samples
from benchmarks.lobby.scene import PLAIN_STYLES, ROOM, build, lobby, solids_of
from benchmarks.lobby.textures import STYLES, paint
from warprrf.geometry.mesh_files import read_mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.rf.scene import Scene

PAINTS = set(PLAIN_STYLES.values())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load(LOBBY / "scene.xml")


def test_every_object_is_a_closed_solid_that_faces_outwards() -> None:
    for solid in lobby():
        mesh = read_mesh(LOBBY / "meshes" / f"{solid.name}.ply")
        assert is_wound_alike(mesh.vertices, mesh.faces), solid.name
        assert enclosed_volume(mesh.vertices, mesh.faces) > 0.01, solid.name


def test_the_air_has_the_volume_of_the_room_less_its_furniture(scene: Scene) -> None:
    # Furniture does not overlap itself beyond the few centimetres it is sunk in: the prisms' volumes inside the room
    # follow from their profiles (shoelace formula).
    solid_volume = 0.0
    for solid in lobby():
        if solid.name.startswith(("wall", "floor", "ceiling")):
            continue
        x, y = np.array(solid.profile).T
        area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
        solid_volume += area * (solid.high - solid.low)
    room = float(np.prod(ROOM[1] - ROOM[0]))
    rng = np.random.default_rng(0)
    points = rng.uniform(*ROOM, (20_000, 3))
    share = scene.is_free(points, device="cpu").mean()
    # Monte Carlo: three deviations are 0.5 % of the room; sunk parts are another 0.3 %.
    assert share == pytest.approx(1 - solid_volume / room, abs=0.008)


def test_no_ray_leaves_the_room(scene: Scene) -> None:
    rng = np.random.default_rng(1)
    origins = rng.uniform([6.5, 4.5, 0.5], [8.0, 5.5, 2.2], (2000, 3))
    directions = rng.standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hit = scene.mesh.cast(origins, directions, device="cpu")
    assert np.isfinite(hit.t).all()
    assert (hit.point > ROOM[0] - 1e-4).all() and (hit.point < ROOM[1] + 1e-4).all()
    assert (np.einsum("ij,ij->i", scene.mesh.face_normals[hit.face], directions) < 0).all()


def test_the_committed_files_are_what_the_script_builds(tmp_path: Path) -> None:
    xml = build(tmp_path)
    assert xml.read_text() == (LOBBY / "scene.xml").read_text()
    assert json.loads((tmp_path / "materials.json").read_text()) == json.loads(
        (LOBBY / "materials.json").read_text()
    )
    for solid in lobby():
        name = f"meshes/{solid.name}.ply"
        ours, theirs = read_mesh(tmp_path / name), read_mesh(LOBBY / name)
        np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-6)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
        assert ours.uv is not None and theirs.uv is not None
        np.testing.assert_allclose(ours.uv, theirs.uv, atol=1e-6)


def test_every_shape_shows_its_own_part_of_a_texture() -> None:
    for shape in ElementTree.parse(LOBBY / "scene.xml").getroot().findall("shape"):
        mesh = read_mesh(LOBBY / "meshes" / f"{shape.get('id')}.ply")
        assert mesh.uv is not None
        assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    images = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    for path in (LOBBY / "textures").glob("*.jpg"):
        with images.open(path) as image:
            assert np.asarray(image).std() > 15


@pytest.mark.parametrize("style", sorted(set(STYLES) - PAINTS))
def test_textures_never_repeat(style: str) -> None:
    image = paint(style, 2.4, 2.4, 0.02, np.random.default_rng(0)).mean(axis=2)
    image = image - image.mean()
    spectrum = np.abs(np.fft.fft2(image, s=(240, 240))) ** 2
    correlation = np.fft.ifft2(spectrum).real[:100, :100] / np.sum(image**2)
    # Normalised autocorrelation at shifts of half a metre and more: a repeated pattern would come near one.
    correlation[:25, :25] = 0
    assert correlation.max() < 0.5
    assert image.std() > 0.05


def test_the_plain_lobby_is_the_lobby_in_plain_paint() -> None:
    plain = LOBBY.parent / "lobby_plain"
    for patterned, painted in zip(lobby(), solids_of("plain"), strict=True):
        bare = patterned.name.startswith(("wall", "ceiling", "pillar", "gallery", "partition"))
        assert (painted.style in PAINTS) == bare, painted.name
        ours, theirs = (read_mesh(d / f"meshes/{patterned.name}.ply") for d in (plain, LOBBY))
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
    assert (plain / "poses_true.json").read_text() == (LOBBY / "poses_true.json").read_text()
    assert len(list((plain / "photos").glob("*.jpg"))) == len(read_poses(plain / "poses_true.json"))
    for style in PAINTS:
        assert np.ptp(paint(style, 1.0, 1.0, 0.02, np.random.default_rng(0)), axis=(0, 1)).max() < 1e-6


def test_unknown_style_is_refused() -> None:
    with pytest.raises(ValueError, match="style"):
        paint("velvet", 1.0, 1.0, 0.01, np.random.default_rng(0))


def test_a_camera_looks_where_its_angles_say() -> None:
    camera = look(np.array([1.0, 2.0, 1.5]), yaw=0.7, pitch=0.2)
    axis = camera.world_to_camera[:3, :3].T @ [0, 0, 1]
    assert np.arctan2(axis[1], axis[0]) == pytest.approx(0.7)
    assert np.arcsin(axis[2]) == pytest.approx(0.2)
    down = camera.world_to_camera[:3, :3].T @ [0, 1, 0]
    assert down[2] < -0.9  # image rows grow towards the floor
    np.testing.assert_allclose(camera.position, [1.0, 2.0, 1.5])


def test_photo_roles_and_clearance(scene: Scene) -> None:
    cameras = read_poses(LOBBY / "poses_true.json")
    roles = json.loads((LOBBY / "photos.json").read_text())
    surveyed = json.loads((LOBBY / "surveyed.json").read_text())
    assert 90 <= len(cameras) <= 150
    assert len(roles["held_out"]) == len(cameras) // HELD_OUT_EVERY
    assert not set(roles["held_out"]) & set(surveyed)
    for name, position in surveyed.items():
        np.testing.assert_allclose(cameras[name].position, position, atol=1e-4)
    positions = np.array([camera.position for camera in cameras.values()])
    assert scene.is_free(positions, clearance_m=0.5, device="cpu").all()


def test_photos_show_what_receivers_see(scene: Scene) -> None:
    points, normals = surface_samples(scene, np.random.default_rng(3), per_m2=2.0)
    cameras = read_poses(LOBBY / "poses_true.json")
    count = sum(shown(scene, camera, points, normals).astype(int) for camera in cameras.values())
    assert np.mean(count >= 2) > 0.93
    assert np.mean(count >= 4) > 0.85


def test_mitsuba_sees_what_the_mesh_says_at_every_pixel(scene: Scene) -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    from benchmarks.lobby.mitsuba_photos import render_positions

    pose = look(np.array([2.5, 5.5, 1.6]), yaw=0.3, pitch=-0.1).world_to_camera
    camera = Camera.pinhole(64, 48, fx=39.5, fy=39.5, cx=32, cy=24, world_to_camera=pose)
    theirs = render_positions(LOBBY / "scene.xml", camera, spp=16).reshape(-1, 3)
    directions = camera.directions().reshape(-1, 3)
    ours = scene.mesh.cast(np.tile(camera.position, (len(directions), 1)), directions, device="cpu")
    # A pixel's mean point lies within a pixel (1/39.5 rad) of its centre's; a wrong axis is metres off.
    error = np.linalg.norm(theirs - ours.point, axis=1) / ours.t
    assert np.median(error) < 0.3 / 39.5
    assert np.mean(error < 3 / 39.5) > 0.9
