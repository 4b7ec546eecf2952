"""An L-shaped office with a meeting room behind glass, drawn as many scenes are: each wall a single sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from radio_scenes import box_mesh

CARRIER_HZ = 28e9
TRANSMITTER = (1.0, 6.0, 2.5)
GLASS_X, HEIGHT = 6.5, 2.8
CORNERS = np.array([[0, 0], [9, 0], [9, 3.5], [5, 3.5], [5, 7], [0, 7.0]])
BEHIND_GLASS = np.array([[7.2, 0.8, 1.2], [7.8, 2.6, 1.4], [8.4, 1.7, 1.3], [7.0, 3.0, 1.1]])
BEFORE_GLASS = np.array(
    [[3.0, 5.0, 1.2], [4.2, 2.0, 1.4], [1.0, 1.0, 1.3], [5.8, 1.2, 1.5], [2.2, 3.2, 1.1], [4.4, 6.2, 1.3]]
)


def office(folder: Path) -> Path:
    """``office.obj`` in ``folder``; its materials are named after ITU-R P.2040's."""
    k = np.arange(len(CORNERS))
    floor, ceiling = (np.column_stack([CORNERS, np.full(len(k), z)]) for z in (0.0, HEIGHT))
    level = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 4], [0, 4, 5]])
    after = np.roll(k, -1)
    walls = np.concatenate([np.column_stack([k, after, after + 6]), np.column_stack([k, after + 6, k + 6])])
    pane = np.array([[GLASS_X, y, z] for y, z in ((0, 0), (3.5, 0), (3.5, HEIGHT), (0, HEIGHT))])
    parts = [
        ("concrete", floor, level),
        ("ceiling_board", ceiling, level[:, ::-1]),
        ("plasterboard", np.concatenate([floor, ceiling]), walls[:, ::-1]),
        ("glass", pane, np.array([[0, 1, 2], [0, 2, 3]])),
        ("wood", *box_mesh([1.5, 3.5, 0.7], [3.0, 4.3, 0.75])),
        ("chipboard", *box_mesh([0.05, 2.0, 0.0], [0.5, 3.0, 1.9])),
    ]
    lines, first = [], 1
    for name, vertices, faces in parts:
        lines += [f"o {name}", f"usemtl {name}", *("v " + " ".join(map(str, v)) for v in vertices)]
        lines += ["f " + " ".join(map(str, f + first)) for f in faces]
        first += len(vertices)
    path = folder / "office.obj"
    path.write_text("\n".join(lines) + "\n")
    return path
