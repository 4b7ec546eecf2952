"""Poses and depth that are known already: read, matched with photos, triangulated from, fused."""

import json
import shutil

import numpy as np
import pytest
from places import LOBBY
from views import lobby_cameras

import warprrf as wr
from warprrf.geometry.photos.config import ReconstructionConfig, RefineConfig
from warprrf.geometry.photos.posed import sfm
from warprrf.geometry.photos.posed.measured_depth import range_maps
from warprrf.geometry.photos.posed.photo_files import find_photos, mask_beside, mask_name
from warprrf.geometry.photos.posed.poses import KnownPoses, find_depth, match_photos, read_depth, read_poses
from warprrf.geometry.pipeline import _known_poses
from warprrf.geometry.scans import SurfaceConfig

image = pytest.importorskip("PIL.Image")
pycolmap = pytest.importorskip("pycolmap")

NAMES = [f"view_{k:03d}.jpg" for k in range(8)]
PHOTOS = [LOBBY / "photos" / name for name in NAMES]
LENS = {"fl_x": 395.0, "fl_y": 395.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
QUICK = ReconstructionConfig(
    max_features=1500, sweep=False, gaussians=2000, completion=False,
    refine=RefineConfig(iterations=2, downscale=8, max_gaussians=2000), surface=SurfaceConfig(min_component_faces=50),
)  # fmt: skip


def camera_to_world(camera, opengl=True):
    return (np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1] if opengl else [1] * 4)).tolist()


def frames(names=NAMES, folder="images/"):
    cameras = lobby_cameras(names).items()
    return [{"file_path": folder + name, "transform_matrix": camera_to_world(c)} for name, c in cameras]


def written(folder, **values):
    path = folder / "transforms.json"
    path.write_text(json.dumps({**LENS, "frames": frames(), **values}))
    return path


@pytest.fixture(scope="module")
def truth(lobby_scene):
    return lobby_scene.mesh


def test_transforms_hold_the_cameras_that_were_written(tmp_path):
    found = read_poses(written(tmp_path))
    for name, camera in lobby_cameras(NAMES).items():
        own = found[f"images/{name}"]
        np.testing.assert_allclose(own.world_to_camera, camera.world_to_camera, atol=1e-9)
        lens = own.of_size(name, 640, 480)
        assert (lens.model, lens.fx, lens.cy, lens.straight) == ("PINHOLE", 395.0, 240.0, True)
        half = own.of_size(name, 320, 240)  # photos made smaller
        assert (half.width, half.fx, half.cx, half.cy) == (320, 197.5, 160.0, 120.0)
        with pytest.raises(ValueError, match="stored with 480 x 640 pixels, its lens is given for 640 x 480"):
            own.of_size(name, 480, 640)


@pytest.mark.parametrize(
    "values, model, coefficients",
    [
        ({"k1": 0.1, "p2": 0.01}, "OPENCV", (0.1, 0.0, 0.0, 0.01)),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "OPENCV", (0.1, 0.0, 0.0, 0.0)),  # as nerfstudio has it
        ({"k1": 0.1, "k3": 0.02}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.02, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.01)),
        ({"is_fisheye": True, "k2": 0.1}, "OPENCV_FISHEYE", (0, 0.1, 0, 0)),
        ({"w": 640.0, "h": 480.0}, "PINHOLE", ()),
    ],
)
def test_lenses_are_read_for_all_frames_or_each(tmp_path, values, model, coefficients):
    each = [frame | {"fl_x": 300.0 + k, "fl_y": 301.0} for k, frame in enumerate(frames())]
    for k, camera in enumerate(read_poses(written(tmp_path, frames=each, **values)).values()):
        lens = camera.of_size("a", 640, 480)
        assert (lens.model, lens.coefficients, lens.fx, lens.fy) == (model, coefficients, 300.0 + k, 301.0)


