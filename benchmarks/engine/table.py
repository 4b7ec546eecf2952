"""The engine's evaluation in one resumable command: knobs, growth, mesh rays, blending, transport on disk.

Each measurement is a stage: a killed run loses one, and a stage is measured again only if its sizes or the code that it
times changed. Figures go to ``engine.json``, tables and pictures beside it.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.engine import knobs, report
from benchmarks.engine.blend import run_blend
from benchmarks.engine.forms import exponential_forms, response_forms
from benchmarks.engine.rays import run_rays
from benchmarks.engine.transport import run_transport
from benchmarks.machine import machine
from benchmarks.stages import StagedRun, plain, write_json
from warprrf.device import Progress, threads
from warprrf.marks import code_mark


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        gaussians: of the scene that the knobs are turned on.
        shape: rows and columns of its spectrum.
        counts: Gaussians of the growth curves.
        shapes: grids of the resolution curve.
        receivers: of the growth curve.
        top_k: values of the limit K.
        form_gaussians, exponentials: of the forms' kernels.
        rays, triangles: of the mesh rays.
        blend: Gaussians, width and height of the comparison with torch.
        stored: Gaussians, receivers measured and receivers in all of the transport on disk.
        repeats: timed runs of each setting; the shortest counts.
    """

    gaussians: int = 100_000
    shape: tuple[int, int] = (90, 180)
    counts: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
    shapes: tuple[tuple[int, int], ...] = ((30, 60), (45, 90), (60, 120), (90, 180), (120, 240), (180, 360))
    receivers: tuple[int, ...] = (1, 2, 4, 8, 16)
    top_k: tuple[int, ...] = (1, 2, 4, 8, 12, 16, 24, 32, 64)
    form_gaussians: int = 20_000
    exponentials: int = 400_000
    rays: int = 1_000_000
    triangles: int = 200_000
    blend: tuple[int, int, int] = (20_000, 400, 300)
    stored: tuple[int, int, int] = (1_000_000, 4, 800)
    repeats: int = 5


QUICK = Sizes(
    gaussians=2_000,
    shape=(24, 48),
    counts=(1_000, 3_000),
    shapes=((12, 24), (24, 48)),
    receivers=(1, 2),
    top_k=(1, 4, 16),
    form_gaussians=500,
    exponentials=20_000,
    rays=2_000,
    triangles=1_000,
    blend=(300, 40, 30),
    stored=(2_000, 2, 12),
    repeats=1,
)
"""Shows that everything runs, in a minute; its figures mean little."""

_CODE = ("warprrf.kernels", "warprrf.geometry")


