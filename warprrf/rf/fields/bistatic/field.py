"""The bistatic radio field: line of sight, mirrors, scattering lobes and what they light further, on frozen geometry.

A pixel holds the power of every path of a scattering surface, spread by the receiver beam:

- line of sight (Friis) and mirror reflections by the image method, blocking softened;
- diffuse scattering of surfaces that the transmitter illuminates, a non-negative mix of normalised lobes
  (:mod:`warprrf.rf.fields.bistatic.scattering`), which changes when the ends are swapped unless fitted as ``reciprocal``;
- what those illuminate in turn (:mod:`warprrf.rf.fields.bistatic.elements`), and an indirect radiance of each group.

Where the data hold absorption by the air, every leg of a path has its own.

Parameters belong to groups of surfaces that look alike and are few, so ten spectra suffice; because each term is a
function of both directions and of the path's lengths, the field holds for a transmitter that it never saw.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import Cache
from warprrf.checks import (
    Expected,
    check_array,
    check_arrays,
    check_count,
    check_number,
    check_type,
    checked,
    index_to,
    one_line,
)
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, Mesh
from warprrf.rf.channel.array_spectra import check_steering
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.absorption import Air, Gas, air_of
from warprrf.rf.em.materials import assumed_permittivity
from warprrf.rf.em.waves import SPEED_OF_LIGHT, check_frequency
from warprrf.rf.fields.base import Data, Measured, RadioField
from warprrf.rf.fields.bistatic import files, uncertainty
from warprrf.rf.fields.bistatic.links import RAYS_AT_A_TIME, LinkTracer
from warprrf.rf.fields.bistatic.materials import ARRAYS as PARAMETER_ARRAYS
from warprrf.rf.fields.bistatic.materials import MOST_NEPERS, Layout, Materials, Parameters, Terms
from warprrf.rf.fields.bistatic.measured import ArrayImage, read
from warprrf.rf.fields.bistatic.observations import Frame, as_list, places_of, transmitters_of
from warprrf.rf.fields.bistatic.paths import paths_of, strongest
from warprrf.rf.fields.bistatic.render import Rendered, images, path_powers, render, sent_radiance
from warprrf.rf.fields.bistatic.suggest import SHAPE as SUGGEST_SHAPE
from warprrf.rf.fields.bistatic.suggest import Pointings, Sensitivity, Unknowns, suggest
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.training import FitOptions, TrainingViews, train
from warprrf.rf.fields.bistatic.transport import ReceiverView, Transport
from warprrf.rf.maps.links import LinkOptions, Links
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.antenna import Pattern
from warprrf.rf.spectra.beam import BeamOperator, beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import check_gains, check_turned
from warprrf.rf.spectra.spectrum import Spectrum, default_floor, directions_from_angles, to_db


@checked
@dataclass(frozen=True, eq=False)
class BistaticField(RadioField):
    """A fitted bistatic field; build it with :meth:`RadioField.fit` or :meth:`RadioField.load`.

    Attributes:
        surface: patches, material groups and elements.
        transmitter: position it was fitted for [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        shape: rows and columns of its spectra.
        floor, range_db, beam_sigma_rad: of the data set it was fitted to.
        terms: what it models.
        parameters: of the groups; those of one material are alike.
        material: of each group, shape ``(G,)``.
        residual: ln gain of each surface cell over its group, for single bounces and for light that it sends on, shape
            ``(2, X)``; see :mod:`warprrf.rf.fields.bistatic.residuals`.
        errors: how wrong it is; None if it was fitted to fewer receivers than that takes.
        air: absorption of every path: that of the data set it was fitted to; None for none.
        fitted_on: receivers that it was fitted to [m], shape ``(R, 3)``; None where it is not known.
        fitted_under: transmitter of each of those [m], shape ``(R, 3)``; None for its own.
        report: how the fit went.
        device: where it computes.
    """

    __repr__ = one_line

    surface: Surface = field(repr=False)
    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    floor: float
    range_db: tuple[float, float]
    beam_sigma_rad: float
    terms: Terms
    parameters: Parameters = field(repr=False)
    material: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)
    errors: uncertainty.ErrorModel | None = field(default=None, repr=False)
    air: Air | None = None
    fitted_on: np.ndarray | None = field(default=None, repr=False)
    fitted_under: np.ndarray | None = field(default=None, repr=False)
    report: dict[str, Any] = field(default_factory=dict, repr=False)
    device: DeviceLike = field(default=None, repr=False)
    _sent: Cache = field(init=False, repr=False, default_factory=lambda: Cache(4))

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {"G": self.surface.groups, "L": len(self.terms.lobes), "X": self.surface.cells}
        check_arrays(vars(self.parameters), PARAMETER_ARRAYS, **sizes)
        check_arrays(vars(self), _ARRAYS, **sizes)
        materials = int(self.material.max()) + 1
        if len(np.unique(self.material)) != materials:
            raise ValueError(
                f"material: got {np.unique(self.material)}, expected all of 0 to {materials - 1}"
            )

        if self.errors is not None:  # terms may have changed since they were learned
            known = [
                Layout(materials, sizes["L"], indirect=indirect, gain=gain).size
                for indirect in (False, True)
                for gain in (False, True)
            ]
            if len(self.errors.covariance) not in known:
                raise ValueError(
                    f"errors: got a covariance of {len(self.errors.covariance)} parameters, expected one of {known}"
                )

    @property
    def model(self) -> str:
        """Name of the model."""
        return "bistatic"

    @property
    def mesh(self) -> Mesh:  # type: ignore[override]
        """What blocks."""
        return self.surface.mesh

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @property
    def materials(self) -> Materials:
        """All that a spectrum depends on besides the geometry."""
        return Materials(self.terms, self.parameters, self.residual, self.transmitter)

    @classmethod
    def fit(  # type: ignore[override]
        cls,
        geometry: GeometryLike,
        ds: Data,
        model: str = "bistatic",
        *,
        options: FitOptions | None = None,
        transport: TrainingViews | None = None,
        client: Any = None,
        device: DeviceLike = None,
        progress: Progress | None = None,
        **settings: Any,
    ) -> BistaticField:
        """Fit a bistatic field.

        Args:
            geometry: Reconstruction, Scene (its materials name the groups, nothing else is taken from them) or Mesh.
            ds: training set: spectra, readings, or a list of them. The field's own transmitter and carrier are the first.
                Without any receiver the field is what is known beforehand.
            model: ``"bistatic"``.
            options: what is modelled and how it is fitted.
            transport: what :func:`warprrf.rf.fields.bistatic.training.trace` found for exactly these receivers.
            client: a ``dask.distributed.Client`` whose workers cast the rays; this process by default.
            device: where rays are cast.
            progress: called with the stages ``"patches"``, ``"mirrors"``, ``"transport"`` and ``"fit"``.
            settings: attributes of :class:`warprrf.FitOptions`, in place of those of
                ``options``: ``quick=True``, ``mirror_order=2``, ``relevance=found``, ...

        Raises:
            ValueError: for options out of range, receivers on a surface or outside the scene, spectra that are all
                empty, or a ``transport`` of others.
            TypeError: for a geometry without a mesh, or an unknown option.
        """
        chosen, data = FitOptions.of(options, settings), as_list(ds)
        if not any(map(len, data)):
            return cls._unmeasured(geometry, data, chosen, device)
        found = train(
            geometry, data, chosen, transport=transport, client=client, device=device, progress=progress
        )
        frame = Frame.of(data)
        ends = np.concatenate([np.column_stack([transmitters_of(one), one.receivers]) for one in data])
        ends = ends[np.sort(np.unique(ends, axis=0, return_index=True)[1])]
        receivers = ends[(ends[:, :3] == frame.transmitter).all(axis=1), 3:]
        fitted = replace(
            cls.prior(found.surface, frame, terms=found.materials.terms, device=device),
            parameters=found.materials.parameters, residual=found.materials.residual, material=found.material,
            errors=found.errors, report=found.report, fitted_on=ends[:, 3:], fitted_under=ends[:, :3],
        )  # fmt: skip
        if any(isinstance(one, SpectrumDataset) for one in data):
            return fitted
        places = receivers[np.linspace(0, len(receivers) - 1, min(len(receivers), 8)).astype(int)]
        gains = np.stack([fitted.spectrum(place).path_gain for place in places])
        floor = default_floor(gains)
        return replace(
            fitted, floor=floor, range_db=(10.0 * float(np.log10(floor)), float(to_db(gains.max(), floor)))
        )

    @classmethod
    def _unmeasured(
        cls, geometry: GeometryLike, data: list[Measured], o: FitOptions, device: DeviceLike
    ) -> BistaticField:
        """What a fit to no measurement gives: permittivities of ITU-R P.2040, by the names of materials where it has
        them, terms left free as for few receivers."""
        frame = Frame.of(data)
        prior = cls.prior(geometry, frame, terms=o.unmeasured(frame.frequency_hz), device=device)
        places_of(data, prior.mesh, device)
        known = [assumed_permittivity(name, prior.frequency_hz) for name in prior.surface.group_names]
        parameters = replace(prior.parameters, log_excess=np.log(np.array(known) - 1.0))
        report = {"receivers": 0, "held_out": 0, "chains": {}, "unexplained": {}}
        return replace(prior, parameters=parameters, report=report)

    @classmethod
    def prior(
        cls,
        geometry: GeometryLike,
        ds: SpectrumDataset | Frame,
        *,
        terms: Terms | None = None,
        device: DeviceLike = None,
    ) -> BistaticField:
        """The field before any measurement: every surface is taken for :meth:`Parameters.prior`.

        Of ``ds`` only transmitter, carrier, grid, beam, floor, range and air count; its spectra are not looked at.

        Args:
            geometry: Reconstruction, Scene, Mesh or Surface.
            ds: data set that it is asked to predict.
            terms: what is modelled; single bounces by default.
            device: where it computes.

        Raises:
            TypeError: for a geometry without a mesh.
        """
        modelled, surface = terms or Terms(), Surface.of(geometry)
        rows, columns = ds.shape if isinstance(ds, Frame) else ds.path_gain.shape[1:]
        return cls(
            surface=surface,
            transmitter=check_array("ds.transmitter", ds.transmitter, (3,)),
            frequency_hz=float(ds.frequency_hz),
            shape=(int(rows), int(columns)),
            floor=float(ds.floor),
            range_db=(float(ds.range_db[0]), float(ds.range_db[1])),
            beam_sigma_rad=float(ds.beam_sigma_rad),
            terms=modelled,
            parameters=Parameters.prior(surface.groups, len(modelled.lobes)),
            material=surface.material,
            residual=np.zeros((2, surface.cells)),
            air=getattr(ds, "air", None),
            fitted_on=np.zeros((0, 3)),
            device=device,
        )

    def with_gas(self, gas: Gas = True) -> BistaticField:
        """The same field with the absorption of ``gas``; see :meth:`RadioField.with_gas`."""
        return replace(self, air=air_of(gas, self.frequency_hz))

    def at_frequency(self, frequency_hz: float) -> BistaticField:
        """The same room at another carrier, with nothing measured there.

        What carries over: geometry, and so directions and delays; permittivities, which ITU-R P.2040-4 has constant above
        100 GHz for every indoor material; how surfaces differ; the roughness that their mirrored and scattered shares tell,
        counted in the new wavelengths (Ament 1953); absorption by the air, at the new carrier. Floor and range move with
        the square of the wavelength. What does not: the width of scattering lobes stays as it was, thin slabs are none,
        gains of measuring chains and the stated uncertainty are not known there.

        Args:
            frequency_hz: the other carrier [Hz].

        Raises:
            ValueError: for no carrier; for one outside ITU-R P.676, where the field has absorption.

        Example::

            field_140 = field_300.at_frequency(140e9)
        """
        ratio = check_frequency(frequency_hz) / self.frequency_hz
        fall = 20.0 * float(np.log10(ratio))
        return replace(
            self, frequency_hz=float(frequency_hz), parameters=self.parameters.at_ratio(ratio), errors=None,
            floor=self.floor / ratio**2, range_db=(self.range_db[0] - fall, self.range_db[1] - fall),
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------ asking

    def spectrum(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        shape: tuple[int, int] | None = None,
        uncertainty: bool = False,
        view: ReceiverView | None = None,
    ) -> Spectrum:
        """The spatial spectrum of every receiver; see :meth:`RadioField.spectrum`.

        Args:
            receivers, transmitter, shape: as there.
            uncertainty: also give the standard deviation of the dB image per pixel, as ``std_db``.
            view: what one receiver sees, if it was traced before (:meth:`view`), on this grid.

        Raises:
            ValueError: as for :meth:`check_positions`; for ``uncertainty`` of a field that was fitted to too few
                receivers to know it.
        """
        field = self.on_grid(shape)
        if view is not None:
            return field._seen(view, uncertainty)
        return field._looked(
            receivers, transmitter, lambda *link: field._trace_spectrum(*link, uncertainty=uncertainty)
        )

    def _trace_spectrum(
        self, receiver: np.ndarray, transmitter: np.ndarray, *, uncertainty: bool = False
    ) -> Spectrum:
        return self._seen(self.transport(transmitter).view(receiver, self.terms), uncertainty)

    def _seen(self, view: ReceiverView, uncertainty: bool) -> Spectrum:
        found = self.render(view)
        delay, aod = strongest(view, found, self.beam_sigma_rad)
        spectrum = Spectrum(
            path_gain=found.image.astype(np.float32),
            delay_s=delay,
            aod=aod,
            floor=self.floor,
            range_db=self.range_db,
        )
        return replace(spectrum, std_db=self._std_db(view, found)) if uncertainty else spectrum

    def paths(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        max_paths: int | None = None,
        *,
        store: str | os.PathLike[str] | None = None,
        client: Any = None,
        progress: Progress | None = None,
        view: ReceiverView | None = None,
    ) -> Paths:
        """Propagation paths; see :meth:`RadioField.paths`.

        A diffuse path goes over the point that the pixel's strongest ray hits; light that came over more surfaces has no
        path of its own and is counted to that. ``view`` is what one receiver sees, if it was traced before (:meth:`view`).
        """
        if view is None:
            return super().paths(
                receivers, transmitter, max_paths, store=store, client=client, progress=progress
            )
        return paths_of(view, self.render(view), self.floor, self.air, max_paths)

    def _trace_paths(self, receiver: np.ndarray, transmitter: np.ndarray, max_paths: int | None) -> Paths:
        view = self.transport(transmitter).view(receiver, self.terms)
        return paths_of(view, self.render(view), self.floor, self.air, max_paths)

    def _trace_spectra(self, receivers: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
        """Several receivers are traced at once."""
        transport = self.transport(transmitter)
        sent, found = self.sent_radiance(transport), np.empty((len(receivers), *self.shape), np.float32)
        batch = max(1, RAYS_AT_A_TIME // len(transport.grid.directions))
        paths = transport.paths(
            receivers, self.terms.mirror_order
        )  # chains of mirrors are searched once for all
        for first in range(0, len(receivers), batch):
            some = np.arange(first, min(first + batch, len(receivers)))
            view = transport.view(receivers[some], self.terms, paths=paths.of(some))
            found[some] = images(view, path_powers(view, self.materials, sent), self._beam)
        return found

    def array_spectrum(
        self,
        receivers: ArrayLike,
        array: PlanarArray,
        directions: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        length_std_m: float = 0.0,
    ) -> np.ndarray:
        """Angular spectrum |a^H h|^2 / M^2 of a coherent array at every receiver, in expectation over the phases of what
        is scattered; see :class:`ArraySpectra`.

        Args:
            receivers, transmitter: as for :meth:`spectrum`; the array's centre.
            array: turned as it stands; without polarisation.
            directions: unit vectors in world axes, shape ``(..., 3)``.
            length_std_m: how well the lengths of paths are known [m].

        Returns:
            Path gain, shape ``(...)`` for one receiver and transmitter, else ``(R, ...)``.

        Raises:
            TypeError, ValueError: as for :meth:`spectrum`, and naming the argument.
        """
        steered = check_steering(array, directions)
        std = check_number("length_std_m", length_std_m, 0.0)
        ends, found = self.check_positions(receivers, transmitter), []
        for receiver, source in zip(ends.receivers, ends.transmitters, strict=True):
            view = self.transport(source).view(receiver, self.terms)
            image = ArrayImage.of(view, array, steered.reshape(-1, 3), std)
            powers = path_powers(view, self.materials, self.sent_radiance(view.transport))
            found.append(np.maximum(read(view, image, powers), 0.0).reshape(steered.shape[:-1]))
        return np.asarray(ends.shaped(np.stack(found)))

    def view(self, receivers: ArrayLike, transmitter: ArrayLike | None = None) -> ReceiverView:
        """What one receiver (3,) sees of the geometry under one transmitter (3,), whatever the materials: the costly part
        of a spectrum.

        Raises:
            ValueError: as for :meth:`spectrum`, and for several.
        """
        ends = self.check_positions(receivers, transmitter)
        if not ends.single:
            raise ValueError(
                f"receivers: got {len(ends.receivers)} links, expected one place (3,) and transmitter (3,)"
            )
        return self.transport(ends.transmitters[0]).view(ends.receivers[0], self.terms)

    def render(self, view: ReceiverView) -> Rendered:
        """The spectrum of what is seen, by its parts."""
        check_type("view", view, ReceiverView)
        view = view.transport.complete(view, self.terms)
        return render(view, self.materials, self._beam, self.sent_radiance(view.transport))

    def transport(self, transmitter: ArrayLike | None = None) -> Transport:
        """The geometry under ``transmitter`` (3,) [m], by default the fitted one; that of the last few is kept."""
        source = self.transmitter if transmitter is None else check_array("transmitter", transmitter, (3,))
        return Transport.of(
            self.surface, source, self.frequency_hz, self.shape, self.terms.sub_pixels,
            beam_sigma_rad=self.beam_sigma_rad,
            loss_per_m=0.0 if self.air is None else self.air.loss_per_m(self.frequency_hz), device=self.device,
        )  # fmt: skip

    def sent_radiance(self, transport: Transport) -> np.ndarray | None:
        """Radiance (E,) that elements send on after first bounces; see
        :func:`warprrf.rf.fields.bistatic.render.sent_radiance`."""
        key = transport.transmitter.tobytes()
        return self._sent.get(key, lambda: sent_radiance(transport, self.materials))

    def suggest(
        self,
        candidates: ArrayLike,
        n: int = 1,
        *,
        arrival: ArrayLike | None = None,
        receive_pattern: Pattern | None = None,
        progress: Progress | None = None,
    ) -> np.ndarray:
        """Where to measure next; see :meth:`RadioField.suggest`, and :mod:`warprrf.rf.fields.bistatic.suggest` for how."""
        given = check_array("candidates", candidates, (None, 3))
        places = self.check_positions(given, name="candidates").receivers
        check_count("n", n, 1, len(places))
        pointings = None
        if (arrival is None) != (receive_pattern is None):
            raise ValueError(
                "receive_pattern: it goes with arrival, got one of the two; expected both or neither"
            )
        if arrival is not None and receive_pattern is not None:
            check_gains("receive_pattern", receive_pattern)
            angles = check_turned("arrival", arrival, len(places))
            pointings = Pointings(directions_from_angles(*angles.T), receive_pattern)
        sensitivity, unknowns = self._sensitivity(self.transmitter)
        measured = np.zeros((0, 3)) if self.fitted_on is None else self.fitted_on
        return suggest(
            sensitivity, unknowns, places, n, measured=measured, pointings=pointings, progress=progress
        )

    def gain_std_db(self, progress: Progress | None = None) -> np.ndarray:
        """How far the gain of what each element of the surface scatters is known after spectra at ``fitted_on``: standard
        deviation [dB], shape ``(E,)``; see :mod:`warprrf.rf.fields.bistatic.suggest`."""
        sensitivity, unknowns = self._sensitivity(self.transmitter)
        places = np.zeros((0, 3)) if self.fitted_on is None else self.fitted_on
        variance = unknowns.variance(sensitivity.precision(places, progress=progress))
        return uncertainty.NEPER * np.sqrt(variance[: len(self.surface.element_area)])

    def _sensitivity(self, transmitter: np.ndarray) -> tuple[Sensitivity, Unknowns]:
        transport = self.transport(transmitter).on_grid(SUGGEST_SHAPE, 1, mirror_sub_pixels=1)
        floor = self.floor * np.prod(self.shape) / np.prod(SUGGEST_SHAPE)
        return Sensitivity(transport, self.materials, floor), Unknowns.of(transport, self.material)

    def trace_links(self, receivers: np.ndarray, transmitter: np.ndarray, options: LinkOptions) -> Links:
        """:meth:`links` at positions that were checked, several at a time."""
        transport = self.transport(transmitter)
        tracer = LinkTracer(transport, self.materials, self.sent_radiance(transport), options, self.shape)
        return options.in_batches(receivers, tracer.batch, tracer)

    @property
    def _beam(self) -> BeamOperator:
        return beam_operator(self.shape, self.beam_sigma_rad, self.device)

    def _std_db(self, view: ReceiverView, rendered: Rendered) -> np.ndarray:
        """Standard deviation of the dB image per pixel (H, W); see :mod:`warprrf.rf.fields.bistatic.uncertainty`."""
        if self.errors is None:
            raise ValueError(
                f"uncertainty: this field was fitted to {self.report.get('receivers', 0)} receivers, too few to hold "
                "some out and learn its error from; fit to four or more"
            )
        materials, lobes = int(self.material.max()) + 1, len(self.terms.lobes)
        free = Layout(materials, lobes, indirect=self.terms.indirect, gain=False).size
        if len(self.errors.covariance) not in (free, free + 1):  # with a common gain
            raise ValueError(
                f"uncertainty: this field's errors were learned for {len(self.errors.covariance)} parameters, but its "
                f"terms have {free} now; fit it with these terms"
            )
        return uncertainty.predicted_std_db(
            self.errors, view, rendered, self.materials, self.material, self._beam, self.floor
        )

    # ------------------------------------------------------------------------------------------ files

    def _taken_apart(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return files.taken_apart({f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def _put_together(cls, tensors: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, Any]:
        return files.put_together(tensors, header)


_ARRAYS = {"material": index_to("G", "G"), "residual": Expected("2 X", -MOST_NEPERS, MOST_NEPERS)}
"""What the arrays of a field's own must be: G groups, X cells."""
