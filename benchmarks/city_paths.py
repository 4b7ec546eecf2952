"""Paths of Sionna RT's own scenes beside its PathSolver's: found or not, right or not, and how fast.

Sionna RT shoots rays to find which surfaces may mirror one after the other, then takes images; it may miss small facets.
So every path of its must be among ours, and what only we have must pass a test of its own: each mirror point lies on the
mesh, the law of reflection holds there, and nothing stands in the way of a leg (both by Open3D, not by the method itself).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.trace import MirrorTracer

FREQUENCY_HZ = 3.5e9
SAMPLES = 1_000_000
LENGTH_M = 3e-3  # 1e-11 s: where PathSolver's float32 ends in a city
POINT_M = 0.05


@dataclass(frozen=True)
class Links:
    """Where a scene is asked: a transmitter ``(3,)`` and receivers ``(R, 3)`` [m]."""

    scene: str
    transmitter: tuple[float, float, float]
    receivers: tuple[tuple[float, float, float], ...]


CITY = Links(
    "munich",
    (8.5, 21.0, 27.0),
    ((45.0, 90.0, 1.5), (-30.0, 60.0, 1.5), (100.0, -20.0, 1.5), (8.0, 120.0, 1.5), (-90.0, -40.0, 1.5)),
)
STREET = Links(
    "simple_street_canyon", (-33.0, 0.0, 32.0), ((20.0, 0.0, 1.5), (-5.0, 3.0, 1.5), (35.0, -4.0, 2.5))
)
TOYS = (
    Links("box", (0.5, -0.8, 1.9), ((2.1, 1.3, 3.3), (-1.7, 2.2, 5.1))),
    Links("floor_wall", (-2.0, 0.6, 2.0), ((-1.0, -1.4, 1.1), (-3.5, 2.0, 0.7))),
    Links("simple_reflector", (-0.1, 0.1, 1.0), ((0.2, -0.05, 0.8), (0.0, 0.1, 2.0))),
    Links("double_reflector", (0.0, 0.3, 0.5), ((0.4, -0.1, 0.6), (0.1, 0.1, 1.2))),
)
LINKS = {links.scene: links for links in (CITY, STREET, *TOYS)}


def open_scene(name: str) -> Any:
    """One of Sionna RT's built-in scenes, with isotropic antennas."""
    from warprrf.rf.sionna_package import sionna_rt

    rt = sionna_rt()
    scene = rt.load_scene(getattr(rt.scene, name), merge_shapes=False)
    scene.frequency = FREQUENCY_HZ
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    return scene


def mesh_of(scene: Any) -> Mesh:
    """All triangles of a Sionna RT scene."""
    import mitsuba as mi

    vertices, faces, count = [], [], 0
    for shape in scene.mi_scene.shapes():
        parameters = mi.traverse(shape)
        vertices.append(np.array(parameters["vertex_positions"]).reshape(-1, 3).astype(float))
        faces.append(np.array(parameters["faces"]).reshape(-1, 3).astype(np.int64) + count)
        count += len(vertices[-1])
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def solved(scene: Any, links: Links, order: int = 2) -> tuple[list[tuple[int, float, np.ndarray]], float]:
    """Paths of PathSolver, diffraction, refraction and scattering off: receiver, length [m] and mirror points; and
    seconds of a second call."""
    from warprrf.rf.sionna_package import sionna_rt

    rt = sionna_rt()
    scene.add(rt.Transmitter("tx", position=list(links.transmitter)))
    for k, point in enumerate(links.receivers):
        scene.add(rt.Receiver(f"rx{k}", position=list(point)))
    solver, seconds = rt.PathSolver(), 0.0
    for _ in range(2):
        begin = time.perf_counter()
        paths = solver(
            scene, max_depth=order, samples_per_src=SAMPLES, synthetic_array=True, los=True,
            specular_reflection=True, diffuse_reflection=False, refraction=False, seed=1,
        )  # fmt: skip
        valid = np.array(paths.valid)
        seconds = time.perf_counter() - begin
    tau, vertices = np.array(paths.tau), np.array(paths.vertices)
    met = np.array(paths.interactions) != 0
    rows = []
    for receiver, _, path in np.argwhere(valid):
        order_of = met[:, receiver, 0, path].sum()
        rows.append(
            (int(receiver), tau[receiver, 0, path] * SPEED_OF_LIGHT, vertices[:order_of, receiver, 0, path])
        )
    return rows, seconds


