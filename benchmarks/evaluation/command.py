"""The commands `warprrf bench table1` and `warprrf bench sparsity`; they share one folder and its finished runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.evaluation import comparison, report
from benchmarks.evaluation.methods import METHODS, Effort
from benchmarks.evaluation.paper_law import law_reach, paper_law_spectra
from benchmarks.evaluation.protocol import SCALES, SPLITS, TRUTHS, Scale, Setting, changed, plan, truth_of
from benchmarks.evaluation.runs import Store, sweep
from benchmarks.machine import machine
from benchmarks.setting import DATA, Geometry, files, scene_of
from benchmarks.stages import StagedRun, fingerprint, plain, write_json
from warprrf.device import Progress
from warprrf.files import write_atomically
from warprrf.marks import code_mark
from warprrf.rf.spectra.dataset import SpectrumDataset

KINDS = ("table1", "sparsity")
OUT = "runs/evaluation"
GEOMETRY = "runs/lobby/reconstruction"
GAUSSIANS_DRAWN = 400  # that stand for all where the reach of the paper's law is found


def run(
    kind: str,
    out: str | os.PathLike[str] = OUT,
    data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = DATA,
    *,
    scale: str = "small",
    geometry: str | os.PathLike[str] = GEOMETRY,
    scene: str | os.PathLike[str] | None = None,
    methods: Sequence[str] | None = None,
    truths: Sequence[str] | None = None,
    splits: Sequence[str] | None = None,
    counts: Sequence[int] | None = None,
    seeds: Sequence[int] | None = None,
    every: int | None = None,
    effort: Effort | None = None,
    scheduler: str | None = None,
    workers: int = 1,
    device: Any = None,
    fresh: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Carry out the runs that are missing, draw table and pictures, and return the content of ``<kind>.json``.

    Writes ``<kind>.json``, ``<kind>.md``, ``<kind>.csv``, pictures and ``runs/`` into ``out``. A run that was finished
    is not done again unless its data, geometry, options or code changed.

    Args:
        kind: ``"table1"``: every method, beside the published figures; ``"sparsity"``: the paper's figure.
        out: folder of the results, of both commands.
        data: folder with the spectra of each truth and ``scene.xml``, or the spectra's files (NetCDF), one a truth.
        scale: ``"small"``: within an hour on two cores; ``"paper"``: all subsets, seeds and truths, full schedules.
        geometry: folder of a saved reconstruction.
        scene: true scene (XML): for the paper's law and Sionna RT with assumed materials.
        methods, truths, splits, counts, seeds, every, effort: instead of the scale's.
        scheduler: address of a dask scheduler; its workers must see the same files under the same names.
        workers: processes of a local cluster otherwise; 0 works in this process. More than one share the cores, and
            so do their times.
        device: Warp device.
        fresh: forget finished runs.
        progress: ``progress("runs", done, total)``; in this process also the steps of each run.

    Raises:
        ValueError: on bad options, missing or broken data, or another command at work in ``out``.
        ImportError: if an extra is missing: ``plots``; ``baselines``, ``sionna`` and ``cluster`` for what needs them.
        RuntimeError: naming the run that failed.
    """
    chosen = _scale(scale, kind, methods, truths, splits, counts, seeds, every, effort)
    place = Path(geometry)
    if not place.is_dir():
        raise ValueError(
            f"geometry: there is no folder {place}; expected a saved reconstruction, such as warprrf lobby leaves in "
            f"{GEOMETRY}"
        )
    folder = Path(out)
    xml = Path(scene) if scene is not None else scene_of(data)
    measured = [
        t
        for t in ("exact", "sionna")
        if t in chosen.truths or (t == "exact" and "paper-law" in chosen.truths)
    ]
    known: dict[str, Path] = dict(zip(measured, files(data, measured), strict=True))
    with StagedRun(folder, fresh=fresh, progress=progress) as stages:
        if fresh:
            shutil.rmtree(folder / "runs", ignore_errors=True)
        if "paper-law" in chosen.truths:
            known["paper-law"] = _paper_law(stages, xml, known["exact"], device)
        setting = Setting(
            files=tuple((name, str(file.resolve())) for name, file in known.items()),
            marks=tuple((name, fingerprint([file])) for name, file in known.items()),
            geometry=str(place.resolve()),
            geometry_mark=fingerprint([place, Geometry(place, xml, device).scene_mark]),
            scene=str(xml.resolve()),
            scratch=str((folder / "scratch").resolve()),
            every=chosen.every,
            effort=chosen.effort,
            device=None if device is None else str(device),
        )
        about, held = _about(chosen, setting)
        runs = plan(kind, chosen, methods=methods, held=held)
        if not runs:
            raise ValueError("counts, methods: nothing is left to do; expected counts that the data hold")
        store = Store(folder)
        rows = sweep(runs, setting, store, scheduler=scheduler, workers=workers, progress=progress)
        summary = comparison.summarise(rows.values())
        coarse = any(
            a < b for d in about.values() for a, b in zip(d["shape"], chosen.least_shape, strict=True)
        )
        found: dict[str, Any] = {
            "kind": kind,
            "scale": chosen.name,
            "coarse": chosen.least_shape if coarse else None,
            "rows": summary,
            "published": [dict(row) for row in report.PUBLISHED],
            "finding": comparison.paper_finding(summary),
            "law_reach": _law_reach(setting, device),
            "ahead": comparison.ours_against_all(summary),
            "data": about,
            "effort": asdict(chosen.effort),
            "machine": machine(device),
            "seconds": sum(_seconds(row) for row in rows.values()),
        }
        found = dict(plain(found))
        write_json(folder / f"{kind}.json", found)
        report.write(kind, folder, found, store, runs, chosen)
        shutil.rmtree(folder / "scratch", ignore_errors=True)
    return found


