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

LIMIT_S = 30.0
"""How long a case may take, of which an undamaged one takes a tenth at most."""
START_S = 180.0
MEMORY = 12 << 30
"""Bytes of address space of a worker: more is refused by the system, which the worker survives."""


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    log: Path
    case: Any = None
    until: float = 0.0


class Workers:
    """A few processes, as a context manager.

    Args:
        make: called in each process with a scratch folder; returns what tries a case.
        count: how many.
        limit_s: a case that takes longer is a hang.
        outcome: what came of a case that killed its process or was stopped, from the words for it.
    """

    def __init__(
        self, make: Callable[[Path], Callable[[Any], Any]], outcome: Callable[[str], Any], count: int = 2,
        limit_s: float = LIMIT_S,
    ) -> None:  # fmt: skip
        self._make, self._outcome, self._count, self._limit_s = make, outcome, count, limit_s
        self._all: list[_Worker] = []
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz-")

    def __enter__(self) -> Workers:
        self._all = [self._start(k) for k in range(self._count)]
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._all:
            _stop(worker)
        self._folder.cleanup()

    def run(self, cases: Iterable[Any], until: float = float("inf")) -> Iterator[tuple[Any, Any]]:
        """Cases with what came of them, as they are done; none is begun after ``until`` (of ``time.monotonic``)."""
        waiting = iter(cases)
        more = True
        while True:
            for worker in self._all:
                if worker.case is None and more and time.monotonic() < until:
                    worker.case = next(waiting, None)
                    more = worker.case is not None
                    if more:
                        worker.pipe.send(worker.case)
                        worker.until = max(worker.until, time.monotonic()) + self._limit_s
            busy = [worker for worker in self._all if worker.case is not None]
            if not busy:
                return
            first = min(worker.until for worker in busy)
            ready = wait([worker.pipe for worker in busy], max(0.0, first - time.monotonic()))
            for worker in busy:
                if worker.pipe in ready or worker.until < time.monotonic():
                    case, worker.case = worker.case, None
                    yield case, self._received(worker)

    def _received(self, worker: _Worker) -> Any:
        try:
            if worker.pipe.poll():
                answer = worker.pipe.recv()
                worker.until = 0.0
                return answer
            words = f"took more than {self._limit_s:g} s"
        except EOFError:
            worker.process.join()
            words = f"the process died: exit code {worker.process.exitcode}"
        _stop(worker)
        place = self._all.index(worker)
        words += "\n" + worker.log.read_text(errors="replace")[-2000:]
        self._all[place] = self._start(place)
        return self._outcome(words)

    def _start(self, number: int) -> _Worker:
        here, there = multiprocessing.get_context("spawn").Pipe()
        log = Path(self._folder.name) / f"{number}.log"
        arguments = (there, self._make, Path(self._folder.name) / str(number), log, self._limit_s)
        process = multiprocessing.get_context("spawn").Process(target=_work, args=arguments, daemon=True)
        process.start()
        there.close()
        return _Worker(process, here, log, until=time.monotonic() + START_S)


def _stop(worker: _Worker) -> None:
    worker.process.kill()
    worker.process.join()
    worker.pipe.close()


def _work(
    pipe: Connection, make: Callable[[Path], Callable[[Any], Any]], scratch: Path, log: Path, limit_s: float
) -> None:
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
