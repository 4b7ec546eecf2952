"""Channels measured: against closed forms, against Sionna RT on the lobby, and the speed of wide responses.

Rows: closed forms at 300 GHz and 100 m; line of sight and mirrors of the lobby beside Sionna RT's; the frequency
response over 69.12 GHz (IEEE Std 802.15.3d-2017, channel 69) beside Sionna's own ``cfr`` and beside dense float64 sums;
what the plane wave costs a large array near by.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.machine import machine
from benchmarks.pictures import figure_of
from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.geometry.mesh import Mesh
from warprrf.rf.channel.arrays import PlanarArray, plane_wave_error
from warprrf.rf.channel.band_plan import thz_channel
from warprrf.rf.em.fresnel import slab_reflection
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase
from warprrf.rf.interop.sionna_engine import load_sionna_scene
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer, trace_paths
from warprrf.rf.scene import Scene
from warprrf.rf.scene_sionna import sionna_rt

FREQUENCY_HZ = 300e9
TRANSMITTER = (13.6, 11.2, 2.5)
SAME_M = 5e-3  # paths of the two tracers are one if lengths and unit directions differ by less, summed
SHORT_LEG_M = 0.2
"""Sionna's interaction points are right to 1e-4 m (float32): a leg between two of them that is shorter than this turns
by half a milliradian, which moves reflection coefficients. Such paths are counted apart."""
SIDES = (4, 8, 16, 32, 64, 128)
DISTANCES_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
ENTRIES = 400
"""Entries of the large response that are summed densely to check it: half at random, half among the largest."""


HELP = """\
Closed forms at 300 GHz and 100 m, line of sight and mirrors of the lobby beside Sionna RT's, the frequency response
over 69.12 GHz beside Sionna's own, and what the plane wave costs a large array near by.

examples:
  python -m benchmarks channel
  python -m benchmarks channel --no-large --no-sionna        a first look, in seconds
