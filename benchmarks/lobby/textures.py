"""Seeded procedural textures: what the lobby's surfaces look like.

A texture is an sRGB image in [0, 1], row 0 at the top, painted for one face at its real size in metres. Every style
carries detail at all scales from a few texels to half a metre that never repeats, since structure from motion matches
nothing on a plain or periodic wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.device import require

LIFT = 0.75  # exponent that brightens all but the ceiling, so that the walls are not dark beside the light
FINE = 0.05  # m: detail below this deviation of a Gaussian window is damped
FINE_CONTRAST = 0.35
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Layer:
    """A random field of a colour; see :func:`octaves`. ``along``: the pattern runs along the face's longer side."""

    colour: Colour
    coarsest: float = 0.8
    finest: float = 0.02
    stretch: tuple[float, float] = (1.0, 1.0)
    along: bool = False


@dataclass(frozen=True)
class Shapes:
    """Random shapes: how many a square metre, their sizes [m], and their colours, or the range and number of random ones."""

    density: float
    sizes: tuple[float, float]
    colours: tuple[Colour, ...] | tuple[float, float, int]
    kind: str = "polygon"

    def palette(self, rng: np.random.Generator) -> np.ndarray:
        """Colours, shape ``(C, 3)``."""
        if isinstance(self.colours[0], tuple):
            return np.array(self.colours)
        low, high, count = self.colours
        return rng.uniform(low, high, (int(count), 3))


@dataclass(frozen=True)
class Style:
    """Layers on a base colour, shapes over them, posters, and a grain: its strength and coarsest wavelength [m]."""

    base: Colour
    layers: tuple[Layer, ...]
    shapes: Shapes
    grain: tuple[float, float] | None
    posters: bool = False


STYLES = {
    "terrazzo": Style(
        (0.68, 0.65, 0.6),
        (Layer((0.07, 0.07, 0.08), coarsest=1.5),),
        Shapes(30, (0.04, 0.3), (
            (0.9, 0.88, 0.85), (0.3, 0.27, 0.25), (0.62, 0.42, 0.33), (0.45, 0.5, 0.55), (0.8, 0.7, 0.5), (0.15, 0.15, 0.15),
        )),
        (0.05, 0.3),
    ),
    "concrete": Style(
        (0.62, 0.62, 0.6),
        (Layer((0.13, 0.13, 0.12)), Layer((0.05, 0.045, 0.03), coarsest=2, stretch=(4, 1))),
        Shapes(6, (0.03, 0.35), ((0.35, 0.33, 0.3), (0.5, 0.45, 0.38), (0.82, 0.82, 0.8), (0.25, 0.25, 0.25))),
        (0.06, 0.2),
    ),
    "plaster": Style(
        (0.74, 0.7, 0.62),
        (Layer((0.1, 0.1, 0.11)), Layer((0.05, 0.03, -0.03), coarsest=3, finest=0.3)),
        Shapes(10, (0.03, 0.3), (0.25, 0.95, 9)),
        (0.05, 0.2),
        posters=True,
    ),
    # Backlit printed fabric: bright, with shapes at every scale. The image is also its radiance.
    "ceiling": Style(
        (0.74, 0.74, 0.72),
        (Layer((0.09, 0.09, 0.09), coarsest=2),),
        Shapes(24, (0.05, 0.6), (
            (0.95, 0.93, 0.88), (0.55, 0.57, 0.6), (0.7, 0.66, 0.58), (0.85, 0.87, 0.9), (0.36, 0.3, 0.28),
        )),
        (0.05, 0.4),
    ),
    "wood": Style(
        (0.62, 0.46, 0.32),
        (Layer((0.13, 0.11, 0.09), coarsest=0.6, stretch=(5, 1), along=True),),
        Shapes(
            35, (0.03, 0.3), ((0.3, 0.2, 0.12), (0.75, 0.6, 0.42), (0.45, 0.3, 0.2), (0.85, 0.75, 0.6)), "rectangle"
        ),
        (0.06, 0.25),
    ),
    "textile": Style(
        (0.45, 0.5, 0.6), (Layer((0.09, 0.08, 0.08)),), Shapes(45, (0.04, 0.35), (0.15, 0.9, 8)), (0.06, 0.2)
    ),
    "metal": Style(
        (0.6, 0.62, 0.65),
        (Layer((0.09, 0.09, 0.09), coarsest=0.6, stretch=(1, 4)),),
        Shapes(40, (0.04, 0.3), (0.1, 0.95, 8), "rectangle"),
        (0.05, 0.3),
    ),
    "foliage": Style(
        (0.3, 0.42, 0.22),
        (Layer((0.06, 0.08, 0.04)),),
        Shapes(250, (0.03, 0.2), (
            (0.25, 0.4, 0.15), (0.5, 0.62, 0.3), (0.7, 0.72, 0.4), (0.15, 0.25, 0.12), (0.8, 0.45, 0.4),
        ), "ellipse"),
        None,
    ),
}  # fmt: skip


