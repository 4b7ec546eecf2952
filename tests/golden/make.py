"""Small inputs to every public verb, and what came out of it when the goldens were written.

``python tests/golden/make.py [CASE ...]`` writes ``tests/golden/CASE.npz``, ``tests/test_golden.py`` compares. A case
uses public names alone, so that it holds however the library is arranged inside. It returns named arrays, each with the
check that fits what it is: to the bit where nothing depends on how a kernel was compiled, else a tolerance with its
reason. Write goldens anew only where a result is meant to change, and say so in the change's message.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import warprrf as wr

HERE = Path(__file__).parent
LOBBY = HERE.parent.parent / "data" / "lobby"
CARRIER_HZ = 300e9
TRANSMITTER = np.array([1.1, 1.3, 2.4])
BEAM_RAD = np.deg2rad(6.0)
SHAPE = (18, 36)


@dataclass(frozen=True)
class Check:
    """How a value is compared with its golden.

    Attributes:
        rtol, atol: of :func:`numpy.isclose`; both zero means to the bit.
        outliers: share of the elements that may differ: pixels whose rays graze an edge or a threshold.
        decibels: compare 10 log10 of the values, ``atol`` in dB, where the golden is above 1e-6 of its maximum.
        psnr_db: instead of element by element, the least PSNR of the dB image over 60 dB below the golden's maximum.
    """

    rtol: float = 0.0
    atol: float = 0.0
    outliers: float = 0.0
    decibels: bool = False
    psnr_db: float | None = None

    def failure(self, now: np.ndarray, golden: np.ndarray) -> str | None:
        """What is wrong with ``now``, or None."""
        if now.shape != golden.shape:
            return f"shape {now.shape}, golden {golden.shape}"
        if now.dtype.kind != golden.dtype.kind:
            return f"dtype {now.dtype}, golden {golden.dtype}"
        if self.psnr_db is not None:
            found = _psnr_db(now, golden)
            return None if found >= self.psnr_db else f"PSNR {found:.1f} dB, at least {self.psnr_db} wanted"
        if now.dtype.kind in "USbiu" or (self.rtol == 0 and self.atol == 0):
            wrong = (now != golden) & ((now == now) | (golden == golden))  # two NaN are alike
        elif self.decibels:
            counts = golden > 1e-6 * golden.max()
            with np.errstate(divide="ignore", invalid="ignore"):
                wrong = counts & ~(np.abs(10 * np.log10(now) - 10 * np.log10(golden)) <= self.atol)
        else:
            wrong = ~np.isclose(now, golden, rtol=self.rtol, atol=self.atol, equal_nan=True)
        share = float(np.mean(wrong)) if wrong.size else 0.0
        if share <= self.outliers:
            return None
        first = tuple(np.argwhere(wrong)[0]) if wrong.ndim else ()
        return (
            f"{share:.2%} of the elements differ, first at {first}: {now[first]!r}, golden {golden[first]!r}"
        )


def _psnr_db(now: np.ndarray, golden: np.ndarray) -> float:
    high = golden.max()
    with np.errstate(divide="ignore"):
        images = [np.clip(10 * np.log10(x / high) / 60 + 1, 0, 1) for x in (now, golden)]
    return float(-10 * np.log10(max(np.mean((images[0] - images[1]) ** 2), 1e-12)))


BITS = Check()
FLOAT64 = Check(rtol=1e-9, atol=1e-15)  # float64 arithmetic in whatever order
PHASE = Check(rtol=1e-6, atol=1e-16)  # 2 pi f tau is 1e5 rad here: what 1e-12 of a delay makes of it
SINGLE = Check(rtol=1e-4, atol=2e-5)  # float32 kernels, compiled anew
PIXELS = Check(rtol=1e-4, atol=2e-5, outliers=0.005)  # ... and thresholds that a last bit can cross
EXACT = Check(atol=0.01, decibels=True, outliers=0.01)  # rays of a pixel that graze an edge
# Fits stop where a step no longer pays: rounding moves their parameters, hardly what they predict.
FITTED = Check(psnr_db=45.0)
FITTED_DB = Check(atol=0.3, decibels=True)
FITTED_METRIC = Check(rtol=0.02, atol=0.02)

Values = dict[str, tuple[object, Check]]
CASES: dict[str, Callable[[], Values]] = {}


def case(function: Callable[[], Values]) -> Callable[[], Values]:
    """Enter a case under its name."""
    CASES[function.__name__] = function
    return function


def values(name: str) -> dict[str, tuple[np.ndarray, Check]]:
    """The arrays of a case, each with its check."""
    return {key: (np.asarray(value), check) for key, (value, check) in CASES[name]().items()}


Part = tuple[np.ndarray, np.ndarray]
"""Vertices and faces."""


def box_mesh(low: ArrayLike, high: ArrayLike, inward: bool = False) -> Part:
    """A closed box, 6 sides of 2 faces, wound so that normals point outward, or inward."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return low + corners * (high - low), faces[:, ::-1] if inward else faces


