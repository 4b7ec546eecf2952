"""Reflection from a slab and diffuse scattering lobes, as facts of the surface alone (no geometry, no distances).

Reflection: ITU-R P.2040-4, section 2.2.2, the single-layer slab in vacuum, in float64. Scattering lobes: Degli-Esposti
et al., "Measurement and modelling of scattering from buildings", IEEE Trans. AP 55 (2007), normalised so that a lobe
integrates to one over the hemisphere.

That normalisation belongs to the direction of incidence, so the power that such a surface passes on is another when the
ends are swapped (f_s |Gamma|^2 cos(theta_i) is not symmetric: rms 2 dB over both directions, 6 dB and more at grazing). A
reciprocal lobe is of the same shape and integrates to one as well, and is symmetric: Lewis (1994) and Lafortune and
Willems (1994) state what reciprocity asks of such lobes, Sinkhorn and Knopp (1967) how to scale a symmetric kernel so that
it sums to one.

Half-spaces are a family of curves over permittivity and the cosine of incidence, tabulated once: one permittivity is one
member, and a few components resolve them all, so that light may be gathered before the permittivity is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import LARGEST, check_alike, check_array, checked, whole
from warprrf.kernels.radio.records import MOMENTS
from warprrf.rf.em.materials import NARROWEST_LOBE, Material, check_known

LAMBERTIAN = 0
"""Value of ``SurfaceTable.alpha_r`` that stands for a Lambertian lobe."""


@dataclass(frozen=True)
class SurfaceTable:
    """Radio properties per material at one frequency, as arrays.

    Attributes:
        permittivity: Complex relative permittivity, shape ``(M,)``.
        thickness_m: Slab thickness [m], shape ``(M,)``.
        scattering: Scattering coefficient S, shape ``(M,)``.
        alpha_r: Exponent of the directive lobe, shape ``(M,)``, int32; 0 for a Lambertian one.
        reciprocal: Whether scattering stays the same when the ends are swapped, shape ``(M,)``, bool.
    """

    permittivity: np.ndarray
    thickness_m: np.ndarray
    scattering: np.ndarray
    alpha_r: np.ndarray
    reciprocal: np.ndarray

    def reflection(
        self, material: np.ndarray, cos_incidence: np.ndarray, wavelength_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """TE and TM of mirrors of ``material``, rows of the table: those of :func:`slab_reflection`, less what scatters."""
        slab = self.permittivity[material], self.thickness_m[material], wavelength_m
        smooth = np.sqrt(1.0 - self.scattering[material] ** 2)
        te, tm = slab_reflection(cos_incidence, *slab)
        return smooth * te, smooth * tm

    def passage(
        self,
        material: np.ndarray,
        cos_incidence: np.ndarray,
        wavelength_m: float,
        solid_m: np.ndarray | float = np.nan,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """:func:`slab_passage` of slabs of ``material``, as thick as that or, where they are solids, ``solid_m``."""
        thickness = np.where(np.isnan(solid_m), self.thickness_m[material], solid_m)
        return slab_passage(cos_incidence, self.permittivity[material], thickness, wavelength_m)


def surface_table(materials: Sequence[Material], frequency_hz: float) -> SurfaceTable:
    """The table of ``materials`` at ``frequency_hz``."""
    check_known(materials)
    alpha = [LAMBERTIAN if m.pattern == "lambertian" else int(m.alpha_r) for m in materials]
    return SurfaceTable(
        permittivity=np.array([m.permittivity(frequency_hz) for m in materials]),
        thickness_m=np.array([float(m.thickness_m) for m in materials]),
        scattering=np.array([m.scattering_coefficient(frequency_hz) for m in materials]),
        alpha_r=np.array(alpha, dtype=np.int32),
        reciprocal=np.array([m.reciprocal for m in materials], dtype=bool),
    )


@checked
def slab_reflection(
    cos_incidence: ArrayLike, permittivity: ArrayLike, thickness_m: ArrayLike, wavelength_m: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Reflection of a slab (``inf`` thick: a half-space): field across (TE) and in (TM) the plane of incidence.

    Source: ITU-R P.2040-4, eqs. (37a), (37b), (43a), (44). A perfect conductor gives -1 and +1.
    """
    te, tm, once = _slab(cos_incidence, permittivity, thickness_m, wavelength_m)
    echo = once**2
    return _shared(te * (1.0 - echo), te, echo, 0.0), _shared(tm * (1.0 - echo), tm, echo, 0.0)  # eq. (43a)


