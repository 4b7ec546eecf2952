"""Power that illuminated surfaces scatter along rays, for given materials, and resolved by what materials may be.

Path gain per ray, after Degli-Esposti et al. (2007), eq. (5), over the footprint of its solid angle Omega:

    (lambda / 4 pi)^2 Omega f_s |Gamma|^2 cos(theta_i) / (cos(theta_s) d1^2)

with f_s a mix of normalised lobes and |Gamma|^2 a Fresnel curve of one permittivity per material group. As in that model
each lobe is normalised by its incidence, and power changes when the ends are swapped. Reciprocal lobes
(:func:`warprrf.rf.em.fresnel.lobe`), with the mean of |Gamma|^2 at both angles, keep it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.kernels.radio import bounce
from warprrf.rf.em.fresnel import COSINES, fresnel_curves, lobe_norm, reciprocal_factor
from warprrf.rf.fields.bistatic.materials import Terms
from warprrf.rf.fields.bistatic.rays import Hits, Illumination
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.transport import Transport


@lru_cache(maxsize=8)
def _lobes(exponents: tuple[int, ...], reciprocal: bool, device: str) -> bounce.Lobes:
    """A mix of lobes with its table, on the device."""
    cosine, found = np.linspace(0.0, 1.0, COSINES), bounce.Lobes()
    scale = [reciprocal_factor(n, cosine) if reciprocal else 1.0 / lobe_norm(n, cosine) for n in exponents]
    found.exponent = wp.array(exponents, dtype=wp.int32, device=device)
    found.scale = wp.array(np.array(scale, np.float32), dtype=wp.float32, device=device)
    found.reciprocal = int(reciprocal)
    return found


def scatter(
    surface: Surface,
    face: wp.array,
    light: Illumination,
    terms: Terms,
    weight: np.ndarray,
    log_excess: np.ndarray,
    wavelength_m: float,
) -> np.ndarray:
    """Path gain of each ray, shape ``(K,)`` float32.

    Args:
        surface: what was hit.
        face: faces that rays hit, shape ``(K,)``, -1 for none.
        light: how those are illuminated.
        terms: which lobes there are.
        weight: of each group and lobe, shape ``(G, L)``.
        log_excess: ln(epsilon_r - 1) of each group, shape ``(G,)``.
        wavelength_m: wavelength.
    """
    where, curves = face.device, fresnel_curves()
    fresnel = curves.at(curves.curves, log_excess)[0]
    power = wp.empty(len(face), dtype=wp.float32, device=where)
    inputs = [
        surface.on_device(where), face, *light.inputs, _lobes(terms.lobes, terms.reciprocal, str(where)),
        wp.array(fresnel, dtype=wp.float32, device=where),
        wp.array(weight * wavelength_m**2, dtype=wp.float32, device=where), power,
    ]  # fmt: skip
    _device.launch(bounce.scatter_bounces, len(face), inputs, device=where)
    return np.asarray(power.numpy())


def send(transport: Transport, hits: Hits, sent: np.ndarray | None) -> np.ndarray:
    """Path gain (K,) along each ray of ``hits`` if elements' sides send radiance ``sent`` (S,); None for none."""
    where, power = hits.face.device, wp.zeros(len(hits.face), dtype=wp.float64, device=hits.face.device)
    if sent is not None:
        unit = (transport.wavelength_m / (4.0 * np.pi)) ** 2
        inputs = [
            transport.surface.on_device(where), *hits.inputs[2:], hits.solid_angle, transport.grid.loss_per_m,
            wp.array(unit * sent, dtype=wp.float64, device=where), power,
        ]  # fmt: skip
        _device.launch(bounce.send_along, len(power), inputs, device=where)
    return np.asarray(power.numpy())


def resolve(
    surface: Surface,
    face: wp.array,
    light: Illumination,
    terms: Terms,
    wavelength_m: float,
    bins: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`scatter` gives at unit weight, summed over bins of rays, by group, lobe and Fresnel component.

    Args:
        bins: which of ``count`` bins each ray belongs to, -1 for none, shape ``(K,)``.

    Returns:
        The groups that are illuminated, shape ``(A,)``, and the sums, shape ``(count, A, L, 3)`` float32. The
        components are those of :class:`warprrf.rf.em.fresnel.FresnelCurves`.
    """
    where = face.device
    order = np.argsort(bins, kind="stable")
    first = np.searchsorted(bins[order], np.arange(count + 1))
    groups = np.unique(surface.group[face.numpy()[light.strength.numpy() > 0]])
    place = np.zeros(surface.groups, np.int32)
    place[groups] = np.arange(len(groups))
    columns = len(groups) * len(terms.lobes) * bounce.MOMENTS
    out = wp.zeros((count, max(columns, 1)), dtype=wp.float32, device=where)
    inputs = [
        *(wp.array(a, dtype=wp.int32, device=where) for a in (first, order)), surface.on_device(where),
        wp.array(place, dtype=wp.int32, device=where), face, *light.inputs,
        _lobes(terms.lobes, terms.reciprocal, str(where)),
        wp.array(fresnel_curves().moments, dtype=wp.float32, device=where), out,
    ]  # fmt: skip
    _device.launch(bounce.resolve_bounces, count, inputs, device=where)
    image = out.numpy()[:, :columns] * np.float32(wavelength_m**2)
    return groups, image.reshape(count, len(groups), len(terms.lobes), bounce.MOMENTS)
