"""What a bistatic field models, and what it knows of its surfaces: radio parameters of material groups, and gains of what
differs in them.

A group scatters with a mix of lobes and reflects as a mirror. Scattering and mirrors share one Fresnel curve of one
permittivity; their weights, S^2 and 1 - S^2, are free, so that an edge in the wrong place does not spoil both.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from scipy.sparse import block_diag, bsr_matrix, csr_matrix, identity

from warprrf.checks import Expected, check_array, check_arrays, check_number, check_type, checked, whole
from warprrf.kernels.radio.records import EXCESS_COLUMN, MIRRORED_COLUMN, THROUGH_COLUMN
from warprrf.rf.em.fresnel import COSINES, EXCESS, fresnel_curves
from warprrf.rf.em.materials import NARROWEST_LOBE
from warprrf.rf.paths.slabs import MOST_SLABS

LOBES = (0, 2, 5, 12, 30)
"""Exponents of the lobe mix; 0 is Lambertian."""


@checked
@dataclass(frozen=True)
class Effects:
    """Which paths are modelled.

    Attributes:
        line_of_sight: whether the transmitter is seen directly.
        mirrors: most mirror reflections on a path without scattering, 0 to 3.
        scatterings: most scatterings on a path, 0 to 3; from the second on by radiosity, on elements of half a metre in a room.
        mirror_scatter: whether mirrors light surfaces that scatter.
        scatter_mirror: whether lit surfaces are seen otherwise than directly: in mirrors and through slabs. Sionna RT has no
            such paths.
        transmissions: most slabs that a path passes, 0 to 8.
        diffractions: most edges on a path, 0 or 1; beside one mirror or one slab at most, and no scattering.
        residual: whether what surfaces scatter differs within their group.

    Example::

        field = wr.RadioField.fit(room, spectra, effects=wr.Effects(scatterings=1, mirrors=1))
    """

    line_of_sight: bool = True
    mirrors: Annotated[int, whole(0, 3)] = 3
    scatterings: Annotated[int, whole(0, 3)] = 3
    mirror_scatter: bool = True
    scatter_mirror: bool = True
    transmissions: Annotated[int, whole(0, MOST_SLABS)] = 3
    diffractions: Annotated[int, whole(0, 1)] = 1
    residual: bool = True


def with_slabs_and_edges(effects: Effects, of: Effects) -> Effects:
    """``effects`` with as many slabs and edges on a path as ``of`` has."""
    return replace(effects, transmissions=of.transmissions, diffractions=of.diffractions)


SETS = {
    "single": Effects(
        mirrors=1, scatterings=1, mirror_scatter=False, scatter_mirror=False, transmissions=0, diffractions=0
    ),
    "room": Effects(scatter_mirror=False, transmissions=0, diffractions=0),
    "everything": Effects(transmissions=0, diffractions=0),
}
"""Sets of effects that a fit tries: one bounce; all of a room but what is seen in mirrors; that too. None has slabs or edges:
``effects="auto"`` adds them where the scene needs them."""

MOST_NEPERS = 40.0  # of any logarithm: 174 dB from one, where no surface is
ROUGHNESS = 2.0
"""Exponent of frequency in ln(1 - S^2) (Ament 1953)."""
ARRAYS = {
    "log_weight": Expected("G L", most=MOST_NEPERS),
    "log_excess": Expected("G", -MOST_NEPERS, MOST_NEPERS),
    "log_mirror": Expected("G", most=MOST_NEPERS),
    "log_through": Expected("G", most=MOST_NEPERS),
}
"""What the arrays of :class:`Parameters` must be: G groups, L lobes."""


@dataclass(frozen=True)
class Parameters:
    """Radio parameters of the groups of a surface, or of the materials that a fit takes several of them for: G rows of either.

    Attributes:
        log_weight: ln of the lobe weights, shape ``(G, L)``; their sum is S^2.
        log_excess: ln(epsilon_r - 1), shape ``(G,)``.
        log_mirror: ln of the share of |Gamma|^2 that is reflected as by a mirror, shape ``(G,)``; a prior holds it near 1 - S^2.
        lobes: exponents of the lobes, 0 for Lambertian, at most 1000 and each once.
        reciprocal: whether lobes scatter alike when transmitter and receiver change places. Those of Degli-Esposti et al.
            (2007), Sionna RT's, do not.
        log_gain: ln of a gain common to all paths (an uncalibrated receiver).
        roughness: exponent of frequency in ln(1 - S^2); 2 by Ament (1953).
        log_through: ln of the power that passes its slab over what permittivity and thickness say, or, where those are not
            known, over what both faces let pass, shape ``(G,)``; by default 0.
        log_gains: ln of the unknown gains of measuring chains, shape ``(C,)``; only while a fit lasts.

    Raises:
        TypeError, ValueError: for arrays that do not fit each other, or are out of range.
    """

    log_weight: np.ndarray
    log_excess: np.ndarray
    log_mirror: np.ndarray
    lobes: tuple[int, ...] = LOBES
    reciprocal: bool = False
    log_gain: float = 0.0
    roughness: float = ROUGHNESS
    log_through: np.ndarray = None  # type: ignore[assignment]  # made when it is not given
    log_gains: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        lobes = check_array("lobes", self.lobes, (None,), dtype=np.int64).tolist()
        if not lobes or len(set(lobes)) < len(lobes) or not 0 <= min(lobes) <= max(lobes) <= NARROWEST_LOBE:
            raise ValueError(
                f"lobes: got {self.lobes!r}, expected different exponents, whole numbers from 0 to {NARROWEST_LOBE}"
            )
        object.__setattr__(self, "lobes", tuple(lobes))
        if self.log_through is None:
            object.__setattr__(self, "log_through", np.zeros(len(self.log_excess)))
        check_arrays(vars(self), ARRAYS, L=len(lobes))
        check_type("reciprocal", self.reciprocal, bool)
        check_number("roughness", self.roughness, -10.0, 10.0)
        check_number("log_gain", self.log_gain, -MOST_NEPERS, MOST_NEPERS)

    @property
    def values(self) -> tuple[Hashable, ...]:
        """All of it, to compare by."""
        own = vars(self).values()
        return tuple(one.tobytes() if isinstance(one, np.ndarray) else one for one in own)

    @property
    def weight(self) -> np.ndarray:
        """Lobe weights ``(G, L)``."""
        return np.exp(self.log_weight)

    @property
    def excess(self) -> np.ndarray:
        """epsilon_r - 1, from 0.05 to 200, shape ``(G,)``."""
        return np.clip(np.exp(self.log_excess), *EXCESS)

    @property
    def gain(self) -> float:
        """The common gain."""
        return float(np.exp(self.log_gain))

    @property
    def scattered_share(self) -> np.ndarray:
        """Share of isotropic light that each group scatters, ``(G,)``: lobe weights times 2 int F cos dcos."""
        return self.weight.sum(axis=1) * fresnel_curves().even(self.log_excess)[0]

    def scattered_over_even(self, group: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """What groups (K,) scatter of light at cosines of incidence (K,), over what they do of isotropic light, ``(K,)``."""
        curves = fresnel_curves()
        table = curves.at(curves.curves, self.log_excess)[0] / curves.even(self.log_excess)[0][:, None]
        found = table[group, np.rint((COSINES - 1) * cosine).astype(int)]
        return 0.5 * (1.0 + found) if self.reciprocal else found

    @property
    def mirrored_share(self) -> np.ndarray:
        """Share of power that each group mirrors head on, ``(G,)``."""
        index = 1.0 + np.sqrt(1.0 + self.excess)
        return np.exp(self.log_mirror) * (1.0 - 2.0 / index) ** 2

    @property
    def log_smooth(self) -> np.ndarray:
        """ln of what each group mirrors of all that it mirrors and scatters, ``(G,)``: -(4 pi sigma_h / lambda)^2 of a
        surface of rms height sigma_h (Ament 1953)."""
        return self.log_mirror - np.log(self.weight.sum(axis=1) + np.exp(self.log_mirror))

    def take(self, index: np.ndarray) -> Parameters:
        """The rows ``index``: of materials to those of groups, say."""
        rows = {name: getattr(self, name)[index] for name in ARRAYS}
        return replace(self, **rows)

    def at_ratio(self, ratio: float) -> Parameters:
        """Those of the same surfaces at ``ratio`` times the carrier: roughness and slabs count in wavelengths.

        What is not scattered, exp(-(4 pi sigma_h / lambda)^2) (Ament 1953), is raised to the square of the ratio, or to
        another power where the data say so; the sum of both shares, the mix of lobes and the permittivity stay. What slabs
        lose beside, as absorption does at one loss tangent, goes with the carrier; a positive ``log_through`` stays.
        """
        if ratio == 1.0:
            return self
        scattered = self.weight.sum(axis=1)
        both = scattered + np.exp(self.log_mirror)
        log_smooth = ratio**self.roughness * self.log_smooth
        grown = np.log(np.maximum(-np.expm1(log_smooth), 1e-12) * both / scattered)
        return replace(
            self, log_weight=np.maximum(self.log_weight + grown[:, None], -MOST_NEPERS),
            log_mirror=np.maximum(log_smooth + np.log(both), -MOST_NEPERS),
            log_through=np.maximum(self.through_slope(ratio) * self.log_through, -MOST_NEPERS),
        )  # fmt: skip

    def through_slope(self, ratio: float) -> np.ndarray:
        """Derivative of what :meth:`at_ratio` makes of each of ``log_through``, shape ``(G,)``."""
        return np.where(self.log_through < 0.0, ratio, 1.0)

    @classmethod
    def prior(cls, groups: int, lobes: Sequence[int] = LOBES, *, reciprocal: bool = False) -> Parameters:
        """What a surface is taken for before any measurement: half scattered, half mirrored, epsilon_r of 4."""
        share = np.full((groups, len(lobes)), np.log(0.5 / max(len(lobes), 1)))
        excess, mirror = np.full(groups, np.log(3.0)), np.full(groups, np.log(0.5))
        return cls(share, excess, mirror, tuple(lobes), reciprocal)


@dataclass(frozen=True)
class Model:
    """All that a spectrum depends on besides the geometry.

    Attributes:
        effects: kinds of paths.
        parameters: of the groups.
        residual: ln gain of each surface cell over its group, shape ``(2, X)``: for light that comes straight from the
            transmitter, and for light that comes to the cell over others; see :mod:`warprrf.rf.fields.bistatic.residual`.
        transmitter: under which the latter were learned [m], shape ``(3,)``. Light of another falls elsewhere: of that
            nothing was learned, so its gains are 1.
    """

    effects: Effects
    parameters: Parameters
    residual: np.ndarray
    transmitter: np.ndarray

    def at_ratio(self, ratio: float) -> Model:
        """That of the same surfaces at ``ratio`` times the carrier."""
        return replace(self, parameters=self.parameters.at_ratio(ratio))

    def learned_rows(self, transmitter: np.ndarray) -> int:
        """How many rows of the residual are known under ``transmitter`` (3,): gains of light sent on under the own one alone."""
        return 1 + np.allclose(transmitter, self.transmitter, rtol=0.0, atol=1e-6)  # [m]


class Layout:
    """Order of the free parameters in a vector: per group lobes, excess, mirror, and what it lets through; then the common gain,
    then the power of the carrier that roughness goes with, then the gains of measuring chains. Groups stand for materials where
    those are fitted.

    Attributes:
        groups, lobes: how many.
        through, gain, roughness: whether these are free.
        chains: how many gains of measuring chains are free.
        stride: parameters of a group.
        first_chain: place of the first chain's gain.
        size: of the vector.
    """

    def __init__(
        self,
        groups: int,
        lobes: int,
        *,
        through: bool = False,
        gain: bool = False,
        roughness: bool = False,
        chains: int = 0,
    ) -> None:
        self.groups, self.lobes, self.through = groups, lobes, through
        self.gain, self.roughness, self.chains = gain, roughness, chains
        self.stride = lobes + 2 + through
        self.first_chain = groups * self.stride + gain + roughness
        self.size = self.first_chain + chains

    @property
    def common_gain(self) -> int:
        """Index of the common gain."""
        return self.groups * self.stride

    @property
    def roughness_exponent(self) -> int:
        """Index of the exponent of frequency."""
        return self.groups * self.stride + self.gain

    def weight(self, group: np.ndarray) -> np.ndarray:
        """Indices of the lobe weights of each of ``group`` (K,), shape ``(K, L)``."""
        return self.stride * group[:, None] + np.arange(self.lobes)

    def excess(self, group: np.ndarray) -> np.ndarray:
        """Indices of the permittivity of each of ``group``."""
        return self.stride * group + self.lobes + EXCESS_COLUMN

    def mirror(self, group: np.ndarray) -> np.ndarray:
        """Indices of the mirror share of each of ``group``."""
        return self.stride * group + self.lobes + MIRRORED_COLUMN

    def let_through(self, group: np.ndarray) -> np.ndarray:
        """Indices of what each of ``group`` lets through, if that is free."""
        return self.stride * group + self.lobes + THROUGH_COLUMN

    def columns(self, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the parameters of each group begin in a table of those of ``groups`` alone, shape ``(G,)`` int32, and the index of
        each of its columns in the vector."""
        own = np.unique(groups)
        place = np.zeros(self.groups, np.int32)
        place[own] = self.stride * np.arange(len(own))
        return place, (self.stride * own[:, None] + np.arange(self.stride)).ravel()

    def pack(self, p: Parameters) -> np.ndarray:
        """Vector of ``p``."""
        columns = {EXCESS_COLUMN: p.log_excess, MIRRORED_COLUMN: p.log_mirror, THROUGH_COLUMN: p.log_through}
        shown = [columns[k] for k in range(self.stride - self.lobes)]
        table = np.column_stack([p.log_weight, *shown]).ravel()
        single = [p.log_gain] * self.gain + [p.roughness] * self.roughness
        return np.concatenate([table, single, p.log_gains])

    def unpack(self, vector: np.ndarray, like: Parameters) -> Parameters:
        """Parameters of a vector; what it does not hold is as in ``like``."""
        table = vector[: self.groups * self.stride].reshape(self.groups, self.stride)
        excess, mirror = (table[:, self.lobes + k].copy() for k in (EXCESS_COLUMN, MIRRORED_COLUMN))
        through = table[:, self.lobes + THROUGH_COLUMN].copy() if self.through else like.log_through
        return replace(
            like, log_through=through, log_weight=table[:, : self.lobes].copy(), log_excess=excess,
            log_mirror=mirror, log_gains=vector[self.first_chain :].copy(),
            log_gain=float(vector[self.common_gain]) if self.gain else like.log_gain,
            roughness=float(vector[self.roughness_exponent]) if self.roughness else like.roughness,
        )  # fmt: skip

    def slopes_at_ratio(self, p: Parameters, ratio: float) -> csr_matrix:
        """Derivatives of the vector of ``p.at_ratio(ratio)`` (rows) to that of ``p`` (columns)."""
        weight, mirror, n = p.weight, np.exp(p.log_mirror), self.lobes
        mirrored = n + MIRRORED_COLUMN
        scattered = weight.sum(axis=1)
        both = scattered + mirror
        share, own = np.zeros((2, self.groups, self.stride))  # of ln both, and of ln mirror
        share[:, :n], share[:, mirrored] = weight / both[:, None], mirror / both
        own[:, mirrored] = 1.0
        steeper = ratio**p.roughness
        smooth = steeper * (own - share)
        fall = 1.0 / np.maximum(np.expm1(-steeper * p.log_smooth), 1e-12)
        grown = share - fall[:, None] * smooth
        grown[:, :n] -= weight / scattered[:, None]
        table = np.tile(np.eye(self.stride), (self.groups, 1, 1))
        table[:, mirrored] = smooth + share
        table[:, :n] += grown[:, None]
        if self.through:
            through = n + THROUGH_COLUMN
            table[:, through, through] = p.through_slope(ratio)
        groups = bsr_matrix((table, np.arange(self.groups), np.arange(self.groups + 1)))
        found = block_diag([groups, identity(self.size - groups.shape[0])], format="lil")
        if self.roughness:
            change = np.log(ratio) * steeper * p.log_smooth  # of ln smooth
            rows = np.zeros((self.groups, self.stride))
            rows[:, :n], rows[:, mirrored] = (-fall * change)[:, None], change
            found[: rows.size, self.roughness_exponent] = rows.reshape(-1, 1)
        return found.tocsr()
