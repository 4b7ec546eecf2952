"""What a bistatic field models, and what it knows of its surfaces: radio parameters of material groups, and gains of what
differs in them.

A group scatters with a mix of lobes, reflects as a mirror, and may have an indirect radiance. Scattering and mirrors
share one Fresnel curve of one permittivity; their weights, S^2 and 1 - S^2, are free, so that an edge in the wrong place
does not spoil both.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import block_diag, bsr_matrix, csr_matrix, identity

from warprrf.checks import Expected, check_array, check_arrays, check_count, check_number, checked
from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.em.materials import NARROWEST_LOBE
from warprrf.rf.paths.polarisation import chain_reflection

LOBES = (0, 2, 5, 12, 30)
"""Exponents of the lobe mix; 0 is Lambertian."""


@checked
@dataclass(frozen=True)
class Terms:
    """What a bistatic field models; see :class:`warprrf.rf.fields.bistatic.training.FitOptions`.

    Attributes:
        line_of_sight, diffuse: whether there are such paths.
        mirror_order: most mirror reflections on a path, 0 to 3.
        lobes: exponents of the scattering lobes, 0 for Lambertian, at most 1000 and each once.
        reciprocal: whether single bounces keep their power when the ends are swapped; see
            :mod:`warprrf.rf.fields.bistatic.scattering`.
        mirror_scatter: whether mirrors light surfaces.
        scatter_mirror: whether mirrors show the lit scene.
        diffuse_order: diffuse bounces on a path, 1 to 3.
        indirect: whether groups have an indirect radiance.
        residual: whether surfaces differ within their group.
        sub_pixels: square root of the rays per pixel, 1 to 16.
    """

    line_of_sight: bool = True
    diffuse: bool = True
    mirror_order: int = 1
    lobes: tuple[int, ...] = LOBES
    reciprocal: bool = False
    mirror_scatter: bool = False
    scatter_mirror: bool = False
    diffuse_order: int = 1
    indirect: bool = False
    residual: bool = False
    sub_pixels: int = 3

    def __post_init__(self) -> None:
        whole = {"mirror_order": (0, 3), "diffuse_order": (1, 3), "sub_pixels": (1, 16)}
        for name, (least, most) in whole.items():
            check_count(name, getattr(self, name), least, most)
        lobes = check_array("lobes", self.lobes, (None,), dtype=np.int64).tolist()
        if not lobes or len(set(lobes)) < len(lobes) or not 0 <= min(lobes) <= max(lobes) <= NARROWEST_LOBE:
            raise ValueError(
                f"lobes: got {self.lobes!r}, expected different exponents, whole numbers from 0 to {NARROWEST_LOBE}"
            )
        object.__setattr__(self, "lobes", tuple(lobes))

    @property
    def further(self) -> bool:
        """Whether elements send on what other surfaces scattered to them."""
        return self.diffuse and self.diffuse_order > 1

    @property
    def after_first_bounce(self) -> bool:
        """Whether there is light that comes over more than one surface, or a mirror and a surface."""
        return self.further or self.mirror_scatter or self.scatter_mirror


MOST_NEPERS = 40.0  # of any logarithm: 174 dB from one, where no surface is
ARRAYS = {
    "log_weight": Expected("G L", most=MOST_NEPERS),
    "log_excess": Expected("G", -MOST_NEPERS, MOST_NEPERS),
    "log_mirror": Expected("G", most=MOST_NEPERS),
    "log_indirect": Expected("G", most=MOST_NEPERS),
}
"""What the arrays of :class:`Parameters` must be: G groups, L lobes."""


@dataclass(frozen=True)
class Parameters:
    """Radio parameters of the groups.

    Attributes:
        log_weight: ln of the lobe weights, shape ``(G, L)``; their sum is S^2.
        log_excess: ln(epsilon_r - 1), shape ``(G,)``.
        log_mirror: ln of the share of |Gamma|^2 that is reflected as by a mirror, shape ``(G,)``; 1 - S^2.
        log_indirect: ln of the indirect radiance [1/m^2], shape ``(G,)``; -inf where there is none.
        log_gain: ln of a gain common to all paths (an uncalibrated receiver).
        log_gains: ln of the unknown gains of measuring chains, shape ``(C,)``; only while a fit lasts.

    Raises:
        TypeError, ValueError: for arrays that do not fit each other, or are out of range.
    """

    log_weight: np.ndarray
    log_excess: np.ndarray
    log_mirror: np.ndarray
    log_indirect: np.ndarray
    log_gain: float = 0.0
    log_gains: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        check_arrays(vars(self), ARRAYS)
        check_number("log_gain", self.log_gain, -MOST_NEPERS, MOST_NEPERS)

    @property
    def weight(self) -> np.ndarray:
        """Lobe weights ``(G, L)``."""
        return np.exp(self.log_weight)

    @property
    def gain(self) -> float:
        """The common gain."""
        return float(np.exp(self.log_gain))

    @property
    def scattered_share(self) -> np.ndarray:
        """Share of power that each group scatters under even light, ``(G,)``: lobe weights times 2 int F cos dcos."""
        return self.weight.sum(axis=1) * fresnel_curves().even(self.log_excess)[0]

    @property
    def log_smooth(self) -> np.ndarray:
        """ln of what each group mirrors of all that it mirrors and scatters, ``(G,)``: -(4 pi sigma_h / lambda)^2 of a
        surface of rms height sigma_h (Ament 1953)."""
        return self.log_mirror - np.log(self.weight.sum(axis=1) + np.exp(self.log_mirror))

    def take(self, index: np.ndarray) -> Parameters:
        """The rows ``index``: of materials to those of groups, say."""
        return replace(
            self, log_weight=self.log_weight[index], log_excess=self.log_excess[index],
            log_mirror=self.log_mirror[index], log_indirect=self.log_indirect[index],
        )  # fmt: skip

    def at_ratio(self, ratio: float) -> Parameters:
        """Those of the same surfaces at ``ratio`` times the carrier: roughness counts in wavelengths.

        What is not scattered, exp(-(4 pi sigma_h / lambda)^2) (Ament 1953), is raised to the square of the ratio; the sum
        of both shares, the mix of lobes and the permittivity stay.
        """
        if ratio == 1.0:
            return self
        scattered = self.weight.sum(axis=1)
        both = scattered + np.exp(self.log_mirror)
        log_smooth = ratio**2 * self.log_smooth
        grown = np.log(np.maximum(-np.expm1(log_smooth), 1e-12) * both / scattered)
        return replace(
            self, log_weight=np.maximum(self.log_weight + grown[:, None], -MOST_NEPERS),
            log_mirror=np.maximum(log_smooth + np.log(both), -MOST_NEPERS), log_indirect=self.log_indirect + grown,
        )  # fmt: skip

    @classmethod
    def prior(cls, groups: int, lobes: int) -> Parameters:
        """What a surface is taken for before any measurement: half scattered, half mirrored, epsilon_r of 4."""
        return cls(
            np.full((groups, lobes), np.log(0.5 / lobes)), np.full(groups, np.log(3.0)), np.full(groups, np.log(0.5)),
            np.full(groups, -np.inf),
        )  # fmt: skip


@dataclass(frozen=True)
class Materials:
    """What is modelled, and with which values: all that a spectrum depends on besides the geometry.

    Attributes:
        terms: kinds of paths.
        parameters: of the groups.
        residual: ln gain of each surface cell over its group, shape ``(2, X)``: for single bounces, and for light that
            the cell sends on after others; see :mod:`warprrf.rf.fields.bistatic.residuals`.
        transmitter: under which the gains of light sent on were learned [m], shape ``(3,)``. Light of another falls
            elsewhere: of that nothing was learned, so its gains are 1.
    """

    terms: Terms
    parameters: Parameters
    residual: np.ndarray
    transmitter: np.ndarray

    def cell_gain(self) -> np.ndarray:
        """Gain of cells for single bounces, shape ``(X,)``."""
        return np.asarray(np.exp(self.terms.residual * self.residual[0]))

    def sent_gain(self, transmitter: np.ndarray) -> np.ndarray:
        """Gain of cells for light of ``transmitter`` (3,) that they send on after others, shape ``(X,)``."""
        known = self.terms.residual and np.array_equal(transmitter, self.transmitter)
        return np.asarray(np.exp(known * self.residual[1]))


class Layout:
    """Order of the free parameters in a vector: per group lobes, excess, mirror, indirect; then the common gain, then those
    of measuring chains.

    Attributes:
        groups, lobes: how many.
        indirect, gain: whether indirect radiance and the common gain are free.
        chains: how many gains of measuring chains are free.
        stride: parameters of a group.
        first_chain: place of the first chain's gain.
        size: of the vector.
    """

    def __init__(self, groups: int, lobes: int, *, indirect: bool, gain: bool, chains: int = 0) -> None:
        self.groups, self.lobes, self.indirect, self.gain, self.chains = groups, lobes, indirect, gain, chains
        self.stride = lobes + 2 + int(indirect)
        self.first_chain = groups * self.stride + int(gain)
        self.size = self.first_chain + chains

    @property
    def common_gain(self) -> int:
        """Place of the common gain."""
        return self.groups * self.stride

    def weight(self, group: np.ndarray) -> np.ndarray:
        """Places of the lobe weights of each of ``group`` (K,), shape ``(K, L)``."""
        return self.stride * group[:, None] + np.arange(self.lobes)

    def excess(self, group: np.ndarray) -> np.ndarray:
        """Places of the permittivity of each of ``group``."""
        return self.stride * group + self.lobes

    def mirror(self, group: np.ndarray) -> np.ndarray:
        """Places of the mirror share of each of ``group``."""
        return self.stride * group + self.lobes + 1

    def radiance(self, group: np.ndarray) -> np.ndarray:
        """Places of the indirect radiance of each of ``group``."""
        return self.stride * group + self.lobes + 2

    def pack(self, p: Parameters) -> np.ndarray:
        """Vector of ``p``."""
        columns = [p.log_weight, p.log_excess[:, None], p.log_mirror[:, None]]
        if self.indirect:
            columns.append(p.log_indirect[:, None])
        vector = np.concatenate(columns, axis=1).ravel()
        return np.concatenate([vector, [p.log_gain] if self.gain else [], p.log_gains])

    def unpack(self, vector: np.ndarray) -> Parameters:
        """Parameters of a vector."""
        table = vector[: self.groups * self.stride].reshape(self.groups, self.stride)
        n = self.lobes
        return Parameters(
            table[:, :n].copy(), table[:, n].copy(), table[:, n + 1].copy(),
            table[:, n + 2].copy() if self.indirect else np.full(self.groups, -np.inf),
            float(vector[self.common_gain]) if self.gain else 0.0, vector[self.first_chain :].copy(),
        )  # fmt: skip

    def slopes_at_ratio(self, p: Parameters, ratio: float) -> csr_matrix:
        """Derivatives of the vector of ``p.at_ratio(ratio)`` (rows) to that of ``p`` (columns)."""
        weight, mirror, n = p.weight, np.exp(p.log_mirror), self.lobes
        scattered = weight.sum(axis=1)
        both = scattered + mirror
        share, own = np.zeros((2, self.groups, self.stride))  # of ln both, and of ln mirror
        share[:, :n], share[:, n + 1] = weight / both[:, None], mirror / both
        own[:, n + 1] = 1.0
        smooth = ratio**2 * (own - share)
        fall = 1.0 / np.maximum(np.expm1(-(ratio**2) * (p.log_mirror - np.log(both))), 1e-12)
        grown = share - fall[:, None] * smooth
        grown[:, :n] -= weight / scattered[:, None]
        table = np.tile(np.eye(self.stride), (self.groups, 1, 1))
        table[:, n + 1] = smooth + share
        for row in (*range(n), *range(n + 2, self.stride)):
            table[:, row] += grown
        groups = bsr_matrix((table, np.arange(self.groups), np.arange(self.groups + 1)))
        return block_diag([groups, identity(self.size - groups.shape[0])], format="csr")


def mirror_share(p: Parameters, group: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Share of unpolarised power that mirrors of ``group`` (K,) reflect at ``cosine`` (K,) of incidence."""
    return np.asarray(np.exp(p.log_mirror[group]) * fresnel_curves().value(p.log_excess[group], cosine)[0])


def mirror_power(
    power: np.ndarray, path_group: np.ndarray, cosine: np.ndarray, turn: np.ndarray, p: Parameters
) -> tuple[np.ndarray, np.ndarray]:
    """Power of line-of-sight and mirror paths, the common gain apart.

    Args:
        power: of each path without its reflections, shape ``(K,)``.
        path_group: groups that it meets, -1 for none, shape ``(K, 3)``.
        cosine: of incidence at each, shape ``(K, 3)``.
        turn: angle of its plane of incidence to the one before [rad], shape ``(K, 3)``.
        p: parameters of the groups.

    Returns:
        Power, shape ``(K,)``, and its logarithmic derivatives to ``log_excess`` of each group met, shape ``(K, 3)``,
        0 for none; those to ``log_mirror`` are 1.
    """
    reflects = path_group >= 0
    own = np.maximum(path_group, 0)
    share, slope = chain_reflection(p.log_excess[own], cosine, turn, reflects)
    strength = np.where(reflects, p.log_mirror[own], 0.0).sum(axis=1)
    return np.asarray(power, float) * np.exp(strength) * share, slope
