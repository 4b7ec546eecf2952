"""Public objects say in a line what they are."""

import numpy as np
import pytest
from fuzz.calls import CLASSES, OPTIONS_OF

import warprrf as wr

BUFFERS = {"splats.GaussianRays", "splats.Rasterizer"}
"""What holds buffers of a device, and no data of its own; options are written out."""


@pytest.mark.parametrize("name", sorted(CLASSES.keys() - {*BUFFERS, *OPTIONS_OF}))
def test_it_is_one_line_that_begins_with_the_class(name, place):
    thing = CLASSES[name](place)
    text = repr(thing)
    assert text.startswith(type(thing).__name__ + "(") and "\n" not in text and len(text) < 400


def test_it_says_how_much_there_is(place):
    many = wr.Paths.stack([place.paths.row(0)] * 40)
    for thing, part in (
        (place.spectra, f"({len(place.spectra)} receivers: "),
        (place.scene, f"({len(place.mesh.faces)} faces, "),
        (place.gaussians, f"means ({len(place.gaussians)}, 3)"),
        (wr.render(place.gaussians, place.camera), "alpha (12, 16)"),
        (many, f"gain (40, {many.gain.shape[1]})"),
        (wr.Spectrum(np.zeros((90, 180))), "path_gain (90, 180)"),
        (place.mesh.closest([[0, 0, 1.0]] * 2), "point (2, 3)"),
    ):
        assert part in repr(thing)
