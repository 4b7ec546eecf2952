"""Propagation paths, and what is computed from them: channels, dispersion, files.

The arrays are those of :class:`~warprrf.rf.channel.path_arrays.PathArrays`, which also explains angles and polarisation.

A file of paths is NetCDF-4 with the dimensions ``receiver``, ``path``, ``vertex`` and ``xyz``, complex numbers as two:
``gain_real`` and ``gain_imag`` (receiver, path) hold the gain at ``frequency_hz`` between isotropic antennas, its power
averaged over transmit and summed over receive polarisations; ``jones_real`` and ``jones_imag`` the Jones matrices,
where known.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import netcdf_files
from warprrf.checks import (
    Expected,
    check_array,
    check_arrays,
    check_known_whole,
    check_number,
    check_positive,
    checked,
    lengths,
    one_line,
)
from warprrf.netcdf_files import Variable
from warprrf.rf.channel import dispersion as dispersions
from warprrf.rf.channel import response
from warprrf.rf.channel.path_arrays import PADDING, PathArrays, turned
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import Hertz, carrier_phase
from warprrf.rf.paths import doppler, sionna
from warprrf.tensor_files import named


@checked
@dataclass(frozen=True)
class Paths(PathArrays):
    """Paths of one receiver, arrays ``(L,)``, or of several, arrays ``(R, L)`` padded where ``valid`` is False.

    ``gain`` (complex, exp(-j 2 pi f tau) included), ``tau`` [s], ``theta_r``, ``phi_r``, ``theta_t``, ``phi_t`` [rad],
    ``vertices`` [m], ``kind``, ``valid`` and, where known, ``jones``, ``frequency_hz``, ``transmitter``, ``receiver`` and
    ``air``: see :class:`~warprrf.rf.channel.path_arrays.PathArrays`.
    """

    __repr__ = one_line

    cir = response.impulse_response
    cfr = response.frequency_response
    taps = response.channel_taps
    diffuse_power = response.diffuse_power
    dispersion = dispersions.dispersion
    doppler_hz = doppler.doppler_hz

    def after(self, time_s: float, doppler_hz: ArrayLike) -> Paths:
        """The same paths ``time_s`` later, each turned by its Doppler shift: exp(j 2 pi f_D t).

        It holds while nothing has moved by more than a part of what changes the paths themselves, or their gains: trace anew for
        longer times.

        Args:
            time_s: [s].
            doppler_hz: shift of each path [Hz], as :meth:`doppler_hz` returns them; shape as ``tau``.

        Raises:
            ValueError: for another shape, or a path without a shift.
        """
        shift = check_array("doppler_hz", doppler_hz, self.tau.shape, finite=False)
        if not np.isfinite(shift[self.valid]).all():
            raise ValueError("doppler_hz: got NaN or infinite shifts, expected one for every path")
        turn = carrier_phase(-check_number("time_s", time_s), np.where(self.valid, shift, 0.0))
        return turned(self, turn)

    to_sionna = sionna.to_sionna

    @classmethod
    def from_sionna(
        cls, paths: Any, *, frequency_hz: Hertz, transmitter: int = 0, drop_repeated: bool = False
    ) -> Paths:
        """Paths that Sionna RT solved, with their Jones matrices, arrays ``(R, L)``, strongest path first.

        Sionna's arrays must be one isotropic element of polarisation "VH" at either end, unrotated: their four
        coefficients are the Jones matrix. The phase of ``gain`` is that of the delay alone.

        Args:
            paths: What a ``PathSolver`` returned, with ``synthetic_array=True`` as by default.
            frequency_hz: The scene's carrier [Hz].
            transmitter: Index of the transmitter.
            drop_repeated: Leave out specular paths that repeat another one: Sionna counts a mirror of many small
                triangles several times.

        Raises:
            ValueError: for other arrays.
        """
        found = sionna.from_sionna(paths, frequency_hz, transmitter, drop_repeated)
        return cls.stack([cls(**arrays) for arrays in found])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to a NetCDF-4 file, whole or not at all; see :mod:`warprrf.rf.paths.path_set`."""
        several = self.as_several()
        held = several.receiver, several.transmitter, several.frequency_hz, several.air
        ends, attributes = ends_and_attributes(*held)
        attributes["single_receiver"] = int(not self.batched)
        netcdf_files.write(path, arrays_of(several) | ends, PATH_VARIABLES, {}, attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Paths:
        """Read what :meth:`save` wrote.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged, or holds something else.
        """
        held, attributes = netcdf_files.read(path, PATH_VARIABLES, {})
        with named(path, "damaged, or no paths"):
            several = cls(**_fields_of(held, attributes))
            return several[0] if attributes["single_receiver"] else several


KINDS = ("", "los", "mirror", "diffuse", "slab", "edge")
"""What the values 0, 1, ... of the variable ``kind`` mean."""

_FORMAT = "warprrf paths 1"
_SEVERAL = ("receiver", "path")
_MATRIX = (*_SEVERAL, "receive", "transmit")
_UNITS = {
    "tau": ("s", "delay"),
    "theta_r": ("rad", "zenith of arrival"),
    "phi_r": ("rad", "azimuth of arrival"),
    "theta_t": ("rad", "zenith of departure"),
    "phi_t": ("rad", "azimuth of departure"),
}
_FLAGS = {
    "flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(("none", *KINDS[1:])),
}  # fmt: skip
_CODES = {
    "flag_values": np.array([0, 1, 2, 4, 8], np.int8),
    "flag_meanings": "none mirror scatter transmission diffraction",
}
PATH_VARIABLES = {
    "vertices": Variable(
        (*_SEVERAL, "vertex", "xyz"), "m", {"long_name": "interaction points from the transmitter on"}
    ),
    "kind": Variable(_SEVERAL, about=_FLAGS),
    "valid": Variable(_SEVERAL),
    "interactions": Variable((*_SEVERAL, "vertex"), about=_CODES, optional=True),
    **{name: Variable(_SEVERAL, unit, {"long_name": text}) for name, (unit, text) in _UNITS.items()},
    "gain_real": Variable(_SEVERAL, "1"),
    "gain_imag": Variable(_SEVERAL, "1"),
    "jones_real": Variable(_MATRIX, "1", optional=True),
    "jones_imag": Variable(_MATRIX, "1", optional=True),
    "receiver_position": Variable(("receiver", "xyz"), "m", optional=True),
    "transmitter_position": Variable(("xyz",), "m", optional=True),
    "transmitter_positions": Variable(("receiver", "xyz"), "m", optional=True),
}
_ARRAYS = {
    "gain_real": Expected("R L"),
    "gain_imag": Expected("R L"),
    "jones_real": Expected("R L 2 2", nan=True),
    "jones_imag": Expected("R L 2 2", nan=True),
    "vertices": Expected("R L D 3", nan=True),
    "kind": Expected("R L", 0, len(KINDS) - 1, kind="iu"),
    "valid": Expected("R L", 0, 1, kind="iu"),
    "interactions": Expected("R L D", 0, 8, kind="iu"),
    "tau": Expected("R L", 0.0, 1.0, nan=True),
    **{name: Expected("R L", -7.0, 7.0, nan=True) for name in list(_UNITS)[1:]},
    "receiver_position": lengths("R 3"),
    "transmitter_position": lengths("3"),
    "transmitter_positions": lengths("R 3"),
}
"""What the arrays in a file must be: R receivers, L paths, D interactions."""


def arrays_of(paths: PathArrays) -> dict[str, np.ndarray]:
    """Arrays of paths of several receivers as a file holds them."""
    codes = sum(k * (paths.kind == name) for k, name in enumerate(KINDS))
    arrays = {
        "vertices": paths.vertices,
        "kind": np.asarray(codes, dtype=np.int8),
        "valid": paths.valid.astype(np.int8),
        "interactions": paths.interactions,
        **{name: getattr(paths, name) for name in _UNITS},
    }
    for name, values in (("gain", paths.gain), ("jones", paths.jones)):
        if values is not None:
            arrays |= {f"{name}_real": values.real, f"{name}_imag": values.imag}
    return arrays


def ends_and_attributes(
    receiver: np.ndarray | None, transmitter: np.ndarray | None, frequency_hz: float | None, air: Air | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What a file holds of several receivers' paths besides :func:`arrays_of`."""
    several = "transmitter_position"
    if transmitter is not None and transmitter.ndim == 2:
        several = "transmitter_positions"
    ends = {"receiver_position": receiver, several: transmitter}
    attributes: dict[str, Any] = {"format": _FORMAT, "single_receiver": 0}
    if frequency_hz is not None:
        attributes["frequency_hz"] = frequency_hz
    known = {name: np.asarray(array) for name, array in ends.items() if array is not None}
    return known, attributes | ({} if air is None else air.attributes)


def _fields_of(held: dict[str, np.ndarray], attributes: dict[str, Any]) -> dict[str, Any]:
    """Paths of several receivers, by the names of their fields, from what a file holds; errors name the array."""
    if attributes.get("format") != _FORMAT:
        raise ValueError(f"it holds {attributes.get('format')!r}, expected {_FORMAT!r}")
    check_arrays(held, {name: wanted for name, wanted in _ARRAYS.items() if name in held})
    carrier = attributes.get("frequency_hz")
    there = {"jones_real", "jones_imag"} & held.keys()
    fields: dict[str, Any] = {
        "gain": held["gain_real"] + 1j * held["gain_imag"],
        "vertices": held["vertices"],
        "kind": np.array(KINDS, dtype="<U7")[held["kind"].astype(int)],
        "valid": held["valid"].astype(bool),
        "jones": held["jones_real"] + 1j * held["jones_imag"] if there else None,
        "frequency_hz": None if carrier is None else check_positive("frequency_hz", carrier),
        "transmitter": held.get("transmitter_position", held.get("transmitter_positions")),
        "receiver": held.get("receiver_position"),
        "air": Air.from_attributes(attributes),
        **{name: held[name] for name in (*_UNITS, "interactions") if name in held},
    }
    for name, empty in PADDING.items():
        if fields.get(name) is not None:
            fields[name][~fields["valid"]] = empty
    check_known_whole("vertices", fields["vertices"])
    for way, angles in (("arrival", ("theta_r", "phi_r")), ("departure", ("theta_t", "phi_t"))):
        check_known_whole(way, np.stack([fields[name] for name in angles], axis=-1))
    if there:
        check_known_whole("jones", fields["jones"], axes=2)
    return fields
