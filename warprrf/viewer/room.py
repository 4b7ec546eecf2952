"""The panel of the room: mesh and splats below a cut, coloured by what is known of each surface; cameras with photos."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians, quaternions_of
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.viewer import pictures
from warprrf.viewer.page import Page, Setting
from warprrf.viewer.subject import Subject

THUMBNAIL = 96  # width of a photo at its camera, pixels
NEAREST, NEAR_M = 16, 0.15  # Gaussians that colour a face
MOST_NAMES = 16  # in a legend
LEARNED = {
    "reflection": (-40.0, 0.0, "dB", "viridis"),
    "scattering": (-40.0, 0.0, "dB", "viridis"),
    "roughness": (0.0, 0.2, "mm", "cividis"),
    "uncertainty": (0.0, 2.5, "dB", "magma"),
}
"""What a field learned of each surface, with the range, unit and colour map in which it is shown."""


def colourings(subject: Subject) -> list[str]:
    """Ways in which the faces of ``subject`` can be coloured, the most natural first."""
    found = []
    if subject.mesh is not None and (subject.mesh.face_colours is not None or subject.gaussians is not None):
        found.append("photo colours")
    if subject.scene is not None and subject.scene.mesh is subject.mesh:
        found.append("scene materials")
    if isinstance(subject.field, BistaticField):
        found += ["learned materials", *LEARNED]
    return [*found, "plain"]


def learned(field: BistaticField, kind: str, progress: Progress | None = None) -> np.ndarray:
    """What ``field`` learned of each tile of its surface, shape ``(N,)``.

    Args:
        kind: ``"reflection"``: power mirrored at normal incidence [dB]; ``"scattering"``: power scattered under even
            light [dB]; ``"roughness"``: rms height that the shares of both tell (Ament 1953) [mm]; ``"uncertainty"``:
            standard deviation of the gain of what a surface scatters, by what the measurements saw of it [dB].
        progress: of the last, which takes seconds.
    """
    surface, p, tiles = field.surface, field.parameters, field.surface.tiles
    if kind == "uncertainty":
        return field.gain_std_db(progress)[surface.element[tiles.cell]]
    if kind == "roughness":
        height_m = field.wavelength_m / (4.0 * np.pi) * np.sqrt(np.maximum(-p.log_smooth, 0.0))
        return 1e3 * height_m[surface.group[tiles.face]]
    share = p.mirrored_share if kind == "reflection" else p.scattered_share
    return 10.0 * np.log10(np.maximum(share, 1e-12))[surface.group[tiles.face]]


def face_colours(
    subject: Subject, kind: str, progress: Progress | None = None
) -> tuple[Mesh, np.ndarray, str]:
    """A mesh with colours (F, 3) uint8 of its faces by one of :func:`colourings`, and what they mean in HTML."""
    mesh, field, names = subject.mesh, subject.field, []
    if mesh is None:
        raise ValueError("subject: got no mesh, expected one")
    if kind == "scene materials" and subject.scene is not None:
        index, names = subject.scene.face_material, [m.name for m in subject.scene.materials]
    elif kind == "learned materials" and isinstance(field, BistaticField):
        mesh, index = field.surface.mesh, field.material[field.surface.group]
        names = [field.surface.group_names[g] for g in np.unique(field.material, return_index=True)[1]]
    elif kind in LEARNED and isinstance(field, BistaticField):
        low, high, unit, name = LEARNED[kind]
        shades = pictures.coloured(learned(field, kind, progress), low, high, name)
        return (
            field.surface.tiles.fan,
            np.repeat(shades, 5, axis=0),
            pictures.colour_bar(low, high, unit, name),
        )
    elif kind == "photo colours":
        seen = mesh.face_colours if subject.gaussians is None else _of_splats(mesh, subject.gaussians)
        known = np.round(np.asarray(seen) * 255.0)
        return mesh, np.where(np.isfinite(known), known, pictures.GREY).astype(np.uint8), ""
    else:
        return mesh, np.tile(np.array([pictures.GREY], dtype=np.uint8), (len(mesh.faces), 1)), ""
    return mesh, pictures.named_colours(index), pictures.legend(names if len(names) <= MOST_NAMES else [])


def _of_splats(mesh: Mesh, gaussians: Gaussians) -> np.ndarray:
    """Median colour (F, 3) of the Gaussians nearest to each face, NaN where there are none near."""
    arrays = pictures.splats(gaussians)
    distance, nearest = cKDTree(arrays["centers"]).query(mesh.triangles.mean(axis=1), NEAREST)
    return np.where(distance[:, :1] < NEAR_M, np.median(arrays["rgbs"][nearest], axis=1), np.nan)


class Room:
    """Mesh, splats and cameras, and which of all that is drawn is shown; ``colouring`` chooses
    the mesh's colours, ``legend`` says what they mean."""

    def __init__(self, page: Page, subject: Subject) -> None:
        self._page, self._subject = page, subject
        low, high = subject.bounds[:, 2]
        if subject.mesh is not None:
            page.hidden.add("splats")
        cut = page.gui.add_slider(
            "show up to [m]", min=round(float(low), 2), max=round(float(high), 2) + 0.01, step=0.01,
            initial_value=round(float(high - 0.02 * (high - low)), 2),
        )  # fmt: skip
        chosen = page.gui.add_dropdown("colour the mesh by", tuple(colourings(subject)))
        self.legend = page.gui.add_html("")
        self._cut, self.colouring = Setting(cut, self._draw), Setting(chosen, self.recolour)
        held = {
            "mesh": subject.mesh, "splats": subject.gaussians, "cameras": subject.cameras or None,
            "measured": subject.places if len(subject.places) else None, "paths": page, "map": subject.field,
        }  # fmt: skip
        for name, thing in held.items():
            if thing is not None:
                box = page.gui.add_checkbox(name, name not in page.hidden)
                box.on_update(lambda event, name=name: self._show(name, event.target.value))
        self._faces: tuple[Mesh, np.ndarray] | None = None
        self._draw_cameras()
        self.recolour()

    def recolour(self) -> None:
        """Colour the mesh as is chosen now; in the background where that takes seconds."""
        if self.colouring.value == "uncertainty":
            self._page.in_background(self._recolour)
        else:
            self._recolour()

    def _recolour(self, progress: Progress | None = None) -> None:
        if self._subject.mesh is not None:
            mesh, colours, meaning = face_colours(self._subject, self.colouring.value, progress)
            self._faces = mesh, colours
            self.legend.content = pictures.figure("", meaning)
        self._draw()

    def _show(self, name: str, visible: bool) -> None:
        if not self._page.show(name, visible) and visible:
            self._draw()

    def _draw(self) -> None:
        """Mesh and splats up to the cut; what is hidden is not sent, for browsers sort splats even so."""
        cut, scene = self._cut.value, self._page.scene
        with self._page.server.atomic():
            if self._faces is not None and "mesh" not in self._page.hidden:
                import trimesh

                mesh, colours = self._faces
                kept = mesh.triangles.mean(axis=1)[:, 2] <= cut
                corners = mesh.triangles[kept].reshape(-1, 3) - self._page.origin
                shown = trimesh.Trimesh(
                    corners, np.arange(len(corners)).reshape(-1, 3), process=False,
                    vertex_colors=np.repeat(colours[kept], 3, axis=0),
                )  # fmt: skip
                scene.add_mesh_trimesh("/mesh", shown)
            if self._subject.gaussians is not None and "splats" not in self._page.hidden:
                arrays = pictures.splats(self._subject.gaussians)
                low = arrays["centers"][:, 2] <= cut
                arrays["centers"] = arrays["centers"] - self._page.origin
                scene.add_gaussian_splats("/splats", **{name: array[low] for name, array in arrays.items()})

    def _draw_cameras(self) -> None:
        """Where the photos were taken, each with its photo; hidden until asked for."""
        scene, subject = self._page.scene, self._subject
        if not subject.cameras:
            return
        scene.add_frame("/cameras", show_axes=False, visible="cameras" not in self._page.hidden)
        for name, camera in subject.cameras.items():
            to_world = np.linalg.inv(camera.world_to_camera)
            scene.add_camera_frustum(
                f"/cameras/{name}", fov=2.0 * float(np.arctan(0.5 * camera.height / (camera.fy or camera.height))),
                aspect=camera.width / camera.height, scale=0.15, image=_thumbnail(subject, name, camera),
                color=(60, 90, 160), wxyz=quaternions_of(to_world[None, :3, :3])[0], position=to_world[:3, 3] - self._page.origin,
            )  # fmt: skip


def _thumbnail(subject: Subject, name: str, camera: Camera) -> np.ndarray | None:
    if name not in subject.photos or not subject.photos[name].is_file():
        return None
    from PIL import Image

    with Image.open(subject.photos[name]) as photo:
        photo.thumbnail((THUMBNAIL, THUMBNAIL))
        return np.asarray(photo.convert("RGB"))
