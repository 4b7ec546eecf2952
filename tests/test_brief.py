"""Public objects say in a line what they are."""

from __future__ import annotations

import numpy as np
import pytest

import warprrf as wr


@pytest.fixture(scope="module")
def shown() -> dict[str, str]:
    ground = wr.Mesh([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])
    ends = {"transmitter": (0, -1, 2.0), "frequency_hz": 300e9}
    gaussians = wr.Gaussians(
        np.zeros((2, 3)), [[1.0, 0, 0, 0]] * 2, np.ones((2, 3)), [0.5, 0.5], np.zeros((2, 1, 3))
    )
    camera = wr.Camera.spherical(8, 4, position=(0, 0, 5.0))
    things = [
        ground,
        ground.closest([[0, 0, 1.0]] * 2),
        wr.Scene(ground, [wr.Material.conductor()], [0]),
        wr.Material.conductor(),
        gaussians,
        camera,
        wr.render(gaussians, camera, device="cpu"),
        wr.trace_paths(ground, receivers=[0, 1, 2.0], **ends),
        wr.trace_paths(ground, receivers=[[0, 1, 2.0]] * 40, **ends),
        wr.Spectrum(np.zeros((90, 180))),
    ]
    return {f"{type(thing).__name__} {k}": repr(thing) for k, thing in enumerate(things)}


def test_it_is_one_line_that_says_how_much_there_is(shown: dict[str, str]) -> None:
    assert [text for text in shown.values() if "\n" in text or len(text) > 400] == []
    assert {
        name.split()[0]: text for name, text in shown.items() if not text.startswith(name.split()[0] + "(")
    } == {}
    for name, part in {
        "Gaussians 4": "means (2, 3)",
        "Rendering 6": "alpha (4, 8)",
        "Paths 8": "gain (40, 2)",
        "Spectrum 9": "path_gain (90, 180)",
        "Closest 1": "point (2, 3)",
    }.items():
        assert part in shown[name]
