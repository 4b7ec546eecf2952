"""Launches are cut over threads; tests/test_concurrency.py has them in forked children."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from warprrf import device as module

COUNT = 5 * module.MIN_SPLIT + 3  # cut unevenly wherever there are threads


@wp.kernel(enable_backward=False)
def count_visits(offset: int, visits: wp.array(dtype=int)):
    i = offset + wp.tid()
    visits[i] = visits[i] + i + 1


@pytest.mark.parametrize("how", [{}, {"grain": 1}, {"pieces": 7}, {"cuts": [200, 250, 250, 300]}])
@pytest.mark.parametrize("count", [1, 3])
def test_a_launch_visits_every_index_of_its_range_once(how, count, device, monkeypatch):
    first, last = (200, 300) if "cuts" in how and device == "cpu" else (0, COUNT)
    with ThreadPoolExecutor(3) as pool:
        monkeypatch.setattr(module, "threads", lambda: count)
        monkeypatch.setattr(module, "_pool", lambda: pool)
        visits = wp.zeros(COUNT, dtype=int, device=device)
        module.launch(count_visits, COUNT, [visits], device=device, **how)
    index = np.arange(COUNT)
    assert np.array_equal(visits.numpy(), np.where((index >= first) & (index < last), index + 1, 0))


@pytest.mark.cuda
@pytest.mark.parametrize(("launched_on", "made_on"), [("cuda:0", "cpu"), ("cpu", "cuda:0")])
def test_an_array_of_the_other_device_is_refused(launched_on, made_on):
    """So a forgotten `device=` shows in every marked test, on a second CPU device too."""
    visits = wp.zeros(COUNT, dtype=int, device=made_on)
    with pytest.raises(RuntimeError, match="allocated on the launch device"):
        module.launch(count_visits, COUNT, [visits], device=launched_on)
    module.launch(count_visits, COUNT, [visits.to(launched_on)], device=launched_on)
