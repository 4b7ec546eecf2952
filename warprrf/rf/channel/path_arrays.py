"""Arrays of propagation paths, of one receiver or several: what channels are computed from.

Angles: arrival points from the receiver to the last interaction, departure from the transmitter to the first.

Polarisation. ``gain`` is one complex number a path, |gain|^2 being the path gain averaged over vertical and horizontal
transmit polarisation and summed over both receive polarisations: its power is defined, its phase is that of the delay
(and, where materials are known, of the TE reflections). A polarised amplitude needs ``jones``: the 2x2 matrix from the
transmitted field along (zenith unit vector, azimuth unit vector) of the departure to the received field along those of
the arrival, Friis and exp(-j 2 pi f tau) included, so that ``|gain|^2`` is half its squared Frobenius norm. Only paths
traced in a scene with materials, or taken from a solver, have it; spectra and fields hold powers alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from warprrf.checks import Shaped, check_chosen, check_count, check_items, checked, one_line
from warprrf.kernels.radio.records import EDGE, MIRROR, SCATTER, SLAB
from warprrf.rf.em.absorption import Air, Gas, air_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase
from warprrf.rf.spectra.spectrum import angles_from_directions, directions_from_angles

_LAST = {"diffuse": SCATTER, "slab": SLAB, "edge": EDGE}
MOST_PATHS = 10_000_000
"""Longest list that is asked for: 2 GB of a receiver."""
PADDING: dict[str, Any] = {
    "gain": 0.0, "tau": np.nan, "theta_r": np.nan, "phi_r": np.nan, "theta_t": np.nan, "phi_t": np.nan,
    "vertices": np.nan, "kind": "", "valid": False, "jones": 0.0, "interactions": 0,
}  # fmt: skip
"""Arrays with an entry for each path, and what they hold where there is none."""


@checked
@dataclass(frozen=True)
class PathArrays:
    """Paths of one receiver, arrays ``(L,)``, or of several, arrays ``(R, L)`` padded where ``valid`` is False.

    Attributes:
        gain: Complex gain between isotropic antennas, exp(-j 2 pi f tau) included; |gain|^2 is path gain averaged over
            vertical and horizontal transmit polarisation and summed over both receive polarisations. 0 where padded.
        tau: Delay [s]; NaN where padded, as the angles are.
        theta_r, phi_r: Zenith and azimuth of arrival [rad].
        theta_t, phi_t: Of departure [rad].
        vertices: Interaction points from the transmitter on [m], shape ``(..., depth, 3)``; NaN past the last.
        kind: "los", "mirror", "slab" (through walls, and mirrors perhaps), "edge" (over an edge, too) or "diffuse"; "" where
            padded.
        valid: Whether there is a path.
        jones: Polarised complex gain, shape ``(..., 2, 2)``: received over transmitted, both along zenith and azimuth
            unit vectors; NaN for paths without, None if no path has it. 0 where padded.
        frequency_hz: Carrier that ``gain`` and ``jones`` hold at [Hz]; None if not known.
        transmitter: Position [m], shape ``(3,)``, or of each receiver ``(R, 3)``; None if not known.
        receiver: Position ``(3,)`` or positions ``(R, 3)`` [m]; None if not known.
        air: The air whose absorption (ITU-R P.676) is in ``gain`` and ``jones``; None for none.
        interactions: What happens at each of ``vertices``, shape ``(..., depth)``, int8: 1 mirror, 2 scatter, 4 transmission, 8
            diffraction, 0 past the last. Where not given, ``kind`` is what happens last, after mirrors.
    """

    __repr__ = one_line

    gain: np.ndarray
    tau: np.ndarray
    theta_r: np.ndarray
    phi_r: np.ndarray
    theta_t: np.ndarray
    phi_t: np.ndarray
    vertices: np.ndarray
    kind: NDArray[np.str_]
    valid: np.ndarray
    jones: np.ndarray | None = None
    frequency_hz: float | None = None
    transmitter: np.ndarray | None = None
    receiver: np.ndarray | None = None
    air: Air | None = None
    interactions: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))

    def __post_init__(self) -> None:
        """Refuse arrays that are not of the same paths; ValueError names the field."""
        for name in PADDING:
            array = getattr(self, name) if name != "interactions" else None  # those are looked at below
            if array is not None and array.shape[: self.gain.ndim] != self.gain.shape:
                raise ValueError(
                    f"{name}: got shape {array.shape}, expected that of gain first, {self.gain.shape}"
                )
        if self.interactions.size == 0:
            there = np.isfinite(self.vertices[..., 0])
            codes = np.where(there, MIRROR, 0)
            last = np.cumsum(there, axis=-1) == there.sum(-1, keepdims=True)
            for kind, code in _LAST.items():
                codes[there & last & (self.kind == kind)[..., None]] = code
            object.__setattr__(self, "interactions", codes.astype(np.int8))
        elif self.interactions.shape != self.vertices.shape[:-1]:
            raise ValueError(
                f"interactions: got shape {self.interactions.shape}, expected {self.vertices.shape[:-1]}, one for each of "
                "vertices"
            )

    @property
    def power(self) -> np.ndarray:
        """Path gain |gain|^2 [linear], shape as ``gain``; 0 where padded."""
        return np.where(self.valid, np.abs(self.gain) ** 2, 0.0)

    @property
    def length_m(self) -> np.ndarray:
        """Unfolded length, with what slabs delay [m]; NaN where padded."""
        return self.tau * SPEED_OF_LIGHT

    @property
    def air_m(self) -> np.ndarray:
        """Length over which air absorbs [m], without what slabs delay, as far as the ends are known; NaN where padded."""
        through = (self.interactions == SLAB).any(axis=-1)
        if self.transmitter is None or self.receiver is None or not through.any():
            return self.length_m
        points = points_along(self.transmitter, self.vertices, self.receiver)
        return np.where(through, length_along(points), self.length_m)

    @property
    def arrival(self) -> np.ndarray:
        """Unit vectors from the receiver to the last interaction, shape ``(..., 3)``."""
        return directions_from_angles(self.theta_r, self.phi_r)

    @property
    def departure(self) -> np.ndarray:
        """Unit vectors from the transmitter to the first interaction, shape ``(..., 3)``."""
        return directions_from_angles(self.theta_t, self.phi_t)

    @property
    def batched(self) -> bool:
        """Whether the arrays are those of several receivers, ``(R, L)``."""
        return self.gain.ndim == 2

    def __getitem__(self, receiver: int) -> Self:
        """The paths of one of several receivers, without padding.

        Raises:
            TypeError: for paths of one receiver.
        """
        one = self.row(receiver)
        return one.select(one.valid)

    def row(self, receiver: int) -> Self:
        """The paths of one of several receivers, padded as they are.

        Raises:
            TypeError: for paths of one receiver.
            ValueError: if there is no such receiver.
        """
        if not self.batched:
            raise TypeError("paths of one receiver cannot be indexed by receiver; expected paths of several")
        check_count("receiver", receiver, -len(self.gain), len(self.gain) - 1)
        point = None if self.receiver is None else self.receiver[receiver]
        source = self.transmitter
        if source is not None and source.ndim == 2:
            source = source[receiver]
        return replace(self._taken(receiver), receiver=point, transmitter=source)

    def _taken(self, index: int | slice | np.ndarray) -> Self:
        arrays: dict[str, Any] = {name: getattr(self, name) for name in PADDING}
        taken: dict[str, Any] = {name: None if v is None else v[index] for name, v in arrays.items()}
        return replace(self, **taken)

    def as_several(self) -> Self:
        """Paths of several receivers: one receiver's as a list of one."""
        return self if self.batched else self.stack([self])

    def each(self) -> Iterator[Self]:
        """The paths of one receiver after another, without padding."""
        several = self.as_several()
        yield from (several[k] for k in range(len(several.gain)))

    __iter__ = each

    def select(self, chosen: slice | np.ndarray) -> Self:
        """Paths ``chosen`` of one receiver: indices in any order, or a mask ``(L,)``.

        Raises:
            TypeError: for paths of several receivers.
        """
        if self.batched:
            raise TypeError(
                "paths of several receivers cannot be selected from at once; index a receiver first"
            )
        if isinstance(chosen, slice):
            return self._taken(chosen)
        return self._taken(check_chosen("chosen", chosen, len(self.gain)))

    def with_gas(self, gas: Gas = True) -> Self:
        """The same paths with the absorption of ``gas`` in their gains, in place of what was in them.

        Args:
            gas: False for none, True for the standard atmosphere, :class:`Air`, or a :class:`Relevance`, which says
                whether the absorption is worth its tolerance.

        Raises:
            ValueError: if the carrier or a path's delay is not known, or the carrier is outside ITU-R P.676.
        """
        air = air_of(gas)
        if air == self.air:
            return self
        self.check_delays()
        carrier = self.carrier_hz
        change = 0.0 if air is None else air.attenuation_db_per_m(carrier)
        change -= 0.0 if self.air is None else self.air.attenuation_db_per_m(carrier)
        loss = 10.0 ** (-change * np.nan_to_num(self.air_m) / 20.0)
        return replace(turned(self, loss), air=air)

    @property
    def carrier_hz(self) -> float:
        """Carrier [Hz].

        Raises:
            ValueError: if it is not known.
        """
        if self.frequency_hz is None:
            raise ValueError(
                "paths: got ones without frequency_hz, expected the carrier that their gains hold at "
                "(dataclasses.replace(paths, frequency_hz=...))"
            )
        return self.frequency_hz

    def check_delays(self) -> None:
        """Raises ValueError if a path has no delay."""
        unknown = int((self.valid & ~np.isfinite(self.tau)).sum())
        if unknown:
            raise ValueError(f"paths: got {unknown} without a delay, expected tau for every path")

    @classmethod
    def from_points(
        cls,
        transmitter: Annotated[np.ndarray, Shaped("3")],
        receiver: Annotated[np.ndarray, Shaped("3")],
        vertices: Annotated[np.ndarray, Shaped("L D 3", finite=False)],
        amplitude: Annotated[np.ndarray, Shaped("L", np.complex128)],
        kind: NDArray[np.str_],
        frequency_hz: float,
        *,
        jones: Annotated[np.ndarray, Shaped("L 2 2", np.complex128, finite=False)] | None = None,
        excess_m: Annotated[np.ndarray, Shaped("L")] | None = None,
        interactions: np.ndarray | None = None,
    ) -> Self:
        """Paths of one receiver from their interaction points ``(L, depth, 3)``, NaN past the last.

        Args:
            amplitude: Gain before exp(-j 2 pi f tau), complex, shape ``(L,)``; its modulus squared is the path gain.
            jones: Polarised gains likewise, shape ``(L, 2, 2)``, where known.
            excess_m: By what slabs make a path longer than it is [m], shape ``(L,)``.
            interactions: As of :class:`PathArrays`.
        """
        bounces = np.isfinite(vertices[..., 0]).sum(axis=1)
        points = points_along(transmitter, vertices, receiver)
        last, length = points[np.arange(len(points)), bounces], length_along(points)
        tau = (length if excess_m is None else length + excess_m) / SPEED_OF_LIGHT
        theta_r, phi_r = angles_from_directions(last - receiver)
        theta_t, phi_t = angles_from_directions(points[:, 1] - transmitter)
        turned = carrier_phase(frequency_hz, tau)
        return cls(
            gain=amplitude * turned,
            tau=tau,
            theta_r=theta_r,
            phi_r=phi_r,
            theta_t=theta_t,
            phi_t=phi_t,
            vertices=vertices,
            kind=kind,
            valid=np.ones(len(points), dtype=bool),
            jones=None if jones is None else jones * turned[:, None, None],
            frequency_hz=frequency_hz,
            transmitter=transmitter.copy(),
            receiver=receiver.copy(),
            interactions=np.zeros(0, np.int8) if interactions is None else interactions,
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All paths of one receiver.

        Raises:
            ValueError, TypeError: for no paths, or those of several receivers.
        """
        check_items("parts", parts, PathArrays, 1)
        if not all(np.array_equal(p.receiver, parts[0].receiver) for p in parts):  # type: ignore[arg-type]
            raise ValueError("parts: got paths of several receivers, expected those of one (Paths.stack)")
        joined: dict[str, Any] = {name: np.concatenate(arrays) for name, arrays in _columns(parts).items()}
        return cls(**joined, **_common(parts), receiver=parts[0].receiver)

    @classmethod
    def stack(cls, parts: Sequence[Self], length: int = 0) -> Self:
        """Paths of several receivers, padded to the longest list or to ``length``: arrays ``(R, L)``.

        Raises:
            ValueError, TypeError: for no paths, or a length above :data:`MOST_PATHS`.
        """
        check_items("parts", parts, PathArrays, 1)
        length = max(check_count("length", length, 0, MOST_PATHS), *(len(p.gain) for p in parts))
        stacked: dict[str, Any] = {
            name: np.stack([_padded(a, 0, length, PADDING[name]) for a in arrays])
            for name, arrays in _columns(parts).items()
        }
        receiver = None
        if all(p.receiver is not None for p in parts):
            receiver = np.stack([np.asarray(p.receiver) for p in parts])
        sources = [p.transmitter for p in parts if p.transmitter is not None]
        common = _common([replace(p, transmitter=None) for p in parts])
        if sources:
            alike = all(np.array_equal(s, sources[0]) for s in sources)
            if alike or len(sources) == len(parts):
                common["transmitter"] = sources[0] if alike else np.stack(sources)
        return cls(**stacked, **common, receiver=receiver)


P = TypeVar("P", bound=PathArrays)


def turned(paths: P, turn: np.ndarray) -> P:
    """The same paths with their complex gains times ``turn``, complex or real, shape as ``gain``."""
    jones = None if paths.jones is None else paths.jones * turn[..., None, None]
    return replace(paths, gain=paths.gain * turn, jones=jones)


def points_along(transmitter: np.ndarray, vertices: np.ndarray, receiver: np.ndarray) -> np.ndarray:
    """Paths from end to end [m], shape ``(..., depth + 2, 3)``: past the last point is the receiver."""
    shape = (*vertices.shape[:-2], 1, 3)
    start, end = (np.broadcast_to(np.asarray(e)[..., None, None, :], shape) for e in (transmitter, receiver))
    return np.concatenate([start, np.where(np.isfinite(vertices), vertices, end), end], axis=-2)


def length_along(points: np.ndarray) -> np.ndarray:
    """Length from end to end [m], shape ``(...)``, of paths along ``points`` as of :func:`points_along`."""
    return np.asarray(np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(axis=-1))


def _columns(parts: Sequence[PathArrays]) -> dict[str, list[np.ndarray]]:
    """The arrays of all parts by name, equally deep; without ``jones`` if no part has it, NaN for those that lack it."""
    if any(p.batched for p in parts):
        raise ValueError("parts: got lists of several receivers, expected one of each (Paths.each)")
    columns = {name: [getattr(p, name) for p in parts] for name in PADDING}
    depth = max((v.shape[1] for v in columns["vertices"]), default=1)
    for name in ("vertices", "interactions"):
        columns[name] = [_padded(v, 1, depth, PADDING[name]) for v in columns[name]]
    known = columns.pop("jones")
    if any(jones is not None for jones in known):
        columns["jones"] = [
            np.full((len(p.gain), 2, 2), np.nan + 0j) if jones is None else jones
            for p, jones in zip(parts, known, strict=True)
        ]
    return columns


def _padded(array: np.ndarray, axis: int, length: int, fill: float) -> np.ndarray:
    widths = [(0, length - n if k == axis else 0) for k, n in enumerate(array.shape)]
    return np.pad(array, widths, constant_values=fill)


def _common(parts: Sequence[PathArrays]) -> dict[str, Any]:
    """What all parts share."""
    first = parts[0]
    for p in parts[1:]:
        same = p.frequency_hz == first.frequency_hz and p.air == first.air
        if p.transmitter is not None and first.transmitter is not None:
            same &= bool(np.array_equal(p.transmitter, first.transmitter))
        if not same:
            raise ValueError(
                "parts: got paths of another carrier, transmitter or air, expected the same for all"
            )
    return {"frequency_hz": first.frequency_hz, "transmitter": first.transmitter, "air": first.air}
