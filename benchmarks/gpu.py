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
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.engine.rays import bumpy_sphere
from benchmarks.engine.scenes import gaussians, panorama, photo, room
from benchmarks.lobby.spectra import TRANSMITTER
from benchmarks.machine import machine
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import resolve
from warprrf.files import write_json
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.geometry.splats.rasterizer import RADIO, Rasterizer
from warprrf.geometry.splats.render import blend_weights
from warprrf.rf.fields.base import RadioField
from warprrf.rf.scene import Scene
from warprrf.rf.simulate import sample_receivers, simulate

PART_LIMIT_S = 300.0
"""A part that takes longer is stopped: compilers included, all together take less than ten minutes."""

FREQUENCY_HZ = 300e9


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        gaussians: of the room that is blended.
        photo, spectrum: rows and columns of what it is blended to.
        receivers: whose spectra the RF-3DGS+ field is fitted to.
        discs: Gaussians of that field.
        field: rows and columns of the fields' spectra.
        triangles, rays: of the closed mesh, and at once.
        repeats: timed runs after one that compiles; the fastest counts.
    """

    gaussians: int = 1_000_000
    photo: tuple[int, int] = (600, 800)
    spectrum: tuple[int, int] = (90, 360)
    receivers: int = 700
    discs: int = 30_000
    field: tuple[int, int] = (90, 180)
    triangles: int = 82_000
    rays: int = 1_000_000
    repeats: int = 10


DRY = Sizes(2_000, (30, 40), (18, 36), 6, 1_000, (18, 36), 2_000, 3_000, 2)

ASKED = {"over_gsplat": 1.0, "spectrum_s": 1e-3, "stage_2_s": 15.0}
"""Hoped for: our time over gsplat's, seconds of a spectrum, and of a fit to 700 receivers (222 s in the paper)."""


