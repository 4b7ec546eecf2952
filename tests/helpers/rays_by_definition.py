"""Gaussians on rays by brute force: every Gaussian on every ray, from the definition, in float64 or long doubles."""

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


def gaussians(means=(2.0, 0.0, 0.0), scales=(0.1, 0.2, 0.3), opacities=0.8, quaternions=(1.0, 0.0, 0.0, 0.0)):
    """One or several; what is given once is that of all."""
    means = np.atleast_2d(means)
    n = len(means)
    return wr.Gaussians(
        means, np.broadcast_to(quaternions, (n, 4)), np.broadcast_to(scales, (n, 3)), np.broadcast_to(opacities, n),
        np.zeros((n, 1, 3)),
    )  # fmt: skip


def met(gaussians, origin, directions, dtype=np.float64):
    """Ranges of peaks, alpha without cutoff or clamp, and cosines of means to rays in units of scales, (..., N) each.

    ``gaussians`` holds means, quaternions, scales and opacities, as attributes or in a dictionary.
    """
    held = gaussians if isinstance(gaussians, dict) else vars(gaussians)
    means, q, scales, opacities = (
        np.asarray(held[k], dtype) for k in ("means", "quaternions", "scales", "opacities")
    )
    unit = np.asarray(directions, dtype) / np.sqrt(
        np.sum(np.square(directions, dtype=dtype), -1, keepdims=True)
    )
    w, x, y, z = (q / np.sqrt(np.sum(q * q, axis=1, keepdims=True))).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
        1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    whiten = np.stack(rows, axis=1).reshape(-1, 3, 3).transpose(0, 2, 1) / scales[:, :, None]
    offset = np.einsum("nij,...nj->...ni", whiten, np.asarray(origin, dtype)[..., None, :] - means)
    toward = np.einsum("nij,...j->...ni", whiten, unit)
    along = -(offset * toward).sum(-1)
    t = along / (toward * toward).sum(-1)
    alpha = opacities * np.exp(-0.5 * ((offset + t[..., None] * toward) ** 2).sum(-1))
    with np.errstate(invalid="ignore"):  # at a mean itself
        return t, alpha, along / np.sqrt((offset * offset).sum(-1) * (toward * toward).sum(-1))


def blended(g, camera, features, blending, background=0.0):
    """Textbook splatting, near to far: features, alpha, depth, and the smallest relative distance of any of a pixel's pairs
    from a decision: cutoff, clamp, early exit, half-space."""
    t, raw, cosine = met(g, camera.position, camera.directions())
    means = g["means"] if isinstance(g, dict) else g.means
    order = np.argsort(np.linalg.norm(means - camera.position, axis=1).astype(np.float32), kind="stable")
    color, left = np.zeros((*t.shape[:2], features.shape[1])), np.ones(t.shape[:2])
    total, reach, margin = np.zeros_like(left), np.zeros_like(left), np.full_like(left, np.inf)
    for k in order:
        near = np.minimum(
            np.abs(raw[..., k] / blending.alpha_min - 1), np.abs(raw[..., k] / blending.alpha_max - 1)
        )
        # Cutoffs far from deciding do not matter where the Gaussian lies behind, nor the half-space where it is faint.
        margin = np.where(cosine[..., k] > -0.01, np.minimum(margin, near), margin)
        faint = raw[..., k] <= 0.5 * blending.alpha_min
        margin = np.where(faint, margin, np.minimum(margin, np.abs(cosine[..., k])))
        margin = np.minimum(margin, np.abs(left / blending.transmittance_min - 1))
        counted = (raw[..., k] > blending.alpha_min) & (t[..., k] > 0) & (left > blending.transmittance_min)
        alpha = np.where(counted, np.minimum(raw[..., k], blending.alpha_max), 0)
        color += (alpha * left)[..., None] * features[k]
        total += alpha * left
        reach += alpha * left * t[..., k]
        left = left * (1 - alpha if blending.rule == "product" else np.exp(-alpha))
    with np.errstate(invalid="ignore"):
        depth = np.where(total > 0, reach / total, np.inf)
    return color + left[..., None] * background, total, depth, margin


def brute_hits(g, origin, direction, k, blending, order="peak"):
    t, raw, _ = met(g, origin, direction)
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
    t, raw, _ = met(g, a, b - a)
    counts = (raw > blending.alpha_min) & (t > 0) & (t < np.linalg.norm(b - a))
    alpha = np.minimum(raw, blending.alpha_max)[counts]
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
