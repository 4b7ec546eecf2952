"""Spectra of a scene for many receivers, by either engine, resumable receiver by receiver."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warprrf.cache import Cache, making
from warprrf.checks import NotNegative, Seed, check_array, check_count, checked, one_of, warn
from warprrf.cluster import each
from warprrf.device import DeviceLike, Progress, silent
from warprrf.geometry.mesh import Mesh, as_mesh
from warprrf.rf.em.absorption import Air, Gas, air_of
from warprrf.rf.em.fresnel import surface_table
from warprrf.rf.em.waves import SPEED_OF_LIGHT, Hertz
from warprrf.rf.exact import REVISION, SINGLE, SUB_PIXELS, ExactEngine
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.positions import (
    check_positions,
    check_receivers,
    ground_height,
    question_unit,
    warn_of_unmodelled,
)
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import Received, SpectrumDataset
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, DEFAULT_SHAPE, Beam, GridShape
from warprrf.rf.tracing.model import Effects
from warprrf.steps import Steps, digest


@checked
def simulate(
    scene: Scene,
    *,
    transmitter: ArrayLike,
    receivers: ArrayLike,
    frequency_hz: Hertz,
    shape: GridShape = DEFAULT_SHAPE,
    engine: Annotated[str, one_of("exact", "sionna")] = "exact",
    effects: Effects = SINGLE,
    depth: int = 3,
    samples: int = 1_000_000,
    beam_sigma_rad: Beam = BEAM_SIGMA_RAD,
    refraction: bool = False,
    seed: int = 0,
    gas: Gas = False,
    roles: Sequence[str] | NDArray[np.str_] | None = None,
    floor: float | None = None,
    workspace: str | os.PathLike[str] | None = None,
    client: Any = None,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> SpectrumDataset:
    """Spectra of one transmitter at many receivers.

    Args:
        scene: The :class:`Scene`.
        transmitter: Position [m], shape ``(3,)``: a data set is of one; fits take a list of data sets.
        receivers: Positions [m], shape ``(R, 3)``, or ``(3,)`` for a set of one.
        frequency_hz: Carrier frequency [Hz].
        shape: Rows and columns of a spectrum.
        engine: "exact": our own, with ``effects``; ``depth``, ``samples`` and ``refraction`` play no part. "sionna": Sionna
            RT's PathSolver.
        effects: What the exact engine models (``residual`` apart): by default line of sight, one mirror reflection and
            single-bounce scattering, without noise. Light that is scattered more often is sampled, by ``seed``.
        depth: Most bounces on a path of Sionna's.
        samples: Rays per transmitter of Sionna's.
        beam_sigma_rad: Receiver beam width, kappa = 1 / sigma^2 [rad].
        refraction: Whether Sionna's paths go through slabs.
        seed: Seed of Sionna's rays, of directions that are sampled, and of the roles if none are given.
        gas: Absorption of the air: see :meth:`Paths.with_gas`. Attributes ``air_...`` of the data set say which.
        roles: "train" or "test" for each receiver, shape ``(R,)``; an eighth is for test by default.
        floor: N0 [linear]; median over views of the view's maximum, less 60 dB, by default.
        workspace: Folder that keeps each finished receiver, so that a killed run goes on where it stopped.
        client: A ``dask.distributed.Client`` whose workers compute, to the same bits; this process by default.
        progress: Called as ``progress("simulate", done, total)``; what ``workspace`` holds is done from the start.
        device: Where our own kernels run.

    Raises:
        ValueError: on a position that is NaN, outside the scene, inside a solid, on a surface, or within the reactive
            near field of the transmitter; on a frequency outside a material's band, or P.676's with ``gas``; on an
            unknown engine.
        ImportError: if ``engine="sionna"`` and Sionna RT is missing.

    Warns:
        UserWarning: below 100 GHz and outdoors, of diffraction and transmission if not modelled; of a transmitter so near to a
            surface that few of the exact engine's rays meet what it lights most.
    """
    if not hasattr(scene, "materials"):
        raise TypeError(f"scene: got {type(scene).__name__}, expected a Scene (a mesh and its materials)")
    sampling = Sampling(depth=depth, samples=samples, refraction=refraction, seed=seed)
    points = np.atleast_2d(check_receivers("receivers", receivers))
    source = check_array("transmitter", transmitter, (3,))
    table = surface_table(scene.materials, frequency_hz)
    air = air_of(gas, frequency_hz)
    mesh, wavelength_m = as_mesh(scene, "scene"), SPEED_OF_LIGHT / frequency_hz
    question_unit(mesh, wavelength_m)
    check_positions(mesh, source, points, wavelength_m, device=device)
    exact = engine == "exact"
    if exact and effects.scatterings:
        _question_rays(mesh, source, points, shape, device)
    modelled = {
        "transmission": effects.transmissions > 0 if exact else refraction,
        "diffraction": exact and effects.diffractions > 0,
    }
    warn_of_unmodelled(mesh, source, points, frequency_hz=frequency_hz, device=device, **modelled)

    common: dict[str, Any] = {"transmitter": source, "frequency_hz": frequency_hz}
    common |= {"shape": shape, "beam_sigma_rad": beam_sigma_rad}
    surfaces = (scene.mesh.vertices, scene.mesh.faces, scene.face_material, *vars(table).values())
    solver: Any = sampling, _versions(engine, solver_only=True)
    settings = {"depth": depth, "samples": samples, "refraction": int(refraction)}
    if exact:
        solver = asdict(effects), seed if effects.scatterings > 1 else 0
        named = {f"effects_{name}": int(value) for name, value in asdict(effects).items()}
        settings = {"sub_pixels": SUB_PIXELS} | named
    inputs = digest(engine, common, air, surfaces, solver)
    results: dict[int, Any] = {}
    if workspace is not None:
        known = {k: _kept(workspace, inputs, point) for k, point in enumerate(points)}
        results = {k: held for k, held in known.items() if held is not None}
    tell = progress or silent
    tell("simulate", len(results), len(points))
    missing = [k for k in range(len(points)) if k not in results]
    receiver = _Receiver(scene, common, effects if exact else sampling, seed, air, device)
    for at, found in each(receiver, [points[k] for k in missing], client):
        k = missing[at]
        results[k] = found if workspace is None else _kept(workspace, inputs, points[k], found)
        tell("simulate", len(results), len(points))
    return SpectrumDataset.from_spectra(
        receivers=points,
        transmitter=source,
        frequency_hz=frequency_hz,
        beam_sigma_rad=beam_sigma_rad,
        engine=engine,
        seed=seed,
        role=roles,
        floor=floor,
        attributes=settings
        | ({} if air is None else air.attributes)
        | {f"version_{name}": value for name, value in _versions(engine).items()},
        **Received.columns([results[k] for k in range(len(points))]),
    )


@checked
def sample_receivers(
    scene: Scene,
    n: int,
    *,
    z: ArrayLike = (0.8, 2.2),
    clearance: NotNegative = 0.3,
    above_ground: bool = False,
    seed: Seed,
    device: DeviceLike = None,
) -> np.ndarray:
    """``n`` places drawn uniformly from the scene's air, shape ``(n, 3)`` [m]; a longer draw starts with a shorter one.

    Args:
        scene: Scene of closed solids, one closed room, or a city under the sky.
        z: Lowest and highest place [m].
        clearance: Least distance to any surface [m].
        above_ground: Whether ``z`` counts from the ground, the lowest surface below each place, instead of 0.
        seed: Seed of the draw.

    Raises:
        ValueError: if there is no such place, or the range is empty.
    """
    # Drawn at a time before those without clearance are dropped; a scene with less than one free place in ``most`` has
    # none worth the name.
    batch, most = 1000, 200_000
    check_count("n", n, most=most)
    z = check_array("z", z, (2,))
    if z[0] > z[1]:
        raise ValueError(f"z: got {z.tolist()}, expected the lowest and the highest place")
    mesh = as_mesh(scene)
    low, high = mesh.bounds.copy()
    low[2], high[2] = z if above_ground else (max(low[2], z[0]), min(high[2], z[1]))
    if low[2] > high[2]:
        raise ValueError(f"z: got {z.tolist()}, but the scene lies at {mesh.bounds[:, 2].tolist()}")
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    count = 0
    for _ in range(most // batch):
        points = rng.uniform(low, high, (batch, 3))
        if above_ground:
            points[:, 2] += ground_height(mesh, points[:, 0], points[:, 1], device=device)
            points = points[np.isfinite(points[:, 2])]
        points = points[scene.is_free(points, clearance_m=clearance, device=device)]
        found.append(points)
        count += len(points)
        if count >= n:
            return np.concatenate(found)[:n]
    raise ValueError(f"clearance: found {count} of {n} places {clearance:g} m from all in {most} draws")


def _question_rays(
    mesh: Mesh, source: np.ndarray, points: np.ndarray, shape: tuple[int, int], device: DeviceLike
) -> None:
    """Warn of a transmitter nearer to a surface than rays from receivers are apart there."""
    off_m = float(mesh.distance(source[None], device=device)[0])
    away_m = float(np.linalg.norm(points - source, axis=1).max(initial=0.0))
    apart_m = away_m * np.sqrt(4.0 * np.pi / (shape[0] * shape[1])) / SUB_PIXELS
    if off_m < apart_m:
        warn(
            f"transmitter: it stands {off_m:.2g} m off a surface, where rays from receivers are {apart_m:.2g} m apart: what that "
            "scatters may err by some decibels; expected a finer shape, or a transmitter further off"
        )


def _versions(engine: str, solver_only: bool = False) -> dict[str, str]:
    """Versions of the packages that compute, or of Sionna RT's alone: what is kept outlives an update of ours."""
    packages = {} if solver_only else {"warprrf": "warprrf", "warp": "warp-lang", "numpy": "numpy"}
    if engine == "sionna":
        packages |= {"sionna_rt": "sionna-rt", "mitsuba": "mitsuba", "drjit": "drjit"}
    found = {}
    for name, package in packages.items():
        try:
            found[name] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


