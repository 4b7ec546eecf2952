"""Paths of Sionna RT's own scenes beside its PathSolver's: found or not, right or not, and how fast; and what verbs take.

Each scene is opened twice, by Sionna RT and by :meth:`Scene.load`, at the frequency that Sionna RT gives it. Sionna RT
shoots rays to find which surfaces may mirror one after the other, then takes images; it may miss small facets. So every
path of its must be among ours, of the same length and gain. Its float32 ends early where two mirror points lie
less than a metre apart and hundreds of metres from the origin: where gains differ by more than 0.05 dB it solves the scene
again with the origin at the mirror points. What only we have must pass a test of its own: each
mirror point lies on the mesh, the law of reflection holds there, and nothing stands in the way of a leg (both by
Open3D, not by the method itself).
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.city_verbs import VERBS, measure
from benchmarks.machine import machine
from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.scene import Scene

FREQUENCY_HZ = 3.5e9
SAMPLES = 1_000_000
POINT_M = 0.05
GAIN_DB = 0.05
ABOVE_GROUND_M = 1.5
MOST_RECEIVERS = 100  # in streets
PLACES = 3000  # at which roofs are looked for


@dataclass(frozen=True)
class Links:
    """Where a scene is asked.

    Attributes:
        scene: its name in ``sionna.rt.scene``.
        transmitter: position [m].
        receivers: positions [m]; none for a hundred in the streets.
        ground: the object on which the streets lie.
        around_m: streets are looked for so far from the transmitter, in x and y.
    """

    scene: str
    transmitter: tuple[float, float, float]
    receivers: tuple[tuple[float, float, float], ...] = ()
    ground: str = ""
    around_m: float = 250.0

    @property
    def delay_tolerance_s(self) -> float:
        """Where PathSolver's float32 ends: coordinates of hundreds of metres, or of a few."""
        return 1e-11 if self.ground else 1e-12

    def places(self, scene: Scene) -> np.ndarray:
        """Receivers ``(R, 3)``; those in the streets are drawn from a fixed seed, under open sky."""
        if self.receivers:
            return np.array(self.receivers)
        drawn = np.random.default_rng(0).uniform(-self.around_m, self.around_m, (4000, 2))
        drawn = np.clip(drawn + self.transmitter[:2], scene.bounds[0, :2], scene.bounds[1, :2])
        top = scene.bounds[1, 2] + 1.0
        hit = scene.mesh.cast(
            np.column_stack([drawn, np.full(len(drawn), top)]), np.tile([0, 0, -1.0], (4000, 1))
        )
        street = np.flatnonzero(np.isin(hit.face, scene.object_faces(self.ground)))[:MOST_RECEIVERS]
        return np.column_stack([drawn[street], top - hit.t[street] + ABOVE_GROUND_M])


def roofs(scene: Scene, links: Links) -> dict[str, int]:
    """Of :data:`PLACES` places over the ground how many have a roof above, and how many of those, and of those under the
    sky, the library takes for places in a building."""
    drawn = np.random.default_rng(1).uniform(-links.around_m, links.around_m, (PLACES, 2))
    drawn = np.clip(drawn + links.transmitter[:2], scene.bounds[0, :2], scene.bounds[1, :2])
    top, down = scene.bounds[1, 2] + 1.0, np.tile([0.0, 0.0, -1.0], (PLACES, 1))
    ground = Mesh(scene.mesh.vertices, scene.mesh.faces[scene.object_faces(links.ground)])
    depth = ground.cast(np.column_stack([drawn, np.full(PLACES, top)]), down).t
    places = np.column_stack([drawn, top - depth + ABOVE_GROUND_M])[np.isfinite(depth)]
    roofed = scene.mesh.cast(places, -down[: len(places)]).face >= 0
    refused = ~scene.is_free(places)
    return {
        "roofed": int(roofed.sum()),
        "roofed_refused": int(refused[roofed].sum()),
        "open": int((~roofed).sum()),
        "open_refused": int(refused[~roofed].sum()),
    }


