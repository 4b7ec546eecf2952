"""What taking a ray's interaction point from a Gaussian costs in error, and what it saves: one row per option.

The paper stands the centre of the dominant Gaussian in for the surface. Rows compare it with the peak of that Gaussian
on the ray, with the blended expected depth, and with the mesh hit, against rays cast at the true surface.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from warprrf.device import Progress, check_array
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic.interaction import INTERACTION_POINTS, interaction_points, path_lengths
from warprrf.rf.fields.harmonic.transport import transport
from warprrf.rf.spectra.spectrum import pixel_directions

REPEATS = 3  # the fastest of so many runs is quoted


def interaction_point_rows(
    geometry: Any,
    true_mesh: Mesh,
    *,
    transmitter: Any,
    receivers: Any,
    shape: tuple[int, int] = (60, 120),
    device: Any = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Length error and cost of every interaction point.

    Args:
        geometry: reconstruction, anything with ``.gaussians`` and ``.mesh``.
        true_mesh: surface to compare with.
        transmitter: position [m], shape ``(3,)``.
        receivers: positions [m], shape ``(R, 3)``.
        shape: rows and columns of the spectra.

    Returns:
        A dict per option: ``interaction_point``; ``length_error_median_m``, ``length_error_p90_m`` of the single-bounce
        length over pixels that both surfaces meet, weighted by nothing; ``delay_error_median_ns``;
        ``milliseconds_per_receiver``, blending weights apart, which all options share and which take
        ``weights_milliseconds_per_receiver``.
    """
    positions = check_array("receivers", receivers, (None, 3))
    source = check_array("transmitter", transmitter, (3,))
    transport(geometry.gaussians, positions[:1], shape, device=device)  # compile outside the clock
    start = time.perf_counter()
    seen = transport(geometry.gaussians, positions, shape, device=device, progress=progress)
    blending = (time.perf_counter() - start) / len(positions)
    size = (len(positions), *seen.shape, 3)
    truth = true_mesh.cast(
        np.broadcast_to(positions[:, None, None], size).reshape(-1, 3),
        np.broadcast_to(pixel_directions(seen.shape), size).reshape(-1, 3),
        device=device,
    )
    exact = path_lengths(truth.point.reshape(size), source, positions).total
    rows = []
    for kind in INTERACTION_POINTS:
        if kind == "mesh" and geometry.mesh is None:
            continue
        fastest = np.inf
        for _ in range(REPEATS):
            start = time.perf_counter()
            points = interaction_points(seen, geometry.gaussians, kind, mesh=geometry.mesh, device=device)
            lengths = path_lengths(points, source, positions).total
            fastest = min(fastest, time.perf_counter() - start)
        error = np.abs(lengths - exact)
        error = error[np.isfinite(error)]
        rows.append(
            {
                "interaction_point": kind,
                "length_error_median_m": float(np.median(error)),
                "length_error_p90_m": float(np.percentile(error, 90)),
                "delay_error_median_ns": float(np.median(error) / SPEED_OF_LIGHT * 1e9),
                "milliseconds_per_receiver": 1e3 * fastest / len(positions),
                "weights_milliseconds_per_receiver": 1e3 * blending,
            }
        )
    return rows
