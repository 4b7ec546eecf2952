"""The engine's evaluation in one resumable command: knobs, growth, mesh rays, blending beside torch, forms.

Each measurement is a step: a killed run loses one, and it is measured again only if its sizes or its version changed.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.engine import knobs
from benchmarks.engine.blend import blend_figures
from benchmarks.engine.forms import response_forms
from benchmarks.engine.rays import bumpy_sphere, ray_rows
from benchmarks.machine import machine
from benchmarks.pictures import figure_of
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress, threads
from warprrf.rf.scene import Scene
from warprrf.steps import Attempt, Steps

VERSION = 1  # counted up by hand when the rasteriser or the rays change so that old times say nothing
TOLERANCE_DB, WORST_DB = 0.05, 2.0
"""A setting will do if its rms error and its worst pixel stay within these: a tenth of the errors of the best fits."""

HELP = """\
Turns each knob of the rasteriser (cutoff, top K, precision, resolution, interaction point, form of the response) and
writes its time and its error as tables and pictures, with the settings that follow; then growth, mesh rays against
Embree, and blending forward and backward against torch. For figures worth quoting leave the machine alone meanwhile.

examples:
  python -m benchmarks engine
  python -m benchmarks engine --quick --out runs/engine-quick
"""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        gaussians: of the scene that the knobs are turned on.
        shape: rows and columns of its spectrum.
        counts: Gaussians of the growth curves.
        shapes: grids of the resolution curve.
        top_k: values of the limit K.
        form_gaussians: of the forms' kernels.
        rays, triangles: of the mesh rays.
        blend: Gaussians, width and height of the comparison with torch.
        repeats: timed runs of each setting; the shortest counts.
    """

    gaussians: int = 100_000
    shape: tuple[int, int] = (90, 180)
    counts: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
    shapes: tuple[tuple[int, int], ...] = ((30, 60), (45, 90), (60, 120), (90, 180), (120, 240), (180, 360))
    top_k: tuple[int, ...] = (1, 2, 4, 8, 12, 16, 24, 32, 64)
    form_gaussians: int = 20_000
    rays: int = 1_000_000
    triangles: int = 200_000
    blend: tuple[int, int, int] = (20_000, 400, 300)
    repeats: int = 5


QUICK = Sizes(
    gaussians=2_000,
    shape=(24, 48),
    counts=(1_000, 3_000),
    shapes=((12, 24), (24, 48)),
    top_k=(1, 4, 16),
    form_gaussians=500,
    rays=2_000,
    triangles=1_000,
    blend=(300, 40, 30),
    repeats=1,
)
"""Shows that everything runs, in a minute; its figures mean little."""


@dataclass(frozen=True)
class Options:
    """Options of the engine.

    Attributes:
        scene: scene whose mesh the rays are cast at, besides a bumpy sphere (XML).
        quick: tiny sizes.
        sizes: how much to measure.
    """

    scene: str = option("data/lobby/scene.xml", "scene that rays are cast at (XML)")
    quick: bool = option(False, "tiny sizes: shows that it runs, in a minute")
    sizes: Sizes = Sizes()


def run(options: Options, job: Job) -> Report:
    """Measure everything that is not kept from before.

    The figures hold rows by measurement: ``alpha_min``, ``top_k``, ``precision``, ``resolution``, ``points``,
    ``responses``, ``growth``, ``rays``; ``blend`` (None without torch), ``machine`` and ``sizes``.

    Raises:
        ValueError: if another run is at work in ``job.out``.
        ImportError: if the extra ``plots`` or ``photos`` is missing.
    """
    size = QUICK if options.quick else options.sizes
    figures: dict[str, Any] = {"machine": machine(job.device), "threads": threads(), "sizes": asdict(size)}
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        for name, (sizes, measure) in _measurements(options, size, job).items():
            inputs = [sizes, job.seed, figures["machine"]["device"], threads()]

            def make(attempt: Attempt, measure: Callable[[Progress], Any] = measure) -> Row:
                return {"found": measure(attempt.progress)}

            figures[name] = steps.run(name, make, version=VERSION, inputs=inputs)["found"]
        figures["seconds"] = steps.seconds()
    figures["choices"] = choices(figures)
    pictures: dict[str, tuple[Callable[[], Any], str]] = {
        "knobs.png": (lambda: _knobs_picture(figures), "Time against error of each knob."),
        "growth.png": (
            lambda: _growth_picture(figures["growth"]),
            "Time and error against the number of Gaussians.",
        ),
    }
    return Report("engine", figures, text(figures), pictures)