def joined(*parts: Part) -> tuple[wr.Mesh, np.ndarray]:
    """One mesh of several parts, and the part each face came from."""
    shift = np.cumsum([0] + [len(v) for v, _ in parts])
    mesh = wr.Mesh(
        np.concatenate([v for v, _ in parts]),
        np.concatenate([f + s for (_, f), s in zip(parts, shift, strict=False)]),
    )
    return mesh, np.repeat(np.arange(len(parts)), [len(f) for _, f in parts])


def room_mesh() -> tuple[wr.Mesh, np.ndarray]:
    """A room of 6 x 5 x 3 m with a cupboard and a screen, and the part each face belongs to."""
    return joined(
        box_mesh((0, 0, 0), (6, 5, 3), inward=True),
        box_mesh((2.5, 2.0, 0.0), (3.4, 3.2, 1.9)),
        box_mesh((4.6, 1.0, 0.4), (4.7, 2.6, 2.2)),
    )


@cache
def room() -> wr.Scene:
    """The room with three materials."""
    mesh, part = room_mesh()
    materials = [
        wr.Material.custom("plaster", relative_permittivity=2.7, conductivity=0.5, scattering=0.6),
        wr.Material.custom("wood", relative_permittivity=2.0, conductivity=1.5, scattering=0.8),
        wr.Material.conductor(scattering=0.3, pattern="directive", alpha_r=10),
    ]
    return wr.Scene(mesh, materials, part, face_object=part, object_names=("room", "cupboard", "screen"))


def places(count: int) -> np.ndarray:
    """Receivers in the room's free space, some behind the cupboard."""
    x = np.linspace(0.7, 5.5, count)
    y = np.where(np.arange(count) % 2 == 0, 4.2, 0.7)
    return np.stack([x, y, np.linspace(1.0, 1.8, count)], axis=1)


def links(count: int) -> dict[str, Any]:
    """The transmitter, ``count`` receivers and the carrier."""
    return {"transmitter": TRANSMITTER, "receivers": places(count), "frequency_hz": CARRIER_HZ}


@cache
def spectra() -> wr.SpectrumDataset:
    """Spectra of eight receivers by the exact engine."""
    return wr.simulate(room(), **links(8), shape=SHAPE, beam_sigma_rad=BEAM_RAD)


@cache
def bistatic() -> wr.RadioField:
    """A bistatic field fitted to three of them: nothing held out."""
    return wr.RadioField.fit(room(), spectra().subset([0, 3, 6]), model="bistatic")


def gaussians(count: int = 400) -> wr.Gaussians:
    """Random Gaussians about the origin."""
    r = np.random.default_rng(0)
    return wr.Gaussians(
        means=r.normal(0, 1.2, (count, 3)).astype(np.float32),
        quaternions=r.normal(size=(count, 4)).astype(np.float32),
        scales=np.exp(r.uniform(-4, -1.2, (count, 3))).astype(np.float32),
        opacities=r.uniform(0.05, 0.95, count).astype(np.float32),
        sh=r.normal(0, 0.3, (count, 9, 3)).astype(np.float32),
    )


def pinhole() -> wr.Camera:
    """A camera at (0, -4, 0) that looks along +y."""
    pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 4], [0, 0, 0, 1]])
    return wr.Camera.pinhole(48, 32, fx=40.0, fy=42.0, cx=23.5, cy=16.5, world_to_camera=pose)


