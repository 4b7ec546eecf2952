"""What every public verb gave on small inputs when the goldens were written (:mod:`golden.make`), it gives today."""

import numpy as np
import pytest
from golden import make


@pytest.mark.parametrize("name", make.CASES)
def test_results_are_what_they_were(name):
    with np.load(make.HERE / f"{name}.npz") as golden:
        found = make.values(name)
        assert sorted(found) == sorted(golden.files)
        wrong = {key: check.failure(value, golden[key]) for key, (value, check) in found.items()}
    told = [f"{key}: {w}" for key, w in wrong.items() if w]
    assert not told, "\n".join(told)


def test_a_check_sees_what_it_is_there_to_see():
    image = np.geomspace(1e-12, 1e-6, 400)
    assert make.BITS.failure(image, image) is None
    assert make.BITS.failure(image * (1 + 1e-15), image)
    assert make.FLOAT64.failure(image * (1 + 1e-8), image)
    assert make.EXACT.failure(image * 1.01, image)
    assert make.FITTED.failure(image * 1.1, image)
    assert make.FITTED.failure(image * 1.02, image) is None
    assert make.PIXELS.failure(np.where(np.arange(400) < 2, 2.0, image), image) is None
    assert make.PIXELS.failure(np.where(np.arange(400) < 3, 2.0, image), image)
