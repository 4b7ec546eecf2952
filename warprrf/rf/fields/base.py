"""Radio fields: one way to fit, ask, save and load, whatever the model.

``bistatic`` obeys scattering physics (:mod:`warprrf.rf.fields.bistatic`); ``rf3dgs+`` and ``rf3dgs`` hold spherical harmonics
per Gaussian as published (:mod:`warprrf.rf.fields.harmonic`).
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from importlib.metadata import version
from typing import Annotated, Any, ClassVar, Self, TypeAlias, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from warprrf import tensor_files
from warprrf.cache import Cache
from warprrf.checks import (
    LARGEST_M,
    Count,
    Shaped,
    check_array,
    check_choice,
    checked,
    one_line,
    one_of,
    within,
)
from warprrf.device import DeviceLike, Progress, resolve
from warprrf.geometry.mesh import GeometryLike, Mesh
from warprrf.netcdf_files import Variable, encoded
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.channel.response import LinkOptions as LinkEnds
from warprrf.rf.channel.response import frequency_response
from warprrf.rf.em.absorption import Air, Gas
from warprrf.rf.em.waves import CARRIERS_HZ, SPEED_OF_LIGHT
from warprrf.rf.fields.batches import Batch, Work
from warprrf.rf.maps.links import LinkOptions, Links, links_of
from warprrf.rf.maps.radio_map import MapOptions, RadioMap, radio_map
from warprrf.rf.paths.path_set import PATH_VARIABLES, Paths, attributes_of
from warprrf.rf.positions import Ends, check_positions, retraced_slope
from warprrf.rf.spectra.antenna import Antenna, Pattern, samples_of
from warprrf.rf.spectra.dataset import SpectrumDataset, measured_at
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.spectra.spectrum import Beam, Floor, GridShape, RangeDb, Spectra, Spectrum
from warprrf.steps import digest

_PLAIN = ("frequency_hz", "shape", "floor", "range_db", "beam_sigma_rad", "report")
"""Attributes of every model that the header of a file has under these names."""
Measured: TypeAlias = SpectrumDataset | Readings | ArraySpectra
"""What fields are fitted to: a set of spectra, a table of readings, spectra of coherent arrays."""
Data: TypeAlias = Measured | Sequence[Measured]
"""One of them, or several."""


@dataclass(frozen=True, eq=False)
class Location:
    """A receiver's place by what it read; see :meth:`RadioField.locate`.

    Attributes:
        position: the likeliest place [m], shape ``(3,)``.
        covariance: of its error, by how readings change there and how well the field explains them [m^2], shape ``(3, 3)``;
            infinite where they leave a way open, as one reading does.
        candidates: places where readings are explained better than round about, the likeliest first [m], shape ``(K, 3)``.
        likelihoods: of each, among them, shape ``(K,)``; their sum is 1.
        known: whether readings and field tell the place: it is likelier than all other candidates together by far, its error
            is small beside the distance of the places searched, and what was read is explained. Never where delays are read
            more finely than half a metre, which those places lie apart: a valley of errors between them may be missed.
        misfit: root mean square error of what was read, over what the field and the readings state: about 1.
        gains_db: of measuring chains of unknown gain, by name [dB].
        azimuth_zeros: what was added to azimuths of an unknown zero, by table's name [rad].
        clock_offsets_s: what was added to delays of an unknown zero, by table's name [s].
    """

    __repr__ = one_line

    position: np.ndarray
    covariance: np.ndarray
    candidates: np.ndarray
    likelihoods: np.ndarray
    known: bool
    misfit: float
    gains_db: Mapping[str, float]
    azimuth_zeros: Mapping[str, float]
    clock_offsets_s: Mapping[str, float]

    @property
    def std_m(self) -> float:
        """Standard deviation of the position, root of the covariance's trace [m]."""
        return float(np.sqrt(np.trace(self.covariance)))