BOX = (0.5, -0.8, 1.9), ((2.1, 1.3, 3.3), (-1.7, 2.2, 4.1))
LINKS = {
    links.scene: links
    for links in (
        Links("box", *BOX),
        Links("box_knife", (2.5, -0.8, 1.9), ((2.1, 1.3, 3.3), (-2.7, 2.2, 4.1), (-3.1, -3.0, 0.7))),
        Links("box_one_screen", (2.5, -0.8, 1.9), ((2.1, 1.3, 3.3), (-2.7, 2.2, 4.1), (-3.1, 4.0, 0.7))),
        Links("box_two_screens", (0.5, -0.8, 1.9), ((1.1, 1.3, 3.3), (-2.7, 2.2, 4.1), (3.1, 4.0, 0.7))),
        Links("floor_wall", (-2.0, 0.6, 2.0), ((-1.0, -1.4, 1.1), (-3.5, 2.0, 0.7))),
        Links("simple_reflector", (-0.1, 0.1, 1.0), ((0.2, -0.05, 0.8), (0.0, 0.1, 2.0))),
        Links("double_reflector", (0.0, 0.3, 0.5), ((0.4, -0.1, 0.6), (0.1, 0.1, 1.2))),
        Links("triple_reflector", (-9.0, 0.3, 4.0), ((9.0, 0.2, 5.0), (3.0, -0.6, 1.2))),
        Links("simple_wedge", (8.0, 9.0, 1.0), ((20.0, 4.0, -3.0), (-6.0, 12.0, 2.0), (-9.0, -3.0, 0.5))),
        Links("simple_street_canyon", (-33.0, 0.0, 32.0), ground="floor", around_m=60.0),
        Links("simple_street_canyon_with_cars", (-33.0, 0.0, 32.0), ground="floor", around_m=60.0),
        Links("etoile", (60.0, -40.0, 30.0), ground="Plane"),
        Links("munich", (8.5, 21.0, 27.0), ground="ground"),
        Links("florence", (30.0, 20.0, 25.0), ground="ground"),
        Links("san_francisco", (0.0, 0.0, 45.0), ground="Terrain"),
    )
}


def scene_path(name: str) -> str:
    """File of one of Sionna RT's scenes."""
    from warprrf.rf.scene_sionna import sionna_rt

    return str(getattr(sionna_rt().scene, name))


def solve(scene: Any, transmitter: np.ndarray, receivers: np.ndarray, order: int) -> tuple[Paths, float]:
    """Paths of PathSolver in a ``sionna.rt.Scene``, diffraction, refraction and scattering off, and its seconds."""
    from warprrf.rf.scene_sionna import sionna_rt

    rt = sionna_rt()
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
    names = ["tx", *(f"rx{k}" for k in range(len(receivers)))]
    scene.add(rt.Transmitter("tx", position=transmitter.tolist()))
    for name, point in zip(names[1:], receivers, strict=True):
        scene.add(rt.Receiver(name, position=point.tolist()))
    begin = time.perf_counter()
    paths = rt.PathSolver()(
        scene, max_depth=order, samples_per_src=SAMPLES, synthetic_array=True, los=True,
        specular_reflection=True, diffuse_reflection=False, refraction=False, seed=1,
    )  # fmt: skip
    np.array(paths.valid)
    seconds = time.perf_counter() - begin
    for name in names:
        scene.remove(name)
    return Paths.from_sionna(paths, frequency_hz=FREQUENCY_HZ, drop_repeated=True), seconds


def near_origin(scene: Scene, transmitter: np.ndarray, receiver: np.ndarray, path: Paths, k: int) -> float:
    """Error of gain [dB] of path ``k`` against PathSolver's where the origin lies at the path's first mirror point."""
    middle = path.vertices[k, 0]
    moved = Scene(
        Mesh(scene.mesh.vertices - middle, scene.mesh.faces), scene.materials, scene.face_material,
        face_object=scene.face_object, object_names=scene.object_names,
    ).to_sionna(frequency_hz=FREQUENCY_HZ)  # fmt: skip
    order = int(np.isfinite(path.vertices[k, :, 0]).sum())
    theirs, _ = solve(moved, transmitter - middle, (receiver - middle)[None], order)
    points = np.where(theirs.valid[0][:, None, None], theirs.vertices[0] + middle, np.inf)
    gap = np.linalg.norm(points - path.vertices[k, :order], axis=2).max(axis=1)
    same = int(np.argmin(np.where(np.isfinite(gap), gap, np.inf)))
    return abs(20 * float(np.log10(np.abs(path.gain[k]) / np.abs(theirs.gain[0, same]))))


