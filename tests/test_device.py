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


@wp.struct
class Weighted:
    points: wp.array(dtype=wp.vec3d)
    count: int


@wp.kernel(enable_backward=False)
def add_up(
    offset: int, given: Weighted, weight: wp.array(dtype=wp.float64), total: wp.array(dtype=wp.float64)
):
    i = offset + wp.tid()
    total[i] = weight[i] * wp.length(given.points[i]) + wp.float64(given.count)


def test_arrays_of_numpy_are_taken_for_what_the_kernel_and_its_structures_take(device):
    points = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    weight, total = np.arange(COUNT), wp.zeros(COUNT, dtype=wp.float64, device=device)
    given = module.filled(Weighted, device, points=points, count=2)
    module.launch(add_up, COUNT, [given, weight, total], device=device)
    expected = weight * np.linalg.norm(points.astype(float), axis=1) + 2.0
    np.testing.assert_allclose(total.numpy(), expected, rtol=1e-12)


def test_progress_is_told_of_an_item_once_it_is_done_with():
    events = []
    for item in module.with_progress("ab", "letters", lambda *told: events.append(told)):
        events.append(item)
    assert events == ["a", ("letters", 1, 2), "b", ("letters", 2, 2)]
    assert list(module.with_progress([3, 4], "numbers", None)) == [3, 4]
