"""The lobby, built from nothing: closed solids, their textures, and one XML for Mitsuba and Sionna RT.

The room is 15 x 12 x 4 m: x to the east, y to the north, z up, the floor at z = 0. Every object is a prism (a profile
extruded along an axis), closed and outward oriented, in a mesh file of its own. Floor, ceiling and walls are solids
around the room; what stands or hangs is sunk a little into what carries it, so that no two faces share a plane.

Sionna RT reads a radio material from the identifier of a ``bsdf`` element (``mat-itu_concrete``), so one such element
stands for one radio material; its faces share one texture, an atlas in which each face has an area of its own.
The ceiling is backlit: its texture is its radiance too, which gives even light and little noise. What the materials are
to radio stands in ``data/lobby/materials.json``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.lobby.textures import paint
from warprrf.device import Progress, require
from warprrf.files import write_atomically, write_text
from warprrf.geometry.mesh_files import write_mesh

ROOM = np.array([[0.0, 0.0, 0.0], [15.0, 12.0, 4.0]])
"""Lower and upper corner of the room's air [m]."""
MATERIALS = Path(__file__).parents[2] / "data" / "lobby" / "materials.json"

ATLAS_WIDTH = 1600  # texels
MARGIN = 4  # texels of repeated border round each face, so that bilinear look-ups never meet a neighbour
HIDDEN = 8  # texels a side of the grey patch that all unseen faces share
JPEG_QUALITY = 82

Pair = tuple[float, float]


@dataclass(frozen=True)
class Solid:
    """A prism: ``profile`` (counter-clockwise, its first corner sees all others) extruded from ``low`` to ``high``.

    The profile lies in the plane of the two axes that follow ``axis`` in cyclic order: (x, y) for z, (y, z) for x,
    (z, x) for y.
    """

    name: str
    material: str
    style: str
    axis: str
    low: float
    high: float
    profile: tuple[Pair, ...]

    @property
    def texel(self) -> float:
        """Size of a texel [m]: what bounds the room has coarser ones."""
        return 0.01 if self.name.startswith(("floor", "ceiling", "wall")) else 0.008

    @property
    def top(self) -> str:
        """Style of upward faces: plants grow in planters."""
        return "foliage" if self.name.startswith("planter") else self.style


def _box(name: str, material: str, style: str, x: Pair, y: Pair, z: Pair) -> Solid:
    profile = ((x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))
    return Solid(name, material, style, "z", *z, profile)


def _sofa(name: str, axis: str, low: float, high: float, back: float, front: float, base: float) -> Solid:
    """An L of seat and back along ``axis`` ("x" or "y"), its back at ``back``, the seat's edge at ``front``."""
    seat, top, bottom = 0.45 + base, 0.92 + base, base - 0.03
    inner = back + 0.3 * float(np.sign(front - back))
    corners = [(inner, seat), (inner, top), (back, top), (back, bottom), (front, bottom), (front, seat)]
    if axis == "y":
        corners = [(z, x) for x, z in corners]
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    profile = corners if area > 0 else [corners[0], *corners[:0:-1]]
    return Solid(name, "carpet_tile", "textile", axis, low, high, tuple(profile))


def _pillar(number: int, x: float, y: float) -> Solid:
    across = (x - 0.3, x + 0.3), (y - 0.3, y + 0.3)
    return _box(f"pillar_{number}", "concrete", "concrete", *across, (-0.02, 4.02))


