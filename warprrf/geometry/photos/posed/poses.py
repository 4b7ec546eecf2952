"""Lenses and poses of photos that are known already, as other programs write them.

- ``transforms.json`` of nerfstudio and instant-ngp, which exports of Polycam, Record3D and ARKit are turned into: OpenGL
  axes (x right, y up, z back), camera to world, intrinsics for all frames or each, with or without distortion;
- a folder of RGB-D frames as of the 7-Scenes data set: ``NAME.pose.txt`` (4 x 4, camera to world, OpenCV axes) beside
  ``NAME.color.jpg`` and ``NAME.depth.png``, and one ``camera-intrinsics.txt`` (3 x 3).

COLMAP models are read by :func:`warprrf.geometry.photos.posed.sfm.read_colmap`. Lengths are the file's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_count, check_number, check_positive, check_type, some_of, warn
from warprrf.files import read_json
from warprrf.geometry.photos.posed.photo_files import MIN_PHOTOS, opened
from warprrf.geometry.photos.posed.undistort import Lens
from warprrf.tensor_files import named as naming

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # to x right, y down, z forward
POSE_FILE, COLOUR_FILE, DEPTH_FILE = ".pose.txt", ".color", ".depth.png"
MILLIMETRE = 1e-3


@dataclass(frozen=True)
class DepthFile:
    """An image of the depth along the optical axis, in the frame of a photo as stored.

    Attributes:
        path: PNG of whole numbers, 0 where unknown.
        unit_m: of its numbers [m].
        turns: quarter turns clockwise that bring the photo upright.
    """

    path: Path
    unit_m: float = MILLIMETRE
    turns: int = 0


@dataclass(frozen=True)
class KnownCamera:
    """Lens and pose of a photo.

    Attributes:
        model: COLMAP's name of the lens model.
        size: width and height that the lens is meant for [pixels]; zeros: the photo's own.
        lens: fx, fy, cx, cy [pixels] and the model's coefficients; empty where ``angle`` tells the focal length.
        angle: horizontal field of view [rad], or 0.
        world_to_camera: OpenCV axes, lengths as in the file, shape ``(4, 4)``.
        depth: None where it is not known.
    """

    model: str
    size: tuple[int, int]
    lens: tuple[float, ...]
    angle: float
    world_to_camera: np.ndarray
    depth: DepthFile | None = None

    def of_size(self, name: str, width: int, height: int) -> Lens:
        """The lens of the photo ``name``, which may have fewer or more pixels than the lens is meant for."""
        own = self.size if all(self.size) else (width, height)
        if abs(width / own[0] / (height / own[1]) - 1) > 0.01:
            raise ValueError(
                f"poses: {name} is stored with {width} x {height} pixels, its lens is given for {own[0]} x {own[1]}; expected "
                "the photos that the poses were made with, or all of them made smaller alike"
            )
        focal = own[0] / 2 / np.tan(self.angle / 2) if self.angle else 0.0
        fx, fy, cx, cy, *bends = self.lens or (focal, focal, own[0] / 2, own[1] / 2)
        return Lens(self.model, *own, fx, fy, cx, cy, tuple(bends)).resized(width, height)


def read_poses(path: Path) -> dict[str, KnownCamera]:
    """Cameras by photo, named as the source names them: a JSON file, or a folder of frames.

    Raises:
        FileNotFoundError, ValueError: if nothing of that kind is there, or a file is damaged, incomplete or refuses sense;
            the file and the frame are named.
    """
    if path.is_dir():
        return _read_frames(path)
    if path.suffix.lower() != ".json":
        raise ValueError(
            f"poses: got {path}, expected a transforms.json, the folder of a COLMAP model, or a folder of "
            f"NAME{POSE_FILE} files"
        )
    if not path.is_file():
        raise FileNotFoundError(f"poses: {path} does not exist")
    return _read_transforms(path)


@dataclass(frozen=True)
class KnownPoses:
    """Poses of photos, which structure from motion then need not find.

    Attributes:
        cameras: by photo.
        model: folder of the COLMAP model that they come from, or None.
        names: of the photos in that model, by photo.
        depth: by photo; without any, points are triangulated.
    """

    cameras: dict[str, KnownCamera]
    model: Path | None = None
    names: dict[str, str] = field(default_factory=dict)
    depth: dict[str, DepthFile] = field(default_factory=dict)

    def unposed(self, photos: Mapping[str, Path]) -> tuple[str, ...]:
        """Which of ``photos`` have no pose and are no depth images."""
        depth = {file.path.resolve() for file in self.depth.values()}
        rest = {n: p for n, p in photos.items() if n not in self.cameras and p.resolve() not in depth}
        return tuple(n for n, p in rest.items() if not p.name.lower().endswith(DEPTH_FILE))


def match_photos(cameras: Iterable[str], photos: Iterable[str], *, every: bool = True) -> dict[str, str]:
    """Which of ``cameras`` is that of a photo, by photo name in the order of ``photos``; warns of cameras without a photo if
    ``every`` one should have one.

    A camera's photo has its name, or else alone ends as it does, or alone has its file name, with or without a suffix.
    """
    cameras, photos = list(cameras), list(photos)
    tails: dict[str, list[str]] = {}
    for photo in photos:
        whole = PurePosixPath(photo)
        for part in (whole, whole.with_suffix("")):
            for k in range(len(part.parts)):
                tails.setdefault("/".join(part.parts[k:]), []).append(photo)
    found: dict[str, str] = {}
    missing = []
    for camera in cameras:
        parts = [p for p in PurePosixPath(camera.replace("\\", "/")).parts if p not in (".", "/")]
        for k in range(len(parts)):
            hits = set(tails.get("/".join(parts[k:]), ()))
            if len(hits) == 1:
                photo = hits.pop()
                if photo in found:
                    raise ValueError(
                        f"poses: {found[photo]} and {camera} are both poses of the photo {photo}"
                    )
                found[photo] = camera
                break
        else:
            missing.append(camera)
    if len(found) < MIN_PHOTOS:
        raise ValueError(
            f"poses: {len(found)} of {len(cameras)} poses have a photo, expected at least {MIN_PHOTOS}; poses are "
            f"named like {some_of(cameras, 2)}, photos like {some_of(photos, 2)}"
        )
    if missing and every:
        warn(
            f"poses: {len(missing)} of {len(cameras)} poses have no photo and are left out: {some_of(missing)}"
        )
    return {photo: found[photo] for photo in photos if photo in found}


def read_depth(file: DepthFile) -> np.ndarray:
    """Depth along the optical axis [m], 0 where unknown, shape ``(H, W)`` float32."""
    with opened(file.path, "depth", "a depth image") as picture:
        if picture.mode not in ("I;16", "I;16B", "I"):
            raise ValueError(f"got an image of mode {picture.mode}, expected grey of 16 bits")
        raw = np.asarray(picture, dtype=np.int64)
    unknown = (raw <= 0) | (raw >= 65535)  # 7-Scenes marks them by the largest number
    return np.where(unknown, 0.0, raw * file.unit_m).astype(np.float32)


def find_depth(folder: Path, photos: Iterable[str]) -> dict[str, Path]:
    """Depth images of ``photos`` in a folder: ``NAME.depth.png`` or ``NAME.png`` beside ``NAME.color.jpg`` or ``NAME.jpg``."""
    if not folder.is_dir():
        raise ValueError(
            f"depth: {folder} is not a folder; expected one of PNG files named as the photos are"
        )
    files = {p.name.removesuffix(".png").removesuffix(".depth"): p for p in sorted(folder.glob("*.png"))}
    stems = {photo: PurePosixPath(photo).stem.removesuffix(COLOUR_FILE) for photo in photos}
    found = {photo: files[stem] for photo, stem in stems.items() if stem in files}
    if len(set(found.values())) < len(found):
        raise ValueError(
            f"depth: {folder} holds one image for several photos of one file name: {some_of(list(found))}"
        )
    if len(found) < MIN_PHOTOS:
        raise ValueError(
            f"depth: {folder} holds depth of {len(found)} photos, expected at least {MIN_PHOTOS}; it has files like "
            f"{some_of([p.name for p in files.values()], 2)}, photos are named like {some_of(list(stems), 2)}"
        )
    return found


def _read_transforms(path: Path) -> dict[str, KnownCamera]:
    held = read_json(path)
    frames = held.get("frames")
    with naming(path, "expected nerfstudio's or instant-ngp's transforms.json"):
        check_type('"frames"', frames, list)
        cameras: dict[str, KnownCamera] = {}
        for k, frame in enumerate(frames or ()):
            check_type(f"frames[{k}]", frame, dict)
            check_type(f"file_path of frames[{k}]", frame.get("file_path"), str)
            name = frame["file_path"]
            if name in cameras:
                raise ValueError(f"frames[{k}]: {name} comes twice")
            with naming(f"frames[{k}] ({name})", "expected a lens and a pose"):
                cameras[name] = _camera(held | frame, path.parent)
    return cameras


def _camera(values: Mapping[str, Any], folder: Path) -> KnownCamera:
    """A frame of ``transforms.json``, what is said for all frames included."""
    model, bends = _distortion(values)
    size = tuple(check_count(n, _whole(values.get(n, 0)), 0, 2**16) for n in ("w", "h"))
    depth, unit = values.get("depth_file_path", values.get("depth_path")), MILLIMETRE
    for name in ("depth_unit_scale_factor", "integer_depth_scale"):
        if name in values:
            unit = check_positive(name, values[name], "number of metres for each unit")
    angle, lens = 0.0, tuple[float, ...]()
    if "camera_angle_x" in values and "fl_x" not in values:
        angle = check_number("camera_angle_x", values["camera_angle_x"], 1e-3, np.pi - 1e-3)
        if all(size) and model != "OPENCV_FISHEYE":
            values = {**values, "fl_x": size[0] / 2 / np.tan(angle / 2)}
    if "fl_x" in values:
        fx = check_positive("fl_x", values["fl_x"], "focal length in pixels")
        fy = check_positive("fl_y", values.get("fl_y", fx), "focal length in pixels")
        if not all(size) and not {"cx", "cy"} <= values.keys():
            raise ValueError("got neither w and h nor cx and cy, expected the size that fl_x is meant for")
        cx, cy = (check_number(n, values.get(n, s / 2)) for n, s in zip(("cx", "cy"), size, strict=True))
        lens = (fx, fy, cx, cy, *bends)
    elif not angle or bends or {"cx", "cy"} & values.keys():
        raise ValueError(
            "got no fl_x, and camera_angle_x without w and h tells no distortion, cx and cy; expected a focal length"
        )
    pose = OPENGL_AXES @ _inverse(values.get("transform_matrix", ()))
    file = None if depth is None else DepthFile(_inside(folder, depth), unit)
    return KnownCamera(model, (size[0], size[1]), lens, angle, pose, file)


def _distortion(values: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of a lens model, and its coefficients."""
    named = str(values.get("camera_model", "OPENCV")).upper()
    model = "OPENCV_FISHEYE" if values.get("is_fisheye") else named
    if model not in ("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE", "OPENCV", "OPENCV_FISHEYE"):
        raise ValueError(f"camera_model: got {model}, expected OPENCV, OPENCV_FISHEYE or PINHOLE")
    names = "k1", "k2", "k3", "k4", "p1", "p2"
    k1, k2, k3, k4, p1, p2 = (check_number(k, values.get(k, 0.0)) for k in names)
    if model == "OPENCV_FISHEYE":
        return model, (k1, k2, k3, k4)
    if k4:
        raise ValueError(f"k4: got {k4:g}, which OPENCV_FISHEYE alone has; expected 0")
    if not any((k1, k2, k3, p1, p2)):
        return "PINHOLE", ()
    return ("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)) if k3 else ("OPENCV", (k1, k2, p1, p2))


def _whole(value: object) -> object:
    """A float that is whole as an int: instant-ngp writes sizes so."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _inside(folder: Path, name: object) -> Path:
    check_type("depth_file_path", name, str)
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"depth_file_path: {name} lies outside {folder}; expected a path below it")
    if not path.is_file():
        raise FileNotFoundError(f"depth_file_path: {path} does not exist")
    return path


def _inverse(camera_to_world: ArrayLike) -> np.ndarray:
    """World to camera from camera to world, ``(4, 4)`` or its first three rows; rounded rotations are made exact."""
    given = check_array("pose", camera_to_world, (None, 4))
    if len(given) not in (3, 4) or (len(given) == 4 and not np.allclose(given[3], [0, 0, 0, 1], atol=1e-6)):
        raise ValueError(f"pose: got {len(given)} rows, expected 4 of which the last is 0 0 0 1")
    u, size, vt = np.linalg.svd(given[:3, :3])
    # 0.02: most that a rotation may stretch: KinectFusion writes some that are off by 0.005
    if np.abs(size - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise ValueError(
            f"pose: its rotation stretches by {size.min():.3g} to {size.max():.3g} or mirrors, expected a rigid transform"
        )
    pose = np.eye(4)
    pose[:3, :3] = (u @ vt).T
    pose[:3, 3] = -pose[:3, :3] @ given[:3, 3]
    return pose


def _read_frames(folder: Path) -> dict[str, KnownCamera]:
    files = sorted(p for p in folder.iterdir() if p.name.endswith(POSE_FILE))
    if not files:
        raise ValueError(
            f"poses: {folder} holds neither a COLMAP model (cameras, images, points3D) nor NAME{POSE_FILE} files"
        )
    lens = folder / "camera-intrinsics.txt"
    if not lens.is_file():
        raise FileNotFoundError(
            f"poses: {lens} does not exist; expected the 3 x 3 matrix of fx, fy, cx, cy of the colour images there"
        )
    k = _numbers(lens, 3)
    if not (k[0, 0] > 0 and k[1, 1] > 0) or k[2, 2] != 1 or np.abs(k[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > 0:
        raise ValueError(f"poses: {lens}: expected rows fx 0 cx, 0 fy cy, 0 0 1 [pixels]")
    numbers, cameras = (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), {}
    for file in files:
        pose = _numbers(file, 4, finite=False)
        if not np.isfinite(pose).all():
            continue  # where tracking was lost
        stem = file.name.removesuffix(POSE_FILE)
        path = file.with_name(stem + DEPTH_FILE)
        depth = DepthFile(path) if path.is_file() else None
        with naming(file, "expected a 4 x 4 pose, camera to world"):
            cameras[stem + COLOUR_FILE] = KnownCamera("PINHOLE", (0, 0), numbers, 0.0, _inverse(pose), depth)
    return cameras


def _numbers(path: Path, size: int, finite: bool = True) -> np.ndarray:
    # 100_000: bytes of a pose or of intrinsics
    if path.stat().st_size > 100_000:
        raise ValueError(
            f"poses: {path} has {path.stat().st_size} bytes, expected {size} rows of {size} numbers"
        )
    with naming(path, f"expected {size} rows of {size} numbers"):
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        return check_array("rows", np.array(rows, dtype=np.float64), (size, size), finite=finite)
