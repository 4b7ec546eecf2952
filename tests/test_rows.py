"""Equal rows are found as NumPy finds them, and rows are summed as one by one."""

import numpy as np
import pytest

from warprrf.rows import couples, distinct_rows, sums_of


@pytest.mark.parametrize(("count", "columns", "values"), [(0, 2, 3), (1, 3, 3), (400, 2, 12), (900, 3, 9)])
def test_distinct_rows_are_those_of_numpy(count, columns, values):
    rng = np.random.default_rng(count)
    for rows in (
        rng.integers(0, values, (count, columns)),
        rng.choice([-1.5, -0.0, 0.0, 2.0], (count, columns)),
    ):
        found = distinct_rows(rows)
        known = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)[1:]
        for own, other in zip(found, known, strict=True):
            assert np.array_equal(own, other.reshape(-1))
        first, second = couples(rows)
        assert np.array_equal(first, np.sort(known[0][known[2] == 2])[np.argsort(np.argsort(first))])
        assert (first < second).all() and np.array_equal(rows[first], rows[second])


def test_sums_are_those_of_each_owner_s_rows():
    rng = np.random.default_rng(0)
    values, owner = rng.normal(size=(50, 3)), rng.integers(0, 7, 50)
    found = sums_of(values, owner, 9)
    assert found.shape == (9, 3)
    for k in range(9):
        np.testing.assert_allclose(found[k], values[owner == k].sum(axis=0), atol=1e-14)