def _paths(paths: wr.Paths, gain: Check = PHASE, length: Check = FLOAT64) -> Values:
    """Paths of one receiver, by kind and delay, so that the order in which they are found does not count."""
    order = np.lexsort((np.round(paths.theta_r, 6), np.round(paths.tau * 1e15), paths.kind))
    order = order[np.asarray(paths.valid)[order]]
    return {
        "kind": (np.asarray(paths.kind)[order], BITS),
        "tau": (paths.tau[order], length),
        "gain": (paths.gain[order], gain),
        "arrival": (np.stack([paths.theta_r, paths.phi_r])[:, order], Check(rtol=1e-7, atol=1e-7)),
        "departure": (np.stack([paths.theta_t, paths.phi_t])[:, order], Check(rtol=1e-7, atol=1e-7)),
        "vertices": (paths.vertices[order], Check(rtol=1e-6, atol=1e-6)),
    }


def _each(paths: Iterable[wr.Paths], prefix: str) -> Values:
    """:func:`_paths` of several, numbered."""
    found = {f"{prefix}_{i}": _paths(one) for i, one in enumerate(paths)}
    return {f"{name}_{key}": value for name, of_one in found.items() for key, value in of_one.items()}


def _image(out: Any) -> Values:
    found: Values = {name: (getattr(out, name), PIXELS) for name in ("features", "alpha", "depth")}
    return found | {"dominant": (out.dominant, Check(outliers=0.005))}


@case
def render_pinhole() -> Values:
    out = wr.render(gaussians(), pinhole(), background=np.array([0.1, 0.2, 0.3]))
    features = wr.render(gaussians(), pinhole(), features=np.linspace(-1, 1, 400 * 2).reshape(400, 2))
    return {**_image(out), "given": (features.features, PIXELS)}


@case
def render_spherical() -> Values:
    out = wr.render(gaussians(), wr.Camera.spherical(48, 24, position=(0.1, 0.2, 0.3)))
    exp = wr.render(
        gaussians(), wr.Camera.spherical(48, 24, position=(0, 0, 0)), blending=wr.splats.Blending(rule="exp")
    )
    return {**_image(out), "exp": (exp.features, PIXELS)}


@case
def blending_weights() -> Values:
    found = wr.splats.blend_weights(gaussians(), wr.Camera.spherical(24, 12, position=(0, 0, 0)), top_k=4)
    return {
        "index": (found.index, Check(outliers=0.005)), "weight": (found.weight, PIXELS),
        "range": (found.range, PIXELS), "alpha": (found.alpha, PIXELS),
    }  # fmt: skip


@case
def gaussian_rays() -> Values:
    r = np.random.default_rng(1)
    rays = wr.splats.GaussianRays(gaussians())
    origins, ends = r.normal(0, 3, (40, 3)), r.normal(0, 3, (40, 3))
    hits = rays.hits(origins, ends - origins, k=8)
    named = {k: np.asarray(v) for k, v in vars(hits).items() if isinstance(v, np.ndarray)}
    found: Values = {k: (v, BITS if v.dtype.kind in "iub" else FLOAT64) for k, v in named.items()}
    return {**found, "transmittance": (rays.transmittance(origins, ends), FLOAT64)}


@case
def cameras() -> Values:
    cam = pinhole()
    pixels, depth = cam.project(np.array([[0.0, 0.0, 0.0], [0.5, 1.0, -0.3]]))
    small = cam.resized(24, 16)
    return {
        "pinhole": (cam.directions(), Check(rtol=1e-6, atol=1e-7)),
        "spherical": (wr.Camera.spherical(8, 4, position=(1, 2, 3)).directions(), Check(rtol=1e-6, atol=1e-7)),
        "position": (cam.position, FLOAT64), "pixels": (pixels, FLOAT64), "depth": (depth, FLOAT64),
        "resized": ([small.fx, small.fy, small.cx, small.cy], FLOAT64),
    }  # fmt: skip


@case
def mesh_queries() -> Values:
    scene = wr.Scene.load(LOBBY / "scene.xml")
    mesh = scene.mesh
    r = np.random.default_rng(2)
    low, high = mesh.bounds
    origins, ends = r.uniform(low, high, (400, 3)), r.uniform(low, high, (400, 3))
    hit = mesh.cast(origins, ends - origins)
    return {
        "t": (hit.t, Check(rtol=1e-6)), "face": (hit.face, BITS), "normal": (hit.normal, Check(rtol=1e-6, atol=1e-6)),
        "point": (hit.point, Check(rtol=1e-6, atol=1e-6)), "visible": (mesh.visible(origins, ends), BITS),
        "distance": (mesh.distance(origins), Check(rtol=1e-5, atol=1e-5)),
        "areas": (mesh.areas, FLOAT64), "face_normals": (mesh.face_normals, FLOAT64),
        "free": (scene.is_free(origins[:60]), BITS),
        "closed": (mesh.is_closed, BITS), "bounds": (np.asarray(mesh.bounds), FLOAT64),
    }  # fmt: skip


