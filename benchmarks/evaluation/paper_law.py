"""Targets built path by path in the way that favours the paper's law: scattering that falls with (l_prev + l_vd)^-2.

A diffuse path of the exact engine has the path gain of a scatterer: (lambda / 4 pi)^2 G / d1^2 per solid angle at the
receiver, independent of the distance d2 to the receiver, because the footprint grows with it. Here every such path is
multiplied by (d1 / (d1 + d2))^2, which makes it (lambda / (4 pi (d1 + d2)))^2 G: the law of eq. (4), with the same
directional gain G at every point. Line of sight and mirror paths obey that law as they are.

:func:`law_reach` says how much that factor can be worth in a room: how far it varies over the receivers that see a
Gaussian, and how much of that a function of the direction alone can stand in for.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.rf.exact import ExactEngine, strongest_delay_and_departure
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import spread_paths


def paper_law_spectra(
    scene: Scene, like: SpectrumDataset, *, progress: Progress | None = None, device: Any = None
) -> SpectrumDataset:
    """Spectra by the paper's law at the receivers of ``like``, under its transmitter, grid, beam and roles."""
    engine = ExactEngine(
        scene, transmitter=like.transmitter, frequency_hz=like.frequency_hz, shape=like.shape,
        beam_sigma_rad=like.beam_sigma_rad, device=device,
    )  # fmt: skip
    gains, delays, departures = [], [], []
    for k, receiver in enumerate(like.receivers):
        specular, scattered = engine.tracer.trace(receiver, 1), engine.diffuse(receiver)
        point = receiver + scattered.range_m[:, None] * scattered.direction
        before = np.linalg.norm(point - like.transmitter, axis=1)
        power = scattered.power * (before / (before + scattered.range_m)) ** 2
        spread = spread_paths(
            np.concatenate([specular.arrival, scattered.direction]),
            np.concatenate([specular.power, power]),
            like.shape,
            like.beam_sigma_rad,
            device=device,
        )
        first = np.where(specular.kind[:, None] == "los", receiver, np.nan_to_num(specular.vertices[:, 0]))
        rest = specular.length_m - np.linalg.norm(first - like.transmitter, axis=1)
        delay, departure = strongest_delay_and_departure(
            spread.strongest,
            like.transmitter,
            np.concatenate([first, point]),
            np.concatenate([rest, scattered.range_m]),
        )
        gains.append(spread.path_gain.astype(np.float32))
        delays.append(delay)
        departures.append(departure.astype(np.float32))
        if progress is not None:
            progress("simulate", k + 1, len(like))
    return SpectrumDataset.from_spectra(
        receivers=like.receivers,
        transmitter=like.transmitter,
        frequency_hz=like.frequency_hz,
        path_gain=np.stack(gains),
        delay_s=np.stack(delays),
        aod=np.stack(departures),
        line_of_sight=like.line_of_sight,
        beam_sigma_rad=like.beam_sigma_rad,
        engine="exact",
        role=like.role,
        attributes={"depth": 1, "law": "scattering falls with the whole path's length squared"},
    )


def law_reach(
    mesh: Mesh, points: np.ndarray, receivers: np.ndarray, transmitter: np.ndarray, *, degree: int = 3,
    least: int = 60, device: Any = None,
) -> dict[str, float] | None:  # fmt: skip
    """How 20 log10(l_prev + l_vd) varies over the receivers that a point sees [dB].

    Args:
        mesh: what blocks.
        points: centres of Gaussians [m], shape ``(N, 3)``.
        receivers: positions [m], shape ``(R, 3)``.
        transmitter: position [m], shape ``(3,)``.
        degree: of the spherical harmonics of the direction, fitted to it point by point.
        least: receivers that a point must see to count.

    Returns:
        ``"varies_db"``, its standard deviation, and ``"left_db"``, that of what the harmonics leave, both medians over
        the points, ``"points"`` that count and ``"degree"``; None if none counts.
    """
    varies, left = [], []
    for point in points:
        way = receivers[mesh.visible(point, receivers, clearance=0.05, device=device)] - point
        if len(way) < least:
            continue
        length = np.linalg.norm(way, axis=1)
        law = 20.0 * np.log10(np.linalg.norm(point - transmitter) + length)
        x, y, z = way.T / length
        # polynomials of the unit vector, z at most linear: the harmonics up to that degree span the same functions
        basis = np.stack(
            [
                x**i * y**j * z**k
                for k in (0, 1)
                for i in range(degree + 1 - k)
                for j in range(degree + 1 - k - i)
            ],
            axis=1,
        )
        varies.append(law.std())
        left.append((law - basis @ np.linalg.lstsq(basis, law, rcond=None)[0]).std())
    if not varies:
        return None
    return {
        "varies_db": float(np.median(varies)), "left_db": float(np.median(left)), "points": float(len(varies)),
        "degree": float(degree),
    }  # fmt: skip