@checked
@dataclass(frozen=True, eq=False, kw_only=True)
class RadioField(ABC):
    """A fitted radio field; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        transmitter: position it was fitted for [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        shape: rows and columns of its spectra.
        floor, range_db, beam_sigma_rad: of the data set it was fitted to.
        fitted_on: receivers that it was fitted to [m], shape ``(R, 3)``.
        fitted_under: transmitter of each of those [m], shape ``(R, 3)``; None for its own.
        air: absorption in its path gains, that of the data set it was fitted to; None for none.
        device: where it computes.
        report: how the fit went.
        models: the class that fits and reads each model, by the model's name.
    """

    transmitter: Annotated[np.ndarray, Shaped("3")]
    frequency_hz: Annotated[float, within(*CARRIERS_HZ)]
    shape: GridShape
    floor: Floor
    range_db: RangeDb
    beam_sigma_rad: Beam
    fitted_on: Annotated[np.ndarray, Shaped("R 3")] = field(default_factory=lambda: np.zeros((0, 3)))
    fitted_under: Annotated[np.ndarray, Shaped("R 3")] | None = None
    air: Air | None = None
    device: DeviceLike = None
    report: dict[str, Any] = field(default_factory=dict)
    _grids: Cache = field(init=False, default_factory=lambda: Cache(2))
    models: ClassVar[dict[str, type[RadioField]]] = {}

    @property
    @abstractmethod
    def model(self) -> str:
        """Name of the model."""

    @property
    @abstractmethod
    def mesh(self) -> Mesh | None:
        """What blocks; None if the geometry has no mesh."""

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @classmethod
    def fit(cls, geometry: GeometryLike, ds: Data, model: str = "bistatic", **options: Any) -> RadioField:
        """Fit a radio field to what was measured.

        Args:
            geometry: a Reconstruction (anything with ``.gaussians`` and ``.mesh``), a Scene or a Mesh.
            ds: training set: spectra, and for a ``bistatic`` field also :class:`Readings`, :class:`ArraySpectra`, or a list
                of any of them.
            model: ``"bistatic"``, ``"rf3dgs+"`` or ``"rf3dgs"``.
            options: by name, ``device`` and ``progress`` among them. A ``bistatic`` field takes ``client``, and those of
                :class:`~warprrf.rf.fields.bistatic.options.FitOptions`, such as ``quick=True``, ``effects``, ``seed``. The others
                take those of :class:`~warprrf.rf.fields.harmonic.fitting.FieldOptions`.

        Raises:
            ValueError, TypeError: for an unknown model or bad arguments.

        Warns:
            UserWarning: of diffraction and transmission where they are not modelled, below 100 GHz and outdoors, and, of a
                ``bistatic`` field, where they would add much as estimated; of readings that are taken for wrong, and of spectra
                whose strongest direction is not that of the transmitter.
        """
        check_choice("model", model, cls.models)
        return cls.models[model].fit(geometry, ds, model, **options)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: DeviceLike = None) -> Self:
        """Read a field that :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or no radio field (of this model).
        """
        tensors, header = tensor_files.read(path)
        found = cls.models.get(str(header.get("model")), cls.models["rf3dgs+"])
        if not issubclass(found, cls):
            raise ValueError(f"{os.fspath(path)}: holds a {found.__name__}, expected a {cls.__name__}")
        with tensor_files.named(path, "corrupt, or no radio field of this version"):
            parts = {name: header[name] for name in _PLAIN} | found._put_together(tensors, header)
            parts |= {name: tensors[name] for name in ("transmitter", "fitted_on")}
            air, under = Air.from_attributes(header), tensors.get("fitted_under")
            return found(**parts, fitted_under=under, air=air, device=device)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go."""
        tensor_files.write(path, *self._whole())

    def _whole(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Tensors and header of its file."""
        tensors, header = self._taken_apart()
        tensors |= {"transmitter": self.transmitter, "fitted_on": self.fitted_on}
        if self.fitted_under is not None:
            tensors["fitted_under"] = self.fitted_under
        header |= {name: getattr(self, name) for name in _PLAIN} | {"model": self.model}
        return tensors, header | ({} if self.air is None else self.air.attributes)

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
        """The same field with the absorption of ``gas``, as of :meth:`Paths.with_gas`, over every path's length, in place of
        what it had.

        Raises:
            ValueError: for a carrier outside ITU-R P.676; for an ``rf3dgs`` field, which has no lengths.
        """

    def spectrum(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        shape: GridShape | None = None,
    ) -> Spectrum:
        """The spatial spectrum of every receiver.

        Args:
            receivers: positions [m], shape ``(3,)`` or ``(R, 3)``.
            transmitter: position ``(3,)``, or one for each receiver ``(R, 3)`` [m]; the fitted one by default. Lengths,
                visibility and mirror points are those of any other too, as are materials; gains only of what it lights straight.
            shape: rows and columns; the field's own by default. Floor and range go with the size of the pixels.

        Returns:
            Arrays ``(H, W)`` for one receiver and transmitter ``(3,)``, else ``(R, H, W)``.

        Raises:
            ValueError: as for :meth:`check_positions`.
        """
        field = self.on_grid(shape)
        return field._looked(receivers, transmitter, field._trace_spectrum)

    def _looked(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None,
        look: Callable[[np.ndarray, np.ndarray], Spectrum],
    ) -> Spectrum:
        """What ``look`` finds at every receiver (3,) under its transmitter (3,)."""
        ends = self.check_positions(receivers, transmitter)
        found = [look(*link) for link in zip(ends.receivers, ends.transmitters, strict=True)]
        return found[0] if ends.single else Spectrum.stack(found)

    @abstractmethod
    def _trace_spectrum(self, receiver: np.ndarray, transmitter: np.ndarray) -> Spectrum:
        """:meth:`spectrum` at a position (3,) that was checked."""

    def on_grid(self, shape: GridShape | None) -> Self:
        """The same field, its spectra of ``shape`` rows and columns; None for its own.

        Floor and range, which are those of a pixel, go with the pixels' size.
        """
        if shape is None or shape == tuple(self.shape):
            return self
        smaller = float(np.prod(self.shape) / np.prod(shape))
        low, high = (level + 10.0 * float(np.log10(smaller)) for level in self.range_db)
        floor = self.floor * smaller
        return self._grids.get(shape, lambda: replace(self, shape=shape, floor=floor, range_db=(low, high)))

    def spectra(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        shape: tuple[int, int] | None = None,
        store: str | os.PathLike[str] | None = None,
        client: Any = None,
        progress: Progress | None = None,
    ) -> Spectra:
        """Path gain of the spectra at many receivers: what :meth:`spectrum` says of each, without delays and departures.

        Args:
            receivers, transmitter, shape: as for :meth:`spectrum`.
            store: a NetCDF-4 file that is written as answers come, in the place of memory; a call that was killed goes on
                where it stopped. Until the last answer its name ends in ``.unfinished``.
            client: a ``dask.distributed.Client`` whose workers compute, to the same bits; this process by default.
            progress: called as ``progress("spectra", done, total)``.

        Returns:
            Path gain ``(R, H, W)``, ``(H, W)`` for one receiver and transmitter, and where it holds; path gain of a store
            stays on the disk.

        Raises:
            ValueError: as for :meth:`spectrum`, and for a ``store`` of something else.

        Example::

            many = field.spectra(receivers, store="spectra.nc", client=distributed.Client("lab:8786"))
            many.path_gain[17]
        """
        field = self.on_grid(shape)
        batch = Batch("spectra", self.check_positions(receivers, transmitter), store, client, progress)
        variables = {"path_gain": Variable(("receiver", "zenith", "azimuth"), "1")}
        found = batch.gather(partial(_spectra, field), variables, {}, field._known_by(batch))
        to, source, gain = map(batch.ends.shaped, (*batch.ends[:2], found["path_gain"]))
        return Spectra(to, source, self.frequency_hz, gain)

    def paths(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        max_paths: Count | None = None,
        *,
        store: str | os.PathLike[str] | None = None,
        client: Any = None,
        progress: Progress | None = None,
    ) -> Paths:
        """Propagation paths: line of sight, mirrors, and one diffuse path per pixel above the floor.

        The sum of ``|gain|^2`` equals the spectrum's sum: what pixels below the floor hold is shared among the diffuse
        paths in proportion.

        Of ``rf3dgs+`` a diffuse path arrives from its pixel's centre, but its vertex, length and departure are those of the
        centre of the Gaussian that contributes most there (RF-3DGS+'s rule). Wide Gaussians reach over many pixels: arrival and
        direction to the vertex differ by degrees, by 10 and more with few Gaussians; ``interaction_point="peak"`` or
        ``"mesh"`` of :class:`~warprrf.rf.fields.harmonic.fitting.FieldOptions` puts the vertex on the ray.

        Args:
            receivers, transmitter: as for :meth:`spectrum`.
            max_paths: keep the strongest only (the sum is then what they carry).
            store: as for :meth:`spectra`, with room for ``max_paths``; :meth:`Paths.load` reads it.
            client, progress: as for :meth:`spectra`.

        Returns:
            Arrays ``(L,)`` for one receiver and transmitter, else ``(R, L)``, padded.

        Raises:
            ValueError: as for :meth:`spectra`, for a ``max_paths`` below 1, and for a store without one.
        """
        ends = self.check_positions(receivers, transmitter)
        batch, work = Batch("paths", ends, store, client, progress), partial(_paths, self, max_paths)
        if store is None:
            found: dict[int, Paths] = {}
            for rows, several in batch.each(work):
                found |= zip(rows.tolist(), several, strict=True)
            return found[0] if ends.single else Paths.stack([found[k] for k in sorted(found)])
        if max_paths is None:
            raise ValueError("max_paths: got None with a store, expected how many paths it has room for")
        attributes = attributes_of(self.frequency_hz, self.air) | self._known_by(batch, max_paths)
        attributes["single_receiver"] = int(ends.single)
        batch.gather(partial(_path_arrays, work, max_paths), PATH_VARIABLES, {}, attributes)
        return Paths.load(store)

    def cfr(
        self,
        receivers: ArrayLike,
        frequencies_hz: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        max_paths: int | None = None,
        store: str | os.PathLike[str] | None = None,
        client: Any = None,
        progress: Progress | None = None,
        **response: Unpack[ResponseOptions],
    ) -> np.ndarray:
        """Channel frequency responses at many receivers, from their :meth:`paths`, which are not kept.

        Args:
            receivers, transmitter: as for :meth:`spectrum`.
            frequencies_hz: absolute [Hz], shape ``(F,)``.
            max_paths: as for :meth:`paths`.
            store, client, progress: as for :meth:`spectra`.
            response: as for :meth:`Paths.cfr`: ``tx_array``, ``rx_array``, ``diffuse``, ...

        Returns:
            Shape ``(R, M, N, F)``, ``(M, N, F)`` for one receiver and transmitter, complex64: M receiving and N
            transmitting ports; that of a store stays on the disk.

        Raises:
            ValueError: as for :meth:`spectra` and :meth:`Paths.cfr`.
        """
        f = check_array("frequencies_hz", frequencies_hz, (None,))
        if unknown := set(response) - set(ResponseOptions.__annotations__):
            raise TypeError(f"cfr: got {', '.join(sorted(unknown))}, expected options of Paths.cfr")
        ports = [a.ports for a in (response.get("tx_array"), response.get("rx_array")) if a is not None]
        ends = self.check_positions(receivers, transmitter)
        batch = Batch("cfr", ends, store, client, progress, 8 * len(f) * int(np.prod(ports)))
        variables = {
            "cfr": Variable(("receiver", "receiving_port", "transmitting_port", "frequency"), "1"),
            "frequency": Variable(("frequency",), "Hz"),
        }
        key = self._known_by(batch, f, max_paths, {n: _sampled(o) for n, o in response.items()})
        work = partial(_cfr, self, f, max_paths, response)
        return ends.shaped(batch.gather(work, variables, {"frequency": f}, key)["cfr"])

    def _known_by(self, batch: Batch, *options: Any) -> dict[str, str]:
        """What tells a store of these answers from others."""
        if batch.store is None:
            return {}
        tensors, header = self._whole()
        del header["report"]
        asked = batch.stage, *batch.ends, str(resolve(self.device)), options
        return {"answers": batch.stage, "key": digest(version("warprrf"), tensors, header, asked)}

    def _trace_spectra(self, receivers: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
        """:meth:`spectra` at positions (K, 3) that were checked."""
        return np.stack([self._trace_spectrum(one, transmitter).path_gain for one in receivers])

    @abstractmethod
    def _trace_paths(self, receiver: np.ndarray, transmitter: np.ndarray, max_paths: int | None) -> Paths:
        """:meth:`paths` at a position (3,) that was checked."""

    def links(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        **options: Any,
    ) -> Links:
        """Total and best path gain, delay spread and best-beam gain at every receiver, without spectra.

        A ``bistatic`` field traces several receivers at once on a coarser grid of rays, for a small part of a
        spectrum's time; other models take their paths one receiver at a time.

        Args:
            receivers, transmitter: as for :meth:`spectrum`.
            options: attributes of :class:`warprrf.rf.maps.links.LinkOptions`: ``beam_sigma_rad``, ``shape``,
                ``mirror_order``, ``client``, ``progress``.

        Returns:
            Arrays ``(R,)``; numbers for one receiver and transmitter.

        Raises:
            ValueError: as for :meth:`spectrum`, and for a beam width that is not positive.
            TypeError: for an unknown option.
        """
        ends, asked = self.check_positions(receivers, transmitter), LinkOptions(**options)
        return self.trace_links(ends, asked)[0 if ends.single else slice(None)]

    def slope(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        quantity: Annotated[str, one_of("total", "spectrum")] = "total",
        step_m: float = 0.01,
    ) -> np.ndarray:
        """How what arrives changes with a receiver's place, by differences of spectra traced anew on either side of it, so that the
        edges of shadows count.

        Args:
            receivers, transmitter: as for :meth:`spectrum`.
            quantity: ``"total"``, 10 log10(total path gain + floor), or ``"spectrum"``, the same of each pixel.
            step_m: how far to either side it is asked [m].

        Returns:
            [dB/m] along x, y and z, shape ``(3,)`` or ``(H, W, 3)`` for one receiver and transmitter, else ``(R, 3)`` or
            ``(R, H, W, 3)``.

        Raises:
            ValueError: as for :meth:`spectrum`, at the receivers or within ``step_m`` of them; for another quantity or step.

        Example::

            field.slope([7.0, 4.0, 1.5])  # of the total [dB/m]
        """
        ends = self.check_positions(receivers, transmitter)

        def decibels(at: np.ndarray) -> np.ndarray:
            gain = self.spectra(at, np.repeat(ends.transmitters, 6, axis=0)).path_gain
            gain = gain.sum(axis=(1, 2), dtype=float) if quantity == "total" else gain.astype(float)
            return 10.0 * np.log10(gain + self.floor)

        return np.asarray(ends.shaped(retraced_slope(decibels, ends.receivers, step_m=step_m)))

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
        at the receivers in ``fitted_on``, each under its transmitter, the same is taken to have been measured that is asked
        for here.

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
        raise ValueError(f"field: got one of model {self.model!r}, expected 'bistatic' to suggest places")

    def locate(
        self,
        measured: Measured | Spectrum | Sequence[Measured],
        *,
        store: str | os.PathLike[str] | None = None,
        progress: Progress | None = None,
    ) -> Location:
        """Where a receiver is, by what it read.

        The first question makes a map of what the field gives everywhere in the air, under each transmitter: a minute or so
        in a room, kept with the field.

        Args:
            measured: the spectrum of one receiver; or its readings under transmitters of known places: of a horn's pointings
                at either end, profiles of delay, or power alone; or an array's spectrum; or a list of them. Where they say the
                receiver stood is not looked at. Gains of measuring chains (``chain``), azimuths with ``azimuth_known=False``
                and delays with ``clock_known=False`` are found too. Absorption that is in the powers, by their ``air``, is
                reckoned with in place of the field's.
            store: a NetCDF-4 file that keeps the map, for another process.
            progress: called as ``progress("map", done, total)``.

        Returns:
            Position and its covariance, other candidates, and whether the place is known.

        Raises:
            TypeError, ValueError: naming the argument; for another model than ``bistatic``.

        Example::

            found = field.locate(field.spectrum([7, 4, 1.5]))
            found.position, found.std_m, found.known
        """
        raise ValueError(f"field: got one of model {self.model!r}, expected 'bistatic' to find receivers")

    def check_positions(
        self, receivers: ArrayLike, transmitter: ArrayLike | None = None, *, name: str = "receivers"
    ) -> Ends:
        """``receivers`` and ``transmitter`` [m], each ``(3,)`` or ``(R, 3)``, by default the fitted one, row by row, if the
        field holds there; errors call the first ``name``.

        Raises:
            ValueError: for a place that is not finite, outside the scene, on a surface, in another solid than the air
                of the fitted transmitter, or a receiver within the transmitter's reactive near field.
        """
        ends = Ends.of(receivers, self.transmitter if transmitter is None else transmitter, name)
        check_positions(
            self.mesh, ends.transmitters, ends.shaped(ends.receivers), self.wavelength_m,
            names=("transmitter", name), known=self.transmitter, device=self.device,
        )  # fmt: skip
        return ends

    def trace_links(self, ends: Ends, options: LinkOptions) -> Links:
        """:meth:`links` at positions that were checked."""
        work, at_once = self._link_work(options)
        batch = Batch("links", ends, None, options.client, options.progress, at_once=at_once)
        rows, found = zip(*batch.each(work), strict=True)
        return Links.joined(found).take(np.argsort(np.concatenate(rows)))

    def _link_work(self, options: LinkOptions) -> tuple[Work, int]:
        """What finds links, and of how many receivers at once: from paths, one receiver at a time."""
        if options.mirror_order is not None:
            raise ValueError(
                f"mirror_order: got {options.mirror_order!r}, but a field of model {self.model!r} has no mirrors"
            )
        return partial(_links, self, options.shape or self.shape, options.beam_sigma_rad), 1

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
        under = self.transmitter if self.fitted_under is None else self.fitted_under
        return measured_at(ds, self.fitted_on, under)

    def __post_init__(self) -> None:
        """Check what annotations do not say; ValueError names the attribute."""
        if self.device is not None:  # its name: a wp.Device cannot be pickled
            object.__setattr__(self, "device", str(self.device))
        if np.abs(self.transmitter).max() > LARGEST_M:
            raise ValueError(f"transmitter: got {self.transmitter}, expected at most {LARGEST_M:g} m")
        if self.air is not None:
            self.air.loss_per_m(self.frequency_hz)


Options = TypeVar("Options", bound=Any)


def with_settings(options: Options, settings: Mapping[str, Any]) -> Options:
    """``options`` of a fit, a dataclass, with ``settings`` in place of the attributes that they name."""
    names = [f.name for f in fields(options)]
    if unknown := sorted(set(settings) - set(names)):
        raise TypeError(f"fit: got unknown option {', '.join(unknown)}, expected among {', '.join(names)}")
    return replace(options, **settings)


class ResponseOptions(LinkEnds, total=False):
    """What :func:`frequency_response` takes besides paths and frequencies.

    Attributes:
        amplitude: "carrier" or "friis".
        method: "dense", "grid" or "auto".
    """

    amplitude: str
    method: str


Part = tuple[np.ndarray, np.ndarray]
"""Receivers (K, 3) and their transmitter (3,)."""


def _spectra(field: RadioField, part: Part) -> dict[str, np.ndarray]:
    return {"path_gain": field._trace_spectra(*part)}


def _paths(field: RadioField, max_paths: int | None, part: Part) -> list[Paths]:
    return [field._trace_paths(receiver, part[1], max_paths) for receiver in part[0]]


def _path_arrays(work: Callable[[Part], list[Paths]], length: int, part: Part) -> dict[str, np.ndarray]:
    paths = replace(Paths.stack(work(part), length), receiver=None, transmitter=None)
    return encoded(vars(paths), PATH_VARIABLES)


def _cfr(
    field: RadioField, f: np.ndarray, max_paths: int | None, options: Any, part: Part
) -> dict[str, np.ndarray]:
    """Each receiver's paths and then its response, in single precision: paths of many would fill the memory."""
    every = (field._trace_paths(receiver, part[1], max_paths) for receiver in part[0])
    found = [frequency_response(paths, f, **options).astype(np.complex64) for paths in every]
    return {"cfr": np.stack(found)}


def _sampled(option: Any) -> Any:
    """An option as a store is known by it: of antennas, whose patterns may be functions, their gains."""
    if isinstance(option, Antenna):
        return samples_of(option)
    if isinstance(option, PlanarArray):
        return option.rows, option.cols, option.spacing, option.rotation, samples_of(option.element)
    return option


def _links(field: RadioField, shape: tuple[int, int], sigma: float, part: Part) -> Links:
    (paths,) = _paths(field, None, part)
    return links_of(paths, shape, sigma, field.device)