@case
def splat_files() -> Values:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splat.ply"
        gaussians(50).save_ply(path)
        size = path.stat().st_size
        back = wr.Gaussians.load_ply(path)
        rec = wr.Reconstruction.from_files(path, mesh=room_mesh()[0])
        rec.save(Path(folder) / "rec")
        again = wr.Reconstruction.load(Path(folder) / "rec")
    near = Check(rtol=1e-5, atol=1e-6)
    return {
        "bytes": (size, BITS), "means": (back.means, near), "scales": (back.scales, near),
        "opacities": (back.opacities, near), "sh": (back.sh, near), "quaternions": (back.quaternions, near),
        "faces": (again.mesh.faces, BITS), "again": (again.gaussians.means, near),
    }  # fmt: skip


@case
def gas() -> Values:
    f = np.array([60e9, 140e9, 183.3e9, 300e9, 325e9])
    air = wr.Air(temperature_k=293.0, pressure_hpa=1000.0, water_vapour_g_m3=10.0)
    return {
        "standard": (wr.em.gas_attenuation_db_per_m(f), FLOAT64),
        "air": (air.attenuation_db_per_m(f), FLOAT64),
        "transmittance": (air.transmittance(CARRIER_HZ, np.array([1.0, 10.0, 100.0])), FLOAT64),
    }


@case
def materials() -> Values:
    scene = wr.Scene.load(LOBBY / "scene.xml")
    found = [m.permittivity(CARRIER_HZ) for m in scene.materials]
    scattering = [m.scattering_coefficient(CARRIER_HZ) for m in scene.materials]
    return {
        "names": ([m.name for m in scene.materials], BITS), "permittivity": (found, FLOAT64),
        "scattering": (scattering, FLOAT64), "face_material": (scene.face_material, BITS),
        "object_names": (list(scene.object_names), BITS), "bounds": (np.asarray(scene.bounds), FLOAT64),
    }  # fmt: skip


@case
def paths_of_a_mesh() -> Values:
    link = links(4) | {"receivers": places(4)[1]}
    return _each((wr.trace_paths(room_mesh()[0], **link, mirror_order=k) for k in (0, 1, 2)), "order")


@case
def paths_of_a_scene() -> Values:
    paths = wr.trace_paths(room(), **links(4), mirror_order=2, gas=True)
    return _each(paths.each(), "receiver")


@case
def paths_of_the_lobby() -> Values:
    ds = wr.SpectrumDataset.load(LOBBY / "spectra.nc")
    scene = wr.Scene.load(LOBBY / "scene.xml")
    paths = wr.trace_paths(
        scene,
        transmitter=ds.transmitter,
        receivers=ds.receivers[:3],
        frequency_hz=ds.frequency_hz,
        mirror_order=2,
    )
    return _each(paths.each(), "receiver")


@case
def path_files_and_other_shapes() -> Values:
    paths = wr.trace_paths(room(), **links(3))
    with tempfile.TemporaryDirectory() as folder:
        paths.save(Path(folder) / "paths.nc")
        back = wr.Paths.load(Path(folder) / "paths.nc")
        written = wr.interop.write_deepmimo(paths, Path(folder) / "deepmimo", scene=room())
        names = sorted(p.name for p in Path(written).rglob("*") if p.is_file())
    sionna = paths.to_sionna()
    spread = paths.dispersion()
    return {
        "same": (np.array_equal(back.gain, paths.gain), BITS), "deepmimo": (names, BITS),
        "sionna_a": (np.sort(np.abs(sionna.a).ravel()), Check(rtol=1e-5)),
        "power": (np.sort(paths.power.ravel()), Check(rtol=1e-6)),
        "delay_spread_s": (spread.delay_spread_s, FLOAT64), "k_factor": (spread.k_factor, Check(rtol=1e-6)),
        "azimuth_spread": (spread.azimuth_spread_arrival_rad, Check(rtol=1e-6)),
        "coherence_bandwidth_hz": (spread.coherence_bandwidth_hz, Check(rtol=1e-6)),
    }  # fmt: skip


