"""The measured floor: what arrives in a response made up is found; files of the measurement's format are read, and others named."""

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.measured import command, office
from benchmarks.measured.arrivals import Arrivals, Response, compared
from benchmarks.runner import Job
from warprrf.rf.em.waves import SPEED_OF_LIGHT

F = office.FREQUENCIES_HZ
PLAN = """
[info]
type = outdoor

[points]
-1 = (-22.0, 4.3)
-2 = (-22.0, 16.5)

[segments]
1 = {'name': 'PARTITION', 'connect': [-1, -2], 'z': (0.0, 3.0)}
2 = {'name': 'AIR', 'connect': [-1, -2], 'z': (0.0, 3.0)}
"""
FURNITURE = """
[cupboard]
origin = [ -20.0 , 5.0 ]
angle = 90
height = 1.98
width = 0.4
length = 1.2
matname = METAL

[table]
origin = [ -25.0 , 5.0 ]
angle = 0
height = 0.75
width = 0.8
length = 1.8
matname = WOOD
"""


def transfer(*paths):
    """Of paths (gain, delay [ns])."""
    return sum(10 ** (gain / 20) * np.exp(-2j * np.pi * F * delay * 1e-9) for gain, delay in paths)


@pytest.fixture
def source(tmp_path):
    """A folder as the command takes it: one wall, one cupboard, an antenna of a dipole's shape, and straight rays as measured."""
    files = {office.PLAN: PLAN, office.FURNITURE: FURNITURE}
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    (tmp_path / office.ANTENNA).parent.mkdir(parents=True)
    dipole = np.full((121, 2), np.sqrt(30.0 * 1.5) / np.sqrt(0.75), complex)  # 1.5 along the horizon
    held = {"Br.s3": dipole, "Br.ind": np.array([[1, 0], [2, 2]]), "fmin": 2.0, "fmax": 8.0}
    savemat(tmp_path / office.ANTENNA, held, appendmat=False)
    noise = np.random.default_rng(0)
    for folder, height in (("h1", 1.2), ("h2", 1.5)):
        for name, spot in office.TRANSMITTERS.items():
            channels = {}
            for receiver, channel in zip(office.RECEIVERS, office.CHANNELS, strict=True):
                far = np.linalg.norm(np.array([*spot, height]) - receiver)
                gain = 20 * np.log10(1.5 * SPEED_OF_LIGHT / office.FREQUENCY_HZ / (4 * np.pi * far))
                white = noise.normal(size=(2, len(F))) * 3e-5
                channels[f"CH{channel}"] = (
                    transfer((gain, far / SPEED_OF_LIGHT * 1e9)) + white[0] + 1j * white[1]
                )
            data = {"DECONV_DATA": {"FREQ_DOMAIN": {"Freq": F, **channels}}}
            (tmp_path / office.RESPONSES / folder).mkdir(parents=True, exist_ok=True)
            said = {"Tx_position": name, "Tx_height": f"{height * 100:.0f}cm"}
            savemat(tmp_path / office.RESPONSES / folder / f"{name}.mat", data | said)
    return tmp_path


def test_a_path_peaks_at_its_gain_and_delay_and_the_power_is_the_sum():
    made = Response.of(F, transfer((-60.0, 40.0), (-66.0, 52.0)), 25.0, noise=1e-6)
    found = Arrivals.of(made)
    assert (found.first_ns, found.strongest_ns) == (pytest.approx(40.0, abs=0.01),) * 2
    assert found.first_db == pytest.approx(-60.0, abs=0.05)
    np.testing.assert_allclose(found.strong_ns, [40.0, 52.0], atol=0.02)
    assert made.power(25.0, 175.0)[0] == pytest.approx(1e-6 * (1 + 10**-0.6), rel=0.01)


