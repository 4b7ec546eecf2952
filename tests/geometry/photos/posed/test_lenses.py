"""How real photos go in: bent by a lens, turned, of several cameras, masked, larger than needed."""

import numpy as np
import pytest
from places import LOBBY
from scipy.ndimage import map_coordinates
from views import lobby_cameras

from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed import photo_files, sfm
from warprrf.geometry.photos.posed.sparse import align_to_known
from warprrf.geometry.photos.posed.undistort import Lens, lenses_in_use, pinhole_of, write_undistorted

Image = pytest.importorskip("PIL.Image")
pycolmap = pytest.importorskip("pycolmap")

FOCAL, K1 = 395.0, -0.12
BENT, TURNED = [f"view_{k:03d}.jpg" for k in range(10)], "view_009.jpg"
GREY = np.full((30, 40, 3), 128)
ORIENTATION, MAKER, MODEL = 0x0112, 0x010F, 0x0110


def save(path, pixels, orientation=1, camera=None):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if camera:
        exif[MAKER], exif[MODEL] = camera
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(path, quality=95, subsampling=0, exif=exif)
    return path


def directions(model, width, height, params):
    """Slopes (x, y) of what each pixel of a lens of COLMAP shows, shape ``(height, width, 2)``."""
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    found = lens.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    return np.array(found)[:, :2].reshape(height, width, 2)


