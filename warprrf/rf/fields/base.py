"""Radio fields: one way to fit, ask, save and load, whatever the model.

``bistatic`` obeys scattering physics (:mod:`warprrf.rf.fields.bistatic`); ``rf3dgs+`` and ``rf3dgs`` hold spherical harmonics
per Gaussian as published (:mod:`warprrf.rf.fields.harmonic`).
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from warprrf import tensor_files
from warprrf.checks import LARGEST_M, check_array, check_number, check_positive, check_type, checked
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, Mesh
from warprrf.rf.em.absorption import Air, Gas
from warprrf.rf.em.waves import CARRIERS_HZ, SPEED_OF_LIGHT
from warprrf.rf.fields.data import Data
from warprrf.rf.maps.links import BeamSearch, LinkOptions, Links, links_of
from warprrf.rf.maps.radio_map import MapOptions, RadioMap, radio_map
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.positions import check_positions, check_receivers
from warprrf.rf.spectra.antenna import Pattern
from warprrf.rf.spectra.dataset import SpectrumDataset, measured_at
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, Spectrum, check_shape

_PLAIN = ("frequency_hz", "shape", "floor", "range_db", "beam_sigma_rad")
"""Attributes of every model that are numbers, under these names in the header of a file."""
NARROWEST_BEAM_RAD = 1e-4


@checked
class RadioField(ABC):
    """A fitted radio field; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        transmitter: position it was fitted for [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        shape: rows and columns of its spectra.
        floor, range_db, beam_sigma_rad: of the data set it was fitted to.
        fitted_on: receivers that it was fitted to [m], shape ``(R, 3)``; None where an older file does not say.
        fitted_under: transmitter of each of those [m], shape ``(R, 3)``; None for its own.
        mesh: what blocks; None if the geometry has no mesh.
        air: absorption in its path gains, that of the data set it was fitted to; None for none.
        device: where it computes.
        report: how the fit went.
        models: the class that fits and reads each model, by the model's name.
    """

    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    floor: float
    range_db: tuple[float, float]
    beam_sigma_rad: float
    fitted_on: np.ndarray | None
    fitted_under: np.ndarray | None = None
    mesh: Mesh | None
    air: Air | None
    device: DeviceLike
    report: dict[str, Any]
    models: ClassVar[dict[str, type[RadioField]]] = {}

    @property
    @abstractmethod
    def model(self) -> str:
        """Name of the model."""

    @classmethod
    def fit(cls, geometry: GeometryLike, ds: Data, model: str = "bistatic", **options: Any) -> RadioField:
        """Fit a radio field to what was measured.

        Args:
            geometry: a Reconstruction (anything with ``.gaussians`` and ``.mesh``), a Scene or a Mesh.
            ds: training set: spectra, and for a ``bistatic`` field also :class:`Readings`, or a list of both.
            model: ``"bistatic"``, ``"rf3dgs+"`` or ``"rf3dgs"``.
            options: keyword arguments of :meth:`BistaticField.fit` or :meth:`HarmonicField.fit`, which name and check
                them.

        Raises:
            ValueError, TypeError: for an unknown model or bad arguments.

        Warns:
            UserWarning: below 100 GHz and outdoors, that diffraction and transmission are not modelled.
        """
        if not isinstance(model, str) or model not in cls.models:
            raise ValueError(f"model: got {model!r}, expected one of {', '.join(cls.models)}")
        return cls.models[model].fit(geometry, ds, model, **options)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: DeviceLike = None) -> Self:
        """Read a field that :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or no radio field (of this model).
        """
        tensors, header = tensor_files.read(path)
        found = cls.models[
            "bistatic" if header.get("model") == "bistatic" else "rf3dgs+"
        ]  # which reads rf3dgs too
        if not issubclass(found, cls):
            raise ValueError(f"{os.fspath(path)}: holds a {found.__name__}, expected a {cls.__name__}")
        with tensor_files.named(path, "corrupt, or no radio field of this version"):
            check_type("report", header["report"], dict)
            parts: dict[str, Any] = {name: header[name] for name in _PLAIN} | {
                "shape": tuple(header["shape"]),
                "range_db": tuple(header["range_db"]),
                "transmitter": tensors["transmitter"],
                "fitted_on": tensors.get("fitted_on"),
                "air": Air.from_attributes(header),
                "report": header["report"],
                "device": device,
            }
            return found(**parts, **found._put_together(tensors, header))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go."""
        tensors, header = self._taken_apart()
        tensors["transmitter"] = self.transmitter
        for name in ("fitted_on", "fitted_under"):
            if getattr(self, name) is not None:
                tensors[name] = getattr(self, name)
        header |= {name: getattr(self, name) for name in _PLAIN} | {
            "model": self.model,
            "report": self.report,
        }
        tensor_files.write(path, tensors, header | ({} if self.air is None else self.air.attributes))

    @abstractmethod
    def _taken_apart(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Tensors and header of what this model alone has, for its file."""

    @classmethod
    @abstractmethod
    def _put_together(cls, tensors: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, Any]:
        """What :meth:`_taken_apart` took apart, by the names of the attributes.

        Raises:
            KeyError, TypeError, ValueError: for what is missing or does not fit.
        """

    @abstractmethod
    def with_gas(self, gas: Gas = True) -> Self:
        """The same field with the absorption of ``gas`` over every path's length, in place of what it had.

        Args:
            gas: False for none, True for the standard atmosphere, :class:`Air`, or a :class:`Relevance`, which says
                whether the absorption is worth its tolerance.

        Raises:
            ValueError: for a carrier outside ITU-R P.676; for an ``rf3dgs`` field, which has no lengths.
        """

    @abstractmethod
    def spectrum(self, rx: ArrayLike, transmitter: ArrayLike | None = None) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m]."""

    def spectra(
        self, rx: ArrayLike, transmitter: ArrayLike | None = None, *, progress: Progress | None = None
    ) -> np.ndarray:
        """Path gain of the spectra at many receivers: what :meth:`spectrum` says of each, without delays and departures.

        Args:
            rx: positions [m], shape ``(R, 3)``.
            transmitter: as for :meth:`spectrum`.
            progress: called as ``progress("spectra", done, total)``.

        Returns:
            Path gain [linear], shape ``(R, H, W)``, float32.

        Raises:
            ValueError: as for :meth:`spectrum`.
        """
        receivers, source = self.check_positions(check_array("rx", rx, (None, 3)), transmitter)
        found = np.empty((len(receivers), *self.shape), np.float32)
        for k, receiver in enumerate(receivers):
            found[k] = self.spectrum(receiver, source).path_gain
            if progress is not None:
                progress("spectra", k + 1, len(receivers))
        return found

    @abstractmethod
    def paths(
        self, rx: ArrayLike, transmitter: ArrayLike | None = None, max_paths: int | None = None
    ) -> Paths:
        """Propagation paths at ``rx`` (3,) or (R, 3) [m]."""

    def links(
        self,
        rx: ArrayLike,
        transmitter: ArrayLike | None = None,
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
        receivers, source = self.check_positions(check_array("rx", rx, (None, 3)), transmitter)
        return self.trace_links(receivers, source, LinkOptions(beam_sigma_rad, shape, mirror_order, progress))

    def suggest(
        self,
        candidates: ArrayLike,
        n: int = 1,
        *,
        arrival: ArrayLike | None = None,
        receive_pattern: Pattern | None = None,
        progress: Progress | None = None,
    ) -> np.ndarray:
        """Where to measure next: the candidates that lower the expected error most, one after another.

        It goes by what is seen there and how far that is known: a field of no measurement knows nothing but its prior;
        at the receivers in ``fitted_on`` the same is taken to have been measured that is asked for here.

        Args:
            candidates: receivers that could be measured [m], shape ``(C, 3)``. Predictions count at all of them.
            n: how many are chosen.
            arrival: zenith and azimuth that a horn would be turned to at each candidate [rad], shape ``(C, 2)``; None
                where a whole spectrum would be measured.
            receive_pattern: its gain, as of :class:`Readings`; 1 in every direction for power alone.
            progress: called as ``progress("suggest", done, total)``.

        Returns:
            Indices of candidates, best first, shape ``(n,)``.

        Raises:
            ValueError: as for :meth:`check_positions`, and for more than there are; for another model than ``bistatic``,
                which tells no surfaces apart.

        Example::

            field = wr.RadioField.fit(room, wr.SpectrumDataset.empty(transmitter=source, frequency_hz=300e9))
            first = candidates[field.suggest(candidates, 3)]
        """
        raise ValueError(f"suggest: got a field of model {self.model!r}, expected 'bistatic'")

    def check_positions(
        self, rx: ArrayLike, transmitter: ArrayLike | None = None, name: str = "rx"
    ) -> tuple[np.ndarray, np.ndarray]:
        """``rx`` (3,) or (R, 3), which errors call ``name``, and ``transmitter`` (3,), by default the fitted one, if the
        field holds there [m].

        Raises:
            ValueError: for a place that is not finite, outside the scene, on a surface, in another solid than the air
                of the fitted transmitter, or a receiver within the transmitter's reactive near field.
        """
        receivers = check_receivers(name, rx)
        source = self.transmitter if transmitter is None else check_array("transmitter", transmitter, (3,))
        check_positions(
            self.mesh, source, receivers, SPEED_OF_LIGHT / self.frequency_hz, names=("transmitter", name),
            known=self.transmitter, device=self.device,
        )  # fmt: skip
        return receivers, source

    def trace_links(self, receivers: np.ndarray, transmitter: np.ndarray, options: LinkOptions) -> Links:
        """:meth:`links` at positions that were checked: from paths, one receiver at a time."""
        if options.mirror_order is not None:
            raise ValueError(
                f"mirror_order: got {options.mirror_order!r}, but a field of model {self.model!r} has no mirrors"
            )
        search = BeamSearch(
            check_shape(options.shape or self.shape), options.beam_sigma_rad, device=self.device
        )
        return options.in_batches(
            receivers, 1, lambda some: links_of([self.paths(r, transmitter) for r in some], search)
        )

    def radio_map(
        self, height: float, cell: float = 0.25, transmitter: ArrayLike | None = None, **options: Any
    ) -> RadioMap:
        """Links over a floor plan, at ``height`` [m] in cells of ``cell`` [m].

        Args:
            height: of all cells' centres.
            cell: width of a cell.
            transmitter: position (3,) [m] if another than the fitted one.
            options: attributes of :class:`warprrf.rf.maps.radio_map.MapOptions`.

        Raises:
            ValueError: as :func:`warprrf.rf.maps.radio_map.radio_map`.
            TypeError: for an unknown option.
        """
        return radio_map(self, height, cell, transmitter, MapOptions(**options))

    def was_fitted_on(self, ds: SpectrumDataset) -> np.ndarray:
        """Which receivers of ``ds`` it was fitted on, under the same transmitter, shape ``(R,)`` bool."""
        if self.fitted_on is None:
            return np.zeros(len(ds.receivers), dtype=bool)
        under = self.transmitter if self.fitted_under is None else self.fitted_under
        return measured_at(ds, self.fitted_on, under)

    def __post_init__(self) -> None:
        """Check what every model has; ValueError or TypeError names the attribute."""
        object.__setattr__(self, "transmitter", check_array("transmitter", self.transmitter, (3,)))
        if self.device is not None:  # its name: a wp.Device cannot be pickled
            object.__setattr__(self, "device", str(self.device))
        check_number("frequency_hz", self.frequency_hz, *CARRIERS_HZ)
        check_shape(self.shape)
        check_positive("floor", self.floor, "linear noise floor")
        low, high = (check_number("range_db", value, -1e4, 1e4) for value in self.range_db)
        if not low <= high:
            raise ValueError(f"range_db: got {self.range_db}, expected the lower end first")
        check_number("beam_sigma_rad", self.beam_sigma_rad, NARROWEST_BEAM_RAD, np.pi)
        if self.fitted_on is not None:
            known = check_array("fitted_on", self.fitted_on, (None, 3))
            if self.fitted_under is not None:
                check_array("fitted_under", self.fitted_under, known.shape)
        if np.abs(self.transmitter).max() > LARGEST_M:
            raise ValueError(f"transmitter: got {self.transmitter}, expected at most {LARGEST_M:g} m")
        if self.air is not None:
            self.air.loss_per_m(self.frequency_hz)
