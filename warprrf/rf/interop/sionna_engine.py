"""Spectra from Sionna RT's PathSolver: line of sight, specular and diffuse paths of any depth, by ray sampling.

Both transmit and both receive polarisations are solved at once: path gain is the mean over the former and
the sum over the latter. One solve per receiver, because Sionna shares its cap on paths between all of them. Sionna has
no absorption by the air; where asked for, every path is given that of its own length.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import device as _device
from warprrf.checks import check_array, check_count, checked
from warprrf.device import DeviceLike
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT, check_frequency
from warprrf.rf.exact import ReceivedPaths
from warprrf.rf.paths.sionna import DIFFUSE, repeated
from warprrf.rf.scene import Scene
from warprrf.rf.scene_sionna import select_variant, sionna_rt
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, check_shape, directions_from_angles, spread_paths

# Dr.Jit keeps freed memory and compiled kernels; emptied every so many receivers.
_RECEIVERS_PER_FLUSH = 20


@checked
def load_sionna_scene(scene: Scene | str | os.PathLike[str], *, frequency_hz: float) -> Any:
    """Open a scene in Sionna RT with its table of materials, scattering patterns included.

    Sionna's own ``load_scene`` knows no patterns (every material is Lambertian) and takes what it can from the XML.

    Args:
        scene: Path of a scene file, or a :class:`Scene`.
        frequency_hz: Carrier frequency [Hz]; materials are those of this frequency.

    Returns:
        The ``sionna.rt.Scene``; see :meth:`Scene.to_sionna`.

    Raises:
        ImportError, ValueError: as :meth:`Scene.to_sionna`; for a path also what :meth:`Scene.load` raises.
    """
    if isinstance(scene, str | os.PathLike):
        scene = Scene.load(scene)
    return scene.to_sionna(frequency_hz=frequency_hz)


@dataclass(frozen=True)
class Sampling:
    """How Sionna RT looks for paths.

    Attributes:
        depth: Most bounces on a path.
        samples: Rays from the transmitter.
        refraction: Whether paths go through slabs.
        seed: Seed of the ray directions.
    """

    depth: int = 3
    samples: int = 1_000_000
    refraction: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("depth", self.depth, 0)
        check_count("samples", self.samples)
        check_count("seed", self.seed, 0)


class SionnaEngine:
    """Sionna RT for one transmitter.

    Args:
        scene: Scene with materials; its own transmitters and receivers play no part.
        transmitter: Position [m], shape ``(3,)``.
        frequency_hz: Carrier frequency [Hz].
        shape: Rows and columns of the spectrum.
        beam_sigma_rad: Receiver beam width [rad].
        sampling: How Sionna looks for paths.
        gas: Absorption of the air: see :meth:`Paths.with_gas`.
        device: Where beams are spread (Sionna takes its own: CUDA where there is a GPU).

    Raises:
        ImportError: if Sionna RT is missing, or only an LLVM that aborts it is installed.
        ValueError: as :meth:`Scene.to_sionna`.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        transmitter: ArrayLike,
        frequency_hz: float,
        shape: tuple[int, int],
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        sampling: Sampling | None = None,
        gas: Gas = False,
        device: DeviceLike = None,
    ) -> None:
        self.shape = check_shape(shape)
        self.beam_sigma_rad = beam_sigma_rad
        self.transmitter = check_array("transmitter", transmitter, (3,))
        self.frequency_hz = check_frequency(frequency_hz)
        self.sampling = Sampling() if sampling is None else sampling
        self.air = air_of(gas)
        self.device = device
        self._rt = sionna_rt()
        self._scene = load_sionna_scene(scene, frequency_hz=self.frequency_hz)
        for name in (*scene.transmitters, *scene.receivers):
            self._scene.remove(name)
        both = {"num_rows": 1, "num_cols": 1, "pattern": "iso", "polarization": "VH"}
        self._scene.tx_array = self._rt.PlanarArray(**both)
        self._scene.rx_array = self._rt.PlanarArray(**both)
        self._scene.add(self._rt.Transmitter("tx", position=self.transmitter.tolist()))
        self._solver = self._rt.PathSolver(deterministic=True)
        self._solved = 0

    def solve(self, receiver: ArrayLike, *, specular: bool = True) -> dict[str, np.ndarray]:
        """Paths of one receiver (3,): ``power``, ``jones`` (L,2,2) without the delay's phase, along zenith and azimuth unit
        vectors, ``tau``, ``arrival`` (L,3), ``aod`` (L,2), ``diffuse``, ``bounces``.

        They come by rising delay: one seed gives the same paths to the bit, in the same order, in every run.
        Without ``specular`` reflections every ray scatters, and at depth 1 Sionna's result hardly depends on chance.
        """
        point = check_array("receiver", receiver, (3,))
        select_variant()
        self._scene.add(self._rt.Receiver("rx", position=point.tolist()))
        try:
            paths = self._solver(
                self._scene,
                max_depth=self.sampling.depth,
                max_num_paths_per_src=self._path_cap,
                samples_per_src=self.sampling.samples,
                synthetic_array=True,
                los=True,
                specular_reflection=specular,
                diffuse_reflection=True,
                refraction=self.sampling.refraction,
                seed=self.sampling.seed,
            )
            found = self._read(paths)
        finally:
            self._scene.remove("rx")
        self._solved += 1
        if self._solved % _RECEIVERS_PER_FLUSH == 0:
            drjit = _device.require("drjit", extra="sionna")
            drjit.flush_malloc_cache()
            drjit.flush_kernel_cache()
        return found

    @property
    def _path_cap(self) -> int:
        """Sionna's default of 1e6 paths truncates silently; each sample can give one path a bounce."""
        return self.sampling.samples * max(self.sampling.depth, 1) + 100_000

    def _read(self, paths: Any) -> dict[str, np.ndarray]:
        """Sionna's arrays of one receiver and transmitter; both antennas are two polarisations at one place."""
        real, imag = (np.asarray(part.numpy(), dtype=np.float64) for part in paths.a)
        per_path = (real**2 + imag**2).reshape(4, real.shape[-1])  # 2 receive x 2 transmit polarisations
        valid = paths.valid.numpy().reshape(-1).astype(bool)  # no paths come as an array of numbers
        if len(valid) >= self._path_cap:
            raise RuntimeError(f"Sionna filled its cap of {self._path_cap} paths: power would be missing")
        kinds = paths.interactions.numpy().reshape(-1, len(valid)) if len(valid) else np.zeros((1, 0), int)

        def field(values: Any) -> np.ndarray:
            return np.asarray(values.numpy(), dtype=np.float64).reshape(-1)[valid]

        found = {
            "power": per_path.sum(axis=0)[valid] / 2.0,
            "jones": (real + 1j * imag).reshape(2, 2, -1).transpose(2, 0, 1)[valid],
            "tau": field(paths.tau),
            "arrival": directions_from_angles(field(paths.theta_r), field(paths.phi_r)),
            "aod": np.column_stack([field(paths.theta_t), field(paths.phi_t)]),
            "diffuse": (kinds == DIFFUSE).any(axis=0)[valid],
            "bounces": (kinds != 0).sum(axis=0)[valid],
        }
        # Sionna stores paths as its threads end; few have equal delays, and sorting by all keys takes long
        order = np.argsort(found["tau"], kind="stable")
        same = np.diff(found["tau"][order], prepend=-1.0, append=-1.0) == 0
        tied = np.flatnonzero(same[1:] | same[:-1])
        keys = [found[name][order[tied]].T for name in ("aod", "arrival", "power", "tau")]
        order[tied] = order[tied][np.lexsort(np.vstack(keys))]
        sharp = np.flatnonzero(~found["diffuse"][order])
        keys = [found[name][order[sharp]] for name in ("tau", "arrival", "aod", "bounces")]
        order = np.delete(order, sharp[repeated(*keys)])
        found = {name: values[order] for name, values in found.items()}
        if self.air is not None:
            through = self.air.transmittance(self.frequency_hz, SPEED_OF_LIGHT * found["tau"])
            found["power"] *= through
            found["jones"] *= np.sqrt(through)[:, None, None]
        return found

    def receive(self, receiver: ArrayLike) -> ReceivedPaths:
        """The spectrum of one receiver (3,)."""
        found = self.solve(receiver)
        beam = self.shape, self.beam_sigma_rad
        spread = spread_paths(found["arrival"], found["power"], *beam, device=self.device)
        return ReceivedPaths(
            path_gain=spread.path_gain,
            delay_s=spread.of_strongest(found["tau"]),
            aod=spread.of_strongest(found["aod"]),
            line_of_sight=bool((found["bounces"] == 0).any()),
        )
