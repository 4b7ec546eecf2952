"""Ways to evaluate a Gaussian's exact response on a ray: time and error in float32.

All response forms are exact in exact arithmetic; they differ in what cancels. ``M = diag(1/s) R^T``, ``m`` the mean
from the ray origin, ``g = M d``, ``o = -M m``, response ``G = exp(-q/2)``:

- ``textbook``: ``q = |o|^2 - (o.g)^2/|g|^2``.
- ``offset first``: ``p = (m.d) d - m``, ``q = |(g/|g|) x M p|^2``.
- ``Gram``: ``q = |m|^2 u^T A u / |g|^2``, u the direction across ``m``, A a 2x2 Gram matrix a Gaussian.
- ``Gram, turned``: the same with A made diagonal, a sum of squares: what :mod:`warprrf.kernels.raster.project` uses.
- ``quadratic 3x3``: ``q = d^T Q d / d^T S d``, a form in the direction itself.

Coefficients are computed in float64 and rounded; the kernels are plain scalar ones, one Gaussian and its rays a thread,
so that times tell the forms apart, not how the rasteriser runs them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.engine.scenes import best_seconds
from benchmarks.report import Row
from warprrf.device import launch, resolve
from warprrf.geometry.splats.gaussians import rotations_of

TEXTBOOK, OFFSET_FIRST, GRAM, TURNED, QUADRATIC = range(5)
COEFFICIENTS = 24  # room for a Gaussian's coefficients in any form
FORMS = {
    "textbook": TEXTBOOK,
    "offset first": OFFSET_FIRST,
    "Gram": GRAM,
    "Gram, turned": TURNED,
    "quadratic 3x3": QUADRATIC,
}
REGIMES = {
    "5 m, 1 to 10 cm": (5.0, 0.01, 0.1, 1.0),
    "10 m, 1 mm": (10.0, 1e-3, 1e-3, 1.0),
    "needles 1:10000 at 5 m": (5.0, 1e-4, 1e-4, 1e4),
}
"""Distance of the means [m], smallest and largest scale [m], and how many times longer one axis is."""
RAYS = 32  # to each Gaussian, aimed at points drawn from it


@wp.func
def squared_distance(form: int, c: wp.array(dtype=wp.float32, ndim=2), i: int, d: wp.vec3):
    """q of Gaussian ``i`` in direction ``d``; ``c`` holds what :func:`_coefficients` puts there."""
    if form == wp.static(TEXTBOOK) or form == wp.static(OFFSET_FIRST):
        g = wp.vec3(
            c[i, 0] * d[0] + c[i, 1] * d[1] + c[i, 2] * d[2],
            c[i, 3] * d[0] + c[i, 4] * d[1] + c[i, 5] * d[2],
            c[i, 6] * d[0] + c[i, 7] * d[1] + c[i, 8] * d[2],
        )
        if form == wp.static(TEXTBOOK):
            o = wp.vec3(c[i, 9], c[i, 10], c[i, 11])
            along = wp.dot(o, g)
            return c[i, 12] - along * along / wp.dot(g, g)
        m = wp.vec3(c[i, 9], c[i, 10], c[i, 11])
        p = wp.dot(m, d) * d - m
        h = wp.vec3(
            c[i, 0] * p[0] + c[i, 1] * p[1] + c[i, 2] * p[2],
            c[i, 3] * p[0] + c[i, 4] * p[1] + c[i, 5] * p[2],
            c[i, 6] * p[0] + c[i, 7] * p[1] + c[i, 8] * p[2],
        )
        x = wp.cross(g, h)
        return wp.dot(x, x) / wp.dot(g, g)
    if form == wp.static(QUADRATIC):
        xx = d[0] * d[0]
        yy = d[1] * d[1]
        zz = d[2] * d[2]
        xy = d[0] * d[1]
        xz = d[0] * d[2]
        yz = d[1] * d[2]
        top = c[i, 0] * xx + c[i, 1] * yy + c[i, 2] * zz + c[i, 3] * xy + c[i, 4] * xz + c[i, 5] * yz
        return top / (
            c[i, 6] * xx + c[i, 7] * yy + c[i, 8] * zz + c[i, 9] * xy + c[i, 10] * xz + c[i, 11] * yz
        )
    u1 = c[i, 0] * d[0] + c[i, 1] * d[1] + c[i, 2] * d[2]
    u2 = c[i, 3] * d[0] + c[i, 4] * d[1] + c[i, 5] * d[2]
    w = c[i, 6] * d[0] + c[i, 7] * d[1] + c[i, 8] * d[2]
    n = c[i, 9] * u1 * u1 + c[i, 10] * u2 * u2
    if form == wp.static(GRAM):
        n = n + c[i, 17] * u1 * u2
    gg = w * (c[i, 11] * w + 2.0 * (c[i, 12] * u1 + c[i, 13] * u2))
    gg = gg + u1 * (c[i, 14] * u1 + 2.0 * c[i, 15] * u2) + c[i, 16] * u2 * u2
    return n / gg


@cache
def form_kernel(form: int) -> Any:
    """Kernel of one form; the compiler drops the others."""

    @wp.kernel(module="unique", enable_backward=False)
    def respond(
        offset: int,
        coefficients: wp.array(dtype=wp.float32, ndim=2),
        directions: wp.array(dtype=wp.vec3, ndim=2),
        q: wp.array(dtype=wp.float32, ndim=2),
    ):
        i = offset + wp.tid()
        for k in range(directions.shape[1]):
            q[i, k] = squared_distance(wp.static(form), coefficients, i, directions[i, k])

    return respond


def response_forms(
    *, gaussians: int = 20_000, repeats: int = 5, seed: int = 0, device: Any = "cpu"
) -> list[Row]:
    """Error of the response against float64, and time, of every form in every regime.

    Returns:
        One row a regime and form: ``regime, form, error_mean, error_max`` of G, ``negative`` (share of q below zero)
        and ``ns_per_pair``.
    """
    on = resolve(device)
    rows = []
    for regime, (distance, low, high, stretch) in REGIMES.items():
        whiten, mean, toward = _rays(gaussians, distance, low, high, stretch, seed)
        exact = np.exp(-0.5 * _exact(whiten, mean, toward))
        directions = wp.array(toward, dtype=wp.vec3, device=on)
        runners, results = {}, {}
        for name, form in FORMS.items():
            table = wp.array(_coefficients(form, whiten, mean), dtype=wp.float32, device=on)
            results[name] = wp.zeros(toward.shape[:2], dtype=wp.float32, device=on)
            inputs = [table, directions, results[name]]
            runners[name] = partial(launch, form_kernel(form), gaussians, inputs, on)
        seconds = best_seconds(runners, repeats)
        for name, q in results.items():
            found = q.numpy().astype(np.float64)
            error = np.abs(np.exp(-0.5 * np.maximum(found, 0.0)) - exact)
            rows.append(
                {
                    "regime": regime,
                    "form": name,
                    "error_mean": float(error.mean()),
                    "error_max": float(error.max()),
                    "negative": float((found < 0).mean()),
                    "ns_per_pair": 1e9 * seconds[name] / found.size,
                }
            )
    return rows


@dataclass(frozen=True)
class _Frame:
    """A Gaussian's frame as seen from the ray origin, (N, ...) in float64; see :mod:`warprrf.kernels.raster.project`."""

    across: np.ndarray
    toward: np.ndarray
    whitened: np.ndarray
    gram: np.ndarray


