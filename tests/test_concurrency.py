"""Threads, forks and other processes ask at once: what they get is what one thread alone gets, to the bit.

Each script runs in a process of its own, because what is wrong here kills a process or stops it for good.
"""

import multiprocessing
import os
import subprocess
import sys
import time

import pytest
from golden import make

from warprrf.steps import Steps

HEAD = """
import faulthandler, multiprocessing, os, signal, sys, threading, time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
sys.path[:0] = {path!r}
import numpy as np
import pytest
import warprrf as wr
from golden import make
from rooms import plain, subdivided
from warprrf.geometry.splats.gaussians import discs_on_mesh

RX = make.TRANSMITTER + [[2.0, 0.3, -1.0], [0.5, 2.0, -0.9], [3.0, 2.5, -1.2]]
POINTS = np.random.default_rng(0).uniform(0.2, 2.8, (3000, 3))
FILE, FOLDER = sys.argv[1:]


def fine_room(times=5):
    room = plain()
    for _ in range(times):
        room = subdivided(room)
    return room.vertices, room.faces


def same(found, wanted):
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted):
        np.testing.assert_array_equal(a, b)


def at_once(*uses):
    \"\"\"Results of functions, each called by a thread of its own, all at the same time.\"\"\"
    start = threading.Barrier(len(uses))

    def call(use):
        start.wait()
        return use()

    with ThreadPoolExecutor(len(uses)) as pool:
        return [waiting.result() for waiting in [pool.submit(call, use) for use in uses]]


def asked(field):
    paths = field.paths(RX[:2])
    return [*(field.spectrum(rx).path_gain for rx in RX[:2]), paths.gain, paths.tau]


def refused(field):
    with pytest.raises(ValueError, match="receiver"):
        field.spectrum([np.nan, 0.0, 0.0])


def near(mesh):
    return mesh.distance(POINTS), mesh.cast(RX[0], POINTS, backend="warp").t


def in_fork(use, wait_s=60):
    \"\"\"What ``use`` returns in a forked child; an error if it dies, or is not done in time: it then says where.\"\"\"
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)

    def work():
        ours.close()
        theirs.send(use())

    child = context.Process(target=work)
    child.start()
    theirs.close()
    try:
        if not ours.poll(wait_s):
            os.kill(child.pid, signal.SIGUSR1)
            time.sleep(1)
            raise TimeoutError("the child hangs")
        return ours.recv()
    except EOFError:
        child.join()
        raise ChildProcessError("the child died with exit code " + str(child.exitcode)) from None
    finally:
        child.kill()
        child.join()


faulthandler.register(signal.SIGUSR1)
"""

