"""Damaged files: 200 single flipped bits and 60 truncations of each format end in an error that names the file, or change
nothing. Formats without a checksum may take a value for another one within its range, never more than that one."""

from pathlib import Path

import numpy as np
import pytest
from damage import CUTS, FLIPS, survey
from file_formats import MAKERS, bistatic_field, harmonic_field, reconstruction, without_checksum

import warprrf as wr
from warprrf import tensor_files

UNCHECKED = {"splats", "mesh ply", "twin xml"}
"""Formats that have no place for a checksum."""
OF_ONE_VALUE = {"normals", "t", "picture"}
"""What readers derive from all values."""


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_damage_is_refused_by_the_file_s_name(name: str, tmp_path: Path) -> None:
    make, read = MAKERS[name]
    found = survey(make(tmp_path), f"file_formats:{read}")
    assert found.wrong == []
    assert found.refused + found.equal + len(found.changed) == found.copies == FLIPS + CUTS
    assert found.slowest_s < 10.0
    if name not in UNCHECKED:
        assert found.changed == []
    for damage, differ in found.changed:
        own = {value: count for value, count in differ.items() if value not in OF_ONE_VALUE}
        # Quaternions are normalised: at most the four numbers of one row differ.
        assert -1 not in own.values() and sum(own.values()) <= 4, (name, damage, differ)
        assert damage.startswith("bit")


@pytest.mark.parametrize("make", [bistatic_field, harmonic_field, reconstruction])
def test_files_of_older_versions_are_checked_by_what_they_hold(make, tmp_path: Path) -> None:
    """They have no checksum: what is accepted gives numbers, in time."""
    read = "read_reconstruction" if make is reconstruction else "read_field"
    found = survey(without_checksum(make(tmp_path)), f"file_formats:{read}")
    assert found.wrong == []
    assert found.refused > 0.4 * found.copies
    assert not any(damage.startswith("cut") for damage, _ in found.changed)


def spoilt(path: Path, **changes: object) -> Path:
    """A file with parts of its header, or tensors, replaced, and the checksum of that."""
    tensors, header = tensor_files.read(path)
    for name, value in changes.items():
        name = name.replace("__", "/")
        (tensors if name in tensors else header)[name] = value  # type: ignore[index,assignment]
    tensor_files.write(path, tensors, header)
    return path


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"terms": {"lobes": [10**9, 4, 12]}}, "lobes"),
        ({"terms": []}, "terms|list"),
        ({"shape": [10**6, 10**6]}, "shape"),
        ({"frequency_hz": 1e-300}, "frequency_hz"),
        ({"floor": 0.0}, "floor"),
        ({"beam_sigma_rad": 1e-300}, "beam_sigma_rad"),
        ({"range_db": [None, 0.0]}, "range_db"),
        ({"report": []}, "report"),
        ({"group_names": "abc"}, "group_names"),
        ({"skin_m": float("nan")}, "skin_m"),
        ({"log_gain": 1e9}, "log_gain"),
        ({"air_temperature_k": -1.0}, "temperature_k"),
        ({"mesh__faces": np.full((4, 3), 10**6, np.int32)}, "faces"),
        ({"mesh__vertices": np.full((16, 3), 1e30)}, "vertices"),
        ({"surface__group": np.zeros(3, np.float32)}, "group"),
        ({"residual": np.full((2, 5), 0.1)}, "residual"),
        ({"transmitter": np.array([np.nan, 0, 0])}, "transmitter"),
        ({"material": np.array([0, 2, 2], np.int32)}, "material"),
        ({"errors__covariance": np.eye(3)}, "covariance"),
    ],
)
def test_a_field_that_states_what_cannot_be_is_refused(changes, named: str, tmp_path: Path) -> None:
    path = spoilt(bistatic_field(tmp_path), **changes)
    with pytest.raises(ValueError, match=rf"bistatic.safetensors: .*({named})"):
        wr.RadioField.load(path)


@pytest.mark.parametrize(
    "header", ["[]", "5", "null", "{", '"x"', '{"model": "bistatic"}', '{"model": []}', "{}"]
)
def test_a_header_of_another_kind_is_refused(header: str, tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    path = tmp_path / "field.safetensors"
    save_file({"x": np.zeros(2)}, path, metadata={"format": tensor_files.FORMAT, "header": header})
    with pytest.raises(ValueError, match="field.safetensors"):
        wr.RadioField.load(path)


def test_a_field_has_all_its_layers(tmp_path: Path) -> None:
    path = harmonic_field(tmp_path, "rf3dgs")
    tensors, header = tensor_files.read(path)
    del tensors["layer/aod_y"]
    tensor_files.write(path, tensors, header)
    with pytest.raises(ValueError, match=r"rf3dgs\.safetensors: .*layers: got no aod_y"):
        wr.RadioField.load(path)


def test_nan_in_a_report_is_unknown(tmp_path: Path) -> None:
    path = bistatic_field(tmp_path)
    _, header = tensor_files.read(path)
    spoilt(path, report=header["report"] | {"fit_time_s": float("nan")})
    assert wr.RadioField.load(path).report == header["report"] | {"fit_time_s": None}


def test_other_tools_open_what_carries_a_checksum(tmp_path: Path) -> None:
    from safetensors import safe_open

    path = bistatic_field(tmp_path)
    field = wr.RadioField.load(path)
    with safe_open(path, framework="numpy") as file:
        assert len(file.metadata()["sha256"]) == 64
        np.testing.assert_array_equal(file.get_tensor("transmitter"), field.transmitter)


def test_a_mesh_of_more_or_fewer_rows_than_stated_is_refused(tmp_path: Path) -> None:
    path = MAKERS["mesh ply"][0](tmp_path)
    whole = path.read_bytes()
    for stated in (b"element face 11\n", b"element face 13\n", b"element face 99999999999\n"):
        path.write_bytes(whole.replace(b"element face 12\n", stated))
        with pytest.raises(ValueError, match="box.ply"):
            wr.Reconstruction.from_files(MAKERS["splats"][0](tmp_path), mesh=path)
