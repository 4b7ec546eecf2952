"""Colours, shapes and small HTML figures of what a viewer draws."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np

from warprrf import device as _device
from warprrf.geometry.splats.gaussians import Gaussians

GREY = (200, 200, 205)
STYLE = """<style>
.wr{font:12px/1.4 sans-serif;padding:0 10px 8px;color:#333}
.wr .title{font-weight:600;margin-top:4px}
.wr .image{position:relative}
.wr img{width:100%;display:block;aspect-ratio:2;image-rendering:pixelated}
.wr .ends{display:flex;justify-content:space-between;color:#777;font-size:11px}
.wr .bar{height:8px}
.wr .mark{position:absolute;width:14px;height:14px;margin:-7px;border-radius:7px;border:1.5px solid #ffffffa0}
.wr .mark:hover{border-color:#fff;background:#ffffff60}
.wr .tip{display:none;position:absolute;left:0;right:0;top:100%;z-index:9;background:#222;color:#fff;padding:4px 8px}
.wr .mark:hover+.tip{display:block}
.wr table{width:100%;border-collapse:collapse}
.wr td,.wr th{text-align:right;padding:1px 4px;font-weight:400}
.wr th{color:#777}
.wr i{display:inline-block;width:10px;height:10px;margin-right:4px}
</style>"""


def coloured(values: np.ndarray, low: float, high: float, name: str = "viridis") -> np.ndarray:
    """Values (...) as colours (..., 3) uint8, ``low`` to ``high`` along a colour map of matplotlib; NaN in grey."""
    colours = _device.require("matplotlib", extra="view").colormaps[name]
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


def colour_bar(low: float, high: float, unit: str, name: str = "viridis") -> str:
    """HTML of the colours from ``low`` to ``high``."""
    steps = ",".join("rgb({},{},{})".format(*c) for c in coloured(np.linspace(0, 1, 9), 0, 1, name))
    ends = "".join(f"<span>{value:.4g} {unit}</span>" for value in (low, 0.5 * (low + high), high))
    return f'<div class="bar" style="background:linear-gradient(90deg,{steps})"></div><div class="ends">{ends}</div>'


def legend(names: Sequence[str], colours: np.ndarray) -> str:
    """HTML of names with their colours (K, 3)."""
    return " &emsp; ".join(
        '<i style="background:rgb({},{},{})"></i>'.format(*c) + html.escape(n)
        for n, c in zip(names, colours, strict=True)
    )


def panorama(
    title: str,
    image_db: np.ndarray,
    low: float,
    high: float,
    name: str = "viridis",
    *,
    marks: Sequence[tuple[float, float, str]] = (),
    scale: bool = True,
) -> str:
    """HTML of an image (H, W) [dB] over azimuth and zenith, with its colours.

    Args:
        title: above it.
        image_db: what is shown from ``low`` to ``high`` in the colour map ``name``.
        marks: zenith and azimuth [rad] of small rings, each with the text that appears while the mouse is over it.
        scale: whether azimuths and colours are told below it.
    """
    data = base64.b64encode(png(coloured(image_db, low, high, name))).decode()
    rings = "".join(
        f'<div class="mark" style="left:{50.0 + azimuth * 50.0 / np.pi:.2f}%;top:{zenith * 100.0 / np.pi:.2f}%"></div>'
        f'<div class="tip">{html.escape(text)}</div>'
        for zenith, azimuth, text in marks
    )
    ends = "".join(f"<span>{a}°</span>" for a in ("azimuth -180", "-90", "0", "90", "180"))
    below = f'<div class="ends">{ends}</div>{colour_bar(low, high, "dB", name)}' if scale else ""
    return (
        f'<div class="title">{html.escape(title)}</div><div class="image">'
        f'<img src="data:image/png;base64,{data}">{rings}</div>{below}'
    )


def sheet(
    caption: str, images: Sequence[tuple[str, np.ndarray, float, float, str]], view: np.ndarray | None
) -> bytes:
    """A PNG file of images as :func:`panorama` takes them, below each other, beside what the browser shows (H, W, 3)."""
    figures = _device.require("matplotlib.figure", extra="view")
    rows = max(len(images), 1)
    figure = figures.Figure(
        figsize=(14.0 if view is not None else 6.0, 0.5 + 3.0 * rows), layout="constrained"
    )
    figure.suptitle(caption, fontsize=10)
    grid = figure.add_gridspec(
        rows, 2 if view is not None else 1, width_ratios=(9, 5) if view is not None else None
    )
    if view is not None:
        ax = figure.add_subplot(grid[:, 0])
        ax.imshow(view)
        ax.axis("off")
    for row, (title, image_db, low, high, name) in enumerate(images):
        ax = figure.add_subplot(
            grid[row, -1], xlabel="azimuth [degrees]", ylabel="zenith [degrees]", title=title
        )
        drawn = ax.imshow(image_db, extent=(-180, 180, 180, 0), vmin=low, vmax=high, cmap=name, aspect="auto")
        figure.colorbar(drawn, ax=ax, label="dB")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return data.getvalue()


def named_colours(index: np.ndarray) -> np.ndarray:
    """A colour (..., 3) uint8 for each index (...), neighbours in index far apart in hue."""
    import colorsys

    hues = [colorsys.hsv_to_rgb((0.61803399 * k) % 1.0, 0.5, 0.9) for k in range(int(index.max()) + 1)]
    return np.round(np.array(hues) * 255).astype(np.uint8)[index]


def splats(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Arrays that viser draws: ``centers`` (N, 3), ``covariances`` (N, 3, 3), ``rgbs`` (N, 3), ``opacities`` (N, 1)."""
    turned = gaussians.rotations * gaussians.scales[:, None, :]
    base = gaussians.sh[:, 0, :3] * 0.28209479177387814 + 0.5
    return {
        "centers": gaussians.means,
        "covariances": turned @ np.swapaxes(turned, 1, 2),
        "rgbs": np.clip(base, 0.0, 1.0),
        "opacities": gaussians.opacities[:, None],
    }


def lobe_mesh(
    centre: np.ndarray,
    directions: np.ndarray,
    lobe: np.ndarray,
    radius_m: float = 1.5,
    range_db: float = 20.0,
) -> tuple[np.ndarray, np.ndarray]:
    """A beam's power gain (K, M) along ``directions`` (K, M, 3) as triangles: the radius falls to 0 over ``range_db``."""
    gain_db = 10.0 * np.log10(np.maximum(lobe / lobe.max(), 1e-9))
    radius = radius_m * np.clip(1.0 + gain_db / range_db, 0.0, 1.0)
    rows, columns = lobe.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return (centre + radius[..., None] * directions).reshape(-1, 3), faces
