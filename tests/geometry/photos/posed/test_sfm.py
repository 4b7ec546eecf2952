"""Structure from motion on real image files, and the similarity to metres."""

import resource
import shutil
import signal
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from places import LOBBY
from scipy.spatial.transform import Rotation
from views import lobby_cameras

from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed import sfm
from warprrf.geometry.photos.posed.photo_files import find_photos, match_names, read_photo
from warprrf.geometry.photos.posed.sparse import SparseModel, align_to_known, fit_similarity, posed_in_words
from warprrf.geometry.splats.camera import Camera
from warprrf.steps import Attempt

pycolmap = pytest.importorskip("pycolmap")
Image = pytest.importorskip("PIL.Image")

VIEWS = [f"view_{k:03d}.jpg" for k in range(10)]
PHOTOS = [LOBBY / "photos" / name for name in VIEWS]


def model(rng, names="abcdefgh"):
    cameras = {}
    for name in names:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(None, rng).as_matrix(), rng.standard_normal(3)
        cameras[f"{name}.jpg"] = Camera.pinhole(
            640, 480, fx=400, fy=410, cx=320, cy=240, world_to_camera=pose
        )
    points = rng.standard_normal((50, 3))
    return SparseModel(
        cameras, points, np.full((50, 3), 0.5), np.full(50, 0.3), np.full(50, 2), np.tile([0, 1], 50)
    )


def made(workspace, photos):
    """The model of photos, and the steps that were taken."""
    stages, config = set(), ReconstructionConfig(max_features=1500)
    found = sfm.structure_from_motion(
        photos, workspace=workspace, config=config, progress=lambda stage, done, total: stages.add(stage)
    )
    return found, stages


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    workspace = tmp_path_factory.mktemp("sfm")
    return workspace, made(workspace, PHOTOS)[0]


@pytest.mark.parametrize("side", [1, -1])
def test_the_similarity_of_noisy_points_is_that_of_least_squares_and_no_mirror_image(side):
    rng = np.random.default_rng(3)
    source = rng.standard_normal((8, 3))
    target = 2.5 * source @ Rotation.random(None, rng).as_matrix().T + rng.standard_normal(3)
    target += 0.1 * rng.standard_normal((8, 3))
    source *= [1, 1, side]
    scale, turn, shift = fit_similarity(source, target)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    best = Rotation.align_vectors(b, a)[0].as_matrix()
    np.testing.assert_allclose(turn, best, atol=1e-9)
    assert scale == pytest.approx((b * (a @ best.T)).sum() / (a**2).sum())
    np.testing.assert_allclose(shift, (target - scale * source @ best.T).mean(axis=0), atol=1e-9)


def test_alignment_reports_the_rms_that_is_left():
    sparse = model(np.random.default_rng(2))
    off = 0.02 * np.random.default_rng(5).standard_normal((8, 3))
    known = {n: c.position + e for (n, c), e in zip(sparse.cameras.items(), off, strict=True)}
    aligned = align_to_known(sparse, known)
    left = [np.linalg.norm(aligned.cameras[n].position - p) for n, p in known.items()]
    assert aligned.scale_rms_m == pytest.approx(np.sqrt(np.mean(np.square(left))))
    assert 0.005 < aligned.scale_rms_m < np.sqrt((off**2).sum(axis=1).mean())


def test_bad_surveyed_positions_are_refused():
    sparse = model(np.random.default_rng(4))
    known = {n: c.position for n, c in sparse.cameras.items()}
    with pytest.raises(ValueError, match="at least 3"):
        align_to_known(sparse, dict(list(known.items())[:2]))
    with pytest.raises(ValueError, match=r"no such photo: z\.jpg"):
        align_to_known(sparse, known | {"z.jpg": [0, 0, 0]})
    with pytest.raises(ValueError, match="one line"):
        align_to_known(sparse, {"a.jpg": [0, 0, 0], "b.jpg": [1, 1, 1], "c.jpg": [2, 2, 2]})
    lost = replace(sparse, cameras=dict(list(sparse.cameras.items())[:2]), unposed=tuple(known)[2:])
    with pytest.raises(ValueError, match=r"2 of 8 photos were posed, but only 2 of the surveyed.*c\.jpg"):
        align_to_known(lost, known)


