"""The panel of the room: mesh and splats below a cut, coloured by what is known of each surface; cameras with photos."""

from __future__ import annotations

from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import quaternions_of
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.materials import mirror_share
from warprrf.viewer import pictures
from warprrf.viewer.page import Page
from warprrf.viewer.subject import Subject

THUMBNAIL = 96  # width of a photo at its camera, pixels
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
    if subject.mesh is not None and subject.mesh.face_colours is not None:
        found.append("photo colours")
    if subject.scene is not None and subject.scene.mesh is subject.mesh:
        found.append("scene materials")
    if isinstance(subject.field, BistaticField):
        found += ["learned materials", *LEARNED]
    return [*found, "plain"]


def learned(field: BistaticField, kind: str, progress: Progress | None = None) -> np.ndarray:
    """What ``field`` learned of each face of its own mesh, shape ``(F,)``.

    Args:
        kind: ``"reflection"``: power mirrored at normal incidence [dB]; ``"scattering"``: power scattered under even
            light [dB]; ``"roughness"``: rms height that the shares of both tell (Ament 1953) [mm]; ``"uncertainty"``:
            standard deviation of the gain of what a surface scatters, by what the measurements saw of it [dB].
        progress: of the last, which takes seconds.
    """
    surface, p = field.surface, field.parameters
    groups = np.arange(surface.groups)
    if kind == "uncertainty":
        return field.gain_std_db(progress=progress)[surface.element]
    if kind == "reflection":
        value = 10.0 * np.log10(np.maximum(mirror_share(p, groups, np.ones(len(groups))), 1e-12))
    elif kind == "scattering":
        value = 10.0 * np.log10(np.maximum(p.scattered_share, 1e-12))
    else:
        value = 1e3 * field.wavelength_m / (4.0 * np.pi) * np.sqrt(np.maximum(-p.log_smooth, 0.0))
    return np.asarray(value[surface.group])


def face_colours(
    subject: Subject, kind: str, progress: Progress | None = None
) -> tuple[Mesh, np.ndarray, str]:
    """The mesh that is drawn, colours (F, 3) uint8 of its faces by one of :func:`colourings`, and a legend in HTML."""
    mesh, field = subject.mesh, subject.field
    if mesh is None:
        raise ValueError("subject: got no mesh, expected one")
    if kind == "photo colours" and mesh.face_colours is not None:
        seen = np.isfinite(mesh.face_colours).all(axis=1)
        known = np.round(np.nan_to_num(mesh.face_colours) * 255.0)
        return mesh, np.where(seen[:, None], known, pictures.GREY).astype(np.uint8), ""
    if kind == "scene materials" and subject.scene is not None:
        return mesh, *_named(subject.scene.face_material, [m.name for m in subject.scene.materials])
    if kind == "plain" or not isinstance(field, BistaticField):
        return mesh, np.tile(np.array([pictures.GREY], dtype=np.uint8), (len(mesh.faces), 1)), ""
    surface = field.surface  # its mesh has more, smaller faces
    if kind == "learned materials":
        first = np.unique(field.material, return_index=True)[1]
        return surface.mesh, *_named(field.material[surface.group], [surface.group_names[g] for g in first])
    low, high, unit, name = LEARNED[kind]
    colours = pictures.coloured(learned(field, kind, progress), low, high, name)
    return surface.mesh, colours, pictures.colour_bar(low, high, unit, name)


def _named(index: np.ndarray, names: Any) -> tuple[np.ndarray, str]:
    shown = names if len(names) <= MOST_NAMES else ()
    return pictures.named_colours(index), pictures.legend(
        shown, pictures.named_colours(np.arange(len(names)))[: len(shown)]
    )


class Room:
    """Mesh, splats and cameras, and what of all that is drawn is shown."""

    def __init__(self, page: Page, subject: Subject) -> None:
        self._page, self._subject = page, subject
        low, high = subject.bounds[:, 2]
        if subject.mesh is not None:
            page.hidden.add("splats")
        self._cut = page.gui.add_slider(
            "show up to [m]", min=float(low), max=float(high) + 0.01, step=0.01,
            initial_value=float(high - 0.02 * (high - low)),
        )  # fmt: skip
        self._colouring = page.gui.add_dropdown("colour the mesh by", tuple(colourings(subject)))
        self._legend = page.gui.add_html("")
        self._cut.on_update(lambda _: self._draw())
        self._colouring.on_update(lambda _: self.recolour())
        held = {
            "mesh": subject.mesh, "splats": subject.gaussians, "cameras": subject.cameras or None,
            "measured": subject.places if len(subject.places) else None, "paths": page,
        }  # fmt: skip
        for name, thing in held.items():
            if thing is not None:
                box = page.gui.add_checkbox(name, page.visible(name))
                box.on_update(lambda event, name=name: self._show(name, event.target.value))
        self._faces: tuple[Mesh, np.ndarray] | None = None
        self._draw_cameras()
        self.recolour()

    @property
    def html(self) -> str:
        """What the colours of the mesh mean."""
        return str(self._legend.content)

    def recolour(self) -> None:
        """Colour the mesh as is chosen now; in the background where that takes seconds."""
        if self._colouring.value == "uncertainty":
            self._page.in_background(self._recolour)
        else:
            self._recolour()

    def _recolour(self, progress: Progress | None = None) -> None:
        if self._subject.mesh is not None:
            mesh, colours, meaning = face_colours(self._subject, self._colouring.value, progress)
            self._faces = mesh, colours
            self._legend.content = f'{pictures.STYLE}<div class="wr">{meaning}</div>'
        self._draw()

    def _show(self, name: str, visible: bool) -> None:
        if not self._page.show(name, visible) and visible:
            self._draw()

    def _draw(self) -> None:
        """Mesh and splats up to the cut; what is hidden is not sent, for browsers sort splats even so."""
        cut, scene = float(self._cut.value), self._page.scene
        with self._page.server.atomic():
            if self._faces is not None and self._page.visible("mesh"):
                import trimesh

                mesh, colours = self._faces
                kept = mesh.triangles.mean(axis=1)[:, 2] <= cut
                corners = mesh.triangles[kept].reshape(-1, 3)
                shown = trimesh.Trimesh(
                    corners, np.arange(len(corners)).reshape(-1, 3), process=False,
                    vertex_colors=np.repeat(colours[kept], 3, axis=0),
                )  # fmt: skip
                scene.add_mesh_trimesh("/mesh", shown)
            if self._subject.gaussians is not None and self._page.visible("splats"):
                arrays = pictures.splats(self._subject.gaussians)
                low = arrays["centers"][:, 2] <= cut
                scene.add_gaussian_splats("/splats", **{name: array[low] for name, array in arrays.items()})

    def _draw_cameras(self) -> None:
        """Where the photos were taken, each with its photo; hidden until asked for."""
        scene, subject = self._page.scene, self._subject
        if not subject.cameras:
            return
        scene.add_frame("/cameras", show_axes=False, visible=self._page.visible("cameras"))
        for name, camera in subject.cameras.items():
            to_world = np.linalg.inv(camera.world_to_camera)
            scene.add_camera_frustum(
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
