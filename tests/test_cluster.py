"""Workers of a cluster: the bits of one process, whatever happens to a worker."""

import os
import signal
from functools import partial

import numpy as np
import pytest
from fuzz.answers import differs, leaves
from golden import make
from radio_scenes import seen

import warprrf as wr
from benchmarks.machine import connected
from warprrf import device
from warprrf.cluster import each
from warprrf.device import threads
from warprrf.rf.fields import batches

PLACES = make.places(9)
F = np.linspace(299e9, 301e9, 4)


@pytest.fixture(scope="module")
def client():
    pytest.importorskip("distributed")
    with connected(None, 2) as client:
        client.wait_for_workers(2)
        yield client


def same(a, b):
    """The same bits."""
    assert leaves(a) and not differs(leaves(a), leaves(b))


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(batches, "AT_ONCE", 2)


def test_every_verb_gives_the_bits_of_one_process(client, tmp_path):
    scene, field, ds = make.room(), make.bistatic(), make.spectra()
    how = {"transmitter": ds.transmitter, "frequency_hz": ds.frequency_hz, "shape": (12, 24)}
    link = {"max_paths": 20, "diffuse": "random_phase"}
    for verb in (
        partial(wr.simulate, scene, receivers=PLACES[:3], **how), partial(field.spectra, PLACES),
        partial(field.paths, PLACES), partial(field.cfr, PLACES, F, **link),
        partial(field.radio_map, 1.2, 1.0), lambda client=None: seen(scene, ds, client=client),
    ):  # fmt: skip
        same(verb(client=client), verb())
    workspace = {"receivers": PLACES[:3], "workspace": tmp_path, **how}
    same(wr.simulate(scene, client=client, **workspace), wr.simulate(scene, **workspace))


def test_a_killed_worker_changes_no_bit(client, tmp_path):
    field = make.bistatic()
    workers, killed = list(client.run(os.getpid).values()), []

    def kill(stage, done, total):
        if not killed:
            killed.append(workers[0])
            os.kill(workers[0], signal.SIGKILL)

    found = field.spectra(PLACES, store=tmp_path / "spectra.nc", client=client, progress=kill)
    same(np.asarray(found.path_gain), field.spectra(PLACES).path_gain)
    assert killed
    assert killed[0] not in client.run(os.getpid).values()


def test_an_error_comes_back_and_a_part_that_kills_every_worker_is_named(client):
    with pytest.raises(ZeroDivisionError):
        dict(each(partial(divmod, 7), [1, 0, 2], client))
    assert [k for k, _ in each(str, range(3))] == [0, 1, 2]  # in order, without a cluster

    def deaths(allowed, dask_scheduler=None):
        dask_scheduler.allowed_failures = allowed

    client.run_on_scheduler(deaths, 0)
    try:
        with pytest.raises(RuntimeError, match="each worker that took 9 died"):
            list(each(os._exit, [9], client))
    finally:
        client.run_on_scheduler(deaths, 3)


def test_a_task_takes_one_thread_unless_told(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.delenv("WARPRRF_THREADS", raising=False)
    device._threads.cache_clear()
    how = {"processes": False, "n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with distributed.Client(**how) as client:
        assert dict(each(lambda k: (k, threads()), range(4), client)) == {k: (k, 1) for k in range(4)}
    assert threads() == len(os.sched_getaffinity(0))
    device._threads.cache_clear()
