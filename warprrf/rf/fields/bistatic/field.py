"""The bistatic radio field: line of sight, mirrors, scattering lobes and what they light further, on frozen geometry.

A pixel holds the power of every path of a scattering surface, spread by the receiver beam:

- line of sight (Friis) and mirror reflections by the image method, blocking softened;
- diffuse scattering of surfaces that the transmitter illuminates, directly or by a mirror, a non-negative mix of normalised
  lobes, which changes when the ends are swapped unless fitted as ``reciprocal``; it may be seen in a mirror;
- what those illuminate in turn (:mod:`warprrf.rf.tracing.render`).

Where the data hold absorption by the air, every leg of a path has its own.

Parameters belong to groups of surfaces that look alike and are few, so ten spectra suffice; because each interaction is a
function of both directions and of the path's lengths, the field holds for a transmitter that it never saw.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import Cache
from warprrf.checks import (
    Count,
    Expected,
    NotNegative,
    check_array,
    check_arrays,
    check_count,
    check_type,
    checked,
    index_to,
    one_line,
    whole,
)
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, Mesh
from warprrf.rf.channel.array_spectra import check_steering
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import NEPER, check_frequency
from warprrf.rf.fields.base import Data, Location, Measured, RadioField, with_settings
from warprrf.rf.fields.batches import Work
from warprrf.rf.fields.bistatic import edited, files
from warprrf.rf.fields.bistatic.fit import fit
from warprrf.rf.fields.bistatic.locate import locate
from warprrf.rf.fields.bistatic.measured import ArrayImage, SpectrumPixels, read, slopes
from warprrf.rf.fields.bistatic.observations import (
    as_list,
    frame_of,
    places_of,
)
from warprrf.rf.fields.bistatic.options import SUB_PIXELS, FitOptions, assumed, evenly
from warprrf.rf.fields.bistatic.paths import (
    LINK_SHAPE,
    RAYS_AT_A_TIME,
    links,
    paths_of,
    receivers_at_once,
    strongest,
)
from warprrf.rf.fields.bistatic.suggest import SHAPE as SUGGEST_SHAPE
from warprrf.rf.fields.bistatic.suggest import Sensitivity, Unknowns, precision, suggest
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel
from warprrf.rf.maps.links import LinkOptions
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.antenna import Antenna, Pattern
from warprrf.rf.spectra.beam import BeamOperator, beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import antenna_of, check_turned
from warprrf.rf.spectra.spectrum import Spectrum, default_floor, to_db
from warprrf.rf.tracing.model import ARRAYS as PARAMETER_ARRAYS
from warprrf.rf.tracing.model import MOST_NEPERS, SETS, Effects, Layout, Model, Parameters
from warprrf.rf.tracing.render import PathGains, materials_of, path_gains, spectra_of
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer, View


@checked
@dataclass(frozen=True, eq=False)
class BistaticField(RadioField):
    """A fitted bistatic field; build it with :meth:`RadioField.fit` or :meth:`RadioField.load`.

    Attributes:
        surface: patches, material groups and elements.
        effects: what it models.
        parameters: of the groups; those of one material are alike.
        material: of each group, shape ``(G,)``.
        residual: ln gain of each surface cell over its group, lit straight by the transmitter and lit in any other way, shape
            ``(2, X)``; see :mod:`warprrf.rf.fields.bistatic.residual`.
        errors: how wrong it is; None after a quick fit, of fewer than four receivers, or if not all are whole spectra.
        sub_pixels: square root of the rays per pixel.

    The others are those of :class:`RadioField`.
    """

    __repr__ = one_line

    surface: Surface = field(repr=False)
    effects: Effects
    parameters: Parameters = field(repr=False)
    material: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)
    errors: ErrorModel | None = field(default=None, repr=False)
    sub_pixels: Annotated[int, whole(1, 16)] = SUB_PIXELS
    _maps: Cache = field(init=False, repr=False, default_factory=lambda: Cache(2))

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {"G": self.surface.groups, "L": len(self.parameters.lobes), "X": len(self.surface.cells)}
        check_arrays(vars(self.parameters), PARAMETER_ARRAYS, **sizes)
        check_arrays(vars(self), _ARRAYS, **sizes)
        materials = int(self.material.max()) + 1
        if len(np.unique(self.material)) != materials:
            raise ValueError(
                f"material: got {np.unique(self.material)}, expected all of 0 to {materials - 1}"
            )
        known = Layout(materials, sizes["L"], through=True).size
        if self.errors is not None and len(self.errors.covariance) not in (known, known + 1):
            raise ValueError(
                f"errors: got a covariance of {len(self.errors.covariance)} parameters, expected {known}, or one more for a "
                "common gain"
            )

    @property
    def model(self) -> str:
        """Name of the model."""
        return "bistatic"

    @property
    def mesh(self) -> Mesh:
        """What blocks."""
        return self.surface.mesh

    @property
    def state(self) -> Model:
        """All that a spectrum depends on besides the geometry."""
        return Model(self.effects, self.parameters, self.residual, self.transmitter)

    @classmethod
    def fit(  # type: ignore[override]
        cls,
        geometry: GeometryLike,
        ds: Data,
        model: str = "bistatic",
        *,
        options: FitOptions | None = None,
        client: Any = None,
        device: DeviceLike = None,
        progress: Progress | None = None,
        **settings: Any,
    ) -> BistaticField:
        """Fit a bistatic field.

        Args:
            geometry: Reconstruction, Scene (its materials name the groups and say what slabs are, no more) or Mesh.
            ds: training set: spectra, readings, or a list of them. The field's own transmitter and carrier are the first
                spectra's, if there are any, else the first.
                Without any receiver the field is what is known beforehand.
            model: ``"bistatic"``.
            options: what is modelled and how it is fitted.
            client: a ``dask.distributed.Client`` whose workers cast the rays; this process by default.
            device: where rays are cast.
            progress: called with the stages ``"patches"``, ``"mirrors"``, ``"transport"`` and ``"fit"``.
            settings: attributes of :class:`~warprrf.rf.fields.bistatic.options.FitOptions`, in place of those of
                ``options``: ``quick=True``, ``effects="room"``, ``relevance=found``, ...

        Raises:
            ValueError: for options out of range, receivers on a surface or outside the scene, spectra without power above
                their floor, a chain without a reading above it, or too many rays or mirrors.
            TypeError: for a geometry without a mesh, or an unknown option.
        """
        chosen, data = with_settings(options or FitOptions(), settings), as_list(ds)
        if model != "bistatic":
            raise ValueError(f"model: got {model!r}, expected 'bistatic'")
        if not any(map(len, data)):
            return cls._unmeasured(geometry, data, chosen, device)
        found = fit(geometry, data, chosen, client=client, device=device, progress=progress)
        frame = frame_of(data)
        prior = cls.prior(found["surface"], frame, sub_pixels=chosen.rays_a_side, device=device)
        fitted = replace(prior, **found)
        if any(isinstance(one, SpectrumDataset) for one in data):
            return fitted
        receivers = found["fitted_on"][(found["fitted_under"] == frame.transmitter).all(axis=1)]
        gains = np.stack([fitted.spectrum(place).path_gain for place in evenly(receivers, 8)])
        floor = default_floor(gains)
        range_db = 10.0 * float(np.log10(floor)), float(to_db(gains.max(), floor))
        return replace(fitted, floor=floor, range_db=range_db)

    @classmethod
    def _unmeasured(
        cls, geometry: GeometryLike, data: list[Measured], o: FitOptions, device: DeviceLike
    ) -> BistaticField:
        """What a fit to no measurement gives: permittivities of ITU-R P.2040, by the names of materials where it has
        them, and effects that rooms have where they are left open."""
        frame = frame_of(data)
        effects = replace(o.candidates(frame.frequency_hz)[:2][-1], residual=False)
        lobes = o.exponents(frame.frequency_hz)
        prior = cls.prior(
            geometry, frame, effects=effects, lobes=lobes, reciprocal=o.reciprocal, sub_pixels=o.rays_a_side, device=device
        )  # fmt: skip
        places_of(data, prior.mesh, device)
        own = assumed(prior.surface, prior.frequency_hz)
        parameters = replace(prior.parameters, log_excess=own.log_excess)
        report = {"receivers": 0, "held_out": 0, "chains": {}, "unexplained": {}}
        return replace(prior, parameters=parameters, report=report)

    @classmethod
    def prior(
        cls,
        geometry: GeometryLike,
        ds: SpectrumDataset,
        *,
        effects: Effects | None = None,
        lobes: tuple[int, ...] | None = None,
        reciprocal: bool = False,
        sub_pixels: int = SUB_PIXELS,
        device: DeviceLike = None,
    ) -> BistaticField:
        """The field before any measurement: every surface is taken for :meth:`Parameters.prior`.

        Of ``ds`` only transmitter, carrier, grid, beam, floor, range and air count; its spectra are not looked at.

        Args:
            geometry: Reconstruction, Scene, Mesh or Surface.
            ds: data set that it is asked to predict.
            effects: what is modelled; single bounces by default.
            lobes, reciprocal, sub_pixels: as of :class:`FitOptions`.
            device: where it computes.

        Raises:
            TypeError: for a geometry without a mesh.
        """
        surface = Surface.of(geometry, frequency_hz=ds.frequency_hz)
        return cls(
            surface=surface,
            transmitter=ds.transmitter,
            frequency_hz=ds.frequency_hz,
            shape=ds.shape,
            floor=ds.floor,
            range_db=ds.range_db,
            beam_sigma_rad=ds.beam_sigma_rad,
            effects=replace(SETS["single"], residual=False) if effects is None else effects,
            parameters=replace(
                Parameters.prior(surface.groups, *([] if lobes is None else [lobes]), reciprocal=reciprocal),
                log_through=surface.slab_properties(ds.frequency_hz)[2],
            ),
            material=surface.material,
            residual=np.zeros((2, len(surface.cells))),
            sub_pixels=sub_pixels,
            air=ds.air,
            device=device,
        )

    def with_gas(self, gas: Gas = True) -> BistaticField:
        """The same field with the absorption of ``gas``; see :meth:`RadioField.with_gas`."""
        return replace(self, air=air_of(gas, self.frequency_hz))

    def at_frequency(self, frequency_hz: float) -> BistaticField:
        """The same room at another carrier, with nothing measured there.

        What carries over: geometry, and so directions and delays; permittivities, which ITU-R P.2040-4 has constant above
        100 GHz for every indoor material; how surfaces differ; the roughness that their mirrored and scattered shares tell,
        counted in the new wavelengths (Ament 1953); slabs as thick as they are, and what they lose beside, in proportion to
        the carrier; absorption by the air, at the new carrier. Floor and range move with the square of the wavelength. What
        does not: the width of scattering lobes stays as it was, thin slabs mirror as if they were none, gains of measuring
        chains and the stated uncertainty are not known there.

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
            self, frequency_hz=float(frequency_hz), parameters=self.parameters.at_ratio(ratio),
            errors=self.errors if ratio == 1.0 else None, floor=self.floor / ratio**2,
            range_db=(self.range_db[0] - fall, self.range_db[1] - fall),
        )  # fmt: skip

    def with_geometry(self, geometry: GeometryLike) -> BistaticField:
        """The same field in a room that changed: fitted materials stay with what stays.

        A face keeps the parameters of the group that its material's name says, else of the one that it lies on, to within the
        surface's error of position; cells keep what was learned of them where they are as before. Anything else is new, and of what
        the Scene's :class:`Material` or a name in ITU-R P.2040 says. A room that is as it was changes nothing. Where photos or a
        scanner made the room, edit ``field.mesh``, which the fit may have mended. The stated uncertainty is not known there.

        Args:
            geometry: the whole room as it is now: Scene, Mesh or Reconstruction.

        Raises:
            TypeError: for a geometry without a mesh.
            ValueError: for a new material that is not known at the field's carrier.

        Warns:
            UserWarning: where a fitted surface vanished, or something is new whose material nobody knows.
        """
        return replace(self, **edited.with_geometry(self, geometry))

    def with_objects(
        self, objects: Mapping[str, Mesh | None], *, materials: Mapping[str, Material | str] | None = None
    ) -> BistaticField:
        """The same field with things added, moved or taken away; the rest stays, as of :meth:`with_geometry`.

        Args:
            objects: by name, the thing's mesh where it is now, faces outward; None takes it away. It stands in the place of the
                object of that name, or else of the material, and is made of the same.
            materials: by the objects' names, of what is new or made otherwise: a :class:`Material`; the name of one of the field's
                groups; one in ITU-R P.2040; or ``"skin"``: dry, by Gabriel et al. (1996), to 100 GHz.

        Raises:
            ValueError: for a name that is no object's, an object whose material nobody says, a material that is not known at the
                field's carrier.

        Example::

            crossing = field.with_objects({"person": wr.Mesh(vertices, faces)}, materials={"person": "skin"})
        """
        return replace(self, **edited.with_objects(self, objects, materials or {}))

    def spectrum(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        shape: tuple[int, int] | None = None,
        uncertainty: bool = False,
        view: View | None = None,
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
            return field._seen(_of_link(view, receivers, transmitter), uncertainty)
        look = partial(field._trace_spectrum, uncertainty=uncertainty)
        return field._looked(receivers, transmitter, look)

    def _trace_spectrum(
        self, receiver: np.ndarray, transmitter: np.ndarray, uncertainty: bool = False
    ) -> Spectrum:
        return self._seen(self._view(receiver, transmitter), uncertainty)

    def _seen(self, view: View, uncertainty: bool) -> Spectrum:
        gains = self.path_gains(view)
        image = spectra_of(gains, self._beam)[0]
        known = {"transmitter": view.tracer.transmitter.copy(), "frequency_hz": self.frequency_hz}
        known |= {"beam_sigma_rad": self.beam_sigma_rad} | ({} if self.air is None else self.air.attributes)
        arrays = image.astype(np.float32), *strongest(gains, image, self.beam_sigma_rad)
        spectrum = Spectrum(*arrays, self.floor, self.range_db, attributes=known)
        return replace(spectrum, std_db=self._std_db(view, image)) if uncertainty else spectrum

    def paths(
        self,
        receivers: ArrayLike,
        transmitter: ArrayLike | None = None,
        max_paths: Count | None = None,
        *,
        store: str | os.PathLike[str] | None = None,
        client: Any = None,
        progress: Progress | None = None,
        view: View | None = None,
    ) -> Paths:
        """Propagation paths; see :meth:`RadioField.paths`.

        A diffuse path goes over the point that the pixel's strongest ray hits, behind slabs if most comes from there; light that
        came over more surfaces has no path of its own and is counted to that. ``view`` is what one receiver sees, if it was
        traced before (:meth:`view`).
        """
        if view is None:
            return super().paths(
                receivers, transmitter, max_paths, store=store, client=client, progress=progress
            )
        return self._paths_of(_of_link(view, receivers, transmitter), max_paths)

    def _trace_paths(self, receiver: np.ndarray, transmitter: np.ndarray, max_paths: int | None) -> Paths:
        return self._paths_of(self._view(receiver, transmitter), max_paths)

    def _paths_of(self, view: View, max_paths: int | None) -> Paths:
        gains = self.path_gains(view)
        return paths_of(gains, spectra_of(gains, self._beam)[0], self.floor, self.air, max_paths)

    def _trace_spectra(self, receivers: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
        """Several receivers are traced at once."""
        tracer, found = self.tracer(transmitter), np.empty((len(receivers), *self.shape), np.float32)
        batch = max(1, RAYS_AT_A_TIME // len(tracer.grid.directions))
        paths = tracer.paths(receivers, self.effects)  # chains of mirrors are searched once for all
        for first in range(0, len(receivers), batch):
            some = np.arange(first, min(first + batch, len(receivers)))
            view = tracer.view(receivers[some], self.effects, paths=paths.of(some))
            found[some] = spectra_of(self.path_gains(view), self._beam)
        return found

    def array_spectrum(
        self,
        receivers: ArrayLike,
        array: PlanarArray,
        directions: ArrayLike,
        transmitter: ArrayLike | None = None,
        *,
        length_std_m: NotNegative = 0.0,
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
        ends, found = self.check_positions(receivers, transmitter), []
        for receiver, source in zip(ends.receivers, ends.transmitters, strict=True):
            view = self._view(receiver, source)
            image = ArrayImage.of(view, array, steered.reshape(-1, 3), length_std_m)
            found.append(np.maximum(read(self.path_gains(view), image), 0.0).reshape(steered.shape[:-1]))
        return np.asarray(ends.shaped(np.stack(found)))

    def view(self, receivers: ArrayLike, transmitter: ArrayLike | None = None) -> View:
        """What one receiver (3,) sees of the geometry under one transmitter (3,), whatever the materials: rays and
        mirror paths. What scatters is traced when it is first asked for, and kept in it.

        Raises:
            ValueError: as for :meth:`spectrum`, and for several.
        """
        ends = self.check_positions(receivers, transmitter)
        if not ends.single:
            raise ValueError(
                f"receivers: got {len(ends.receivers)} links, expected one place (3,) and transmitter (3,)"
            )
        return self._view(ends.receivers[0], ends.transmitters[0])

    def _view(self, receiver: np.ndarray, transmitter: np.ndarray) -> View:
        return self.tracer(transmitter).view(receiver, self.effects)

    def path_gains(self, view: View) -> PathGains:
        """Path gain of all that is seen, by sequence of interactions.

        Raises:
            ValueError: for a view of another geometry, carrier, air or grid, or of fewer mirrors, slabs or edges.
        """
        check_type("view", view, View)
        loss = 0.0 if self.air is None else self.air.loss_per_m(self.frequency_hz)
        t, own = view.tracer, (self.surface, self.frequency_hz, loss, tuple(self.shape))
        if (t.surface, t.frequency_hz, t.grid.loss_per_m, tuple(t.grid.shape)) != own:
            raise ValueError(
                "view: got one of another geometry, carrier, air or grid, expected this field's own"
            )
        most = [[e.mirrors, e.transmissions, e.diffractions] for e in (view.effects, self.effects)]
        if np.less(most[0], most[1]).any():
            raise ValueError(
                f"view: got one of {most[0]} mirrors, slabs and edges, expected at least {most[1]}"
            )
        return path_gains(view, self.state)

    def tracer(self, transmitter: ArrayLike | None = None) -> Tracer:
        """The geometry under ``transmitter`` (3,) [m], by default the fitted one; that of the last few is kept."""
        source = self.transmitter if transmitter is None else check_array("transmitter", transmitter, (3,))
        return Tracer.of(
            self.surface,
            source,
            self.frequency_hz,
            self.shape,
            self.sub_pixels,
            air=self.air,
            device=self.device,
        )

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
        turned = antenna = None
        if (arrival is None) != (receive_pattern is None):
            raise ValueError(
                "receive_pattern: it goes with arrival, got one of the two; expected both or neither"
            )
        if arrival is not None and receive_pattern is not None:
            turned = check_turned("arrival", arrival, len(places))
            antenna = antenna_of("receive_pattern", receive_pattern)
        sensitivity, unknowns = self._sensitivity(antenna)
        measured = self._measured(antenna)
        return suggest(sensitivity, unknowns, places, n, measured=measured, turned=turned, progress=progress)

    def locate(
        self,
        measured: Measured | Spectrum | Sequence[Measured],
        *,
        store: str | os.PathLike[str] | None = None,
        progress: Progress | None = None,
    ) -> Location:
        """Where a receiver is; see :meth:`RadioField.locate`, and :mod:`warprrf.rf.fields.bistatic.locate` for how."""
        return locate(self, measured, store, progress)

    def gain_std_db(self, progress: Progress | None = None) -> np.ndarray:
        """How far the gain of what each element of the surface scatters is known after spectra at ``fitted_on``: standard
        deviation [dB], shape ``(E,)``; see :mod:`warprrf.rf.fields.bistatic.suggest`."""
        unknowns = self._sensitivity()[1]
        variance = unknowns.variance(precision(self._measured(), unknowns, progress=progress))
        return NEPER * np.sqrt(variance[: len(self.surface.element_area)])

    def _measured(self, antenna: Antenna | None = None) -> list[tuple[Sensitivity, np.ndarray]]:
        """Receivers that it was fitted to, each as its own transmitter lights what it sees."""
        under = self.transmitter if self.fitted_under is None else self.fitted_under
        sources, own = np.unique(np.broadcast_to(under, self.fitted_on.shape), axis=0, return_inverse=True)
        by_source = [self._sensitivity(antenna, source)[0] for source in sources]
        return [(by_source[k], place) for k, place in zip(own.reshape(-1), self.fitted_on, strict=True)]

    def _sensitivity(
        self, antenna: Antenna | None = None, transmitter: np.ndarray | None = None
    ) -> tuple[Sensitivity, Unknowns]:
        tracer = self.tracer(transmitter).on_grid(SUGGEST_SHAPE, 1)
        floor = self.floor * np.prod(self.shape) / np.prod(SUGGEST_SHAPE)
        return Sensitivity(tracer, self.state, floor, antenna), Unknowns.of(tracer, self.material)

    def _link_work(self, options: LinkOptions) -> tuple[Work, int]:
        effects, shape = self.effects, options.shape or LINK_SHAPE
        if options.mirror_order is not None:
            effects = replace(effects, mirrors=min(effects.mirrors, options.mirror_order))
        return partial(links, self, effects, shape, options.beam_sigma_rad), receivers_at_once(shape)

    @property
    def _beam(self) -> BeamOperator:
        return beam_operator(self.shape, self.beam_sigma_rad, self.device)

    def _std_db(self, view: View, image: np.ndarray) -> np.ndarray:
        """Standard deviation of the dB image per pixel (H, W); see :mod:`warprrf.rf.fields.bistatic.uncertainty`."""
        if self.errors is None:
            raise ValueError(
                f"uncertainty: no receiver was held out of this field's fit to {self.report.get('receivers', 0)}, or it was "
                "edited, or is of another carrier since, so its error is not known; fit spectra of four or more, without "
                "quick=True"
            )
        rows = np.unique(self.material, return_index=True)[1]
        lit = materials_of(view.tracer, self.parameters, self.effects)
        materials = lit.by_materials(self.parameters.take(rows), self.material)
        layout = Layout(len(rows), len(self.parameters.lobes), through=True)
        table, index = slopes(view, SpectrumPixels(self._beam), self.effects, materials, layout)
        table *= np.float32(self.parameters.gain / self.floor)
        power = image.ravel() / self.floor
        if len(self.errors.covariance) > layout.size:  # of a common gain
            table = np.concatenate([table, power[None].astype(np.float32)])
            index = np.append(index, layout.size)
        table *= (NEPER / (1.0 + power)).astype(np.float32)
        image_db = NEPER * np.log1p(power).reshape(image.shape)
        return self.errors.std_db(image_db, view.receivers[0], table, index)

    def _taken_apart(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return files.taken_apart({f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def _put_together(cls, tensors: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, Any]:
        return files.put_together(tensors, header)


def _of_link(view: View, receivers: ArrayLike, transmitter: ArrayLike | None) -> View:
    """``view``, if it is of this link."""
    ends = (receivers, view.receivers), (transmitter, view.tracer.transmitter)
    for name, (given, own) in zip(("receivers", "transmitter"), ends, strict=True):
        if given is not None and not np.array_equal(np.ravel(given), np.ravel(own)):
            raise ValueError(f"view: got one of {name} {np.ravel(own).tolist()}, expected {given}")
    return view


_ARRAYS = {"material": index_to("G", "G"), "residual": Expected("2 X", -MOST_NEPERS, MOST_NEPERS)}
"""What the arrays of a field's own must be: G groups, X cells."""
