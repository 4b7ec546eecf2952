"""Paths in the shapes and conventions of Sionna RT 2.2, and back.

Sionna's ``a`` holds passband coefficients without exp(-j 2 pi f tau), array and pattern factors included, shape ``(rx,
rx_ant, tx, tx_ant, path)``; ``tau`` and angles are ``(rx, tx, path)`` for synthetic arrays, delays -1 where there is no
path; ``cir`` adds the phase of the delay, by default counted from the first path. Ports are numbered alike here and
there: polarisation by polarisation, then element by element. There is one transmitter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_count, check_positive, checked, one_line
from warprrf.device import require
from warprrf.kernels.radio.records import EDGE, SCATTER, SLAB
from warprrf.rf.channel.arrays import End
from warprrf.rf.channel.path_arrays import PathArrays, turned
from warprrf.rf.channel.response import channel_taps, frequency_response, impulse_response
from warprrf.rf.em.waves import carrier_phase


@checked
@dataclass(frozen=True)
class SionnaPaths:
    """What ``sionna.rt.Paths`` holds for synthetic arrays and one transmitter, as NumPy arrays.

    Attributes:
        a: Passband coefficients, shape ``(R, M, 1, N, L)``, complex128; 0 where there is no path.
        tau: Delays [s], shape ``(R, 1, L)``; -1 where there is no path.
        theta_t, phi_t, theta_r, phi_r: Angles of departure and arrival [rad], shape ``(R, 1, L)``; 0 where none.
        valid: Shape ``(R, 1, L)``, bool.
        interactions: ``sionna.rt.InteractionType`` (1 specular, 2 diffuse, 4 refraction, 8 diffraction, 0 none), shape
            ``(depth, R, 1, L)``.
        vertices: Interaction points [m], shape ``(depth, R, 1, L, 3)``; 0 where none.
        doppler: Doppler shifts [Hz], shape ``(R, 1, L)``; 0 where nothing was said to move.
        synthetic_array: always True.
    """

    __repr__ = one_line

    a: np.ndarray
    tau: np.ndarray
    theta_t: np.ndarray
    phi_t: np.ndarray
    theta_r: np.ndarray
    phi_r: np.ndarray
    valid: np.ndarray
    interactions: np.ndarray
    vertices: np.ndarray
    doppler: np.ndarray
    synthetic_array: ClassVar[bool] = True
    _paths: PathArrays
    _options: dict[str, Any]

    def cir(
        self,
        *,
        sampling_frequency: float = 1.0,
        num_time_steps: int = 1,
        normalize_delays: bool = True,
        out_type: str = "numpy",
    ) -> tuple[Any, Any]:
        """Baseband coefficients ``(R, M, 1, N, L, T)`` and delays ``(R, 1, L)``, as ``sionna.rt.Paths.cir``.

        The ``num_time_steps`` T, ``sampling_frequency`` [Hz] of them a second, differ by the paths' Doppler shifts. ``out_type``
        "torch" gives complex64 and float32 tensors.
        """
        a, tau = impulse_response(self._paths, normalize_delays=normalize_delays, **self._options)
        time_s = _times(num_time_steps, sampling_frequency)
        turn = carrier_phase(-time_s, self.doppler[:, None, :, None, :, None])
        a = a[:, :, None, ..., None] * turn
        return _as(a, out_type), _as(np.where(self.valid, tau[:, None], -1.0), out_type)

    def cfr(
        self,
        frequencies: ArrayLike,
        *,
        sampling_frequency: float = 1.0,
        num_time_steps: int = 1,
        normalize_delays: bool = True,
        normalize: bool = False,
        out_type: str = "numpy",
    ) -> Any:
        """Frequency response ``(R, M, 1, N, T, F)`` at baseband ``frequencies`` (F,) [Hz], as ``sionna.rt.Paths.cfr``.

        ``normalize`` scales each link to unit mean energy.
        """
        f = self._paths.carrier_hz + check_array("frequencies", frequencies, (None,))
        options = self._options | {"squint": False, "normalize_delays": normalize_delays}
        work = partial(frequency_response, frequencies_hz=f, **options)
        h = self._over_time(work, _times(num_time_steps, sampling_frequency))
        return _as(_normalised(h, normalize, mean=True), out_type)

    def taps(
        self,
        bandwidth: float,
        l_min: int,
        l_max: int,
        *,
        sampling_frequency: float | None = None,
        num_time_steps: int = 1,
        normalize: bool = False,
        normalize_delays: bool = True,
        out_type: str = "numpy",
    ) -> Any:
        """Taps ``(R, M, 1, N, T, l_max - l_min + 1)``, as ``sionna.rt.Paths.taps``; T of them a second are ``bandwidth`` by
        default."""
        options = self._options | {"squint": False, "normalize_delays": normalize_delays}
        work = partial(channel_taps, bandwidth_hz=bandwidth, l_min=l_min, l_max=l_max, **options)
        every = bandwidth if sampling_frequency is None else sampling_frequency
        h = self._over_time(work, _times(num_time_steps, every))
        return _as(_normalised(h, normalize, mean=False), out_type)

    def _over_time(self, work: Callable[[PathArrays], np.ndarray], time_s: np.ndarray) -> np.ndarray:
        """``work`` on the paths at each of the times (T,), ``(R, M, N, T, ...)``."""
        if not self.doppler.any():
            h = work(self._paths)[:, :, :, None]
            return np.broadcast_to(h, (*h.shape[:3], len(time_s), *h.shape[4:])).copy()
        turns = (carrier_phase(-t, self.doppler[:, 0]) for t in time_s)
        return np.stack([work(turned(self._paths, turn)) for turn in turns], axis=3)


def to_sionna(
    paths: PathArrays,
    tx_array: End = None,
    rx_array: End = None,
    *,
    diffuse: str | None = None,
    seed: int = 0,
    doppler_hz: ArrayLike | None = None,
) -> SionnaPaths:
    """``paths`` in Sionna RT's shapes: plane waves, carrier phases across arrays.

    Args:
        tx_array, rx_array: One isotropic element without polarisation by default.
        diffuse, seed: see :func:`~warprrf.rf.channel.response.frequency_response`.
        doppler_hz: shift of each path [Hz], as of :meth:`Paths.doppler_hz`; None: nothing moves.

    Raises:
        ValueError: as there; for shifts that are not those of the paths.
    """
    several = paths.as_several()
    shift = np.zeros(several.gain.shape)
    if doppler_hz is not None:
        shift[:] = check_shifts(paths, doppler_hz)
    options: dict[str, Any] = {"tx_array": tx_array, "rx_array": rx_array, "diffuse": diffuse, "seed": seed}
    coefficient, tau = impulse_response(several, **options)
    valid = several.valid & np.isfinite(tau)
    if diffuse == "power":
        valid &= several.kind != "diffuse"
    passband = coefficient * carrier_phase(-several.carrier_hz, np.where(valid, tau, 0.0))[:, None, None]
    there = np.isfinite(several.vertices[..., 0]) & valid[..., None]

    def angle(values: np.ndarray) -> np.ndarray:
        return np.where(valid, values, 0.0)[:, None]

    return SionnaPaths(
        a=passband[:, :, None],
        tau=np.where(valid, tau, -1.0)[:, None],
        **{name: angle(getattr(several, name)) for name in ("theta_t", "phi_t", "theta_r", "phi_r")},
        valid=valid[:, None],
        interactions=np.moveaxis(np.where(there, several.interactions, 0).astype(int), -1, 0)[:, :, None],
        vertices=np.moveaxis(np.where(there[..., None], several.vertices, 0.0), -2, 0)[:, :, None],
        doppler=shift[:, None],
        _paths=several,
        _options=options,
    )


def check_shifts(paths: PathArrays, doppler_hz: ArrayLike) -> np.ndarray:
    """Shifts [Hz] of ``paths``, shape as ``tau``, 0 where padded."""
    given = check_array("doppler_hz", doppler_hz, paths.tau.shape, finite=False)
    if not np.isfinite(given[paths.valid]).all():
        raise ValueError("doppler_hz: got NaN or infinite shifts, expected one for every path")
    return np.where(paths.valid, given, 0.0)


def by_delay(paths: Any, carrier: float, transmitter: int, drop_repeated: bool) -> Iterator[PathArrays]:
    """The paths of ``sionna.rt.Paths`` from one transmitter, of each receiver, by rising delay: in the same order, whatever
    Sionna's threads did; see :meth:`Paths.from_sionna`."""
    if not hasattr(paths, "synthetic_array"):
        raise TypeError(f"paths: got {type(paths).__name__}, expected what Sionna RT's PathSolver returned")
    real, imag = (np.asarray(part.numpy(), dtype=np.float64) for part in paths.a)
    if not paths.synthetic_array or real.shape[1] != 2 or real.shape[3] != 2:
        raise ValueError(
            f"paths: got coefficients of shape {real.shape}, expected those of one isotropic element of both polarisations "
            'at either end: set scene.tx_array and scene.rx_array to PlanarArray(num_rows=1, num_cols=1, pattern="iso", '
            'polarization="VH") and solve with synthetic_array=True'
        )
    check_count("transmitter", transmitter, 0, real.shape[2] - 1)
    a = (real + 1j * imag)[:, :, transmitter]  # (R, 2, 2, L)

    def field(values: Any) -> np.ndarray:
        return np.asarray(values.numpy(), dtype=np.float64)[:, transmitter]

    valid = np.asarray(paths.valid.numpy(), dtype=bool)[:, transmitter]
    kinds = np.asarray(paths.interactions.numpy())[:, :, transmitter]
    points = np.moveaxis(np.asarray(paths.vertices.numpy(), dtype=np.float64)[:, :, transmitter], 0, -2)
    sources, targets = (np.asarray(p.numpy(), dtype=np.float64).T for p in (paths.sources, paths.targets))
    names = ("tau", "theta_r", "phi_r", "theta_t", "phi_t")
    own = {name: field(getattr(paths, name)) for name in names}
    for r in range(len(a)):
        here = np.flatnonzero(valid[r])
        here = here[np.argsort(own["tau"][r, here], kind="stable")]
        # few have equal delays, and sorting by all keys takes long
        same = np.diff(own["tau"][r, here], prepend=-1.0, append=-1.0) == 0
        tied = np.flatnonzero(same[1:] | same[:-1])
        keys = [own[name][r, here[tied]] for name in names[::-1]]
        here[tied] = here[tied][np.lexsort(keys)]
        bounce = np.moveaxis(kinds[:, r, here], 0, -1)  # (L, depth)
        count = (bounce != 0).sum(axis=1)
        has = [(bounce == code).any(axis=1) for code in (SCATTER, EDGE, SLAB)]
        kind = np.select([count == 0, *has], ["los", "diffuse", "edge", "slab"], "mirror")
        turned = carrier_phase(carrier, own["tau"][r, here])
        jones = np.moveaxis(a[r][:, :, here], -1, 0) * turned[:, None, None]
        found = PathArrays(
            gain=np.sqrt(0.5 * (np.abs(jones) ** 2).sum(axis=(1, 2))) * turned,
            vertices=np.where((bounce != 0)[..., None], points[r, here], np.nan),
            interactions=bounce.astype(np.int8),
            kind=kind.astype("<U7"),
            valid=np.ones(len(here), dtype=bool),
            jones=jones,
            frequency_hz=carrier,
            transmitter=sources[transmitter],
            receiver=targets[r],
            **{name: values[r, here] for name, values in own.items()},
        )
        if drop_repeated:
            sharp = np.flatnonzero(found.kind != "diffuse")
            found = found.select(np.delete(np.arange(len(here)), sharp[repeated(found.select(sharp))]))
        yield found