def octaves(
    height: int,
    width: int,
    texel: float,
    rng: np.random.Generator,
    *,
    finest: float = 0.02,
    coarsest: float = 0.8,
    slope: float = 1.0,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Random field of unit deviation with wavelengths from ``finest`` to ``coarsest`` [m], shape ``(height, width)``.

    The amplitude falls with the frequency to the power ``slope``: 1 gives each octave the same share. ``stretch``
    lengthens the pattern along (vertical, horizontal).
    """
    fy = np.fft.fftfreq(height, texel)[:, None] * stretch[0]
    fx = np.fft.rfftfreq(width, texel)[None, :] * stretch[1]
    f = np.hypot(fy, fx)
    amplitude = np.where((f > 1 / coarsest) & (f < 1 / finest), np.maximum(f, 1e-9) ** -slope, 0)
    phase = np.fft.rfft2(rng.standard_normal((height, width)))
    field = np.fft.irfft2(phase * amplitude, s=(height, width))
    return field / max(float(field.std()), 1e-12)


def _scatter(
    image: np.ndarray,
    texel: float,
    rng: np.random.Generator,
    *,
    density: float,
    sizes: tuple[float, float],
    palette: np.ndarray,
    kind: str = "polygon",
) -> np.ndarray:
    """Draw random shapes over ``image``: ``density`` a square metre, ``sizes`` [m] drawn log-uniformly."""
    drawing = require("PIL.ImageDraw", extra="photos")
    pil = require("PIL.Image", extra="photos")
    height, width = image.shape[:2]
    canvas = pil.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    draw = drawing.Draw(canvas)
    for _ in range(rng.poisson(density * height * width * texel**2)):
        size = sizes[0] * (sizes[1] / sizes[0]) ** rng.random() / texel
        x, y = rng.random() * width, rng.random() * height
        tone = palette[rng.integers(len(palette))] + rng.normal(0, 0.05, 3)
        fill = tuple(int(v) for v in np.clip(255 * tone, 0, 255))
        if kind == "polygon":
            n = int(rng.integers(3, 8))
            angle = np.sort(rng.random(n)) * 2 * np.pi
            radius = size / 2 * rng.uniform(0.6, 1.0, n)
            draw.polygon(
                [(x + r * np.cos(a), y + r * np.sin(a)) for r, a in zip(radius, angle, strict=True)], fill
            )
        elif kind == "ellipse":
            a, b = size / 2 * rng.uniform(0.4, 1.0, 2)
            draw.ellipse([x - a, y - b, x + a, y + b], fill)
        else:
            a, b = size / 2, size / 2 * rng.uniform(0.3, 1.0)
            draw.rectangle([x - a, y - b, x + a, y + b], fill)
    return np.asarray(canvas, dtype=np.float64) / 255


def _poster(
    image: np.ndarray, texel: float, rng: np.random.Generator, left: float, top: float, w: float, h: float
) -> None:
    """Paint one poster, ``w`` x ``h`` metres: random shapes above lines of text-like blocks."""
    r0, c0 = int(top / texel), int(left / texel)
    r1, c1 = min(image.shape[0], r0 + int(h / texel)), min(image.shape[1], c0 + int(w / texel))
    if r1 - r0 < 8 or c1 - c0 < 8:
        return
    poster = np.ones((r1 - r0, c1 - c0, 3)) * rng.uniform(0.35, 0.95, 3)
    poster = _scatter(
        poster,
        texel,
        rng,
        density=60,
        sizes=(0.05, 0.5),
        palette=rng.uniform(0.05, 1, (7, 3)),
        kind="polygon",
    )
    ink, paper = (0.1, 0.9) if rng.random() < 0.5 else (0.92, 0.15)
    line = max(2, int(0.03 / texel))
    row = int(poster.shape[0] * rng.uniform(0.6, 0.75))
    poster[row:] = paper
    while row + line < poster.shape[0] - 1:
        col = 2
        while col < poster.shape[1] - 4:
            word = int(rng.integers(2, 9))
            poster[row + 1 : row + line, col : col + word] = ink
            col += word + int(rng.integers(1, 4))
        row += line + max(1, line // 2)
    image[r0:r1, c0:c1] = poster


def _styled(style: Style, h: int, w: int, texel: float, rng: np.random.Generator) -> np.ndarray:
    image = np.ones((h, w, 3)) * style.base
    for layer in style.layers:
        turned = layer.along and w > h
        stretch = layer.stretch[::-1] if turned else layer.stretch
        pattern = octaves(h, w, texel, rng, finest=layer.finest, coarsest=layer.coarsest, stretch=stretch)
        image += pattern[..., None] * np.asarray(layer.colour)
    shapes = style.shapes
    palette = shapes.palette(rng)
    image = _scatter(
        image, texel, rng, density=shapes.density, sizes=shapes.sizes, palette=palette, kind=shapes.kind
    )
    wide, tall = w * texel, h * texel
    if style.posters and wide > 1.5 and tall > 1.5:
        left = rng.uniform(0.2, 0.6)
        while left < wide - 0.8:
            pw, ph = rng.uniform(0.6, 1.2), rng.uniform(0.8, 1.4)
            _poster(image, texel, rng, left, max(0.0, tall - 2.4 + rng.uniform(-0.4, 0.5)), pw, ph)
            left += pw + rng.uniform(0.2, 0.8)
    if style.grain is None:
        return image
    strength, coarsest = style.grain
    return image + strength * octaves(h, w, texel, rng, coarsest=coarsest)[..., None]


def _brick(h: int, w: int, texel: float, rng: np.random.Generator) -> np.ndarray:
    image = np.ones((h, w, 3)) * (0.78, 0.75, 0.7)
    row = 0
    while row < h:
        tall = int(rng.uniform(0.07, 0.2) / texel)
        col = -int(rng.uniform(0, 0.3) / texel)
        while col < w:
            long = int(rng.uniform(0.12, 0.5) / texel)
            tone = np.array([0.66, 0.4, 0.3]) * rng.uniform(0.5, 1.35) + rng.normal(0, 0.05, 3)
            image[row : row + tall - 1, max(col, 0) : max(col + long - 1, 0)] = tone
            col += long
        row += tall
    return image + 0.08 * octaves(h, w, texel, rng, coarsest=0.3)[..., None]


def _glass(h: int, w: int, texel: float, rng: np.random.Generator) -> np.ndarray:
    """Frosted glass printed with a skyline under a cloudy sky, above a hedge."""
    y = np.linspace(0, 1, h)[:, None] * np.ones((1, w))
    image = np.ones((h, w, 3)) * (0.55, 0.7, 0.85)
    image += octaves(h, w, texel, rng, coarsest=1.5)[..., None] * (0.12, 0.1, 0.07)
    image += y[..., None] * (0.2, 0.1, 0)
    for _ in range(int(w * texel * 5)):
        left, wide = int(rng.random() * w), int(rng.uniform(0.3, 1.0) / texel)
        top = int(h * rng.uniform(0.2, 0.75))
        image[top:, left : left + wide] = rng.uniform(0.3, 0.8) + rng.normal(0, 0.06, 3)
        for _ in range(int(rng.integers(4, 22))):
            r, c = top + int(rng.random() * (h - top)), left + int(rng.random() * wide)
            image[r : r + int(rng.uniform(3, 12)), c : min(c + int(rng.uniform(3, 9)), left + wide)] = (
                rng.random(3)
            )
    image = _scatter(image, texel, rng, density=9, sizes=(0.05, 0.35), palette=rng.uniform(0.2, 0.95, (8, 3)))
    foliage = np.array([[0.2, 0.35, 0.15], [0.4, 0.55, 0.25], [0.6, 0.65, 0.35], [0.15, 0.22, 0.1]])
    low = int(0.72 * h)
    image[low:] = _scatter(
        image[low:], texel, rng, density=90, sizes=(0.04, 0.3), palette=foliage, kind="ellipse"
    )
    return image + 0.05 * octaves(h, w, texel, rng, coarsest=0.4)[..., None]


PAINTED = {"brick": _brick, "glass": _glass}
"""Styles that are more than layers and shapes."""


def soften(image: np.ndarray, texel: float) -> np.ndarray:
    """``image`` with its contrast below `FINE` damped to `FINE_CONTRAST`: surfaces of a room are smooth up close."""
    pad = [min(n - 1, round(3 * FINE / texel)) for n in image.shape[:2]]
    padded = np.pad(image, [(pad[0], pad[0]), (pad[1], pad[1]), (0, 0)], mode="reflect")
    height, width = padded.shape[:2]
    f2 = np.fft.fftfreq(height, texel)[:, None] ** 2 + np.fft.rfftfreq(width, texel)[None, :] ** 2
    gain = FINE_CONTRAST + (1 - FINE_CONTRAST) * np.exp(-2 * (np.pi * FINE) ** 2 * f2)
    spectrum = np.fft.rfft2(padded, axes=(0, 1)) * gain[..., None]
    out = np.fft.irfft2(spectrum, s=(height, width), axes=(0, 1))
    return out[pad[0] : pad[0] + image.shape[0], pad[1] : pad[1] + image.shape[1]]


def paint(style: str, width_m: float, height_m: float, texel: float, rng: np.random.Generator) -> np.ndarray:
    """One face's texture in ``style``, shape ``(rows, columns, 3)``, sRGB in (0, 1).

    Raises:
        ValueError: for an unknown style.
    """
    if style not in {**STYLES, **PAINTED}:
        raise ValueError(f"style: got {style!r}, expected one of {', '.join(sorted({**STYLES, **PAINTED}))}")
    rows, columns = max(4, round(height_m / texel)), max(4, round(width_m / texel))
    if style in PAINTED:
        image = PAINTED[style](rows, columns, texel, rng)
    else:
        image = _styled(STYLES[style], rows, columns, texel, rng)
    if style == "ceiling":
        image = np.clip(image, 0.3, 0.97)
    image = np.clip(soften(image, texel), 0.02, 0.97)
    return image if style == "ceiling" else image**LIFT