@dataclass(frozen=True)
class _Receiver:
    """What a receiver (3,) gets, in single precision; a pickle holds how the engine is built."""

    scene: Scene
    common: dict[str, Any]
    how: Effects | Sampling
    seed: int
    air: Air | None
    device: DeviceLike
    _running: Cache = field(default_factory=lambda: Cache(1))

    def __call__(self, point: np.ndarray) -> Received:
        how, common = self.how, {**self.common, "gas": self.air, "device": self.device}
        if isinstance(how, Effects):
            ours = partial(ExactEngine, self.scene, **common, effects=how, seed=self.seed)
            found = self._running.get("engine", ours).receive(point)
        else:
            theirs = partial(SionnaEngine, self.scene, **common, sampling=how)
            with making:  # Sionna RT's scene holds the receiver: one thread at a time
                found = self._running.get("engine", theirs).receive(point)
        single: dict[str, Any] = {n: getattr(found, n).astype(np.float32) for n in ("path_gain", "aod")}
        return replace(found, **single)


def _kept(
    workspace: str | os.PathLike[str], inputs: str, point: np.ndarray, found: Received | None = None
) -> Received | None:
    """What is on file for ``point``: what an earlier run left there, else what was ``found``."""
    make: Any = None if found is None else partial(vars, found)
    with Steps(workspace, shared=True) as steps:
        held: Any = steps.arrays(digest(inputs, point)[:24], make, version=REVISION, inputs=[inputs, point])
    return Received(**held) if held else None
