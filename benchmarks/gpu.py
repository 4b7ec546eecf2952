"""What a GPU does: its tests, and the times of everything that is launched there, within ten minutes.

gsplat (Ye et al., "gsplat: An open-source library for Gaussian splatting", JMLR 26, 2025; version 1.5's
``rasterization``) takes turns with ours if it and a torch with CUDA are installed. It blends ellipses of a projection
made affine, so its image is another one.
"""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warprrf as wr
from benchmarks.data import DATA
from benchmarks.lobby.photos import read_poses
from benchmarks.lobby.spectra import FREQUENCY_HZ, TRANSMITTER
from benchmarks.machine import machine
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import require, resolve
from warprrf.files import write_json
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.geometry.splats.rasterizer import RADIO, Rasterizer
from warprrf.geometry.splats.render import blend_weights

PART_LIMIT_S = 300.0
"""A part that takes longer is stopped: compilers included, all together take less than ten minutes."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        gaussians: on the lobby's surfaces, which a photo and a spectrum are blended from.
        spectrum: rows and columns of that spectrum.
        receivers: whose spectra the RF-3DGS+ field is fitted to.
        discs: Gaussians of that field.
        field: rows and columns of the fields' spectra.
        subdivisions: of the closed mesh, 20 x 4^n triangles.
        rays: at once.
        repeats: timed runs after one that compiles; the fastest counts.
    """

    gaussians: int = 1_000_000
    spectrum: tuple[int, int] = (90, 360)
    receivers: int = 700
    discs: int = 30_000
    field: tuple[int, int] = (90, 180)
    subdivisions: int = 6
    rays: int = 1_000_000
    repeats: int = 10


DRY = Sizes(2_000, (18, 36), 12, 1_000, (18, 36), 3, 3_000, 2)


def lobby() -> wr.Scene:
    """The lobby's true scene."""
    return wr.Scene.load(f"{DATA}/scene.xml")


