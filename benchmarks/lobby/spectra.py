"""The lobby's spectra: one transmitter in a corner, 800 receivers, both engines.

The transmitter hangs at 2.5 m in the north-eastern corner, over the lounge; screen, kiosk, pillars, partition and
gallery throw its shadows. The committed sample is 60 training and 100 test receivers at 60 x 120. The paper's size is
700 and 100 other receivers at 90 x 180, which no design was chosen by; they are made on demand (``*_full.nc``).
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.files import write_text
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import sample_receivers, simulate
from warprrf.rf.spectra.dataset import assign_roles

TRANSMITTER = (13.6, 11.2, 2.5)  # [m]
FREQUENCY_HZ = 300e9
SHAPE, FULL_SHAPE = (60, 120), (90, 180)
RECEIVERS = 800
TEST_RECEIVERS = 100
SAMPLE_TRAINING = 60
SEED, FULL_SEED = 0, 1
FILES = {"exact": "spectra.nc", "sionna": "spectra_sionna.nc"}
"""Committed sample of each engine; sets of the paper's size end in ``_full.nc``."""


@dataclass(frozen=True)
class Plan:
    """Who receives.

    Attributes:
        receivers: Positions [m], shape ``(800, 3)``.
        role: "train" or "test", shape ``(800,)``.
        sample: Indices of the committed receivers, training first, shape ``(160,)``.
    """

    receivers: np.ndarray
    role: np.ndarray
    sample: np.ndarray


def plan(scene: Scene, seed: int = SEED) -> Plan:
    """The 800 receivers of a seed, the same every time for one scene."""
    receivers = np.round(sample_receivers(scene, RECEIVERS, seed=seed), 4)
    role = assign_roles(RECEIVERS, test=TEST_RECEIVERS, seed=seed)
    train, test = np.flatnonzero(role == "train"), np.flatnonzero(role == "test")
    return Plan(receivers, role, np.concatenate([train[:SAMPLE_TRAINING], test]))


def make(
    data: str | os.PathLike[str] = "data/lobby",
    *,
    full: bool = False,
    engines: tuple[str, ...] = ("exact", "sionna"),
    workspace: str | os.PathLike[str] = "runs/data/spectra",
    replace: bool = False,
    client: Any = None,
    progress: Progress | None = None,
    device: Any = None,
) -> None:
    """Write the spectra that are missing, and ``receivers.json`` beside the sample.

    Args:
        data: The lobby's folder, with its scene.
        full: The paper's size instead of the sample: 800 receivers of their own, at full precision.
        engines: Which engines.
        workspace: Folder of finished receivers: a killed run goes on where it stopped.
        replace: Make files that are there already again.
        client: A ``dask.distributed.Client`` whose workers compute.
    """
    folder = Path(data)
    scene = Scene.load(folder / "scene.xml")
    who = plan(scene, FULL_SEED if full else SEED)
    chosen = np.arange(RECEIVERS) if full else who.sample
    if not full:
        _write_receivers(folder / "receivers.json", scene, who)
    for engine in engines:
        target = folder / FILES[engine]
        if full:
            target = target.with_name(f"{target.stem}_full.nc")
        if target.is_file() and not replace:
            continue

        def report(stage: str, done: int, total: int, engine: str = engine) -> None:
            if progress is not None:
                progress(f"{stage} {engine}", done, total)

        simulate(
            scene,
            transmitter=TRANSMITTER,
            receivers=who.receivers[chosen],
            frequency_hz=FREQUENCY_HZ,
            shape=FULL_SHAPE if full else SHAPE,
            engine=engine,
            seed=SEED,
            roles=who.role[chosen],
            workspace=workspace,
            client=client,
            progress=report,
            device=device,
        ).save(target, compact=not full)


def _write_receivers(path: Path, scene: Scene, who: Plan) -> None:
    seen = scene.mesh.visible(np.array(TRANSMITTER), who.receivers)
    text = {
        "transmitter_m": TRANSMITTER,
        "frequency_hz": FREQUENCY_HZ,
        "seed": SEED,
        "sample": who.sample.tolist(),
        "receivers_m": who.receivers.tolist(),
        "role": who.role.tolist(),
        "line_of_sight": seen.tolist(),
    }
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in text.items())
    write_text(path, "{\n" + lines + "\n}\n")
