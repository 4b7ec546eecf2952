"""The bistatic radio field: line of sight, mirrors, scattering lobes and what they light further, on frozen geometry.

A pixel holds the power of every path of a scattering surface, spread by the receiver beam:

- line of sight (Friis) and mirror reflections by the image method, blocking softened
  (:mod:`warprrf.rf.fields.bistatic.specular`);
- diffuse scattering (lambda / 4 pi)^2 Omega f_s |Gamma|^2 cos(theta_i) / (cos(theta_s) d1^2), f_s a non-negative mix of
  normalised lobes (:mod:`warprrf.rf.fields.bistatic.bounces`);
- what those light in turn (:mod:`warprrf.rf.fields.bistatic.second_bounce`), and an indirect radiance of each group.

Where the data hold absorption by the air, every leg of a path has its own.

Parameters belong to groups of surfaces that look alike and are few, so ten spectra suffice; because each term is a
function of both directions and of the path's lengths, the field holds for a transmitter that it never saw.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.device import check_array
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import Air, air_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic import files
from warprrf.rf.fields.bistatic.bounces import BounceTracer
from warprrf.rf.fields.bistatic.fit import NEPER, Layout, Parameters, View, jacobian, specular_power
from warprrf.rf.fields.bistatic.mirror_tree import MirrorTree
from warprrf.rf.fields.bistatic.paths import paths_of, strongest
from warprrf.rf.fields.bistatic.second_bounce import ElementLight, mirrored_scene
from warprrf.rf.fields.bistatic.sight import Composed, Sight
from warprrf.rf.fields.bistatic.specular import SpecularPaths, specular_paths
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import Terms
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel
from warprrf.rf.fields.receivers import check_receiver
from warprrf.rf.paths.trace import Paths
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.spectrum import Spectrum, unit_beams

if TYPE_CHECKING:
    from warprrf.rf.spectra.dataset import SpectrumDataset

MIRRORED_SUB_PIXELS = 2  # square root of the rays per pixel that look into mirrors
NEGLIGIBLE = (
    1e-3  # groups that bring a receiver less than this share of N0 at unit weight are not fitted to it
)


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
        residual: ln gain of each texel over its group, for single bounces and for light that it sends on, shape
            ``(2, X)``; see :mod:`warprrf.rf.fields.bistatic.residuals`.
        errors: how wrong it is; None if it was fitted to fewer receivers than that takes.
        air: absorption of every path: that of the data set it was fitted to; None for none.
        report: how the fit went.
    """

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
    errors: ErrorModel | None = field(default=None, repr=False)
    air: Air | None = None
    report: dict[str, Any] = field(default_factory=dict, repr=False)
    device: Any = field(default=None, repr=False)

    @property
    def model(self) -> str:
        """Name of the model."""
        return "bistatic"

    @classmethod
    def fit(cls, geometry: Any, ds: SpectrumDataset, **options: Any) -> BistaticField:  # type: ignore[override]
        """Fit to the spectra of ``ds``; see :func:`warprrf.rf.fields.bistatic.training.train`."""
        from warprrf.rf.fields.bistatic.training import train

        return train(geometry, ds, **options)

    @classmethod
    def prior(
        cls, geometry: Any, ds: SpectrumDataset, *, terms: Terms | None = None, device: Any = None
    ) -> BistaticField:
        """The field before any measurement: every surface is taken for :meth:`Parameters.prior`.

        Of ``ds`` only transmitter, carrier, grid, beam, floor, range and air count; its spectra are not looked at.

        Args:
            geometry: Reconstruction, Scene, Mesh or Surface.
            ds: data set that it is asked to predict.
            terms: what is modelled; single bounces by default.

        Raises:
            TypeError: for a geometry without a mesh.
        """
        modelled = Terms() if terms is None else terms
        surface = geometry if isinstance(geometry, Surface) else Surface.of(geometry)
        return cls(
            surface=surface,
            transmitter=check_array("ds.transmitter", ds.transmitter, (3,)),
            frequency_hz=float(ds.frequency_hz),
            shape=(int(ds.path_gain.shape[1]), int(ds.path_gain.shape[2])),
            floor=float(ds.floor),
            range_db=(float(ds.range_db[0]), float(ds.range_db[1])),
            beam_sigma_rad=float(ds.beam_sigma_rad),
            terms=modelled,
            parameters=Parameters.prior(surface.groups, len(modelled.lobes)),
            material=surface.material,
            residual=np.zeros((2, surface.texels)),
            air=getattr(ds, "air", None),
            device=device,
        )

    # ------------------------------------------------------------------------------------------ asking

    def with_gas(self, gas: Any = True) -> BistaticField:
        """The same field with the absorption of ``gas``; see :meth:`RadioField.with_gas`."""
        return replace(self, air=air_of(gas, self.frequency_hz))

    def spectrum(
        self, rx: Any, transmitter: Any = None, *, uncertainty: bool = False, sight: Sight | None = None
    ) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m].

        Args:
            rx: receiver position.
            transmitter: position (3,) [m] if another than the fitted one: lengths, visibility and mirror points are
                computed anew, materials are kept.
            uncertainty: also give the standard deviation of the dB image per pixel, as ``std_db``.
            sight: what this receiver sees, if it was traced before (:meth:`see`).

        Raises:
            ValueError: for a position that is not finite, outside the scene or on a surface, or at the transmitter;
                for ``uncertainty`` of a field that was fitted to too few receivers to know it.
        """
        seen = sight or self.see(rx, transmitter)
        parts = self.compose(seen)
        delay, aod = strongest(self, seen, parts)
        spectrum = Spectrum(
            path_gain=parts.image.astype(np.float32),
            delay_s=delay,
            aod=aod,
            floor=self.floor,
            range_db=self.range_db,
        )
        return replace(spectrum, std_db=self.std_db(seen, parts)) if uncertainty else spectrum

    def paths(self, rx: Any, transmitter: Any = None, max_paths: int | None = None) -> Paths:
        """Propagation paths at ``rx``: line of sight, mirrors, and one diffuse path per pixel above the floor.

        The sum of ``|gain|^2`` equals the spectrum's sum: what pixels below the floor hold is shared among the diffuse
        paths in proportion. A diffuse path goes over the point that the pixel's strongest ray meets; light that came
        over more surfaces has no path of its own and is counted to that.

        Args:
            rx: receiver position ``(3,)``, or ``(R, 3)`` for arrays ``(R, L)``, padded.
            transmitter: as for :meth:`spectrum`.
            max_paths: keep the strongest only (the sum is then what they carry).

        Raises:
            ValueError: as for :meth:`spectrum`, and for a ``max_paths`` below 1.
        """
        if max_paths is not None and (not isinstance(max_paths, int | np.integer) or max_paths < 1):
            raise ValueError(f"max_paths: got {max_paths!r}, expected a whole number of at least 1, or None")
        positions = check_receiver("rx", rx, self.surface.mesh)
        found = [paths_of(self, self.see(p, transmitter), max_paths) for p in np.atleast_2d(positions)]
        return found[0] if positions.ndim == 1 else Paths.stack(found)

    def std_db(self, sight: Sight, parts: Composed) -> np.ndarray:
        """Standard deviation of the dB image per pixel (H, W); see :mod:`warprrf.rf.fields.bistatic.uncertainty`."""
        if self.errors is None:
            raise ValueError(
                f"uncertainty: this field was fitted to {self.report.get('receivers', 0)} receivers, too few to hold "
                "some out and learn its error from; fit to four or more"
            )
        p, floor = self.parameters.take(np.unique(self.material, return_index=True)[1]), self.floor
        layout = next(
            Layout(*p.log_weight.shape, indirect=self.terms.indirect, gain=g)
            for g in (False, True)
            if Layout(*p.log_weight.shape, indirect=self.terms.indirect, gain=g).size
            == len(self.errors.covariance)
        )
        view = self.view(sight, np.arange(self.shape[0] * self.shape[1])).tied(self.material)
        slopes, index = jacobian(view, p, layout)[1:]
        image = parts.image / floor
        slopes = slopes * (NEPER / (1.0 + image.ravel()))[:, None]
        return self.errors.std_db(NEPER * np.log1p(image), sight.receiver, slopes, index)

    def see(self, rx: Any, transmitter: Any = None, *, paths: SpecularPaths | None = None) -> Sight:
        """What the receiver at ``rx`` (3,) sees of the geometry: the costly part of a spectrum."""
        receiver = check_receiver("rx", check_array("rx", rx, (3,)), self.surface.mesh)
        source = self.transmitter if transmitter is None else check_array("transmitter", transmitter, (3,))
        if np.linalg.norm(receiver - source) == 0:
            raise ValueError("rx: got the transmitter's own position; expected them apart")
        met = self.tracer.meet(receiver)
        lit = self.tracer.light(met, source)
        if paths is None:
            paths = specular_paths(
                self.surface,
                source,
                receiver[None],
                self.wavelength_m,
                order=self.terms.mirror_order,
                tree=self.mirror_tree(source),
                device=self.device,
            )
        beams = unit_beams(paths.arrival, self.shape, self.beam_sigma_rad)
        return Sight(receiver, source, met, lit, paths, beams, self.tracer)

    def compose(self, sight: Sight) -> Composed:
        """The spectrum of what is seen, by its parts."""
        p, gain = self.parameters, np.exp(self.parameters.log_gain)
        strength = self.path_power(sight.paths)
        image = np.tensordot(strength.astype(np.float32), sight.beams, axes=1).astype(np.float64)
        rays = np.zeros(len(self.tracer.solid_angle))
        if self.terms.diffuse:
            rays = gain * self.tracer.scatter(sight.met, sight.lit, p.weight, p.log_excess, self.wavelength_m)
            if self.terms.residual:
                rays = rays * self.texture(np.maximum(sight.met.face.numpy(), 0))
        further = gain * self.further(sight)
        image += self.beam(rays.reshape(*self.shape, -1).sum(axis=-1) + further)
        return Composed(rays, strength, further, np.maximum(image, 0.0))

    def further(self, sight: Sight) -> np.ndarray:
        """Path gain per pixel (H, W), before the beam, of everything after a first bounce."""
        out = np.zeros(self.shape[0] * self.shape[1])
        for pixel, face, power in self.sent_on(sight):
            if self.terms.residual:
                power = power * self.texture(face, sight.transmitter)
            out += np.bincount(pixel, power, minlength=len(out))
        return out.reshape(self.shape) + self._mirrored_scene(sight)

    def further_by_group(self, sight: Sight, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What :meth:`further` is made of, after the beam, at ``pixels`` (N,).

        Returns:
            The groups that send it (B,), their images (N, B), and what mirrors show besides (N,).
        """
        count = self.shape[0] * self.shape[1]
        parts = [(pixel, self.surface.group[face], power) for pixel, face, power in self.sent_on(sight)]
        found = np.unique(np.concatenate([np.zeros(0, int), *(np.unique(group) for _, group, _ in parts)]))
        column = np.zeros(self.surface.groups, int)
        column[found] = np.arange(len(found))
        images = np.zeros((count, len(found)))
        for pixel, group, power in parts:
            cell = pixel * len(found) + column[group]
            images += np.bincount(cell, power, minlength=images.size).reshape(images.shape)
        shown = self._mirrored_scene(sight).reshape(-1, 1)
        return found, self.beam.at(pixels, images), self.beam.at(pixels, shown)[:, 0]

    def texture(self, face: np.ndarray, sent_on_from: np.ndarray | None = None) -> np.ndarray:
        """Gain of each face (K,) over its group: for single bounces, or for light that it sends on.

        Args:
            face: faces of :attr:`surface`.
            sent_on_from: the transmitter (3,) whose light is sent on. Light of another than the fitted one falls
                elsewhere: of that nothing was learned, so its gains are 1.
        """
        if sent_on_from is None:
            return np.asarray(np.exp(self.residual[0]))[self.surface.texel[face]]
        if not np.array_equal(sent_on_from, self.transmitter):
            return np.ones(len(face))
        return np.asarray(np.exp(self.residual[1]))[self.surface.texel[face]]

    def sent_on(self, sight: Sight) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Pixel, face and path gain of light that faces got from other surfaces and send on, without the residual."""
        parts = []
        sent = self.sent(sight.transmitter)
        if sent is not None:
            seen = sight.surface
            power = seen.power(sent[self.surface.element[seen.face]], self.wavelength_m)
            lit = power > 0
            parts.append((seen.pixel[lit], seen.face[lit], power[lit]))
        if self.terms.diffuse and self.terms.mirror_scatter:
            light = self.element_light(sight.transmitter).mirrors
            mirrored = sight.mirrored(light)
            power = light.power(mirrored, self.parameters, self.wavelength_m)
            parts.append((mirrored.pixel, mirrored.face.numpy(), power))
        return parts

    def _mirrored_scene(self, sight: Sight) -> np.ndarray:
        """Path gain per pixel (H, W), before the beam, of the lit scene that mirrors show."""
        if not (self.terms.diffuse and self.terms.scatter_mirror):
            return np.zeros(self.shape)
        return mirrored_scene(
            self._mirror_tracer, sight.receiver, sight.transmitter, self.parameters, self.wavelength_m,
            self.sent(sight.transmitter),
        )  # fmt: skip

    def view(self, sight: Sight, pixels: np.ndarray, target_db: np.ndarray | None = None) -> View:
        """The sight as linear maps from group parameters to ``pixels`` (N,), for :mod:`warprrf.rf.fields.bistatic.fit`."""
        count, groups = self.shape[0] * self.shape[1], self.surface.groups
        lit, images = self.tracer.resolve(sight.met, sight.lit, self.wavelength_m)
        columns = self.beam.at(pixels, images.reshape(count, -1)) / np.float32(self.floor)
        basis = columns.reshape(len(pixels), *images.shape[1:])
        strong = np.abs(basis).max(axis=(0, 2, 3), initial=0.0) > NEGLIGIBLE
        face = sight.met.face.numpy()
        met = np.flatnonzero(face >= 0)
        rays = (self.wavelength_m / (4.0 * np.pi)) ** 2 * self.tracer.solid_angle[met] / self.floor
        rays = rays * self.tracer.through_air(sight.met.range_m.numpy()[met])
        cell = (met // self.tracer.sub_pixels**2) * groups + self.surface.group[face[met]]
        dark = np.bincount(cell, rays, minlength=count * groups).reshape(count, groups)
        visible = np.flatnonzero(dark.any(axis=0))
        dark = self.beam.at(pixels, dark[:, visible])
        gain = (
            (self.wavelength_m / (4.0 * np.pi * sight.paths.length_m)) ** 2
            * sight.paths.share**2
            * self.tracer.through_air(sight.paths.length_m)
            / self.floor
        )
        return View(
            groups=lit[strong],
            basis=np.ascontiguousarray(basis[:, strong]),
            seen=visible,
            dark=dark,
            gain=gain,
            path_group=self._met_groups(sight.paths),
            cosine=sight.paths.cosine,
            turn=sight.paths.turn,
            beam=sight.beams.reshape(len(gain), count)[:, pixels],
            extra=np.zeros(len(pixels), np.float32),
            again_group=np.zeros(0, int),
            again=np.zeros((len(pixels), 0), np.float32),
            target_db=np.zeros(len(pixels)) if target_db is None else target_db.ravel()[pixels],
        )

    # ------------------------------------------------------------------------------------------ files

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go: surface, parameters, terms, report."""
        files.write(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: Any = None) -> BistaticField:
        """Read a field that :meth:`save` wrote; errors as for :meth:`RadioField.load`."""
        return cls(**files.read(path), device=device)

    # ------------------------------------------------------------------------------------------ parts

    @property
    def mesh(self) -> Mesh:  # type: ignore[override]
        """What blocks."""
        return self.surface.mesh

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @cached_property
    def tracer(self) -> BounceTracer:
        """Rays of the grid on the surface."""
        return self.tracer_of(self.shape, self.terms.sub_pixels)

    def tracer_of(self, shape: tuple[int, int], sub_pixels: int) -> BounceTracer:
        """Rays of a grid of ``shape`` on the surface, ``sub_pixels`` squared a pixel."""
        loss = 0.0 if self.air is None else self.air.loss_per_m(self.frequency_hz)
        return BounceTracer(
            self.surface, shape, lobes=self.terms.lobes, sub_pixels=sub_pixels, loss_per_m=loss, device=self.device
        )  # fmt: skip

    @cached_property
    def beam(self) -> BeamOperator:
        """The receiver beam."""
        return BeamOperator(self.shape, self.beam_sigma_rad, device=self.device)

    @cached_property
    def _mirror_tracer(self) -> BounceTracer:
        return self.tracer_of(self.shape, MIRRORED_SUB_PIXELS)

    @cached_property
    def _element_light(self) -> dict[bytes, ElementLight]:
        return {}

    @cached_property
    def _radiance(self) -> dict[bytes, np.ndarray]:
        return {}

    @cached_property
    def _mirror_trees(self) -> dict[bytes, MirrorTree]:
        return {}

    def mirror_tree(self, transmitter: np.ndarray) -> MirrorTree | None:
        """Chains of mirrors that ``transmitter`` may be seen in, found once; None where one mirror is the most."""
        if self.terms.mirror_order < 2:
            return None
        key = np.asarray(transmitter, np.float64).tobytes()
        if key not in self._mirror_trees:
            self._mirror_trees[key] = MirrorTree(self.surface, transmitter, self.terms.mirror_order)
        return self._mirror_trees[key]

    def element_light(self, transmitter: np.ndarray) -> ElementLight:
        """How ``transmitter`` lights the elements by way of others, traced once."""
        key = np.asarray(transmitter, np.float64).tobytes()
        if key not in self._element_light:
            self._element_light[key] = ElementLight(self.tracer, transmitter, self.wavelength_m)
        return self._element_light[key]

    def sent(self, transmitter: np.ndarray) -> np.ndarray | None:
        """Radiance (E,) that elements send on besides first bounces [1/(m^2 sr)], None where there is none."""
        if not (self.terms.further or self.terms.indirect):
            return None
        key = np.asarray(transmitter, np.float64).tobytes()
        if key not in self._radiance:
            sent = np.zeros(len(self.surface.element_area))
            if self.terms.further:
                light = self.element_light(transmitter)
                sent += light.radiance(
                    self.parameters, mirrors=self.terms.mirror_scatter, diffuse=self.terms.diffuse_order - 1
                )
            if self.terms.indirect:
                sent += np.exp(self.parameters.log_indirect)[self.surface.element_group]
            self._radiance[key] = sent
        return self._radiance[key]

    def path_power(self, paths: SpecularPaths) -> np.ndarray:
        """Power of each line-of-sight and mirror path, shape ``(L,)``."""
        base = (self.wavelength_m / (4.0 * np.pi * paths.length_m)) ** 2 * paths.share**2
        base = base * self.tracer.through_air(paths.length_m)
        groups = self._met_groups(paths)
        power = specular_power(base, groups, paths.cosine, paths.turn, self.parameters)[0]
        power = power * np.exp(self.parameters.log_gain)
        kept = (paths.order <= self.terms.mirror_order) & ((paths.order > 0) | self.terms.line_of_sight)
        return np.where(kept, power, 0.0)

    def _met_groups(self, paths: SpecularPaths) -> np.ndarray:
        """Groups that each path meets (L, 3), -1 where fewer."""
        known = paths.patch >= 0
        owner = self.surface.patch_group
        return np.where(known, owner[np.where(known, paths.patch, 0)] if len(owner) else -1, -1)
