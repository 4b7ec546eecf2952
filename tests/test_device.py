"""Launches: recorded ones do what direct ones do."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import warp as wp

from warprrf.device import MIN_SPLIT, Recording, launch

COUNT = 5 * MIN_SPLIT + 3  # cut unevenly wherever there are threads


@wp.kernel(enable_backward=False)
def add_scaled(offset: int, factor: float, x: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = offset + wp.tid()
    out[i] = out[i] + factor * x[i] + float(i)


def arrays(device):
    x = np.random.default_rng(0).random(COUNT, dtype=np.float32)
    return (
        wp.array(x, dtype=float, device=device),
        *(wp.zeros(COUNT, dtype=float, device=device) for _ in range(2)),
    )


def test_recorded_launches_work_on_what_their_arrays_hold_by_then(device):
    def both(x, between, out):
        launch(add_scaled, COUNT, [2.0, x, between], device=device)
        launch(add_scaled, COUNT, [-0.5, between, out], device=device)

    direct, recorded = arrays(device), arrays(device)
    both(*direct)
    recording = Recording(lambda: both(*recorded), device)
    assert np.array_equal(recorded[2].numpy(), direct[2].numpy())  # run once, not twice
    for step in range(3):
        for x, _, _ in (direct, recorded):
            x.fill_(0.25 * step)
        both(*direct)
        recording.run()
        for a, b in zip(direct, recorded, strict=True):
            assert np.array_equal(a.numpy(), b.numpy())
    assert len(np.unique(recorded[2].numpy())) > COUNT // 2


def test_a_recording_keeps_its_arrays(device):
    x, _, out = arrays(device)
    there = weakref.ref(x)
    recording = Recording(lambda x=x: launch(add_scaled, COUNT, [1.0, x, out], device=device), device)
    once = out.numpy().copy()
    del x
    gc.collect()
    assert there() is not None
    recording.run()
    assert np.array_equal(out.numpy(), once + once)
    del recording
    gc.collect()
    assert there() is None


def test_given_cuts_hold_in_a_recording():
    x, _, out = arrays("cpu")
    recording = Recording(
        lambda: launch(add_scaled, COUNT, [0.0, x, out], device="cpu", cuts=[3, 3, 40, 50]), "cpu"
    )
    recording.run()
    index = np.arange(COUNT)
    assert np.array_equal(out.numpy(), np.where((index >= 3) & (index < 50), 2.0 * index, 0.0))


def test_recordings_are_not_nested_and_one_that_fails_leaves_none_behind():
    x, _, out = arrays("cpu")

    def inner():
        Recording(lambda: launch(add_scaled, COUNT, [0.0, x, out], device="cpu"), "cpu")

    with pytest.raises(RuntimeError, match="^work: a recording was begun while another"):
        Recording(inner, "cpu")
    out.zero_()
    launch(add_scaled, COUNT, [0.0, x, out], device="cpu")
    assert np.array_equal(out.numpy(), np.arange(COUNT))