def blending(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds forward and backward on a photo of three channels, and gsplat's; of the strongest weights of a spectrum's
    pixels, and of a spectrum of one channel from Gaussians that lie on the device."""
    height, width = sizes.photo
    cam, receiver = photo(width, height), panorama(*sizes.spectrum)
    means, quaternions, scales, opacities, colors = room(sizes.gaussians)
    g = gaussians(sizes.gaussians)
    slopes = np.random.default_rng(0).normal(size=(height, width, 3)).astype(np.float32)
    raster = Rasterizer(device=device)
    inputs, features = raster.upload(g), wp.array(colors, dtype=wp.float32, device=device)
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

    def both() -> None:
        forward()
        backward()

    radio = Rasterizer(device=device, blending=RADIO)
    frozen, gains = radio.upload(g), wp.array(np.ones((len(g), 1)), dtype=wp.float32, device=device)
    runs: dict[str, Callable[[], Any]] = {"forward_s": forward, "backward_s": backward}
    peer = _gsplat((means, quaternions, scales, opacities, colors), slopes, cam, device)
    found: dict[str, Any] = _fastest({**runs, **peer}, sizes.repeats, device)
    found["seconds"] = found["forward_s"] + found["backward_s"]
    if peer:
        found["over_gsplat"] = found["seconds"] / (found["gsplat_forward_s"] + found["gsplat_backward_s"])
    found |= _fastest(
        {
            "spectrum_s": lambda: radio.rasterize(*frozen, gains, receiver),
            "blending_weights_s": lambda: blend_weights(g, receiver, device=device),
        },
        sizes.repeats,
        device,
    )
    found["kernels_ms"] = {
        "forward and backward": _activities(both),
        "spectrum": _activities(lambda: radio.rasterize(*frozen, gains, receiver)),
    }
    return found


def stage_2(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds of an RF-3DGS+ fit from exact spectra of the lobby: blending weights, and the steps."""
    scene = Scene.load("data/lobby/scene.xml")
    receivers = sample_receivers(scene, sizes.receivers, seed=0, device=device)
    started = time.perf_counter()
    ds = simulate(
        scene, transmitter=TRANSMITTER, receivers=receivers, frequency_hz=FREQUENCY_HZ, shape=sizes.field,
        device=device,
    )  # fmt: skip
    simulated = time.perf_counter() - started
    geometry = _Covered(discs_on_mesh(scene.mesh, sizes.discs), scene.mesh)
    RadioField.fit(
        geometry, ds.subset(np.arange(min(4, len(receivers)))), model="rf3dgs+", iterations=2, device=device
    )
    started = time.perf_counter()
    report = RadioField.fit(geometry, ds, model="rf3dgs+", device=device).report
    return {
        "receivers": len(receivers),
        "simulate_s": simulated,
        "weights_s": report["transport_time_s"],
        "fit_s": report["fit_time_s"],
        "stage_2_s": time.perf_counter() - started,
        "loss": report["losses"]["gain"][-1],
    }


def bistatic(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Seconds of a bistatic field's fit to ten spectra of the lobby, and of its spectrum at a new receiver."""
    scene = Scene.load("data/lobby/scene.xml")
    places = sample_receivers(scene, min(10, sizes.receivers) + sizes.repeats + 1, seed=0, device=device)
    train, new = places[: -sizes.repeats - 1], iter(places[-sizes.repeats - 1 :])
    ds = simulate(
        scene,
        transmitter=TRANSMITTER,
        receivers=train,
        frequency_hz=FREQUENCY_HZ,
        shape=sizes.field,
        device=device,
    )
    started = time.perf_counter()
    field = RadioField.fit(scene, ds, model="bistatic", device=device)
    fitted = time.perf_counter() - started
    return {
        "fit_s": fitted,
        **_fastest({"spectrum_s": lambda: field.spectrum(next(new))}, sizes.repeats, device),
    }


def mesh_rays(sizes: Sizes, device: wp.Device) -> dict[str, Any]:
    """Rays per second against a closed mesh: nearest hits and lines of sight, here and, for comparison, on the CPU."""
    mesh, rng = bumpy_sphere(sizes.triangles), np.random.default_rng(0)
    origins, directions = rng.uniform(-1, 1, (sizes.rays, 3)), rng.standard_normal((sizes.rays, 3))
    ends = rng.uniform(-5, 5, (sizes.rays, 3))
    runs: dict[str, Callable[[], Any]] = {}
    for name, where in {"": device, "cpu_": resolve("cpu")}.items():
        runs[f"{name}hits"] = partial(mesh.cast, origins, directions, device=where)
        runs[f"{name}sights"] = partial(mesh.visible, origins, ends, device=where)
    found = _fastest(runs, sizes.repeats, device)
    agree = np.abs(
        mesh.cast(origins, directions, device=device).t - mesh.cast(origins, directions, device="cpu").t
    )
    return {
        "triangles": len(mesh.faces),
        **{f"{name}_per_s": sizes.rays / seconds for name, seconds in found.items()},
        "largest_difference_m": float(agree.max()),
    }


PARTS: dict[str, Callable[[Sizes, wp.Device], dict[str, Any]]] = {
    "blending": blending,
    "stage_2": stage_2,
    "bistatic": bistatic,
    "mesh_rays": mesh_rays,
}


@dataclass(frozen=True)
class Options:
    """What of it to measure."""

    dry: bool = option(False, "tiny sizes on the CPU, although there is a GPU")
    parts: tuple[str, ...] = option(("tests", *PARTS), "what to run", choices=("tests", *PARTS))


def run(options: Options, job: Job) -> None:
    """Every part, one process each; a part that fails is told under ``failed`` and costs no other.

    Raises:
        ValueError: if a part failed.
    """
    dry = options.dry or not wp.is_cuda_available()
    device = resolve("cpu" if dry else job.device or "cuda:0")
    path = job.out / f"gpu-{re.sub(r'[^a-z0-9]+', '-', device.name.lower()).strip('-')}.json"
    result: dict[str, Any] = {
        "machine": machine(device), "sizes": asdict(DRY if dry else Sizes()), "asked": ASKED, "seconds": {}, "failed": {},
    }  # fmt: skip
    for name in options.parts:
        print(f"{name} ...", flush=True)
        started = time.monotonic()
        found, error = _tests(dry) if name == "tests" else _apart(name, str(device), dry)
        result["seconds"][name] = time.monotonic() - started
        result[name] = found
        if error:
            result["failed"][name] = error
        print(
            error or json.dumps({k: v for k, v in found.items() if k != "kernels_ms"}, indent=2), flush=True
        )
        if not dry:
            write_json(path, result)  # after each part: what was measured is not lost
    why = "asked for a dry run" if options.dry else "no CUDA device here"
    print(
        f"No GPU was measured: {why}. Every part ran on the CPU in tiny sizes; nothing written."
        if dry
        else path
    )
    if result["failed"]:
        raise ValueError(f"failed: {', '.join(result['failed'])}")


def run_part(name: str, device: str, dry: bool, file: str) -> None:
    """Measure one part of :data:`PARTS` and write it to ``file``."""
    with wp.ScopedDevice(device):
        write_json(Path(file), PARTS[name](DRY if dry else Sizes(), resolve(device)))


def _tests(dry: bool) -> tuple[dict[str, Any], str]:
    """The tests of kernels and laws on the GPU; collected alone in a dry run."""
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "cuda",
        "tests",
        *(["--collect-only"] if dry else []),
    ]
    done, error = _process(words)
    line = next((text for text in reversed(done.splitlines()) if text.strip()), "")
    return {"summary": line.strip("= ")}, error


def _apart(name: str, device: str, dry: bool) -> tuple[dict[str, Any], str]:
    """A part in a process of its own: what it found, and its error."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "part.json"
        code = f"from benchmarks.gpu import run_part; run_part({name!r}, {device!r}, {dry}, {str(file)!r})"
        _, error = _process([sys.executable, "-c", code])
        return (json.loads(file.read_text()) if file.exists() else {}), error


def _process(words: list[str]) -> tuple[str, str]:
    """What a process printed, and what is wrong with it."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PART_LIMIT_S)
    except subprocess.TimeoutExpired:
        return "", f"stopped after {PART_LIMIT_S:.0f} s"
    return done.stdout, "" if done.returncode == 0 else (done.stdout + done.stderr)[-4_000:]


@dataclass(frozen=True)
class _Covered:
    """Gaussians on a mesh: the geometry of a fit."""

    gaussians: Any
    mesh: Mesh


def _gsplat(
    values: Sequence[np.ndarray], slopes: np.ndarray, cam: Any, device: wp.Device
) -> dict[str, Callable[[], Any]]:
    """gsplat's passes forward and backward over the same scene; none where it cannot run."""
    if not device.is_cuda or any(importlib.util.find_spec(name) is None for name in ("torch", "gsplat")):
        return {}
    torch, library = importlib.import_module("torch"), importlib.import_module("gsplat")
    if not torch.cuda.is_available():
        return {}
    place = wp.device_to_torch(device)
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


def _activities(work: Callable[[], Any]) -> dict[str, float]:
    """Milliseconds on the GPU of each kernel and copy of ``work``, the largest first; none on a CPU."""
    wp.timing_begin()
    work()
    total: dict[str, float] = {}
    for found in wp.timing_end():
        total[found.name] = total.get(found.name, 0.0) + found.elapsed
    return dict(sorted(total.items(), key=lambda item: -item[1]))


HELP = """\
Runs the tests of kernels and laws on CUDA, then measures, each in a process of its own: forward and backward of a
million Gaussians beside gsplat (if it is installed), blending weights, a spectrum, a fit of RF-3DGS+ to 700 receivers,
a bistatic field's fit and spectrum, and mesh rays. Writes benchmarks/results/gpu-NAME.json, in less than ten minutes.
Without a CUDA device it runs all parts on the CPU in tiny sizes, says so, and writes nothing.

examples:
  python -m benchmarks gpu
  python -m benchmarks gpu --parts blending mesh_rays
"""

BENCHMARKS = {"gpu": Benchmark("gpu", Options, run, HELP, "benchmarks/results")}
