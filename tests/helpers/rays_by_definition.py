"""Rays through Gaussians by brute force in float64: every Gaussian on every ray, from the definition."""

import numpy as np
import pytest

import warprrf as wr


def cloud(rng, n, low=0.02, high=0.5, spread=2.0):
    return wr.Gaussians(
        rng.uniform(-spread, spread, (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))),
        rng.uniform(0.05, 1.0, n),
        np.zeros((n, 1, 3)),
    )


def one(mean=(2.0, 0.0, 0.0), scales=(0.1, 0.2, 0.3), opacity=0.5, quaternion=(1.0, 0, 0, 0)):
    return wr.Gaussians([mean], [quaternion], [scales], [opacity], np.zeros((1, 1, 3)))


def peaks(g, origin, unit):
    """Range of the peak and the response there, (N,) each: textbook form in float64."""
    whiten = g.rotations.transpose(0, 2, 1) / g.scales.astype(np.float64)[:, :, None]
    offset = np.einsum("nij,nj->ni", whiten, origin - g.means.astype(np.float64))
    toward = whiten @ unit
    t = -np.sum(offset * toward, axis=1) / np.sum(toward**2, axis=1)
    return t, np.exp(-0.5 * np.sum((offset + t[:, None] * toward) ** 2, axis=1))


def brute_hits(g, origin, direction, k, blending, order="peak"):
    unit = direction / np.linalg.norm(direction)
    t, response = peaks(g, origin, unit)
    raw = g.opacities.astype(np.float64) * response
    alpha = np.minimum(raw, blending.alpha_max)
    key = t if order == "peak" else np.linalg.norm(g.means.astype(np.float64) - origin, axis=1)
    chosen = np.flatnonzero((raw > blending.alpha_min) & (t > 0))
    chosen = chosen[np.argsort(key[chosen], kind="stable")][:k]
    left, rows = 1.0, []
    for i in chosen:
        if left <= blending.transmittance_min:
            break
        rows.append((i, t[i], alpha[i], left * alpha[i]))
        left *= 1 - alpha[i] if blending.rule == "product" else np.exp(-alpha[i])
    return rows, left


def brute_transmittance(g, a, b, blending):
    length = np.linalg.norm(b - a)
    t, response = peaks(g, a, (b - a) / length)
    raw = g.opacities.astype(np.float64) * response
    alpha = np.minimum(raw, blending.alpha_max)[(raw > blending.alpha_min) & (t > 0) & (t < length)]
    return np.prod(1 - alpha) if blending.rule == "product" else np.exp(-alpha.sum())


def expect_hits(found, expected):
    """The rows of :func:`brute_hits`, one ray after the other."""
    for ray, (rows, left) in enumerate(expected):
        count = int(np.count_nonzero(found.index[ray] >= 0))
        assert found.index[ray, :count].tolist() == [row[0] for row in rows]
        assert (found.index[ray, count:] == -1).all() and np.isinf(found.t[ray, count:]).all()
        assert not found.weight[ray, count:].any() and not found.alpha[ray, count:].any()
        for values, column in ((found.t, 1), (found.alpha, 2), (found.weight, 3)):
            np.testing.assert_allclose(
                values[ray, :count], [row[column] for row in rows], rtol=1e-9, atol=1e-12
            )
        assert found.left[ray] == pytest.approx(left, rel=1e-9, abs=1e-14)
