"""All rows of the evaluation, each kept in a file of its own once it is there.

A killed run loses the row at which it stood. A row is made again only if something that it depends on changed: data,
geometry, its options, or the code of its own model.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.bistatic import checks, report
from benchmarks.bistatic.methods import HARMONIC, UNTAUGHT, VARIANTS, score, source_of
from benchmarks.bistatic.plots import WHOLE
from benchmarks.machine import machine
from benchmarks.setting import DATA, TRUTHS, Geometry, Truth, files, scene_of
from benchmarks.stages import StagedRun, fingerprint, plain, write_json
from warprrf.device import Progress
from warprrf.files import write_arrays, write_atomically
from warprrf.marks import code_mark
from warprrf.rf.spectra import lookups
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import to_db

COUNTS = (10, 50, 400)
GEOMETRY = "runs/lobby/reconstruction"
SECOND_TRANSMITTER = (2.2, 1.6, 2.5)  # [m], at the other end of the lobby
TIMED_COUNT = 50  # the training receivers that fit times are asked for
REPEAT = 10

Row = dict[str, Any]


def run(
    out: str | os.PathLike[str] = "runs/bistatic",
    data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = DATA,
    *,
    geometry: str | os.PathLike[str] = GEOMETRY,
    scene: str | os.PathLike[str] | None = None,
    second: str | os.PathLike[str] | None = None,
    counts: Sequence[int] = COUNTS,
    truths: Sequence[str] = TRUTHS,
    every: int = 1,
    repeat: int = REPEAT,
    second_at: Sequence[float] = SECOND_TRANSMITTER,
    seed: int = 0,
    device: Any = None,
    fresh: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make every row that is missing, draw table and pictures, and return the content of ``bistatic.json``.

    Writes ``bistatic.json``, ``bistatic.md``, pictures, ``rows/`` (per-receiver figures) and ``fields/`` into ``out``.

    Args:
        out: folder of the results.
        data: folder with the spectra of each truth and ``scene.xml``, or the spectra's files (NetCDF), one a truth.
        geometry: folder of a saved reconstruction.
        scene: true scene (XML): for ablation, delays, repeats and the second transmitter. Default: the one in the
            folder ``data``, or beside the first file, or the lobby's.
        second: spectra of the test receivers under another transmitter; made by the exact engine if there is none.
        counts: training receivers; those that a data set does not hold are left out.
        truths: "exact", "sionna" or both.
        every: take each how-manieth test receiver.
        repeat: test receivers of Sionna's second solve; 0 leaves it out.
        second_at: place of the second transmitter [m], where its spectra are made.
        seed: of the random choices of pixels in the comparison of optimisers.
        device: Warp device.
        fresh: start over instead of continuing.
        progress: ``progress(step, done, total)``, the row's name in front of the step.

    Raises:
        ValueError: on bad options, missing or broken data, or another run at work in ``out``.
        ImportError: if the extra ``plots`` is missing, or ``sionna`` where Sionna's truth is repeated.
    """
    for name, value, least in (("every", every, 1), ("repeat", repeat, 0)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name}: got {value!r}, expected a whole number of at least {least}")
    unknown = [name for name in truths if name not in TRUTHS]
    if unknown or not truths:
        raise ValueError(f"truths: got {list(truths)!r}, expected one or both of {', '.join(TRUTHS)}")
    folder = Path(geometry)
    if not folder.is_dir():
        raise ValueError(
            f"geometry: there is no folder {folder}; expected a saved reconstruction, such as warprrf lobby leaves in "
            f"{GEOMETRY}"
        )
    known = [Truth.load(file, tuple(counts), int(every)) for file in files(data, truths)]
    place = Geometry(folder, Path(scene) if scene is not None else scene_of(data), device)
    with _Rows(Path(out), fresh, progress) as rows:
        return _Bench(rows, place, [t for name in truths for t in known if t.name == name], int(seed)).report(
            None if second is None else Path(second), tuple(map(float, second_at)), int(repeat)
        )


