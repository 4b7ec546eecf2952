"""Fields whose checksum fits and whose contents cannot be are refused; what damage of bytes does is in ``tests/fuzz``."""

import numpy as np
import pytest

import warprrf as wr
from warprrf import tensor_files


def spoilt(path, out, changes):
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
        ({"lobes": [10**9, 4, 12]}, "lobes"),
        ({"effects": {"mirrors": 9}}, "mirrors"),
        ({"range_db": [None, 0.0]}, "range_db"),
        ({"floor": 0.0}, "floor"),
        ({"air_temperature_k": -1.0}, "temperature_k"),
        ({"log_gain": 1e9}, "log_gain"),
        ({"mesh/vertices": np.full((16, 3), 1e30)}, "vertices"),
        ({"residual": np.full((2, 5), 0.1)}, "residual"),
        ({"material": np.array([0, 2], np.int32)}, "material"),
        ({"errors/covariance": np.eye(3)}, "covariance"),
        ({"layer/aod_y": None}, "layers: got aod_x, aod_z, delay, gain, exp"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_field_that_states_what_cannot_be_is_refused(changes, named, place, tmp_path):
    name = "rf3dgs.safetensors" if "layer/aod_y" in changes else "bistatic.safetensors"
    path = spoilt(place.folder / name, tmp_path, changes)
    with pytest.raises(ValueError, match=rf"{name}: .*({named})"):
        wr.RadioField.load(path)


def test_nan_in_a_report_is_unknown(place, tmp_path):
    path = place.folder / "bistatic.safetensors"
    report = tensor_files.read(path)[1]["report"]
    found = wr.RadioField.load(spoilt(path, tmp_path, {"report": report | {"fit_time_s": float("nan")}}))
    assert found.report == report | {"fit_time_s": None}


def test_other_tools_open_what_carries_a_checksum(place):
    from safetensors import safe_open

    path = place.folder / "bistatic.safetensors"
    field = wr.RadioField.load(path)
    with safe_open(path, framework="numpy") as file:
        assert len(file.metadata()["sha256"]) == 64
        np.testing.assert_array_equal(file.get_tensor("transmitter"), field.transmitter)


def test_a_mesh_of_more_or_fewer_rows_than_stated_is_refused(place, tmp_path):
    whole = (place.folder / "walls.ply").read_bytes()
    for stated in (b"element face 11\n", b"element face 13\n", b"element face 99999999999\n"):
        (tmp_path / "walls.ply").write_bytes(whole.replace(b"element face 12\n", stated))
        with pytest.raises(ValueError, match=r"walls\.ply"):
            wr.Reconstruction.from_files(place.folder / "splats.ply", mesh=tmp_path / "walls.ply")
