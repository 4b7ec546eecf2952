"""Cameras for geometry tests."""

import json

import numpy as np
from places import LOBBY

from warprrf.geometry.splats.camera import Camera


def look(position, target, width=64, height=48, f=40.0, off=(0.0, 0.0)):
    """A pinhole camera at ``position`` towards ``target``, z up; ``off`` moves the principal point [pixels]."""
    ahead = np.asarray(target, float) - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(ahead, right), ahead]
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera.pinhole(
        width, height, fx=f, fy=f, cx=width / 2 + off[0], cy=height / 2 + off[1], world_to_camera=pose
    )


def lobby_cameras(names):
    """The lobby's true cameras by photo."""
    held = json.loads((LOBBY / "poses_true.json").read_text())
    lens = {n: held[n] for n in ("width", "height", "fx", "fy", "cx", "cy")}
    return {n: Camera.pinhole(**lens, world_to_camera=held["views"][n]["world_to_camera"]) for n in names}