SCRIPTS = {
    "first uses of a mesh from four threads agree with one": """
FINE = fine_room()
def use(mesh):
    return mesh.distance(POINTS[:200]), mesh.is_closed, mesh.areas, mesh.cast(RX[0], POINTS).t, mesh.bounds
for _ in range(3):
    mesh = wr.Mesh(*FINE)
    found = at_once(*[lambda: use(mesh)] * 4)
    alone = use(wr.Mesh(*FINE))
    for one in found:
        same(one, alone)
mesh = wr.Mesh(*FINE)
alone = wr.Mesh(*FINE).cast(RX[0], POINTS, backend="embree").t
same(at_once(*[lambda: mesh.cast(RX[0], POINTS, backend="embree").t] * 4), [alone] * 4)
""",
    "first uses of a field from four threads agree with one": """
alone = asked(wr.RadioField.load(FILE))
for _ in range(3):
    field = wr.RadioField.load(FILE)
    for found in at_once(*[lambda: asked(field), lambda: refused(field)] * 4)[::2]:
        same(found, alone)  # whatever fails beside it
sources = RX[0], RX[0] + [0.3, 0.1, 0.2], RX[2]
from_elsewhere = [wr.RadioField.load(FILE).spectrum(RX[1], transmitter=t).path_gain for t in sources]
for _ in range(3):
    field = wr.RadioField.load(FILE)
    same(at_once(*[lambda t=t: field.spectrum(RX[1], transmitter=t).path_gain for t in sources]), from_elsewhere)
""",
    # Warp itself, kernels and tables of the process are then first used by several threads.
    "a process may start with all verbs at once": """
scene, (mesh, _) = make.room(), make.room_mesh()
camera = wr.Camera.spherical(36, 18, position=RX[0])
link = dict(transmitter=make.TRANSMITTER, receivers=RX, frequency_hz=make.CARRIER_HZ)
grid = dict(shape=make.SHAPE, beam_sigma_rad=make.BEAM_RAD)

def fitted():
    ds = wr.simulate(scene, **link, **grid)
    return wr.RadioField.fit(scene, ds, quick=True).spectrum(RX[0] + 0.1).path_gain

def saved():
    field = wr.RadioField.load(FILE)
    for k in range(3):
        field.save(FOLDER + "/again.safetensors")
        same(asked(wr.RadioField.load(FOLDER + "/again.safetensors"))[:1], asked(field)[:1])
    return 1.0

uses = [
    lambda: wr.simulate(scene, **link, **grid).path_gain, lambda: wr.trace_paths(scene, **link, mirror_order=2).gain,
    lambda: wr.RadioField.load(FILE).radio_map(1.0, 1.5).total_path_gain,
    lambda: wr.render(discs_on_mesh(mesh, 2000), camera).depth, fitted, saved,
]
found = at_once(*2 * uses)
same(found, 2 * [use() for use in uses])
""",
    "threads go on after the main thread has ended": """
field = wr.RadioField.load(FILE)
alone = asked(field)
def late():
    threading.main_thread().join()
    same(asked(field), alone)
    wr.Mesh(*fine_room()).distance(POINTS)
    open(FOLDER + "/done", "w").close()
threading.Thread(target=late).start()
room = wr.Mesh(*fine_room())
def for_ever():  # not Embree's rays: Open3D takes tensors that are in use at exit for a leak, and exits with 1
    while True:
        room.distance(POINTS)
threading.Thread(target=for_ever, daemon=True).start()
time.sleep(0.5)
""",
    "a forked child goes on where its parent was": """
field, mesh = wr.RadioField.load(FILE), wr.Mesh(*fine_room())
before, near = asked(field), mesh.distance(POINTS)
t = mesh.cast(RX[0], POINTS, backend="embree").t
same(in_fork(lambda: asked(field)), before)
same([in_fork(lambda: mesh.cast(RX[0], POINTS, backend="embree").t), in_fork(lambda: mesh.distance(POINTS))], [t, near])
same(in_fork(lambda: asked(wr.RadioField.load(FILE))), before)
same(in_fork(lambda: in_fork(lambda: asked(field))), before)  # and its child's child
with multiprocessing.get_context("fork").Pool(3) as pool:
    same(pool.map(mesh.distance, np.split(POINTS, 6)), np.split(near, 6))
same(asked(field), before)
""",
    # Forks while other threads are in launches and in first uses: the children neither hang nor differ.
    "a fork waits for what other threads make": """
FINE = fine_room()
field, mesh = wr.RadioField.load(FILE), wr.Mesh(*FINE)
before, near, closed = asked(field), mesh.distance(POINTS), mesh.is_closed
stop = threading.Event()

def busy():
    while not stop.is_set():
        asked(wr.RadioField.load(FILE))
        field.spectrum(RX[0])

def first_uses():
    while not stop.is_set():
        assert wr.Mesh(*FINE).is_closed == closed
        wr.Mesh(*FINE).distance(POINTS[:100])

threads = [threading.Thread(target=f) for f in (busy, first_uses)]
[t.start() for t in threads]
try:
    for _ in range(6):
        time.sleep(np.random.default_rng().uniform(0, 0.05))
        fresh = wr.Mesh(*FINE)
        same(in_fork(lambda: [*asked(field), mesh.distance(POINTS), fresh.is_closed]), [*before, near, closed])
finally:
    stop.set()
    [t.join() for t in threads]
""",
    # Pickles of fields are in tests/fuzz and test_cluster; here all find an empty cache of kernels and fill it at once.
    "used objects go to spawned processes": """
if __name__ == "__main__":
    mesh, _ = make.room_mesh()
    wanted = near(mesh)
    os.environ["WARP_CACHE_PATH"] = FOLDER + "/kernels"
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        for found in [pool.submit(near, mesh) for _ in range(2)]:
            same(found.result(), wanted)
    assert os.listdir(FOLDER + "/kernels")
""",
}
"""What must hold, and what fails where it does not: by an error, a status or a hang."""
THREADED = [name for name in SCRIPTS if "fork" in name or "go on after" in name]


@pytest.fixture(scope="module")
def field_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("concurrency") / "field.safetensors"
    make.bistatic().save(path)
    return path


forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


@pytest.mark.parametrize("law", [pytest.param(law, marks=forks if "fork" in law else ()) for law in SCRIPTS])
def test_it_holds(law, field_file, tmp_path):
    script = tmp_path / "script.py"  # spawned processes read it again
    script.write_text(HEAD.format(path=sys.path) + SCRIPTS[law])
    threads = {"WARPRRF_THREADS": "3"} if law in THREADED else {}
    command = [sys.executable, script, field_file, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env=os.environ | threads)
    assert done.returncode == 0, f"exit status {done.returncode}\n{done.stderr[-3000:]}"
    assert (tmp_path / "done").exists() or "go on after" not in law


@forks
def test_a_forked_child_does_not_keep_its_parents_folder(tmp_path):
    with Steps(tmp_path):
        child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
        child.start()
    try:
        with Steps(tmp_path):
            pass
    finally:
        child.kill()
        child.join()