def test_what_was_posed_is_said_in_words():
    whole = model(np.random.default_rng(5))
    assert posed_in_words(whole) == ""
    cameras = {f"{n}.jpg": whole.cameras[f"{n}.jpg"] for n in "abcd"}
    lost = replace(whole, cameras=cameras, unposed=("e.jpg", "f.jpg", "g.jpg", "h.jpg"))
    assert posed_in_words(lost) == "photos: 4 of 8 posed; without a pose: e.jpg, f.jpg, g.jpg, h.jpg"
    apart = replace(lost, pieces=(tuple(cameras), ("f.jpg", "g.jpg", "h.jpg")))
    assert posed_in_words(apart) == (
        "photos: 4 of 8 posed in the largest of 2 pieces that too few features join: "
        "add photos between d.jpg and f.jpg; without a pose: e.jpg"
    )


def test_the_focal_length_is_known_before_any_photo_has_a_pose(posed, tmp_path):
    matches = shutil.copy(posed[0] / "sfm" / "matches.db", tmp_path)

    def focal():
        with pycolmap.Database.open(str(matches)) as database:
            (camera,) = database.read_all_cameras()
        return camera.mean_focal_length()

    assert focal() == pytest.approx(1.2 * 640)
    sfm._calibrate(matches, tmp_path / "scratch.db", 0)
    assert focal() == pytest.approx(395, rel=0.05)  # one in a hundred of the whole walk


def test_models_that_share_a_photo_become_one_and_others_stay_apart(posed, tmp_path):
    folder, options = posed[0] / "sfm", pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)

    def part(names):
        found = pycolmap.Reconstruction(str(folder / "model"))
        camera = found.cameras[1]  # as while mapping, before the lens was found to be straight
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [*camera.params, 0.0]
        for image in list(found.images.values()):
            if image.name not in names:
                found.deregister_frame(image.frame_id)
        return found

    for shared, joined in ((1, True), (0, False)):
        first, second = part(VIEWS[:6]), part(VIEWS[6 - shared :])
        second.transform(pycolmap.Sim3d(2.5, pycolmap.Rotation3d([0.1, 0.2, 0.3]), [3.0, -1.0, 2.0]))
        source = folder / "matches.db", PHOTOS[0].parent, options
        both = sfm._joined(first, second, source, tmp_path)
        assert (both is not None) == joined
        if both is not None:
            centres = {i.name: i.projection_center() for i in both.images.values()}
            known = np.array([posed[1].cameras[name].position for name in VIEWS])
            scale, rotation, shift = fit_similarity([centres[name] for name in VIEWS], known)
            moved = scale * np.array([centres[name] for name in VIEWS]) @ rotation.T + shift
            assert np.abs(moved - known).max() < 0.01 * np.ptp(known, axis=0).max()


def test_pieces_that_share_no_view_are_named_and_kept(tmp_path):
    photos = [LOBBY / "photos" / f"view_{k:03d}.jpg" for k in (*range(4, 10), *range(60, 64))]
    with pytest.warns(UserWarning, match="of 10 posed in the largest of 2 pieces"):
        found = made(tmp_path, photos)[0]
    assert found.guessed[0].startswith("photos: ") and len(found.pieces) == 2
    assert set(found.pieces[1]) <= set(found.unposed) and "model-2" in found.causes[found.pieces[1][0]]
    assert set(sfm.read_known(tmp_path / "sfm" / "model-2")) == set(found.pieces[1])


def test_poses_of_rendered_photos_agree_with_the_truth_and_straight_photos_are_taken_as_they_are(posed):
    sparse = posed[1]
    truth = {name: camera.position for name, camera in lobby_cameras(VIEWS).items()}
    assert set(sparse.cameras) == set(VIEWS) and sparse.unposed == ()
    aligned = align_to_known(sparse, truth)
    assert aligned.scale_rms_m < 0.03  # ten neighbouring views; the whole walk does better
    assert sparse.cameras[VIEWS[0]].fx == pytest.approx(395, rel=0.03)  # estimated from the images alone
    assert sparse.lenses[VIEWS[0]].model == "SIMPLE_PINHOLE" and sparse.lenses[VIEWS[0]].straight
    for photo in PHOTOS:
        assert sparse.photos[photo.name].read_bytes() == photo.read_bytes()


def test_comparing_promising_pairs_alone_poses_every_photo(tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "MAX_EXHAUSTIVE_PAIRS", 1)
    monkeypatch.setattr(sfm, "COARSE_NEIGHBOURS", 4)
    assert set(made(tmp_path, PHOTOS)[0].cameras) == set(VIEWS)


