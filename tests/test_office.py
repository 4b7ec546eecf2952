"""An office from its drawing to field, scores, page and twin, by the command line alone; readings are made as a meter's."""

import json
import re
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from office import BEFORE_GLASS, BEHIND_GLASS, CARRIER_HZ, TRANSMITTER, office

import warprrf as wr
from warprrf import cli
from warprrf.rf.spectra.spectrum import pixel_directions

SHAPE, METER, CHAIN_DB, HORN_DEG = (30, 60), (45, 90), 7.0, 20.0
NAMES = ("concrete", "ceiling_board", "plasterboard", "glass", "wood", "chipboard")
SOURCE = [str(x) for x in TRANSMITTER]
CSV = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z"


def write_readings(truth, folder):
    """A horn turned in azimuth at three places, its chain's gain unknown; calibrated power at the others."""
    toward = pixel_directions(METER).reshape(-1, 3)
    ends = [",".join(map(str, (*TRANSMITTER, *place))) for place in truth.receivers]
    rows = [f"{CSV},azimuth_deg,elevation_deg,power_db,chain"]
    for k in range(3):
        for azimuth in range(-180, 180, 15):
            ahead = np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.0])
            gain = wr.horn(np.radians(HORN_DEG)).gain_off_boresight(np.arccos((toward @ ahead).clip(-1, 1)))
            power = 10 * np.log10(truth.path_gain[k].reshape(-1) @ gain) + CHAIN_DB
            rows.append(f"{ends[k]},{azimuth},0,{power:.2f},horn")
    (folder / "horn.csv").write_text("\n".join(rows) + "\n")
    total = 10 * np.log10(truth.path_gain.sum(axis=(1, 2)))
    rows = [f"{ends[k]},{total[k]:.2f}" for k in range(3, len(ends))]
    (folder / "power.csv").write_text("\n".join([f"{CSV},power_db", *rows]) + "\n")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """The folder after `sample`, `simulate` and `fit`."""
    folder = tmp_path_factory.mktemp("office")
    table = {name: {"scattering": 0.4, **({"thickness": 0.01} if name == "glass" else {})} for name in NAMES}
    (folder / "table.json").write_text(json.dumps(table))
    scene = [str(office(folder)), "--materials", str(folder / "table.json")]
    run("sample", *scene, "-o", folder / "places.csv", "-n", "16", "--height", "1", "1.6")
    measured = [",".join(map(str, where)) for where in BEFORE_GLASS]
    for name, places, shape, beam in (
        ("measured", measured, METER, 2),
        ("truth", [folder / "places.csv"], SHAPE, 5),
    ):
        run("simulate", *scene, "-o", folder / f"{name}.nc", "--transmitter", *SOURCE, "--receivers", *places,
            "--frequency", CARRIER_HZ, "--shape", *shape, "--beam-sigma-deg", beam)  # fmt: skip
    write_readings(wr.SpectrumDataset.load(folder / "measured.nc"), folder)
    run("fit", *scene, folder / "horn.csv", f"receive-pattern={HORN_DEG}", folder / "power.csv", "-o",
        folder / "field.safetensors", "--frequency", CARRIER_HZ, "--noise-floor-db", -150)  # fmt: skip
    return folder


def run(*words):
    assert cli.main([*map(str, words), "--quiet"]) == 0, words


def test_the_office_s_places_are_in_its_air_before_and_behind_the_glass(place):
    places = np.loadtxt(place / "places.csv", delimiter=",", skiprows=1)
    assert len(places) == 16
    assert not ((places[:, 0] > 5) & (places[:, 1] > 3.5)).any()  # the corner that is cut out
    assert (places[:, 0] > 6.5).any() and wr.Scene.load(place / "office.obj").is_free(BEHIND_GLASS).all()


def test_a_horn_and_a_power_meter_make_a_field_that_is_right_where_nobody_measured(place):
    field = wr.RadioField.load(place / "field.safetensors")
    assert field.report["chains"]["horn"]["gain_db"] == pytest.approx(CHAIN_DB, abs=0.6)
    words = "evaluate {0}/field.safetensors {0}/truth.nc -o {0}/figures.json --no-lookups"
    run(*words.format(place).split())
    figures = json.loads((place / "figures.json").read_text())["bistatic"]
    assert figures["receivers"] == 2 and figures["psnr_db"] > 24.0 and figures["direction_within_3deg"] > 0.8
    truth = wr.SpectrumDataset.load(place / "truth.nc")
    seen = truth.subset(truth.line_of_sight)
    total = field.spectra(seen.receivers).path_gain.sum(axis=(1, 2)) / seen.path_gain.sum(axis=(1, 2))
    assert np.median(np.abs(10 * np.log10(total))) < 0.5


def test_the_page_opens_with_all_of_it(place):
    things = "office.obj field.safetensors truth.nc horn.csv receive-pattern=20"
    options = f"--frequency {CARRIER_HZ} --noise-floor-db -150 --port 8210 --no-browser"
    command = [sys.executable, *f"-m warprrf view {things} {options}".split()]
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=place, **said) as page:
        try:
            found = (re.search(r"http://127\.0\.0\.1:\d+\S*", line) for line in page.stdout)
            address = next(filter(None, found))
            assert b"<html" in urllib.request.urlopen(address[0]).read()
        finally:
            page.terminate()


def test_the_twin_is_the_office_with_its_glass(place):
    run("twin", place / "field.safetensors", "-o", place / "twin")
    twin = wr.Scene.load(place / "twin" / "scene.xml")
    thickness = {m.name.removeprefix("fitted_"): m.thickness_m for m in twin.materials}
    assert thickness["glass"] == pytest.approx(0.01)