def _rays(
    count: int, distance: float, low: float, high: float, stretch: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitening matrices (N, 3, 3), means (N, 3) and unit directions (N, RAYS, 3), as float32 holds them."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(count, 3))
    mean *= distance / np.linalg.norm(mean, axis=1, keepdims=True)
    scales = np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
    scales[:, 0] *= stretch
    rotation = rotations_of(rng.normal(size=(count, 4)))
    offset = np.einsum("nij,nkj->nki", rotation, scales[:, None] * rng.normal(size=(count, RAYS, 3)))
    toward = mean[:, None] + offset
    toward = (toward / np.linalg.norm(toward, axis=-1, keepdims=True)).astype(np.float32)
    whiten = rotation.transpose(0, 2, 1) / scales[:, :, None]
    return whiten, mean, toward


def _exact(whiten: np.ndarray, mean: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """q in float64 for the direction as rounded, of whatever length."""
    d = toward.astype(np.float64)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    across = np.einsum("nki,ni->nk", d, mean)[..., None] * d - mean[:, None]
    g, h = np.einsum("nij,nkj->nki", whiten, d), np.einsum("nij,nkj->nki", whiten, across)
    cross = np.cross(g, h)
    exact: np.ndarray = (cross**2).sum(-1) / (g**2).sum(-1)
    return exact


def _coefficients(form: int, whiten: np.ndarray, mean: np.ndarray) -> np.ndarray:
    count = len(mean)
    table = np.zeros((count, COEFFICIENTS))
    offset = -np.einsum("nij,nj->ni", whiten, mean)
    if form in (TEXTBOOK, OFFSET_FIRST):
        table[:, :9] = whiten.reshape(count, 9)
        table[:, 9:12] = offset if form == TEXTBOOK else mean
        table[:, 12] = (offset**2).sum(axis=1)
        return table
    if form == QUADRATIC:
        turned = np.cross(offset[:, :, None], whiten, axis=1)  # columns: o x (M e_k)
        for first, matrix in ((0, turned), (6, whiten)):
            square = np.einsum("nki,nkj->nij", matrix, matrix)
            pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
            for k, (i, j) in enumerate(pairs):
                table[:, first + k] = square[:, i, j] * (1 if i == j else 2)
        return table
    frame = _frame(whiten, mean, turn=form == TURNED)
    table[:, 0:3], table[:, 3:6], table[:, 6:9] = frame.across[:, 0], frame.across[:, 1], frame.toward
    table[:, 9], table[:, 10] = frame.gram[:, 0, 0], frame.gram[:, 1, 1]
    table[:, 17] = 2 * frame.gram[:, 0, 1]
    a, b1, b2 = np.moveaxis(frame.whitened, 1, 0)
    for column, (x, y) in enumerate(((a, a), (a, b1), (a, b2), (b1, b1), (b1, b2), (b2, b2)), start=11):
        table[:, column] = (x * y).sum(axis=1)
    return table


def _frame(whiten: np.ndarray, mean: np.ndarray, *, turn: bool) -> _Frame:
    """The frame of mean direction and two axes across it, turned until the Gram matrix is diagonal if asked."""
    distance = np.linalg.norm(mean, axis=1, keepdims=True)
    toward = mean / distance
    helper = np.eye(3)[np.argmin(np.abs(toward), axis=1)]
    e1 = np.cross(toward, helper)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(toward, e1)
    for _ in range(2 if turn else 1):
        a, b1, b2 = (np.einsum("nij,nj->ni", whiten, v) for v in (toward, e1, e2))
        c1, c2 = np.cross(b1, a), np.cross(b2, a)
        gram = np.stack([c1, c2], axis=1) @ np.stack([c1, c2], axis=2) * distance[:, :, None] ** 2
        if turn:
            angle = 0.5 * np.arctan2(2 * gram[:, 0, 1], gram[:, 0, 0] - gram[:, 1, 1])[:, None]
            e1, e2 = np.cos(angle) * e1 + np.sin(angle) * e2, np.cos(angle) * e2 - np.sin(angle) * e1
    return _Frame(np.stack([e1, e2], axis=1), toward, np.stack([a, b1, b2], axis=1), gram)
