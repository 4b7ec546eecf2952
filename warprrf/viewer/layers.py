"""What stands still in the page: mesh and splats below a cut, cameras with their photos, measured places."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import quaternions_of
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.viewer import pictures
from warprrf.viewer.subject import Subject

THUMBNAIL = 96  # width of a photo at its camera, pixels
MEASURED = (240, 160, 30)
LEARNED_DB = (-30.0, 0.0)  # range of learned shares of power
_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
_OCTAHEDRON_FACES = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
)


def colourings(subject: Subject) -> list[str]:
    """Ways in which the faces of ``subject`` can be coloured, the most natural first."""
    found = []
    if subject.mesh is not None and subject.mesh.face_colours is not None:
        found.append("photo colours")
    if subject.scene is not None and subject.scene.mesh is subject.mesh:
        found.append("scene materials")
    if isinstance(subject.field, BistaticField):
        found += ["learned materials", "scattered share", "mirrored share"]
    return [*found, "plain"]


def face_colours(subject: Subject, kind: str) -> np.ndarray:
    """Colours (F, 3) uint8 of the faces of ``subject``'s mesh, by one of :func:`colourings`."""
    mesh, field = subject.mesh, subject.field
    if mesh is None:
        return np.zeros((0, 3), dtype=np.uint8)
    if kind == "photo colours" and mesh.face_colours is not None:
        seen = np.isfinite(mesh.face_colours).all(axis=1)
        known = np.round(np.nan_to_num(mesh.face_colours) * 255.0)
        return np.where(seen[:, None], known, pictures.GREY).astype(np.uint8)
    if kind == "scene materials" and subject.scene is not None:
        return pictures.named_colours(subject.scene.face_material)
    if kind == "plain" or not isinstance(field, BistaticField):
        return np.tile(np.array([pictures.GREY], dtype=np.uint8), (len(mesh.faces), 1))
    face = field.surface.mesh.closest(
        mesh.triangles.mean(axis=1)
    ).face  # the field's own mesh has more, smaller faces
    group = field.surface.group[face]
    if kind == "learned materials":
        return pictures.named_colours(field.material[group])
    share = (
        field.parameters.scattered_share if kind == "scattered share" else np.exp(field.parameters.log_mirror)
    )
    return pictures.coloured(10.0 * np.log10(np.maximum(share[group], 1e-6)), *LEARNED_DB)


def draw_mesh(server: Any, subject: Subject, kind: str, cut: float) -> None:
    """The mesh's faces whose middle is below ``cut`` [m], coloured by ``kind``."""
    if subject.mesh is None:
        return
    import trimesh

    kept = subject.mesh.triangles.mean(axis=1)[:, 2] <= cut
    corners = subject.mesh.triangles[kept].reshape(-1, 3)
    shown = trimesh.Trimesh(
        corners, np.arange(len(corners)).reshape(-1, 3), process=False,
        vertex_colors=np.repeat(face_colours(subject, kind)[kept], 3, axis=0),
    )  # fmt: skip
    server.scene.add_mesh_trimesh("/mesh", shown)


def draw_splats(server: Any, subject: Subject, cut: float) -> None:
    """The Gaussians below ``cut`` [m]."""
    if subject.gaussians is None:
        return
    arrays = pictures.splats(subject.gaussians)
    kept = arrays["centers"][:, 2] <= cut
    server.scene.add_gaussian_splats("/splats", **{name: array[kept] for name, array in arrays.items()})


def draw_cameras(server: Any, subject: Subject) -> None:
    """Where the photos were taken, each with its photo; hidden until asked for."""
    server.scene.add_frame("/cameras", show_axes=False, visible=False)
    for name, camera in subject.cameras.items():
        to_world = np.linalg.inv(camera.world_to_camera)
        server.scene.add_camera_frustum(
            f"/cameras/{name}", fov=2.0 * float(np.arctan(0.5 * camera.height / camera.fy)),
            aspect=camera.width / camera.height, scale=0.15, image=_thumbnail(subject, name, camera),
            color=(60, 90, 160), wxyz=quaternions_of(to_world[None, :3, :3])[0], position=to_world[:3, 3],
        )  # fmt: skip


def _thumbnail(subject: Subject, name: str, camera: Camera) -> np.ndarray | None:
    if name not in subject.photos or not subject.photos[name].is_file():
        return None
    from PIL import Image

    with Image.open(subject.photos[name]) as photo:
        photo.thumbnail((THUMBNAIL, THUMBNAIL))
        return np.asarray(photo.convert("RGB"))


def draw_measured(
    server: Any, places: np.ndarray, colours: np.ndarray | None, clicked: Callable[[np.ndarray], None]
) -> None:
    """A small octahedron at each of ``places`` (R, 3) [m]; ``clicked`` is called with the one that is clicked."""
    if colours is None:
        colours = np.tile(np.array([MEASURED], dtype=np.uint8), (len(places), 1))
    turns = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(places), 1))
    handle = server.scene.add_batched_meshes_simple(
        "/measured",
        0.07 * _OCTAHEDRON,
        _OCTAHEDRON_FACES,
        turns,
        places.astype(np.float32),
        batched_colors=colours,
    )

    @handle.on_click
    def _(event: Any) -> None:
        if event.instance_index is not None:
            clicked(places[event.instance_index])