class Judge:
    """Whether paths obey geometry, by Open3D alone: not through the library."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        self.mesh = mesh
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32))
        )

    def errors(self, stops: np.ndarray) -> dict[str, float]:
        """How far a path ``stops`` (k + 2, 3) is from one: its points off the mesh [m], its legs' directions off the
        law of reflection, and the number of legs that something blocks."""
        mesh = self.mesh
        legs = np.diff(stops, axis=0)
        length = np.linalg.norm(legs, axis=1)
        along = legs / length[:, None]
        off = turned = 0.0
        if len(stops) > 2:
            near = self._scene.compute_closest_points(self._tensor(stops[1:-1].astype(np.float32)))
            off = float(np.linalg.norm(near["points"].numpy() - stops[1:-1], axis=1).max())
            # Faces nearly as near, at an edge, may be the one: the best of all that hold the point.
            corner = mesh.triangles
            for k, point in enumerate(stops[1:-1]):
                gap = np.abs(np.einsum("ni,ni->n", mesh.face_normals, corner[:, 0] - point))
                box = (point >= corner.min(axis=1) - 1e-2) & (point <= corner.max(axis=1) + 1e-2)
                normal = mesh.face_normals[(gap < 1e-2) & box.all(axis=1)]
                mirrored = along[k] - 2.0 * (normal @ along[k])[:, None] * normal
                turned = max(
                    turned, float(np.linalg.norm(mirrored - along[k + 1], axis=1).min(initial=np.inf))
                )
        skin = 1e-3 * np.maximum(1.0, np.abs(mesh.bounds).max() / 100.0)
        rays = np.column_stack([stops[:-1] + skin * along, along]).astype(np.float32)
        hit = self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy()
        return {"off_mesh_m": off, "off_law": turned, "blocked_legs": float((hit < length - 2 * skin).sum())}

    def is_wrong(self, stops: np.ndarray) -> bool:
        """Whether any of the errors is more than rounding."""
        found = self.errors(stops)
        return found["off_mesh_m"] > 1e-2 or found["off_law"] > 1e-2 or found["blocked_legs"] > 0


def match(ours: list[Paths], theirs: Paths) -> dict[str, Any]:
    """Their paths among ours: those found, with the errors of delay and gain, those lost, and what only we have."""
    lost, delay_error, gain_error, found = [], 0.0, 0.0, 0
    extra: list[tuple[int, int]] = []
    apart_in_gain: list[tuple[int, int]] = []
    for receiver, mine in enumerate(ours):
        taken = np.zeros(len(mine.tau), bool)
        bounces = np.isfinite(mine.vertices[..., 0]).sum(axis=-1)
        for k in np.flatnonzero(theirs.valid[receiver]):
            points = theirs.vertices[receiver, k]
            points = points[np.isfinite(points[:, 0])]
            same = np.flatnonzero((bounces == len(points)) & ~taken)
            gap = np.abs(mine.tau[same] - theirs.tau[receiver, k])
            if len(points):
                apart = np.linalg.norm(mine.vertices[same, : len(points)] - points, axis=2).max(axis=1)
                gap = np.where(apart < POINT_M, gap, np.inf)
            if gap.min(initial=np.inf) * SPEED_OF_LIGHT > POINT_M:
                lost.append(
                    {"receiver": receiver, "delay_s": float(theirs.tau[receiver, k]), "points": points}
                )
                continue
            own = same[gap.argmin()]
            taken[own], found = True, found + 1
            delay_error = max(delay_error, float(gap.min()))
            gains = np.abs(mine.gain[own]), np.abs(theirs.gain[receiver, k])
            off = abs(20 * float(np.log10(gains[0] / gains[1])))
            gain_error = max(gain_error, off)
            if off > GAIN_DB:
                apart_in_gain.append((receiver, int(own)))
        extra += [(receiver, int(k)) for k in np.flatnonzero(~taken)]
    return {
        "found": found, "lost": lost, "delay_error_s": delay_error, "gain_error_db": gain_error, "extra": extra,
        "apart_in_gain": apart_in_gain,
    }  # fmt: skip


def compare(links: Links, order: int = 2) -> dict[str, Any]:
    """One scene: counts, errors and times of both."""
    from warprrf.rf.scene_sionna import sionna_rt

    rt = sionna_rt()
    path = scene_path(links.scene)
    begin = time.perf_counter()
    scene = Scene.load(path)
    load_s = time.perf_counter() - begin
    transmitter, receivers = np.array(links.transmitter), links.places(scene)
    live = rt.load_scene(path, merge_shapes=False)
    live.frequency = FREQUENCY_HZ
    solve(live, transmitter, receivers[:1], order)
    sionna_one_s = solve(live, transmitter, receivers[:1], order)[1]
    theirs, sionna_all_s = solve(live, transmitter, receivers, order)
    for _ in range(2):
        clock = [time.perf_counter()]
        tracer = MirrorTracer(scene, transmitter=links.transmitter, frequency_hz=FREQUENCY_HZ)
        clock.append(time.perf_counter())
        tracer.trace_each(receivers[:1], order)
        clock.append(time.perf_counter())
    ours = tracer.trace_each(receivers, order)
    clock.append(time.perf_counter())
    found = match(ours, theirs)
    again = [
        near_origin(scene, transmitter, receivers[receiver], ours[receiver], k)
        for receiver, k in found["apart_in_gain"]
    ]
    judge = Judge(scene.mesh)
    wrong = 0
    for receiver, k in found["extra"]:
        points = ours[receiver].vertices[k]
        points = points[np.isfinite(points[:, 0])]
        wrong += judge.is_wrong(np.concatenate([[links.transmitter], points, receivers[receiver][None]]))
    return {
        "scene": links.scene,
        "faces": len(scene.mesh.faces),
        "patches": len(tracer.patches),
        "receivers": len(receivers),
        "order": order,
        "paths_of_sionna": int(theirs.valid.sum()),
        "found": found["found"],
        "lost": found["lost"],
        "delay_error_s": found["delay_error_s"],
        "delay_tolerance_s": links.delay_tolerance_s,
        "gain_error_db": found["gain_error_db"],
        "gain_apart": len(again),
        "gain_apart_near_origin_db": max(again, default=0.0),
        "roofs": roofs(scene, links) if links.ground else None,
        "only_ours": len(found["extra"]),
        "only_ours_wrong": wrong,
        "load_s": load_s,
        "patches_s": clock[1] - clock[0],
        "one_receiver_s": clock[2] - clock[1],
        "all_receivers_s": clock[3] - clock[2],
        "sionna_one_receiver_s": sionna_one_s,
        "sionna_all_receivers_s": sionna_all_s,
    }


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        scenes: Sionna RT's built-in scenes.
        order: Most reflections on a path.
        verbs: Scenes in which every verb is measured.
    """

    scenes: tuple[str, ...] = option(tuple(LINKS), "built-in scenes of Sionna RT", choices=tuple(LINKS))
    order: int = option(2, "most reflections on a path")
    verbs: tuple[str, ...] = option(
        tuple(VERBS), "cities in which every verb is measured", choices=tuple(VERBS)
    )