def repeated(paths: PathArrays) -> np.ndarray:
    """Which of one receiver's specular paths repeat an earlier one, shape ``(L,)`` bool.

    Sionna tells mirrors apart by the rounded plane of the triangle met. Small triangles of one surface have planes that
    differ by rounding, and each is then taken for a mirror of its own: one reflection is counted several times.
    """
    bounces = np.isfinite(paths.vertices[..., 0]).sum(axis=1)
    # Sionna takes planes 1 cm apart for one
    same = (bounces[:, None] == bounces) & (np.abs(paths.length_m[:, None] - paths.length_m) < 5e-3)
    for direction in (paths.arrival, paths.departure):
        same &= np.linalg.norm(direction[:, None] - direction, axis=-1) < 1e-3
    return np.asarray(np.tril(same, -1).any(axis=1))


def _times(count: int, per_second: float) -> np.ndarray:
    """Times [s] of ``count`` steps."""
    every = check_positive("sampling_frequency", per_second)
    return np.arange(check_count("num_time_steps", count, most=1_000_000)) / every


def _normalised(h: np.ndarray, normalize: bool, *, mean: bool) -> np.ndarray:
    """``(R, M, N, T, F)`` as ``(R, M, 1, N, T, F)``; normalised over a link's mean energy, or its energy in all taps."""
    if normalize:
        energy = np.abs(h) ** 2
        energy = energy.mean(axis=-1) if mean else energy.sum(axis=-1)
        energy = energy.mean(axis=(1, 2, 3))[:, None, None, None, None]
        h = np.divide(h, np.sqrt(energy), out=np.zeros_like(h), where=energy > 0)
    return h[:, :, None]


def _as(values: np.ndarray, out_type: str) -> Any:
    if out_type == "numpy":
        return values
    if out_type == "torch":
        torch = require("torch", extra="baselines")
        return torch.from_numpy(values.astype(np.complex64 if np.iscomplexobj(values) else np.float32))
    raise ValueError(f"out_type: got {out_type!r}, expected 'numpy' or 'torch'")
