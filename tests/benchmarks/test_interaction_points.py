"""The table of interaction points on a box whose surface is known exactly."""

from types import SimpleNamespace

import numpy as np

from benchmarks.interaction_points import interaction_point_rows
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.discs import discs_on_mesh


def test_the_mesh_hit_is_exact_and_the_centre_errs_by_a_discs_size() -> None:
    corners = np.array([[x, y, z] for x in (0, 5) for y in (0, 4) for z in (0, 3)], float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh = Mesh(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    geometry = SimpleNamespace(gaussians=discs_on_mesh(mesh, 1500), mesh=mesh)
    rows = interaction_point_rows(
        geometry,
        mesh,
        transmitter=[1.0, 1.0, 2.5],
        receivers=[[3.0, 2.0, 1.2], [1.5, 3.0, 1.0]],
        shape=(16, 32),
    )
    error = {row["interaction_point"]: row["length_error_median_m"] for row in rows}
    assert list(error) == ["centre", "peak", "expected", "mesh"]
    assert error["mesh"] < 1e-9
    assert error["peak"] < error["centre"]
    spacing = np.sqrt(94.0 / 1500)  # m: 94 m^2 of surface
    assert 0.01 * spacing < error["centre"] < spacing
    assert all(row["milliseconds_per_receiver"] > 0 for row in rows)
