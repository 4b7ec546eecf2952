"""Launches are cut over threads; tests/test_concurrency.py has them in forked children."""

from __future__ import annotations

import numpy as np
import warp as wp

from warprrf.device import MIN_SPLIT, launch

COUNT = 5 * MIN_SPLIT + 3  # cut unevenly wherever there are threads


@wp.kernel(enable_backward=False)
def add_scaled(offset: int, factor: float, x: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = offset + wp.tid()
    out[i] = out[i] + factor * x[i] + float(i)


def scaled(device, **how):
    x = np.random.default_rng(0).random(COUNT, dtype=np.float32)
    out = wp.zeros(COUNT, dtype=float, device=device)
    launch(add_scaled, COUNT, [2.0, wp.array(x, dtype=float, device=device), out], device=device, **how)
    return out.numpy(), 2.0 * x + np.arange(COUNT, dtype=np.float32)


def test_every_index_is_run_once(device):
    for how in ({}, {"grain": 1}, {"pieces": 7}):
        found, expected = scaled(device, **how)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_given_cuts_hold():
    found, expected = scaled("cpu", cuts=[3, 3, 40, 50])
    index = np.arange(COUNT)
    np.testing.assert_allclose(found, np.where((index >= 3) & (index < 50), expected, 0.0), rtol=1e-6)
