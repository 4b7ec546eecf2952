"""Equal rows are found as NumPy finds them, and what belongs to them is averaged."""

import numpy as np
import pytest

from warprrf.rows import distinct_rows, group_means


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


def test_means_of_groups_are_those_of_their_members():
    rng = np.random.default_rng(0)
    rows, values = rng.integers(0, 4, (200, 2)), rng.standard_normal((200, 3))
    first, group, count = distinct_rows(rows)
    found = group_means(values, group, count)
    for mean, row in zip(found, rows[first], strict=True):
        np.testing.assert_allclose(mean, values[(rows == row).all(axis=1)].mean(axis=0), rtol=1e-12)