@checked
def slab_transmission(
    cos_incidence: ArrayLike, permittivity: ArrayLike, thickness_m: ArrayLike, wavelength_m: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Transmission of a slab: field across (TE) and in (TM) the plane of incidence; nothing leaves a half-space.

    Source: ITU-R P.2040-4, eqs. (37a), (37b), (43b), (44).
    """
    te, tm, once = _slab(cos_incidence, permittivity, thickness_m, wavelength_m)
    echo = once**2
    return _shared((1.0 - te**2) * once, te, echo, once), _shared((1.0 - tm**2) * once, tm, echo, once)


def slab_passage(
    cos_incidence: ArrayLike, permittivity: ArrayLike, thickness_m: ArrayLike, wavelength_m: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What passing a slab does to a path that goes straight on: factors of the field (TE, TM), and by how much the slab makes the
    path longer than in air [m]. The factors are those of :func:`slab_transmission` without the phase of the way through."""
    te, tm = slab_transmission(cos_incidence, permittivity, thickness_m, wavelength_m)
    cos, thickness = np.asarray(cos_incidence, float), np.asarray(thickness_m, float)
    root = np.sqrt(np.asarray(permittivity, complex) - (1.0 - cos**2)).real
    way = np.where(np.isinf(thickness), 0.0, thickness)
    turned = np.exp(2j * np.pi / np.asarray(wavelength_m) * way * root)
    return te * turned, tm * turned, way * (root - cos)


def _shared(wave: np.ndarray, face: np.ndarray, echo: np.ndarray, none: np.ndarray | float) -> np.ndarray:
    """``wave`` over 1 - face^2 echo; ``none`` where that is 0, as at grazing of a slab without thickness."""
    below = 1.0 - face**2 * echo
    nothing = np.abs(below) < np.finfo(float).tiny
    return np.where(nothing, none, wave / np.where(nothing, 1.0, below))


def _slab(
    cos_incidence: ArrayLike, permittivity: ArrayLike, thickness_m: ArrayLike, wavelength_m: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflection of the first face, TE and TM, and what is left of a wave that goes once through; eqs. (37), (44)."""
    cos = check_array("cos_incidence", cos_incidence)
    eta = check_array("permittivity", permittivity, dtype=np.complex128)
    thickness = check_array("thickness_m", thickness_m, finite=False)
    wavelength = check_array("wavelength_m", wavelength_m)
    check_alike(cos_incidence=cos, permittivity=eta, thickness_m=thickness, wavelength_m=wavelength)
    for name, values, fits in (
        ("cos_incidence", cos, (cos >= 0) & (cos <= 1.0 + 1e-6)),
        ("permittivity", eta, (eta.real > 0) & (eta.imag <= 0) & (abs(eta) < 1e30)),
        ("thickness_m", thickness, thickness >= 0),
        ("wavelength_m", wavelength, wavelength >= 1 / LARGEST),
    ):
        if not fits.all():
            raise ValueError(
                f"{name}: got {values[~fits].flat[0]!r}, expected a wave that meets a passive slab"
            )
    root = np.sqrt(eta - (1.0 - cos**2))
    root = np.where(root.imag > 0, -root, root)  # beyond total reflection the wave decays
    endless = np.isinf(thickness)
    q = 2.0 * np.pi * np.where(endless, 0.0, thickness) / wavelength * root
    once = np.where(endless, 0.0, np.exp(-1j * q))
    return _step(cos, root), _step(eta * cos, root), once


def _step(before: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Reflection where one turns into the other; 0 where both are 0, as at grazing of what is no other medium."""
    both = before + behind
    return (before - behind) / np.where(both == 0, 1.0, both)


@checked
def lobe(
    alpha_r: Annotated[int, whole(0, NARROWEST_LOBE)],
    cos_incidence: ArrayLike,
    cos_scatter: ArrayLike,
    cos_to_mirror: ArrayLike,
    *,
    reciprocal: bool = False,
) -> np.ndarray:
    """Scattering lobe f_s [1/sr]: Lambertian for ``alpha_r`` 0, else ((1 + cos psi) / 2)^alpha_r, normalised.

    The directive lobe of Degli-Esposti et al. is not reciprocal: f_s cos(theta_i) changes when the ends are swapped.

    Args:
        cos_incidence: Cosine of the incidence angle, 0 to 1.
        cos_scatter: Cosine of the scattering angle, 0 to 1.
        cos_to_mirror: Cosine of the angle psi between the scattered and the mirror direction.
        reciprocal: The reciprocal lobe: cos(theta_s) b(theta_i) b(theta_s) ((1 + cos psi) / 2)^alpha_r, with b of
            :func:`reciprocal_factor`.
    """
    cosines = {"cos_incidence": cos_incidence, "cos_scatter": cos_scatter, "cos_to_mirror": cos_to_mirror}
    check_alike(**cosines)
    for (name, value), low in zip(cosines.items(), (0, 0, -1), strict=True):
        found = check_array(name, value, finite=False)
        if ((found < low - 1e-6) | (found > 1.0 + 1e-6)).any():
            raise ValueError(f"{name}: got values beyond {low} to 1, expected cosines")
    if alpha_r == LAMBERTIAN:
        return np.asarray(cos_scatter) / np.pi
    shape = (0.5 * (1.0 + np.asarray(cos_to_mirror))) ** alpha_r
    if reciprocal:
        both = reciprocal_factor(alpha_r, cos_incidence) * reciprocal_factor(alpha_r, cos_scatter)
        return np.asarray(np.asarray(cos_scatter) * shape * both)
    return np.asarray(shape / lobe_norm(alpha_r, cos_incidence))


def reciprocal_factor(alpha_r: int, cosine: ArrayLike) -> np.ndarray:
    """b(theta) of the reciprocal lobe [1/sr^(1/2)], at cosines in [0, 1].

    It makes the lobe cos(theta_s) b(theta_i) b(theta_s) ((1 + cos psi) / 2)^alpha_r integrate to one over the hemisphere
    for every incidence: b(theta_i) int cos(theta_s) ((1 + cos psi) / 2)^alpha_r b(theta_s) dOmega_s = 1.
    """
    cos = np.clip(np.asarray(cosine, dtype=np.float64), 0.0, 1.0)
    node, weighed = _reciprocal_nodes(int(alpha_r))
    held = _around_the_normal(int(alpha_r), cos.ravel(), node) @ weighed
    return np.asarray(1.0 / held.reshape(cos.shape))


@lru_cache(maxsize=64)
def _reciprocal_nodes(alpha_r: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines of a Gauss-Legendre rule on [0, 1], and cos(theta) b(theta) there times their weights.

    Sinkhorn and Knopp's scaling, whose plain steps swing about the solution: their geometric mean is taken.
    """
    node, weight = np.polynomial.legendre.leggauss(64 + 4 * int(np.sqrt(alpha_r)))
    node, weight = 0.5 * (node + 1.0), 0.5 * weight * 0.5 * (node + 1.0)
    kernel = _around_the_normal(alpha_r, node, node)
    b = 1.0 / np.sqrt(kernel @ weight)
    for _ in range(100):
        before, b = b, np.sqrt(b / (kernel @ (weight * b)))
        if np.abs(b / before - 1.0).max() < 1e-14:
            break
    return node, weight * b


def _around_the_normal(alpha_r: int, cos_a: np.ndarray, cos_b: np.ndarray) -> np.ndarray:
    """((1 + cos psi) / 2)^alpha_r integrated over azimuth, shape ``(A, B)``: a trapezium rule, exact to rounding."""
    count = min(alpha_r + 1, 16 + 8 * int(np.sqrt(alpha_r)))
    turn = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    middle = 0.5 * (1.0 + np.multiply.outer(cos_a, cos_b))
    swing = 0.5 * np.sqrt(np.multiply.outer(1.0 - cos_a**2, 1.0 - cos_b**2))
    total = np.zeros_like(middle)
    for cos_turn in np.cos(turn):
        total += (middle + swing * cos_turn) ** alpha_r
    return total * (2.0 * np.pi / count)


def lobe_norm(alpha_r: int, cos_incidence: ArrayLike) -> np.ndarray:
    """Integral of ((1 + cos psi) / 2)^alpha_r over the hemisphere [sr]. Degli-Esposti et al. (2007), eqs. (11)-(14)."""
    cos = np.asarray(cos_incidence, dtype=np.float64)
    sin_sq = 1.0 - cos**2
    binomial, term, series, total = 1.0, np.ones_like(cos), np.zeros_like(cos), np.zeros_like(cos)
    for j in range(alpha_r + 1):
        if j % 2 == 0:
            total = total + binomial * 2.0 * np.pi / (j + 1)
        else:
            # One more term of sum_w C(2w, w) (sin theta_i)^(2w) / 4^w.
            series = series + term
            w = (j - 1) // 2
            term = term * sin_sq * (2 * w + 1) / (2 * w + 2)
            total = total + binomial * 2.0 * np.pi / (j + 1) * cos * series
        binomial = binomial * (alpha_r - j) / (j + 1)
    return total / 2.0**alpha_r


EXCESS = (0.05, 200.0)  # of epsilon_r over 1, what half-spaces are taken for; the last reflects like metal
COSINES = 257  # entries of tables over the cosine of incidence


@dataclass(frozen=True)
class FresnelCurves:
    """Power reflection of half-spaces, mean of TE and TM, as a family of curves over the cosine of incidence.

    Attributes:
        log_excess: ln(epsilon_r - 1) of each member, shape ``(97,)``.
        curves: reflection, shape ``(97, 257)``.
        moments: components that resolve the family, shape ``(3, 257)``.
        coordinates: of each member in them, shape ``(97, 3)``.
    """

    log_excess: np.ndarray
    curves: np.ndarray
    moments: np.ndarray
    coordinates: np.ndarray

    def at(self, table: np.ndarray, log_excess: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Rows of ``table`` (97, K) at ``log_excess`` (G,), clipped to the family, and derivatives, ``(G, K)``."""
        step = self.log_excess[1] - self.log_excess[0]
        x = (np.asarray(log_excess, float) - self.log_excess[0]) / step
        x = np.clip(x, 0.0, len(self.log_excess) - 1.001)
        i = x.astype(int)
        s = (x - i)[:, None]
        return (1 - s) * table[i] + s * table[i + 1], (table[i + 1] - table[i]) / step

    def even(self, log_excess: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Reflection under even light, 2 int F cos dcos, at ``log_excess`` (G,), and its derivative."""
        cosine = np.linspace(0.0, 1.0, COSINES)
        return tuple(rows @ cosine / cosine.sum() for rows in self.at(self.curves, log_excess))


@lru_cache(maxsize=1)
def fresnel_curves() -> FresnelCurves:
    """The family of half-spaces from epsilon_r 1.05 to 201."""
    excess = np.geomspace(*EXCESS, 97)
    te, tm = slab_reflection(np.linspace(0.0, 1.0, COSINES), 1.0 + excess[:, None], np.inf, 1.0)
    curves = 0.5 * (np.abs(te) ** 2 + np.abs(tm) ** 2)
    # relative errors count: each curve is weighted by its mean
    moments = np.linalg.svd(curves / curves.mean(axis=1, keepdims=True), full_matrices=False)[2][:MOMENTS]
    return FresnelCurves(np.log(excess), curves, moments, curves @ moments.T)