def _scale(
    name: str,
    kind: str,
    methods: Sequence[str] | None,
    truths: Sequence[str] | None,
    splits: Sequence[str] | None,
    counts: Sequence[int] | None,
    seeds: Sequence[int] | None,
    every: int | None,
    effort: Effort | None,
) -> Scale:
    for label, value, allowed in (
        ("kind", [kind], KINDS),
        ("scale", [name], tuple(SCALES)),
        ("methods", methods, tuple(METHODS)),
        ("truths", truths, tuple(TRUTHS)),
        ("splits", splits, SPLITS),
    ):
        unknown = [v for v in value or () if v not in allowed]
        if unknown or (value is not None and not value):
            raise ValueError(f"{label}: got {', '.join(unknown) or 'none'}, expected of {', '.join(allowed)}")
    several = None if every is None else [every]
    for label, numbers, least in (("counts", counts, 1), ("seeds", seeds, 0), ("every", several, 1)):
        if numbers is not None and any(isinstance(n, bool) or n != int(n) or n < least for n in numbers):
            raise ValueError(f"{label}: got {list(numbers)}, expected whole numbers of at least {least}")
    own = None if counts is None else tuple(sorted(set(map(int, counts))))
    return changed(
        SCALES[name],
        truths=None if truths is None else tuple(truths),
        splits=None if splits is None else tuple(splits),
        table_counts=own,
        curve_counts=own,
        region_counts=own,
        network_counts=own,
        opacity_counts=own,
        seeds=None if seeds is None else tuple(map(int, seeds)),
        every=every,
        effort=effort,
    )


def _paper_law(stages: StagedRun, xml: Path, exact: Path, device: Any) -> Path:
    """The file of targets by the paper's law, made from the exact truth's receivers if it is not there."""
    file = stages.folder / "spectra_paper_law.nc"

    def make(progress: Progress) -> dict[str, Any]:
        from warprrf.rf.scene import Scene

        spectra = paper_law_spectra(
            Scene.load(xml), SpectrumDataset.load(exact), progress=progress, device=device
        )
        write_atomically(file, spectra.save)
        return {"receivers": len(spectra)}

    place = Geometry(stages.folder, xml, device)
    inputs = [
        exact,
        place.scene_mark,
        code_mark("benchmarks.evaluation.paper_law"),
    ]
    stages.stage("paper-law", make, inputs=inputs, outputs=(file.name,))
    return file


def _law_reach(setting: Setting, device: Any) -> dict[str, float] | None:
    """What the paper's law can be worth to Gaussians drawn at random, over all receivers of the first truth."""
    data = SpectrumDataset.load(setting.files[0][1])
    known = Geometry(Path(setting.geometry), Path(setting.scene), device).reconstruction
    centres = np.asarray(known.gaussians.means, float)
    drawn = np.random.default_rng(0).choice(len(centres), min(GAUSSIANS_DRAWN, len(centres)), replace=False)
    return law_reach(known.mesh, centres[drawn], data.receivers, data.transmitter, device=device)


def _about(scale: Scale, setting: Setting) -> tuple[dict[str, Any], dict[tuple[str, str], tuple[int, ...]]]:
    """What each truth and split consists of, and the numbers of training receivers that they hold."""
    about: dict[str, Any] = {}
    held: dict[tuple[str, str], tuple[int, ...]] = {}
    for truth in scale.truths:
        data = SpectrumDataset.load(setting.file(truth))
        for split in scale.splits:
            if split != "random" and truth == "paper-law":
                continue
            found = truth_of(truth, setting.mark(truth), data, split, setting.every)
            held[truth, split] = found.counts
            wanted = scale.region_counts if split == "region" else (*scale.table_counts, *scale.curve_counts)
            test = found.test
            about[f"{truth}/{split}"] = {
                "test": len(test),
                "blocked": int(np.count_nonzero(~test.line_of_sight)),
                "train": len(found.counts),
                "left_out": sorted({n for n in wanted if n not in found.counts}),
                "shape": test.shape,
                "frequency_hz": test.frequency_hz,
                "range_db": test.range_db,
                "settings": dict(test.attributes),
            }
    return about, held


def _seconds(row: dict[str, Any]) -> float:
    """About what a run took."""
    each = (row["seconds_per_spectrum"] or 0.0) * row["receivers"]
    return float((row["transport_s"] or 0.0) + (row["fit_s"] or 0.0) + each)
