"""Radio fields: one way to fit, ask, save and load, whatever the model.

``bistatic`` obeys scattering physics (:mod:`warprrf.rf.bistatic`); ``rf3dgs+`` and ``rf3dgs`` hold spherical harmonics
per Gaussian as published (:mod:`warprrf.rf.harmonic`).
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from warprrf.rf import field_files

if TYPE_CHECKING:
    from warprrf.rf.dataset import SpectrumDataset
    from warprrf.rf.paths import Paths
    from warprrf.rf.spectrum import Spectrum

MODELS = ("bistatic", "rf3dgs+", "rf3dgs")


class RadioField(ABC):
    """A fitted radio field; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        report: how the fit went.
    """

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
        if model == "bistatic":
            from warprrf.rf.bistatic import BistaticField

            return BistaticField.fit(geometry, ds, **options)
        from warprrf.rf.harmonic import HarmonicField

        return HarmonicField.fit(geometry, ds, model, **options)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: Any = None) -> RadioField:
        """Read a field that :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or no radio field.
        """
        header = field_files.read(path)[1]
        if header.get("model") == "bistatic":
            from warprrf.rf.bistatic import BistaticField

            return BistaticField.load(path, device=device)
        from warprrf.rf.harmonic import HarmonicField

        return HarmonicField.load(path, device=device)

    @abstractmethod
    def spectrum(self, rx: Any, transmitter: Any = None) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m]."""

    @abstractmethod
    def paths(self, rx: Any, transmitter: Any = None, max_paths: int | None = None) -> Paths:
        """Propagation paths at ``rx`` (3,) or (R, 3) [m]."""

    @abstractmethod
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go."""