def features_of(folder, names):
    """A database of features that all photos share, up to noise."""
    rng = np.random.default_rng(0)
    features = rng.exponential(1.0, (128, 128))
    with pycolmap.Database.open(str(folder / "features.db")) as database:
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
        camera_id = database.write_camera(camera)
        for name in names:
            image = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            seen = np.maximum(features + rng.normal(0, 0.25, features.shape), 0)
            seen = np.minimum(512 * seen / np.linalg.norm(seen, axis=1, keepdims=True), 255).astype(np.uint8)
            order, sift = rng.permutation(128), pycolmap.FeatureExtractorType.SIFT
            database.write_keypoints(image, rng.uniform(1, 400, (128, 4)).astype(np.float32))
            database.write_descriptors(image, pycolmap.FeatureDescriptors(type=sift, data=seen[order]))
    (folder / "scratch").mkdir()
    return Attempt(lambda *_: None, folder / "scratch")


def test_matches_repeat_themselves_to_the_bit(tmp_path, monkeypatch):
    # Small photos in many pairs: on two threads or more about every second run gives two pairs, or four, other matches, as
    # OpenBLAS lends one buffer twice. That may miss four runs, so the number of threads is looked at too.
    names = [f"{k:03d}.jpg" for k in range(90)]
    attempt = features_of(tmp_path, names)
    monkeypatch.setattr(sfm, "MAX_EXHAUSTIVE_PAIRS", 90 * 90)
    match, threads = pycolmap.match_image_pairs, set()

    def spied(*args, **options):
        threads.add(options["matching_options"].num_threads)
        options["matching_options"].skip_geometric_verification = True  # which takes longer
        match(*args, **options)

    monkeypatch.setattr(pycolmap, "match_image_pairs", spied)
    found = []
    for _ in range(4):
        sfm._match(tmp_path, names, 0, attempt)
        with closing(sqlite3.connect(tmp_path / "matches.db")) as database:
            found.append(
                database.execute("SELECT pair_id, rows, data FROM matches ORDER BY pair_id").fetchall()
            )
    assert len(found[0]) == 90 * 89 // 2 and min(rows for _, rows, _ in found[0]) > 64
    assert all(again == found[0] for again in found[1:])
    assert threads == {1}


def test_photos_whose_names_have_blanks_are_matched(tmp_path, monkeypatch):
    names = ["a room/photo 1.jpg", "a room/photo 2.jpg", "#3.jpg"]
    match = pycolmap.match_image_pairs

    def quick(*args, **options):
        options["matching_options"].skip_geometric_verification = True
        match(*args, **options)

    monkeypatch.setattr(pycolmap, "match_image_pairs", quick)
    sfm._match(tmp_path, names, 0, features_of(tmp_path, names))
    with pycolmap.Database.open(str(tmp_path / "matches.db")) as database:
        assert {i.name for i in database.read_all_images()} == set(names)
        assert database.num_matched_image_pairs() == 3


def test_a_point_projects_to_where_its_photos_saw_it(posed):
    sparse = posed[1]
    cameras = list(sparse.cameras.values())
    k = np.repeat(np.arange(len(sparse.points)), sparse.track_length)
    inside = 0
    for c, camera in enumerate(cameras):
        uv, depth = camera.project(sparse.points[k[sparse.track_camera == c]])
        assert (depth > 0).all()
        inside += ((uv > -2) & (uv < (camera.width + 2, camera.height + 2))).all(axis=1).sum()
    assert inside == len(sparse.track_camera)
    assert (sparse.track_length >= 2).all() and sparse.track_start[-1] == len(sparse.track_camera)


def test_finished_work_of_the_same_photos_is_reused_and_repeats_itself(posed, tmp_path):
    workspace, first = posed
    again, stages = made(workspace, PHOTOS)
    assert stages == set()
    np.testing.assert_array_equal(again.points, first.points)
    # Stopped while mapping, with rubbish left behind: the same model comes out of the matches.
    shutil.copytree(workspace, tmp_path / "w", symlinks=True)
    shutil.rmtree(tmp_path / "w" / "sfm" / "model")
    scratch = tmp_path / "w" / "sfm" / ".steps" / "model"
    (scratch / "mapping" / "0").mkdir(parents=True)
    (scratch / "matches.db").write_bytes(b"half written")
    resumed, stages = made(tmp_path / "w", PHOTOS)
    assert stages == {"mapping"}
    np.testing.assert_array_equal(resumed.points, first.points)
    # And of other photos nothing is taken.
    sparse, stages = made(tmp_path / "w", PHOTOS[:6])
    assert stages == {"features", "matching", "mapping", "undistorting"}
    assert set(sparse.cameras) | set(sparse.unposed) == set(VIEWS[:6])