# A slab with the parapet on its southern edge; it ends in the north and west walls.
GALLERY = (9.6, 2.6), (9.6, 3.55), (9.45, 3.55), (9.45, 2.35), (12.02, 2.35), (12.02, 2.6)
SOLIDS = (
    _box("floor", "marble", "terrazzo", (-0.10, 15.10), (-0.10, 12.10), (-0.20, 0.0)),
    _box("ceiling", "ceiling_board", "ceiling", (-0.11, 15.11), (-0.11, 12.11), (4.0, 4.2)),
    _box("wall_south", "concrete", "concrete", (-0.12, 15.12), (-0.25, 0.0), (-0.12, 4.12)),
    _box("wall_north", "brick", "brick", (-0.13, 15.13), (12.0, 12.25), (-0.13, 4.13)),
    _box("wall_west", "glass", "glass", (-0.20, 0.0), (-0.14, 12.14), (-0.14, 4.14)),
    _box("wall_east", "plasterboard", "plaster", (15.0, 15.20), (-0.15, 12.15), (-0.15, 4.15)),
    _pillar(1, 3.6, 3.3),
    _pillar(2, 3.6, 8.4),
    _pillar(3, 8.6, 6.6),
    _pillar(4, 12.2, 3.2),
    Solid("gallery", "concrete", "concrete", "x", -0.02, 6.8, GALLERY),
    _box("partition", "plasterboard", "plaster", (6.1, 6.3), (-0.02, 4.4), (-0.02, 2.8)),
    _box("screen", "wood", "wood", (11.4, 15.02), (6.0, 6.2), (-0.02, 2.5)),
    _box("kiosk", "plywood", "wood", (8.2, 10.3), (1.9, 4.0), (-0.02, 2.6)),
    _box("platform", "carpet_tile", "textile", (11.0, 15.02), (7.4, 12.02), (-0.04, 0.15)),
    _box("desk", "marble", "terrazzo", (7.6, 10.4), (9.7, 10.4), (-0.02, 1.1)),
    _box("desk_wing", "marble", "terrazzo", (7.4, 8.1), (10.38, 11.4), (-0.03, 1.09)),
    _box("elevator", "metal", "metal", (12.6, 14.4), (-0.03, 0.08), (-0.03, 2.3)),
    _box("vending", "metal", "metal", (14.1, 15.03), (4.6, 5.6), (-0.03, 1.9)),
    _box("totem", "metal", "metal", (5.2, 6.0), (6.0, 6.3), (-0.03, 2.0)),
    _box("sign_north", "metal", "metal", (8.2, 9.8), (11.92, 12.03), (1.9, 2.9)),
    _box("sign_east", "metal", "metal", (14.92, 15.04), (8.9, 10.5), (1.5, 2.5)),
    _box("sign_south", "wood", "wood", (2.0, 4.0), (-0.03, 0.07), (1.3, 2.5)),
    _box("bench", "wood", "wood", (1.2, 1.9), (6.2, 7.8), (-0.03, 0.45)),
    _box("table", "wood", "wood", (12.6, 13.6), (9.0, 9.8), (0.12, 0.6)),
    _box("table_west", "wood", "wood", (1.6, 2.4), (1.4, 2.3), (-0.03, 0.5)),
    _sofa("sofa_north", "x", 11.9, 14.2, 12.02, 11.1, 0.15),
    _sofa("sofa_east", "y", 7.8, 9.9, 15.02, 14.1, 0.15),
    _sofa("sofa_west", "y", 0.7, 3.0, -0.02, 0.9, 0.0),
    _box("planter_west", "concrete", "concrete", (0.5, 1.3), (4.2, 5.0), (-0.03, 0.8)),
    _box("planter_hall", "concrete", "concrete", (10.9, 11.7), (0.5, 1.3), (-0.03, 0.8)),
    _box("planter_lounge", "concrete", "concrete", (11.2, 11.9), (6.6, 7.2), (-0.03, 0.7)),
)


@dataclass(frozen=True, eq=False)
class Face:
    """One planar face: its corners (a fan from the first), its look, and whether the room's air touches it."""

    corners: np.ndarray
    normal: np.ndarray
    style: str
    texel: float
    visible: bool

    def plane(self) -> np.ndarray:
        """Metres to the right of, and below, the face's upper left corner, shape ``(corners, 2)``."""
        up = np.array([0.0, 0.0, 1.0]) if abs(self.normal[2]) < 0.5 else np.array([0.0, 1.0, 0.0])
        u, v = self.corners @ np.cross(-self.normal, up), self.corners @ up
        return np.column_stack([u - u.min(), v.max() - v])


def faces_of(solid: Solid) -> list[Face]:
    """Both ends of a prism, then its sides."""
    axis, profile = "xyz".index(solid.axis), np.array(solid.profile)
    order, along = [(axis + 1) % 3, (axis + 2) % 3, axis], np.eye(3)[axis]

    def lift(height: float) -> np.ndarray:
        points = np.empty((len(profile), 3))
        points[:, order] = np.column_stack([profile, np.full(len(profile), height)])
        return points

    low, high = lift(solid.low), lift(solid.high)
    polygons = [(np.concatenate([low[:1], low[:0:-1]]), -along), (high, along)]
    for k in range(len(profile)):
        j = (k + 1) % len(profile)
        normal = np.cross(low[j] - low[k], along)
        polygons.append((np.array([low[k], low[j], high[j], high[k]]), normal / np.linalg.norm(normal)))
    faces = []
    for corners, normal in polygons:
        centre = corners.mean(axis=0)
        inside = bool(np.all(centre >= ROOM[0] - 1e-9) and np.all(centre <= ROOM[1] + 1e-9))
        faces.append(
            Face(corners, normal, solid.top if normal[2] > 0.5 else solid.style, solid.texel, inside)
        )
    return faces


