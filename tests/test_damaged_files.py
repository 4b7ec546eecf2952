"""Fields whose checksum fits and whose contents cannot be are refused; what damage of bytes does is in ``tests/fuzz``."""

from pathlib import Path

import numpy as np
import pytest
from fuzz.place import Place

import warprrf as wr
from warprrf import tensor_files


@pytest.fixture
def fields(place: Place) -> Path:
    """A folder with fields of every model."""
    return place.folder


def spoilt(path: Path, out: Path, changes: dict[str, object]) -> Path:
    """A file with parts of its header, or tensors, replaced or left out (None), and the checksum of that."""
    tensors, header = tensor_files.read(path)
    for name, value in changes.items():
        held = tensors if name in tensors else header
        held[name] = value
        if value is None:
            del held[name]
    tensor_files.write(out / path.name, tensors, header)
    return out / path.name


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
        ({"mesh/faces": np.full((4, 3), 10**6, np.int32)}, "faces"),
        ({"mesh/vertices": np.full((16, 3), 1e30)}, "vertices"),
        ({"surface/group": np.zeros(3, np.float32)}, "group"),
        ({"residual": np.full((2, 5), 0.1)}, "residual"),
        ({"transmitter": np.array([np.nan, 0, 0])}, "transmitter"),
        ({"material": np.array([0, 2], np.int32)}, "material"),
        ({"errors/covariance": np.eye(3)}, "covariance"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_field_that_states_what_cannot_be_is_refused(
    changes, named: str, fields: Path, tmp_path: Path
) -> None:
    path = spoilt(fields / "bistatic.safetensors", tmp_path, changes)
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


def test_a_field_has_all_its_layers(fields: Path, tmp_path: Path) -> None:
    path = spoilt(fields / "rf3dgs.safetensors", tmp_path, {"layer/aod_y": None})
    with pytest.raises(ValueError, match=r"rf3dgs\.safetensors: .*layers: got no aod_y"):
        wr.RadioField.load(path)


def test_nan_in_a_report_is_unknown(fields: Path, tmp_path: Path) -> None:
    path = fields / "bistatic.safetensors"
    report = tensor_files.read(path)[1]["report"]
    found = wr.RadioField.load(spoilt(path, tmp_path, {"report": report | {"fit_time_s": float("nan")}}))
    assert found.report == report | {"fit_time_s": None}


def test_other_tools_open_what_carries_a_checksum(fields: Path) -> None:
    from safetensors import safe_open

    path = fields / "bistatic.safetensors"
    field = wr.RadioField.load(path)
    with safe_open(path, framework="numpy") as file:
        assert len(file.metadata()["sha256"]) == 64
        np.testing.assert_array_equal(file.get_tensor("transmitter"), field.transmitter)


def test_a_mesh_of_more_or_fewer_rows_than_stated_is_refused(fields: Path, tmp_path: Path) -> None:
    whole = (fields / "walls.ply").read_bytes()
    for stated in (b"element face 11\n", b"element face 13\n", b"element face 99999999999\n"):
        (tmp_path / "walls.ply").write_bytes(whole.replace(b"element face 12\n", stated))
        with pytest.raises(ValueError, match=r"walls\.ply"):
            wr.Reconstruction.from_files(fields / "splats.ply", mesh=tmp_path / "walls.ply")
