"""A bistatic field of known parameters on a room with a block in it: nothing is fitted."""

from dataclasses import replace

import numpy as np
from furnished import RECEIVERS, TX, furnished
from radio_scenes import RadioScene, SlabMaterial

from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.tracing.model import SETS, Parameters
from warprrf.rf.tracing.surface import Surface

F, SHAPE, SIGMA = 300e9, (30, 60), np.radians(5.0)
SEES, BLOCKED = RECEIVERS[0], np.array([3.6, 3.3, 0.9])
MATERIALS = [
    SlabMaterial("walls", 3.0, 0.0, np.inf, 0.5, "directive", 4),
    SlabMaterial("block/top <1>", 6.0, 0.0, np.inf, 0.8),
    SlabMaterial("nowhere", 2.0, 0.0, np.inf, 0.1),
]
LOBES = (0, 4, 12)


def room() -> RadioScene:
    """Half-spaces that a field and a material can both describe; no face is of the third."""
    return furnished(*MATERIALS)


def known_field(**changes) -> BistaticField:
    """The field of :func:`room`; ``changes`` replace its parts."""
    surface = Surface.of(room())
    tiny = -60.0
    weight = np.full((3, len(LOBES)), tiny)
    weight[0, 1], weight[1, 0], weight[2, 0] = np.log(0.25), np.log(0.64), np.log(0.01)
    given = {
        "surface": surface,
        "transmitter": TX,
        "frequency_hz": F,
        "shape": SHAPE,
        "floor": 1e-17,
        "range_db": (-170.0, -80.0),
        "beam_sigma_rad": SIGMA,
        "effects": replace(SETS["single"], residual=False),
        "parameters": Parameters(weight, np.log([2.0, 5.0, 1.0]), np.log([0.75, 0.36, 0.99]), LOBES),
        "material": surface.material,
        "residual": np.zeros((2, len(surface.cells))),
    }
    return BistaticField(**(given | changes))