def run_engine(
    out: str | os.PathLike[str],
    *,
    scene: str | os.PathLike[str] = "data/lobby/scene.xml",
    sizes: Sizes | None = None,
    seed: int = 0,
    device: Any = None,
    opensplat: str | os.PathLike[str] | None = None,
    fresh: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure everything and write ``engine.json``, ``engine.md`` and pictures to ``out``.

    Args:
        out: folder of the results; what an earlier run finished there is kept.
        scene: scene whose mesh the rays are cast at, besides a bumpy sphere.
        sizes: how much to measure; default: what the README quotes.
        seed: of scenes and rays.
        device: where to run.
        opensplat: folder of a checkout of OpenSplat, whose CPU rasteriser is then compiled and measured too.
        fresh: start over instead of continuing.
        progress: ``progress(step, done, total)``.

    Returns:
        What ``engine.json`` holds: rows by measurement (``alpha_min``, ``alpha_max``, ``top_k``, ``precision``,
        ``resolution``, ``points``, ``responses``, ``exponentials``, ``counts``, ``growth``, ``receivers``, ``rays``,
        ``blend`` (None without torch), ``transport``), ``machine`` and ``sizes``.

    Raises:
        ValueError: on a broken ``out``, or another run at work there, or if ``opensplat`` is no checkout.
        RuntimeError: if OpenSplat does not compile.
        ImportError: if the extra ``plots`` is missing.
    """
    size = sizes or Sizes()
    found: dict[str, Any] = {"machine": machine(device), "threads": threads(), "sizes": asdict(size)}
    with StagedRun(out, fresh=fresh, progress=progress) as run:
        stages = _Stages(run, str(found["machine"]["device"]), seed)
        _knobs(stages, size, seed, device, found)
        _growth(stages, size, seed, device, found)
        options = {
            "scene": scene,
            "triangles": size.triangles,
            "rays": size.rays,
            "repeats": 3 * size.repeats,
        }
        found["rays"] = stages.rows(
            "rays",
            lambda tell: run_rays(**options, seed=seed, device=device, progress=tell),  # type: ignore[arg-type]
            {**options, "scene": str(scene)},
            "benchmarks.engine.rays",
        )
        found["blend"] = None
        if importlib.util.find_spec("torch") is not None:
            n, width, height = size.blend
            found["blend"] = stages.figures(
                "blend",
                lambda tell: run_blend(
                    n=n,
                    width=width,
                    height=height,
                    repeats=size.repeats,
                    seed=seed,
                    opensplat=opensplat,
                    progress=tell,
                ),
                {"blend": size.blend, "repeats": size.repeats, "opensplat": opensplat and str(opensplat)},
                "benchmarks.engine.blend",
            )
        n, measured, receivers = size.stored
        found["transport"] = stages.figures(
            "transport",
            lambda tell: run_transport(
                gaussians=n,
                measured=measured,
                receivers=receivers,
                shape=size.shape,
                seed=seed,
                device=device,
                progress=tell,
            ),
            {"stored": size.stored, "shape": size.shape},
            "benchmarks.engine.transport",
            "warprrf.rf.fields.harmonic.fitting",
            "warprrf.rf.fields.harmonic.store",
        )
        found["seconds"] = run.seconds()
    write_json(Path(out) / "engine.json", found)
    report.write(out)
    return dict(plain(found))


class _Stages:
    """Measurements as stages whose inputs are their sizes, the seed, the device and the code that they time."""

    def __init__(self, run: StagedRun, device: str, seed: int) -> None:
        self._run, self._common = run, [device, seed, threads(), code_mark(*_CODE)]

    def figures(
        self, name: str, work: Callable[[Progress], dict[str, Any]], sizes: dict[str, Any], *code: str
    ) -> dict[str, Any]:
        """The figures of measurement ``name``."""
        inputs = [*self._common, sizes, code_mark(*code) if code else ""]
        return self._run.stage(name, work, inputs=inputs)

    def rows(
        self, name: str, work: Callable[[Progress], list[dict[str, Any]]], sizes: dict[str, Any], *code: str
    ) -> list[dict[str, Any]]:
        """The rows of measurement ``name``."""
        found: list[dict[str, Any]] = self.figures(name, lambda tell: {"rows": work(tell)}, sizes, *code)[
            "rows"
        ]
        return found


def _knobs(stages: _Stages, size: Sizes, seed: int, device: Any, found: dict[str, Any]) -> None:
    known: dict[str, knobs.Scene] = {}

    def scene() -> knobs.Scene:
        if "room" not in known:
            known["room"] = knobs.Scene(size.gaussians, size.shape, seed=seed, device=device)
        return known["room"]

    about = {"gaussians": size.gaussians, "shape": size.shape, "repeats": size.repeats}
    code = ("benchmarks.engine.knobs",)

    def rows(name: str, work: Callable[[], list[dict[str, Any]]], **sizes: Any) -> None:
        def measure(tell: Progress) -> list[dict[str, Any]]:
            tell(name, 0, 1)
            return work()

        found[name] = stages.rows(name, measure, {**about, **sizes}, *code)

    n = size.repeats
    rows("alpha_min", lambda: knobs.cutoff_rows(scene(), "alpha_min", knobs.ALPHA_MIN, repeats=n))
    rows(
        "alpha_max",
        lambda: knobs.cutoff_rows(
            knobs.Scene.screened(size.gaussians, size.shape, seed=seed, device=device),
            "alpha_max",
            knobs.ALPHA_MAX,
            repeats=n,
        ),
    )
    rows("top_k", lambda: knobs.top_k_rows(scene(), size.top_k, repeats=n), top_k=size.top_k)
    rows("precision", lambda: knobs.precision_rows(scene(), repeats=n, seed=seed))
    rows(
        "resolution",
        lambda: knobs.resolution_rows(scene(), size.shapes, repeats=n),
        shapes=size.shapes,
    )
    rows(
        "points",
        lambda: knobs.point_rows(
            min(size.gaussians, 30_000), min(4, max(size.receivers)), size.shape, seed=seed, device=device
        ),
        receivers=size.receivers,
    )
    for name, work, count in (
        ("responses", response_forms, {"gaussians": size.form_gaussians}),
        ("exponentials", exponential_forms, {"values": size.exponentials}),
    ):
        found[name] = stages.rows(
            name,
            lambda tell, work=work, count=count: work(**count, repeats=n, seed=seed, device=device),  # type: ignore[misc]
            {**count, "repeats": n},
            "benchmarks.engine.forms",
        )


def _growth(stages: _Stages, size: Sizes, seed: int, device: Any, found: dict[str, Any]) -> None:
    code = ("benchmarks.engine.knobs",)
    options: dict[str, Any] = {"repeats": min(3, size.repeats), "seed": seed, "device": device}
    for name, work in (("counts", knobs.count_row), ("growth", knobs.growth_row)):
        found[name] = [
            stages.figures(
                f"{name} {count}",
                lambda tell, work=work, count=count: work(count, size.shape, **options),  # type: ignore[misc]
                {"count": count, "shape": size.shape, "repeats": options["repeats"]},
                *code,
            )
            for count in size.counts
        ]
    found["receivers"] = stages.rows(
        "receivers",
        lambda tell: knobs.receiver_rows(
            knobs.Scene(size.gaussians, size.shape, seed=seed, device=device),
            size.receivers,
            repeats=min(2, size.repeats),
            seed=seed,
        ),
        {"gaussians": size.gaussians, "shape": size.shape, "receivers": size.receivers},
        *code,
    )