class _Rows:
    """Rows as stages of a run, one JSON file each."""

    def __init__(self, folder: Path, fresh: bool, progress: Progress | None) -> None:
        self.folder = folder
        self._progress, self._name = progress, ""
        self._stages = StagedRun(folder, fresh=fresh, progress=self._tell)

    def __enter__(self) -> _Rows:
        self._stages.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stages.__exit__(*error)

    def _tell(self, step: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(f"{self._name}: {step}", done, total)

    def row(
        self,
        name: str,
        work: Callable[[Progress], Row],
        inputs: Iterable[Any],
        outputs: Iterable[str] = (),
    ) -> Row:
        """The row ``name``, from its file or from ``work``; see :meth:`StagedRun.stage`."""
        file = f"rows/{name}.json"
        self._name = name

        def make(progress: Progress) -> Row:
            write_json(self.folder / file, work(progress))
            return {}

        self._stages.stage(name, make, inputs=inputs, outputs=(file, *outputs))
        found: Row = json.loads((self.folder / file).read_text())
        return found

    @property
    def seconds(self) -> float:
        return self._stages.seconds()


class _Bench:
    """One evaluation: which rows there are, and what each depends on."""

    def __init__(self, rows: _Rows, geometry: Geometry, truths: list[Truth], seed: int) -> None:
        self.rows, self.geometry, self.truths, self.seed = rows, geometry, truths, seed
        self.code = {method: source_of(method) for method in VARIANTS}
        self.checks = Path(checks.__file__)

    def report(self, second: Path | None, second_at: tuple[float, ...], repeat: int) -> dict[str, Any]:
        table = self._table()
        found: dict[str, Any] = {
            "rows": [_brief(row) for row in table],
            "ablation": [_brief(row) for row in self._ablation(table)],
            "calibration": self._of_fields("calibration", checks.calibration),
            "delays": self._of_fields("delays", checks.delays, scene=True),
            "optimisers": self._optimisers(),
            "repeat": [_brief(row) for row in self._repeat(repeat)],
            "second": self._second(table, second, second_at),
            "shown": self._shown(table),
            "data": {t.name: self._about(t) for t in self.truths},
            "machine": machine(self.geometry.device),
            "seed": self.seed,
        }
        found["seconds"] = self.rows.seconds
        write_json(self.rows.folder / "bistatic.json", found)
        report.write(self.rows.folder)
        return dict(plain(found))

    def _about(self, truth: Truth) -> dict[str, Any]:
        test = truth.test
        return {
            "counts": truth.counts,
            "left_out": truth.left_out,
            "every": truth.every,
            "test": len(test),
            "blocked": int(np.count_nonzero(~test.line_of_sight)),
            "shape": test.shape,
            "frequency_hz": test.frequency_hz,
            "range_db": test.range_db,
            "settings": dict(test.attributes),
        }

    # ------------------------------------------------------------------------------------------ inputs, names

    def _inputs(self, truth: Truth, method: str, *more: Any) -> list[Any]:
        return [truth.mark, self.geometry.mark, truth.every, self.code[method], *more]

    def _field_file(self, truth: Truth, count: int, method: str, variant: str) -> str:
        return f"fields/{_slug(truth.name, count, method, variant)}.safetensors"

    def _field(self, row: Row) -> Any:
        return wr.RadioField.load(self.rows.folder / row["field"], device=self.geometry.device)

    # ------------------------------------------------------------------------------------------ the main table

    def _table(self) -> list[Row]:
        """One row a truth, number of training receivers and method, the better of its variants."""
        rows: list[Row] = []
        for truth in self.truths:
            rows += [self._method(truth, 0, method) for method in UNTAUGHT]
        for count in sorted({n for t in self.truths for n in t.counts}):
            for truth in self.truths:  # receivers are the same, so what was traced for one serves the other
                if count in truth.counts:
                    rows += [self._method(truth, count, m) for m in VARIANTS if m not in UNTAUGHT]
        return rows

    def _method(self, truth: Truth, count: int, method: str) -> Row:
        found = []
        for variant in VARIANTS[method]:
            learned = method == "bistatic" or method in HARMONIC
            file = self._field_file(truth, count, method, variant) if learned else None
            row = self.rows.row(
                _slug(truth.name, count, method, variant),
                partial(
                    score,
                    method,
                    variant,
                    truth,
                    count,
                    self.geometry,
                    self.rows.folder / file if file else None,
                ),
                self._inputs(truth, method, count, method, variant),
                (file,) if file else (),
            )
            found.append(
                {
                    "truth": truth.name,
                    "n_train": count,
                    "method": method,
                    "variant": variant,
                    "field": file,
                    **row,
                }
            )
        chosen = max(found, key=lambda row: float(row["psnr_db"]))
        return {**chosen, "variants": {row["variant"]: row["psnr_db"] for row in found if row["variant"]}}

    # ------------------------------------------------------------------------------------------ checks

    def _ablation(self, table: list[Row]) -> list[Row]:
        rows: list[Row] = []
        for truth in self.truths:
            for method, count, name in (
                ("bistatic", truth.few, WHOLE),
                ("zero", 0, "zero spectra"),
                ("rf3dgs+los", truth.few, "RF-3DGS+ with line of sight"),
            ):
                rows.append({**_find(table, truth.name, count, method), "model": name})
        for name, options in checks.ABLATION.items():
            true = name == checks.TRUE_MESH
            for truth in self.truths:
                row = self.rows.row(
                    _slug("ablation", truth.name, truth.few, name),
                    partial(checks.ablation, options, true, truth, truth.few, self.geometry),
                    self._inputs(
                        truth,
                        "bistatic",
                        truth.few,
                        options,
                        self.geometry.scene_mark if true else "",
                        self.checks,
                    ),
                )
                rows.append({"truth": truth.name, "n_train": truth.few, "model": name, **row})
        self.geometry.forget(keep="weights")
        return rows

    def _of_fields(self, name: str, work: Callable[..., Row], *, scene: bool = False) -> list[Row]:
        """``work`` on the bistatic field of each truth and number of training receivers."""
        rows = []
        for truth in self.truths:
            for count in truth.counts:
                file = self._field_file(truth, count, "bistatic", "")

                def one(progress: Progress, truth: Truth = truth, file: str = file) -> Row:
                    more = (self.geometry,) if scene else ()
                    return work(self._field({"field": file}), truth, *more, progress)

                mark = self.geometry.scene_mark if scene else ""
                row = self.rows.row(
                    _slug(name, truth.name, count),
                    one,
                    self._inputs(truth, "bistatic", count, name, mark, self.checks),
                )
                rows.append({"truth": truth.name, "n_train": count, **row})
        return rows

    def _optimisers(self) -> Row:
        truth = self.truths[0]
        count = TIMED_COUNT if TIMED_COUNT in truth.counts else truth.counts[-1]
        row = self.rows.row(
            _slug("optimisers", truth.name, count),
            partial(checks.optimisers, truth, count, self.geometry, self.seed),
            self._inputs(truth, "bistatic", count, self.seed, self.checks),
        )
        return {"truth": truth.name, "n_train": count, **row}

    def _repeat(self, count: int) -> list[Row]:
        """Engines that sample, solved again with another seed."""
        rows = []
        for truth in self.truths:
            if truth.name == "exact" or count == 0:
                continue
            row = self.rows.row(
                _slug("repeat", truth.name),
                partial(checks.repeat, truth, count, self.geometry, self.rows.folder / "workspace"),
                [
                    truth.mark,
                    truth.every,
                    count,
                    self.geometry.scene_mark,
                    self.checks,
                    code_mark("warprrf.rf.simulate", "warprrf.rf.spectra.metrics"),
                ],
            )
            rows.append({"truth": truth.name, **row})
        return rows

    def _second(self, table: list[Row], given: Path | None, transmitter: tuple[float, ...]) -> list[Row]:
        """Fields of the smallest training set of the exact truth, asked for another transmitter."""
        truth = next((t for t in self.truths if t.name == "exact"), None)
        if truth is None:
            return []
        file = given or self.rows.folder / "second_exact.nc"
        if given is None:

            def make(progress: Progress) -> Row:
                workspace = self.rows.folder / "workspace"
                ds = checks.second_spectra(truth, transmitter, self.geometry, workspace, progress)
                write_atomically(file, ds.save)
                return {"receivers": len(ds)}

            inputs = [
                truth.mark,
                self.geometry.scene_mark,
                transmitter,
                code_mark("warprrf.rf.simulate"),
                self.checks,
            ]
            self.rows.row("second-spectra", make, inputs, (file.name,))
        ds = SpectrumDataset.load(file)
        mark = fingerprint([file])
        rows = []
        for method in ("bistatic", *HARMONIC):
            first = _find(table, truth.name, truth.few, method)
            row = self.rows.row(
                _slug("second", truth.few, method),
                partial(self._second_row, first, ds, truth),
                self._inputs(truth, method, mark, first["field"], self.checks),
            )
            rows.append(
                {
                    "method": method,
                    "variant": first["variant"],
                    "n_train": truth.few,
                    "transmitter": ds.transmitter,
                    "seen": {
                        name: value for name, value in _brief(first).items() if name.startswith("psnr_db")
                    },
                    **_brief(row),
                    "first_range": _brief(row["first_range"]),
                }
            )
        return rows

    def _second_row(self, first: Row, ds: SpectrumDataset, truth: Truth, progress: Progress) -> Row:
        return checks.second_transmitter(self._field(first), ds, truth, self.geometry, progress)

    def _shown(self, table: list[Row]) -> list[Row]:
        """Spectra of a blocked receiver and one with line of sight, those of median PSNR, by some methods."""
        rows = []
        for truth in self.truths:
            file = f"rows/{_slug('shown', truth.name)}.npz"
            ours = _find(table, truth.name, truth.few, "bistatic")
            others = [_find(table, truth.name, truth.few, m) for m in ("rf3dgs+", "rf3dgs+los", "nearest")]

            def make(
                progress: Progress, truth: Truth = truth, file: str = file, picked: Any = (ours, *others)
            ) -> Row:
                test, ours = truth.test, picked[0]
                indices = _middle(np.array(ours["per_receiver"]["psnr_db"], float), ~test.line_of_sight)
                arrays = {
                    "truth": _images(test, [test[i] for i in indices]),
                    "range_db": np.array(test.range_db),
                }
                for done, row in enumerate(picked):
                    nearest = row["method"] == "nearest"
                    ask = lookups.nearest(truth.train(truth.few)) if nearest else self._field(row).spectrum
                    arrays[row["method"]] = _images(test, [ask(test.receivers[i]) for i in indices])
                    progress("spectra", done + 1, len(picked))
                write_arrays(self.rows.folder / file, arrays)
                return {
                    "receivers": test.receivers[indices],
                    "blocked": ~test.line_of_sight[indices],
                    "methods": {row["method"]: row["variant"] for row in picked},
                    "file": file,
                }

            row = self.rows.row(
                _slug("shown", truth.name),
                make,
                [
                    *(x for m in ("bistatic", *HARMONIC) for x in self._inputs(truth, m)),
                    truth.few,
                    [row["variant"] for row in others],
                    Path(__file__),
                ],
                (file,),
            )
            rows.append({"truth": truth.name, "n_train": truth.few, **row})
        return rows


def _images(test: SpectrumDataset, spectra: Sequence[Any]) -> np.ndarray:
    """dB images of spectra by the floor of ``test``, shape ``(S, H, W)`` float32."""
    return np.stack([to_db(s.path_gain, test.floor) for s in spectra]).astype(np.float32)


def _middle(psnr: np.ndarray, blocked: np.ndarray) -> np.ndarray:
    """The receivers of median PSNR with line of sight and without, where there are such."""
    chosen = []
    for where in (~blocked, blocked):
        index = np.flatnonzero(where)
        if len(index):
            chosen.append(index[np.argsort(psnr[index])][(len(index) - 1) // 2])
    return np.array(chosen, dtype=int)


def _find(table: list[Row], truth: str, count: int, method: str) -> Row:
    return next(
        row for row in table if (row["truth"], row["n_train"], row["method"]) == (truth, count, method)
    )


def _brief(row: Row) -> Row:
    """A row without what is kept per receiver."""
    return {
        name: value for name, value in row.items() if name not in ("per_receiver", "lpips", "lpips_reason")
    }


def _slug(*parts: Any) -> str:
    return "-".join(str(part).replace(",", "").replace(" ", "_") for part in parts if part != "")