def _measurements(
    options: Options, size: Sizes, job: Job
) -> dict[str, tuple[list[Any], Callable[[Progress], Any]]]:
    """What each measurement's sizes are, and what measures it."""
    n, device, seed = size.repeats, job.device, job.seed
    known: dict[str, knobs.Scene] = {}

    def scene() -> knobs.Scene:
        if "room" not in known:
            known["room"] = knobs.Scene(size.gaussians, size.shape, seed=seed, device=device)
        return known["room"]

    def growth(tell: Progress) -> list[Row]:
        rows = []
        for done, count in enumerate(size.counts):
            tell("growth", done, len(size.counts))
            rows.append(knobs.growth_row(count, size.shape, repeats=min(3, n), seed=seed, device=device))
        return rows

    def rays(tell: Progress) -> list[Row]:
        meshes = {"scene": Scene.load(options.scene).mesh, "bumpy sphere": bumpy_sphere(size.triangles)}
        return ray_rows(meshes, rays=size.rays, repeats=3 * n, seed=seed, device=device, progress=tell)

    def blend(tell: Progress) -> dict[str, Any] | None:
        if importlib.util.find_spec("torch") is None:
            return None
        return blend_figures(*size.blend, repeats=n, seed=seed, progress=tell)

    room = [size.gaussians, size.shape, n]
    points = min(size.gaussians, 30_000)
    return {
        "alpha_min": (room, lambda tell: knobs.cutoff_rows(scene(), repeats=n)),
        "top_k": ([*room, size.top_k], lambda tell: knobs.top_k_rows(scene(), size.top_k, repeats=n)),
        "precision": (room, lambda tell: knobs.precision_rows(scene(), repeats=n, seed=seed)),
        "resolution": (
            [*room, size.shapes],
            lambda tell: knobs.resolution_rows(scene(), size.shapes, repeats=n),
        ),
        "points": (
            [points, size.shape],
            lambda tell: knobs.point_rows(points, 4, size.shape, seed=seed, device=device),
        ),
        "responses": (
            [size.form_gaussians, n],
            lambda tell: response_forms(gaussians=size.form_gaussians, repeats=n, seed=seed, device=device),
        ),
        "growth": ([size.counts, size.shape], growth),
        "rays": ([options.scene, size.triangles, size.rays, n], rays),
        "blend": ([size.blend, n], blend),
    }


def choices(figures: dict[str, Any]) -> dict[str, Any]:
    """The cheapest setting of each knob whose errors stay within the tolerances; None where none does."""
    found: dict[str, Any] = {}
    for knob in ("alpha_min", "top_k", "precision"):
        good = [
            r for r in figures[knob] if r["error_rms_db"] <= TOLERANCE_DB and r["error_worst_db"] <= WORST_DB
        ]
        # Cutoffs and limits cost monotonically: times of neighbours differ by noise, so the coarsest counts.
        found[knob] = good[0]["value"] if good else None
    return found