def test_an_angle_of_view_tells_the_focal_length(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames()}))
    lens = next(iter(read_poses(path).values())).of_size("a", 640, 480)
    assert lens.fx == lens.fy == pytest.approx(320.0) and (lens.cx, lens.cy) == (320.0, 240.0)
    shifted = {"camera_angle_x": np.pi / 2, "cx": 300.0, "k1": 0.1, "frames": frames()}
    path.write_text(json.dumps(shifted | {"w": 640, "h": 480}))
    lens = next(iter(read_poses(path).values())).of_size("a", 320, 240)
    assert lens.fx == lens.fy == pytest.approx(160.0) and (lens.cx, lens.cy) == (150.0, 120.0)
    assert lens.coefficients == (0.1, 0, 0, 0)
    path.write_text(json.dumps(shifted))
    with pytest.raises(ValueError, match="camera_angle_x without w and h tells no distortion, cx and cy"):
        read_poses(path)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"frames": frames()[:1] * 2}, "comes twice"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model"),
        ({"k4": 0.1}, "k4"),
        ({"frames": [frames()[0] | {"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}]}, "rigid"),
        ({"frames": [frames()[0] | {"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}]}, "mirrors"),
        ({"frames": [frames()[0] | {"depth_file_path": "/etc/passwd"}]}, "outside"),
    ],
)
def test_bad_transforms_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=rf"transforms\.json.*{message}"):
        read_poses(written(tmp_path, **change))


def test_frames_are_matched_with_photos_by_as_much_of_their_names_as_it_takes(tmp_path):
    photos = ["a/0001.jpg", "a/0002.jpg", "b/0001.jpg", "b/r_3.png"]
    names = ["./a/0001.jpg", "x/b/0001.jpg", "0002.jpg", "./train/r_3", "a/0009.jpg"]
    with pytest.warns(UserWarning, match="1 of 5 poses have no photo and are left out: a/0009.jpg"):
        found = match_photos(names, photos)
    assert found == {"a/0001.jpg": "./a/0001.jpg", "a/0002.jpg": "0002.jpg", "b/0001.jpg": "x/b/0001.jpg",
                     "b/r_3.png": "./train/r_3"}  # fmt: skip
    with pytest.raises(ValueError, match="both poses of the photo"):
        match_photos(["a/0002.jpg", "0002.jpg"], photos)
    with pytest.raises(ValueError, match="0 of 1 poses have a photo"):
        match_photos(["0001.jpg"], photos)  # which of the two?


@pytest.fixture(scope="module")
def triangulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("triangulated")
    cameras = read_poses(written(folder, frames=frames(NAMES[:6])))
    named = find_photos(PHOTOS[:6])
    known = KnownPoses({photo: cameras[name] for photo, name in match_photos(cameras, named).items()})
    return folder, sfm.structure_from_motion(
        PHOTOS[:6], workspace=folder / "w", config=ReconstructionConfig(max_features=1500), poses=known
    )


def test_points_are_triangulated_from_known_poses_which_stay_as_they_are(triangulated, truth):
    sparse = triangulated[1]
    for name, camera in lobby_cameras(NAMES[:6]).items():
        np.testing.assert_allclose(sparse.cameras[name].world_to_camera, camera.world_to_camera, atol=1e-6)
        assert sparse.cameras[name].fx == 395.0
    assert len(sparse.points) > 100 and sparse.unposed == ()
    far = sparse.track_length > 2
    assert np.median(truth.distance(sparse.points[far])) < 0.02
    assert 0.1 < sparse.colors.mean() < 0.9


def test_points_of_a_colmap_model_are_taken_as_they_are(triangulated, tmp_path):
    folder, sparse = triangulated
    cameras = sfm.read_known(folder / "w" / "sfm" / "model")
    known = KnownPoses(cameras, folder / "w" / "sfm" / "model", {name: name for name in cameras})
    stages = []
    again = sfm.structure_from_motion(
        PHOTOS[:5], workspace=tmp_path, poses=KnownPoses({n: cameras[n] for n in NAMES[:5]}, known.model, known.names),
        progress=lambda stage, done, total: stages.append(stage),
    )  # fmt: skip
    assert list(again.cameras) == NAMES[:5] and set(stages) == {"undistorting"}
    assert 0.3 * len(sparse.points) < len(again.points) <= len(sparse.points)
    pose, before = (found.cameras[NAMES[1]].world_to_camera for found in (again, sparse))
    np.testing.assert_allclose(pose, before, atol=1e-9)


def test_a_mask_that_came_later_is_noticed_where_poses_and_points_are_known(triangulated, tmp_path):
    model = triangulated[0] / "w" / "sfm" / "model"
    cameras = {name: camera for name, camera in sfm.read_known(model).items() if name in NAMES[:3]}
    for name in cameras:
        shutil.copy(LOBBY / "photos" / name, tmp_path)
    known = KnownPoses(cameras, model, {name: name for name in cameras})
    mask = np.full((480, 640), 255, np.uint8)
    mask[:20] = 0
    for k in range(2):
        found = sfm.structure_from_motion(tmp_path, workspace=tmp_path / "w", poses=known)
        assert (mask_beside(found.photos[NAMES[0]]) is not None) == (k == 1)
        image.fromarray(mask).save(mask_name(tmp_path / NAMES[0]))


def test_photos_of_one_camera_of_a_colmap_model_may_differ_in_size(tmp_path):
    names = [f"{k}.jpg" for k in range(1, 4)]
    rows = "".join(f"{k} 1 0 0 0 {k} 0 0 1 {name}\n100 100 1\n" for k, name in enumerate(names, 1))
    for name, text in (
        ("cameras", "1 PINHOLE 640 480 400 400 320 240\n"), ("images", rows),
        ("points3D", "1 0 0 5 10 20 30 0.5 1 0 2 0 3 0\n"),
    ):  # fmt: skip
        (tmp_path / f"{name}.txt").write_text(text)
    cameras = sfm.read_known(tmp_path)
    known = KnownPoses(cameras, tmp_path, {name: name for name in names})
    for widths in ((320, 320, 320), (640, 320, 640)):
        wanted = {n: cameras[n].of_size(n, w, w * 3 // 4) for n, w in zip(names, widths, strict=True)}
        model = sfm._known_model(known, wanted)
        found = {name: (lens.width, lens.fx) for name, lens in sfm.lenses_of(model).items()}
        assert found == {name: (w, 400 * w / 640) for name, w in zip(names, widths, strict=True)}
        assert model.num_points3D() == (widths[0] == 320)  # others are triangulated anew


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory, truth):
    """Eight photos of the lobby with poses and the true depth, in a folder as of 7-Scenes."""
    folder = tmp_path_factory.mktemp("rgbd")
    np.savetxt(folder / "camera-intrinsics.txt", [[395.0, 0, 320], [0, 395, 240], [0, 0, 1]])
    for k, (name, camera) in enumerate(lobby_cameras(NAMES).items()):
        (folder / f"frame-{k:06d}.color.jpg").write_bytes((LOBBY / "photos" / name).read_bytes())
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", camera_to_world(camera, opengl=False))
        view = camera.resized(320, 240)
        towards = view.directions().reshape(-1, 3)
        hit = truth.cast(view.position, towards)
        depth = np.where(hit.valid, hit.t * (towards @ camera.rotation[2]), 0.0).reshape(240, 320)
        image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / f"frame-{k:06d}.depth.png")
    return folder


def test_measured_depth_is_fused_within_a_centimetre(rgbd, truth, tmp_path):
    rec = wr.reconstruct(rgbd, workspace=tmp_path, poses=rgbd, up="z", config=QUICK)
    assert rec.metric and rec.unposed == () and rec.guessed == ()
    true = list(lobby_cameras(NAMES).values())
    for own, camera in zip(rec.cameras.values(), true, strict=True):
        np.testing.assert_allclose(own.world_to_camera, camera.world_to_camera, atol=1e-6)
    centres = rec.mesh.triangles.mean(axis=1)
    distance = truth.distance(centres)
    assert rec.mesh.areas.sum() > 30 and np.average(distance < 0.03, weights=rec.mesh.areas) > 0.9
    assert np.median(np.repeat(distance, np.ceil(100 * rec.mesh.areas).astype(int))) < 0.01


def test_measured_depth_counts_where_its_photo_is_not_masked(rgbd, tmp_path):
    folder = tmp_path / "photos"
    shutil.copytree(rgbd, folder)
    mask = np.full((480, 640), 255, np.uint8)
    mask[:, :160] = 0
    image.fromarray(mask).save(folder / "frame-000001.color.mask.png")
    known = _known_poses(folder, None, find_photos(folder), True)
    sparse = sfm.structure_from_motion(folder, workspace=tmp_path / "w", poses=known)
    maps = {name: measured for name, (_, measured) in range_maps(sparse, known.depth).items()}
    masked, whole = maps["frame-000001.color.jpg"], maps["frame-000002.color.jpg"]
    assert masked.shape == (240, 320) and not masked[:, :79].any()
    assert (masked[:, 81:] > 0).mean() > 0.9 and (whole[:, :79] > 0).mean() > 0.9


def test_depth_that_contradicts_the_poses_is_refused(rgbd, tmp_path):
    with pytest.raises(ValueError, match="depth and poses differ in unit"):
        wr.reconstruct(rgbd, workspace=tmp_path, poses=rgbd, scale=3.0, up="z", config=QUICK)


def test_depth_of_frames_that_tell_it_is_found(rgbd, tmp_path):
    found = find_depth(rgbd, ["frame-000001.color.jpg", "frame-000002.jpg", "a/frame-000003.png"])
    assert list(found.values()) == [rgbd / f"frame-00000{k}.depth.png" for k in (1, 2, 3)]
    with pytest.raises(ValueError, match="holds depth of 0 photos"):
        find_depth(rgbd, ["a.jpg", "b.jpg", "c.jpg"])
    (tmp_path / "d.png").write_bytes((rgbd / "frame-000001.depth.png").read_bytes())
    one = [frames()[0] | {"depth_file_path": "d.png", "depth_unit_scale_factor": 0.002}]
    depth = next(iter(read_poses(written(tmp_path, frames=one)).values())).depth
    once = next(c.depth for n, c in read_poses(rgbd).items() if n.startswith("frame-000001"))
    np.testing.assert_allclose(read_depth(depth), 2 * read_depth(once), rtol=1e-6)


def test_a_depth_image_is_of_one_photo(tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.png").touch()
    assert len(find_depth(tmp_path, ["a/0.jpg", "a/1.jpg", "b/2.jpg"])) == 3
    with pytest.raises(ValueError, match="depth: .* one image for several photos of one file name: a/0.jpg"):
        find_depth(tmp_path, ["a/0.jpg", "a/1.jpg", "b/0.jpg"])


def test_frames_where_tracking_was_lost_are_left_out_and_bad_ones_named(rgbd, tmp_path):
    for file in [*rgbd.glob("*.pose.txt")][:3]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with pytest.raises(FileNotFoundError, match="camera-intrinsics.txt does not exist"):
        read_poses(tmp_path)
    (tmp_path / "camera-intrinsics.txt").write_bytes((rgbd / "camera-intrinsics.txt").read_bytes())
    (tmp_path / "lost.pose.txt").write_text("-inf -inf -inf -inf\n" * 4)
    assert len(read_poses(tmp_path)) == 3
    (tmp_path / "bent.pose.txt").write_text("1 2 3 4\n" * 4)
    with pytest.raises(ValueError, match="bent.pose.txt"):
        read_poses(tmp_path)
    colour = [frame | {"depth_file_path": "colour.png"} for frame in frames()[:1]]
    image.new("RGB", (4, 3)).save(tmp_path / "colour.png")
    with pytest.raises(ValueError, match="colour.png does not read as a depth image: .* of mode RGB"):
        read_depth(next(iter(read_poses(written(tmp_path, frames=colour)).values())).depth)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"depth": "."}, "depth: got .* without poses"),
        ({"scale": 1.0}, "goes with poses"),
        ({"scale": 2}, "goes with poses"),
        ({"up": "z", "poses": ".", "known_positions": {}}, "got both"),
    ],
)
def test_arguments_that_need_one_another_are_named(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        wr.reconstruct(PHOTOS, workspace=tmp_path, **options)
