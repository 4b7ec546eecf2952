"""Spectra from Sionna RT's PathSolver: line of sight, specular and diffuse paths of any depth, by ray sampling.

Both transmit and both receive polarisations are solved at once: path gain is the mean over the former and
the sum over the latter. One solve per receiver, because Sionna shares its cap on paths between all of them. Sionna has
no absorption by the air; where asked for, every path is given that of its own length.
"""

from __future__ import annotations

import os
from copy import copy
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Count, Seed, check_array, checked, whole
from warprrf.device import DeviceLike, require
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.waves import check_frequency
from warprrf.rf.paths.sionna import by_delay
from warprrf.rf.scene import Scene
from warprrf.rf.scene_sionna import select_variant, sionna_rt
from warprrf.rf.spectra.dataset import Received
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, check_shape


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


@checked
@dataclass(frozen=True)
class Sampling:
    """How Sionna RT looks for paths.

    Attributes:
        depth: Most bounces on a path.
        samples: Rays from the transmitter.
        refraction: Whether paths go through slabs.
        seed: Seed of the ray directions.
    """

    depth: Annotated[int, whole(0)] = 3
    samples: Count = 1_000_000
    refraction: bool = False
    seed: Seed = 0


class SionnaEngine:
    """Sionna RT for one transmitter.

    Args:
        scene: Scene with materials; its own transmitters and receivers play no part.
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
        # Sionna's single precision needs an origin near by.
        self._origin = 1e3 * np.rint(scene.bounds.mean(axis=0) / 1e3)
        scene = copy(scene)
        scene.mesh = scene.mesh.transformed(shift=-self._origin)
        self._scene = load_sionna_scene(scene, frequency_hz=self.frequency_hz)
        for name in (*scene.transmitters, *scene.receivers):
            self._scene.remove(name)
        both = {"num_rows": 1, "num_cols": 1, "pattern": "iso", "polarization": "VH"}
        self._scene.tx_array = self._rt.PlanarArray(**both)
        self._scene.rx_array = self._rt.PlanarArray(**both)
        place = (self.transmitter - self._origin).tolist()
        self._scene.add(self._rt.Transmitter("warprrf-tx", position=place))
        self._solver = self._rt.PathSolver(deterministic=True)
        # Sionna's default of 1e6 paths truncates silently; each sample can give one path a bounce.
        self._most = self.sampling.samples * max(self.sampling.depth, 1) + 100_000
        self._solved = 0

    def solve(self, receiver: ArrayLike, *, specular: bool = True) -> PathArrays:
        """Paths of one receiver (3,), by rising delay.

        One seed gives the same paths to the bit, in the same order, in every run.
        Without ``specular`` reflections every ray scatters, and at depth 1 Sionna's result hardly depends on chance.
        """
        point = check_array("receiver", receiver, (3,))
        select_variant()
        self._scene.add(self._rt.Receiver("warprrf-rx", position=(point - self._origin).tolist()))
        try:
            paths = self._solver(
                self._scene,
                max_depth=self.sampling.depth,
                max_num_paths_per_src=self._most,
                samples_per_src=self.sampling.samples,
                synthetic_array=True,
                los=True,
                specular_reflection=specular,
                diffuse_reflection=True,
                refraction=self.sampling.refraction,
                seed=self.sampling.seed,
            )
            if paths.valid.numpy().size >= self._most:
                raise RuntimeError(f"Sionna filled its cap of {self._most} paths: power would be missing")
            (found,) = by_delay(paths, self.frequency_hz, 0, True)
        finally:
            self._scene.remove("warprrf-rx")
        self._solved += 1
        if self._solved % 20 == 0:  # Dr.Jit keeps freed memory and compiled kernels
            drjit = require("drjit", extra="sionna")
            drjit.flush_malloc_cache()
            drjit.flush_kernel_cache()
        found = replace(found, transmitter=self.transmitter, receiver=point)
        return replace(found, vertices=found.vertices + self._origin).with_gas(self.air)

    def receive(self, receiver: ArrayLike) -> Received:
        """The spectrum of one receiver (3,)."""
        return Received.of(self.solve(receiver), self.shape, self.beam_sigma_rad, self.device)
