"""The picture of what passes walls and goes round edges: maps of a flat and of a street corner, with and without.

Usage::

    python tools/docs/walls_and_edges.py     # writes docs/pictures/walls_and_edges.png, in a minute
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import warprrf as wr

PICTURE = Path(__file__).parents[2] / "docs" / "pictures" / "walls_and_edges.png"
PARTITIONS = [
    [(4, 0), (4, 2.6)], [(4, 3.4), (4, 7)], [(4, 4), (6.4, 4)], [(7.2, 4), (10, 4)], [(7, 0), (7, 1.6)], [(7, 2.4), (7, 4)],
]  # fmt: skip


def upright(ground: list[tuple[float, float]], height: float) -> list[np.ndarray]:
    """Upright rectangles (4, 3) over the legs of a line on the ground."""
    return [
        np.array([[*a, 0.0], [*b, 0.0], [*b, height], [*a, height]])
        for a, b in zip(ground, ground[1:], strict=False)
    ]


def level(x: float, y: float, z: float) -> np.ndarray:
    """A level rectangle (4, 3) from the origin's side, or about it for negative corners."""
    low = np.minimum([x, y], 0.0) if x > 0 else np.array([x, y])
    high = np.abs([x, y])
    return np.array([[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]])


def scene_of(parts: list[tuple[wr.Material, list[np.ndarray]]]) -> wr.Scene:
    """A scene of rectangles, each material's own."""
    corners = np.concatenate([r for _, rectangles in parts for r in rectangles])
    faces = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners) // 4)[:, None, None]).reshape(
        -1, 3
    )
    owner = np.repeat(np.arange(len(parts)), [2 * len(rectangles) for _, rectangles in parts])
    return wr.Scene(wr.Mesh(corners, faces), [material for material, _ in parts], owner)


def chart(scene: wr.Scene, x: np.ndarray, y: np.ndarray, free: np.ndarray, height: float, **link: Any) -> Any:
    """Total path gain [dB] at ``x``, ``y`` where they are ``free``; NaN elsewhere and where no path leads."""
    found = np.full(x.shape, np.nan)
    places = np.column_stack([x[free], y[free], np.full(free.sum(), height)])
    with np.errstate(divide="ignore"):
        found[free] = 10.0 * np.log10(wr.trace_paths(scene, receivers=places, **link).power.sum(axis=1))
    return np.where(np.isfinite(found), found, np.nan)


def draw() -> Any:
    """The four maps."""
    concrete, plaster = wr.em.itu_material("concrete"), wr.em.itu_material("plasterboard")
    outline: list[tuple[float, float]] = [(0, 0), (10, 0), (10, 7), (0, 7), (0, 0)]
    shell = [*upright(outline, 2.6), level(10, 7, 0.0), level(10, 7, 2.6)]
    flat = scene_of([(concrete, shell), (plaster, [w for line in PARTITIONS for w in upright(line, 2.6)])])
    blocks = [
        wall
        for sx in (-1, 1)
        for sy in (-1, 1)
        for wall in upright(
            [(6 * sx, 6 * sy), (40 * sx, 6 * sy), (40 * sx, 40 * sy), (6 * sx, 40 * sy), (6 * sx, 6 * sy)],
            25.0,
        )
    ]
    town = scene_of([(concrete, [*blocks, level(-60, -60, 0.0)])])
    figure, axes = plt.subplots(2, 2, figsize=(9, 7.2), layout="constrained")
    flat_link = {"transmitter": [1.53, 5.47, 1.8], "frequency_hz": 5e9, "mirror_order": 2}
    town_link = {"transmitter": [-30.3, 1.2, 4.0], "frequency_hz": 3.5e9, "mirror_order": 1}
    x, y = np.meshgrid(np.arange(0.1, 10, 0.2), np.arange(0.1, 7, 0.2))
    u, v = np.meshgrid(np.arange(-39.5, 40, 1.0), np.arange(-39.5, 40, 1.0))
    street = (np.abs(u) < 5.6) | (np.abs(v) < 5.6)
    rows = (
        (flat, x, y, x > 0, 1.2, flat_link, {"transmissions": 3}, (0, 10, 0, 7), (-110, -40), PARTITIONS),
        (town, u, v, street, 1.5, town_link, {"diffractions": 1}, (-40, 40, -40, 40), (-140, -60), []),
    )
    for row, (scene, a, b, free, height, link, on, extent, (low, high), lines) in zip(
        axes, rows, strict=True
    ):
        for ax, more in zip(row, ({}, on), strict=True):
            gain = chart(scene, a, b, free, height, **link, **more)
            shown = ax.imshow(gain, origin="lower", extent=extent, vmin=low, vmax=high, cmap="viridis")
            for line in lines:
                ax.plot(*np.transpose(line), color="white", lw=1.2)
            ax.plot(*link["transmitter"][:2], "^", color="#c4570f", ms=7)
            words = (
                ", ".join(f"{name}={count}" for name, count in more.items()) or "line of sight and mirrors"
            )
            ax.set(title=words, facecolor="0.85", xlabel="x [m]", ylabel="y [m]")
        figure.colorbar(shown, ax=row, label="path gain [dB]")
    return figure


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*not modelled, which matters")
        draw().savefig(PICTURE, dpi=80)
