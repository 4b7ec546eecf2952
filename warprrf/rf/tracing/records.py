"""Records of paths as geometry fixes them, and what parameters make of them: powers, slopes, columns.

A table holds the paths of one sequence of interactions, named from the transmitter to the receiver: ``M`` a mirror, ``S`` a
surface that scatters, ``E`` an element of the surface that sends on what it got of others, ``T`` slabs that are passed.
Paths without scattering, of one direction each, are the table ``"specular"``. All kinds are evaluated by
:mod:`warprrf.kernels.radio.records`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np
import warp as wp

from warprrf.cache import Cache
from warprrf.device import DeviceLike, filled, launch, resolve
from warprrf.kernels.radio import records as kernels
from warprrf.rf.em.fresnel import COSINES, SurfaceTable, fresnel_curves, lobe_norm, reciprocal_factor
from warprrf.rf.tracing.model import Parameters
from warprrf.rf.tracing.rays import REALS
from warprrf.rows import Rows


@dataclass(frozen=True)
class Interactions(Rows):
    """Interactions, K in a row.

    Attributes:
        index: group that each meets, or side of the element that sends, from the transmitter on, -1 for none, shape ``(N, K)``.
        angle: of each (cosine of incidence, turn of its plane [rad], thickness in wavelengths), of one that scatters three
            cosines; see :mod:`warprrf.kernels.radio.records`; shape ``(N, K, 3)``.
        kind: ``MIRROR``, ``SCATTER``, ``SLAB``, ``SOURCE`` of the kernels or 0, shape ``(N, K)`` int8. What is rough is in the same
            column of all rows.
    """

    index: np.ndarray
    angle: np.ndarray
    kind: np.ndarray

    @classmethod
    def of_kind(cls, index: np.ndarray, angle: np.ndarray, kind: int) -> Interactions:
        """Those of one ``kind`` all."""
        return cls(index, angle, np.full(index.shape, kind, np.int8))

    @classmethod
    def of_mirrors(cls, group: np.ndarray, cosine: np.ndarray) -> Interactions:
        """One mirror each: group ``(N,)`` and cosine of incidence ``(N,)``."""
        angle = np.column_stack([cosine, 0.0 * cosine, 0.0 * cosine])
        return cls.of_kind(group[:, None], angle[:, None], kernels.MIRROR)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all ``parts``; shorter ones meet nothing at their end."""
        most = max(part.index.shape[1] for part in parts)
        return super().joined([part.widened(most) for part in parts])

    def widened(self, count: int) -> Self:
        """Each row as ``count`` interactions."""
        more = (0, 0), (0, count - self.index.shape[1])
        index, kind = np.pad(self.index, more, constant_values=-1), np.pad(self.kind, more)
        return replace(self, index=index, angle=np.pad(self.angle, (*more, (0, 0))), kind=kind)


