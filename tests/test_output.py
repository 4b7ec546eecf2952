"""Long work says how far it is, in one way; commands say it as bars or JSON; Ctrl-C ends them and loses nothing."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from told import check_told

import warprrf as wr
from warprrf import cli
from warprrf.cli.output import Output
from warprrf.device import TimeLeft


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_time_left_follows_the_recent_rate(clock):
    left, said = TimeLeft(), []
    for now, done in ((0, 900), (30, 901), (32, 902), (34, 903), (44, 908), (54, 909)):
        clock[0] = now
        said.append(left("refine", done, 1000))
    # What an earlier run did tells nothing; the first step, which compiles, counts only while it is the only one.
    assert said[:4] == [None, 99 * 30.0, 98 * 2.0, 97 * 2.0]
    # 7 steps in 14 s since the first one, then 6 in the 20 s since the newest count that is 15 s old.
    assert said[4:] == pytest.approx([92 * 2.0, 91 * 20.0 / 6.0])
    assert left("refine", 1000, 1000) == 0.0
    assert left("report", 1, 2) is None  # another stage has a rate of its own
    assert left("report", 1, 2) is None  # and none while it stands still


def test_a_log_gets_a_line_every_half_minute_and_a_terminal_one_line_that_moves(clock, monkeypatch):
    def drawn(terminal):
        stream = io.StringIO()
        monkeypatch.setattr(stream, "isatty", lambda: terminal)
        monkeypatch.setattr(sys, "stderr", stream)
        out = Output("warprrf")
        for now, done in ((0, 900), (10, 901), (40, 910)):
            clock[0] = now
            out("refine", done, 1000)
        out("report", 0, 2)
        out.error("error: no", 2)
        return stream.getvalue()

    ends = "00:00<?", "00:40<05:00"
    bar = [f"refine:  {90 + k}%|{'#' * 18}  | {900 + 10 * k}/1000 [{end}]" for k, end in enumerate(ends)]
    report = f"report:   0%|{' ' * 20}| 0/2 [00:00<?]"
    assert drawn(False).splitlines() == [*bar, report, "warprrf: error: no"]
    moving = drawn(True)
    assert moving.count("\n") == 3 and moving.count("\r") == 4 and bar[1] in moving  # 901 is drawn there too


def test_an_error_goes_to_standard_error_when_nobody_reads_standard_output(monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.main(["sample", "none.xml", "-o", "r.csv", "--json"]) == 2
        full.buffer.raw.close()
    assert "none.xml: no such file" in capsys.readouterr().err


def events(text):
    """Standard output of a command with --json: strict JSON, an object a line, and nothing else."""

    def refuse(word):
        raise AssertionError(word)

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A scene, a hundred receivers and what is made of them by the tests below, in order."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "room.xml").write_text(
        '<scene version="3.0.0"><bsdf type="itu-radio-material" id="it"><string name="type" value="concrete"/></bsdf>'
        '<shape type="cube"><ref id="it"/><boolean name="flip_normals" value="true"/></shape></scene>'
    )
    places = np.random.default_rng(1).uniform(-0.8, 0.8, (100, 3))
    np.savetxt(folder / "receivers.csv", places, delimiter=",")
    return folder


COMMANDS = {
    "simulate room.xml -o x.nc --transmitter 0.7 0.7 0.9 --receivers receivers.csv --shape 8 16": (
        ["simulate"], ["x.nc"], {"spectra": 100, "shape": [8, 16], "engine": "exact"},
    ),
    "fit room.xml x.nc -o f.safetensors --quick --train 20": (
        ["patches", "mirrors", "transport", "fit"], ["f.safetensors"], {"model": "bistatic", "receivers": 20},
    ),
    "evaluate f.safetensors x.nc --train 20 -o e.json": (
        [f"evaluate {name}" for name in ("bistatic", "nearest", "idw", "constant", "mean")], ["e.json"], {},
    ),
    "suggest f.safetensors receivers.csv -n 2 -o next.csv": (["suggest"], ["next.csv"], {}),
    "map f.safetensors -o m.nc --cell 0.7 --height 0": (["links"], ["m.nc", "m.png"], {"cells": 9, "cells_in_air": 9}),
    "twin f.safetensors -o twin": ([], ["twin"], {"materials": 1}),
    "render f.safetensors --receiver 0.2 0.2 0.1 -o r.npz": ([], ["r.npz"], {}),
    "relevance room.xml --spectra x.nc --most 2 -o rel.json": (
        ["relevance"], ["rel.json", "rel.md"], {"receivers": 2},
    ),
}  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_json_holds_progress_and_one_result(command, room, monkeypatch, capsys):
    stages, files, figures = COMMANDS[command]
    monkeypatch.chdir(room)
    assert cli.main([*command.split(), "--json", "--device", "cpu"]) == 0
    said = events(capsys.readouterr().out)
    *told, result = said
    assert {one["event"] for one in told} <= {"progress"} and result.pop("event") == "result"
    check_told([(one["stage"], one["done"], one["total"]) for one in told], stages)
    assert all(one["seconds_left"] == 0 for one in told if one["done"] == one["total"])
    assert result.pop("files") == files and all((room / file).exists() for file in files)
    assert figures.items() <= result.items() and (figures or result)


def test_every_long_function_tells_how_far_it_is(room):
    """As do those behind the commands above, and a reconstruction (tests/geometry/test_reconstruction.py)."""
    scene, data = wr.Scene.load(room / "room.xml"), wr.SpectrumDataset.load(room / "x.nc")
    few, places = data.subset(range(12)), data.receivers[90:95]
    field = wr.RadioField.load(room / "f.safetensors")
    ends = {"transmitter": data.transmitter, "frequency_hz": 300e9, "receivers": places}
    store = {"store": room / "stored.nc"}
    asked = [
        (["transport", "fit"], lambda tell: wr.RadioField.fit(scene, few, "rf3dgs+", iterations=9, progress=tell)),
        (["transport", "fit"], lambda tell: wr.RadioField.fit(scene, few, "rf3dgs", iterations=9, progress=tell)),
        (["spectra"], lambda tell: field.spectra(places, progress=tell)),
        (["spectra"], lambda tell: field.spectra(places, **store, progress=tell)),
        (["spectra"], lambda tell: field.spectra(places, **store, progress=tell)),  # all is there
        (["paths"], lambda tell: field.paths(places, progress=tell)),
        (["cfr"], lambda tell: field.cfr(places, [300e9], diffuse="power", progress=tell)),
        (["patches", "mirrors"], lambda tell: wr.trace_paths(scene, **ends, mirror_order=2, progress=tell)),
    ]  # fmt: skip
    for stages, call in asked:
        told = []
        call(lambda *news, told=told: told.append(news))
        check_told(told, stages)


def test_errors_are_json_too_and_a_bug_has_a_traceback(room, monkeypatch, capsys):
    for words, said in {
        f"fit none {room}/none.nc -o f": "none: no such file or folder",
        "fit": "required: geometry, measurements, -o/--out (see warprrf fit --help)",
    }.items():
        assert cli.main([*words.split(), "--json", "--quiet"]) == 2
        (one,) = events(capsys.readouterr().out)
        assert one["event"] == "error" and one["status"] == 2 and said in one["message"]

    def fail(*args, **options):
        print("a stranger's word")
        raise RuntimeError("a bug")

    monkeypatch.setattr(wr, "simulate", fail)
    with pytest.raises(RuntimeError):
        cli.main(f"simulate {room}/room.xml -o y.nc --transmitter 0 0 0 --receivers 2,2,2 --json".split())
    said = capsys.readouterr()
    assert events(said.out) == [{"event": "error", "message": "error: a bug", "status": 1}]
    assert said.err == "a stranger's word\n"


def interrupted(words, when, folder, file="*"):
    """What a real process says on SIGINT, sent once it has told ``when`` and made ``file``, and how long it takes to end.

    ``file`` is a pattern; a file that is still being written begins with a point, which ``[!.]`` leaves out.
    """
    # A job in the background ignores SIGINT, and so do its children.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-m", *words, "--json", "--device", "cpu"], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    signal.signal(signal.SIGINT, before)
    for line in process.stdout:
        if when in line:
            break
    else:
        raise AssertionError(process.communicate())
    while not list(folder.glob(file)):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    start = time.monotonic()
    out, err = process.communicate(timeout=60)
    took = time.monotonic() - start
    assert process.returncode == 130, err
    assert "Traceback" not in err
    last = events(out)[-1]
    assert last["status"] == 130 and last["event"] == "error"
    return last["message"], took


def test_simulate_goes_on_where_ctrl_c_ended_it(room, monkeypatch, capsys):
    monkeypatch.chdir(room)
    # Twenty receivers last for seconds: when Python loses the signal in a __del__, a second later the command ends all
    # the same.
    places, some = np.loadtxt("receivers.csv", delimiter=",")[:20], [0, 1, 10, 18, 19]
    np.savetxt("twenty.csv", places, delimiter=",")
    np.savetxt("some.csv", places[some], delimiter=",")
    words = "simulate room.xml --transmitter 0.7 0.7 0.9 --shape 45 90 --receivers".split()
    command = ["warprrf", *words, "twenty.csv", "-o", "i.nc"]
    message, took = interrupted(command, '"simulate"', room, "i.nc.receivers/[!.]*.npz")
    kept_in = "finished work is kept in i.nc.receivers, the same command goes on from there"
    assert message == f"interrupted; {kept_in}"
    assert took < 3.0 and not Path("i.nc").exists()
    kept = len(list(Path("i.nc.receivers").glob("[!.]*.npz")))
    assert 0 < kept < 20
    for file, name, known in (("twenty.csv", "i.nc", kept), ("some.csv", "fresh.nc", 0)):
        assert cli.main([*words, file, "-o", name, "--device", "cpu", "--json"]) == 0
        assert events(capsys.readouterr().out)[0]["done"] == known
    one, fresh = wr.SpectrumDataset.load("i.nc"), wr.SpectrumDataset.load("fresh.nc")
    np.testing.assert_array_equal(one.path_gain[some], fresh.path_gain)
    np.testing.assert_array_equal(one.delay_s[some], fresh.delay_s)
    assert not Path("i.nc.receivers").exists()


def test_ctrl_c_ends_a_fit_at_once(room):
    words = "warprrf fit room.xml x.nc -o none --model rf3dgs+".split()
    message, took = interrupted(words, '"transport"', room)
    assert message == "interrupted; nothing is kept" and took < 3.0 and not (room / "none").exists()


STUCK = """
import ctypes, sys, threading
from warprrf import cli
def stuck(args, out):
    threading.Timer(0.5, out, ("stuck", 0, 1)).start()  # told from within the wait
    lock = ctypes.create_string_buffer(64)  # a mutex of zeros is open; who locks it twice waits for ever
    [ctypes.CDLL(None).pthread_mutex_lock(lock) for _ in range(2)]
sys.exit(cli.run(cli.make_parser("stuck", "", "", [lambda add: add("stuck", stuck, "is stuck", "")])))
"""


def test_ctrl_c_ends_native_code_that_does_not_listen(tmp_path):
    (tmp_path / "stuck.py").write_text(STUCK)
    message, took = interrupted(["stuck", "stuck"], '"stuck"', tmp_path)
    assert message == "interrupted; nothing is kept" and 0.9 < took < 3.0