@case
def channels() -> Values:
    paths = wr.trace_paths(room(), **links(2), mirror_order=2)
    tx = wr.PlanarArray(2, 2, orientation=(0.5, 0.0, 0.0), pattern="tr38901", polarisation="V")
    rx = wr.PlanarArray(1, 2, orientation=(-2.0, 0.0, 0.0), polarisation="cross")
    f = CARRIER_HZ + np.linspace(-1e9, 1e9, 16)
    h, _ = paths.cir(tx_array=tx, rx_array=rx)
    bare = {"tx_array": wr.PlanarArray(2, 2), "rx_array": wr.PlanarArray(2, 1)}
    return {
        "cfr": (paths.cfr(f), PHASE),
        "cfr_arrays": (paths.cfr(f, tx_array=tx, rx_array=rx), PHASE),
        "cfr_spherical": (paths.cfr(f[:4], **bare, wave="spherical", squint=False), PHASE),
        "cir_power": (np.sort((np.abs(h) ** 2).ravel()), Check(rtol=1e-6, atol=1e-20)),
        "taps": (paths.taps(1e9, 0, 60), Check(rtol=1e-6, atol=1e-12)),
    }


@case
def arrays_and_beams() -> Values:
    tx = wr.PlanarArray(4, 4, orientation=wr.channel.orientation_towards((1.0, 0.5, -0.2)), pattern="tr38901")
    rx = wr.PlanarArray(2, 4, orientation=wr.channel.orientation_towards((-1.0, -0.2, 0.1)))
    r = np.random.default_rng(3)
    directions = r.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    paths = wr.trace_paths(room(), **links(3))
    choice = wr.channel.select_beams(paths, tx, rx, count=3)
    f = np.array([CARRIER_HZ])
    channel = paths.cfr(f, tx_array=tx, rx_array=wr.PlanarArray(1, 1))[:, 0, :, 0]
    many = wr.channel.select_beams_multiuser(list(paths.each()), tx, noise=1e-9)
    steered = wr.channel.steering_codebook(tx, directions[:5])
    error = wr.channel.plane_wave_error(tx, 0.05, 1e-3)
    named = {k: v for k, v in vars(error).items() if np.ndim(v) == 0}
    found: Values = {
        "gain": (tx.gain(directions), FLOAT64), "response": (rx.response(directions, 1e-3), FLOAT64),
        "positions": (tx.positions(1e-3), FLOAT64), "dft": (wr.channel.dft_codebook(rx).weights, FLOAT64),
        "steering": (steered.weights, FLOAT64), "amplitude": (steered.amplitude(directions), FLOAT64),
        "beam_gains": (wr.channel.beam_gains(paths, tx, rx), Check(rtol=1e-5, atol=1e-16)),
        "tx": (choice.tx, BITS), "rx": (choice.rx, BITS), "chosen": (choice.gain, Check(rtol=1e-6)),
        "many": (np.asarray(many.tx), BITS),
        "covariance": (wr.channel.transmit_covariance(list(paths.each()), tx), Check(rtol=1e-6, atol=1e-16)),
    }  # fmt: skip
    for name, value in sorted(named.items()):
        found[f"plane_wave_{name}"] = (value, Check(rtol=1e-6))
    for method in ("mr", "zf", "slnr"):
        weights = wr.channel.precoders(channel, method, noise=1e-9)
        sinr = wr.channel.precoded_sinr(channel, weights, noise=1e-9)
        found[f"sinr_{method}"] = (sinr, Check(rtol=1e-5))
    return found


@case
def band_plan() -> Values:
    numbers = sorted(wr.channel.THZ_CHANNELS)
    plan = [wr.channel.thz_channel(n) for n in numbers]
    return {
        "numbers": (numbers, BITS),
        "values": ([[v for v in vars(c).values() if isinstance(v, float)] for c in plan], FLOAT64),
    }


@case
def simulated() -> Values:
    ds = spectra()
    air = wr.simulate(room(), **links(2), shape=SHAPE, beam_sigma_rad=BEAM_RAD, gas=True)
    return {
        "path_gain": (ds.path_gain[:3], EXACT), "air": (air.path_gain[1], EXACT),
        "total": (ds.path_gain.sum(axis=(1, 2)), Check(atol=0.005, decibels=True)),
        "delay_s": (ds.delay_s[0], Check(rtol=1e-5, outliers=0.01)), "aod": (ds.aod[0], Check(atol=1e-4, outliers=0.01)),
        "line_of_sight": (ds.line_of_sight, BITS), "floor": (ds.floor, Check(atol=0.01, decibels=True)),
        "range_db": (ds.range_db, Check(atol=0.01)),
    }  # fmt: skip


