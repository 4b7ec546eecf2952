"""One way to resume: steps of a long job that are kept on disk when finished, and done again when their inputs change.

A step is known by its key, the digest of its name, its version and its inputs. The version is a number that a person
counts up when the step's code computes something else; the source itself is not looked at, so that a mended sentence
throws no finished work away. A job that was killed goes on at its unfinished step, in the scratch folder that the
killed attempt left::

    with Steps("runs/room") as steps:
        steps.run("mesh", make_mesh, version=1, inputs=[Path("photos"), config], outputs=["mesh.ply"])
        weights = steps.arrays("weights", make_weights, version=3, inputs=[steps.key("mesh"), receivers])
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from warprrf.device import Progress, silent
from warprrf.files import check_seal, plain, read_arrays, read_json, write_arrays, write_json

_RECORDED = {
    "key": str, "finished": bool, "seconds": float, "attempts": int, "stages": dict, "figures": dict,
}  # fmt: skip
RECORDS = ".steps"  # of records, scratch and lock: the folder that tells a workspace from others
HEARTBEAT_S = 5.0  # how much time of a killed attempt may go unrecorded


def digest(*parts: object) -> str:
    """SHA-256 [hex] of ``parts``, by value.

    A ``Path`` counts by the names and content of its files, an array by type, shape and content, a dataclass by its
    name and fields, a mapping whatever its order, a list like a tuple; numbers, text and None as they are.

    Raises:
        FileNotFoundError: if a path does not exist.
        TypeError: for anything else.
    """
    total = hashlib.sha256()
    for part in parts:
        _add(total, part)
    return total.hexdigest()


@dataclass(frozen=True)
class Attempt:
    """What a step is given to work with.

    Attributes:
        progress: ``progress(stage, done, total)``; the time since the last call is put down to ``stage``.
        folder: scratch of this step: empty at the first attempt, kept for the next one if this is killed or fails,
            removed when the step is finished or its inputs change.
    """

    progress: Progress
    folder: Path


class Steps:
    """A folder of resumable steps, as a context manager: one process at a time works in it.

    Args:
        folder: where outputs lie, and in ``.steps`` records and scratch; made if missing.
        fresh: forget what is finished.
        progress: called as ``progress(stage, done, total)`` by what the steps report.
        shared: several processes may work here at once, which is safe for :meth:`arrays` alone.

    Attributes:
        records: of the steps that this job has run or found finished, in order: ``key``, ``figures``, ``attempts`` until it was
            finished, wall time ``seconds`` of them all, and in ``stages`` by what was reported as progress [s].

    Raises:
        ValueError: on entering, if another process is at work in ``folder``.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        fresh: bool = False,
        progress: Progress | None = None,
        shared: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self._own = self.folder / RECORDS
        self._fresh, self._progress, self._shared = fresh, progress or silent, shared
        self._lock: IO[str] | None = None
        self.records: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Steps:
        self._own.mkdir(parents=True, exist_ok=True)
        if not self._shared:
            self._process = os.getpid()
            self._lock = (self._own / "lock").open("w")
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                self._lock.close()
                raise ValueError(
                    f"{self.folder}: another process is at work there; wait for it or name another folder"
                ) from error
        return self

    def __exit__(self, *error: object) -> None:
        if self._lock is not None:
            if os.getpid() == self._process:  # a child that was forked meanwhile holds the lock as well
                fcntl.flock(self._lock, fcntl.LOCK_UN)
            self._lock.close()

    def run(
        self,
        name: str,
        make: Callable[[Attempt], Mapping[str, Any] | None],
        *,
        version: int,
        inputs: Iterable[Any],
        outputs: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Figures of step ``name``: those on record if version and inputs are the same, else what ``make`` returns.

        Args:
            name: of the step, fit for a file name, once in a folder.
            make: does the step and returns figures, if any, that JSON holds (arrays come back as lists, NaN as None).
            version: counted up by hand when ``make`` computes something else.
            inputs: all that the step reads; see :func:`digest`.
            outputs: files that it leaves, relative to the folder, each written in one go
                (:func:`~warprrf.files.write_atomically`); if one is missing the step is done again.

        Raises:
            RuntimeError: if ``make`` returns and an output is missing.
        """
        key, scratch = digest(name, version, list(inputs)), self._own / name
        known = self._read(name)
        same = known.get("key") == key
        if same and known["finished"] and all((self.folder / file).exists() for file in outputs):
            self.records[name] = known
            return dict(known["figures"])
        going_on = same and not known["finished"]
        record: dict[str, Any] = {"key": key, "finished": False, "seconds": 0.0, "attempts": 0, "stages": {}}
        record |= {k: known[k] for k in ("seconds", "attempts", "stages") if going_on}
        record |= {"attempts": record["attempts"] + 1, "figures": {}}
        if not going_on and scratch.exists():
            shutil.rmtree(scratch)
        scratch.mkdir(parents=True, exist_ok=True)
        start, before = time.monotonic(), record["seconds"]
        last = written = start

        def write(**news: Any) -> None:
            self.records[name] = record
            record.update(seconds=before + time.monotonic() - start, **news)
            write_json(self._file(name), record, seal=True)

        def progress(stage: str, done: int, total: int) -> None:
            nonlocal last, written
            now = time.monotonic()
            record["stages"][stage] = record["stages"].get(stage, 0.0) + now - last
            last = now
            self._progress(stage, done, total)
            if now - written > HEARTBEAT_S:
                written = now
                write()

        write()
        try:
            figures = make(Attempt(progress, scratch))
        except BaseException:
            write()
            raise
        missing = [file for file in outputs if not (self.folder / file).exists()]
        if missing:
            raise RuntimeError(f"step {name} ended without writing {', '.join(missing)}")
        write(finished=True, figures=plain(figures or {}))
        shutil.rmtree(scratch)
        return dict(record["figures"])

    def arrays(
        self,
        name: str,
        make: Callable[[], Mapping[str, Any]] | None,
        *,
        version: int,
        inputs: Iterable[Any],
    ) -> dict[str, np.ndarray]:
        """Arrays of step ``name``, kept in ``NAME.npz``: those on file if they are of this key, else what ``make`` returns;
        without ``make`` none.

        For small steps, of which a job has many: neither figures nor time are recorded; a damaged file is made again.
        """
        key, path = digest(name, version, list(inputs)), self.folder / f"{name}.npz"
        if path.is_file() and not self._fresh:
            try:
                found = read_arrays(path) if check_seal(path) else {}
            except ValueError:  # damaged: to be replaced
                found = {}
            if str(found.pop("key", "")) == key:
                return found
        if make is None:
            return {}
        made = {n: np.asarray(a) for n, a in make().items()}
        write_arrays(path, {"key": np.array(key), **made}, compress=False)
        return made

    def key(self, name: str) -> str:
        """Key of step ``name``, which this job has run: an input for the steps that read what it left."""
        if name not in self.records:
            raise ValueError(f"name: got {name!r}, expected a step that ran: {', '.join(self.records)}")
        return str(self.records[name]["key"])

    def _file(self, name: str) -> Path:
        return self._own / f"{name}.json"

    def _read(self, name: str) -> dict[str, Any]:
        """The record of step ``name``; empty where there is none, none that reads, or none that counts."""
        if self._fresh and name not in self.records:
            return {}
        try:
            record = read_json(self._file(name))
        except (FileNotFoundError, ValueError):  # what is damaged is done again
            return {}
        return record if all(isinstance(record.get(k), kind) for k, kind in _RECORDED.items()) else {}


def _add(total: Any, part: Any) -> None:
    """Feed ``part`` to the hash ``total``, each kind under a tag and with its length, so that no two look alike."""
    if isinstance(part, Path):
        files = sorted(f for f in part.rglob("*") if f.is_file()) if part.is_dir() else [part]
        total.update(f"\0files {len(files)}".encode())
        for file in files:
            total.update(f"\0file {file.relative_to(part.parent)}\0".encode())
            with file.open("rb") as content:
                total.update(hashlib.file_digest(content, "sha256").digest())
    elif isinstance(part, np.ndarray) and part.dtype != object:
        total.update(f"\0array {part.dtype.str} {part.shape}".encode())
        total.update(np.ascontiguousarray(part).tobytes())
    elif is_dataclass(part) and not isinstance(part, type):
        total.update(f"\0dataclass {type(part).__name__}".encode())
        _add(total, {field.name: getattr(part, field.name) for field in fields(part)})
    elif isinstance(part, Mapping):
        total.update(f"\0mapping {len(part)}".encode())
        for name in sorted(part, key=str):
            _add(total, str(name))
            _add(total, part[name])
    elif isinstance(part, (list, tuple)):
        total.update(f"\0sequence {len(part)}".encode())
        for item in part:
            _add(total, item)
    elif isinstance(part, np.generic):
        _add(total, part.item())
    elif part is None or isinstance(part, (bool, int, float, complex, str, bytes)):
        text = part if isinstance(part, bytes) else repr(part).encode()
        total.update(f"\0{type(part).__name__} {len(text)} ".encode() + text)
    else:
        raise TypeError(
            f"parts: got {type(part).__name__}, expected paths, arrays, dataclasses, mappings, sequences or plain values"
        )
