"""Cameras and flat pieces for geometry tests."""

import json

import numpy as np
from places import LOBBY

from warprrf.geometry.photos.gaussians.cells import occupancy
from warprrf.geometry.planes import Plane, PlaneConfig
from warprrf.geometry.splats.camera import Camera


def look(position, target, width=64, height=48, f=40.0):
    """A pinhole camera at ``position`` towards ``target``, z up."""
    ahead = np.asarray(target, float) - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(ahead, right), ahead]
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera.pinhole(width, height, fx=f, fy=f, cx=width / 2, cy=height / 2, world_to_camera=pose)


def pinhole(width=33, height=33, *, focal=30.0, position=(0.0, 0.0, 0.0)):
    """A pinhole camera that looks along +z, y down; its middle is the axis."""
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(position)
    centre = {"cx": width / 2, "cy": height / 2}
    return Camera.pinhole(width, height, fx=focal, fy=focal, **centre, world_to_camera=pose)


def range_in_box(camera, low, high):
    """Distance along every pixel's ray to the inside of a box that the camera is in, shape ``(height, width)``."""
    d = camera.directions()
    with np.errstate(divide="ignore"):
        return np.where(d > 0, (high - camera.position) / d, (low - camera.position) / d).min(axis=-1)


def lobby_cameras(names):
    """The lobby's true cameras by photo."""
    held = json.loads((LOBBY / "poses_true.json").read_text())
    lens = {n: held[n] for n in ("width", "height", "fx", "fy", "cx", "cy")}
    return {n: Camera.pinhole(**lens, world_to_camera=held["views"][n]["world_to_camera"]) for n in names}


def flat(normal, low, high):
    """Points of a rectangle along the axes from ``low`` to ``high``, 5 cm apart, and their plane, which faces ``normal``."""
    spans = [np.arange(a, b, 0.05) + 0.025 if b > a else [a] for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*spans), axis=-1).reshape(-1, 3)
    plane = Plane(np.asarray(normal, float), float(points[0] @ normal), np.arange(len(points)))
    none = points[:0]
    return points, occupancy([plane], points, none, none, config=PlaneConfig(margin_m=0.0))[0]
