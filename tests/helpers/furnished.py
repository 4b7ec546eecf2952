"""A furnished room of 5 x 4 x 3 m, places in it, and spectra there by the exact engine."""

import numpy as np
from radio_scenes import RadioScene, SlabMaterial, box_mesh, exact_spectra, joined

F, SHAPE, SIGMA = 300e9, (24, 48), np.radians(5.0)
TX = np.array([0.8, 0.9, 2.2])
RECEIVERS = np.array(
    [[4.2, 3.1, 1.2], [1.4, 3.4, 1.7], [3.2, 0.6, 0.8], [4.4, 1.3, 1.9], [0.9, 2.6, 0.9], [3.6, 3.3, 2.1],
     [2.2, 0.7, 1.5], [4.5, 2.2, 1.0], [1.8, 1.1, 1.1], [2.6, 3.5, 1.4]]
)  # fmt: skip
"""The block stands between the transmitter and the first."""
ROOM, BLOCK = box_mesh([0, 0, 0], [5, 4, 3], inward=True), box_mesh([2.2, 1.6, 0.0], [3.0, 2.4, 2.4])
MATERIALS = (
    SlabMaterial("walls", 3.0, 0.5, np.inf, 0.5, "directive", 4),
    SlabMaterial("box", 6.0, 0.5, np.inf, 0.8),
)


def furnished(*materials):
    """The room and a block in it, of two ``materials``."""
    mesh, part = joined(ROOM, BLOCK)
    return RadioScene(mesh, part, list(materials or MATERIALS))


def spectra(scene, receivers=RECEIVERS, **options):
    given = {"transmitter": TX, "frequency_hz": F, "shape": SHAPE, "sigma": SIGMA} | options
    return exact_spectra(scene, receivers, **given)
