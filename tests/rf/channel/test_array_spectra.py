"""Spectra of coherent arrays: what they are, and NeRF2's folders of pictures."""

import numpy as np
import pytest
from PIL import Image

from warprrf.rf.channel.array_spectra import UP, ArraySpectra, hemisphere
from warprrf.rf.channel.arrays import PlanarArray


@pytest.fixture
def folder(tmp_path):
    """Four pictures in NeRF2's layout, each with a bright spot; the gateway is turned by 90 degrees about z."""
    (tmp_path / "spectrum").mkdir()
    rows = ["x,y,z"]
    for k in range(4):
        picture = np.zeros((9, 36), np.uint8)
        picture[3, 9 * k] = 255
        picture[5] = 51
        Image.fromarray(picture).save(tmp_path / "spectrum" / f"{k + 1}.png")
        rows.append(f"{k + 0.5},1.0,1.5")
    (tmp_path / "tx_pos.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "gateway_info.yml").write_text(
        "gateway1:\n  position: [1.0, 2.0, 0.5]\n  orientation: [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]\n"
    )
    (tmp_path / "train_index.txt").write_text("4\n2\n1\n")
    (tmp_path / "test_index.txt").write_text("3\n")
    return tmp_path


def test_nerf2_folders_are_read_by_their_own_conventions(folder):
    known = ArraySpectra.load(folder, frequency_hz=920e6)
    assert known.power.shape == (4, 9, 36)
    assert known.power[2, 3, 18] == 1.0
    assert known.power[0, 5, 7] == pytest.approx(0.2)
    np.testing.assert_array_equal(known.transmitters[:, 0], [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_array_equal(known.receivers, np.tile([1.0, 2.0, 0.5], (4, 1)))
    # Elevation 1 degree, azimuth 1 degree; the gateway's x axis points along the world's y.
    e, a = np.radians(1.0), np.radians(1.0)
    np.testing.assert_allclose(
        known.directions[0, 0], [-np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)]
    )
    np.testing.assert_allclose(known.directions[-1, 5], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(known.array.positions(0.1)[:, 2], 0.0, atol=1e-12)  # it lies flat
    train = ArraySpectra.load(folder, frequency_hz=920e6, part="train")
    np.testing.assert_array_equal(train.transmitters[:, 0], [3.5, 1.5, 0.5])
    test = ArraySpectra.load(folder, frequency_hz=920e6, part="test", floor=0.1)
    np.testing.assert_array_equal(test.power[0], known.power[2])
    assert test.floor == 0.1


@pytest.mark.parametrize(
    ("break_it", "said"),
    [
        (lambda p: (p / "tx_pos.csv").unlink(), "tx_pos.csv is missing"),
        (lambda p: (p / "tx_pos.csv").write_text("x,y,z\n1,2,3\n"), "got 1 positions"),
        (lambda p: (p / "gateway_info.yml").write_text("position: [1, nan, 3]\n"), "gateway_info.yml.*position"),
        (lambda p: (p / "spectrum" / "1.png").rename(p / "spectrum" / "0.png"), "named '0'"),
        (lambda p: (p / "spectrum" / "2.png").write_bytes((p / "spectrum" / "1.png").read_bytes()[:50]), "2.png"),
        (lambda p: Image.new("RGB", (36, 9)).save(p / "spectrum" / "3.png"), r"3\.png.*mode RGB"),
        (lambda p: Image.new("L", (35, 9)).save(p / "spectrum" / "3.png"), r"3\.png.*first spectrum"),
    ],
)  # fmt: skip
def test_broken_folders_name_the_file(folder, break_it, said):
    break_it(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        ArraySpectra.load(folder, frequency_hz=920e6)


GOOD = {
    "transmitters": np.ones(3), "receivers": np.zeros((2, 3)), "power": np.ones((2, 5, 7)), "frequency_hz": 2.4e9,
    "array": PlanarArray(4, 4, orientation=UP), "directions": hemisphere((5, 7)),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("power", -np.ones((2, 5, 7)), "linear powers"),
        ("power", np.zeros((2, 5, 7)), "no value above the floor"),
        ("array", PlanarArray(4, 4, polarisation="V"), "polarisation"),
        ("directions", 2.0 * hemisphere((5, 7)), "unit vectors"),
    ],
)
def test_wrong_arguments_are_named(name, value, said):
    assert len(ArraySpectra(**GOOD).subset([1])) == 1
    with pytest.raises(ValueError, match=said):
        ArraySpectra(**{**GOOD, name: value})