@case
def spectra_of_the_lobby() -> Values:
    ds = wr.SpectrumDataset.load(LOBBY / "spectra.nc")
    train, test = ds.split(50)
    fewer, _ = ds.split(10)
    other, _ = ds.split(10, seed=1)
    with tempfile.TemporaryDirectory() as folder:
        part = ds.subset([0, 3, 5])
        part.save(Path(folder) / "part.nc")
        back = wr.SpectrumDataset.load(Path(folder) / "part.nc")
    same = all(np.array_equal(getattr(back, k), getattr(part, k)) for k in ("path_gain", "receivers"))
    return {
        "receivers": (ds.receivers, BITS), "transmitter": (ds.transmitter, BITS), "shape": (ds.shape, BITS),
        "sums": (ds.path_gain.astype(float).sum(axis=(1, 2)), FLOAT64), "floor": (ds.floor, FLOAT64),
        "range_db": (ds.range_db, FLOAT64), "line_of_sight": (ds.line_of_sight, BITS), "role": (ds.role, BITS),
        "train": (train.receivers, BITS), "test": (test.receivers, BITS), "fewer": (fewer.receivers, BITS),
        "other": (other.receivers, BITS), "back": (same, BITS),
    }  # fmt: skip


@case
def measured_spectra() -> Values:
    given = spectra()
    ds = wr.SpectrumDataset.from_spectra(
        receivers=given.receivers, transmitter=given.transmitter, frequency_hz=given.frequency_hz,
        path_gain=given.path_gain, delay_s=given.delay_s, aod=given.aod, line_of_sight=given.line_of_sight,
        beam_sigma_rad=given.beam_sigma_rad, engine="measured",
    )  # fmt: skip
    shown = wr.Spectrum(ds.path_gain[0], floor=ds.floor)
    return {
        "floor": (ds.floor, Check(atol=0.01, decibels=True)), "range_db": (ds.range_db, Check(atol=0.01)),
        "total": (shown.total_path_gain, Check(atol=0.005, decibels=True)),
        "db": (shown.path_gain_db, Check(atol=0.02, outliers=0.01)),
    }  # fmt: skip


@case
def scores() -> Values:
    ds = wr.SpectrumDataset.load(LOBBY / "spectra.nc")
    train, test = ds.split(10)
    test = test.subset(range(6))
    mean = np.asarray(train.path_gain).mean(axis=0)
    found = wr.evaluate(test, lambda rx: mean)
    kept = {k: float(v) for k, v in sorted(found.items()) if isinstance(v, (int, float))}
    return {k: (v, Check(rtol=1e-5)) for k, v in kept.items() if k not in ("seconds_per_spectrum", "lpips")}


def _asked(field: wr.RadioField, ds: wr.SpectrumDataset, last: np.ndarray) -> Values:
    """What a fitted field answers at a receiver that it has not seen, and how it scores there."""
    spectrum = field.spectrum(last)
    score = wr.evaluate(ds.subset([1, 4]), field.spectrum)
    return {
        "path_gain": (spectrum.path_gain, FITTED),
        "total": (spectrum.path_gain.sum(), FITTED_DB),
        "delay_s": (np.nanmedian(spectrum.delay_s), Check(rtol=0.01)),
        "psnr_db": (score["psnr_db"], Check(atol=0.25)),
        "rmse_db": (score["rmse_db"], Check(atol=0.1)),
    }


@case
def bistatic_field() -> Values:
    field, ds = bistatic(), spectra()
    rx = ds.receivers[2]
    moved = field.spectrum(rx, transmitter=(4.0, 4.0, 2.2))
    paths = field.paths(rx)
    with tempfile.TemporaryDirectory() as folder:
        field.save(Path(folder) / "field.safetensors")
        back = wr.RadioField.load(Path(folder) / "field.safetensors").spectrum(rx)
    sharp = np.asarray(paths.kind) != "diffuse"
    some = field.paths(rx, max_paths=5)
    return {
        **_asked(field, ds, rx),
        "moved": (moved.path_gain, FITTED),
        "model": (field.model, BITS),
        "back": (np.allclose(back.path_gain, field.spectrum(rx).path_gain, rtol=1e-6), BITS),
        "sum": (abs(np.sum(np.abs(paths.gain) ** 2) / field.spectrum(rx).path_gain.sum() - 1) < 1e-5, BITS),
        "mirror_tau": (np.sort(paths.tau[sharp]), FLOAT64), "kinds": (np.unique(paths.kind), BITS),
        "mirror_power": (np.sort(np.abs(paths.gain[sharp]) ** 2), Check(rtol=0.05)),
        "some": (len(some.gain), BITS),
        "air": (field.with_gas(True).spectrum(rx).path_gain, FITTED),
    }  # fmt: skip


