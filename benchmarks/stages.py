"""A run made of stages that survives being killed: finished stages are kept, the unfinished one is done again.

Each stage has a fingerprint of everything that it reads (files by content, parameters by value, the package's source
where asked) and is skipped when the same fingerprint was finished before and its outputs are still there. Wall time
is added up over attempts, the killed ones included (to within `HEARTBEAT_S`). State lives in one JSON file, replaced
in one step.
"""

from __future__ import annotations

import copy
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from warprrf.device import Progress
from warprrf.files import plain, write_json

HEARTBEAT_S = 5.0  # how much time of a killed stage may go unrecorded
STATE_FILE = "stages.json"


def fingerprint(parts: Iterable[Any]) -> str:
    """SHA-256 over `parts`: a path by the names and content of its files, anything else by its JSON."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            files = sorted(p for p in part.rglob("*") if p.is_file()) if part.is_dir() else [part]
            for file in files:
                digest.update(f"\0file {file.relative_to(part.parent)}\0".encode())
                with file.open("rb") as content:
                    digest.update(hashlib.file_digest(content, "sha256").digest())
        else:
            digest.update(b"\0value " + json.dumps(plain(part), sort_keys=True).encode())
    return digest.hexdigest()


class StagedRun:
    """A folder with resumable stages; a context manager, since one folder takes one run at a time.

    Args:
        folder: where state and outputs live; made if missing.
        fresh: forget what is finished.
        progress: handed to every stage.

    Raises:
        ValueError: if another process runs in `folder`.
    """

    def __init__(
        self, folder: str | os.PathLike[str], *, fresh: bool = False, progress: Progress | None = None
    ) -> None:
        self.folder = Path(folder)
        self._fresh = fresh
        self._progress = progress
        self._lock: IO[str] | None = None
        self._stages: dict[str, dict[str, Any]] = {}
        self.order: list[str] = []

    def __enter__(self) -> StagedRun:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = (self.folder / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._lock.close()
            raise ValueError(
                f"out: another run is at work in {self.folder}; wait for it or name another folder"
            ) from error
        state = self.folder / STATE_FILE
        if state.exists() and not self._fresh:
            try:
                self._stages = json.loads(state.read_text())["stages"]
            except (ValueError, KeyError, TypeError) as error:
                self._lock.close()
                raise ValueError(
                    f"{state}: not readable ({error}); start over with fresh=True (--fresh)"
                ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lock is not None:
            self._lock.close()

    def stage(
        self,
        name: str,
        work: Callable[[Progress], dict[str, Any]],
        *,
        inputs: Iterable[Any],
        outputs: Iterable[str] = (),
    ) -> dict[str, Any]:
        """The figures of stage `name`: those on record if nothing it reads has changed, else `work(progress)`.

        Args:
            work: does the stage and returns its figures; it must write each file in one step.
            inputs: see :func:`fingerprint`.
            outputs: files that it leaves, relative to the folder; a missing one means that the stage is redone.
        """
        mark = fingerprint([name, *inputs])
        outputs = list(outputs)
        self.order.append(name)
        known = self._stages.get(name, {})
        same = known.get("fingerprint") == mark
        if same and known.get("finished") and all((self.folder / file).exists() for file in outputs):
            return copy.deepcopy(known["figures"])
        spent = known["seconds"] if same and not known.get("finished") else 0.0
        attempts = known["attempts"] + 1 if same and not known.get("finished") else 1
        steps: dict[str, float] = dict(known.get("steps", {})) if spent else {}
        start = last = step_start = time.monotonic()

        def record(finished: bool, figures: dict[str, Any]) -> None:
            seconds = spent + time.monotonic() - start
            self._stages[name] = {
                "fingerprint": mark,
                "finished": finished,
                "seconds": seconds,
                "attempts": attempts,
                "steps": steps,
                "outputs": outputs,
                "figures": plain(figures),
            }
            write_json(self.folder / STATE_FILE, {"stages": self._stages})

        def progress(step: str, done: int, total: int) -> None:
            nonlocal last, step_start
            now = time.monotonic()
            steps[step] = (
                steps.get(step, 0.0) + now - step_start
            )  # the time since the last call went into this step
            step_start = now
            if self._progress is not None:
                self._progress(step, done, total)
            if time.monotonic() - last > HEARTBEAT_S:
                last = time.monotonic()
                record(False, {})

        record(False, {})
        try:
            figures = work(progress)
        except BaseException:
            record(False, {})
            raise
        missing = [file for file in outputs if not (self.folder / file).exists()]
        if missing:
            raise RuntimeError(f"stage {name} ended without writing {', '.join(missing)}")
        record(True, figures)
        return copy.deepcopy(self._stages[name]["figures"])

    def seconds(self, *names: str) -> float:
        """Wall time of the named stages (default: all of this run), killed attempts included."""
        return float(sum(self._stages[name]["seconds"] for name in names or self.order))

    def steps(self, name: str) -> dict[str, float]:
        """Wall time [s] of the steps that stage `name` reported to its progress callback."""
        return {step: float(seconds) for step, seconds in self._stages[name].get("steps", {}).items()}

    def attempts(self, name: str) -> int:
        """How many times stage `name` was started until it was finished."""
        return int(self._stages[name]["attempts"])
