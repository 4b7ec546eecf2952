"""Targets built path by path in the way that favours the paper's law: scattering that falls with (l_prev + l_vd)^-2.

A diffuse path of the exact engine has the path gain of a scatterer: (lambda / 4 pi)^2 G / d1^2 per solid angle at the
receiver, independent of the distance d2 to the receiver, because the footprint grows with it. Here every such path is
multiplied by (d1 / (d1 + d2))^2, which makes it (lambda / (4 pi (d1 + d2)))^2 G: the law of eq. (4), with the same
directional gain G at every point. Line of sight and mirror paths obey that law as they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.rf.exact import ExactEngine, strongest_delay_and_departure
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset


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
        spread = engine.spread(specular, replace(scattered, power=power))
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
