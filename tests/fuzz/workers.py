"""Processes that try cases and may crash or hang: the one that waits sees it, says at which case, and starts another."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

KINDS = ("answered", "refused", "unfit", "finding")
LIMIT_S = 30.0
"""How long a case may take, of which an undamaged one takes a tenth at most; as much longer as others keep the machine busy."""
START_S = 180.0
MEMORY = 12 << 30
"""Bytes of address space of a worker: more is refused by the system, which the worker survives."""


@dataclass(frozen=True)
class Outcome:
    """What came of a case, one of :data:`KINDS`, and what it says; ``unfit``: there is no such value or file."""

    kind: str
    text: str = ""


Make = Callable[[Path], Callable[[Any], Outcome]]
SPAWN = multiprocessing.get_context("spawn")


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    log: Path
    until: float
    case: Any = None

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


class Workers:
    """A few processes, as a context manager.

    Args:
        make: called in each process with a scratch folder; returns what tries a case.
        count: how many.
        limit_s: a case that takes longer is a hang.
    """

    def __init__(self, make: Make, count: int = 2, limit_s: float = LIMIT_S) -> None:
        self._make, self._count, self._limit_s = make, count, limit_s

    def __enter__(self) -> Workers:
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz-")
        self._all = [self._start(k) for k in range(self._count)]
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._all:
            worker.stop()
        self._folder.cleanup()

    def run(self, cases: Iterable[Any], until: float = float("inf")) -> Iterator[tuple[Any, Outcome]]:
        """Cases with what came of them, as they are done; none is begun after ``until`` (of ``time.monotonic``)."""
        waiting = iter(cases)
        while True:
            for worker in self._all:
                if worker.case is None and time.monotonic() < until:
                    worker.case = next(waiting, None)
                    if worker.case is not None:
                        worker.pipe.send(worker.case)
                        busier = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
                        worker.until = max(worker.until, time.monotonic()) + busier * self._limit_s
            busy = [worker for worker in self._all if worker.case is not None]
            if not busy:
                return
            first = min(worker.until for worker in busy)
            ready = wait([worker.pipe for worker in busy], max(0.0, first - time.monotonic()))
            for worker in busy:
                if worker.pipe in ready or worker.until < time.monotonic():
                    case, worker.case = worker.case, None
                    yield case, self._received(worker)

    def _received(self, worker: _Worker) -> Outcome:
        try:
            if worker.pipe.poll():
                answer, worker.until = worker.pipe.recv(), 0.0
                return answer
            words = f"took more than {self._limit_s:g} s"
        except EOFError:
            worker.process.join()
            words = f"the process died: exit code {worker.process.exitcode}"
        worker.stop()
        number = self._all.index(worker)
        words += "\n" + worker.log.read_text(errors="replace")[-2000:]
        self._all[number] = self._start(number)
        return Outcome("finding", words)

    def _start(self, number: int) -> _Worker:
        here, there = SPAWN.Pipe()
        scratch = Path(self._folder.name) / str(number)
        log = scratch.with_suffix(".log")
        process = SPAWN.Process(
            target=_work, args=(there, self._make, scratch, log, self._limit_s), daemon=True
        )
        process.start()
        there.close()
        return _Worker(process, here, log, time.monotonic() + START_S)


def _work(pipe: Connection, make: Make, scratch: Path, log: Path, limit_s: float) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    scratch.mkdir(parents=True, exist_ok=True)
    with log.open("w") as out:
        for stream in (1, 2):
            os.dup2(out.fileno(), stream)
        faulthandler.enable(out)
        os.chdir(scratch)
        attempt = make(scratch)
        while True:
            try:
                case = pipe.recv()
            except EOFError:
                return
            out.truncate(0)  # what earlier cases wrote says nothing of this one
            out.seek(0)
            faulthandler.dump_traceback_later(0.9 * limit_s, file=out)
            answer = attempt(case)
            faulthandler.cancel_dump_traceback_later()
            pipe.send(answer)