"""


@dataclass(frozen=True)
class Options:
    """Options of the channels.

    Attributes:
        scene: scene XML of the comparison with Sionna RT, materials beside it.
        large: whether to measure 1e5 paths between 1024 and 16 elements at 2048 frequencies (about 1.5 GB).
        sionna: whether to compare with Sionna RT, which must then be installed.
        receivers: of that comparison.
    """

    scene: str = option("data/lobby/scene.xml", "scene compared with Sionna RT (XML)")
    large: bool = option(True, "1e5 paths between 1024 and 16 elements (1.5 GB)")
    sionna: bool = option(True, "the comparison with Sionna RT")
    receivers: int = option(30, "receivers of that comparison")


def run(options: Options, job: Job) -> Report:
    """Measure all rows.

    Raises:
        ImportError: if Sionna RT is asked for and missing.
    """
    steps: list[tuple[str, Callable[[], Any]]] = [
        ("closed_forms", lambda: closed_forms(job.seed)),
        ("plane_wave", plane_wave_table),
    ]
    if options.sionna:
        scene = options.scene
        steps.append(("lobby", lambda: against_sionna(scene, options.receivers, job.seed, job.device)))
        steps.append(("small", lambda: small_response(scene)))
    if options.large:
        steps.append(("large", lambda: [large_response(s, job.seed) for s in (False, True)]))
    figures: dict[str, Any] = {"machine": machine(job.device), "seed": job.seed}
    for k, (name, measure) in enumerate(steps):
        job.progress("channel", k, len(steps))
        figures[name] = measure()
    job.progress("channel", len(steps), len(steps))
    caption = "What a beam steered by a plane wave loses near by."
    return Report("channel", figures, text(figures), {"plane_wave.png": (_picture, caption)}, dpi=120)


def closed_forms(seed: int = 0, trials: int = 50) -> dict[str, dict[str, float]]:
    """Largest relative error of gain and error of phase [rad] at 300 GHz and about 100 m, over random places.

    Friis; the two rays over a slab, both polarisations; the four images of a corner of two perfect mirrors.
    """
    rng = np.random.default_rng(seed)
    slab = Material.custom("slab", relative_permittivity=5.0, conductivity=0.5, thickness_m=0.02)
    floor = Mesh([[-300, -300, 0], [300, -300, 0], [300, 300, 0], [-300, 300, 0]], [[0, 1, 2], [0, 2, 3]])
    ground = Scene(floor, [slab], np.zeros(2, dtype=np.int32))
    s = 300.0
    corners = [[0, 0, -s], [s, 0, -s], [s, 0, s], [0, 0, s], [0, s, -s], [0, s, s]]
    corner = Mesh(corners, [[0, 1, 2], [0, 2, 3], [0, 5, 4], [0, 3, 5]])
    errors: dict[str, list[tuple[float, float]]] = {"friis": [], "two_ray": [], "images": []}
    for _ in range(trials):
        f = rng.uniform(252.72e9, 321.84e9)
        tx, rx = (
            np.array([0.0, 0.0, rng.uniform(1, 5)]),
            np.array([100.0, *rng.uniform(-3, 3, 1), rng.uniform(1, 5)]),
        )
        direct, bounced = (float(np.linalg.norm(rx - tx * [1, 1, side])) for side in (1, -1))
        free = trace_paths(ground, transmitter=tx, receivers=rx, frequency_hz=f, mirror_order=0)
        errors["friis"].append(_error(free.cfr([f])[0, 0, 0], _friis(direct, f)))
        both = trace_paths(ground, transmitter=tx, receivers=rx, frequency_hz=f)
        cosine = (tx[2] + rx[2]) / bounced
        te, tm = slab_reflection(cosine, slab.permittivity(f), slab.thickness_m, SPEED_OF_LIGHT / f)
        for polarisation, reflection, sign in (("V", tm, 1.0), ("H", te, -1.0)):
            a = PlanarArray(1, 1, polarisation=polarisation)
            # Azimuth unit vectors of departure and arrival are opposite; zenith's are so to the ray, as TM's basis is.
            expected = complex(sign * (_friis(direct, f) + complex(reflection) * _friis(bounced, f)))
            found = both.cfr([f], tx_array=a, rx_array=a)[0, 0, 0]
            errors["two_ray"].append(_error(found, expected))
        tx, rx = rng.uniform(10, 80, 3), rng.uniform(10, 80, 3)
        four = trace_paths(corner, transmitter=tx, receivers=rx, frequency_hz=f, mirror_order=2)
        images = [tx * [i, j, 1] for i in (1, -1) for j in (1, -1)]
        expected = sum(_friis(float(np.linalg.norm(image - rx)), f) for image in images)
        errors["images"].append(_error(four.cfr([f])[0, 0, 0], expected))
    return {
        name: {
            "gain": max(e[0] for e in found),
            "phase_rad": max(e[1] for e in found),
            "trials": len(found),
        }
        for name, found in errors.items()
    }


def _friis(length_m: float, frequency_hz: float) -> complex:
    wavelength = SPEED_OF_LIGHT / frequency_hz
    return complex(
        wavelength / (4 * np.pi * length_m) * carrier_phase(frequency_hz, length_m / SPEED_OF_LIGHT)
    )


def _error(found: complex, expected: complex) -> tuple[float, float]:
    return abs(abs(found) / abs(expected) - 1.0), abs(float(np.angle(found / expected)))


def against_sionna(
    scene: str | os.PathLike[str], receivers: int, seed: int = 0, device: Any = None
) -> dict[str, float]:
    """Line of sight and up to two mirrors of a scene beside Sionna RT's, path by path: largest differences.

    Sionna finds mirrors by shooting rays and repeats those of finely split surfaces: repeats are left out, paths that
    only one of the two has are counted.
    """
    room = Scene.load(scene)
    points = _places(room, receivers, seed)
    carrier = thz_channel(69).center_hz
    solved, sionna_s = _solve(room, points, carrier, _Ask())
    theirs = Paths.from_sionna(solved, frequency_hz=carrier, drop_repeated=True)
    start = time.perf_counter()
    tracer = MirrorTracer(room, transmitter=TRANSMITTER, frequency_hz=carrier, device=device)
    ours = [tracer.trace(p, 2) for p in points]
    ours_s = time.perf_counter() - start
    names = ("tau_s", "arrival_rad", "departure_rad", "gain_db_all", "gain_db", "jones")
    worst = dict.fromkeys(names, 0.0)
    matched = lone_theirs = lone_ours = short = 0
    for r, own in enumerate(ours):
        other = theirs[r]
        gap = (
            np.abs(other.tau[:, None] - own.tau) * SPEED_OF_LIGHT
            + np.linalg.norm(other.arrival[:, None] - own.arrival, axis=2)
            + np.linalg.norm(other.departure[:, None] - own.departure, axis=2)
        )
        near = gap.argmin(axis=1)
        good = gap[np.arange(len(near)), near] < SAME_M
        lone_theirs += int((~good).sum())
        lone_ours += len(own.tau) - len(set(near[good]))
        matched += int(good.sum())
        if not good.any():
            continue
        a, b = other.select(good), own.select(near[good])
        still = [
            p.jones * carrier_phase(-carrier, p.tau)[:, None, None] for p in (a, b) if p.jones is not None
        ]
        jones = np.abs(still[0] - still[1]).max(axis=(1, 2)) / np.abs(still[0]).max(axis=(1, 2))
        step = np.linalg.norm(np.diff(b.vertices, axis=1), axis=2)
        long = ~(step < SHORT_LEG_M).any(axis=1)
        short += int((~long).sum())
        gain_db = np.abs(10 * np.log10(a.power / b.power))
        for name, values in (
            ("tau_s", np.abs(a.tau - b.tau)),
            ("arrival_rad", np.linalg.norm(a.arrival - b.arrival, axis=1)),
            ("departure_rad", np.linalg.norm(a.departure - b.departure, axis=1)),
            ("gain_db_all", gain_db),
            ("gain_db", gain_db[long]),
            ("jones", jones[long]),
        ):
            worst[name] = max(worst[name], float(values.max(initial=0.0)))
    return {
        **worst,
        "paths": matched,
        "short_legs": short,
        "sionna_only": lone_theirs,
        "ours_only": lone_ours,
        "receivers": receivers,
        "sionna_seconds": sionna_s,
        "ours_seconds": ours_s,
    }


def small_response(scene: str | os.PathLike[str], repeats: int = 5) -> dict[str, Any]:
    """1000 paths, 64 x 4 elements, 256 frequencies over 69.12 GHz: seconds beside Sionna's own ``cfr``, and errors.

    Errors are of the largest entry, against the dense float64 sum of the same coefficients and delays. Sionna holds
    both in float32, which limits its own.
    """
    room = Scene.load(scene)
    channel = thz_channel(69)
    carrier, f = channel.center_hz, channel.frequencies_hz(256)
    point = _places(room, 1, 0)
    plain_ask = _Ask(samples=20_000, diffuse=True, most=1000)
    solved, _ = _solve(room, point, carrier, replace(plain_ask, tx=("V", 2, 2), rx=("V", 8, 8)))
    plain, _ = _solve(room, point, carrier, plain_ask)
    paths = Paths.from_sionna(plain, frequency_hz=carrier)[0]
    tx, rx = PlanarArray(2, 2, polarisation="V"), PlanarArray(8, 8, polarisation="V")
    baseband = (f - carrier).astype(np.float32)
    ports: dict[str, Any] = {"tx_array": tx, "rx_array": rx, "diffuse": "given", "normalize_delays": True}

    def sionna() -> np.ndarray:
        return np.asarray(solved.cfr(baseband, out_type="numpy"))[0, :, 0, :, 0]

    rows: dict[str, Any] = {"paths": len(paths.gain), "sionna_paths": int(solved.valid.numpy().sum())}
    truth = _dense(paths, tx, rx, f, carrier)
    rows["sionna_seconds"], theirs = _timed(sionna, repeats)
    rows["sionna_error"] = float(np.abs(theirs - truth).max() / np.abs(truth).max())
    for name in ("grid", "dense"):
        ours = partial(paths.cfr, f, squint=False, method=name, **ports)
        rows[f"{name}_seconds"], h = _timed(ours, repeats)
        rows[f"{name}_error"] = float(np.abs(h - truth).max() / np.abs(truth).max())
    rows["squint_seconds"], _ = _timed(partial(paths.cfr, f, **ports), repeats)
    rows["times_faster"] = rows["sionna_seconds"] / rows["grid_seconds"]
    return rows


def large_response(squint: bool, seed: int = 0) -> dict[str, Any]:
    """1e5 paths, 1024 x 16 elements, 2048 frequencies over 69.12 GHz: seconds, and errors against dense float64 sums.

    Paths bounce once at random points of the walls of a room of 18 x 12 x 4 m, with random phases. The error is the
    largest over :data:`ENTRIES` entries, relative to the largest entry, and relative to each of the largest ones.
    """
    channel = thz_channel(69)
    paths = _scattered(100_000, channel.center_hz, seed)
    f = channel.frequencies_hz(2048)
    tx, rx = PlanarArray(4, 4), PlanarArray(32, 32, orientation=(np.pi, 0, 0))
    # Kernels are compiled once a machine, not once a call.
    paths.select(np.arange(10)).cfr(f[:64], tx_array=tx, squint=squint, diffuse="given", method="grid")
    start, cpu = time.perf_counter(), time.process_time()
    h = paths.cfr(f, tx_array=tx, rx_array=rx, squint=squint, diffuse="given")
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    rng = np.random.default_rng(seed)
    flat = np.abs(h).reshape(-1)
    top = np.argpartition(flat, -ENTRIES // 2)[-ENTRIES // 2 :]
    chosen = np.concatenate([top, rng.integers(0, flat.size, ENTRIES - len(top))])
    m, n, k = np.unravel_index(chosen, h.shape)
    wavelength = SPEED_OF_LIGHT / channel.center_hz
    sending, receiving = tx.positions(wavelength), rx.positions(wavelength)
    truth = np.empty(len(chosen), dtype=complex)
    for i, (a, b, c) in enumerate(zip(m, n, k, strict=True)):
        longer = -(paths.arrival @ receiving[a] + paths.departure @ sending[b]) / SPEED_OF_LIGHT
        at = f[c] if squint else channel.center_hz
        turns = carrier_phase(f[c] - channel.center_hz, paths.tau) * carrier_phase(at, longer)
        truth[i] = (paths.gain * turns).sum()
    wrong = np.abs(h[m, n, k] - truth)
    return {
        "squint": squint,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "error_of_largest": float(wrong.max() / flat.max()),
        "error_in_largest_entries": float((wrong[: len(top)] / np.abs(truth[: len(top)])).max()),
        "terms": float(flat.size) * len(paths.gain),
    }


def plane_wave_table() -> list[dict[str, float]]:
    """What a beam steered by a plane wave loses on a spherical one, square arrays at half a wavelength, 300 GHz."""
    wavelength = SPEED_OF_LIGHT / FREQUENCY_HZ
    rows = []
    for side in SIDES:
        array = PlanarArray(side, side)
        for distance in DISTANCES_M:
            error = plane_wave_error(array, distance, wavelength)
            rows.append(
                {
                    "elements": float(side**2),
                    "distance_m": distance,
                    "phase_rad": error.phase_rad,
                    "beam_loss_db": error.beam_loss_db,
                    "fraunhofer_m": 2 * array.aperture_m(wavelength) ** 2 / wavelength,
                }
            )
    return rows


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    titles = {
        "friis": "Friis",
        "two_ray": "two rays over a slab, V and H",
        "images": "four images in a corner",
    }
    rows = [
        (
            f"{titles[name]}, 100 m, {e['trials']} trials",
            f"gain {e['gain']:.1e}, phase {e['phase_rad']:.1e} rad",
        )
        for name, e in figures["closed_forms"].items()
    ]
    if "lobby" in figures:
        e = figures["lobby"]
        found = (
            f"gain {e['gain_db']:.3f} dB ({e['gain_db_all']:.3f} dB with the {e['short_legs']} paths that have a leg "
            f"shorter than {SHORT_LEG_M:g} m), tau {e['tau_s']:.1e} s, angles {e['arrival_rad']:.1e} and "
            f"{e['departure_rad']:.1e} rad, coefficients {100 * e['jones']:.2f} %; Sionna only {e['sionna_only']}, "
            f"ours only {e['ours_only']}"
        )
        rows.append((f"lobby beside Sionna RT: {e['paths']} paths, {e['receivers']} receivers", found))
    if "small" in figures:
        e = figures["small"]
        grid = (
            f"{1e3 * e['grid_seconds']:.1f} ms, error {e['grid_error']:.1e}; Sionna {1e3 * e['sionna_seconds']:.0f} ms, "
            f"error {e['sionna_error']:.1e}: {e['times_faster']:.0f} times faster"
        )
        dense = f"{1e3 * e['dense_seconds']:.1f} ms, error {e['dense_error']:.1e}"
        rows.append((f"cfr, {e['paths']} paths, 64 x 4 elements, 256 frequencies", grid))
        rows.append(("the same, dense sum in float64", dense))
        rows.append(("the same with beam squint", f"{1e3 * e['squint_seconds']:.1f} ms"))
    for e in figures.get("large", []):
        squint = ", beam squint" if e["squint"] else ""
        found = (
            f"{e['seconds']:.1f} s ({e['cpu_seconds']:.1f} s of processor time), error {e['error_of_largest']:.1e} of "
            f"the largest entry, {e['error_in_largest_entries']:.1e} in the largest entries"
        )
        rows.append((f"cfr, 1e5 paths, 1024 x 16 elements, 2048 frequencies{squint}", found))
    losses = []
    for side in SIDES:
        own = [e for e in figures["plane_wave"] if e["elements"] == side**2]
        cells = [f"{e['beam_loss_db']:.2g}" for e in own]
        losses.append([str(side**2), *cells, f"{own[0]['fraunhofer_m']:.2g} m"])
    head = ["elements", *(f"{d:g} m" for d in DISTANCES_M), "2 D^2 / lambda"]
    about = "Loss of a beam steered by a plane wave [dB], 300 GHz, elements half a wavelength apart:"
    return "\n\n".join([table(("measured", "value"), rows), about, table(head, losses)])


# ------------------------------------------------------------------------------------------------------- pieces


def _places(room: Scene, count: int, seed: int) -> np.ndarray:
    """Random free places 1 to 2 m above the floor, half a metre from everything."""
    rng = np.random.default_rng(seed)
    low, high = room.bounds
    found = np.zeros((0, 3))
    while len(found) < count:
        trial = rng.uniform([low[0], low[1], 1.0], [high[0], high[1], 2.0], (4 * count + 20, 3))
        found = np.concatenate([found, trial[room.is_free(trial, clearance_m=0.5)]])
    return found[:count]


@dataclass(frozen=True)
class _Ask:
    """What Sionna's solver is asked for: polarisation, rows and columns of both arrays, and its own settings."""

    tx: tuple[str, int, int] = ("VH", 1, 1)
    rx: tuple[str, int, int] = ("VH", 1, 1)
    samples: int = 200_000
    diffuse: bool = False
    most: int = 1_000_000


