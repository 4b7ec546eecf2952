"""Radio fields: one way to fit, ask, save and load, whatever the model.

``bistatic`` obeys scattering physics (:mod:`warprrf.rf.fields.bistatic`); ``rf3dgs+`` and ``rf3dgs`` hold spherical harmonics
per Gaussian as published (:mod:`warprrf.rf.fields.harmonic`). A model's package is loaded when its name is first asked for.
"""

from __future__ import annotations

import importlib
import os
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.rf.fields import files as field_files
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD

if TYPE_CHECKING:
    from typing import Self

    from warprrf.rf.em.absorption import Air
    from warprrf.rf.maps.links import Links
    from warprrf.rf.maps.radio_map import RadioMap
    from warprrf.rf.paths.trace import Paths
    from warprrf.rf.spectra.dataset import SpectrumDataset
    from warprrf.rf.spectra.spectrum import Spectrum

_HOMES = {
    "bistatic": ("bistatic.field", "BistaticField"),
    "rf3dgs+": ("harmonic.field", "HarmonicField"),
    "rf3dgs": ("harmonic.field", "HarmonicField"),
}
MODELS = tuple(_HOMES)


class RadioField(ABC):
    """A fitted radio field; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        transmitter: position it was fitted for [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        shape: rows and columns of its spectra.
        mesh: what blocks; None if the geometry has no mesh.
        air: absorption in its path gains, that of the data set it was fitted to; None for none.
        device: where it computes.
        report: how the fit went.
    """

    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    mesh: Mesh | None
    air: Air | None
    device: Any
    report: dict[str, Any]

    @property
    @abstractmethod
    def model(self) -> str:
        """Name of the model."""

    @classmethod
    def fit(cls, geometry: Any, ds: SpectrumDataset, model: str = "bistatic", **options: Any) -> RadioField:
        """Fit a radio field to the spectra of ``ds``.

        Args:
            geometry: a Reconstruction (anything with ``.gaussians`` and ``.mesh``), a Scene or a Mesh.
            ds: training set.
            model: ``"bistatic"``, ``"rf3dgs+"`` or ``"rf3dgs"``.
            options: of the model: see :meth:`BistaticField.fit` and :meth:`HarmonicField.fit`.

        Raises:
            ValueError, TypeError: for an unknown model or bad arguments.
        """
        if model not in MODELS:
            raise ValueError(f"model: got {model!r}, expected one of {', '.join(MODELS)}")
        chosen = {} if model == "bistatic" else {"model": model}
        return _class_of(model).fit(geometry, ds, **chosen, **options)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: Any = None) -> RadioField:
        """Read a field that :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or no radio field.
        """
        header = field_files.read(path)[1]
        model = "bistatic" if header.get("model") == "bistatic" else "rf3dgs+"  # which reads rf3dgs too
        return _class_of(model).load(path, device=device)

    @abstractmethod
    def with_gas(self, gas: Any = True) -> Self:
        """The same field with the absorption of ``gas`` over every path's length, in place of what it had.

        Args:
            gas: False for none, True for the standard atmosphere, :class:`Air`, or a :class:`Relevance`, which says
                whether the absorption is worth its tolerance.

        Raises:
            ValueError: for a carrier outside ITU-R P.676; for an ``rf3dgs`` field, which has no lengths.
        """

    @abstractmethod
    def spectrum(self, rx: Any, transmitter: Any = None) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m]."""

    @abstractmethod
    def paths(self, rx: Any, transmitter: Any = None, max_paths: int | None = None) -> Paths:
        """Propagation paths at ``rx`` (3,) or (R, 3) [m]."""

    def links(
        self,
        rx: Any,
        transmitter: Any = None,
        *,
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        shape: tuple[int, int] | None = None,
        mirror_order: int | None = None,
        progress: Progress | None = None,
    ) -> Links:
        """Total and best path gain, delay spread and best-beam gain at ``rx`` (R, 3) [m], without spectra.

        A ``bistatic`` field traces several receivers at once on a coarser grid of rays, for a small part of a
        spectrum's time; other models take their paths one receiver at a time.

        Args:
            rx: receiver positions.
            transmitter: as for :meth:`spectrum`.
            beam_sigma_rad: width of the receiver's beam: kappa = 1 / sigma^2.
            shape: rows and columns of the grid that rays fill; 20 x 40 by default, the field's own for other models.
            mirror_order: most reflections on a mirror path of a ``bistatic`` field, if fewer than it was fitted with:
                chains of three mirrors take most of the time and carry little.
            progress: called as ``progress("links", done, total)``.

        Raises:
            ValueError: as for :meth:`spectrum`, and for a beam width that is not positive.
        """
        from warprrf.rf.maps.tracing import find_links

        return find_links(self, rx, transmitter, beam_sigma_rad, shape, mirror_order, progress)

    def radio_map(
        self, height: float, cell: float = 0.25, transmitter: Any = None, **options: Any
    ) -> RadioMap:
        """Links over a floor plan, at ``height`` [m] in cells of ``cell`` [m]; see
        :func:`warprrf.rf.maps.radio_map.radio_map`."""
        from warprrf.rf.maps.radio_map import radio_map

        return radio_map(self, height, cell, transmitter, **options)

    @abstractmethod
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go."""


def _class_of(model: str) -> type[RadioField]:
    """The class that fits and reads ``model``."""
    module, name = _HOMES[model]
    found: type[RadioField] = getattr(importlib.import_module(f"warprrf.rf.fields.{module}"), name)
    return found
