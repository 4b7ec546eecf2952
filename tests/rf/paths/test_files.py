"""Paths to NetCDF and back."""

from dataclasses import replace

import numpy as np
import pytest
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
