"""How real photos go in: bent by a lens, turned, of several cameras, masked, larger than needed."""

import numpy as np
import pytest
from bent_photos import bent
from places import LOBBY
from views import lobby_cameras

from warprrf.geometry.photos import sfm
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.photo_files import (
    cameras_of,
    check_photos,
    find_photos,
    photo_facts,
    read_mask,
    read_photo,
)
from warprrf.geometry.photos.sparse import align_to_known
from warprrf.geometry.photos.undistort import Lens, lenses_in_use, pinhole_of, write_undistorted

Image = pytest.importorskip("PIL.Image")
pytest.importorskip("pycolmap")

FOCAL, K1 = 395.0, -0.12
BENT, TURNED = [f"view_{k:03d}.jpg" for k in range(10)], "view_009.jpg"
ORIENTATION, MAKER, MODEL = 0x0112, 0x010F, 0x0110


def save(path, pixels, orientation=1, camera=None):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if camera:
        exif[MAKER], exif[MODEL] = camera
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(path, quality=95, subsampling=0, exif=exif)
    return path


def smooth(width, height):
    """A picture without edges, that resampling hardly changes."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    waves = [np.sin(2 * np.pi * (x * a / width + y * b / height)) for a, b in ((1, 2), (2, -1), (0.5, 1.5))]
    return (127.5 + 100 * np.stack(waves, axis=-1)).round().astype(np.uint8)


@pytest.fixture(scope="module")
def through_a_lens(tmp_path_factory):
    """Ten photos of the lobby through a lens; one is stored on its side, one has a mask over its left third."""
    folder = tmp_path_factory.mktemp("bent")
    for name in BENT:
        pixels = bent(np.asarray(Image.open(LOBBY / "photos" / name)), FOCAL, K1)
        turned = name == TURNED
        save(folder / name, np.rot90(pixels) if turned else pixels, 6 if turned else 1, ("Maker", "Camera"))
    height, width = pixels.shape[:2]
    mask = np.full((height, width), 255, np.uint8)
    mask[:, : width // 3] = 0
    Image.fromarray(mask).save(folder / "view_005.mask.png")
    work = tmp_path_factory.mktemp("work")
    found = sfm.structure_from_motion(folder, workspace=work, config=ReconstructionConfig(max_features=1500))
    return folder, work, found


def test_the_lens_is_found(through_a_lens):
    lens = through_a_lens[2].lenses[BENT[0]]
    assert lens.model == "SIMPLE_RADIAL"
    assert lens.coefficients[0] == pytest.approx(K1, rel=0.02)
    assert lens.fx == pytest.approx(FOCAL, rel=0.01)


def test_poses_through_a_lens_agree_with_the_truth(through_a_lens):
    sparse, true = through_a_lens[2], lobby_cameras(BENT)
    assert set(sparse.cameras) == set(BENT)
    aligned = align_to_known(sparse, {n: camera.position for n, camera in true.items()})
    assert aligned.scale_rms_m < 0.03  # as without a lens
    for name, camera in true.items():  # upright all, also the one stored on its side
        error = aligned.cameras[name].rotation @ camera.rotation.T
        assert np.degrees(np.arccos((np.trace(error) - 1) / 2)) < 1.0


def test_undistorted_photos_show_what_the_straight_ones_do(through_a_lens):
    sparse = through_a_lens[2]
    for name in (BENT[3], TURNED):
        camera = sparse.cameras[name]
        found, straight = read_photo(sparse.photos[name]), read_photo(LOBBY / "photos" / name)
        assert found.shape == (camera.height, camera.width, 3)
        x, y = (
            np.round((np.arange(n) + 0.5 - c) / f * FOCAL + half - 0.5).astype(int)
            for n, c, f, half in (
                (camera.width, camera.cx, camera.fx, 320), (camera.height, camera.cy, camera.fy, 240)
            )
        )  # fmt: skip
        other = straight[np.clip(y, 0, 479)][:, np.clip(x, 0, 639)]
        apart = np.abs(found - other).mean()
        assert apart < 0.03 < np.abs(found - np.roll(other, 8, axis=1)).mean()


@pytest.mark.parametrize(
    "model, bends",
    [
        ("PINHOLE", ()), ("SIMPLE_RADIAL", (-0.1,)), ("RADIAL", (-0.1, 0.02)), ("OPENCV", (-0.1, 0.02, 0.002, -0.003)),
        ("OPENCV_FISHEYE", (0.02, -0.01, 0.0, 0.0)), ("FULL_OPENCV", (-0.1, 0.02, 1e-3, 0.0, 0.01, 0.02, 0.0, 0.0)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_pixel_shows_the_direction_that_its_camera_says(model, bends, orientation, tmp_path):
    """The undistorted photo of a picture that is a function of direction is this function of its camera's directions."""
    import pycolmap

    focal = [110.0] if model in ("SIMPLE_RADIAL", "RADIAL") else [110.0, 112.0]
    lens = Lens(model, 160, 120, focal[0], focal[-1], 78.0, 61.0, bends)
    camera = pycolmap.Camera(model=model, width=160, height=120, params=[*focal, 78.0, 61.0, *bends])
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    direction = np.array(camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))[:, :2]

    def shown(a, b):
        return np.stack(
            [0.5 + 0.4 * np.sin(3 * a), 0.5 + 0.4 * np.cos(3 * b), 0.5 + 0.4 * np.sin(2 * a + b)], axis=-1
        )

    stored = (255 * shown(*direction.T)).reshape(120, 160, 3)
    save(tmp_path / "a.png", stored.round(), orientation)
    facts = photo_facts(tmp_path / "a.png")
    assert facts.turns == {1: 0, 6: 1, 3: 2, 8: 3}[orientation]
    for most in (10**6, 9000):
        write_undistorted(tmp_path / "a.png", tmp_path / "out" / "a.png", lens, most)
        flat = pinhole_of(lens, np.eye(4), facts.turns, most)
        assert flat.width * flat.height <= 1.02 * most
        found = read_photo(tmp_path / "out" / "a.png")
        assert found.shape == (flat.height, flat.width, 3)
        d = flat.directions()  # the world has the axes of the photo as stored
        expected = shown(d[..., 0] / d[..., 2], d[..., 1] / d[..., 2])
        assert np.abs(found - expected)[2:-2, 2:-2].max() < 0.02


