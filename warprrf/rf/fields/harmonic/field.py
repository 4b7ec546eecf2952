"""Radio fields on frozen Gaussians: RF-3DGS+ and RF-3DGS, fitted to spectra and queried at any receiver.

``rf3dgs+`` follows Song et al., "Terahertz Spatial Wireless Channel Modeling with Radio Radiance Field", eq. (2)-(4),
single bounce: a pixel holds

    P = Omega sum_k alpha_k T_k A_k(d) (lambda / (4 pi (l_prev + l_vd)))^2

with Omega the pixel's solid angle, d the ray's direction, l_prev and l_vd the distances of the ray's interaction point
from transmitter and receiver. ``rf3dgs`` has no lengths; its delay and angle of departure are channels of their own,
blended plainly and trained on delay and AoD spectra. The paper leaves the gain's domain open; ours: A = exp(SH), or
max(0, SH) with ``gain="linear"``, SH of degree 3; loss 0.8 L1 + 0.2 (1 - SSIM) on the dB image. Delay and AoD are
those of the single bounce, in float64; for ``rf3dgs+`` the pixels around a transmitter that the mesh lets be seen carry
those of the line of sight, although the paper's surfaces must carry its power. Absorption by the air is that of the path's
length; ``rf3dgs``, which has none, learns it with the gain.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.cache import Cache
from warprrf.checks import (
    Expected,
    Positive,
    check_array,
    check_arrays,
    check_type,
    checked,
    one_line,
    within,
)
from warprrf.device import DeviceLike, Progress, launch, silent
from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh
from warprrf.geometry.splats.gaussians import Gaussians, discs_on_mesh, gaussians_of
from warprrf.geometry.splats.rasterizer import Parameters, Rasterizer
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.kernels.radio import transport as _rays
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import RadioField, with_settings
from warprrf.rf.fields.harmonic import fitting
from warprrf.rf.fields.harmonic.fitting import CHANNEL_RATES, GAIN_RATES, FieldOptions
from warprrf.rf.fields.harmonic.opacity import OpacityTraining, list_responses
from warprrf.rf.fields.harmonic.paths import View, near_line_of_sight, paths_of
from warprrf.rf.fields.harmonic.problem import Problem, harmonics
from warprrf.rf.fields.harmonic.transport import Transport, transport
from warprrf.rf.paths.trace import Paths
from warprrf.rf.positions import Ends, check_dataset, warn_of_unmodelled
from warprrf.rf.spectra.dataset import SpectrumDataset, question_spectra
from warprrf.rf.spectra.spectrum import (
    Spectrum,
    angles_from_directions,
    pixel_directions,
    pixel_solid_angles,
    spread,
)
from warprrf.steps import digest

LAYERS = {"rf3dgs+": ("gain",), "rf3dgs": ("gain", "delay", "aod_x", "aod_y", "aod_z")}
"""Layers that each model may have."""


@checked
@dataclass(frozen=True, eq=False)
class HarmonicField(RadioField):
    """A radio field of spherical harmonics per Gaussian; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        gaussians: frozen geometry.
        options: what it computes.
        layers: coefficients per Gaussian, shape ``(N, 16)`` float32: ``gain``, and for ``rf3dgs`` ``delay`` and
            ``aod_x``, ``aod_y``, ``aod_z``.
        gain_unit: linear factor of the gain layer.
        delay_unit: seconds per unit of the delay layer.
        mesh: surface for line of sight; None if the geometry has none.

    The others are those of :class:`RadioField`. ``rf3dgs`` has lengths, for ``air`` to absorb over, of an explicit line of
    sight alone, and learns the rest with the gain.
    """

    __repr__ = one_line

    gaussians: Gaussians
    options: FieldOptions
    layers: dict[str, np.ndarray]
    gain_unit: Positive
    delay_unit: Annotated[float, within(0.0, 1.0)]
    mesh: Mesh | None = None
    _uploaded: Cache = field(init=False, default_factory=lambda: Cache(8))

    def __post_init__(self) -> None:
        super().__post_init__()
        known, aod = set(LAYERS[self.model]), {"aod_x", "aod_y", "aod_z"}
        if not set(self.layers) <= known or aod & set(self.layers) not in (set(), aod):
            raise ValueError(f"layers: got {', '.join(self.layers)}, expected {', '.join(sorted(known))}")
        most_coefficient = 1e9
        table = Expected(f"N {_kernels.COEFFICIENTS}", -most_coefficient, most_coefficient)
        check_arrays(self.layers, dict.fromkeys(self.layers, table), N=len(self.gaussians))

    @property
    def model(self) -> str:
        """Name of the model."""
        return self.options.model

    @classmethod
    def fit(  # type: ignore[override]
        cls,
        geometry: GeometryLike | Gaussians,
        ds: SpectrumDataset,
        model: str = "rf3dgs+",
        *,
        options: FieldOptions | None = None,
        transport: Transport | None = None,
        device: DeviceLike = None,
        progress: Progress | None = None,
        **settings: Any,
    ) -> HarmonicField:
        """Fit a radio field to the spectra of ``ds``.

        Args:
            geometry: anything with ``.gaussians`` and ``.mesh`` (a Reconstruction); a Scene or Mesh is covered with
                discs first.
            ds: training set.
            model: ``"rf3dgs+"`` or ``"rf3dgs"``.
            options: what the field computes and how it is fitted.
            transport: blending weights of ``ds.receivers``, if they were computed before.
            device: where to compute.
            progress: called with the stages ``"transport"`` and ``"fit"``.
            settings: attributes of :class:`~warprrf.rf.fields.harmonic.fitting.FieldOptions`, in place of those of
                ``options``: ``gain="linear"``, ``iterations=600``, ``seed=1``, ...

        Raises:
            TypeError: if ``geometry`` has no Gaussians and is no mesh, or for an unknown option.
            ValueError: for an option's value that is not allowed, receivers that are not inside the scene, spectra
                without power, or a checkpoint of another fit.
        """
        if not (hasattr(ds, "path_gain") and hasattr(ds, "transmitter")):
            raise TypeError(
                f"ds: got {type(ds).__name__}, expected a SpectrumDataset: model {model!r} is fitted to whole spectra; "
                'a model="bistatic" takes readings and arrays too'
            )
        chosen = with_settings(options or FieldOptions(), {**settings, "model": model})
        started = time.perf_counter()
        gaussians, mesh = _geometry(geometry)
        question_spectra(ds)
        check_dataset(mesh, ds, device=device)
        receivers, transmitter = ds.receivers, ds.transmitter
        warn_of_unmodelled(mesh, transmitter, receivers, frequency_hz=ds.frequency_hz, device=device)
        if mesh is None and (chosen.line_of_sight == "explicit" or chosen.interaction_point == "mesh"):
            raise ValueError('line_of_sight="explicit" and interaction_point="mesh" need a mesh; got none')
        images = check_array("ds.path_gain", ds.path_gain, (len(receivers), None, None))
        blank = cls(
            gaussians=gaussians,
            mesh=mesh,
            transmitter=transmitter,
            **{n: getattr(ds, n) for n in ("frequency_hz", "floor", "range_db", "beam_sigma_rad")},
            shape=images.shape[1:],
            options=replace(chosen, checkpoint=None),
            layers={},
            gain_unit=1.0,
            delay_unit=1.0,
            air=getattr(ds, "air", None),
            fitted_on=receivers.copy(),
            device=device,
        )
        seen = blank._seen_from(receivers, progress) if transport is None else transport
        rule = chosen.transmittance
        got, wanted = (seen.shape, seen.rule, seen.gaussians), (blank.shape, rule, len(gaussians))
        if got != wanted or not np.array_equal(seen.receivers, receivers):
            raise ValueError(
                f"transport: got weights of {len(seen.receivers)} receivers, (shape, rule, Gaussians) = {got}; expected those "
                f"of exactly the {len(receivers)} receivers of ds, {wanted}"
            )
        ready = time.perf_counter()
        trained = _train(blank, ds, images, seen.on(device), checkpoint=chosen.checkpoint, progress=progress)
        report = {
            "receivers": len(images),
            "transport_time_s": 0.0 if transport is not None else ready - started,
            "fit_time_s": time.perf_counter() - ready,
            **trained.report,
        }
        return replace(trained, report=report)

    def with_gas(self, gas: Gas = True) -> HarmonicField:
        """The same field with the absorption of ``gas``; see :meth:`RadioField.with_gas`."""
        air = air_of(gas, self.frequency_hz)
        if air != self.air and self.options.model == "rf3dgs":
            raise ValueError(
                f"gas: got {gas!r}, but an rf3dgs field knows no lengths and holds what absorption its spectra had; "
                'fit model="rf3dgs+", or fit again'
            )
        return replace(self, air=air)

    def check_positions(
        self, receivers: ArrayLike, transmitter: ArrayLike | None = None, *, name: str = "receivers"
    ) -> Ends:
        """As :meth:`RadioField.check_positions`; ValueError also for another transmitter of an ``rf3dgs`` field."""
        ends = super().check_positions(receivers, transmitter, name=name)
        other = ends.transmitters[(ends.transmitters != self.transmitter).any(axis=1)]
        if self.options.model == "rf3dgs" and len(other):
            raise ValueError(
                f"transmitter: got {other[0].tolist()}, but an rf3dgs field holds only for the one it was fitted for, "
                f'{self.transmitter.tolist()}; fit model="rf3dgs+", which recomputes lengths, or fit again'
            )
        return ends

    def _trace_spectrum(self, receiver: np.ndarray, transmitter: np.ndarray) -> Spectrum:
        return self._view_from(receiver, transmitter).spectrum

    def _trace_paths(self, receiver: np.ndarray, transmitter: np.ndarray, max_paths: int | None) -> Paths:
        """At least one diffuse path is kept to carry what is below the floor. With ``line_of_sight="explicit"`` the ``los``
        path carries Friis gain; without, the power of the pixels within 3 beam sigmas of the transmitter's direction,
        merged. Direction and delay of ``los`` are exact; a diffuse path arrives from its pixel's centre."""
        view = self._view_from(receiver, transmitter)
        return replace(paths_of(view, self.beam_sigma_rad, self.frequency_hz, max_paths), air=self.air)

    def _taken_apart(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        tensors = {f"layer/{name}": table for name, table in self.layers.items()}
        tensors |= {f"gaussians/{f.name}": getattr(self.gaussians, f.name) for f in fields(Gaussians)}
        if self.mesh is not None:
            tensors["mesh/vertices"], tensors["mesh/faces"] = self.mesh.vertices, self.mesh.faces
        header = {"gain_unit": self.gain_unit, "delay_unit": self.delay_unit, "options": asdict(self.options)}
        return tensors, header

    @classmethod
    def _put_together(cls, tensors: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, Any]:
        layers = {n.removeprefix("layer/"): t for n, t in tensors.items() if n.startswith("layer/")}
        if "gain" not in layers:
            raise ValueError("it has no layer of gain")
        held = "mesh/faces" in tensors
        return {
            "gaussians": Gaussians(**{f.name: tensors[f"gaussians/{f.name}"] for f in fields(Gaussians)}),
            "mesh": Mesh(tensors["mesh/vertices"], tensors["mesh/faces"]) if held else None,
            "options": FieldOptions(**header["options"]),
            "layers": layers,
            **{name: header[name] for name in ("gain_unit", "delay_unit")},
        }

    def _on_device(self) -> Parameters:
        return self._uploaded.get("gaussians", lambda: Rasterizer(device=self.device).upload(self.gaussians))

    def _bounces(self, seen: Transport, transmitter: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Where the rays of each receiver's pixels are taken to interact [m], ``(H, W, 3)``, and how long the paths over there are
        [m], ``(H, W)``; NaN where a ray meets nothing.

        One point stands for the whole ray, as in the paper: the centre of the Gaussian that contributes most (``"centre"``), the
        peak of that Gaussian's response on the ray (``"peak"``), the blended mean of all peaks (``"expected"``), or the mesh hit
        (``"mesh"``; ``"peak"`` for a ray that misses it). In float64: at 300 GHz a wavelength is 1 mm.
        """
        kind, device = self.options.interaction_point, seen.device
        if kind == "mesh" and self.mesh is None:
            raise ValueError('interaction_point: got "mesh", but the geometry has no mesh; use "peak"')
        toward = pixel_directions(self.shape).reshape(-1, 3)
        directions = self._uploaded.get("directions", lambda: wp.array(toward, dtype=wp.vec3d, device=device))
        how = _rays.CENTRE if kind == "centre" else _rays.ALONG
        for origin, view in zip(seen.receivers, seen.views, strict=True):
            ranges: Any = view.expected_range if kind == "expected" else np.zeros(0)
            if self.mesh is not None and kind == "mesh":
                ranges = self.mesh.cast(origin, toward, device=device).t
            points, lengths = (wp.empty(len(toward), dtype=t, device=device) for t in (wp.vec3d, wp.float64))
            inputs = [how, wp.vec3d(origin), wp.vec3d(transmitter), directions, *self._on_device()[:3]]
            inputs += [view.dominant, ranges, points, lengths]
            launch(_rays.single_bounces, len(toward), inputs, device=device)
            yield points.numpy().reshape(*self.shape, 3), lengths.numpy().reshape(self.shape)

    def _factor(self, length: np.ndarray) -> np.ndarray:
        """Solid angle [sr], times spreading loss for ``rf3dgs+``, of pixels whose paths are of ``length`` (..., H, W) [m];
        zero where the ray meets nothing."""
        loss = np.isfinite(length) if self.model == "rf3dgs" else self._free_space(length)
        return np.nan_to_num(pixel_solid_angles(self.shape)[:, None] * loss, posinf=0.0)

    def _line_of_sight(
        self, receiver: np.ndarray, transmitter: np.ndarray
    ) -> tuple[float, np.ndarray | None]:
        """Friis gain, less absorption, 0 where the mesh does not let them see each other; and its beam on the grid, if the model
        has an explicit line of sight."""
        visible = self.mesh is not None and self.mesh.visible(receiver, transmitter, device=self.device)[0]
        toward = transmitter - receiver
        gain = float(self._free_space(float(np.linalg.norm(toward)))) if visible else 0.0
        if self.options.line_of_sight != "explicit":
            return gain, None
        return gain, spread(toward[None], [gain], self.shape, self.beam_sigma_rad, device=self.device)

    def _free_space(self, length_m: float | np.ndarray) -> float | np.ndarray:
        """Gain of a path of ``length_m`` [m] between isotropic antennas, less what the air absorbs."""
        with np.errstate(divide="ignore"):
            gain = (self.wavelength_m / (4 * np.pi * length_m)) ** 2
        return gain if self.air is None else gain * self.air.transmittance(self.frequency_hz, length_m)

    def _seen_from(self, receivers: np.ndarray, progress: Progress | None) -> Transport:
        """Blending weights of ``receivers`` (R, 3)."""
        return transport(
            self.gaussians, receivers, self.shape, range_db=self.range_db, rule=self.options.transmittance,
            top_k=self.options.top_k, device=self.device, uploaded=self._on_device(), progress=progress,
        )  # fmt: skip

    def _blend(self, name: str, seen: Transport) -> np.ndarray:
        """The blended layer ``name`` of one receiver, shape ``(H, W)`` float64."""
        device, (view,) = seen.device, seen.views
        kernels = _kernels.build(wp.float32)
        kind = fitting.KINDS[self.options.gain if name == "gain" else "signed"]
        out = wp.zeros(self.shape[0] * self.shape[1], dtype=float, device=device)
        basis = self._uploaded.get("basis", lambda: harmonics(self.shape, wp.float32, device))
        upload = partial(wp.array, self.layers[name], dtype=kernels.vec16, device=device)
        layer = self._uploaded.get(name, upload)
        inputs = [kind, view.start, view.gaussian, view.weight, basis, layer, out]
        launch(kernels.predict, len(out), inputs, device=device)
        return out.numpy().reshape(self.shape).astype(np.float64)

    def _view_from(self, receiver: np.ndarray, source: np.ndarray) -> View:
        """Spectrum at one receiver and what it was made of."""
        seen = self._seen_from(receiver[None], None)
        friis, beam = self._line_of_sight(receiver, source)
        ((point, length),) = self._bounces(seen, source)
        power = self._factor(length) * self.gain_unit * self._blend("gain", seen)
        delay = length / SPEED_OF_LIGHT
        departure = point - source
        if self.options.model == "rf3dgs":
            point = np.full_like(point, np.nan)
            delay, departure = self._channels(seen)
        angles = np.stack(angles_from_directions(departure), axis=-1)
        direct = np.zeros(self.shape, dtype=bool)
        if beam is not None:
            direct, power = beam > power, power + beam
        elif friis > 0 and self.options.model == "rf3dgs+":
            direct = near_line_of_sight(receiver, source, self.shape, self.beam_sigma_rad)
        toward = receiver - source
        soonest = np.where(direct, np.linalg.norm(toward) / SPEED_OF_LIGHT, delay)
        aod = np.where(direct[..., None], np.stack(angles_from_directions(toward)), angles)
        spectrum = Spectrum(power.astype(np.float32), soonest, aod, self.floor, self.range_db)
        return View(spectrum, receiver, source, point, delay, angles, friis, beam)

    def _channels(self, seen: Transport) -> tuple[np.ndarray, np.ndarray]:
        """Learned delay [s] and vector of departure; NaN where a ray meets nothing or nothing was learned."""
        met = seen.dominant[0] >= 0

        def learned(name: str) -> np.ndarray:
            return np.where(met, self._blend(name, seen) if name in self.layers else np.nan, np.nan)

        departure = np.stack([learned(f"aod_{axis}") for axis in "xyz"], axis=-1)
        return np.maximum(learned("delay"), 0.0) * self.delay_unit, departure


def _geometry(geometry: GeometryLike | Gaussians) -> tuple[Gaussians, Mesh | None]:
    if isinstance(geometry, Gaussians):
        return geometry, None
    gaussians = gaussians_of(geometry)
    if gaussians is None:
        mesh = as_mesh(geometry, "geometry")
        return discs_on_mesh(mesh), mesh
    check_type("geometry.gaussians", gaussians, Gaussians)
    if len(gaussians) == 0:
        raise ValueError("geometry: got no Gaussians, expected at least one")
    return gaussians, getattr(geometry, "mesh", None) if getattr(geometry, "has_mesh", True) else None


def _train(
    blank: HarmonicField,
    ds: SpectrumDataset,
    images: np.ndarray,
    seen: Transport,
    *,
    checkpoint: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> HarmonicField:
    """``blank`` with layers that are fitted to ``images`` (R, H, W), and a report of losses and sizes."""
    options, gaussians, device = blank.options, blank.gaussians, blank.device
    listed = None
    if options.train_opacity:
        listed = list_responses(gaussians, seen, ds.range_db, progress=progress)
        seen = listed.transport
    factor = blank._factor(np.stack([length for _, length in blank._bounces(seen, blank.transmitter)]))
    extra = np.zeros_like(factor)
    if options.line_of_sight == "explicit":
        extra[:] = [blank._line_of_sight(receiver, blank.transmitter)[1] for receiver in seen.receivers]
    problem = Problem(seen, batch=options.batch, seed=options.seed, device=device)
    plan, gain_unit, delay_unit = fitting.targets(options, ds, images, problem, factor, extra)
    channel_steps = 100  # of each delay and AoD channel: they start at means that are nearly right
    steps = {
        name: options.iterations if name == "gain" else min(channel_steps, options.iterations)
        for name in plan
    }
    identity = "" if checkpoint is None else digest(options, seen.values, plan)
    states, before = fitting.load_states(checkpoint, identity), 0
    layers: dict[str, np.ndarray] = {}

    def each(name: str, done: int, state: Callable[[], fitting.State]) -> None:
        """What follows each step of a layer: progress, and now and then the checkpoint."""
        (progress or silent)("fit", before + done, sum(steps.values()))
        if checkpoint is not None and (done % 50 == 0 or done == steps[name]):
            states[name] = state()
            fitting.save_states(checkpoint, identity, states)

    for name, target in plan.items():
        is_gain, state, opacity = name == "gain", states.get(name), None
        if listed is not None and is_gain:
            logits = None if state is None else state.opacity
            opacity = OpacityTraining(problem, listed, gaussians.opacities, logits)
        states[name] = state = fitting.fit_layer(
            problem, target, steps=steps[name], rates=GAIN_RATES if is_gain else CHANNEL_RATES,
            degree=options.sh_degree, opacity=opacity, state=state, each=partial(each, name),
        )  # fmt: skip
        before += steps[name]
        layers[name] = np.zeros((len(gaussians), _kernels.COEFFICIENTS), np.float32)
        layers[name][:, 0] = target.unseen
        unit = 1.0 if target.unit is None else target.unit[:, None]
        layers[name][problem.seen] = state.coefficients * unit
        if listed is not None and opacity is not None:
            trained = np.array(gaussians.opacities, np.float32)
            trained[problem.seen] = opacity.opacities
            gaussians = replace(gaussians, opacities=trained)
            # Channels are blended with the opacities that the gain has found.
            seen_now = listed.with_opacities(trained)
            problem = Problem(seen_now, batch=options.batch, seed=options.seed, device=device)
    if checkpoint is not None:
        Path(checkpoint).unlink(missing_ok=True)
    report = {
        "gaussians": len(gaussians),
        "gaussians_seen": len(problem.seen),
        "iterations": options.iterations,
        "seed": options.seed,
        "train_opacity": options.train_opacity,
        "losses": {name: states[name].losses.tolist() for name in plan},
    }
    return replace(
        blank,
        gaussians=gaussians,
        layers=layers,
        gain_unit=gain_unit,
        delay_unit=delay_unit,
        report=report,
    )
