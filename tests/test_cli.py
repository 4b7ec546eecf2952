"""The command line teaches, refuses bad input in one line, and carries spectra from a scene to a scored field."""

import json
import re
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from golden import make
from places import ROOT
from rays_by_definition import gaussians
from small_room import small_room

import warprrf as wr
from warprrf import cli
from warprrf.cli.inputs import PLACES, POINTINGS, load_geometry, read_positions, read_receivers
from warprrf.cli.views import _look_at, _thickness
from warprrf.rf.fields.bistatic.options import FitOptions
from warprrf.rf.fields.harmonic.fitting import FieldOptions
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.spectra.spectrum import pixel_directions

SCENE = ROOT / "data" / "lobby" / "scene.xml"
SPECTRA = ROOT / "data" / "lobby" / "spectra.nc"
COMMANDS = (
    "reconstruct", "sample", "simulate", "fit", "suggest", "locate", "relevance", "render", "evaluate", "map", "twin", "view",
)  # fmt: skip


def run(words, tmp_path, status=0):
    words = words.format(tmp=tmp_path, scene=SCENE, spectra=SPECTRA).split()
    assert cli.main([*words, "--quiet", "--device", "cpu"]) == status


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example_that_the_parser_takes(command, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([*command.split(), "--help"])
    assert ended.value.code == 0
    assert re.search(rf"^    {command}\s", cli._parser().format_help(), re.MULTILINE)
    text = capsys.readouterr().out
    examples = re.findall(r"^ *warprrf (.+?)(?:   .*)?$", text, re.MULTILINE)
    assert examples
    for words in examples:
        cli._parser().parse_args(words.split())  # raises where an example is wrong


def test_a_scene_may_be_named_in_capitals(tmp_path):
    for name in ("meshes", "textures", "materials.json"):
        (tmp_path / name).symlink_to(SCENE.parent / name)
    (tmp_path / "ROOM.XML").write_bytes(SCENE.read_bytes())
    none = dict.fromkeys(("mesh", "materials", "unit", "up", "simplify"))
    found = load_geometry(
        tmp_path / "ROOM.XML", SimpleNamespace(**none, allow_outside=True, extrapolate=False)
    )
    assert isinstance(found, wr.Scene) and len(found.materials) > 1


def test_scenes_that_name_itu_materials_alone_go_in(tmp_path, capsys):
    (tmp_path / "room.xml").write_text(
        '<scene version="3.0.0"><bsdf type="itu-radio-material" id="it"><string name="type" value="metal"/></bsdf>'
        '<shape type="cube"><ref id="it"/><boolean name="flip_normals" value="true"/></shape></scene>'
    )
    words = "simulate {tmp}/room.xml -o {tmp}/x.nc --shape 8 16 --transmitter 0.5 0 0 --receivers 0,0.5,0.1"
    run(words, tmp_path, status=2)
    assert "1 to 100 GHz" in capsys.readouterr().err  # metal, at 300 GHz
    run(f"{words} --extrapolate", tmp_path)
    run(f"{words} --frequency 60e9", tmp_path)


def test_examples_of_simulate_that_need_the_repository_alone_run(tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        cli.main(["simulate", "--help"])
    lines = re.findall("warprrf (simulate .*data/lobby.*)", capsys.readouterr().out)
    runnable = [line.split() for line in lines if not re.search(r"receivers\.csv|sionna", line)]
    assert runnable
    for words in runnable:
        assert cli.main([*words, "--shape", "8", "16", "--quiet"]) == 0


def test_numbers_below_zero_are_no_options():
    words = "simulate s.xml -o x.nc --transmitter -1e-3 -2 -.5 --receivers -1,4,-1.5".split()
    seen = []
    parser = cli._parser()
    for action in parser._subparsers._group_actions[0].choices.values():
        action.set_defaults(command=lambda args, out: seen.append((args.transmitter, args.receivers)))
    assert cli.run(parser, words) == 0
    (transmitter, receivers) = seen[0]
    assert transmitter == [-0.001, -2.0, -0.5]
    np.testing.assert_array_equal(read_receivers(receivers), [[-1.0, 4.0, -1.5]])


@pytest.mark.parametrize("kind", [ValueError, TypeError, OSError, ImportError, MemoryError])
def test_what_went_wrong_is_one_line_and_a_bug_is_a_traceback(kind, monkeypatch, capsys):
    def fail(error):
        def load(path, device=None):
            raise error("first line\nsecond")

        return load

    words = ["twin", str(SCENE), "-o", "none"]
    monkeypatch.setattr(wr.RadioField, "load", fail(kind))
    assert cli.main(words) == 2
    assert capsys.readouterr().err == "warprrf: error: first line second\n"
    for bug in (AttributeError, KeyError, RuntimeError):
        monkeypatch.setattr(wr.RadioField, "load", fail(bug))
        with pytest.raises(bug):
            cli.main(words)


SIMULATE = "simulate {scene} -o {tmp}/x.nc --transmitter 2 3 3 --receivers"
RENDER = "render -o {tmp}/x.png"
FIT = "fit {scene} -o {tmp}/f.safetensors"
HORN = f"{FIT} --frequency 300e9 --noise-floor-db -120 {{tmp}}/horn.csv"
SUGGEST = "suggest {scene} 2,2,1 --transmitter 13.6 11.2 2.5"
BAD = {
    "no scene": (SIMULATE.replace("{scene}", "none.xml") + " 2,2,1", "none.xml"),
    "a folder in the place of the result": (SIMULATE.replace("{tmp}/x.nc", "{tmp}") + " 7,4,1.5", "expected the name of a file"),
    "a result below a file": (SIMULATE.replace("x.nc", "one.ply/a/x.nc") + " 7,4,1.5", "one.ply is no folder that may be"),
    "a result where none may be written": (SIMULATE.replace("{tmp}/x", "/proc/self/x") + " 7,4,1.5", "/proc/self is no folder"),
    "empty name of the result": (SIMULATE.replace("-o {tmp}/x.nc", "--out=") + " 7,4,1.5", "-o/--out: got ''"),
    "folder in the place of a scene": ("sample {tmp} -o {tmp}/r.csv", "is a folder, expected a scene file"),
    "materials of a reconstruction": ("relevance {tmp} --receivers 2,2,1 --materials {tmp}/materials.json", "--materials"),
    "mesh of a reconstruction, which has one": ("fit {tmp} {spectra} -o {tmp}/f --mesh {tmp}/one.ply", "--mesh: got"),
    "unit of a reconstruction": ("relevance {tmp} --receivers 2,2,1 --unit mm", "--unit: got 'mm', but"),
    "axis of a mesh that splats lack": ("relevance {tmp}/one.ply --receivers 2,2,1 --up y", "no --mesh is given"),
    "bands of a reconstruction": ("fit {tmp} {spectra} -o {tmp}/f --extrapolate", "--extrapolate: got True, but"),
    "bands of a field": ("relevance {tmp}/bad.safetensors --receivers 2,2,1 --extrapolate", "is a field, which has its own"),
    "scale that is no number": ("reconstruct {tmp} -o {tmp}/out --scale a.jpg b.jpg far", "--scale"),
    "horn of no table": (f"{FIT} {{tmp}}/bad.nc --receive-pattern 10", "--receive-pattern"),
    "fading of spectra, behind their file": (f"{FIT} {{tmp}}/bad.nc samples=1", "--samples"),
    "setting of a file that there is not": (f"{HORN} azimut=unknown", "horn.csv: got 'azimut=unknown' behind it, expected"),
    "part of a table": (f"{HORN} --train 3", "--train"),
    "floor that is no number": (f"{HORN} noise-floor-db=4000", "--noise-floor-db"),
    "horn that looks through its own foot": (f"{HORN} receive-pattern=10", "zenith of -1.91986"),
    "pattern of three numbers": (f"{HORN} --receive-pattern 10,-25,3", "'10,-25,3'"),
    "option of no model": (f"{FIT} {{spectra}} --option colour=red", "colour"),
    "option without a value": (f"{FIT} {{spectra}} --option quick", "--option: got 'quick', expected NAME=VALUE"),
    "option that has a name of its own": (f"{FIT} {{spectra}} --option seed=3", "--option: got 'seed=3', expected --seed"),
    "option twice": (f"{FIT} {{spectra}} --option quick=false --quick", "got quick twice"),
    "effects of a fit": (f"{SIMULATE} 7,4,1.5 --effects auto", "--effects: got 'auto', expected single, room, everything"),
    "effects by a list": (f"{SIMULATE} 7,4,1.5 --effects [1]", "--effects: got '[1]', expected single, room"),
    "effects by a wrong name": (f'{FIT} {{spectra}} --effects {{{{"mirror":2}}}}', "got mirror, expected among line_of_sight"),
    "effects of Sionna": (f"{SIMULATE} 7,4,1.5 --engine sionna --effects room", "--effects: got 'room'"),
    "walls of Sionna": (f"{SIMULATE} 7,4,1.5 --refraction", "--refraction: got True, but engine exact has --effects"),
    "table in the place of JSON": ("relevance {scene} --spectra {spectra} -o {tmp}/r.md", "--out: got"),
    "picture of others where a map's goes": ("map {tmp}/bad.safetensors -o {tmp}/mine.nc", "mine.png would be written over"),
    "text of others where a table goes": ("relevance {scene} --spectra {spectra} -o {tmp}/mine.json", "mine.md would be written"),
    "what is not ours in the place of unfinished work": (SIMULATE.replace("x.nc", "mine.nc") + " 7,4,1.5", "is no earlier run's"),
    "result in the place of a mesh": ("sample {tmp}/one.ply -o {tmp}/../{tmp.name}/one.ply", "which the command reads"),
    "result in the place of readings": (HORN.replace("f.safetensors", "horn.csv"), "which the command reads"),
    "pointings without a direction": (f"{SUGGEST} --frequency 3e11 --receive-pattern 10", "azimuth"),
    "camera looks straight up": (f"{RENDER} {{tmp}}/one.ply --position 0 0 1 --look-at 0 0 2", "--look-at"),
    "picture of no kind": ("render {tmp}/one.ply -o {tmp}/v --position 0 0 1 --look-at 1 0 1", "v: expected .png (a picture) or"),
    "spectrum of no kind": ("render {tmp}/bad.safetensors -o {tmp}/v.jpg --receiver 1 1 1", "expected .png (a picture) or .npz"),
    "camera of a field": (f"{RENDER} {{tmp}}/bad.safetensors --receiver 1 1 1 --size 9 9", "--size: got [9, 9], but"),
    "receiver of splats": (f"{RENDER} {{tmp}}/one.ply --position 0 0 1 --look-at 1 0 1 --receiver 1 1 1", "is no radio field"),
    "direction of no array": (f"{RENDER} {{tmp}}/bad.safetensors --receiver 1 1 1 --facing 0 0", "no --array is given"),
    "field without receiver": (f"{RENDER} {{tmp}}/bad.safetensors", "--receiver"),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(BAD))
def test_bad_input_is_one_line_and_status_2(case, tmp_path, capsys):
    (tmp_path / "materials.json").write_text("[5]")
    (tmp_path / "horn.csv").write_text(
        "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,azimuth_deg,elevation_deg,power_db\n13,11,2.5,7,4,1.5,0,200,-90\n"
    )
    (tmp_path / "bad.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0notjson!")
    (tmp_path / "bad.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    gaussians().save_ply(tmp_path / "one.ply")
    (tmp_path / "mine.nc.receivers").mkdir()
    for name in ("mine.png", "mine.md", "mine.nc.receivers/mine.csv"):
        (tmp_path / name).write_text("mine")
    words, expected = BAD[case]
    before = sorted(path.name for path in tmp_path.iterdir())
    run(words, tmp_path, status=2)
    said = capsys.readouterr().err.strip()
    assert said.startswith("warprrf: error: ") and expected in said and said.count("\n") == 0
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "run") == before


def test_an_interrupted_fit_says_where_its_checkpoint_is(tmp_path, monkeypatch, capsys):
    def fit(*_, checkpoint, **__):
        (tmp_path / checkpoint).write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr(wr.RadioField, "fit", fit)
    run(f"{FIT} {{spectra}} --model rf3dgs --option checkpoint={{tmp}}/half", tmp_path, status=130)
    assert f"finished work is kept in {tmp_path / 'half'}, the same command" in capsys.readouterr().err


def test_debug_shows_the_traceback():
    with pytest.raises(ValueError, match="no such file"):
        cli.main("simulate none.xml -o x.nc --transmitter 1 1 1 --receivers 1,1,1 --debug".split())


def test_known_positions_from_json_and_csv_agree(tmp_path):
    (tmp_path / "a.json").write_text('{"a.jpg": [1, 2.5, 3], "b.jpg": [4, 5, 6]}')
    (tmp_path / "a.csv").write_text("file,x,y,z\na.jpg,1,2.5,3\nb.jpg,4,5,6\n")
    for name in ("a.json", "a.csv"):
        assert read_positions(tmp_path / name) == {"a.jpg": (1.0, 2.5, 3.0), "b.jpg": (4.0, 5.0, 6.0)}


@pytest.mark.filterwarnings("error")
def test_receivers_from_file_and_words_agree(tmp_path):
    expected = np.array([[1.0, 2.0, 1.5], [3.0, 4.0, 1.5]])
    (tmp_path / "r.csv").write_text("x,y,z\n1,2,1.5\n3,4,1.5\n")
    np.save(tmp_path / "r.npy", expected)
    for words in (["1,2,1.5", "3,4,1.5"], [str(tmp_path / "r.csv")], [str(tmp_path / "r.npy")]):
        np.testing.assert_array_equal(read_receivers(words), expected)
    for none in ("", "x,y,z\n", "# none\n\n"):
        (tmp_path / "r.csv").write_text(none)
        assert read_receivers([str(tmp_path / "r.csv")]).shape == (0, 3)


def test_a_photo_has_one_known_position(tmp_path):
    (tmp_path / "a.csv").write_text("file,x,y,z\na.jpg,1,2.5,3\na.jpg,4,5,6\n")
    with pytest.raises(ValueError, match="a file stands in it twice"):
        read_positions(tmp_path / "a.csv")


def test_thicknesses_are_one_for_all_or_one_a_name():
    assert _thickness(["0.1"]) == 0.1 and _thickness(["a=b=.1", "c=2"]) == {"a=b": 0.1, "c": 2.0}
    for words in (["0.1", "0.2"], ["a=1", "a=2"], ["a=x"]):
        with pytest.raises(ValueError, match="--thickness: got .* expected M, or NAME=M of each"):
            _thickness(words)


@pytest.mark.parametrize("names", ["x,z,y", "y,x,z", "x,y,z,elevation,azimuth"])
def test_columns_in_another_order_are_refused(names, tmp_path):
    file, row = tmp_path / "r.csv", ",".join("123450"[: names.count(",") + 1])
    file.write_text(f"{names}\n{row}\n")
    with pytest.raises(ValueError, match="expected rows x,y,z"):
        read_receivers([str(file)], "candidates", PLACES if names.count(",") == 2 else POINTINGS)
    file.write_text(f"file,{names}\na.jpg,{row}\n")
    with pytest.raises(ValueError, match="CSV file,x,y,z"):
        read_positions(file)


def test_look_at_puts_the_target_in_the_middle_with_z_up():
    camera = _look_at((1.0, 2.0, 1.5), (4.0, 6.0, 1.0), (640, 480), 90.0)
    pose = camera.world_to_camera
    target, above = (pose @ (*point, 1.0) for point in ((4.0, 6.0, 1.0), (4.0, 6.0, 1.2)))
    np.testing.assert_allclose(target[:3], [0.0, 0.0, np.sqrt(3**2 + 4**2 + 0.5**2)], atol=1e-12)
    assert above[1] < 0  # y points down, so higher is negative
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert camera.fx == pytest.approx(320.0)  # half the width over tan(45 degrees)


def test_each_file_of_measurements_has_its_own_settings(tmp_path, monkeypatch, capsys):
    head, row = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,", "13,11,2.5,7,4,1.5,"
    for name, columns, values in (
        ("horn", "azimuth_deg", "20"), ("taps", "azimuth_deg,tx_azimuth_deg,delay_ns", "0,5,9"), ("power", "std_db", "1"),
    ):  # fmt: skip
        (tmp_path / f"{name}.csv").write_text(f"{head}{columns},power_db\n{row}{values},-90\n")
    (tmp_path / "gains.csv").write_text("1\n0.5\n0\n")
    given = {"receivers": np.ones((1, 3)), "transmitter": np.zeros(3), "frequency_hz": 3e11}
    np.savez(tmp_path / "s.npz", path_gain=np.full((1, 4, 8), 1e-9), beam_sigma_rad=0.1, **given)
    seen = {}
    report = {
        "azimuth_zero_deg": {"corner": 7.5},
        "clock_offset_s": {"taps": -3e-9},
        "noise_db": {"power": 1.5},
        "unexplained": {"corner": [0]},
    }
    report |= {"chains": {}, "position_offset_m": {"corner": [([7, 4, 1.5], [0.02, 0, -0.01])]}}

    def fit(geometry, data, **options):
        seen.update({getattr(one, "name", len(one)): one for one in data}, **options)
        return SimpleNamespace(report=report, save=lambda path: None)

    monkeypatch.setattr(wr.RadioField, "fit", fit)
    monkeypatch.chdir(tmp_path)
    run(
        "fit {scene} {spectra} s.npz horn.csv receive-pattern=10,-25 azimuth=unknown name=corner position-std=0.03 "
        "power.csv samples=1 noise-floor-db=-140 taps.csv window=hann receive-pattern=gains.csv transmit-pattern=20 "
        "bandwidth=2e9 clock=unknown -o f.safetensors --frequency 300e9 --noise-floor-db -120 --option lobes=[0,12] "
        '--effects {{"mirrors":2,"residual":false}}',
        tmp_path,
    )  # fmt: skip
    said = capsys.readouterr().out
    told = (
        "corner: add 7.50 degrees",
        "taps: add -3.00 ns",
        "off by 0.02,0,-0.01 m",
        "power: readings are 1.50 dB",
        "from 0: 0",
    )
    assert [line for line in told if line not in said] == []
    horn, power, taps, angle = seen["corner"], seen["power"], seen["taps"], np.linspace(0.0, np.pi, 9)
    np.testing.assert_allclose(
        horn.receive_pattern.gain_off_boresight(angle),
        wr.horn(np.radians(10), -25.0).gain_off_boresight(angle),
    )
    assert (horn.azimuth_known, horn.position_std_m, horn.samples) == (False, 0.03, None)
    assert (power.samples, power.azimuth_known, power.frequency_hz) == (1, True, 300e9)
    assert (horn.floor[0], power.floor[0]) == (pytest.approx(1e-12), pytest.approx(1e-14))
    assert (taps.window, taps.bandwidth_hz, horn.bandwidth_hz) == ("hann", 2e9, None)
    assert (taps.clock_known, horn.clock_known) == (False, True)
    np.testing.assert_allclose(taps.receive_pattern.gain_off_boresight(angle[::4]), [1.0, 0.5, 0.0])
    np.testing.assert_allclose(
        taps.transmit_pattern.gain_off_boresight(angle), wr.horn(np.radians(20)).gain_off_boresight(angle)
    )
    whole = wr.SpectrumDataset.load(SPECTRA)  # whose receivers for training alone are taken
    assert (seen[(whole.role == "train").sum()].role == "train").all()
    assert seen[1].shape == (4, 8) and seen["lobes"] == (0, 12)
    assert seen["effects"] == wr.Effects(mirrors=2, residual=False)
    for words in ("--effects room", '--option effects="room"'):
        run(f"fit {{scene}} {{spectra}} s.npz -o f.safetensors {words}", tmp_path)
        assert seen["effects"] == "room"


def test_materials_that_are_given_are_those_of_a_mesh_whatever_lies_beside_it(tmp_path, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(wr, "relevance", lambda scene, **_: seen.append(scene) or {}[0])
    (tmp_path / "room.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl pane\nf 1 2 3\n")
    (tmp_path / "mine.json").write_text('{"pane": {"itu": "glass", "thickness": 0.01}}')
    (tmp_path / "materials.json").write_text('{"metadata": 4}')
    words = "relevance {tmp}/room.obj --receivers 2,2,1 --transmitter 1 1 1 --frequency 3e11 --materials {tmp}/mine.json"
    with pytest.raises(KeyError):
        run(words, tmp_path)
    pane, glass = seen[0].materials[0], wr.em.itu_material("glass", thickness_m=0.01)
    assert pane.name == "pane" and pane.thickness_m == 0.01
    assert pane.permittivity(3e11) == glass.permittivity(3e11)
    (tmp_path / "mine.json").write_text('{"pane": {"thicknes": 0.01}}')
    run(words, tmp_path, status=2)
    assert "got thicknes, expected among itu, thickness" in capsys.readouterr().err


def test_the_carrier_has_one_name():
    commands = cli._parser()._subparsers._group_actions[0].choices.values()
    words = {word for command in commands for action in command._actions for word in action.option_strings}
    assert {word for word in words if re.search("carrier|freq|hertz|ghz", word)} == {"--frequency"}


def test_sample_render_and_suggest_say_what_the_library_says(tmp_path, capsys):
    run("sample {scene} -o {tmp}/r.csv -n 5 --height 1 1.5 --clearance 0.5 --seed 3", tmp_path)
    expected = wr.sample_receivers(wr.Scene.load(SCENE), 5, z=(1, 1.5), clearance=0.5, seed=3)
    np.testing.assert_allclose(read_receivers([f"{tmp_path}/r.csv"]), expected, rtol=1e-11)
    field = make.bistatic()
    field.save(tmp_path / "f.safetensors")
    place, sender = field.transmitter + [2.0, 0.3, -1.0], field.transmitter + [0.5, 0.5, -0.2]
    asked = "render {tmp}/f.safetensors -o {tmp}/s.npz --receiver " + " ".join(map(repr, map(float, place)))
    run(f"{asked} --transmitter {' '.join(map(repr, map(float, sender)))} --frequency 140e9", tmp_path)
    other = field.at_frequency(140e9).spectrum(place, sender)
    np.testing.assert_allclose(np.load(tmp_path / "s.npz")["path_gain"], other.path_gain, rtol=1e-5)
    run(f"{asked} --array 4 2 --facing 30 60", tmp_path)
    array = wr.PlanarArray(4, 2, orientation=(np.pi / 6, -np.pi / 3, 0.0))
    heard = field.array_spectrum(place, array, pixel_directions(field.shape))
    np.testing.assert_allclose(np.load(tmp_path / "s.npz")["path_gain"], heard, rtol=1e-5)
    assert f"strongest direction {10 * np.log10(heard.max()):.2f} dB" in capsys.readouterr().out
    turned = np.array([[90.0, 0.0], [-90.0, 0.0], [180.0, 20.0]])
    np.savetxt(tmp_path / "c.csv", np.column_stack([np.tile(place, (3, 1)), turned]), delimiter=",")
    run("suggest {tmp}/f.safetensors {tmp}/c.csv -n 2 --receive-pattern 10 -o {tmp}/next.csv", tmp_path)
    arrival = np.radians(np.column_stack([90.0 - turned[:, 1], turned[:, 0]]))
    best = field.suggest(np.tile(place, (3, 1)), 2, arrival=arrival, receive_pattern=wr.horn(np.radians(10)))
    chosen = np.loadtxt((tmp_path / "next.csv").read_text().splitlines()[1:], delimiter=",")
    np.testing.assert_allclose(chosen[:, 3:], turned[best])


def test_a_reconstruction_is_drawn_as_its_gaussians_are(tmp_path):
    drawn = gaussians()
    drawn.save_ply(tmp_path / "one.ply")
    wr.Reconstruction(drawn).save(tmp_path / "room")
    for source in ("one.ply", "room"):
        run(
            f"render {{tmp}}/{source} -o {{tmp}}/{source}.png --position 0 0 1 --look-at 1 0.1 1 --size 16 8",
            tmp_path,
        )
    assert (tmp_path / "one.ply.png").read_bytes() == (tmp_path / "room.png").read_bytes()


def test_locate_takes_spectra_which_name_their_carrier(tmp_path, capsys):
    field, ds = make.bistatic(), make.spectra()
    field.save(tmp_path / "f.safetensors")
    ds.save(tmp_path / "s.nc")
    run("locate {tmp}/f.safetensors {tmp}/s.nc --receiver 4 -o {tmp}/at.json", tmp_path)
    said = json.loads((tmp_path / "at.json").read_text())["position"]
    np.testing.assert_allclose(said, field.locate(ds.subset([4])).position, atol=1e-6)
    for number in (-1, len(ds)):
        run(f"locate {{tmp}}/f.safetensors {{tmp}}/s.nc --receiver {number}", tmp_path, status=2)
        assert (
            f"--receiver: got {number}, expected a whole number of 0 to {len(ds) - 1}"
            in capsys.readouterr().err
        )
    (tmp_path / "p.csv").write_text(
        "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,power_db\n1,1,1,2,2,1,-80\n1,1,1,3,2,1,-80\n"
    )
    run("locate {tmp}/f.safetensors {tmp}/p.csv --noise-floor-db -120 --receiver 1", tmp_path, status=2)
    assert "--receiver: got 1, but no file of spectra is given" in capsys.readouterr().err


def test_help_of_fit_names_every_option_of_its_models(capsys):
    with pytest.raises(SystemExit):
        cli.main(["fit", "--help"])
    text = capsys.readouterr().out.partition("options of a model")[2]
    known = {f.name for kind in (FitOptions, FieldOptions) for f in fields(kind)}
    inner = {"selection", "groups", "residuals", "rates"}  # dataclasses of their own
    assert set(re.findall(r"[a-z_]+", text)) >= known - inner - {"seed", "model", "relevance"}


def test_the_walk_through_is_what_the_library_gives_for_the_same_files(tmp_path):
    small_room(tmp_path)
    for words in (
        "sample {tmp}/scene.xml -o {tmp}/r.csv -n 16 --height 1 2",
        "simulate {tmp}/scene.xml -o {tmp}/s.nc --receivers {tmp}/r.csv --transmitter 0.8 0.9 2.2 --shape 16 32",
        "fit {tmp}/scene.xml {tmp}/s.nc -o {tmp}/f.safetensors --train 10 --quick",
        "evaluate {tmp}/f.safetensors {tmp}/s.nc -o {tmp}/figures.json",
        "map {tmp}/f.safetensors -o {tmp}/m.nc --cell 1.5 --bounds 0.2 0.2 4.7 3.2 --power-dbm 7",
    ):
        run(words, tmp_path)
    for words in ("evaluate {tmp}/f.safetensors {tmp}/s.nc", "map {tmp}/f.safetensors -o {tmp}/n.nc"):
        assert cli.main([*words.format(tmp=tmp_path).split(), "--device", "cuda:99"]) == 2
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert set(figures) == {"bistatic", "nearest", "idw", "constant", "mean"}
    assert {row["receivers_fitted_on"] for row in figures.values()} == {0}
    train, test = wr.SpectrumDataset.load(tmp_path / "s.nc").split(10)
    field = wr.RadioField.load(tmp_path / "f.safetensors")
    again = wr.evaluate(test, field.spectrum)
    for name in ("psnr_db", "rmse_db", "tof_error_median_ns"):
        assert figures["bistatic"][name] == pytest.approx(again[name], rel=1e-6)
    # Of as many receivers, in the same order.
    nearest = wr.evaluate(test, wr.lookups.nearest(train))["psnr_db"]
    assert figures["nearest"]["psnr_db"] == pytest.approx(nearest, rel=1e-9)
    assert figures["bistatic"]["psnr_db"] > nearest > figures["constant"]["psnr_db"]
    found, expected = RadioMap.load(tmp_path / "m.nc"), field.radio_map(1.5, 1.5, bounds=[0.2, 0.2, 4.7, 3.2])
    np.testing.assert_allclose(found.total_path_gain, expected.total_path_gain, rtol=1e-6)
    np.testing.assert_allclose(found.best_beam_snr_db, expected.best_beam_snr_db - 13.0, atol=1e-6)
