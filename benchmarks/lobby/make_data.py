"""``make data``: the lobby from nothing: scene, photos and spectra, each step resumable."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.lobby import photos, scene, spectra
from warprrf.device import Progress

STEPS = ("scene", "photos", "spectra")


def run(
    data: str | os.PathLike[str] = "data/lobby",
    *,
    steps: Sequence[str] | None = None,
    full: bool = False,
    progress: Progress | None = None,
    device: Any = None,
) -> None:
    """Make what is missing of the named steps (default: all, in order).

    Args:
        data: folder to write.
        steps: of ``"scene"``, ``"photos"``, ``"spectra"``.
        full: also all 800 receivers, beside the committed sample (``*_full.nc``).
        progress: ``progress(stage, done, total)``.
        device: Warp device of the exact engine.

    Raises:
        ValueError: for an unknown step, or photos and spectra without a scene.
        ImportError: if the extra ``sionna`` is not installed.
    """
    wanted = STEPS if steps is None else tuple(steps)
    unknown = sorted(set(wanted) - set(STEPS))
    if unknown:
        raise ValueError(f"steps: got {', '.join(unknown)}, expected some of {', '.join(STEPS)}")
    data = Path(data)
    if "scene" in wanted:
        scene.build(data, progress=progress)
    if not (data / "scene.xml").is_file():
        raise ValueError(f"data: {data} holds no scene.xml; make the scene first (step scene)")
    if "photos" in wanted:
        photos.make_photos(data, progress=progress)
    if "spectra" in wanted:
        for whole in (False, True) if full else (False,):
            spectra.make(data, full=whole, progress=progress, device=device)
