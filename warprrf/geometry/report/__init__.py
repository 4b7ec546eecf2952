"""A reconstruction on one HTML page: what went in, what came out, how far it can be trusted. Pictures are embedded."""

from __future__ import annotations

import base64
import html
import io
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from warprrf.device import DeviceLike, Progress, require, silent
from warprrf.files import write_text
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.posed.photo_files import read_photo, spread
from warprrf.geometry.photos.posed.undistort import Lens
from warprrf.geometry.report.sight import CLASSES, colours_of, from_outside, how_seen, painted
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render

SHOWN = 6  # photos beside their renderings
PICTURE_WIDTH = 420  # of one of them [pixels]
WIDTH, MARGIN = 760.0, 34.0  # of the plan [pixels]
MOST_LINES = 6000  # of walls
FITTED, HELD = "#2166ac", "#e08214"
SIDES = ((0.25, "from +x +y"), (0.75, "from -x +y"), (1.25, "from -x -y"), (1.75, "from +x -y"))  # [pi rad]

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
p.note, figcaption { color: #555; font-size: .92rem; } figure { margin: .6rem 0; } img, svg { max-width: 100%; }
.two img { width: 100%; }
svg text { font-size: 11px; fill: #666; } .two { display: grid; grid-template-columns: 1fr 1fr; gap: .6rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .8rem .3rem 0; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top; }
.key { display: inline-block; width: .9em; height: .9em; margin: 0 .3em 0 1em; } .warn { color: #a8200d; }
"""


class Subject(Protocol):
    """What a report is about: a :class:`~warprrf.geometry.reconstruction.Reconstruction`, whose attributes these are."""

    cameras: dict[str, Camera]
    photos: dict[str, Path]
    held_out: tuple[str, ...]
    unposed: tuple[str, ...]
    causes: dict[str, str]
    lenses: dict[str, Lens]
    guessed: tuple[str, ...]
    metric: bool
    scale_rms_m: float


def write_report(
    path: str | os.PathLike[str],
    subject: Subject,
    gaussians: Gaussians | None,
    mesh: Mesh | None,
    *,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> None:
    """Write the page of ``subject`` to ``path``."""
    report = progress or silent
    report("report", 0, 3)
    parts = [_head(subject, gaussians, mesh), _warnings(subject)]
    if subject.cameras:
        parts.append(_from_above(subject, mesh))
        parts.append(_beside(subject, gaussians, device))
    report("report", 1, 3)
    if mesh is not None:
        parts.append(_surface(mesh, gaussians, subject, device))
    report("report", 2, 3)
    parts += [_lenses(subject), _unposed(subject)]
    body = "\n".join(part for part in parts if part)
    write_text(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Reconstruction</title>'
        f"<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n",
    )
    report("report", 3, 3)


def psnr_db(picture: np.ndarray, photo: np.ndarray) -> float:
    """Peak signal to noise ratio [dB] of a picture in [0, 1]."""
    error = float(np.mean((np.clip(picture, 0, 1) - photo) ** 2))
    return -10 * np.log10(max(error, 1e-12))


def colours_matched(picture: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """``picture`` after the affine change of its colours that brings it nearest to ``photo``, both ``(H, W, 3)``."""
    given = np.column_stack([picture.reshape(-1, 3), np.ones(picture.shape[0] * picture.shape[1])])
    change = np.linalg.lstsq(given, photo.reshape(-1, 3), rcond=None)[0]
    return (given @ change).reshape(picture.shape)


def _head(subject: Subject, gaussians: Gaussians | None, mesh: Mesh | None) -> str:
    total = len(subject.cameras) + len(subject.unposed)
    rows = [
        ("photos", f"{len(subject.cameras)} of {total} posed, {len(subject.held_out)} held out of the fit")
    ]
    if gaussians is not None:
        rows.append(("Gaussians", f"{len(gaussians)}"))
    if mesh is not None:
        low, high = mesh.bounds
        size = " x ".join(f"{length:.2f}" for length in high - low)
        rows.append(
            (
                "mesh",
                f"{len(mesh.faces)} triangles, {mesh.areas.sum():.1f} m², within {size} m",
            )
        )
    if not np.isnan(subject.scale_rms_m):
        rows.append(("surveyed positions", f"met within {100 * subject.scale_rms_m:.1f} cm rms"))
    return f"<h1>Reconstruction</h1>{_table(rows)}"


def _warnings(subject: Subject) -> str:
    said = list(subject.guessed)
    if not subject.metric and not any(text.startswith("scale") for text in said):
        said.append("scale: lengths are not metres")
    if not said:
        return '<h2>What is guessed</h2><p class="note">Nothing: scale, up and the floor are measured or seen.</p>'
    items = "".join(f'<li class="warn">{html.escape(text)}</li>' for text in said)
    return f"<h2>What is guessed</h2><ul>{items}</ul>"


def _from_above(subject: Subject, mesh: Mesh | None) -> str:
    """Cameras with the directions that they look in, over a section of the mesh at their median height, as SVG."""
    cameras = subject.cameras
    places = np.array([c.position for c in cameras.values()])
    walls = np.zeros((0, 2, 2))
    if mesh is not None:
        walls = mesh.cross_section(float(np.median(places[:, 2]))).reshape(-1, 2, 2)
        walls = walls if len(walls) else mesh.triangles[:, [0, 1], :2]  # nothing at that height: its outline
        walls = walls[np.argsort(-np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1))[:MOST_LINES]]
    spread = np.percentile(np.concatenate([places[:, :2], walls.reshape(-1, 2)]), [0.5, 99.5], axis=0)
    low = np.minimum(spread[0], places[:, :2].min(axis=0))
    high = np.maximum(spread[1], places[:, :2].max(axis=0))
    extent = np.maximum(high - low, 1e-6)
    scale = min((WIDTH - 2 * MARGIN) / extent[0], 1.2 * WIDTH / extent[1])
    width, height = scale * extent + 2 * MARGIN

    def line(*corners: np.ndarray) -> str:
        x, y = np.asarray(corners)[:, :2].T
        x, y = MARGIN + scale * (x - low[0]), height - MARGIN - scale * (y - low[1])
        return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))

    parts = [f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="plan of the cameras">']
    rough = float(extent.max()) / 8
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(s for s in (1, 2, 5, 10) if s * power >= rough)
    for axis, style in ((0, 'dy="16" text-anchor="middle"'), (1, 'dx="-6" dy="4" text-anchor="end"')):
        for value in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step + 0.0:
            ends = np.array([low, high])
            ends[:, axis] = value
            path = line(*ends)
            x, y = path[1:].split("L")[0].split()
            parts.append(f'<path d="{path}" stroke="#e4e4e4"/><text x="{x}" y="{y}" {style}>{value:g}</text>')
    parts.append(f'<path d="{"".join(line(*wall) for wall in walls)}" stroke="#444" stroke-width="1.6"/>')
    for name, camera in cameras.items():
        colour = HELD if name in subject.held_out else FITTED
        right, _, ahead = camera.rotation * 20 / scale
        half = right * (camera.width / 2 / camera.fx if camera.fx else 1.0)
        at = camera.position
        x, y = line(at)[1:].split()
        title = f"{html.escape(name)}: {at[0]:.2f}, {at[1]:.2f}, {at[2]:.2f}"
        parts.append(
            f'<path d="{line(at, at + ahead - half, at + ahead + half)}Z" fill="{colour}" opacity=".28"/>'
            f'<circle cx="{x}" cy="{y}" r="3" fill="{colour}"><title>{title}</title></circle>'
        )
    unit = "m" if subject.metric else "assumed m"
    keys = _key(FITTED, "photos that were fitted") + _key(HELD, "held out.")
    return (
        f"<h2>Cameras from above</h2><figure>{''.join(parts)}</svg><figcaption>{keys} x and y in {unit}. Lines: "
        "where the mesh is at the cameras' median height.</figcaption></figure>"
    )


def _beside(subject: Subject, gaussians: Gaussians | None, device: DeviceLike) -> str:
    """Photos beside what the Gaussians show, those held out where there are some."""
    if gaussians is None:
        return ""
    held = [name for name in subject.held_out if name in subject.cameras]
    names = held or list(subject.cameras)
    there = [name for name in names if name in subject.photos and subject.photos[name].is_file()]
    title = "Held-out photos" if held else "Photos"
    text = "Photo on the left, Gaussians on the right"
    text += "." if held else "; none was held out, and the PSNR of photos that were fitted flatters."
    if not there:
        return f'<h2>{title}</h2><p class="note">Their files are not there any more.</p>'
    rows, scores = [], []
    for name in spread(there, SHOWN):
        photo = read_photo(subject.photos[name])
        camera = subject.cameras[name].resized(photo.shape[1], photo.shape[0])
        picture = render(gaussians, camera, device=device).features
        plain, matched = psnr_db(picture, photo), psnr_db(colours_matched(picture, photo), photo)
        scores.append((plain, matched))
        caption = f"{html.escape(name)}: {plain:.1f} dB, {matched:.1f} dB with colours matched"
        rows.append(
            f'<figure><div class="two">{_jpeg(photo)}{_jpeg(picture)}</div><figcaption>{caption}</figcaption></figure>'
        )
    mean = np.mean(scores, axis=0)
    text += f" Mean PSNR of those shown: {mean[0]:.1f} dB, {mean[1]:.1f} dB after an affine change of each one's colours."
    return f'<h2>{title} beside renderings</h2><p class="note">{text}</p>{"".join(rows)}'


def _surface(mesh: Mesh, gaussians: Gaussians | None, subject: Subject, device: DeviceLike) -> str:
    """The mesh from four sides, in its colours and by how often it was seen."""
    views = [(from_outside(mesh, np.pi * turn, device=device), name) for turn, name in SIDES]
    grey = np.zeros((1, 3)), np.full((1, 3), 0.8)
    own = grey if gaussians is None else (gaussians.means, colours_of(gaussians))
    said = (
        "Backs of surfaces are left out: walls and ceiling between the eye and the room are looked through."
    )
    parts = [f'<h2>Mesh from four sides</h2><p class="note">{said}</p>{_four(views, own)}']
    if subject.cameras:
        seen = how_seen(mesh, list(subject.cameras.values()), device=device)
        keys = "".join(
            _key(colour, f"{name}: {share:.0%}")
            for (_, name, colour), share in zip(CLASSES, seen.shares, strict=True)
        )
        parts.append(
            "<h2>How well each surface was seen</h2><p>Photos that show it, and the part of the area:"
            f"{keys}</p>{_four(views, (seen.points, seen.colours))}"
            '<p class="note">What fewer than three photos show is inferred from what is round it.</p>'
        )
    return "".join(parts)


def _four(
    views: Sequence[tuple[tuple[np.ndarray, np.ndarray], str]], coloured: tuple[np.ndarray, np.ndarray]
) -> str:
    figures = "".join(
        f"<figure>{_jpeg(painted(*view, *coloured))}<figcaption>{name}</figcaption></figure>"
        for view, name in views
    )
    return f'<div class="two">{figures}</div>'


def _lenses(subject: Subject) -> str:
    groups = Counter(
        (c.width, c.height, *(round(x, 2) for x in (c.fx, c.fy, c.cx, c.cy)))
        for c in subject.cameras.values()
    )
    if not groups:
        return ""
    rows = [("photos", "pixels used", "focal length [pixels]", "principal point", "field of view")]
    for (width, height, fx, fy, cx, cy), count in groups.most_common(SHOWN):
        view = " x ".join(
            f"{np.degrees(2 * np.arctan2(n / 2, f)):.0f}°" for n, f in ((width, fx), (height, fy))
        )
        focal = f"{fx:.1f}" if fx == fy else f"{fx:.1f}, {fy:.1f}"
        rows.append((f"{count}", f"{width:.0f} x {height:.0f}", focal, f"{cx:.1f}, {cy:.1f}", view))
    more = f'<p class="note">{len(groups) - SHOWN} more lenses.</p>' if len(groups) > SHOWN else ""
    return f"<h2>Lenses</h2>{_table(rows)}{more}{_taken_with(subject)}"


def _taken_with(subject: Subject) -> str:
    """Lenses before photos were undistorted and reduced."""
    if not subject.lenses:
        return ""
    rows = [("photos", "pixels as stored", "lens model", "distortion")]
    for lens, count in Counter(subject.lenses.values()).most_common(SHOWN):
        bends = ", ".join(f"{c:.4g}" for c in lens.coefficients) if not lens.straight else "none"
        rows.append((f"{count}", f"{lens.width} x {lens.height}", lens.model, bends))
    return f"<p>They were taken with:</p>{_table(rows)}"


def _unposed(subject: Subject) -> str:
    if not subject.unposed:
        return ""
    rows = [(name, subject.causes.get(name, "cause not known")) for name in subject.unposed]
    return f"<h2>Photos without a pose</h2>{_table(rows)}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table>{lines}</table>"


def _key(colour: str, text: str) -> str:
    return f'<span class="key" style="background:{colour}"></span>{html.escape(text)}'


def _jpeg(picture: np.ndarray) -> str:
    """An embedded picture ``(H, W, 3)`` in [0, 1], made smaller where it is wide."""
    image = require("PIL.Image", extra="photos")
    shown = image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    if shown.width > PICTURE_WIDTH * 1.2:
        size = PICTURE_WIDTH, max(1, round(shown.height * PICTURE_WIDTH / shown.width))
        shown = shown.resize(size, image.Resampling.BOX)
    data = io.BytesIO()
    shown.save(data, "JPEG", quality=85)
    code = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="" width="{shown.width}" src="data:image/jpeg;base64,{code}">'
