"""Paths to NetCDF and back."""

from dataclasses import replace

import numpy as np
import pytest
import xarray
from path_makers import random_paths

from warprrf.rf.paths.path_set import Paths


def same(a, b):
    for name in Paths.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y)
            assert x.dtype == y.dtype
        else:
            assert x == y, name


@pytest.mark.parametrize("jones", [False, True])
def test_nothing_is_lost(tmp_path, jones):
    one = random_paths(4, jones=jones)
    several = Paths.stack([one, random_paths(2, seed=1, kind="diffuse", jones=jones)]).with_gas()
    for k, p in enumerate((one, several, replace(one, frequency_hz=None, transmitter=None, receiver=None))):
        p.save(tmp_path / f"{k}.nc")
        same(p, Paths.load(tmp_path / f"{k}.nc"))
    assert sorted(f.name for f in tmp_path.iterdir()) == ["0.nc", "1.nc", "2.nc"]  # no temporary files left


def rewritten(tmp_path, paths, change):
    """A file of ``paths`` as another tool, or an older version, writes it."""
    paths.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_cf=False) as opened:
        change(opened.load()).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    return tmp_path / "b.nc"


@pytest.mark.parametrize("filled", [("jones_imag",), ("jones_real", "jones_imag")])
def test_a_jones_matrix_is_known_whole_or_not_at_all(tmp_path, filled):
    paths = random_paths(4, jones=True)
    paths.jones[:, 0, 1] = 0.0
    empty = {"_FillValue": 0.0}
    path = rewritten(
        tmp_path, paths, lambda data: data.assign({n: data[n].assign_attrs(empty) for n in filled})
    )
    with pytest.raises(ValueError, match=r"b\.nc: .*jones: got 4 .*in part"):
        Paths.load(path)


def test_a_file_from_before_interactions_were_told_is_read(tmp_path):
    one = random_paths(4)
    same(Paths.load(rewritten(tmp_path, one, lambda data: data.drop_vars("interactions"))), one)


def test_a_heap_in_which_hdf5_would_go_round_for_ever_is_refused(tmp_path):
    path = tmp_path / "a.nc"
    random_paths(4).save(path)
    data = bytearray(path.read_bytes()).partition(b"\nwarprrf sha256 ")[0]
    at = data.index(b"GCOL") + 16
    data[at : at + 16] = bytes(16)  # free space of no size comes first
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.nc: damaged.*heap"):
        Paths.load(path)
