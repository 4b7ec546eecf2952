"""What a command says: bars and text, or with `--json` one JSON object a line; and how Ctrl-C ends it."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

from warprrf.device import TimeLeft
from warprrf.files import plain

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
_PATIENCE_S = 1.0  # after which Ctrl-C ends native code too


class Output:
    """Progress, result and errors of one command; a progress callback `(stage, done, total)`.

    With ``lines`` everything is JSON on standard output, an object a line, distinguished by ``event``: ``progress`` (when a
    stage begins and ends, and each second), ``result`` and ``error``. Otherwise results go there as text, and bars and
    errors to standard error.
    """

    def __init__(self, name: str = "", lines: bool = False, quiet: bool = False) -> None:
        self._name, self.lines, self._quiet = name, lines, quiet
        self._stdout, self._bars = sys.stdout, sys.stderr
        # On a terminal a bar moves often; in a log every line stays, so a new one every half minute is enough.
        self._terminal = not lines and self._bars.isatty()
        self._interval = 1.0 if lines else 0.2 if self._terminal else 30.0
        self._left = TimeLeft()
        self._stage: str | None = None
        # what was last reported, if it was not shown
        self._unshown: tuple[int, int, float | None] | None = None
        self._began = self._shown = 0.0
        self._resumes: Path | None = None
        self._once = threading.Lock()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Tell that `done` of `total` steps of `stage` are behind us."""
        if self._quiet:
            return
        left, now = self._left(stage, done, total), time.monotonic()
        if stage != self._stage:
            self.close()
            self._stage, self._began, self._shown = stage, now, now - self._interval
        if now - self._shown >= self._interval or done >= total:
            self._show(done, total, left)
        else:
            self._unshown = done, total, left

    def close(self) -> None:
        """End the stage: its last state is shown, and what is printed next stands below it."""
        if self._unshown is not None:
            self._show(*self._unshown)
        if self._stage is not None and self._terminal:
            print(file=self._bars)
        self._stage = None

    def _show(self, done: int, total: int, left: float | None) -> None:
        self._unshown, self._shown = None, time.monotonic()
        if self.lines:
            self._line("progress", stage=self._stage, done=done, total=total, seconds_left=left)
            return
        part = min(done / total, 1.0) if total else 1.0
        ends = ("\r", "\x1b[K", "") if self._terminal else ("", "", "\n")
        print(
            f"{ends[0]}{self._stage}: {100 * part:3.0f}%|{'#' * int(20 * part):20}| {done}/{total} "
            f"[{_clock(self._shown - self._began)}<{_clock(left)}]{ends[1]}",
            end=ends[2], file=self._bars, flush=True,
        )  # fmt: skip

    def _line(self, event: str, **record: Any) -> None:
        text = json.dumps(plain({"event": event, **record}), allow_nan=False)
        print(text, file=self._stdout, flush=True)

    def result(self, text: str, **figures: Any) -> None:
        """Say what came out: ``text``, or as JSON the figures, among which ``files`` are the paths written."""
        self.close()
        if self.lines:
            self._line("result", **figures)
        else:
            print(text, file=self._stdout, flush=True)

    def error(self, message: str, status: int) -> None:
        """Say why the command ends with ``status``."""
        with suppress(OSError):  # nobody reads standard output any more
            self.close()
            if self.lines:
                return self._line("error", message=message, status=status)
        print(f"{self._name}: {message}", file=sys.stderr, flush=True)

    def resumes(self, kept: str | os.PathLike[str]) -> None:
        """From now on finished work lies in ``kept``, a file or a folder with :class:`~warprrf.steps.Steps`."""
        self._resumes = Path(kept)

    def interrupted(self) -> None:
        """Say, once, what Ctrl-C left behind."""
        if not self._once.acquire(blocking=False):
            return
        kept = self._resumes
        there = kept is not None and (kept.is_file() or any(kept.rglob(".steps")))
        rest = f"finished work is kept in {kept}, the same command goes on from there"
        self.error(f"interrupted; {rest if there else 'nothing is kept'}", INTERRUPTED)

    @contextmanager
    def speaking(self) -> Iterator[None]:
        """While a command runs: strangers' prints go to standard error, and Ctrl-C ends native code as well.

        Python raises KeyboardInterrupt when native code returns, which can be minutes later. So a thread waits for the
        signal too, and ends the process if nobody did. Files are whole or absent whenever a process ends.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        heard, write = os.pipe()
        os.set_blocking(write, False)
        before = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        ended = threading.Event()
        threading.Thread(
            target=self._watch, args=(heard, ended), name="warprrf-interrupt", daemon=True
        ).start()
        try:
            with redirect_stdout(sys.stderr if self.lines else sys.stdout):
                yield
        finally:
            ended.set()
            signal.set_wakeup_fd(before)
            os.close(write)

    def _watch(self, heard: int, ended: threading.Event) -> None:
        with open(heard, "rb", buffering=0) as signals:
            while (came := signals.read(1)) and came[0] != signal.SIGINT:
                pass
        if came and not ended.wait(_PATIENCE_S):
            self.interrupted()
            os._exit(INTERRUPTED)


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes:02}:{rest:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def table(methods: dict[str, dict[str, Any]]) -> str:
    """The figures of several methods as aligned text, one row a method."""
    columns = {
        "psnr_db": "PSNR dB",
        "ssim": "SSIM",
        "rmse_db": "RMSE dB",
        "direction_median_deg": "direction deg",
        "direction_within_3deg": "within 3 deg",
        "direction_within_3deg_blocked": "blocked",
        "beam_gain_loss_db": "beam loss dB",
        "tof_error_median_ns": "ToF ns",
        "aod_error_median_deg": "AoD deg",
    }
    shown = [key for key in columns if any(figures.get(key) is not None for figures in methods.values())]
    rows = [["method", *(columns[key] for key in shown)]]
    rows += [[name, *(_cell(figures.get(key)) for key in shown)] for name, figures in methods.items()]
    return aligned(rows)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 10 else f"{value:.2f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text with their columns flush right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    )
