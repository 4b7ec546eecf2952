"""Answers for many receivers: in parts that fit into memory, here or on a cluster, gathered in arrays or in a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.cluster import each
from warprrf.device import Progress, silent
from warprrf.netcdf_files import Store, Variable
from warprrf.rf.positions import Ends

AT_ONCE = 24  # receivers of a part: some tenths of a second of work, to which sending it adds little

_ENDS = {name: Variable(("receiver", "xyz"), "m") for name in ("receiver_position", "transmitter_positions")}
Work = Callable[[tuple[np.ndarray, np.ndarray]], Any]
"""From receivers ``(K, 3)`` and their transmitter ``(3,)`` to answers."""


@dataclass(frozen=True)
class Batch:
    """What is asked of many receivers.

    Attributes:
        stage: name of the answers, for the progress.
        ends: places that were checked.
        store, client, progress: where they are gathered and computed, and who is told; see :meth:`RadioField.spectra`.
        row_bytes: of one receiver's answer.
        at_once: most receivers of a part; :data:`AT_ONCE` by default.
    """

    stage: str
    ends: Ends
    store: str | os.PathLike[str] | None
    client: Any
    progress: Progress | None
    row_bytes: int = 0
    at_once: int | None = None

    def parts(self) -> list[np.ndarray]:
        """Receivers that are asked together, under one transmitter: always the same, so that so are the answers."""
        part_bytes = 64_000_000  # of its answers at most
        most = max(1, min(self.at_once or AT_ONCE, part_bytes // max(1, self.row_bytes)))
        return [own[k : k + most] for _, own in self.ends.groups() for k in range(0, len(own), most)]

    def each(self, work: Work, missing: np.ndarray | None = None) -> Iterator[tuple[np.ndarray, Any]]:
        """Rows and answers of the parts of which some are ``missing`` (R,), all by default, as they are ready."""
        parts = [own for own in self.parts() if missing is None or missing[own].any()]
        ends, count = self.ends, len(self.ends.receivers)
        done, tell = count - sum(map(len, parts)), self.progress or silent
        tell(self.stage, done, count)
        jobs = [(ends.receivers[own], ends.transmitters[own[0]]) for own in parts]
        for k, found in each(work, jobs, self.client):
            yield parts[k], found
            done += len(parts[k])
            tell(self.stage, done, count)

    def gather(
        self,
        work: Work,
        variables: Mapping[str, Variable],
        known: Mapping[str, np.ndarray],
        attributes: Mapping[str, Any],
    ) -> dict[str, np.ndarray]:
        """Arrays ``(R, ...)`` of the answers, which are arrays ``(K, ...)`` by the names of ``variables``; ``known`` and
        ``attributes`` go into the file besides."""
        path, held, count = self.store, dict[str, np.ndarray](), len(self.ends.receivers)
        if path is None:
            for rows, found in self.each(work):
                for name, array in found.items():
                    if name not in held:
                        held[name] = np.empty((count, *array.shape[1:]), array.dtype)
                    held[name][rows] = array
            return held
        ends = {"receiver_position": self.ends.receivers, "transmitter_positions": self.ends.transmitters}
        with Store(path, ends | dict(known), _ENDS | dict(variables), attributes, count) as store:
            for rows, found in self.each(work, store.missing):
                store.put(rows, found)
        return store.arrays()