def _solve(room: Scene, points: np.ndarray, carrier: float, ask: _Ask) -> tuple[Any, float]:
    """Sionna RT's paths of order 2 from :data:`TRANSMITTER` to ``points``, and the seconds of its solver."""
    loaded = load_sionna_scene(room, frequency_hz=carrier)
    rt = sionna_rt()
    for name, (polarisation, rows, cols) in (("tx_array", ask.tx), ("rx_array", ask.rx)):
        array = rt.PlanarArray(num_rows=rows, num_cols=cols, pattern="iso", polarization=polarisation)
        setattr(loaded, name, array)
    loaded.add(rt.Transmitter("tx", position=list(TRANSMITTER)))
    for k, point in enumerate(points):
        loaded.add(rt.Receiver(f"rx{k}", position=point.tolist()))
    solver = rt.PathSolver(deterministic=True)
    start = time.perf_counter()
    solved = solver(
        loaded, max_depth=2, samples_per_src=ask.samples, max_num_paths_per_src=ask.most, synthetic_array=True,
        los=True, specular_reflection=True, diffuse_reflection=ask.diffuse, refraction=False, seed=1,
    )  # fmt: skip
    np.asarray(solved.tau.numpy())
    return solved, time.perf_counter() - start


def _dense(paths: Paths, tx: PlanarArray, rx: PlanarArray, f: np.ndarray, carrier: float) -> np.ndarray:
    """Sum over paths by its definition, V elements, delays from the first path, shape ``(M, N, F)``."""
    wavelength = SPEED_OF_LIGHT / carrier
    a = (paths.jones if paths.jones is not None else np.zeros((0, 2, 2)))[:, 0, 0] * carrier_phase(
        -carrier, paths.tau
    )
    right = carrier_phase(-1.0, rx.positions(wavelength) @ paths.arrival.T / wavelength)
    left = carrier_phase(-1.0, tx.positions(wavelength) @ paths.departure.T / wavelength)
    waves = carrier_phase(f, (paths.tau - paths.tau.min())[:, None])
    return np.einsum("mp,np,p,pf->mnf", right, left, a, waves, optimize=True)