class Atlas:
    """Textures of one material, packed in rows (a "shelf" each, the tallest faces first)."""

    def __init__(self, faces: Sequence[Face], rng: np.random.Generator) -> None:
        self.place: dict[int, tuple[int, int]] = {}
        sizes = [np.ceil(f.plane().max(axis=0) / f.texel).astype(int) + 2 * MARGIN for f in faces]
        width = max([ATLAS_WIDTH, *(int(s[0]) for s in sizes)])
        x, y, shelf = HIDDEN, 0, HIDDEN
        for k in sorted(range(len(faces)), key=lambda k: -int(sizes[k][1])):
            if not faces[k].visible:
                continue
            w, h = (int(v) for v in sizes[k])
            if x + w > width:
                x, y, shelf = 0, y + shelf, 0
            self.place[k] = (x, y)
            x, shelf = x + w, max(shelf, h)
        self.width, self.height = width, y + shelf
        self.image = np.full((self.height, self.width, 3), 0.5)
        for k, (x, y) in self.place.items():
            face = faces[k]
            w, h = (int(v) - 2 * MARGIN for v in sizes[k])
            tile = paint(face.style, w * face.texel, h * face.texel, face.texel, rng)
            padded = np.pad(tile, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")
            self.image[y : y + padded.shape[0], x : x + padded.shape[1]] = padded

    def uv(self, k: int, face: Face) -> np.ndarray:
        """Texture coordinates of the corners of face ``k``; v grows downwards, as Mitsuba reads PLY files."""
        if k not in self.place:
            texels = np.full((len(face.corners), 2), HIDDEN / 2)
        else:
            texels = face.plane() / face.texel + np.array(self.place[k]) + MARGIN
        return np.column_stack([texels[:, 0] / self.width, texels[:, 1] / self.height])


BSDF = """\
  <bsdf type="diffuse" id="mat-itu_{0}">
    <texture type="bitmap" name="reflectance">
      <string name="filename" value="textures/{0}.jpg"/>
    </texture>
  </bsdf>"""
SHAPE = """\
  <shape type="ply" id="{0.name}">
    <string name="filename" value="meshes/{0.name}.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-itu_{0.material}" name="bsdf"/>{1}
  </shape>"""
EMITTER = """
    <emitter type="area">
      <texture type="bitmap" name="radiance">
        <string name="filename" value="textures/{0.material}.jpg"/>
      </texture>
    </emitter>"""


def scene_xml() -> str:
    """The scene description: one textured ``bsdf`` a radio material, one ``shape`` an object."""
    about = "  <!-- Look: the atlas. Radio: the identifier, see materials.json. -->"
    looks = [BSDF.format(material) for material in dict.fromkeys(s.material for s in SOLIDS)]
    shapes = [SHAPE.format(s, EMITTER.format(s) if s.name == "ceiling" else "") for s in SOLIDS]
    return "\n".join(['<scene version="3.0.0">', "", about, *looks, "", *shapes, "", "</scene>", ""])


def build(directory: str | os.PathLike[str], *, seed: int = 0, progress: Progress | None = None) -> Path:
    """Write ``scene.xml``, ``materials.json``, meshes and textures under ``directory``; returns the XML's path."""
    directory = Path(directory)
    (directory / "meshes").mkdir(parents=True, exist_ok=True)
    (directory / "textures").mkdir(exist_ok=True)
    images = require("PIL.Image", extra="photos")
    materials = list(dict.fromkeys(s.material for s in SOLIDS))
    for done, material in enumerate(materials):
        members = [(s, f) for s in SOLIDS if s.material == material for f in faces_of(s)]
        atlas = Atlas([f for _, f in members], np.random.default_rng([seed, *material.encode()]))
        picture = images.fromarray(np.round(255 * atlas.image).astype(np.uint8))
        save = partial(picture.save, format="JPEG", quality=JPEG_QUALITY, optimize=True)
        write_atomically(directory / "textures" / f"{material}.jpg", save)
        for solid in dict.fromkeys(s for s, _ in members):
            own = [(face, atlas.uv(k, face)) for k, (s, face) in enumerate(members) if s is solid]
            first = np.cumsum([0, *(len(face.corners) for face, _ in own)])
            triangles = [
                (start, start + i, start + i + 1)
                for start, (face, _) in zip(first, own, strict=False)
                for i in range(1, len(face.corners) - 1)
            ]
            write_mesh(
                directory / "meshes" / f"{solid.name}.ply", np.concatenate([face.corners for face, _ in own]),
                np.array(triangles), uv=np.concatenate([uv for _, uv in own]),
            )  # fmt: skip
        if progress is not None:
            progress("scene", done + 1, len(materials))
    write_text(directory / "materials.json", MATERIALS.read_text(encoding="utf-8"))
    write_text(directory / "scene.xml", scene_xml())
    return directory / "scene.xml"