@case
def bistatic_field_with_held_out_receivers() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 2, 3, 5, 6, 7]), model="bistatic", sub_pixels=1)
    doubtful = field.spectrum(ds.receivers[4], uncertainty=True)
    return {
        **_asked(field, ds, ds.receivers[4]),
        "std_db": (np.median(doubtful.std_db), Check(rtol=0.1)),
    }


@case
def bistatic_field_of_a_bare_mesh() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room().mesh, ds.subset([0, 3, 6]))
    return _asked(field, ds, ds.receivers[4])


@case
def rf3dgs_plus() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 3, 6]), model="rf3dgs+", iterations=40)
    paths = field.paths(ds.receivers[1])
    return {**_asked(field, ds, ds.receivers[1]), "power": (np.sum(np.abs(paths.gain) ** 2), FITTED_DB)}


@case
def rf3dgs() -> Values:
    ds = spectra()
    field = wr.RadioField.fit(room(), ds.subset([0, 3, 6]), model="rf3dgs", iterations=40)
    return _asked(field, ds, ds.receivers[1])


@case
def coverage() -> Values:
    field = bistatic()
    links = field.links(places(5), beam_sigma_rad=BEAM_RAD)
    chart = field.radio_map(1.4, cell=1.0, beam_sigma_rad=BEAM_RAD)
    with tempfile.TemporaryDirectory() as folder:
        chart.save(Path(folder) / "map.nc")
        back = wr.RadioMap.load(Path(folder) / "map.nc")
    return {
        "link_total": (links.total_path_gain, FITTED_DB), "link_best": (links.best_path_gain, FITTED_DB),
        "link_spread_s": (links.delay_spread_s, Check(rtol=0.05)), "link_beam": (links.best_beam_gain, FITTED_DB),
        "x": (chart.x, FLOAT64), "y": (chart.y, FLOAT64), "free": (chart.free, BITS),
        "total": (np.nan_to_num(chart.total_path_gain), FITTED_DB),
        "back": (np.array_equal(back.total_path_gain, chart.total_path_gain, equal_nan=True), BITS),
    }  # fmt: skip


@case
def twin() -> Values:
    with tempfile.TemporaryDirectory() as folder:
        wr.interop.write_twin(bistatic(), Path(folder) / "twin")
        scene = wr.Scene.load(Path(folder) / "twin" / "scene.xml")
    area = np.bincount(scene.face_material, weights=scene.mesh.areas)
    return {
        "bounds": (np.asarray(scene.bounds), Check(atol=1e-6)), "area": (np.sort(area), Check(rtol=1e-5)),
        "scattering": (np.sort([m.scattering_coefficient(CARRIER_HZ) for m in scene.materials]), FITTED_METRIC),
        "permittivity": (
            np.sort([m.permittivity(CARRIER_HZ).real for m in scene.materials]), Check(rtol=0.1, atol=0.1)
        ),
    }  # fmt: skip


@case
def relevance() -> Values:
    found = wr.relevance(
        room(), transmitter=TRANSMITTER, receivers=places(3)[1:], frequency_hz=CARRIER_HZ, tolerance_db=1.0,
        shape=SHAPE, beam_sigma_rad=BEAM_RAD,
    )  # fmt: skip
    told = found.to_dict()
    effects = {e["name"]: e for e in told["effects"]} if "effects" in told else {}
    return {
        "names": (sorted(effects), BITS),
        "image_db": (found.image_db, Check(atol=0.2)), "total_db": (found.total_db, Check(atol=0.2)),
    }  # fmt: skip


def main(names: list[str]) -> None:
    """Write the goldens of ``names``, or all."""
    for name in names or CASES:
        np.savez_compressed(HERE / f"{name}.npz", **{k: v for k, (v, _) in values(name).items()})
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])