def test_noise_is_that_of_the_quiet_time_and_moves_arrivals_as_much_as_it_is_said_to():
    rng, found, said = np.random.default_rng(1), [], []
    for _ in range(300):
        white = rng.normal(size=(2, len(F))) * 2.0
        made = Response.of(F, transfer((0.0, 60.0)) + white[0] + 1j * white[1], 25.0)
        own = made.peaks[np.abs(made.amplitude[made.peaks]).argmax()]
        found.append((20 * np.log10(np.abs(made.amplitude[own])), made.delay_ns[own]))
        said.append((*made.noise_of(own), made.noise))
    window = np.hanning(len(F))
    level, delay, noise = np.mean(said, axis=0)
    assert noise == pytest.approx(2.0 * np.sqrt(2 * (window**2).sum()) / window.sum(), rel=0.03)
    np.testing.assert_allclose(np.std(found, axis=0), [level, delay], rtol=0.15)


def test_what_is_not_traced_is_late_for_ever_and_chance_meets_little():
    heard = Response.of(F, transfer((-60.0, 40.0)), 25.0, noise=1e-5)
    deaf = Response.of(F, transfer((-120.0, 40.0)), 25.0, noise=1e-5)
    known, none = Arrivals.of(heard), Arrivals.of(deaf)
    row = compared([known, known], [known, none], [-90.0, -90.0])
    assert (row["links"], row["missed"], row["first_ns"]) == (2, 1, np.inf)
    assert row["first_db"] == pytest.approx(30.0 / np.sqrt(2), abs=0.05)
    assert (row["met"], row["by_chance"]) == (0.5, 0.0)


def test_links_walls_and_metal_are_read_as_they_were_written(source):
    found = office.place(source, 0)
    far = found.links.distance_m
    expected = 20 * np.log10(1.5 * SPEED_OF_LIGHT / office.FREQUENCY_HZ / (4 * np.pi * far))
    np.testing.assert_allclose(found.links.level_db, expected, atol=0.3)
    assert len(found.links) == 24 and set(found.links.anchor) == {1, 2, 3, 4}
    assert (found.links.walls[:, 0] == 1).all()  # x = -22 stands between all ends
    straight = found.more["arrivals"][0]
    assert straight["missed"] == 0 and straight["first_ns"] < 0.02 and straight["first_db"] < 0.3
    wall = found.more["arrivals"][1]
    assert 0.1 < wall["first_ns"] < 0.3 and -8.0 < wall["first_mean_db"] < -3.0
    assert [row["later_most_ns"] for row in found.more["heights"] if row["height_m"] == 1.2] == [0.0]
    metal = office.scene(source, "metal")
    assert metal.mesh.cast([-20.2, 5.6, 2.5], [0, 0, -1]).t == pytest.approx(0.52, abs=1e-5)
    assert metal.mesh.cast([-24.5, 5.4, 2.5], [0, 0, -1]).t == pytest.approx(2.5, abs=1e-5)


def test_the_antenna_of_a_dipole_s_shape_has_its_gain(source):
    np.testing.assert_allclose(np.abs(office.antenna(source, F)) ** 2, 1.5, rtol=1e-12)


def test_what_is_held_out_is_half_of_the_links(source):
    links = office.place(source, 0).links
    held = list(links.held_out(("pair", "height")))
    assert len(held) == 6 + 2 and all(out.sum() == 12 for _, _, out in held)


def test_what_is_missing_or_of_another_place_is_named(source, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no file \*\.mat there; --source is a copy of the repository"
    ):
        office.responses(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"there is no data.ant.defant\.vsh3, which the repository"):
        office.antenna(tmp_path / "nowhere", F)
    file = source / office.RESPONSES / "h1" / "P001.mat"
    savemat(file, {"Tx_position": "P001", "Tx_height": "120cm"})
    with pytest.raises(ValueError, match=r"P001\.mat: KeyError\('DECONV_DATA'\): expected"):
        office.responses(source / office.RESPONSES)
    with pytest.raises(ValueError, match="hold_out: got room, expected some of pair, height of the office"):
        file.unlink()
        command.run(command.Options("office", str(source), ("room",)), Job(tmp_path))