def test_why_a_photo_has_no_pose_is_said(posed):
    workspace, sparse = posed
    cameras = {name: camera for name, camera in sparse.cameras.items() if name != VIEWS[4]}
    lost = replace(sparse, cameras=cameras, unposed=(VIEWS[4], "black.jpg"))
    causes = sfm._causes(workspace / "sfm" / "matches.db", lost)
    assert list(causes) == [VIEWS[4], "black.jpg"] and causes["black.jpg"].startswith("shows 0 features")
    assert any(f"matches {name} in" in causes[VIEWS[4]] for name in cameras)


def test_colmap_models_are_read_in_both_formats(posed, tmp_path):
    source = pycolmap.Reconstruction(str(posed[0] / "sfm" / "model"))
    (tmp_path / "text").mkdir()
    source.write_text(str(tmp_path / "text"))
    for folder in (posed[0] / "sfm" / "model", tmp_path / "text"):
        read = sfm.read_colmap(folder)
        assert list(read.cameras) == VIEWS
        for name, camera in posed[1].cameras.items():
            np.testing.assert_allclose(read.cameras[name].world_to_camera, camera.world_to_camera, atol=1e-12)
    points = tmp_path / "text" / "points3D.txt"
    whole = points.read_text()
    row = next(line for line in whole.splitlines() if not line.startswith("#"))
    points.write_text(whole.replace(row, " ".join(row.split()[:8])))  # a point that no photo shows
    assert len(sfm.read_colmap(tmp_path / "text").points) == len(posed[1].points) - 1


def test_a_model_that_a_full_disk_cuts_short_is_an_error_and_no_finished_step(posed, tmp_path):
    model = pycolmap.Reconstruction(str(posed[0] / "sfm" / "model"))
    handler, limit = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limit[1]))
        with pytest.raises(OSError, match=r"images\.bin was not written whole in .*: is the disk full"):
            sfm._keep_known(tmp_path, {}, model, False, 0, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert not any(tmp_path.iterdir())


def test_names_of_a_colmap_text_model_may_have_blanks(tmp_path):
    names = ["a room/photo 1.jpg", "a room/photo 2.jpg", "c.jpg"]
    images = [f"{k} 1 0 0 0 {k} 0 0 1 {name}\n{'1 2 -1' * (k < 2)}\n" for k, name in enumerate(names, 1)]
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text("# Image list\n" + "".join(images))
    (tmp_path / "points3D.txt").write_text("")
    found = sfm.read_colmap(tmp_path).cameras
    assert {name: -camera.position[0] for name, camera in found.items()} == dict(
        zip(names, (1, 2, 3), strict=True)
    )


@pytest.mark.parametrize("at", [16, 43])  # x, and the reprojection error
def test_colmap_points_that_are_nan_are_refused(at, posed, tmp_path):
    folder = shutil.copytree(posed[0] / "sfm" / "model", tmp_path / "model")
    data = bytearray((folder / "points3D.bin").read_bytes())
    data[at : at + 8] = np.float64(np.nan).tobytes()
    (folder / "points3D.bin").write_bytes(data)
    with pytest.raises(ValueError, match=r"model holds points, or errors of theirs, that are NaN"):
        sfm.read_colmap(folder)


def test_hidden_files_are_no_photos(tmp_path):
    for name in ("a.jpg", "b.png", "c.JPG", ".d.123.partial.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert list(find_photos(tmp_path)) == ["a.jpg", "b.png", "c.JPG"]


def test_photos_that_unfold_to_too_many_pixels_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 640 * 480 // 3)
    with pytest.raises(ValueError, match="3 of 3 files do not read as images: .*decompression bomb"):
        sfm.structure_from_motion(PHOTOS[:3], workspace=tmp_path)
    with pytest.raises(ValueError, match="does not read as an image: .*decompression bomb"):
        read_photo(PHOTOS[0])


def test_photos_without_anything_in_common_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    for least, told in ((255, "3 of 3 photos show fewer than 8 features"), (0, "too few matches")):
        photos = [tmp_path / f"{least}_{k}.png" for k in range(3)]
        for path in photos:
            blocks = np.kron(rng.integers(least, 256, (15, 20, 3)), np.ones((8, 8, 1)))
            Image.fromarray(blocks.astype(np.uint8)).save(path)
        with pytest.raises(ValueError, match=rf"{told}.*{least}_0\.png"):
            sfm.structure_from_motion(photos, workspace=tmp_path / "w")


def test_short_names_serve_where_they_are_unique():
    names = ["left/a.jpg", "left/b.jpg", "right/b.jpg"]
    assert match_names("held_out", ["a.jpg", "right/b.jpg"], names) == ["left/a.jpg", "right/b.jpg"]
    with pytest.raises(ValueError, match=r"held_out: several photos have the file name of b\.jpg"):
        match_names("held_out", ["b.jpg"], names)
