"""Colours, shapes and small HTML figures of what a viewer draws."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence

import numpy as np

from warprrf.device import require
from warprrf.geometry.splats.gaussians import Y00, Gaussians

Image = tuple[str, np.ndarray, float, float, str]
"""Title, values (H, W) [dB], lowest and highest of the colours, colour map."""
GREY = (200, 200, 205)
STYLE = """<style>
.wr{font:12px/1.4 sans-serif;padding:0 10px 8px;color:#333} .wr .title{font-weight:600;margin-top:4px}
.wr img{width:100%;display:block;aspect-ratio:2;image-rendering:pixelated} .wr .image{position:relative}
.wr .ends{display:flex;justify-content:space-between;color:#777;font-size:11px} .wr .bar{height:8px}
.wr .mark{position:absolute;width:14px;height:14px;margin:-7px;border-radius:7px;border:1.5px solid #ffffffa0}
.wr .mark:hover{border-color:#fff;background:#ffffff60} .wr .mark:hover+.tip{display:block}
.wr .tip{display:none;position:absolute;left:0;right:0;top:100%;z-index:9;background:#222;color:#fff;padding:4px 8px}
.wr table{width:100%;border-collapse:collapse} .wr th{color:#777}
.wr td,.wr th{text-align:right;padding:1px 4px;font-weight:400}
.wr i{display:inline-block;width:10px;height:10px;margin-right:4px}
</style>"""


def coloured(values: np.ndarray, low: float, high: float, name: str = "viridis") -> np.ndarray:
    """Values (...) as colours (..., 3) uint8, ``low`` to ``high`` along a colour map of matplotlib; NaN in grey."""
    colours = require("matplotlib", extra="view").colormaps[name]
    unit = (np.asarray(values, dtype=np.float64) - low) / max(high - low, 1e-12)
    found = np.round(colours(np.clip(np.nan_to_num(unit), 0.0, 1.0))[..., :3] * 255).astype(np.uint8)
    found[np.isnan(unit)] = GREY
    return found


def png(image: np.ndarray) -> bytes:
    """A picture (H, W, 3) uint8 as a PNG file."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, format="PNG")
    return data.getvalue()


def figure(title: str, content: str) -> str:
    """HTML of ``content`` in the page's style, below a title."""
    return f'{STYLE}<div class="wr"><div class="title">{html.escape(title)}</div>{content}</div>'


def _spread(texts: Iterable[str]) -> str:
    return '<div class="ends">' + "".join(f"<span>{text}</span>" for text in texts) + "</div>"


def colour_bar(low: float, high: float, unit: str, name: str = "viridis") -> str:
    """HTML of the colours from ``low`` to ``high``."""
    steps = ",".join("rgb({},{},{})".format(*c) for c in coloured(np.linspace(0, 1, 9), 0, 1, name))
    ends = _spread(f"{value:.4g} {unit}" for value in (low, 0.5 * (low + high), high))
    return f'<div class="bar" style="background:linear-gradient(90deg,{steps})"></div>{ends}'


def legend(names: Sequence[str]) -> str:
    """HTML of names with their :func:`named_colours`."""
    colours = named_colours(np.arange(len(names)))
    square = '<i style="background:rgb({},{},{})"></i>{} &emsp;'
    return "".join(square.format(*c, html.escape(n)) for n, c in zip(names, colours, strict=True))


def panorama(image: Image, marks: Sequence[tuple[float, float, str]] = (), *, scale: bool = True) -> str:
    """HTML of an image over azimuth and zenith.

    Args:
        image: its title, values (H, W) [dB], their range, and a colour map.
        marks: zenith and azimuth [rad] of small rings, each with the text that appears while the mouse is over it.
        scale: whether azimuths and colours are labelled below it.
    """
    title, values, low, high, name = image
    data = base64.b64encode(png(coloured(values, low, high, name))).decode()
    rings = "".join(
        f'<div class="mark" style="left:{50.0 + azimuth * 50.0 / np.pi:.2f}%;top:{zenith * 100.0 / np.pi:.2f}%"></div>'
        f'<div class="tip">{html.escape(text)}</div>'
        for zenith, azimuth, text in marks
    )
    ends = _spread(("azimuth -180°", "-90°", "0°", "90°", "180°"))
    below = ends + colour_bar(low, high, "dB", name) if scale else ""
    return (
        f'<div class="title">{html.escape(title)}</div>'
        f'<div class="image"><img src="data:image/png;base64,{data}">{rings}</div>{below}'
    )


def combined(caption: str, images: Sequence[Image], view: np.ndarray | None = None) -> bytes:
    """A PNG file of images as :func:`panorama` takes them, below what the browser shows (H, W, 3)."""
    figures = require("matplotlib.figure", extra="view")
    tall = 3.5 * len(images) + (6.8 if view is not None else 0.5)
    drawing = figures.Figure(figsize=(9.0, tall), layout="constrained")
    drawing.suptitle(caption, fontsize=10)
    heights = [6.5] * (view is not None) + [3.5] * len(images)
    axes = list(drawing.subplots(len(heights), height_ratios=heights, squeeze=False).flat) if heights else []
    if view is not None:
        axes[0].imshow(view)
        axes.pop(0).axis("off")
    for ax, (title, values, low, high, name) in zip(axes, images, strict=True):
        shown = ax.imshow(values, extent=(-180, 180, 180, 0), vmin=low, vmax=high, cmap=name, aspect="auto")
        drawing.colorbar(shown, ax=ax, label="dB")
        ax.set(title=title, xlabel="azimuth [degrees]", ylabel="zenith [degrees]")
    data = io.BytesIO()
    drawing.savefig(data, format="png", dpi=110)
    return data.getvalue()


def named_colours(index: np.ndarray) -> np.ndarray:
    """A colour (..., 3) uint8 for each index (...), neighbours in index far apart in hue."""
    import colorsys

    hues = [
        colorsys.hsv_to_rgb((0.61803399 * k) % 1.0, 0.5, 0.9) for k in range(int(index.max(initial=-1)) + 1)
    ]
    return np.round(np.array(hues) * 255).astype(np.uint8)[index]


def splats(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Arrays that viser draws: ``centers`` (N, 3), ``covariances`` (N, 3, 3), ``rgbs`` (N, 3), ``opacities`` (N, 1)."""
    turned = gaussians.rotations * gaussians.scales[:, None, :]
    base = gaussians.sh[:, 0, :3] * Y00 + 0.5
    return {
        "centers": gaussians.means,
        "covariances": turned @ np.swapaxes(turned, 1, 2),
        "rgbs": np.clip(base, 0.0, 1.0),
        "opacities": gaussians.opacities[:, None],
    }


def lobe_mesh(centre: np.ndarray, directions: np.ndarray, lobe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A beam's power gain (K, M) along ``directions`` (K, M, 3) as triangles: the radius falls to 0 over 20 dB."""
    radius_m, range_db = 1.5, 20.0
    gain_db = 10.0 * np.log10(np.maximum(lobe / lobe.max(), 1e-9))
    radius = radius_m * np.clip(1.0 + gain_db / range_db, 0.0, 1.0)
    rows, columns = lobe.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return (centre + radius[..., None] * directions).reshape(-1, 3), faces