def geometric_errors(mesh: Mesh, stops: np.ndarray) -> dict[str, float]:
    """How far a path ``stops`` (k + 2, 3) is from one: its points off the mesh [m], its legs' directions off the law
    of reflection, and the number of legs that something blocks, all by Open3D alone."""
    import open3d as o3d  # an independent judge: not through the library

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    legs = np.diff(stops, axis=0)
    length = np.linalg.norm(legs, axis=1)
    along = legs / length[:, None]
    off = turned = 0.0
    if len(stops) > 2:
        near = scene.compute_closest_points(o3d.core.Tensor.from_numpy(stops[1:-1].astype(np.float32)))
        off = float(np.linalg.norm(near["points"].numpy() - stops[1:-1], axis=1).max())
        # Faces nearly as near, at an edge, may be the one: the best of all that hold the point.
        corner = mesh.triangles
        for k, point in enumerate(stops[1:-1]):
            gap = np.abs(np.einsum("ni,ni->n", mesh.face_normals, corner[:, 0] - point))
            box = (point >= corner.min(axis=1) - 1e-2) & (point <= corner.max(axis=1) + 1e-2)
            normal = mesh.face_normals[(gap < 1e-2) & box.all(axis=1)]
            mirrored = along[k] - 2.0 * (normal @ along[k])[:, None] * normal
            turned = max(turned, float(np.linalg.norm(mirrored - along[k + 1], axis=1).min(initial=np.inf)))
    skin = 1e-3 * np.maximum(1.0, np.abs(mesh.bounds).max() / 100.0)
    rays = np.column_stack([stops[:-1] + skin * along, along]).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    return {"off_mesh_m": off, "off_law": turned, "blocked_legs": float((hit < length - 2 * skin).sum())}


def compare(links: Links, order: int = 2) -> dict[str, Any]:
    """One scene: counts, errors and times of both."""
    scene = open_scene(links.scene)
    mesh = mesh_of(scene)
    theirs, solver_s = solved(scene, links, order)
    receivers = np.array(links.receivers)
    times = []
    for _ in range(2):
        begin = time.perf_counter()
        tracer = MirrorTracer(mesh, transmitter=links.transmitter, frequency_hz=FREQUENCY_HZ)
        prepared = time.perf_counter()
        tracer.find(receivers[:1], order)
        times.append((prepared - begin, time.perf_counter() - prepared))
    ours = tracer.find(receivers, order)
    taken = np.zeros(len(ours), bool)
    lost, length_error = [], 0.0
    for receiver, length, points in theirs:
        mine = np.flatnonzero((ours.receiver == receiver) & (ours.order == len(points)) & ~taken)
        gap = np.abs(ours.length_m[mine] - length)
        if len(points):
            apart = np.linalg.norm(ours.point[mine, : len(points)] - points, axis=2).max(axis=1)
            gap = np.where(apart < POINT_M, gap, np.inf)
        if gap.min(initial=np.inf) > LENGTH_M:
            lost.append({"receiver": receiver, "length_m": length, "points": points})
            continue
        taken[mine[gap.argmin()]] = True
        length_error = max(length_error, float(gap.min()))
    extra = [
        geometric_errors(
            mesh,
            np.concatenate(
                [[links.transmitter], ours.point[k, : ours.order[k]], receivers[ours.receiver[k]][None]]
            ),
        )
        for k in np.flatnonzero(~taken)
    ]
    return {
        "scene": links.scene,
        "faces": len(mesh.faces),
        "patches": len(tracer.patches),
        "receivers": len(receivers),
        "order": order,
        "paths_of_sionna": len(theirs),
        "found": len(theirs) - len(lost),
        "lost": lost,
        "length_error_m": length_error,
        "only_ours": len(extra),
        "only_ours_wrong": sum(
            e["off_mesh_m"] > 1e-2 or e["off_law"] > 1e-2 or e["blocked_legs"] > 0 for e in extra
        ),
        "patches_s": times[1][0],
        "one_receiver_s": times[1][1],
        "sionna_all_receivers_s": solver_s,
    }


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        scenes: Sionna RT's built-in scenes.
        order: Most reflections on a path.
    """

    scenes: tuple[str, ...] = option(tuple(LINKS), "built-in scenes of Sionna RT", choices=tuple(LINKS))
    order: int = option(2, "most reflections on a path")


def run(options: Options, job: Job) -> Report:
    """Compare scene by scene."""
    rows = []
    for k, name in enumerate(options.scenes):
        job.progress("scenes", k, len(options.scenes))
        rows.append(compare(LINKS[name], options.order))
    job.progress("scenes", len(rows), len(rows))
    shown = (
        "scene", "faces", "patches", "receivers", "paths_of_sionna", "found", "length_error_m", "only_ours",
        "only_ours_wrong", "patches_s", "one_receiver_s", "sionna_all_receivers_s",
    )  # fmt: skip
    cells = [[f"{row[n]:.2g}" if isinstance(row[n], float) else str(row[n]) for n in shown] for row in rows]
    return Report("city_paths", {"scenes": rows}, table([n.replace("_", " ") for n in shown], cells))


HELP = """\
Line of sight and mirror paths to two reflections of Sionna RT's own scenes beside its PathSolver's: how many are found,
and how many that only we have fail a geometric test. Needs the extra sionna.

examples:
  python -m benchmarks city-paths
  python -m benchmarks city-paths --scenes box simple_street_canyon
"""

BENCHMARKS = {"city-paths": Benchmark("city-paths", Options, run, HELP)}