def bent(photo):
    """``photo`` of a pinhole camera as a lens with ``K1`` shows it: the largest centred rectangle that the photo fills."""
    size = np.array(photo.shape[:2])
    height, width = (size * (1 + K1 * (size**2).sum() / (2 * FOCAL) ** 2)).astype(int)
    seen = directions("SIMPLE_RADIAL", width, height, [FOCAL, width / 2, height / 2, K1])
    at = np.moveaxis(seen[..., ::-1] * FOCAL + size / 2 - 0.5, -1, 0)
    channels = [map_coordinates(photo[..., c].astype(float), at, order=3, mode="nearest") for c in range(3)]
    return np.stack(channels, axis=-1).clip(0, 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def through_a_lens(tmp_path_factory):
    """Ten photos of the lobby through a lens; one is stored on its side, one has a mask over its left third."""
    folder = tmp_path_factory.mktemp("bent")
    for name in BENT:
        pixels = bent(np.asarray(Image.open(LOBBY / "photos" / name)))
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
    focal = [110.0] if model in ("SIMPLE_RADIAL", "RADIAL") else [110.0, 112.0]
    lens = Lens(model, 160, 120, focal[0], focal[-1], 78.0, 61.0, bends)
    direction = directions(model, 160, 120, [*focal, 78.0, 61.0, *bends])

    def shown(a, b):
        return 0.5 + 0.4 * np.stack([np.sin(3 * a), np.cos(3 * b), np.sin(2 * a + b)], axis=-1)

    save(tmp_path / "a.png", (255 * shown(*np.moveaxis(direction, -1, 0))).round(), orientation)
    facts = photo_files.photo_facts(tmp_path / "a.png")
    assert facts.turns == {1: 0, 6: 1, 3: 2, 8: 3}[orientation]
    for most in (10**6, 9000):
        write_undistorted(tmp_path / "a.png", tmp_path / "out" / "a.png", lens, most)
        flat = pinhole_of(lens, np.eye(4), facts.turns, most)
        assert flat.width * flat.height <= 1.02 * most
        found = photo_files.read_photo(tmp_path / "out" / "a.png")
        assert found.shape == (flat.height, flat.width, 3)
        d = flat.directions()  # the world has the axes of the photo as stored
        expected = shown(d[..., 0] / d[..., 2], d[..., 1] / d[..., 2])
        assert np.abs(found - expected)[2:-2, 2:-2].max() < 0.02


def test_photos_stored_mirrored_are_refused(tmp_path):
    save(tmp_path / "a.png", GREY, 2)
    with pytest.raises(ValueError, match=r"a\.png has EXIF orientation 2, expected 1, 3, 6 or 8"):
        photo_files.photo_facts(tmp_path / "a.png")


def test_photos_are_reduced_and_never_enlarged():
    lens = Lens("SIMPLE_PINHOLE", 4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
    small = pinhole_of(lens, np.eye(4), 0, 1_000_000)
    assert 0.998e6 < small.width * small.height <= 1e6
    assert small.fx / small.width == pytest.approx(0.75) and small.cx / small.width == pytest.approx(0.5)
    assert pinhole_of(lens, np.eye(4), 0, 10**8).width == 4000


def test_photos_of_one_camera_share_a_lens_wherever_they_lie(tmp_path):
    for folder in ("hall", "lounge"):
        (tmp_path / folder).mkdir()
        save(tmp_path / folder / "a.jpg", GREY, camera=("Maker", "Phone"))
        save(tmp_path / folder / "b.jpg", np.rot90(GREY), camera=("Maker", "Phone"))
        save(tmp_path / folder / "c.jpg", GREY)
    shared = [[f"hall/{name}.jpg", f"lounge/{name}.jpg"] for name in "ab"]
    found = photo_files.cameras_of(photo_files.find_photos(tmp_path))
    assert found == [*shared, ["hall/c.jpg"], ["lounge/c.jpg"]]


def test_features_are_not_found_where_a_mask_is_black(through_a_lens):
    found = {}
    with pycolmap.Database.open(str(through_a_lens[1] / "sfm" / "features.db")) as database:
        for image in database.read_all_images():
            found[image.name] = database.read_keypoints(image.image_id)[:, 0]
    width = through_a_lens[2].lenses[BENT[0]].width
    assert found["view_005.jpg"].min() > width / 3 - 1
    assert found["view_004.jpg"].min() < width / 6


def test_masks_are_bent_with_their_photos(through_a_lens):
    sparse = through_a_lens[2]
    ignored = photo_files.read_mask(sparse.photos["view_005.jpg"])
    camera = sparse.cameras["view_005.jpg"]
    assert ignored.shape == (camera.height, camera.width)
    seen = sparse.lenses["view_005.jpg"]
    rays = directions(seen.model, seen.width, seen.height, [FOCAL, seen.cx, seen.cy, K1])
    edge = rays[seen.height // 2, seen.width // 3, 0]  # below and above mid height it bends outwards
    column = round(camera.fx * edge + camera.cx)
    middle = ignored[camera.height // 2]
    assert middle[: column - 2].all() and not middle[column + 3 :].any()
    assert photo_files.read_mask(sparse.photos["view_004.jpg"]) is None


def test_masks_that_fit_no_photo_are_named(tmp_path):
    for name in ("a.png", "b.png", "c.png"):
        save(tmp_path / name, GREY)
    save(tmp_path / "a.mask.png", GREY[:, :20])
    assert list(photo_files.find_photos(tmp_path)) == ["a.png", "b.png", "c.png"]
    with pytest.raises(ValueError, match=r"a\.png .*its mask is 20 x 30, expected 40 x 30"):
        photo_files.check_photos(photo_files.find_photos(tmp_path))
    save(tmp_path / "d.mask.png", GREY)
    with pytest.raises(ValueError, match=r"1 masks are of no photo: d\.mask\.png"):
        photo_files.find_photos(tmp_path)


@pytest.mark.parametrize("name", ["a.png", "a.mask.png"])
def test_transparent_pixels_are_refused_opaque_ones_read(name, tmp_path):
    layers = np.full((30, 40, 4), 255, np.uint8)
    for file in ("a.png", name):
        Image.fromarray(layers).save(tmp_path / file)
    photo_files.check_photos({"a.png": tmp_path / "a.png"})
    layers[:5, :, 3] = 0  # as where a program took the background away
    Image.fromarray(layers).save(tmp_path / name)
    with pytest.raises(
        ValueError, match=rf"{name} does not read as an image: some of its pixels are transparent"
    ):
        photo_files.check_photos({"a.png": tmp_path / "a.png"})


@pytest.mark.parametrize(("keep", "told"), [(1, "is 1 where"), (254, "is 254 where"), (255, ""), (0, "")])
def test_masks_without_white_are_refused_unless_all_is_ignored(keep, told, tmp_path):
    mask = np.zeros_like(GREY)
    mask[:, :20] = keep
    save(tmp_path / "a.png", GREY)
    save(tmp_path / "a.mask.png", mask)
    lens = Lens("PINHOLE", 40, 30, 30, 30, 20, 15)

    def check():
        photo_files.check_photos({"a.png": tmp_path / "a.png"})

    def write():
        write_undistorted(tmp_path / "a.png", tmp_path / "out" / "a.png", lens, 10**6)

    for use in (check, write):
        if told:
            with pytest.raises(ValueError, match=rf"a\.mask\.png {told} it is brightest, expected 255"):
                use()
        else:
            use()


def test_photos_in_their_own_workspace_are_not_overwritten(through_a_lens):
    work = through_a_lens[1]
    with pytest.raises(ValueError, match="workspace: .* holds the photos and would be overwritten"):
        sfm.structure_from_motion(work / "sfm" / "photos", workspace=work)


def test_photos_of_two_sizes_are_posed_together_and_a_mask_that_is_gone_is_forgotten(tmp_path):
    names = BENT[:8]
    for k, name in enumerate(names):
        photo = Image.open(LOBBY / "photos" / name)
        (photo if k % 2 else photo.resize((512, 384))).save(tmp_path / name, quality=95)
    mask = tmp_path / "view_001.mask.png"
    grey = np.full((480, 640), 255, np.uint8)
    grey[:20] = 0
    Image.fromarray(grey).save(mask)
    config = ReconstructionConfig(max_features=1500, lens="SIMPLE_PINHOLE")
    found = sfm.structure_from_motion(tmp_path, workspace=tmp_path / "work", config=config)
    # And none of the workspace beside them.
    assert list(photo_files.find_photos(tmp_path)) == names == list(found.cameras)
    large, small = found.lenses[names[1]], found.lenses[names[0]]
    assert len(lenses_in_use(found.lenses)) == 2
    assert large.fx == pytest.approx(FOCAL, rel=0.03) and small.fx == pytest.approx(0.8 * FOCAL, rel=0.03)
    np.testing.assert_array_equal(photo_files.read_mask(found.photos["view_001.jpg"]), grey == 0)
    mask.unlink()
    again = sfm.structure_from_motion(tmp_path, workspace=tmp_path / "work", config=config)
    assert photo_files.read_mask(again.photos["view_001.jpg"]) is None
