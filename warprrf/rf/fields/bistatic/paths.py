"""Propagation paths of a bistatic field at one receiver, and each pixel's strongest."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.sight import Composed, Sight
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.spectrum import angles_from_directions

if TYPE_CHECKING:
    from warprrf.rf.fields.bistatic.field import BistaticField

PATH_SHARE = (
    1.0 / 200.0
)  # a ray's part of the power that scattering brings to a pixel, at 64 rays a pixel and a beam of 3


def paths_of(field: BistaticField, sight: Sight, max_paths: int | None) -> Paths:
    """Paths of what is seen, strongest first; see :meth:`BistaticField.paths`."""
    parts = field.compose(sight)
    exact = np.flatnonzero(parts.specular > 0)
    total = float(parts.image.sum())
    p, s = sight.paths, parts.specular[exact]
    kinds = np.where(p.order[exact] == 0, "los", "mirror").astype("<U7")
    vertices = p.point[exact]
    diffuse = parts.rays.reshape(*field.shape, -1).sum(axis=-1) + parts.further
    point = _bounce_points(field, sight, parts.rays + _anything(field, sight))
    kept = diffuse > field.floor
    if not kept.any() and diffuse.max() > 0:
        kept = diffuse == diffuse.max()
    power = diffuse[kept]
    if len(power):
        power = power * max(total - s.sum(), 0.0) / power.sum()
    over = np.full((len(power), *vertices.shape[1:]), np.nan)
    over[:, 0] = point[kept]
    whole = np.isfinite(over[:, 0]).all(axis=1)
    power, over = power[whole] * (power.sum() / max(power[whole].sum(), 1e-300)), over[whole]
    found = Paths.from_points(
        sight.transmitter,
        sight.receiver,
        np.concatenate([vertices, over]),
        np.sqrt(np.concatenate([s, power])).astype(complex),
        np.concatenate([kinds, np.full(len(power), "diffuse", dtype="<U7")]),
        field.frequency_hz,
    )
    order = np.argsort(-np.abs(found.gain), kind="stable")[:max_paths]
    return replace(found.select(order), air=field.air)


def strongest(field: BistaticField, sight: Sight, parts: Composed) -> tuple[np.ndarray, np.ndarray]:
    """Delay [s] and angles of departure [rad] of each pixel's strongest path through the receiver beam; NaN where
    empty."""
    ray = field.tracer.strongest(parts.rays, field.beam_sigma_rad)
    dark = ray < 0
    ray = np.maximum(ray, 0)
    range_m = np.where(dark, np.nan, sight.met.range_m.numpy()[ray])
    point = sight.receiver + range_m[..., None] * field.tracer.directions[ray]
    outward = np.where(dark[..., None], 1.0, point - sight.transmitter)
    length = np.where(dark, np.nan, np.linalg.norm(outward, axis=-1) + range_m)
    if len(parts.specular):
        beams = parts.specular[:, None, None] * sight.beams
        which = beams.argmax(axis=0)
        diffuse = np.maximum(parts.image - beams.sum(axis=0), 0.0)
        direct = np.take_along_axis(beams, which[None], axis=0)[0] > PATH_SHARE * diffuse
        first = sight.paths.point[:, 0]
        first = np.where(np.isnan(first), sight.receiver, first) - sight.transmitter
        outward = np.where(direct[..., None], first[which], outward)
        length = np.where(direct, sight.paths.length_m[which], length)
    length = np.where(np.isfinite(length), length, np.nan)
    outward = np.where(np.isnan(length)[..., None], 1.0, outward)
    aod = np.stack(angles_from_directions(outward), axis=-1)
    return length / SPEED_OF_LIGHT, np.where(np.isnan(length)[..., None], np.nan, aod).astype(np.float32)


def _bounce_points(field: BistaticField, sight: Sight, rays: np.ndarray) -> np.ndarray:
    """The point that each pixel's strongest ray meets (H, W, 3)."""
    per_pixel = rays.reshape(-1, field.tracer.sub_pixels**2)
    best = per_pixel.argmax(axis=1) + np.arange(len(per_pixel)) * per_pixel.shape[1]
    range_m = sight.met.range_m.numpy()[best]
    with np.errstate(invalid="ignore"):
        point = sight.receiver + range_m[:, None] * field.tracer.directions[best]
    return point.reshape(*field.shape, 3)


def _anything(field: BistaticField, sight: Sight) -> np.ndarray:
    """A trace of power for every ray that meets something, so that a pixel lit by further bounces has a point."""
    met = sight.met.face.numpy() >= 0
    return np.where(met, 1e-12 * field.floor * field.tracer.solid_angle, 0.0)