def blending(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds forward and backward on a photo of three channels, and gsplat's; of the strongest weights of a spectrum's
    pixels, and of a spectrum of one channel from Gaussians that lie on the device."""
    cam = next(iter(read_poses(Path(DATA) / "poses_true.json").values()))
    receiver = wr.Camera.spherical(*sizes.spectrum[::-1], position=cam.position)
    g = discs_on_mesh(lobby().mesh, sizes.gaussians)
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(cam.height, cam.width, 3)).astype(np.float32)
    colours = rng.random((len(g), 3)).astype(np.float32)
    raster = Rasterizer(device=device)
    inputs, features = raster.upload(g), wp.array(colours, dtype=wp.float32, device=device)
    for array in (*inputs, features):
        array.requires_grad = True
    slope = wp.array(slopes, dtype=wp.float32, device=device)
    tape: list[wp.Tape] = []

    def forward() -> None:
        tape[:] = [wp.Tape()]
        with tape[0]:
            image = raster.rasterize(*inputs, features, cam)
        image.features.grad.assign(slope)

    def backward() -> None:
        tape[0].backward()

    radio = Rasterizer(device=device, blending=RADIO)
    frozen, gains = radio.upload(g), wp.array(np.ones((len(g), 1)), dtype=wp.float32, device=device)
    peer = _gsplat(g, colours, slopes, cam, device)
    runs: dict[str, Callable[[], Any]] = {"forward_s": forward, "backward_s": backward, **peer}
    found: dict[str, Any] = _fastest(runs, sizes.repeats, device)
    found["seconds"] = found["forward_s"] + found["backward_s"]
    if peer:
        found["over_gsplat"] = found["seconds"] / (found["gsplat_forward_s"] + found["gsplat_backward_s"])
    spectra: dict[str, Callable[[], Any]] = {
        "spectrum_s": lambda: radio.rasterize(*frozen, gains, receiver),
        "blending_weights_s": lambda: blend_weights(g, receiver, device=device),
    }
    return found | _fastest(spectra, sizes.repeats, device)


def stage_2(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds of an RF-3DGS+ fit in the lobby: blending weights, and the steps. Power is random and falls on every pixel,
    which is the most work that spectra can be."""
    scene, rng = lobby(), np.random.default_rng(0)
    receivers = wr.sample_receivers(scene, sizes.receivers, seed=0, device=device)
    ds = wr.SpectrumDataset.from_spectra(
        receivers=receivers, transmitter=np.array(TRANSMITTER), frequency_hz=FREQUENCY_HZ,
        beam_sigma_rad=np.radians(2.0),
        path_gain=10 ** rng.uniform(-14, -12, (len(receivers), *sizes.field)),
    )  # fmt: skip
    geometry = wr.Reconstruction(discs_on_mesh(scene.mesh, sizes.discs), scene.mesh)
    fit = partial(wr.RadioField.fit, geometry, model="rf3dgs+", device=device)
    fit(ds.subset(range(min(4, len(ds)))), iterations=2)  # kernels are compiled
    started = time.perf_counter()
    report = fit(ds).report
    return {
        "receivers": len(ds), "weights_s": report["transport_time_s"], "fit_s": report["fit_time_s"],
        "stage_2_s": time.perf_counter() - started,
    }  # fmt: skip


def bistatic(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds of an exact spectrum of the lobby, of a bistatic field's fit to ten of them, the first one of a process and
    the next, and of its spectrum at a new receiver."""
    scene = lobby()
    places = wr.sample_receivers(scene, 11, seed=0, device=device)
    link: dict[str, Any] = {"transmitter": TRANSMITTER, "frequency_hz": FREQUENCY_HZ, "shape": sizes.field}
    simulated = partial(wr.simulate, scene, device=device, **link)
    simulated(receivers=places[:1])  # kernels are compiled
    started = time.perf_counter()
    train = simulated(receivers=places[1:])
    exact_s = (time.perf_counter() - started) / len(train)
    new = iter(wr.sample_receivers(scene, sizes.repeats + 1, seed=1, device=device))
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        field = wr.RadioField.fit(scene, train, model="bistatic", device=device)
        seconds.append(time.perf_counter() - started)
    asked = {"spectrum_s": lambda: field.spectrum(next(new))}
    timed = _fastest(asked, sizes.repeats, device)
    return {"exact_spectrum_s": exact_s, "first_fit_s": seconds[0], "fit_s": seconds[1], **timed}


def mesh_rays(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Rays per second against a closed mesh: nearest hits and lines of sight, here and, for comparison, on the CPU."""
    rng = np.random.default_rng(0)
    sphere = require("trimesh.creation", extra="test").icosphere(subdivisions=sizes.subdivisions, radius=3.0)
    bumps = 1.0 + 0.02 * rng.random((len(sphere.vertices), 1))
    mesh = wr.Mesh(sphere.vertices * bumps, sphere.faces)
    origins, directions = rng.uniform(-1, 1, (sizes.rays, 3)), rng.standard_normal((sizes.rays, 3))
    ends = rng.uniform(-5, 5, (sizes.rays, 3))
    runs: dict[str, Callable[[], Any]] = {}
    for name, where in {"": device, "cpu_": resolve("cpu")}.items():
        runs[f"{name}hits"] = partial(mesh.cast, origins, directions, device=where)
        runs[f"{name}sights"] = partial(mesh.visible, origins, ends, device=where)
    found = _fastest(runs, sizes.repeats, device)
    here, there = (mesh.cast(origins, directions, device=where).t for where in (device, "cpu"))
    rates = {f"{name}_per_s": sizes.rays / seconds for name, seconds in found.items()}
    return {"triangles": len(mesh.faces), **rates, "largest_difference_m": float(np.abs(here - there).max())}


PARTS: dict[str, Callable[[Sizes, wp.Device], dict[str, Any]]] = {
    "blending": blending, "mesh_rays": mesh_rays, "stage_2": stage_2, "bistatic": bistatic,
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """What of it to measure."""

    dry: bool = option(False, "tiny sizes on the CPU, although there is a GPU")
    parts: tuple[str, ...] = option(("tests", *PARTS), "what to run", choices=("tests", *PARTS))


def run(options: Options, job: Job) -> None:
    """Every part, one process each; a part that fails is listed under ``failed`` and costs no other.

    Raises:
        ValueError: if a part failed.
    """
    dry = options.dry or not wp.is_cuda_available()
    device = resolve("cpu" if dry else job.device or "cuda:0")
    path = job.out / f"gpu-{re.sub(r'[^a-z0-9]+', '-', device.name.lower()).strip('-')}.json"
    result: dict[str, Any] = {
        "machine": machine(device), "sizes": asdict(DRY if dry else Sizes()), "seconds": {}, "failed": {},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        for name in options.parts:
            print(f"{name} ...", flush=True)
            started = time.monotonic()
            found, error = _tests(dry) if name == "tests" else _apart(name, str(device), dry, folder)
            result["seconds"][name] = time.monotonic() - started
            result[name] = found
            if error:
                result["failed"][name] = error
            print(error or json.dumps(found, indent=2), flush=True)
            if not dry:
                write_json(path, result)  # after each part: what was measured is not lost
    why = "asked for a dry run" if options.dry else _refusal("cuda")
    print(
        f"No GPU was measured: {why}. Every part ran on the CPU in tiny sizes; nothing written."
        if dry
        else path
    )
    if result["failed"]:
        raise ValueError(f"failed: {', '.join(result['failed'])}")


def _refusal(device: str) -> str:
    """Why there is no such device."""
    try:
        resolve(device)
    except ValueError as error:
        return str(error)
    return ""


def run_part(name: str, device: str, dry: bool, folder: str) -> None:
    """Measure one part of :data:`PARTS` and write it to ``folder``."""
    with wp.ScopedDevice(device):
        found = PARTS[name](DRY if dry else Sizes(), resolve(device))
        write_json(Path(folder) / f"{name}.json", found)


def _tests(dry: bool) -> tuple[dict[str, Any], str]:
    """The tests of kernels and laws on the GPU; collected alone in a dry run."""
    how = ["--collect-only"] if dry else ["-n", "logical"]
    words = [sys.executable, "-m", "pytest", "-q", "-m", "cuda", "tests", "--ignore=tests/viewer", *how]
    done, error = _process(words)
    line = next((text for text in reversed(done.splitlines()) if text.strip()), "")
    return {"summary": line.strip("= ")}, error


def _apart(name: str, device: str, dry: bool, folder: str) -> tuple[dict[str, Any], str]:
    """A part in a process of its own: what it found, and its error."""
    code = f"from benchmarks.gpu import run_part; run_part({name!r}, {device!r}, {dry}, {folder!r})"
    _, error = _process([sys.executable, "-c", code])
    file = Path(folder) / f"{name}.json"
    return (json.loads(file.read_text()) if file.exists() else {}), error


def _process(words: list[str]) -> tuple[str, str]:
    """What a process printed, and what is wrong with it."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PART_LIMIT_S)
    except subprocess.TimeoutExpired:
        return "", f"stopped after {PART_LIMIT_S:.0f} s"
    return done.stdout, "" if done.returncode == 0 else done.stdout[-2_000:] + done.stderr[-2_000:]


def _gsplat(
    g: wr.Gaussians, colours: np.ndarray, slopes: np.ndarray, cam: wr.Camera, device: wp.Device
) -> dict[str, Callable[[], Any]]:
    """gsplat's passes forward and backward over the same scene; none where it cannot run."""
    if not device.is_cuda or any(importlib.util.find_spec(name) is None for name in ("torch", "gsplat")):
        return {}
    torch, library = importlib.import_module("torch"), importlib.import_module("gsplat")
    if not torch.cuda.is_available():
        return {}
    place = wp.device_to_torch(device)
    values = (g.means, g.quaternions, g.scales, g.opacities, colours)
    parameters = [torch.tensor(v, device=place, requires_grad=True) for v in values]
    slope = torch.tensor(slopes, device=place)
    pose = torch.tensor(cam.world_to_camera, dtype=torch.float32, device=place)[None]
    lens = [[cam.fx, 0, cam.cx], [0, cam.fy, cam.cy], [0, 0, 1]]
    intrinsics = torch.tensor(lens, dtype=torch.float32, device=place)[None]
    image: list[Any] = []

    def forward() -> None:
        image[:] = [
            library.rasterization(*parameters, pose, intrinsics, cam.width, cam.height, packed=False)[0][0]
        ]
        torch.cuda.synchronize()

    def backward() -> None:
        for parameter in parameters:
            parameter.grad = None
        (image[0] * slope).sum().backward()
        torch.cuda.synchronize()

    return {"gsplat_forward_s": forward, "gsplat_backward_s": backward}


def _fastest(runs: dict[str, Callable[[], Any]], repeats: int, device: wp.Device) -> dict[str, float]:
    """Seconds of the fastest of ``repeats`` runs of each, in turns, after one that compiles."""
    best = dict.fromkeys(runs, np.inf)
    for turn in range(repeats + 1):
        for name, work in runs.items():
            started = time.perf_counter()
            work()
            wp.synchronize_device(device)
            if turn:
                best[name] = min(best[name], time.perf_counter() - started)
    return {name: float(seconds) for name, seconds in best.items()}


HELP = """\
Runs the tests of kernels and laws on CUDA, then measures, each in a process of its own: forward and backward of a
million Gaussians beside gsplat (if it is installed), blending weights, a spectrum, mesh rays, a fit of RF-3DGS+ to 700
receivers, exact spectra, a bistatic field's fit and spectrum. Writes benchmarks/results/gpu-NAME.json after each of
them, in less than ten minutes.
Without a CUDA device it runs all parts on the CPU in tiny sizes, says so, and writes nothing.

examples:
  python -m benchmarks gpu
  python -m benchmarks gpu --parts blending mesh_rays
"""

BENCHMARKS = {"gpu": Benchmark("gpu", Options, run, HELP, "benchmarks/results")}