KNOB_COLUMNS = (
    ("value", "setting", "{}"), ("seconds", "time [s]", "{:.4g}"), ("error_rms_db", "rms error [dB]", "{:.2g}"),
    ("error_worst_db", "worst pixel [dB]", "{:.2g}"), ("error_total_db", "of the sum [dB]", "{:.2g}"),
)  # fmt: skip
TABLES: dict[str, tuple[str, tuple[tuple[str, str, str], ...]]] = {
    "alpha_min": ("Alpha cutoff", KNOB_COLUMNS),
    "top_k": ("Top K", KNOB_COLUMNS),
    "precision": ("Precision", KNOB_COLUMNS),
    "resolution": ("Resolution", KNOB_COLUMNS),
    "points": (
        "Interaction point",
        (
            ("interaction_point", "point", "{}"), ("length_error_median_m", "length error, median [m]", "{:.2g}"),
            ("length_error_p90_m", "90 % [m]", "{:.2g}"), ("delay_error_median_ns", "delay error, median [ns]", "{:.2g}"),
            ("milliseconds_per_receiver", "time [ms]", "{:.1f}"),
            ("weights_milliseconds_per_receiver", "weights besides [ms]", "{:.1f}"),
        ),
    ),
    "responses": (
        "Form of the response, float32",
        (
            ("regime", "Gaussians", "{}"), ("form", "form", "{}"), ("error_mean", "mean error", "{:.1e}"),
            ("error_max", "largest", "{:.1e}"), ("negative", "negative", "{:.1%}"),
            ("ns_per_pair", "ns a pair", "{:.2f}"),
        ),
    ),
    "growth": (
        "Growth",
        (
            ("gaussians", "Gaussians", "{}"), ("seconds", "spectrum [s]", "{:.4g}"),
            ("error_rms_db", "discs: rms error [dB]", "{:.2g}"),
            ("range_error_median_m", "range error, median [m]", "{:.1e}"),
            ("transmittances_per_s", "segments a second", "{:.3g}"),
        ),
    ),
}  # fmt: skip


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    picked = ", ".join(f"{knob} {value}" for knob, value in figures["choices"].items())
    parts = [
        f"{figures['machine']['cores']} cores, {figures['machine']['processor']}, {figures['machine']['device']}. "
        f"Cheapest settings within {TOLERANCE_DB:g} dB rms and {WORST_DB:g} dB anywhere: {picked}."
    ]
    for name, (title, columns) in TABLES.items():
        parts += [f"### {title}", columns_table(columns, figures[name])]
    runners = ("warp", "chosen", "embree bare", "embree from arrays")
    rows = [{**r, **{n: r[n]["over_bare"] for n in runners}} for r in figures["rays"]]
    columns = (
        ("mesh", "mesh", "{}"),
        ("faces", "faces", "{}"),
        ("kind", "rays", "{}"),
        *((n, n, "{:.2f}") for n in runners),
    )
    parts += ["### Mesh rays, speed over bare Embree", columns_table(columns, rows)]
    blend = figures["blend"]
    if blend is not None:
        timed = [
            {"threads": r["threads"], "name": n, **r[n]} for r in blend["runs"] for n in ("ours", "torch")
        ]
        columns = (
            ("threads", "threads", "{}"), ("name", "renderer", "{}"), ("forward_s", "forward [s]", "{:.3f}"),
            ("backward_s", "backward [s]", "{:.3f}"), ("seconds", "both [s]", "{:.3f}"),
            ("ns_per_passing_pair", "ns a pair", "{:.1f}"),
        )  # fmt: skip
        title = (
            f"### Blending {blend['gaussians']} Gaussians, {blend['shape'][1]} x {blend['shape'][0]} pixels"
        )
        parts += [title, columns_table(columns, timed)]
    return "\n\n".join(parts)


def _knobs_picture(figures: dict[str, Any]) -> Any:
    names = ("alpha_min", "top_k", "resolution")
    figure, axes = figure_of(len(names), (13.0, 3.8))
    for ax, name in zip(axes, names, strict=True):
        rows = [r for r in figures[name] if r["error_rms_db"] > 1e-4]
        ax.loglog([r["seconds"] for r in rows], [r["error_rms_db"] for r in rows], "o-", color="#0b6e99")
        for r in rows:
            at = (r["seconds"], r["error_rms_db"])
            ax.annotate(str(r["value"]), at, (4, 4), textcoords="offset points", fontsize=7)
        ax.set_title(TABLES[name][0], fontsize=10)
        ax.set_xlabel("time [s]")
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("rms error of the dB image [dB]")
    return figure


def _growth_picture(rows: list[Row]) -> Any:
    figure, axes = figure_of(2, (10.0, 3.8))
    for ax, key, name in zip(
        axes, ("seconds", "error_rms_db"), ("time of a spectrum [s]", "discs: rms error [dB]"), strict=True
    ):
        ax.loglog([r["gaussians"] for r in rows], [r[key] for r in rows], "o-", color="#0b6e99")
        ax.set_xlabel("Gaussians")
        ax.set_ylabel(name)
        ax.grid(alpha=0.3, which="both")
    return figure


BENCHMARKS = {"engine": Benchmark("engine", Options, run, HELP)}
