"""Cameras and walls from above, as SVG."""

from __future__ import annotations

import html
from collections.abc import Collection, Mapping

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera

WIDTH, MARGIN = 760.0, 34.0  # of the drawing [pixels]
MOST_LINES = 6000  # of walls
FITTED, HELD = "#2166ac", "#e08214"


def plan(mesh: Mesh | None, cameras: Mapping[str, Camera], held_out: Collection[str], unit: str) -> str:
    """Camera positions with the directions that they look in, over a section of the mesh at their median height.

    Args:
        held_out: names of the photos that are drawn in another colour.
        unit: of lengths.
    """
    places = np.array([c.position for c in cameras.values()]).reshape(-1, 3)
    height = float(np.median(places[:, 2])) if len(places) else 0.0
    walls = mesh.cross_section(height).reshape(-1, 2, 2) if mesh is not None else np.zeros((0, 2, 2))
    if not len(walls) and mesh is not None:  # nothing at that height: its outline
        walls = mesh.triangles[:, [0, 1], :2]
    if len(walls) > MOST_LINES:  # the longest ones show most
        walls = walls[np.argsort(-np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1))[:MOST_LINES]]
    everything = np.concatenate([places[:, :2], walls.reshape(-1, 2)])
    low, high = np.percentile(everything, [0.5, 99.5], axis=0)
    low, high = (
        np.minimum(low, places[:, :2].min(axis=0, initial=np.inf)),
        np.maximum(high, places[:, :2].max(axis=0, initial=-np.inf)),
    )
    extent = np.maximum(high - low, 1e-6)
    scale = min((WIDTH - 2 * MARGIN) / extent[0], 1.2 * WIDTH / extent[1])
    size = scale * extent + 2 * MARGIN

    def at(xy: np.ndarray) -> np.ndarray:
        return np.stack(
            [MARGIN + scale * (xy[..., 0] - low[0]), size[1] - MARGIN - scale * (xy[..., 1] - low[1])], -1
        )

    parts = [f'<svg viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" role="img" aria-label="plan of the cameras">']
    parts += _grid(low, high, scale, size, unit)
    path = "".join(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" for (x0, y0), (x1, y1) in at(walls))
    parts.append(f'<path d="{path}" stroke="#444" stroke-width="1.6" fill="none"/>')
    for name, camera in cameras.items():
        parts.append(_camera(name, camera, at(camera.position[:2]), HELD if name in held_out else FITTED))
    return "".join(parts) + "</svg>"


def _camera(name: str, camera: Camera, at: np.ndarray, colour: str) -> str:
    """A dot, and a wedge as wide as the field of view."""
    ahead = camera.rotation[2, :2]
    level = float(np.linalg.norm(ahead))
    wedge = ""
    if level > 1e-3:
        turn = np.arctan2(-ahead[1], ahead[0])
        half = np.arctan(camera.width / 2 / camera.fx) if camera.fx else np.pi / 4
        ends = [
            at + 20 * max(level, 0.3) * np.array([np.cos(turn + s * half), np.sin(turn + s * half)])
            for s in (-1, 1)
        ]
        (x0, y0), (x1, y1) = ends
        wedge = f'<path d="M{at[0]:.1f} {at[1]:.1f}L{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}Z" fill="{colour}" opacity=".28"/>'
    x, y, z = camera.position
    title = f"<title>{html.escape(name)}: {x:.2f}, {y:.2f}, {z:.2f}</title>"
    return f'<g>{wedge}<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="3" fill="{colour}">{title}</circle></g>'


def _grid(low: np.ndarray, high: np.ndarray, scale: float, size: np.ndarray, unit: str) -> list[str]:
    """Lines at round numbers, with their numbers."""
    rough = float((high - low).max()) / 8
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * float(min((s for s in (1, 2, 5, 10) if s * power >= rough), default=10))
    lines = []
    for axis in range(2):
        for value in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step + 0.0:
            place = MARGIN + scale * (value - low[axis])
            if axis:
                place = size[1] - place
                lines.append(f'<path d="M{MARGIN} {place:.1f}H{size[0] - MARGIN:.1f}" stroke="#e4e4e4"/>')
                lines.append(f'<text x="{MARGIN - 6}" y="{place + 4:.1f}" text-anchor="end">{value:g}</text>')
            else:
                lines.append(f'<path d="M{place:.1f} {MARGIN}V{size[1] - MARGIN:.1f}" stroke="#e4e4e4"/>')
                lines.append(
                    f'<text x="{place:.1f}" y="{size[1] - MARGIN + 16:.1f}" text-anchor="middle">{value:g}</text>'
                )
    lines.append(
        f'<text x="{size[0] - MARGIN:.1f}" y="{size[1] - 4:.1f}" text-anchor="end">x, y [{unit}]</text>'
    )
    return lines