def run(options: Options, job: Job) -> Report:
    """Compare scene by scene."""
    rows = []
    for k, name in enumerate(options.scenes):
        job.progress("scenes", k, len(options.scenes))
        rows.append(compare(LINKS[name], options.order))
    job.progress("scenes", len(rows), len(rows))
    verbs = []
    for k, name in enumerate(options.verbs):
        job.progress("verbs", k, len(options.verbs))
        path, links = scene_path(name), LINKS[name]
        verbs += measure(name, path, np.array(links.transmitter), links.places(Scene.load(path)))
    job.progress("verbs", len(options.verbs), len(options.verbs))
    shown = (
        "scene", "faces", "receivers", "paths_of_sionna", "found", "delay_error_s", "gain_error_db", "gain_apart",
        "gain_apart_near_origin_db", "only_ours",
        "only_ours_wrong", "load_s", "patches_s", "one_receiver_s", "all_receivers_s", "sionna_one_receiver_s",
        "sionna_all_receivers_s",
    )  # fmt: skip
    cells = [[f"{row[n]:.2g}" if isinstance(row[n], float) else str(row[n]) for n in shown] for row in rows]
    return Report(
        "city_paths",
        {"machine": machine(job.device), "load_average": os.getloadavg()[0], "scenes": rows, "verbs": verbs},
        "\n\n".join([table([n.replace("_", " ") for n in shown], cells), verbs_table(verbs)]),
    )


def verbs_table(verbs: list[dict[str, Any]]) -> str:
    """What verbs take, for the report."""
    head = ("scene", "verb", "wall [s]", "again [s]", "core [s]", "peak [GB]")
    return table(
        head,
        [
            [
                v["scene"],
                v["verb"],
                f"{v['wall_s']:.2g}",
                "" if v["again_wall_s"] is None else f"{v['again_wall_s']:.2g}",
            ]
            + [f"{v['core_s']:.2g}", f"{v['peak_bytes'] / 1e9:.2f}"]
            for v in verbs
        ],
    )


HELP = """\
Line of sight and mirror paths to two reflections of Sionna RT's own scenes, opened by Scene.load, beside its
PathSolver's: how many are found, errors of delay and gain, and how many that only we have fail a geometric test. Needs
the extra sionna. Then what every verb of the library takes in Munich and in San Francisco: time and memory.

examples:
  python -m benchmarks city-paths
  python -m benchmarks city-paths --scenes box simple_street_canyon --verbs munich
"""

BENCHMARKS = {"city-paths": Benchmark("city-paths", Options, run, HELP)}
