"""The command line teaches, refuses bad input in one line, and carries spectra from a scene to a scored field."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from golden import make
from places import ROOT
from radio_scenes import box_mesh

from warprrf import cli
from warprrf.cli.inputs import read_positions, read_receivers
from warprrf.cli.views import _look_at
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.fields.bistatic.training import FitOptions
from warprrf.rf.fields.harmonic.options import FieldOptions
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.positions import check_positions
from warprrf.rf.spectra.spectrum import pixel_directions

SCENE = ROOT / "data" / "lobby" / "scene.xml"
SPECTRA = ROOT / "data" / "lobby" / "spectra.nc"
COMMANDS = (
    "reconstruct", "sample", "simulate", "fit", "suggest", "relevance", "render", "evaluate", "map", "twin", "view",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example_that_the_parser_takes(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*command.split(), "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    examples = [
        line.split("   ")[0].split()[1:]
        for line in map(str.strip, text.splitlines())
        if line.startswith("warprrf ")
    ]
    assert examples
    for words in examples:
        cli._parser().parse_args(words)  # exits where an example is wrong


def test_scenes_that_name_itu_materials_alone_go_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "room.xml").write_text(
        '<scene version="3.0.0"><bsdf type="itu-radio-material" id="it"><string name="type" value="metal"/></bsdf>'
        '<shape type="cube"><ref id="it"/><boolean name="flip_normals" value="true"/></shape></scene>'
    )
    words = ["simulate", tmp_path / "room.xml", "-o", tmp_path / "x.nc", "--shape", 8, 16, "--quiet"]
    words += ["--transmitter", 0.5, 0, 0, "--receivers", "0,0.5,0.1"]
    assert cli.main([str(word) for word in words]) == 2
    assert "1 to 100 GHz" in capsys.readouterr().err  # metal, at 300 GHz
    assert cli.main([str(word) for word in [*words, "--extrapolate"]]) == 0
    assert cli.main([str(word) for word in [*words, "--frequency", 60e9]]) == 0


@pytest.mark.parametrize("command", ["simulate", "relevance"])
def test_examples_that_need_the_repository_alone_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import warprrf as wr

    def placed(scene: wr.Scene, *, transmitter: np.ndarray, receivers: np.ndarray, **options: object) -> None:
        check_positions(scene.mesh, np.asarray(transmitter), receivers, 1e-3)
        raise ValueError("positions are fine")

    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wr, "relevance", placed)  # takes seconds
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    lines = re.findall(rf"warprrf ({command} .*data/lobby.*)", capsys.readouterr().out)
    runnable = [line.split() for line in lines if not re.search(r"receivers\.csv|sionna", line)]
    assert runnable
    for words in runnable:
        status = cli.main([*words, *["--shape", "8", "16"][: 3 * (command == "simulate")], "--quiet"])
        assert status == 0 or "positions are fine" in capsys.readouterr().err


def test_numbers_below_zero_are_no_options() -> None:
    words = "simulate s.xml -o x.nc --transmitter -1e-3 -2 -.5 --receivers -1,4,-1.5".split()
    seen: list[object] = []
    parser = cli._parser()
    for action in parser._subparsers._group_actions[0].choices.values():  # type: ignore[union-attr]
        action.set_defaults(command=lambda args, out: seen.append((args.transmitter, args.receivers)))
    assert cli.run(parser, words) == 0
    (transmitter, receivers) = seen[0]  # type: ignore[misc]
    assert transmitter == [-0.001, -2.0, -0.5]
    np.testing.assert_array_equal(read_receivers(receivers), [[-1.0, 4.0, -1.5]])


@pytest.mark.parametrize("kind", [ValueError, TypeError, OSError, ImportError, MemoryError])
def test_what_went_wrong_is_one_line_and_a_bug_is_a_traceback(
    kind: type[Exception], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(error: type[Exception]) -> object:
        def load(path: object, device: object = None) -> None:
            raise error("first line\nsecond")

        return load

    import warprrf as wr

    words = ["twin", str(SCENE), "-o", "none"]
    monkeypatch.setattr(wr.RadioField, "load", fail(kind))
    assert cli.main(words) == 2
    assert capsys.readouterr().err == "warprrf: error: first line second\n"
    for bug in (AttributeError, KeyError, RuntimeError):
        monkeypatch.setattr(wr.RadioField, "load", fail(bug))
        with pytest.raises(bug):
            cli.main(words)


def test_top_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    text = capsys.readouterr().out
    assert [command for command in COMMANDS if not re.search(rf"^    {command}\s", text, re.MULTILINE)] == []


def test_runs_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "warprrf", "fit", "none", "none.nc", "-o", "none.safetensors"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=300,
    )
    assert done.returncode == 2
    assert done.stderr == "warprrf: error: none: no such file or folder\n"


SIMULATE = "simulate {scene} -o {tmp}/x.nc --transmitter 2 3 3 --receivers"
RENDER = "render -o {tmp}/x.png"
FIT = "fit {scene} -o {tmp}/f.safetensors"
HORN = f"{FIT} --frequency 300e9 --noise-floor-db -120 {{tmp}}/horn.csv"
SUGGEST = "suggest {scene} 2,2,1 --transmitter 13.6 11.2 2.5"
BAD = {
    "no photos": ("reconstruct {tmp}/none -o {tmp}/out", "none"),
    "no scene": (SIMULATE.replace("{scene}", "none.xml") + " 2,2,1", "none.xml"),
    "receiver of two numbers": (f"{SIMULATE} 2,2", "x,y,z"),
    "receiver that is no number": (f"{SIMULATE} 2,2,up", "numbers"),
    "NaN receiver": (f"{SIMULATE} 2,2,nan", "receivers"),
    "receiver outside": (f"{SIMULATE} 2,2,40", "receivers"),
    "frequency outside the materials": (f"{SIMULATE} 2,2,1 --frequency 5e12", "frequency"),
    "materials of a list": (f"{SIMULATE} 2,2,1 --materials {{tmp}}/materials.json", "materials.json"),
    "seed below zero": (f"{SIMULATE} 7,4,1.5 --seed -1", "seed"),
    "receivers of complex numbers": (f"{SIMULATE} {{tmp}}/c.npy", "c.npy"),
    "nowhere to sample": ("sample {scene} -o {tmp}/r.csv -n 3 --height 20 30", "z: got"),
    "too wide a view": (f"{RENDER} {{tmp}}/one.ply --position 0 0 1 --look-at 1 0 1 --field-of-view 180", "--field-of-view"),
    "no receivers at all": ("relevance {scene} --receivers 2,2,1 --most 0", "--most"),
    "materials of a reconstruction": ("relevance {tmp} --receivers 2,2,1 --materials {tmp}/materials.json", "--materials"),
    "relevance that nests too deep": (f"{FIT} {{spectra}} --relevance {{tmp}}/deep.json", "deep.json"),
    "positions that nest too deep": ("reconstruct {tmp} -o {tmp}/out --known-positions {tmp}/deep.json", "deep.json"),
    "scale that is no number": ("reconstruct {tmp} -o {tmp}/out --scale a.jpg b.jpg far", "--scale"),
    "geometry of unknown kind": ("fit {tmp}/words.txt {tmp}/x.nc -o {tmp}/f.safetensors", ".ply"),
    "horn of no table": (f"{FIT} {{tmp}}/bad.nc --receive-pattern 10", "--receive-pattern"),
    "fading of spectra, behind their file": (f"{FIT} {{tmp}}/bad.nc samples=1", "--samples"),
    "part of a table": (f"{HORN} --train 3", "--train"),
    "setting of no name": (f"{HORN} {{tmp}}/horn.csv colour=red", "colour"),
    "floor that is no number": (f"{HORN} noise-floor-db=4000", "--noise-floor-db"),
    "horn that looks through its own foot": (f"{HORN} receive-pattern=10", "zenith of -1.91986"),
    "pattern of words": (f"{HORN} receive-pattern={{tmp}}/words.txt", "words.txt"),
    "pattern of three numbers": (f"{HORN} --receive-pattern 10,-25,3", "'10,-25,3'"),
    "option of no model": (f"{FIT} {{spectra}} --option colour=red", "colour"),
    "arrays that are no spectra": (f"{FIT} {{tmp}}/bad.npz", "bad.npz"),
    "candidates that are no numbers": ("suggest {scene} 2,2,up", "candidates"),
    "pointings without a direction": (f"{SUGGEST} --frequency 3e11 --receive-pattern 10", "azimuth"),
    "suggest without a carrier": (SUGGEST, "--frequency"),
    "more suggested than there are": (f"{SUGGEST} -n 2 --frequency 300e9", "n: got 2"),
    "nowhere to look": ("relevance {scene}", "--receivers"),
    "relevance of nothing": ("relevance {tmp}/none.xml --receivers 2,2,1", "none.xml"),
    "carrier of no material": ("relevance {scene} --receivers 2,2,1 --transmitter 3 2 3 --frequency 5e9", "frequency"),
    "corrupt spectra": (f"{FIT} {{tmp}}/bad.nc", "bad.nc"),
    "corrupt field": (f"{RENDER} {{tmp}}/bad.safetensors --receiver 1 1 1", "bad.safetensors"),
    "corrupt splats": (f"{RENDER} {{tmp}}/bad.ply --position 0 0 1 --look-at 1 0 1", "bad.ply"),
    "camera looks straight up": (f"{RENDER} {{tmp}}/one.ply --position 0 0 1 --look-at 0 0 2", "--look-at"),
    "map of no kind": ("map {tmp}/bad.safetensors -o {tmp}/m.tif", "m.tif"),
    "map of a corrupt field": ("map {tmp}/bad.safetensors -o {tmp}/m.nc", "bad.safetensors"),
    "field without receiver": (f"{RENDER} {{tmp}}/bad.safetensors", "--receiver"),
    "positions that are no positions": ("reconstruct {tmp} -o {tmp}/out --known-positions {tmp}/words.txt", "words.txt"),
}  # fmt: skip


def test_an_empty_name_of_the_result_is_refused_before_any_work(capsys: pytest.CaptureFixture[str]) -> None:
    words = SIMULATE.format(tmp="", scene=SCENE).split()
    words[words.index("-o") + 1] = ""
    assert cli.main([*words, "7,4,1.5"]) == 2
    assert "-o/--out: got ''" in capsys.readouterr().err


@pytest.mark.parametrize("case", sorted(BAD))
def test_bad_input_is_one_line_and_status_2(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import warprrf as wr

    (tmp_path / "materials.json").write_text("[5]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    np.save(tmp_path / "c.npy", np.ones((2, 3), complex))
    np.savez(tmp_path / "bad.npz", receivers=np.ones((1, 3)))
    (tmp_path / "words.txt").write_text("these are, words\n")
    (tmp_path / "horn.csv").write_text(
        "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,azimuth_deg,elevation_deg,power_db\n13,11,2.5,7,4,1.5,0,200,-90\n"
    )
    (tmp_path / "bad.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0notjson!")
    (tmp_path / "bad.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    (tmp_path / "bad.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n"
    )
    wr.Gaussians(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.ones((1, 3)), [0.5], np.zeros((1, 1, 3))).save_ply(
        tmp_path / "one.ply"
    )
    words, expected = BAD[case]
    before = sorted(path.name for path in tmp_path.iterdir())
    status = cli.main(f"{words} --quiet".format(tmp=tmp_path, scene=SCENE, spectra=SPECTRA).split())
    said = capsys.readouterr().err.strip()
    assert (status, said.count("\n")) == (2, 0)
    assert said.startswith("warprrf: error: ") and expected in said
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "run") == before


def test_debug_shows_the_traceback() -> None:
    with pytest.raises(ValueError, match="no such file"):
        cli.main("simulate none.xml -o x.nc --transmitter 1 1 1 --receivers 1,1,1 --debug".split())


@pytest.mark.parametrize("suffix", ["json", "csv"])
def test_known_positions_from_json_and_csv_agree(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"surveyed.{suffix}"
    path.write_text(
        '{"a.jpg": [1, 2.5, 3], "b.jpg": [4, 5, 6]}'
        if suffix == "json"
        else "file,x,y,z\na.jpg,1,2.5,3\nb.jpg,4,5,6\n"
    )
    assert read_positions(path) == {"a.jpg": (1.0, 2.5, 3.0), "b.jpg": (4.0, 5.0, 6.0)}


def test_receivers_from_file_and_words_agree(tmp_path: Path) -> None:
    expected = np.array([[1.0, 2.0, 1.5], [3.0, 4.0, 1.5]])
    (tmp_path / "r.csv").write_text("x,y,z\n1,2,1.5\n3,4,1.5\n")
    np.save(tmp_path / "r.npy", expected)
    for words in (["1,2,1.5", "3,4,1.5"], [str(tmp_path / "r.csv")], [str(tmp_path / "r.npy")]):
        np.testing.assert_array_equal(read_receivers(words), expected)


@pytest.mark.parametrize("text", ["", "x,y,z\n", "# none\n\n"])
@pytest.mark.filterwarnings("error")
def test_a_file_without_receivers_holds_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    assert read_receivers([str(tmp_path / "r.csv")]).shape == (0, 3)


def test_suggest_writes_the_places_that_it_chooses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_mesh(tmp_path / "room.ply", *box_mesh([0, 0, 0], [5, 4, 3], inward=True))
    (tmp_path / "candidates.csv").write_text("x,y,z\n1,1,1.5\n4,3,1.5\n-0.0,9,1\n")
    words = ["suggest", f"{tmp_path}/room.ply", f"{tmp_path}/candidates.csv", "-n", "2", "--quiet"]
    words += ["--transmitter", "0.8", "0.9", "2.2", "--frequency", "300e9", "-o", f"{tmp_path}/next.csv"]
    assert cli.main(words) == 2 and "outside the scene" in capsys.readouterr().err
    (tmp_path / "candidates.csv").write_text("x,y,z\n1,1,1.5\n4,3,1.5\n2.5,3.5,1\n")
    assert cli.main(words) == 0
    chosen = read_receivers([f"{tmp_path}/next.csv"])
    assert chosen.shape == (2, 3) and len(np.unique(chosen, axis=0)) == 2
    assert {tuple(place) for place in chosen} <= {(1, 1, 1.5), (4, 3, 1.5), (2.5, 3.5, 1)}


def test_look_at_puts_the_target_in_the_middle_with_z_up() -> None:
    camera = _look_at((1.0, 2.0, 1.5), (4.0, 6.0, 1.0), (640, 480), 90.0)
    pose = camera.world_to_camera
    target, above = (pose @ (*point, 1.0) for point in ((4.0, 6.0, 1.0), (4.0, 6.0, 1.2)))
    np.testing.assert_allclose(target[:3], [0.0, 0.0, np.sqrt(3**2 + 4**2 + 0.5**2)], atol=1e-12)
    assert above[1] < 0  # y points down, so higher is negative
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert camera.fx == pytest.approx(320.0)  # half the width over tan(45 degrees)


def test_fit_takes_receivers_for_training_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import warprrf as wr

    seen: list[wr.SpectrumDataset] = []

    def fit(geometry: object, dataset: wr.SpectrumDataset, **options: object) -> None:
        seen.append(dataset)
        raise ValueError("enough")

    monkeypatch.setattr(wr.RadioField, "fit", fit)
    assert cli.main(f"fit {SCENE} {SPECTRA} -o {tmp_path}/f.safetensors --quiet".split()) == 2
    whole = wr.SpectrumDataset.load(SPECTRA)
    assert (seen[0].role == "train").all()
    assert 0 < len(seen[0]) == (whole.role == "train").sum() < len(whole)


def test_each_file_of_measurements_has_its_own_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import warprrf as wr

    head, row = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,", "13,11,2.5,7,4,1.5,"
    (tmp_path / "horn.csv").write_text(f"{head}azimuth_deg,power_db\n{row}20,-90\n")
    (tmp_path / "taps.csv").write_text(
        f"{head}azimuth_deg,tx_azimuth_deg,delay_ns,power_db\n{row}0,5,9,-90\n"
    )
    (tmp_path / "power.csv").write_text(f"{head}power_db\n{row}-90\n")
    (tmp_path / "gains.csv").write_text("1\n0.5\n0\n")
    given = {
        "receivers": np.ones((1, 3)),
        "transmitter": np.zeros(3),
        "frequency_hz": 3e11,
        "beam_sigma_rad": 0.03,
    }
    np.savez(tmp_path / "s.npz", path_gain=np.full((1, 4, 8), 1e-9), **given)
    seen: dict[str, Any] = {}

    def fit(geometry: object, data: list[Any], **options: object) -> None:
        seen.update({getattr(one, "name", "spectra"): one for one in data}, **options)
        raise ValueError("enough")

    monkeypatch.setattr(wr.RadioField, "fit", fit)
    monkeypatch.chdir(tmp_path)
    words = "s.npz horn.csv receive-pattern=10,-25 azimuth=unknown name=corner position-std=0.03 power.csv samples=1 "
    words += (
        "noise-floor-db=-140 taps.csv window=hann receive-pattern=gains.csv transmit-pattern=20 bandwidth=2e9"
    )
    shared = "--frequency 300e9 --noise-floor-db -120 --option mirror_order=2 --option lobes=[0,12] --quiet"
    assert cli.main(f"fit {SCENE} {words} -o f.safetensors {shared}".split()) == 2
    horn, power, taps = (seen[name] for name in ("corner", "power", "taps"))
    angle = np.linspace(0.0, np.pi, 9)
    np.testing.assert_allclose(horn.receive_pattern(angle), wr.horn(np.radians(10), -25.0)(angle))
    assert (horn.azimuth_known, horn.position_std_m, horn.samples, horn.floor[0]) == (
        False,
        0.03,
        None,
        1e-12,
    )
    assert (power.samples, power.azimuth_known, power.frequency_hz) == (1, True, 300e9)
    assert power.floor[0] == pytest.approx(1e-14)
    assert (taps.window, taps.bandwidth_hz, horn.bandwidth_hz) == ("hann", 2e9, None)
    np.testing.assert_array_equal(taps.receive_pattern, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(taps.transmit_pattern(angle), wr.horn(np.radians(20))(angle))
    assert seen["spectra"].shape == (4, 8) and (seen["mirror_order"], seen["lobes"]) == (2, (0, 12))


def test_materials_that_are_given_are_those_of_a_mesh_whatever_lies_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import warprrf as wr

    seen: list[wr.Scene] = []
    monkeypatch.setattr(wr, "relevance", lambda scene, **_: seen.append(scene) or {}[0])
    (tmp_path / "room.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl pane\nf 1 2 3\n")
    (tmp_path / "mine.json").write_text('{"pane": {"itu": "glass", "thickness": 0.01}}')
    (tmp_path / "materials.json").write_text('{"metadata": 4}')
    words = f"relevance {tmp_path}/room.obj --receivers 2,2,1 --transmitter 1 1 1 --frequency 3e11 --quiet"
    with pytest.raises(KeyError):
        cli.main([*words.split(), "--materials", f"{tmp_path}/mine.json"])
    pane, glass = seen[0].materials[0], wr.em.itu_material("glass", thickness_m=0.01)
    assert pane.name == "pane" and pane.thickness_m == 0.01
    assert pane.permittivity(3e11) == glass.permittivity(3e11)
    (tmp_path / "mine.json").write_text('{"pane": {"thicknes": 0.01}}')
    assert cli.main([*words.split(), "--materials", f"{tmp_path}/mine.json"]) == 2
    assert "got thicknes, expected among itu, thickness" in capsys.readouterr().err


def test_the_carrier_has_one_name() -> None:
    commands = cli._parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    named = {
        word
        for command in commands.values()
        for action in command._actions
        for word in action.option_strings
        if re.search("carrier|freq|hertz|ghz", word)
    }
    assert named == {"--frequency"}


def test_sample_render_and_suggest_say_what_the_library_says(tmp_path: Path) -> None:
    import warprrf as wr

    def run(words: str) -> None:
        assert cli.main([*words.format(tmp=tmp_path, scene=SCENE).split(), "--quiet", "--device", "cpu"]) == 0

    run("sample {scene} -o {tmp}/r.csv -n 5 --height 1 1.5 --clearance 0.5 --seed 3")
    expected = wr.sample_receivers(wr.Scene.load(SCENE), 5, z=(1, 1.5), clearance=0.5, seed=3)
    np.testing.assert_allclose(read_receivers([f"{tmp_path}/r.csv"]), expected, rtol=1e-11)
    field = make.bistatic()
    field.save(tmp_path / "f.safetensors")
    place, sender = field.transmitter + [2.0, 0.3, -1.0], field.transmitter + [0.5, 0.5, -0.2]
    asked = "render {tmp}/f.safetensors -o {tmp}/s.npz --receiver " + " ".join(map(repr, map(float, place)))
    run(f"{asked} --transmitter {' '.join(map(repr, map(float, sender)))} --frequency 140e9")
    other = field.at_frequency(140e9).spectrum(place, sender)
    np.testing.assert_allclose(np.load(tmp_path / "s.npz")["path_gain"], other.path_gain, rtol=1e-5)
    run(f"{asked} --array 4 2 --facing 30 60")
    array = wr.PlanarArray(4, 2, orientation=(np.pi / 6, -np.pi / 3, 0.0))
    heard = field.array_spectrum(place, array, pixel_directions(field.shape))
    np.testing.assert_allclose(np.load(tmp_path / "s.npz")["path_gain"], heard, rtol=1e-5)
    turned = np.array([[90.0, 0.0], [-90.0, 0.0], [180.0, 20.0]])
    np.savetxt(tmp_path / "c.csv", np.column_stack([np.tile(place, (3, 1)), turned]), delimiter=",")
    run("suggest {tmp}/f.safetensors {tmp}/c.csv -n 2 --receive-pattern 10 -o {tmp}/next.csv")
    arrival = np.radians(np.column_stack([90.0 - turned[:, 1], turned[:, 0]]))
    best = field.suggest(np.tile(place, (3, 1)), 2, arrival=arrival, receive_pattern=wr.horn(np.radians(10)))
    chosen = np.loadtxt((tmp_path / "next.csv").read_text().splitlines()[1:], delimiter=",")
    np.testing.assert_allclose(chosen[:, 3:], turned[best])


def test_help_of_fit_names_every_option_of_its_models(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["fit", "--help"])
    text = capsys.readouterr().out.partition("options of a model")[2]
    known = {f.name for kind in (FitOptions, FieldOptions) for f in fields(kind)}
    inner = {"selection", "groups", "residuals", "rates"}  # dataclasses of their own
    assert set(re.findall(r"[a-z_]+", text)) >= known - inner - {"seed", "model", "relevance"}


def test_simulate_fit_evaluate_and_render_round_trip(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the true mesh; what the commands write and print is what the library gives for the same files."""
    import warprrf as wr

    rng = np.random.default_rng(3)
    scene = wr.Scene.load(SCENE)
    places = rng.uniform([1.0, 1.0, 1.0], [14.0, 11.0, 2.0], (400, 3))
    places = places[scene.is_free(places, clearance_m=0.3)][:16]
    np.savetxt(tmp_path / "receivers.csv", places, delimiter=",")
    spectra, field = tmp_path / "spectra.nc", tmp_path / "field.safetensors"
    common = ["--quiet", "--device", "cpu"]
    simulate = ["simulate", SCENE, "-o", spectra, "--receivers", tmp_path / "receivers.csv"]
    simulate += ["--transmitter", 3.2, 2.6, 3.2, "--shape", 16, 32]
    assert cli.main([str(word) for word in [*simulate, *common]]) == 0
    fit = ["fit", SCENE, spectra, "-o", field, "--train", 10, "--iterations", 60, "--model", "rf3dgs+"]
    assert cli.main([str(word) for word in [*fit, *common]]) == 0
    evaluate = ["evaluate", field, spectra, "--train", 10, "-o", tmp_path / "figures.json"]
    assert cli.main([str(word) for word in [*evaluate, *common]]) == 0
    assert "rf3dgs+" in capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert set(figures) == {"rf3dgs+", "nearest", "idw", "constant", "mean"}
    train, test = wr.SpectrumDataset.load(spectra).split(10)
    stored_field = wr.RadioField.load(field)
    assert stored_field.report["receivers"] == len(train) == 10
    assert stored_field.report["losses"]["gain"][-1] < 0.8 * stored_field.report["losses"]["gain"][0]
    again = wr.evaluate(test, stored_field.spectrum)
    for name in ("psnr_db", "rmse_db", "tof_error_median_ns"):
        assert figures["rf3dgs+"][name] == pytest.approx(again[name], rel=1e-6)
    assert figures["nearest"]["psnr_db"] > figures["constant"]["psnr_db"]
    position = [f"{x:.3f}" for x in places[0]]
    for name in ("s.png", "s.npz"):
        assert (
            cli.main(["render", str(field), "-o", str(tmp_path / name), "--receiver", *position, *common])
            == 0
        )
    stored = np.load(tmp_path / "s.npz")
    rounded = [float(word) for word in position]
    np.testing.assert_allclose(stored["path_gain"], stored_field.spectrum(rounded).path_gain, rtol=1e-6)
    assert (tmp_path / "s.png").read_bytes()[:4] == b"\x89PNG"
    plan = ["map", field, "-o", tmp_path / "m.nc", "--cell", 4, "--bounds", 1, 1, 13, 9, "--power-dbm", 7]
    assert cli.main([str(word) for word in [*plan, *common]]) == 0
    found, expected = RadioMap.load(tmp_path / "m.nc"), stored_field.radio_map(1.5, 4, bounds=[1, 1, 13, 9])
    np.testing.assert_allclose(found.total_path_gain, expected.total_path_gain, rtol=1e-6)
    np.testing.assert_allclose(found.best_beam_snr_db, expected.best_beam_snr_db - 13.0, atol=1e-6)
    assert f"{found.free.sum()} cells in the air" in capsys.readouterr().out
    assert (tmp_path / "m.png").read_bytes()[:4] == b"\x89PNG"
