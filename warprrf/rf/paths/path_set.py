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
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import netcdf_files
from warprrf.checks import Expected, check_known_whole, check_positive, checked, lengths, one_line, within
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

    def after(self, time_s: Annotated[float, within()], doppler_hz: ArrayLike) -> Paths:
        """The same paths ``time_s`` later, each turned by its Doppler shift: exp(j 2 pi f_D t).

        It holds while nothing has moved by more than a part of what changes the paths themselves, or their gains: trace anew for
        longer times.

        Args:
            time_s: [s].
            doppler_hz: shift of each path [Hz], as :meth:`doppler_hz` returns them; shape as ``tau``.

        Raises:
            ValueError: for another shape, or a path without a shift.
        """
        return turned(self, carrier_phase(-time_s, sionna.check_shifts(self, doppler_hz)))

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
            ValueError: for other arrays, or a transmitter that there is not.
        """
        several = sionna.by_delay(paths, frequency_hz, transmitter, drop_repeated)
        found = [p.select(np.argsort(-np.abs(p.gain), kind="stable")) for p in several]
        return cls.stack([cls(**vars(p)) for p in found])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to a NetCDF-4 file, whole or not at all; see :mod:`warprrf.rf.paths.path_set`."""
        several = self.as_several()
        attributes = attributes_of(self.frequency_hz, self.air) | {"single_receiver": int(not self.batched)}
        arrays = netcdf_files.encoded(vars(several), PATH_VARIABLES)
        netcdf_files.write(path, arrays, PATH_VARIABLES, {}, attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Paths:
        """Read what :meth:`save` wrote.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged, or holds something else.
        """
        held, attributes = netcdf_files.read(path, PATH_VARIABLES, {}, _FORMAT)
        with named(path, "damaged, or no paths"):
            several = cls(**_fields_of(netcdf_files.decoded(held, PATH_VARIABLES), attributes))
            return several[0] if attributes["single_receiver"] else several


KINDS = ("", "los", "mirror", "diffuse", "slab", "edge")
"""What the values 0, 1, ... of the variable ``kind`` mean."""

_FORMAT = "warprrf paths 1"
_FLAGS = {
    "flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(("none", *KINDS[1:])),
}  # fmt: skip
_CODES = {
    "flag_values": np.array([0, 1, 2, 4, 8], np.int8),
    "flag_meanings": "none mirror scatter transmission diffraction",
}
_POINTS = {"long_name": "interaction points from the transmitter on"}


def _path(unit: str, text: str, least: float, most: float) -> Variable:
    """One number of each path, NaN where it is not known."""
    return Variable(
        ("receiver", "path"), unit, {"long_name": text}, expected=Expected("R L", least, most, nan=True)
    )


def _part(field: str, *axes: str, optional: bool = False) -> Variable:
    """The real or the imaginary part of complex numbers of each path."""
    limits = Expected("R L" + " 2" * len(axes), nan=optional)
    return Variable(
        ("receiver", "path", *axes), "1", optional=optional, field=field, is_part=True, expected=limits
    )


def _place(field: str, shape: str, *axes: str) -> Variable:
    """Where the ends are, if that is known."""
    return Variable((*axes, "xyz"), "m", optional=True, field=field, expected=lengths(shape))


_DIRECTIONS = {
    "theta_r": "zenith of arrival",
    "phi_r": "azimuth of arrival",
    "theta_t": "zenith of departure",
    "phi_t": "azimuth of departure",
}
PATH_VARIABLES = {
    "vertices": Variable(
        ("receiver", "path", "vertex", "xyz"), "m", _POINTS, expected=Expected("R L D 3", nan=True)
    ),
    "kind": Variable(("receiver", "path"), about=_FLAGS, codes=KINDS),
    "valid": Variable(("receiver", "path"), codes=(False, True)),
    "interactions": Variable(
        ("receiver", "path", "vertex"),
        about=_CODES,
        optional=True,
        expected=Expected("R L D", 0, 8, kind="iu"),
    ),
    "tau": _path("s", "delay", 0.0, 1.0),
    **{name: _path("rad", text, -7.0, 7.0) for name, text in _DIRECTIONS.items()},
    **{f"gain_{part}": _part("gain") for part in ("real", "imag")},
    **{f"jones_{part}": _part("jones", "receive", "transmit", optional=True) for part in ("real", "imag")},
    "receiver_position": _place("receiver", "R 3", "receiver"),
    "transmitter_position": _place("transmitter", "3"),
    "transmitter_positions": _place("transmitter", "R 3", "receiver"),
}
"""What a file of paths holds: R receivers, L paths, D interactions."""


def attributes_of(frequency_hz: float | None, air: Air | None) -> dict[str, Any]:
    """Attributes of a file of paths."""
    known: dict[str, Any] = {} if frequency_hz is None else {"frequency_hz": frequency_hz}
    return {"format": _FORMAT, "single_receiver": 0} | known | ({} if air is None else air.attributes)


def _fields_of(fields: dict[str, Any], attributes: dict[str, Any]) -> dict[str, Any]:
    """Paths of several receivers, by the names of their fields, from what a file holds; errors name the array."""
    carrier = attributes.get("frequency_hz")
    fields["frequency_hz"] = None if carrier is None else check_positive("frequency_hz", carrier)
    fields["air"] = Air.from_attributes(attributes)
    source: Any = fields.get("transmitter")
    if np.ndim(source) == 2 and len(np.unique(source, axis=0)) == 1:  # stores have it in every row
        fields["transmitter"] = source[0]
    for name in PADDING.keys() & fields.keys():
        fields[name][~fields["valid"]] = PADDING[name]
    check_known_whole("vertices", fields["vertices"])
    for way, angles in (("arrival", ("theta_r", "phi_r")), ("departure", ("theta_t", "phi_t"))):
        check_known_whole(way, np.stack([fields[name] for name in angles], axis=-1))
    if "jones" in fields:
        check_known_whole("jones", fields["jones"], axes=2)
    return fields
