"""One piece of work in many parts, in this process or on the workers of a dask cluster: the one module that knows dask.

The parts are the same either way, and so is what each gives, to the bit on processors of one kind: every part runs on one
thread of BLAS, and nothing else depends on the number of threads. What parts share is sent to each worker once. A worker that
dies loses nothing: dask gives its parts to others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from warprrf.cache import Cache
from warprrf.device import one_thread, require

Part = TypeVar("Part")
Result = TypeVar("Result")

_works = Cache(2)  # on a worker
_LEAST = 8  # parts under way at once, also while a cluster has no worker yet


def each(
    work: Callable[[Part], Result], parts: Sequence[Part], client: Any = None
) -> Iterator[tuple[int, Result]]:
    """The number and result of ``work(part)`` for each of ``parts``: in order here, as they are ready on a cluster.

    Args:
        work: with all that it holds it is what parts share; on a cluster it is pickled, and its modules must be there.
        parts: small, because each is sent by itself.
        client: a ``dask.distributed.Client``; None works in this process. A worker's task takes one of its threads; the
            variable ``WARPRRF_THREADS`` of a worker gives each task more.

    Raises:
        Exception: what ``work`` raises; parts under way are given up.
        RuntimeError: for a part whose every worker died.
        TypeError: for a client that is none.
        ImportError: without dask.distributed, where it is needed.
    """
    if client is None:
        for k, part in enumerate(parts):
            with threadpool_limits(1, user_api="blas"):
                found = work(part)
            yield k, found
        return
    distributed, dask = require("distributed", extra="cluster"), require("dask", extra="cluster")
    if not isinstance(client, distributed.Client):
        raise TypeError(f"client: got {type(client).__name__}, expected a dask.distributed.Client")
    data = distributed.protocol.pickle.dumps(work)
    known = hashlib.sha256(data).hexdigest()
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TB"}):
        # The scheduler keeps these bytes, also when a worker dies.
        shared = client.submit(bytes, data, pure=False)
    waiting, running = iter(enumerate(parts)), dict[Any, int]()
    ready = distributed.as_completed(loop=client.loop)
    try:
        while True:
            room = max(_LEAST, 2 * sum(client.nthreads().values())) - len(running)
            for k, part in islice(waiting, max(room, 0)):
                # first come, first done
                future = client.submit(_run, known, shared, part, pure=False, priority=-k)
                running[future] = k
                ready.add(future)
            if not running:
                return
            future = next(ready)
            try:
                found = future.result()
            except distributed.KilledWorker as error:
                part = parts[running[future]]
                raise RuntimeError(
                    f"each worker that took {part!r:.200} died; try fewer workers if memory ran out"
                ) from error
            yield running.pop(future), found
    finally:
        client.cancel([*running, shared])


def _run(known: str, data: bytes, part: Any) -> Any:
    """A part, on a worker, which keeps the last pieces of work."""
    code = require("distributed", extra="cluster").protocol.pickle
    with one_thread(), threadpool_limits(1, user_api="blas"):
        return _works.get(known, lambda: code.loads(data))(part)