def test_photos_stored_mirrored_are_refused(tmp_path):
    save(tmp_path / "a.png", smooth(40, 30), 2)
    with pytest.raises(ValueError, match=r"a\.png has EXIF orientation 2, expected 1, 3, 6 or 8"):
        photo_facts(tmp_path / "a.png")


def test_photos_are_reduced_and_never_enlarged():
    lens = Lens("SIMPLE_PINHOLE", 4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
    small = pinhole_of(lens, np.eye(4), 0, 1_000_000)
    assert 0.998e6 < small.width * small.height <= 1e6
    assert small.fx / small.width == pytest.approx(0.75) and small.cx / small.width == pytest.approx(0.5)
    assert pinhole_of(lens, np.eye(4), 0, 10**8).width == 4000


def test_photos_of_one_camera_share_a_lens_wherever_they_lie(tmp_path):
    pixels = smooth(40, 30)
    for folder in ("hall", "lounge"):
        (tmp_path / folder).mkdir()
        save(tmp_path / folder / "a.jpg", pixels, camera=("Maker", "Phone"))
        save(tmp_path / folder / "b.jpg", np.rot90(pixels), camera=("Maker", "Phone"))
        save(tmp_path / folder / "c.jpg", pixels)
    found = cameras_of(find_photos(tmp_path))
    assert found == [
        ["hall/a.jpg", "lounge/a.jpg"],
        ["hall/b.jpg", "lounge/b.jpg"],
        ["hall/c.jpg"],
        ["lounge/c.jpg"],
    ]


def test_photos_of_two_sizes_are_posed_together(tmp_path):
    names = BENT[:8]
    for k, name in enumerate(names):
        photo = Image.open(LOBBY / "photos" / name)
        (photo if k % 2 else photo.resize((512, 384))).save(tmp_path / name, quality=95)
    sparse = sfm.structure_from_motion(
        tmp_path,
        workspace=tmp_path / "work",
        config=ReconstructionConfig(max_features=1500, lens="SIMPLE_PINHOLE"),
    )
    assert set(sparse.cameras) == set(names)
    assert list(find_photos(tmp_path)) == names  # not those in the workspace beside them
    large, small = sparse.lenses[names[1]], sparse.lenses[names[0]]
    assert len(lenses_in_use(sparse.lenses)) == 2
    assert large.fx == pytest.approx(FOCAL, rel=0.03) and small.fx == pytest.approx(0.8 * FOCAL, rel=0.03)


def test_features_are_not_found_where_a_mask_is_black(through_a_lens):
    import pycolmap

    found = {}
    with pycolmap.Database.open(str(through_a_lens[1] / "sfm" / "features.db")) as database:
        for image in database.read_all_images():
            found[image.name] = database.read_keypoints(image.image_id)[:, 0]
    width = through_a_lens[2].lenses[BENT[0]].width
    assert found["view_005.jpg"].min() > width / 3 - 1
    assert found["view_004.jpg"].min() < width / 6


def test_masks_are_bent_with_their_photos(through_a_lens):
    sparse = through_a_lens[2]
    ignored = read_mask(sparse.photos["view_005.jpg"])
    camera = sparse.cameras["view_005.jpg"]
    assert ignored.shape == (camera.height, camera.width)
    seen = sparse.lenses["view_005.jpg"]
    edge = (seen.width // 3 - seen.cx) / seen.fx  # at mid height; below and above it bends outwards
    for _ in range(20):
        edge -= (edge * (1 + K1 * edge**2) - (seen.width // 3 - seen.cx) / seen.fx) / (1 + 3 * K1 * edge**2)
    column = round(camera.fx * edge + camera.cx)
    middle = ignored[camera.height // 2]
    assert middle[: column - 2].all() and not middle[column + 3 :].any()
    assert read_mask(sparse.photos["view_004.jpg"]) is None


def test_masks_that_fit_no_photo_are_named(tmp_path):
    for name in ("a.png", "b.png", "c.png"):
        save(tmp_path / name, smooth(40, 30))
    save(tmp_path / "a.mask.png", smooth(20, 30))
    assert list(find_photos(tmp_path)) == ["a.png", "b.png", "c.png"]
    with pytest.raises(ValueError, match=r"a\.png .*its mask is 20 x 30, expected 40 x 30"):
        check_photos(find_photos(tmp_path))
    save(tmp_path / "d.mask.png", smooth(40, 30))
    with pytest.raises(ValueError, match=r"1 masks are of no photo: d\.mask\.png"):
        find_photos(tmp_path)


def test_photos_in_their_own_workspace_are_not_overwritten(through_a_lens):
    work = through_a_lens[1]
    with pytest.raises(ValueError, match="workspace: .* holds the photos and would be overwritten"):
        sfm.structure_from_motion(work / "sfm" / "photos", workspace=work)


def test_a_mask_that_is_gone_is_forgotten(tmp_path):
    photos, work = tmp_path / "photos", tmp_path / "work"
    photos.mkdir()
    for name in BENT[:6]:
        Image.open(LOBBY / "photos" / name).save(photos / name, quality=95)
    mask = photos / "view_001.mask.png"
    grey = np.full((480, 640), 255, np.uint8)
    grey[:20] = 0
    Image.fromarray(grey).save(mask)
    config = ReconstructionConfig(max_features=1000, lens="SIMPLE_PINHOLE")
    found = sfm.structure_from_motion(photos, workspace=work, config=config)
    np.testing.assert_array_equal(read_mask(found.photos["view_001.jpg"]), grey == 0)
    mask.unlink()
    again = sfm.structure_from_motion(photos, workspace=work, config=config)
    assert read_mask(again.photos["view_001.jpg"]) is None