@dataclass(frozen=True, eq=False)
class Records(Interactions):
    """Paths of one sequence: N records of K interactions from the transmitter to the receiver.

    Attributes:
        power: path gain without interactions, shape ``(N,)``; where a ray sees what scatters or sends
            lambda^2 Omega cos(theta_i) / (4 pi d1)^2 or (lambda / 4 pi)^2 Omega. Its precision is that of what is computed.
        ray: what its maker sums over: rays of the receiver's grid, paths without scattering, or sides of elements, ``(N,)``.
        residual_row: row of :attr:`Model.residual`: 0 where light comes straight from the transmitter, 1 over mirrors, slabs or
            elements; -1 for none.
        reach_m: of what is seen through slabs, how far along the ray that is [m], shape ``(N,)``; None elsewhere.
        half_width: half the spacing of rays in the cosine of scattering, over which 1 / cosine is averaged.
    """

    power: np.ndarray
    ray: np.ndarray
    residual_row: int = -1
    half_width: float = 0.0
    reach_m: np.ndarray | None = None
    _uploaded: Cache = field(init=False, repr=False, default_factory=lambda: Cache(1))

    @property
    def rough(self) -> int:
        """Column of what leaves light unpolarised, K where there is none."""
        found = np.isin(self.kind[:1], (kernels.SCATTER, kernels.SOURCE)).nonzero()[1]
        return int(found[0]) if len(found) else self.index.shape[1]

    @property
    def is_single(self) -> bool:
        """Whether surfaces scatter it once and slabs are all that it meets else."""
        kinds = set(self.kind[:1].ravel().tolist())
        return kernels.SCATTER in kinds and kinds <= {kernels.SCATTER, kernels.SLAB}

    @property
    def is_sent(self) -> bool:
        """Whether elements send."""
        return bool((self.kind[:1] == kernels.SOURCE).any())

    def rough_groups(self, side_group: np.ndarray) -> np.ndarray:
        """Group that scatters or sends in each, shape ``(N,)``; ``side_group`` (E,) is that of each side of an element."""
        own = self.index[:, self.rough] if len(self) else np.zeros(0, np.int32)
        return side_group[own] if self.is_sent else own

    def groups(self, side_group: np.ndarray) -> np.ndarray:
        """Groups that any of its interactions meets."""
        rough = self.rough
        found = [own for k, own in enumerate(self.index.T) if k != rough]
        found += [self.rough_groups(side_group)] if rough < self.index.shape[1] else []
        every = np.concatenate([np.zeros(0, int), *found])
        return np.unique(every[every >= 0])

    def powers(self, materials: Materials) -> np.ndarray:
        """Power of each under ``materials``, shape ``(N,)``."""
        if len(self) == 0:
            return np.zeros(0)
        if self.is_sent and not materials.has_sources:
            raise ValueError("materials: got none that elements send by, expected those with their radiance")
        real, (table, m, run) = REALS[self.power.dtype], self._table(materials)
        out = wp.empty(len(self), dtype=real, device=materials.device)
        inputs = [table, m, m.weight, m.excess, m.mirror, m.through, out]
        run(kernels.build(real).record_power, len(self), inputs)
        return np.asarray(out.numpy(), np.float64)

    def fields(
        self, materials: Materials, sent: np.ndarray, heard: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Field between two polarised antennas over mirrors and slabs under ``materials``, shape ``(N,)``, and its derivatives to
        ln(epsilon_r - 1) of each interaction, shape ``(N, K)``. Those to the logarithms of the shares that it mirrors or lets
        through are half of the field.

        It is real: half-spaces have no phase but their sign, and of slabs the sizes count; what they delay is in the path's length.

        Args:
            sent, heard: fields of the antennas in the (TE, TM) of the first interaction and of the last, shape ``(N, 2)`` each.
        """
        if len(self) == 0:
            return np.zeros(0), np.zeros(self.index.shape)
        real, where = REALS[self.power.dtype], materials.device
        ends = (wp.array(own, dtype=wp.types.vector(2, real), device=where) for own in (sent, heard))
        out, slope = (wp.zeros(shape, dtype=real, device=where) for shape in (len(self), self.index.shape))
        table, m, run = self._table(materials)
        run(kernels.build(real).record_field, len(self), [table, m, *ends, out, slope])
        return out.numpy(), slope.numpy()

    def add_slopes(self, materials: Materials, bins: Bins, place: np.ndarray, slopes: np.ndarray) -> None:
        """Add to ``slopes`` (B, C) the derivatives of the powers summed in ``bins`` to logarithms of parameters; those of
        material m stand from column ``place[m]`` on: lobe weights, epsilon_r - 1, mirrored share, share let through."""
        if isinstance(materials, SlabMaterials):
            raise TypeError("materials: got slabs, expected half-spaces, which have slopes")
        self._add("bin_slopes", materials, bins, [place], slopes)

    def slopes(self, materials: Materials, place: np.ndarray, count: int) -> np.ndarray:
        """Those of each record, shape ``(N, count)``."""
        found = np.zeros((len(self), count))
        self.add_slopes(materials, Bins.of(np.arange(len(self)), len(self)), place, found)
        return found

    def components(self, materials: Materials, bins: Bins) -> tuple[np.ndarray, np.ndarray]:
        """What groups scatter into each bin at unit weight: the groups that do, shape ``(A,)``, and sums by lobe and
        component of :class:`warprrf.rf.em.fresnel.FresnelCurves`, shape ``(B, A, L, 3)``."""
        own = bins.order[bins.first[0] : bins.first[-1]]
        groups = np.unique(self.rough_groups(np.zeros(0, int))[own])
        place = np.zeros(int(self.index.max(initial=0)) + 1, np.int32)
        place[groups] = np.arange(len(groups))
        lobes = len(materials.parameters.lobes)
        found = np.zeros((bins.count, len(groups) * lobes * kernels.MOMENTS), self.power.dtype)
        self._add("bin_components", materials, bins, [place, fresnel_curves().moments], found)
        return groups, found.reshape(bins.count, len(groups), lobes, kernels.MOMENTS)

    def _add(self, kernel: str, materials: Materials, bins: Bins, more: list[Any], sums: np.ndarray) -> None:
        if sums.size == 0 or len(self) == 0:
            return
        real, where = REALS[self.power.dtype], materials.device
        out = wp.array(sums, dtype=real, device=where, copy=False)
        table, m, run = self._table(materials)
        kernel_of = getattr(kernels.build(real), kernel)
        run(kernel_of, bins.count, [bins.first, bins.order, table, m, *more, out])
        if out.ptr != sums.ctypes.data:  # it was a copy: of another precision, or on another device
            sums[...] = out.numpy()

    def _table(self, materials: Materials) -> tuple[Any, Any, Any]:
        real, where = REALS[self.power.dtype], materials.device

        def upload() -> Any:
            table = kernels.build(real).Table()
            table.power = wp.array(self.power, dtype=real, device=where, copy=False)
            table.index = wp.array(self.index, dtype=wp.int32, device=where, copy=False)
            table.angle = wp.array(self.angle, dtype=wp.types.vector(3, real), device=where, copy=False)
            table.kind = wp.array(self.kind, dtype=wp.int8, device=where, copy=False)
            table.rough, table.half_width = self.rough, self.half_width
            return table

        table = self._uploaded.get(where, upload)
        return table, materials.on_device(real), partial(launch, device=where)


@dataclass(frozen=True, eq=False)
class Bins:
    """Records in the order of the bins that they are summed in.

    Attributes:
        first: where each bin's records begin in ``order``, shape ``(B + 1,)`` int32.
        order: records by bin, shape ``(N,)`` int32.
    """

    first: np.ndarray
    order: np.ndarray

    @property
    def count(self) -> int:
        """Number of bins."""
        return len(self.first) - 1

    @classmethod
    def of(cls, own: np.ndarray, count: int) -> Bins:
        """Those of records in the bins ``own`` (N,) of ``count``, -1 for none."""
        if count <= np.iinfo(np.int16).max:
            own = own.astype(np.int16)  # which NumPy sorts by counting
        order = np.argsort(own, kind="stable").astype(np.int32)
        return cls(np.searchsorted(own[order], np.arange(count + 1)).astype(np.int32), order)


class Materials:
    """Materials as kernels take them: M rows of parameters, and which of them each of G groups of faces is made of.

    Args:
        slabs: complex permittivity of each group, 0 where it is not known, and its thickness in wavelengths, ``(G,)`` each; see
            :attr:`~warprrf.rf.tracing.tracer.Tracer.slabs`.
        material: row of each group in the parameters, shape ``(G,)``; by default groups are rows.
        side_group: group of each element's side, shape ``(E,)``; None where no element sends.
        radiance: that each side sends [1/(m^2 sr)] where the transmitter gives cos(theta_i) / d1^2 [1/m^2], shape ``(E,)``.
    """

    def __init__(
        self,
        parameters: Parameters,
        slabs: tuple[np.ndarray, np.ndarray],
        material: np.ndarray | None = None,
        side_group: np.ndarray | None = None,
        radiance: np.ndarray | None = None,
        *,
        device: DeviceLike = None,
    ) -> None:
        self.slabs = slabs
        self.parameters, self.device = parameters, str(resolve(device))
        self.material = np.arange(len(parameters.log_excess)) if material is None else material
        self._side_group = np.zeros(0, int) if side_group is None else side_group
        self._radiance = np.zeros(0) if radiance is None else radiance
        self._made = Cache(2)  # which a pickle leaves behind

    @property
    def has_sources(self) -> bool:
        """Whether it knows what elements send."""
        return len(self._radiance) > 0

    def by_materials(self, parameters: Parameters, material: np.ndarray) -> Materials:
        """The same with parameters of materials in place of those of groups; ``material`` (G,) is that of each."""
        sent = self._side_group, self._radiance
        return Materials(parameters, self.slabs, material, *sent, device=self.device)

    def on_device(self, real: Any) -> Any:
        """The kernels' view of it."""
        return self._made.get(real, lambda: self._upload(real))

    def _upload(self, real: Any) -> Any:
        p, rows, where = self.parameters, self.material, self.device
        even, slope = fresnel_curves().even(p.log_excess)
        eta, thickness = self.slabs
        exponent, scale = _lobes(p.lobes, (p.reciprocal,) * len(p.lobes), real, where, COSINES)
        return filled(
            kernels.build(real).Materials, where, weight=p.weight, excess=p.excess, mirror=np.exp(p.log_mirror),
            even_slope=slope / even, radiance=self._radiance, through=np.exp(p.log_through), thickness=thickness,
            permittivity=np.column_stack([eta.real, eta.imag]), row=rows, side_row=rows[self._side_group],
            reciprocal=np.full(len(p.log_excess), p.reciprocal), exponent=exponent, scale=scale,
        )  # fmt: skip


class SlabMaterials(Materials):
    """A scene's materials as kernels take them: slabs, and lobes of either kind beside each other.

    Args:
        material: of each group, shape ``(G,)``.
    """

    def __init__(
        self, table: SurfaceTable, wavelength_m: float, material: np.ndarray, device: DeviceLike
    ) -> None:
        count = len(table.scattering)
        slabs = table.permittivity, table.thickness_m / wavelength_m
        super().__init__(Parameters.prior(count), slabs, material, device=device)
        self._table = table

    def _upload(self, real: Any) -> Any:
        table, where = self._table, self.device
        m, scattering = super()._upload(real), table.scattering**2
        kinds = list(zip(table.alpha_r.tolist(), table.reciprocal.tolist(), strict=True))
        lobes = sorted(set(kinds))
        weight = np.array([[kind == lobe for lobe in lobes] for kind in kinds]) * scattering[:, None]
        m.slab = 1
        values = {"weight": weight, "mirror": 1.0 - scattering}
        for name, value in values.items():
            setattr(m, name, wp.array(value, dtype=real, device=where))
        m.reciprocal = wp.array(table.reciprocal, dtype=wp.int32, device=where)
        fine = 4097  # entries of a lobe's table: interpolation errs by 1e-6 at most up to an exponent of 100
        m.exponent, m.scale = _lobes(*zip(*lobes, strict=True), real, where, fine)
        return m


@lru_cache(maxsize=8)
def _lobes(
    exponents: tuple[int, ...], reciprocal: tuple[bool, ...], real: Any, device: str, count: int
) -> tuple[wp.array, wp.array]:
    """Exponents of lobes, and a table over the cosine of each: 1 / norm, or the factor of a reciprocal one."""
    cosine, each = np.linspace(0.0, 1.0, count), zip(exponents, reciprocal, strict=True)
    scale = [
        reciprocal_factor(n, cosine) if symmetric else 1.0 / lobe_norm(n, cosine) for n, symmetric in each
    ]
    scales = wp.array(np.stack(scale), dtype=real, device=device)
    return wp.array(exponents, dtype=wp.int32, device=device), scales
