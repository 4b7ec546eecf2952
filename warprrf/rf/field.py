"""Radio fields on frozen Gaussians: RF-3DGS+ and RF-3DGS, fitted to spectra and queried at any receiver.

``rf3dgs+`` follows Song et al., "Terahertz Spatial Wireless Channel Modeling with Radio Radiance Field", eq. (2)-(4),
single bounce: a pixel holds

    P = Omega sum_k alpha_k T_k A_k(d) (lambda / (4 pi (l_prev + l_vd)))^2

with Omega the pixel's solid angle, d the ray's direction, l_prev and l_vd the distances of the ray's interaction point
from transmitter and receiver. ``rf3dgs`` has no lengths; its delay and angle of departure are channels of their own,
blended plainly and trained on delay and AoD spectra. The paper leaves the gain's domain open; ours: A = exp(SH), or
max(0, SH) with ``gain="linear"``, SH of degree 3; loss 0.8 L1 + 0.2 (1 - SSIM) on the dB image. Delay and AoD are those
of the single bounce (float64); the transmitter's line of sight is separated in :meth:`RadioField.paths`.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.device import Progress, check_array
from warprrf.geometry.discs import discs_on_mesh
from warprrf.geometry.gaussians import Gaussians
from warprrf.geometry.mesh import Mesh
from warprrf.kernels import field as _kernels
from warprrf.kernels.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf import field_files
from warprrf.rf import transport as _transport
from warprrf.rf.fitting import KINDS, Problem, Rates, State, Target, fit_layer, harmonics
from warprrf.rf.fresnel import SPEED_OF_LIGHT
from warprrf.rf.paths import Paths
from warprrf.rf.spectrum import (
    Spectrum,
    angles_from_directions,
    pixel_directions,
    pixel_of,
    pixel_solid_angles,
    spread,
    to_db,
)
from warprrf.rf.transport import Lengths, Transport

if TYPE_CHECKING:
    from warprrf.rf.dataset import SpectrumDataset

MODELS = ("rf3dgs+", "rf3dgs")
GAINS = ("exp", "linear")
STEPS = 400  # optimiser steps; the loss is flat well before
CHANNEL_STEPS = 200  # of each delay and AoD channel
BEAM_REACH = 3.0  # pixels within so many beam sigmas of a visible transmitter are its line of sight
Y00 = 0.28209479177387814  # harmonic of degree 0


@dataclass(frozen=True)
class FieldOptions:
    """What a field computes; see :meth:`RadioField.fit`."""

    model: str = "rf3dgs+"
    transmittance: str = "product"
    interaction_point: str = "centre"
    gain: str = "exp"
    sh_degree: int = 3
    top_k: int = _transport.TOP_K
    line_of_sight: str | None = None

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            later = "; the bistatic model is not in this version" if self.model == "bistatic" else ""
            raise ValueError(f"model: got {self.model!r}, expected one of {', '.join(MODELS)}{later}")
        for name, known in (
            ("transmittance", _transport.TRANSMITTANCE),
            ("interaction_point", _transport.INTERACTION_POINTS),
            ("gain", GAINS),
            ("sh_degree", tuple(DEGREE_TO_COUNT)),
            ("line_of_sight", (None, "explicit")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected one of {known}")
        if not isinstance(self.top_k, int | np.integer) or self.top_k < 1:
            raise ValueError(f"top_k: got {self.top_k!r}, expected a whole number of at least 1")


@dataclass(frozen=True, eq=False)
class RadioField:
    """A fitted radio field; build it with :meth:`fit` or :meth:`load`.

    Attributes:
        gaussians: frozen geometry.
        mesh: surface for line of sight; None if the geometry has none.
        transmitter: position it was fitted for [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        shape: rows and columns of its spectra.
        floor, range_db, beam_sigma_rad: of the data set it was fitted to.
        options: what it computes.
        layers: coefficients per Gaussian, shape ``(N, 16)`` float32: ``gain``, and for ``rf3dgs`` ``delay`` and
            ``aod_x``, ``aod_y``, ``aod_z``.
        gain_unit: linear factor of the gain layer.
        delay_unit: seconds per unit of the delay layer.
        report: how the fit went: seconds, pairs, losses, Gaussians seen.
    """

    gaussians: Gaussians = field(repr=False)
    mesh: Mesh | None = field(repr=False)
    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    floor: float
    range_db: tuple[float, float]
    beam_sigma_rad: float
    options: FieldOptions
    layers: dict[str, np.ndarray] = field(repr=False)
    gain_unit: float
    delay_unit: float
    report: dict[str, Any] = field(default_factory=dict, repr=False)
    device: Any = field(default=None, repr=False)
    _uploaded: dict[str, wp.array] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def fit(
        cls,
        geometry: Any,
        ds: SpectrumDataset,
        model: str = "rf3dgs+",
        *,
        transmittance: str = "product",
        interaction_point: str = "centre",
        gain: str = "exp",
        sh_degree: int = 3,
        top_k: int = _transport.TOP_K,
        line_of_sight: str | None = None,
        iterations: int = STEPS,
        batch: int = 10,
        rates: Rates | None = None,
        transport: Transport | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        seed: int = 0,
        device: Any = None,
        progress: Progress | None = None,
    ) -> RadioField:
        """Fit a radio field to the spectra of ``ds``.

        Args:
            geometry: anything with ``.gaussians`` and ``.mesh`` (a Reconstruction); a Scene or Mesh is covered with
                discs first.
            ds: training set.
            model: ``"rf3dgs+"`` or ``"rf3dgs"``.
            transmittance: ``"product"`` of (1 - alpha), or the paper's ``"exp"`` of minus the sum of alphas.
            interaction_point: ``"centre"`` of the dominant Gaussian (the paper), ``"peak"``, ``"expected"``, ``"mesh"``.
            gain: ``"exp"`` of the harmonics or ``"linear"``, clamped at zero.
            sh_degree: 0 to 3.
            top_k: Gaussians kept per pixel.
            line_of_sight: None (the paper: surfaces must carry it), or ``"explicit"``: Friis gain where the mesh lets
                the transmitter be seen, spread by the data set's beam.
            iterations: optimiser steps of the gain layer, ``batch`` receivers each.
            batch: receivers per step.
            rates: learning rates and ridge.
            transport: blending weights of ``ds.receivers``, if they were computed before.
            checkpoint: file to save progress to and go on from; removed when the fit is done.
            seed: of the batches.
            device: where to compute.
            progress: called with the stages ``"transport"`` and ``"fit"``.

        Raises:
            TypeError: if ``geometry`` has no Gaussians and is no mesh.
            ValueError: for an unknown option, receivers that are not inside the scene, spectra without power, or a
                checkpoint of another fit.
        """
        options = FieldOptions(
            model, transmittance, interaction_point, gain, int(sh_degree), int(top_k), line_of_sight
        )
        if not isinstance(iterations, int | np.integer) or iterations < 0:
            raise ValueError(f"iterations: got {iterations!r}, expected a whole number of steps, 0 or more")
        started = time.perf_counter()
        gaussians, mesh = _geometry(geometry)
        _transport.check_receiver("ds.receivers", np.asarray(ds.receivers, np.float64), mesh)
        if mesh is None and (line_of_sight == "explicit" or interaction_point == "mesh"):
            raise ValueError(
                'line_of_sight="explicit" and interaction_point="mesh" need a mesh; the geometry has none'
            )
        images = check_array("ds.path_gain", ds.path_gain, (len(ds.receivers), None, None), np.float64)
        shape = (images.shape[1], images.shape[2])
        seen = transport
        if seen is None:
            seen = _transport.transport(
                gaussians, ds.receivers, shape, range_db=ds.range_db, rule=transmittance, top_k=top_k,
                device=device, progress=progress,
            )  # fmt: skip
        _check_transport(seen, np.asarray(ds.receivers, np.float64), shape, transmittance)
        blank = cls(
            gaussians=gaussians,
            mesh=mesh,
            transmitter=check_array("ds.transmitter", ds.transmitter, (3,)),
            frequency_hz=float(ds.frequency_hz),
            shape=shape,
            floor=float(ds.floor),
            range_db=(float(ds.range_db[0]), float(ds.range_db[1])),
            beam_sigma_rad=float(ds.beam_sigma_rad),
            options=options,
            layers={},
            gain_unit=1.0,
            delay_unit=1.0,
            device=device,
        )
        ready = time.perf_counter()
        targets, initial, gain_unit, delay_unit = blank._targets(ds, images, seen)
        problem = Problem(seen, batch=batch, seed=seed, device=device)
        plan = {"gain": int(iterations)}
        plan.update({name: min(CHANNEL_STEPS, int(iterations)) for name in targets if name != "gain"})
        learned = Rates() if rates is None else rates
        saver = field_files.Checkpoint(
            checkpoint,
            field_files.fingerprint(options, learned, seed, batch, plan, problem.seen, seen, images),
        )
        layers, losses = {}, {}
        done, total = 0, sum(plan.values())
        for name, target in targets.items():
            kind = options.gain if name == "gain" else "signed"
            state = fit_layer(
                problem, target, kind, initial=initial[name], steps=plan[name], degree=options.sh_degree,
                rates=learned if name == "gain" else Rates(0.1, 0.05, 0.02, 0.1), state=saver.state(name),
                each=saver.saving(name), progress=_shifted(progress, done, total),
            )  # fmt: skip
            done += plan[name]
            everyone = np.zeros((len(gaussians), _kernels.COEFFICIENTS), np.float32)
            everyone[:, 0] = initial[name]
            everyone[problem.seen] = state.coefficients
            layers[name], losses[name] = everyone, state.losses
        saver.remove()
        return blank._with(
            layers=layers,
            gain_unit=gain_unit,
            delay_unit=delay_unit,
            report={
                "receivers": len(images),
                "transport_time_s": 0.0 if transport is not None else ready - started,
                "fit_time_s": time.perf_counter() - ready,
                "pairs_per_pixel": len(seen.gaussian) / (len(images) * shape[0] * shape[1]),
                "weight_dropped_mean": seen.dropped[1],
                "gaussians": len(gaussians),
                "gaussians_seen": len(problem.seen),
                "iterations": int(iterations),
                "seed": int(seed),
                "losses": {name: [float(v) for v in values] for name, values in losses.items()},
            },
        )

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    def spectrum(self, rx: Any, transmitter: Any = None, *, transport: Transport | None = None) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m].

        Args:
            rx: receiver position.
            transmitter: position (3,) [m] if another than the fitted one: lengths are recomputed, fitted gains are kept.
            transport: blending weights of exactly this receiver, if they were computed before.

        Raises:
            ValueError: for a position that is not finite, outside the scene or on a surface; or another transmitter
                with ``rf3dgs``, whose delays and gains hold only for the one it was fitted for.
        """
        return self._look(rx, transmitter, transport)[0]

    def paths(self, rx: Any, transmitter: Any = None, max_paths: int | None = None) -> Paths:
        """Propagation paths at ``rx``: line of sight where the mesh lets the transmitter be seen, and one diffuse path
        per pixel above the floor.

        The sum of ``|gain|^2`` equals the spectrum's sum: what pixels below the floor hold is spread over the diffuse
        paths in proportion to their power (at least one is kept to carry it). With ``line_of_sight="explicit"`` the
        ``los`` path carries Friis gain; without, the power of the pixels within 3 beam sigmas of the transmitter's
        direction, merged. Direction and delay of ``los`` are exact; a diffuse path arrives from its pixel's centre.

        Args:
            rx: receiver position ``(3,)``, or ``(R, 3)`` for arrays ``(R, L)``, padded.
            transmitter: as for :meth:`spectrum`.
            max_paths: keep the strongest only (the sum is then what they carry).

        Raises:
            ValueError: as for :meth:`spectrum`, and for a ``max_paths`` below 1.
        """
        if max_paths is not None and (not isinstance(max_paths, int | np.integer) or max_paths < 1):
            raise ValueError(f"max_paths: got {max_paths!r}, expected a whole number of at least 1, or None")
        positions = _transport.check_receiver("rx", rx, self.mesh)
        if positions.ndim == 1:
            return self._paths(positions, transmitter, max_paths)
        return Paths.stack([self._paths(p, transmitter, max_paths) for p in positions])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one safetensors file, in one go: geometry, coefficients, options, report."""
        tensors = {f"layer/{name}": table for name, table in self.layers.items()}
        for name in ("means", "quaternions", "scales", "opacities", "sh"):
            tensors[f"gaussians/{name}"] = getattr(self.gaussians, name)
        if self.mesh is not None:
            tensors["mesh/vertices"], tensors["mesh/faces"] = self.mesh.vertices, self.mesh.faces
        tensors["transmitter"] = self.transmitter
        header = {name: getattr(self, name) for name in _PLAIN}
        field_files.write(path, tensors, {**header, "options": asdict(self.options), "report": self.report})

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: Any = None) -> RadioField:
        """Read a field that :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or no radio field.
        """
        tensors, header = field_files.read(path)
        try:
            parts = {
                n: tensors[f"gaussians/{n}"] for n in ("means", "quaternions", "scales", "opacities", "sh")
            }
            mesh = Mesh(tensors["mesh/vertices"], tensors["mesh/faces"]) if "mesh/faces" in tensors else None
            layers = {n.removeprefix("layer/"): t for n, t in tensors.items() if n.startswith("layer/")}
            if "gain" not in layers or any(t.shape != (len(parts["means"]), 16) for t in layers.values()):
                raise ValueError("its coefficients do not fit its Gaussians")
            plain = {name: header[name] for name in _PLAIN}
            return cls(
                **{**plain, "shape": tuple(plain["shape"]), "range_db": tuple(plain["range_db"])},
                gaussians=Gaussians(**parts),
                mesh=mesh,
                transmitter=tensors["transmitter"],
                options=FieldOptions(**header["options"]),
                layers=layers,
                report=header["report"],
                device=device,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{os.fspath(path)}: corrupt or no radio field of this version: {error}"
            ) from error

    def _with(self, **changes: Any) -> RadioField:
        from dataclasses import replace

        return replace(self, **changes)

    def _factor(self, lengths: Lengths) -> np.ndarray:
        """Solid angle [sr], times spreading loss for ``rf3dgs+``; zero where the ray meets nothing."""
        solid_angle = pixel_solid_angles(self.shape)[:, None]
        if self.options.model == "rf3dgs":
            return np.where(np.isfinite(lengths.total), solid_angle, 0.0)
        with np.errstate(divide="ignore"):
            loss = (self.wavelength_m / (4 * np.pi * lengths.total)) ** 2
        return np.where(np.isfinite(loss), solid_angle * loss, 0.0)

    def _lengths(self, seen: Transport, transmitter: np.ndarray) -> Lengths:
        points = _transport.interaction_points(
            seen, self.gaussians, self.options.interaction_point, mesh=self.mesh, device=self.device
        )
        return _transport.path_lengths(points, transmitter, seen.receivers)

    def _line_of_sight(self, receiver: np.ndarray, transmitter: np.ndarray) -> tuple[bool, float]:
        """Whether the mesh lets them see each other, and their Friis gain."""
        distance = float(np.linalg.norm(receiver - transmitter))
        if distance == 0:
            raise ValueError("rx: got the transmitter's own position; expected them apart")
        visible = self.mesh is not None and bool(
            self.mesh.visible(receiver[None], transmitter[None], device=self.device)[0]
        )
        return visible, (self.wavelength_m / (4 * np.pi * distance)) ** 2

    def _explicit(self, receiver: np.ndarray, transmitter: np.ndarray) -> np.ndarray | None:
        """The explicit line of sight's beam on the grid, or None."""
        if self.options.line_of_sight != "explicit":
            return None
        visible, gain = self._line_of_sight(receiver, transmitter)
        if not visible:
            return None
        toward = (transmitter - receiver)[None]
        return spread(toward, np.array([gain]), self.shape, self.beam_sigma_rad, device=self.device)

    def _targets(
        self, ds: SpectrumDataset, images: np.ndarray, seen: Transport
    ) -> tuple[dict[str, Target], dict[str, float], float, float]:
        """What each layer is fitted to, what its constants start from, and the units of gain and delay."""
        lengths = self._lengths(seen, self.transmitter)
        factor = self._factor(lengths)
        extra = np.zeros_like(images)
        for i, receiver in enumerate(seen.receivers):
            beam = self._explicit(receiver, self.transmitter)
            extra[i] = 0.0 if beam is None else beam
        blended = factor * seen.pixel_weight
        lit = (images - extra > self.floor) & (blended > 0)
        if not lit.any():
            raise ValueError(
                "ds: got no pixel above the floor where a ray meets a Gaussian; expected spectra with power and "
                "geometry around the receivers"
            )
        gain_unit = float(np.median((images - extra)[lit] / blended[lit]))
        low, high = self.range_db
        targets = {
            "gain": Target(
                image=np.clip((to_db(images, self.floor) - low) / (high - low), 0.0, 1.0),
                # in units of the floor, so that float32 works near one
                factor=factor * (gain_unit / self.floor),
                extra=extra / self.floor,
                floor=1.0,
                low=low - 10 * np.log10(self.floor),
                high=high - 10 * np.log10(self.floor),
            )
        }
        initial = {"gain": 0.0 if self.options.gain == "exp" else 1.0 / Y00}
        delay_unit = 1.0
        delays = None if ds.delay_s is None else np.asarray(ds.delay_s, np.float64)
        if self.options.model == "rf3dgs" and delays is not None:
            mask = (images > self.floor) & np.isfinite(delays) & (seen.dominant >= 0)
            if mask.any():
                delay_unit = float(delays[mask].max())
                departure = _unit(np.asarray(ds.aod, np.float64))
                channels = {"delay": delays / delay_unit}
                channels.update({f"aod_{axis}": departure[..., k] for k, axis in enumerate("xyz")})
                for name, image in channels.items():
                    targets[name] = Target(image=np.where(mask, image, 0.0), mask=mask)
                    initial[name] = float(np.median(image[mask])) / Y00
        return targets, initial, gain_unit, delay_unit

    def _blend(self, name: str, seen: Transport) -> np.ndarray:
        """The blended layer ``name`` of one receiver, shape ``(H, W)`` float64."""
        device = _device.resolve(self.device)
        kernels = _kernels.build(wp.float32)
        if name not in self._uploaded:
            self._uploaded[name] = wp.array(self.layers[name], dtype=kernels.vec16, device=device)
        if "basis" not in self._uploaded:
            self._uploaded["basis"] = harmonics(self.shape, wp.float32, device)
        kind = KINDS[self.options.gain] if name == "gain" else KINDS["signed"]
        out = wp.zeros(self.shape[0] * self.shape[1], dtype=float, device=device)
        inputs = [
            kind,
            wp.array(seen.start.astype(np.int32), dtype=int, device=device),
            wp.array(seen.gaussian, dtype=int, device=device),
            wp.array(seen.weight, dtype=float, device=device),
            self._uploaded["basis"],
            self._uploaded[name],
            out,
        ]
        _device.launch(kernels.predict, len(out), inputs, device=device)
        return out.numpy().reshape(self.shape).astype(np.float64)

    def _look(
        self, rx: Any, transmitter: Any, seen: Transport | None
    ) -> tuple[Spectrum, np.ndarray, np.ndarray, np.ndarray | None]:
        """Spectrum at one receiver, the receiver, interaction points ``(H, W, 3)``, explicit line of sight's beam."""
        receiver = _transport.check_receiver("rx", check_array("rx", rx, (3,)), self.mesh)
        source = self._transmitter(transmitter)
        if seen is None:
            seen = _transport.transport(
                self.gaussians, receiver[None], self.shape, range_db=self.range_db,
                rule=self.options.transmittance, top_k=self.options.top_k, device=self.device,
            )  # fmt: skip
        _check_transport(seen, receiver[None], self.shape, self.options.transmittance)
        lengths = self._lengths(seen, source)
        power = self._factor(lengths)[0] * self.gain_unit * self._blend("gain", seen)
        point, delay, departure = lengths.point[0], lengths.delay_s[0], lengths.departure[0]
        if self.options.model == "rf3dgs":
            nothing = np.full(self.shape, np.nan)
            point = np.full_like(point, np.nan)
            empty = seen.dominant[0] < 0
            delay, departure = nothing, np.stack([nothing] * 3, axis=-1)
            if "delay" in self.layers:
                delay = np.where(empty, np.nan, np.maximum(self._blend("delay", seen), 0.0) * self.delay_unit)
                departure = np.stack([self._blend(f"aod_{axis}", seen) for axis in "xyz"], axis=-1)
                departure = np.where(empty[..., None], np.nan, departure)
        angles = np.stack(angles_from_directions(departure), axis=-1)
        beam = self._explicit(receiver, source)
        if beam is not None:
            toward = receiver - source
            first = beam > power
            delay = np.where(first, np.linalg.norm(toward) / SPEED_OF_LIGHT, delay)
            angles = np.where(first[..., None], np.stack(angles_from_directions(toward)), angles)
            power = power + beam
        spectrum = Spectrum(
            path_gain=power.astype(np.float32),
            delay_s=delay,
            aod=angles,
            floor=self.floor,
            range_db=self.range_db,
        )
        return spectrum, receiver, point, beam

    def _paths(self, rx: np.ndarray, transmitter: Any, max_paths: int | None) -> Paths:
        spectrum, receiver, points, beam = self._look(rx, transmitter, None)
        source = self._transmitter(transmitter)
        power = np.asarray(spectrum.path_gain, np.float64)
        total = power.sum()
        visible, friis = self._line_of_sight(receiver, source)
        toward = pixel_directions(self.shape)
        los = 0.0
        if beam is not None:
            los, power = min(friis, total), np.maximum(power - beam, 0.0)
        elif visible:
            direction = (source - receiver) / np.linalg.norm(source - receiver)
            near = toward @ direction >= np.cos(BEAM_REACH * self.beam_sigma_rad)
            near[pixel_of(direction, self.shape)] = True
            los, power = float(power[near].sum()), np.where(near, 0.0, power)
        rest = total - los
        kept = power > self.floor
        if not kept.any() and rest > 0 and power.max() > 0:
            kept = power == power.max()
        row, column = np.nonzero(kept)
        diffuse = power[row, column]
        if len(diffuse):
            diffuse = diffuse * (max(rest, 0.0) / diffuse.sum())
        else:
            los = total  # nothing but the line of sight has power
        # A ray may carry power and still have no delay (an rf3dgs field fitted without delay spectra): phase 0 then.
        aod = np.asarray(spectrum.aod)[row, column]
        parts = [_single(np.sqrt(diffuse), np.asarray(spectrum.delay_s)[row, column], toward[row, column], aod,
                         points[row, column], "diffuse", self.frequency_hz)]  # fmt: skip
        if los > 0:
            outward = receiver - source
            delay = np.array([np.linalg.norm(outward) / SPEED_OF_LIGHT])
            departure = np.stack(angles_from_directions(outward[None]), axis=-1)
            parts.append(_single(np.sqrt([los]), delay, -outward[None], departure, np.full((1, 3), np.nan), "los",
                                 self.frequency_hz))  # fmt: skip
        everything = Paths.concatenate(parts)
        order = np.argsort(-np.abs(everything.gain), kind="stable")[:max_paths]
        return Paths(**{name: getattr(everything, name)[order] for name in Paths.__dataclass_fields__})

    def _transmitter(self, transmitter: Any) -> np.ndarray:
        if transmitter is None:
            return self.transmitter
        position = check_array("transmitter", transmitter, (3,))
        if self.options.model == "rf3dgs" and not np.array_equal(position, self.transmitter):
            raise ValueError(
                f"transmitter: got {position.tolist()}, but an rf3dgs field holds only for the one it was fitted for, "
                f'{self.transmitter.tolist()}; fit model="rf3dgs+", which recomputes lengths, or fit again'
            )
        return position


_PLAIN = ("frequency_hz", "shape", "floor", "range_db", "beam_sigma_rad", "gain_unit", "delay_unit")


def _geometry(geometry: Any) -> tuple[Gaussians, Mesh | None]:
    if isinstance(geometry, Gaussians):
        return geometry, None
    gaussians = getattr(geometry, "gaussians", None)
    mesh = geometry if isinstance(geometry, Mesh) else getattr(geometry, "mesh", None)
    if gaussians is None and mesh is not None:
        gaussians = discs_on_mesh(mesh)
    if not isinstance(gaussians, Gaussians):
        raise TypeError(
            f"geometry: got {type(geometry).__name__}, expected a Reconstruction (or anything with .gaussians and "
            ".mesh), a Scene or a Mesh"
        )
    if len(gaussians) == 0:
        raise ValueError("geometry: got no Gaussians, expected at least one")
    return gaussians, mesh


def _check_transport(seen: Transport, receivers: np.ndarray, shape: tuple[int, int], rule: str) -> None:
    if seen.shape != shape or seen.rule != rule or not np.array_equal(seen.receivers, receivers):
        raise ValueError(
            f"transport: got weights of {len(seen.receivers)} receivers, shape {seen.shape}, rule {seen.rule!r}; expected "
            f"those of exactly the {len(receivers)} receivers asked for, shape {shape}, rule {rule!r}"
        )


def _shifted(progress: Progress | None, done: int, total: int) -> Progress | None:
    if progress is None:
        return None
    return lambda stage, step, _: progress(stage, done + step, total)


def _single(
    amplitude: np.ndarray,
    delay: np.ndarray,
    arrival: np.ndarray,
    departure: np.ndarray,
    points: np.ndarray,
    kind: str,
    frequency_hz: float,
) -> Paths:
    """Paths of at most one interaction, at ``points`` (L, 3), NaN for none."""
    turns = np.mod(frequency_hz * np.where(np.isfinite(delay), delay, 0.0), 1.0)
    zenith, azimuth = angles_from_directions(arrival)
    return Paths(
        gain=amplitude * np.exp(-2j * np.pi * turns),
        tau=delay,
        theta_r=zenith,
        phi_r=azimuth,
        theta_t=departure[:, 0],
        phi_t=departure[:, 1],
        vertices=points[:, None, :],
        kind=np.full(len(delay), kind, dtype="<U7"),
        valid=np.ones(len(delay), dtype=bool),
    )


def _unit(angles: np.ndarray) -> np.ndarray:
    from warprrf.rf.spectrum import directions_from_angles

    return directions_from_angles(angles[..., 0], angles[..., 1])


__all__ = ["FieldOptions", "RadioField", "State"]
