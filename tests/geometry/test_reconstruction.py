"""From photos to geometry: initial Gaussians, resumed runs, files."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from fuzz.answers import differs, leaves
from PIL import Image
from places import LOBBY
from radio_scenes import box_mesh
from scipy.spatial.transform import Rotation
from told import check_told
from views import flat, lobby_cameras, look

import warprrf as wr
from warprrf import tensor_files
from warprrf.geometry import pipeline as from_photos
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.config import ReconstructionConfig, RefineConfig
from warprrf.geometry.photos.gaussians.cells import plane_mesh, seen_cells, visible_from
from warprrf.geometry.pipeline import reconstruct
from warprrf.geometry.planar_patches import planar_patches
from warprrf.geometry.planes import PlaneConfig, plane_axes
from warprrf.geometry.reconstruction import Reconstruction, of_patches, to_patches
from warprrf.geometry.scans import SurfaceConfig
from warprrf.geometry.splats.gaussians import discs_on_mesh

pytest.importorskip("open3d")
pytest.importorskip("pycolmap")

VIEWS = [f"view_{k:03d}.jpg" for k in range(10)]
SMALL = ReconstructionConfig(
    max_features=1500,
    planes=PlaneConfig(cell_m=0.2),
    gaussians=2500,
    refine=RefineConfig(iterations=12, downscale=4, max_gaussians=3000, checkpoint_every=4),
    surface=SurfaceConfig(depth_pixels=20_000, voxel_m=0.1),
    completion=False,
)


def surveyed(names=VIEWS):
    return {name: camera.position for name, camera in lobby_cameras(names).items()}


def test_cells_that_no_photo_sees_get_no_discs():
    planes = [flat([1, 0, 0], [0, -2, 0], [0, 2, 4])[1]]
    camera = look([2.0, 1.5, 2.0], [0, 1.5, 2.0])
    seen = seen_cells(planes, [camera, camera])
    uv, depth = camera.project(seen[0].cells())
    assert 0 < len(uv) < planes[0].occupied.sum()
    assert ((uv >= 0) & (uv < (64, 48))).all()
    behind = [look([-2.0, 1.5, 2.0], [0, 1.5, 2.0])] * 2
    assert not visible_from(None, planes[0].cells(), planes[0].normal, behind).any()
    hidden = seen_cells(planes, behind)
    assert hidden[0].occupied.sum() == 0 and plane_mesh(hidden) is None
    nearer = flat([1, 0, 0], [1, -2, 0], [1, 2, 4])[1]
    front, back = seen_cells([nearer, *planes], [look([3.0, 0, 2.0], [0, 0, 2.0])] * 2)
    assert front.occupied.any() and not back.occupied.any()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Makes a reconstruction of photos of the lobby at half their size; returns it with what its progress told."""
    folder = tmp_path_factory.mktemp("photos")
    for name in VIEWS:
        photo = Image.open(LOBBY / "photos" / name)
        photo.resize((photo.width // 2, photo.height // 2), Image.Resampling.LANCZOS).save(
            folder / name, quality=95
        )

    def make(workspace, photos=VIEWS, **options):
        told = []
        given = {"known_positions": surveyed(), "held_out": VIEWS[4:5], "config": SMALL, "device": "cpu"}
        photos = [folder / n for n in photos]
        rec = reconstruct(
            photos, workspace=workspace, progress=lambda *row: told.append(row), **given | options
        )
        return rec, told

    return make


def steps(told):
    return {stage for stage, _, _ in told}


@pytest.fixture(scope="module")
def whole(made, tmp_path_factory):
    workspace = tmp_path_factory.mktemp("whole")
    rec, told = made(workspace)
    posed = ["features", "matching", "mapping", "undistorting"]
    check_told(told, [*posed, "planes", "refine", "depth", "stereo", "segments", "surface"])
    return workspace, rec


def test_ten_photos_become_gaussians_mesh_and_patches(whole, lobby_scene):
    rec = whole[1]
    assert len(rec.gaussians) > 1000 and len(rec.cameras) == 10 and rec.held_out == (VIEWS[4],)
    assert rec.scale_rms_m < 0.03 and rec.metric
    # Against the true room: the floor is at z = 0, and it is the largest thing that these photos see.
    level = rec.patches.normal[:, 2] > 0.99
    assert np.abs(rec.patches.offset[level]).min() < 0.02
    centres = rec.mesh.triangles.mean(axis=1)
    assert np.median(lobby_scene.mesh.distance(centres)) < 0.03
    assert rec.patches.area.sum() > 0.5 * rec.mesh.areas.sum()
    for k in range(5):
        corners = rec.mesh.triangles[rec.patches.faces(k)]
        assert np.median(np.abs(corners @ rec.patches.normal[k] - rec.patches.offset[k])) < 1e-6


def test_a_killed_run_continues_to_the_same_result(whole, made, monkeypatch):
    workspace, rec = whole
    for name in ("refined", "depth", "surface"):
        (workspace / f"{name}.safetensors").unlink()

    def killed(*args, least_views, **kwargs):
        raise KeyboardInterrupt(least_views)

    # Of few photos one depth map is enough to keep what it saw.
    for few, least in ((9, "1"), (8, "2")):
        with monkeypatch.context() as patch:
            patch.setattr(from_photos, "FEW_MAPS", few)
            patch.setattr(from_photos, "fuse_maps", killed)
            with pytest.raises(KeyboardInterrupt, match=least):
                made(workspace)
    (workspace / "surface.safetensors.partial").write_bytes(b"half")
    resumed, told = made(workspace)
    assert steps(told) == {"surface"}  # depth maps were kept
    np.testing.assert_array_equal(resumed.gaussians.means, rec.gaussians.means)
    np.testing.assert_array_equal(resumed.mesh.vertices, rec.mesh.vertices)


def test_a_workspace_that_was_moved_is_continued_though_its_folder_is_named(
    whole, made, tmp_path, monkeypatch
):
    moved, posed = tmp_path / "moved", from_photos.sfm.structure_from_motion
    shutil.copytree(whole[0], moved)

    def in_pieces(photos, *, workspace, **options):
        said = f"poses={workspace}/sfm/model-2 gives that"
        return replace(
            posed(photos, workspace=workspace, **options), causes={"far.jpg": said}, guessed=(said,)
        )

    monkeypatch.setattr(from_photos.sfm, "structure_from_motion", in_pieces)
    rec, told = made(moved)
    assert steps(told) == set() and rec.causes == {"far.jpg": f"poses={moved}/sfm/model-2 gives that"}


def test_a_changed_setting_is_not_served_from_the_old_run(whole, made, lobby_scene):
    completed, told = made(whole[0], config=replace(SMALL, completion=True))
    assert steps(told) == {"surface"}
    centres = completed.mesh.triangles.mean(axis=1)
    assert np.median(lobby_scene.mesh.distance(centres)) < 0.03
    assert completed.patches.area.sum() > 0.5 * completed.mesh.areas.sum()
    wider = replace(SMALL, surface=replace(SMALL.surface, patch_distance_m=0.07))
    assert steps(made(whole[0], config=wider)[1]) == {"depth", "stereo", "segments", "surface"}
    less = replace(SMALL, stereo=False)
    other, told = made(whole[0], held_out=VIEWS[4:6], iterations=2, config=less)
    assert steps(told) == {"planes", "refine", "depth", "surface"}  # the photos' poses stay
    assert other.held_out == tuple(VIEWS[4:6])


def test_bad_names_and_surveys_are_refused_before_any_work(made, tmp_path):
    for told, wrong in (
        ("known_positions: got 2, expected at least 3", {"known_positions": surveyed(VIEWS[:2])}),
        (
            r"known_positions\['view_000\.jpg'\]: got shape \(2,\)",
            {"known_positions": surveyed(VIEWS[:3]) | {"view_000.jpg": [1.0, 2.0]}},
        ),
        (r"held_out: no such photo: nobody\.jpg", {"held_out": ["nobody.jpg"]}),
        ("got both", {"scale": (VIEWS[0], VIEWS[1], 1.0)}),
    ):
        with pytest.raises(ValueError, match=told):
            made(tmp_path, VIEWS[:4], **{"held_out": (), "known_positions": surveyed(VIEWS[:3])} | wrong)
        assert not any(tmp_path.iterdir())


def test_a_saved_reconstruction_is_the_same(whole, tmp_path):
    rec = whole[1]
    rec.save(tmp_path)
    read = Reconstruction.load(tmp_path)
    assert list(read.cameras) == list(rec.cameras)
    for part in ("gaussians", "mesh", "patches", "cameras", "scale_rms_m"):
        kept = leaves(getattr(rec, part))
        assert kept and not differs(leaves(getattr(read, part)), kept), part


def test_a_file_of_an_older_format_says_what_to_do(tmp_path):
    old = {"means": np.zeros((1, 3))}
    tensor_files.write(tmp_path / "reconstruction.safetensors", old, {"format": 1}, None)
    with pytest.raises(ValueError, match="format 1, this version reads 2; make it again"):
        Reconstruction.load(tmp_path)


ROOM = wr.Mesh(*box_mesh([0, 0, 0], [4, 3, 2.5], inward=True))


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    """A file of splats of a bare room."""
    file = tmp_path_factory.mktemp("splats") / "g.ply"
    discs_on_mesh(ROOM, 600).save_ply(file)
    return file


def test_patches_of_older_files_are_read():
    """They hold which faces of patches repeat no other, in place of which ones these repeat."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [3, 3, 3], [3, 3, 4]], float)
    mesh = wr.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [0, 4, 5]]))
    patches = planar_patches(mesh)
    arrays = of_patches(patches)
    del arrays["patch_first"]
    found = to_patches(arrays | {"patch_once": patches.once & (patches.face_patch >= 0)})
    np.testing.assert_array_equal(found.first, [0, 1, 0, 3])
    np.testing.assert_array_equal(found.face_patch, patches.face_patch)


def test_splats_with_a_mesh_take_it_as_it_is(splats):
    rec = Reconstruction.from_files(splats, mesh=ROOM)
    assert len(rec.mesh.faces) == 12 and len(rec.patches) == 6
    assert rec.patches.area.sum() == pytest.approx(2 * (12 + 10 + 7.5))


def test_splats_alone_say_what_they_lack_when_it_is_needed(splats):
    rec = Reconstruction.from_files(splats)
    assert not rec.has_mesh and rec.patches is None
    with pytest.raises(ValueError, match="has no mesh.*mesh=, or colmap="):
        _ = rec.mesh
    with pytest.raises(FileNotFoundError):
        Reconstruction.from_files(splats.with_name("none.ply"))


@pytest.fixture
def seen():
    """Gaussians of every degree on a box, its patches, and three cameras."""
    rng = np.random.default_rng(0)
    box = planar_patches(Mesh(*box_mesh([0, 0, 0], [2, 3, 1])))
    splats = discs_on_mesh(box.mesh, 300)
    sh = 0.2 * rng.standard_normal((len(splats), 16, 3))
    splats = replace(splats, sh=sh, scales=[0.09, 0.05, 0.02] + 0 * splats.scales)
    cameras = {f"{k}.jpg": look([4 + k, 3 - 2 * k, 1 + k * k], [1, 1.5, 0.5]) for k in range(3)}
    guessed = ("scale: nobody measured one", "floor: the lowest points", "plain")
    return Reconstruction(splats, box.mesh, cameras, patches=box, guessed=guessed)


def test_a_moved_reconstruction_looks_the_same_from_its_moved_cameras(seen):
    turn = Rotation.from_rotvec([0.3, -0.8, 1.9]).as_matrix()
    moved = seen.transformed(scale=2.5, rotation=turn, shift=[3.0, -1.0, 0.5])
    for name, camera in seen.cameras.items():
        before, after = wr.render(seen.gaussians, camera), wr.render(moved.gaussians, moved.cameras[name])
        assert before.alpha.max() > 0.9
        np.testing.assert_allclose(after.features, before.features, atol=2e-4)
        np.testing.assert_allclose(after.depth, 2.5 * before.depth, rtol=1e-4)
    for normal, offset, patch in zip(moved.patches.normal, moved.patches.offset, range(6), strict=True):
        corners = moved.mesh.triangles[moved.patches.face_patch == patch]
        np.testing.assert_allclose(corners @ normal, offset, atol=1e-9)
    np.testing.assert_allclose(moved.patches.area.sum(), moved.mesh.areas.sum())
    with pytest.raises(ValueError, match=r"rotation.*mirrored"):
        seen.transformed(rotation=np.diag([1, 1, -1]))


def test_surveyed_cameras_bring_a_reconstruction_into_their_frame(seen):
    turn = Rotation.from_rotvec([0.0, 0.0, 1.1]).as_matrix()
    known = {name: camera.position for name, camera in seen.cameras.items()}
    back = seen.transformed(scale=0.4, rotation=turn, shift=[9, 9, 9]).aligned(known)
    np.testing.assert_allclose(back.mesh.vertices, seen.mesh.vertices, atol=1e-9)
    assert back.metric and back.scale_rms_m < 1e-9 and back.guessed == ("plain",)
    with pytest.raises(ValueError, match=r"known_positions: got 2"):
        seen.aligned({"0.jpg": (0, 0, 0), "1.jpg": (1, 0, 0)})
    with pytest.raises(ValueError, match=r"known_positions: got 0\.jpg twice"):
        seen.aligned(known | {"day/0.jpg": (0, 0, 0)})


def test_plane_axes_are_a_right_handed_frame():
    normals = np.vstack([np.eye(3), -np.eye(3), [[0.6, 0, 0.8]]])
    for normal, (first, second) in zip(normals, plane_axes(normals), strict=True):
        np.testing.assert_array_equal(plane_axes(normal), [first, second])
        np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-12)
        assert first[2] == 0 or abs(normal[2]) > 0.99
