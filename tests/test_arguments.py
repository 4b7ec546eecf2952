"""What no answer exists for is refused by its name, and public objects survive a pickle."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

import warprrf as wr

GROUND = wr.Mesh([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])
CORNERS = [[x, y, z] for x in (0.0, 5) for y in (0.0, 4) for z in (0.0, 3)]
SIDES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
ROOM = wr.Scene(
    wr.Mesh(CORNERS, [[a, b, c] for p, q, r, s in SIDES for a, b, c in ((p, q, r), (p, r, s))]),
    [wr.Material.conductor()],
    np.zeros(12, int),
)
INSIDE = {"transmitter": (1, 1, 2.5), "receivers": [(2, 2, 1.5)], "frequency_hz": 300e9}
ENDS = {"transmitter": (0, -1, 2.0), "receivers": (0, 1, 2.0), "frequency_hz": 300e9}


def _paths() -> wr.Paths:
    return wr.trace_paths(GROUND, **ENDS)  # type: ignore[arg-type]


def _gaussians() -> wr.Gaussians:
    return wr.Gaussians(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.ones((1, 3)), [0.5], np.zeros((1, 1, 3)))


READINGS = wr.Readings([(1.0, 1, 2.5)], [(2.0, 2, 1.5)], [1e-8], 300e9, floor=1e-15)
REFUSED: dict[str, Callable[[], object]] = {
    "beam_sigma_rad: got 0": lambda: wr.simulate(ROOM, beam_sigma_rad=0, **INSIDE),
    "faces: got none that has an area": lambda: wr.Mesh(np.outer([0, 1, 2], [5, 4, 3]), [[0, 1, 2]]),
    "orientation: got a matrix of determinant -1": lambda: wr.PlanarArray(2, 2, orientation=np.diag([1, 1, -1])),
    "ds: got Readings, expected a SpectrumDataset": lambda: wr.RadioField.fit(ROOM, READINGS, model="rf3dgs+"),
}  # fmt: skip


@pytest.mark.parametrize("told", REFUSED)
def test_what_no_answer_exists_for_is_refused_by_its_name(told: str) -> None:
    with pytest.raises((ValueError, TypeError), match=told):
        REFUSED[told]()


def test_public_objects_survive_a_pickle() -> None:
    ds = wr.simulate(ROOM, shape=(6, 12), **{**INSIDE, "receivers": [(2, 2, 1.5), (4, 1, 1), (3, 3, 2)]})
    fields = [wr.RadioField.fit(ROOM, ds, quick=True), wr.RadioField.fit(ROOM, ds, "rf3dgs+", iterations=2)]
    horn, place = wr.horn(0.2), (2.5, 2, 1.5)
    found = [
        ROOM, ROOM.mesh, ROOM.materials[0], ds, ds[0], READINGS, wr.Air(), wr.Reconstruction.from_files(mesh=ROOM.mesh),
        _paths(), _gaussians(), wr.Camera.spherical(4, 2, position=place), wr.PlanarArray(2, 2, pattern=horn), horn,
        wr.dft_codebook(wr.PlanarArray(2, 2)), wr.GaussianRays(_gaussians()), wr.Rasterizer(device="cpu"), wr.Blending(),
        wr.relevance(ROOM, **INSIDE), fields[0].radio_map(1.5, 1.0), *fields,
        *(getattr(wr.lookups, name)(ds) for name in ("nearest", "idw", "constant", "mean")),
    ]  # fmt: skip
    for one in found:
        again = pickle.loads(pickle.dumps(one))
        assert isinstance(again, type(one))
        if hasattr(one, "spectrum"):
            np.testing.assert_array_equal(again.spectrum(place).path_gain, one.spectrum(place).path_gain)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(horn))([0.0, 0.3]), horn([0.0, 0.3]))
