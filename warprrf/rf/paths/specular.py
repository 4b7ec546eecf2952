"""Line of sight, mirror paths and paths through slabs as a function: what each meets is held fixed, all else may vary.

Gains, Jones matrices, delays, angles and vertices of :func:`~warprrf.trace_paths` come from the kernel that is here
(:mod:`warprrf.kernels.radio.specular`), and their derivatives from its adjoint, on Warp's tape or in torch. Which paths there
are, what they meet and what blocks them is traced once and not differentiated: of a total or a spectrum over positions much is
edges of shadows, which no derivative at fixed visibility knows. Totals and spectra by positions are given by differences of
what is traced anew: :func:`~warprrf.paths.retraced_slope` and :meth:`RadioField.slope`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warprrf.checks import LARGEST, LARGEST_M, check_array
from warprrf.device import DeviceLike, filled, launch, require, resolve
from warprrf.kernels.radio import specular as kernels
from warprrf.rf.em.fresnel import SurfaceTable
from warprrf.rf.em.materials import ROUGHEST_M, VACUUM_PERMITTIVITY
from warprrf.rf.paths.mirror_paths import MirrorPaths

POSITIONS = ("transmitter", "receivers", "transmitter_orientation", "receiver_orientation")
MATERIALS = ("relative_permittivity", "conductivity", "thickness_m", "roughness_m", "scattering")
TYPES = {name: wp.vec3d if name in POSITIONS else wp.float64 for name in POSITIONS + MATERIALS}
RANGES = {
    **dict.fromkeys(POSITIONS, (-LARGEST_M, LARGEST_M)), "relative_permittivity": (1.0, LARGEST), "conductivity": (0.0, LARGEST),
    "thickness_m": (1e-9, np.inf), "roughness_m": (0.0, ROUGHEST_M), "scattering": (0.0, 1.0),
}  # fmt: skip
"""What parameters may be, as far as it is looked at."""


@dataclass(frozen=True, eq=False)
class PathValues:
    """What arrives over L paths: arrays of NumPy, of Warp or of torch, as what was given.

    Attributes:
        gain: complex gain between isotropic antennas, exp(-j 2 pi f tau) included, shape ``(L,)``; see :class:`Paths`.
        jones: polarised complex gain ``(L, 2, 2)``, received over transmitted, along the zenith and azimuth unit vectors of each
            antenna's own axes. Of a bare mesh, which says nothing of polarisation, that of mirrors without a sign.
        tau: delay [s], shape ``(L,)``.
        theta_r, phi_r: zenith and azimuth of arrival in the receiving antenna's axes [rad], shape ``(L,)``.
        theta_t, phi_t: of departure in the transmitting antenna's [rad], shape ``(L,)``.
        vertices: interaction points from the transmitter on [m], shape ``(L, depth, 3)``; NaN past the last.

    Warp's complex numbers are ``vec2d`` (real, imaginary) and its points ``vec3d``.
    """

    gain: Any
    jones: Any
    tau: Any
    theta_r: Any
    phi_r: Any
    theta_t: Any
    phi_t: Any
    vertices: Any


OUTPUTS = tuple(f.name for f in fields(PathValues))


class SpecularPaths:
    """Paths whose mirrors and slabs are held fixed, L of them; :func:`~warprrf.paths.trace_specular` makes them.

    Attributes:
        receiver: index of the receiver of each path, shape ``(L,)``. Rows come in the order of :func:`~warprrf.trace_paths`:
            of several receivers they are its ``paths.gain[paths.valid]``.
        frequency_hz: carrier [Hz].
        device: where paths are computed.
    """

    def __init__(
        self,
        found: MirrorPaths,
        offset: np.ndarray,
        material: np.ndarray,
        traced: Mapping[str, wp.array],
        frequency_hz: float,
        device: DeviceLike,
    ) -> None:
        self.receiver, self.frequency_hz, self.device = found.receiver, frequency_hz, resolve(device)
        self._made_of = found, offset, material
        self._traced, self._shape = {name: traced[name] for name in TYPES}, found.patch.shape
        mirrors = found.patch >= 0
        self._there = mirrors | (found.slab >= 0)
        self._sequences = filled(
            kernels.Sequences,
            self.device,
            frequency_hz=frequency_hz,
            receiver=found.receiver,
            count=self._there.sum(axis=1),
            mirrors=mirrors,
            normal=found.normal,
            plane_offset=offset,
            material=material,
            solid_m=found.thickness_m,
        )

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """What :meth:`evaluate` takes, with the values that were traced, by name.

        ``transmitter`` [m] ``(1, 3)``, ``receivers`` [m] ``(R, 3)``, ``transmitter_orientation`` and ``receiver_orientation``
        [rad] ``(1, 3)``; of the scene's M materials at the carrier ``relative_permittivity``, ``conductivity`` [S/m],
        ``thickness_m`` [m], ``roughness_m`` [m] and ``scattering``, each ``(M,)``. Where scattering comes from the roughness
        ``scattering`` is 0, and the other way round. A solid is as thick as it was where it was traced.
        """
        return {name: array.numpy().copy() for name, array in self._traced.items()}

    def __len__(self) -> int:
        return self._shape[0]

    def __repr__(self) -> str:
        receivers = self._traced["receivers"].shape[0]
        return f"SpecularPaths({len(self)} to {receivers} receivers at {self.frequency_hz / 1e9:g} GHz)"

    def __reduce__(self) -> tuple[Any, ...]:
        return SpecularPaths, (*self._made_of, self._traced, self.frequency_hz, str(self.device))

    def evaluate(
        self,
        *,
        transmitter: Any = None,
        receivers: Any = None,
        transmitter_orientation: Any = None,
        receiver_orientation: Any = None,
        relative_permittivity: Any = None,
        conductivity: Any = None,
        thickness_m: Any = None,
        roughness_m: Any = None,
        scattering: Any = None,
    ) -> PathValues:
        """What arrives, with what is given in place of what was traced (:attr:`parameters`).

        Of arrays of NumPy, or none: arrays of NumPy. Of arrays of Warp, float64 or ``vec3d``: Warp's, recorded on the tape that
        runs. Of torch's tensors: tensors that autograd differentiates once (``pip install "warprrf[baselines]"``). Both on
        :attr:`device`.

        Args:
            transmitter: position [m], ``(3,)`` or ``(1, 3)``.
            receivers: positions [m], ``(R, 3)``; of one also ``(3,)``.
            transmitter_orientation: yaw, pitch and roll of the antenna [rad], ``(3,)`` or ``(1, 3)``.
            receiver_orientation: the same of all receivers, or of each, ``(R, 3)``.
            relative_permittivity, conductivity, thickness_m, roughness_m, scattering: of each material of the scene, ``(M,)``.

        Raises:
            TypeError: for arrays of Warp and of torch at once.
            ValueError: naming the argument, for another shape, number type or device, and, of NumPy's arrays and of tensors,
                for numbers that no antenna or material has.

        Example::

            held = wr.paths.trace_specular(scene, transmitter=tx, receivers=rx, frequency_hz=60e9, mirror_order=2)
            at = torch.tensor(rx, dtype=torch.float64, requires_grad=True)
            held.evaluate(receivers=at).gain.abs().square().sum().backward()
            at.grad  # of the summed power [1/m], shape as rx
        """
        every = locals()
        given = {name: every[name] for name in (*POSITIONS, *MATERIALS) if every[name] is not None}
        kinds = {name: type(value).__module__.split(".")[0] for name, value in given.items()}
        if {"torch", "warp"} <= set(kinds.values()):
            raise TypeError(f"{', '.join(kinds)}: got arrays of Warp and of torch, expected those of one")
        if "torch" in kinds.values():
            require("torch", extra="baselines")
            from warprrf.rf.paths.torch_functions import evaluate

            for name, value in given.items():
                self._checked(name, value)
            return PathValues(*evaluate(partial(self._launch, taped=True), given, TYPES, self.device))
        taped = "warp" in kinds.values()
        arrays = {
            name: self._as_given(name, value) if kinds[name] == "warp" else self._uploaded(name, value)
            for name, value in given.items()
        }
        values = PathValues(*self._launch(arrays, taped))
        return values if taped else self._of_numpy(values, given)

    def _of_numpy(self, values: PathValues, given: Mapping[str, Any]) -> PathValues:
        arrays = {name: getattr(values, name).numpy() for name in OUTPUTS}
        for name in ("gain", "jones"):
            arrays[name] = np.ascontiguousarray(arrays[name]).view(np.complex128)[..., 0]
        met = np.isfinite(arrays["vertices"]).all(axis=-1)
        lost = (met != self._there).any(axis=1) | ~np.isfinite(arrays["tau"])
        if lost.any():
            raise ValueError(
                f"{' or '.join(name for name in given if name in POSITIONS[:2])}: got places that {int(lost.sum())} of "
                f"{len(self)} paths do not reach over what they met, expected ones near those that were traced"
            )
        return PathValues(**arrays)

    def _checked(self, name: str, value: Any) -> np.ndarray:
        """A parameter in its own shape; ValueError for another, or numbers that it cannot be."""
        array = check_array(name, value, finite=name != "thickness_m")
        array = array[None] if name in POSITIONS and array.ndim == 1 else array
        self._check_shape(name, array.shape)
        low, high = RANGES[name]
        if array.size and not (array.min() >= low and array.max() <= high):
            raise ValueError(f"{name}: got {array.min():g} to {array.max():g}, expected {low:g} to {high:g}")
        return array

    def _check_shape(self, name: str, shape: tuple[int, ...]) -> None:
        like = [self._traced[name], *([self._traced["receivers"]] if name == "receiver_orientation" else [])]
        wanted = [(*a.shape, 3) if a.dtype is wp.vec3d else a.shape for a in like]
        if tuple(shape) not in wanted:
            told = " or ".join(map(str, dict.fromkeys(wanted)))
            raise ValueError(f"{name}: got shape {tuple(shape)}, expected {told}")

    def _uploaded(self, name: str, value: Any) -> wp.array:
        return wp.array(self._checked(name, value), dtype=TYPES[name], device=self.device)

    def _as_given(self, name: str, value: Any) -> wp.array:
        """A Warp array, which is differentiated."""
        dtype = TYPES[name]
        if not isinstance(value, wp.array) or value.dtype != dtype or value.device != self.device:
            raise ValueError(
                f"{name}: got {value!r:.60}, expected a Warp array of {dtype.__name__} on {self.device}"
            )
        self._check_shape(name, (*value.shape, 3) if dtype is wp.vec3d else value.shape)
        return value

    def _launch(self, given: Mapping[str, wp.array], taped: bool) -> list[wp.array]:
        """Answers, as :class:`PathValues` has them, of parameters some of which are ``given``: recorded on the tape that runs if
        ``taped``, else on all cores."""
        (count, depth), inputs = self._shape, [given.get(name, array) for name, array in self._traced.items()]
        shapes = [
            ((count, depth + 1, kernels.STATE), wp.vec3d),
            (count, wp.vec2d),
            ((count, 2, 2), wp.vec2d),
            *[(count, wp.float64)] * 5,
            ((count, depth), wp.vec3d),
        ]
        arrays = [wp.empty(shape, dtype=d, device=self.device, requires_grad=taped) for shape, d in shapes]
        if taped:
            wp.launch(kernels.follow_paths, count, [0, self._sequences, *inputs, *arrays], device=self.device)
        else:
            launch(
                kernels.follow_paths, count, [self._sequences, *inputs, *arrays], device=self.device, grain=64
            )
        return arrays[1:]


def fixed_parameters(
    materials: Any, table: SurfaceTable | None, frequency_hz: float, device: wp.Device
) -> dict[str, wp.array]:
    """Parameters that hang on no place: materials' properties, of which a bare mesh has none, and antennas as they stand."""
    found = dict.fromkeys(MATERIALS, np.zeros(0))
    if table is not None:
        rough = np.array([m.roughness_m if getattr(m, "scattering", 0.0) is None else 0.0 for m in materials])
        found = {
            "relative_permittivity": table.permittivity.real,
            "conductivity": -table.permittivity.imag * (2.0 * np.pi * frequency_hz * VACUUM_PERMITTIVITY),
            "thickness_m": table.thickness_m,
            "roughness_m": rough,
            "scattering": np.where(rough > 0.0, 0.0, table.scattering),
        }
    found |= dict.fromkeys(POSITIONS[2:], np.zeros((1, 3)))
    return {name: wp.array(array, dtype=TYPES[name], device=device) for name, array in found.items()}