def _timed(run: Callable[[], np.ndarray], repeats: int) -> tuple[float, np.ndarray]:
    """Least seconds of ``repeats`` runs after one to warm up, and the last result."""
    result = run()
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - start)
    return best, result


def _scattered(count: int, carrier: float, seed: int) -> Paths:
    """Paths over random points of a room's walls."""
    rng = np.random.default_rng(seed)
    size = np.array([18.0, 12.0, 4.0])
    point = rng.random((count, 3)) * size
    wall = rng.integers(0, 6, count)
    point[np.arange(count), wall % 3] = np.where(wall < 3, 0.0, size[wall % 3])
    tx, rx = np.array([2.0, 3.0, 3.2]), np.array([14.0, 8.0, 1.5])
    spread = np.linalg.norm(point - tx, axis=1) * np.linalg.norm(point - rx, axis=1)
    amplitude = np.exp(2j * np.pi * rng.random(count)) / spread
    return Paths.from_points(
        tx, rx, point[:, None], amplitude, np.full(count, "diffuse", dtype="<U7"), carrier
    )


def _picture() -> Any:
    """Beam loss over distance, a line for each size of array."""
    wavelength = SPEED_OF_LIGHT / FREQUENCY_HZ
    figure, (axes,) = figure_of(1, (6.4, 4.0))
    distances = np.geomspace(0.3, 30.0, 60)
    for side in SIDES[1:]:
        array = PlanarArray(side, side)
        loss = [plane_wave_error(array, d, wavelength).beam_loss_db for d in distances]
        axes.loglog(distances, loss, label=f"{side} x {side}")
    axes.set_xlabel("distance [m]")
    axes.set_ylabel("loss of a plane-wave beam [dB]")
    axes.set_ylim(1e-4, 30)
    axes.grid(True, which="major", alpha=0.4)
    axes.legend(title="elements")
    axes.set_title("Beam steered by a plane wave at 300 GHz, half-wavelength spacing", fontsize=10)
    return figure


BENCHMARKS = {"channel": Benchmark("channel", Options, run, HELP)}
