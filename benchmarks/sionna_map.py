"""Sionna RT's own radio map, which ours is compared with."""

from __future__ import annotations

from typing import Any

import numpy as np

from warprrf.checks import check_array
from warprrf.rf.em.waves import check_frequency
from warprrf.rf.interop.sionna_engine import load_sionna_scene
from warprrf.rf.scene_sionna import select_variant, sionna_rt


class SionnaMap:
    """Sionna RT's RadioMapSolver for one transmitter on a horizontal grid of square cells.

    Path gain is averaged over each cell by Sionna, and over vertical and horizontal transmit polarisation by us; its
    receiver is isotropic and takes every polarisation.

    Args:
        scene: Scene loaded from an XML file.
        transmitter: Position [m], shape ``(3,)``.
        frequency_hz: Carrier frequency [Hz].
        x: Centres of the cells [m], evenly spaced, shape ``(X,)``, at least two.
        y: The same, shape ``(Y,)``, at the same spacing.
        height_m: Of the plane.
        depth: Most bounces on a path: specular and diffuse ones, without refraction.

    Raises:
        ImportError: if Sionna RT is missing, or only an LLVM that aborts it is installed.
        ValueError: if the scene was not loaded from a file, or the cells are not square.
    """

    def __init__(
        self,
        scene: Any,
        *,
        transmitter: Any,
        frequency_hz: float,
        x: Any,
        y: Any,
        height_m: float,
        depth: int = 3,
    ) -> None:
        columns, rows = check_array("x", x, (None,)), check_array("y", y, (None,))
        steps = np.concatenate([np.diff(columns), np.diff(rows)])
        if len(columns) < 2 or not (steps[0] > 0 and np.allclose(steps, steps[0], rtol=1e-6)):
            raise ValueError(
                f"x, y: got steps of {np.unique(steps.round(6)).tolist()} m, expected square cells"
            )
        self.shape, self.depth = (len(rows), len(columns)), depth
        self._cell = float(steps[0])
        self._middle = [0.5 * (columns[0] + columns[-1]), 0.5 * (rows[0] + rows[-1]), height_m]
        self._rt = sionna_rt()
        self._scene = load_sionna_scene(scene, frequency_hz=check_frequency(frequency_hz))
        self._solver = self._rt.RadioMapSolver()
        self._scene.rx_array = self._array("V")
        place = check_array("transmitter", transmitter, (3,))
        self._scene.add(self._rt.Transmitter("tx", position=place.tolist()))

    def _array(self, polarisation: str) -> Any:
        return self._rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=polarisation)

    def __call__(self, samples: int, *, seed: int) -> np.ndarray:
        """Mean path gain of every cell [linear], shape ``(Y, X)``; half of ``samples`` in each polarisation."""
        mitsuba = select_variant()
        rows, columns = self.shape
        total = np.zeros(self.shape)
        for k, polarisation in enumerate("VH"):
            self._scene.tx_array = self._array(polarisation)
            solved = self._solver(
                self._scene,
                center=mitsuba.Point3f(*(float(v) for v in self._middle)),
                orientation=mitsuba.Point3f(0.0),
                # a little less, since Sionna rounds up to whole cells
                size=mitsuba.Point2f((columns - 1e-3) * self._cell, (rows - 1e-3) * self._cell),
                cell_size=mitsuba.Point2f(self._cell, self._cell),
                samples_per_tx=max(samples // 2, 1),
                max_depth=self.depth,
                diffuse_reflection=True,
                refraction=False,
                seed=2 * seed + k,
            )
            total += 0.5 * np.asarray(solved.path_gain.numpy(), np.float64)[0]
        return total
