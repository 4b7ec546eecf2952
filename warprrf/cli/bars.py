"""Progress of long work, as bars on the terminal."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any


class Bars:
    """One tqdm bar per stage, as a progress callback `(stage, done, total)`; silent when `quiet`."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bar: Any = None
        self._stage: str | None = None

    def __enter__(self) -> Bars:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Draw that `done` of `total` steps of `stage` are behind us."""
        if self._quiet:
            return
        if stage != self._stage:
            from tqdm import tqdm

            self.close()
            # On a terminal the bar moves often; in a log every line stays, so a new one every half minute is enough.
            # Work that goes on where a run was stopped begins at its count; what is left is promised from the mean speed.
            interval = 0.2 if sys.stderr.isatty() else 30.0
            self._bar = tqdm(total=total, initial=done, desc=stage, smoothing=0, mininterval=interval)
            self._stage = stage
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """End the bar that is drawn, so that what is printed next stands below it."""
        if self._bar is not None:
            self._bar.close()
        self._bar = self._stage = None
