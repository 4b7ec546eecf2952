"""``make data``: the lobby from nothing: scene, photos and spectra, each step resumable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.lobby import photos, scene, spectra
from benchmarks.machine import connected
from benchmarks.runner import Benchmark, Job, option

STEPS = ("scene", "photos", "spectra")

HELP = """\
Builds the scene (meshes, textures, materials), renders the photos with Mitsuba and simulates the spectra with both
engines; needs the extras photos and sionna, and an LLVM of at least 17 for Dr.Jit. Finished photos and receivers are
kept, so that a killed run continues.

examples:
  python -m benchmarks data
  python -m benchmarks data --only spectra --full --workers 2      also the 800 receivers of the paper's size; resumable
"""


@dataclass(frozen=True)
class Options:
    """Options of the data.

    Attributes:
        data: folder to write.
        only: steps to do, of ``"scene"``, ``"photos"``, ``"spectra"``.
        workers: processes of one thread each that simulate, by dask; 0: this one alone.
        full: also 800 receivers at the paper's size, beside the committed sample (``*_full.nc``).
    """

    data: str = option("data/lobby", "folder to write")
    only: tuple[str, ...] = option(STEPS, "steps to do", choices=STEPS)
    workers: int = option(0, "processes of one thread each that simulate; 0: this one alone")
    full: bool = option(
        False, "the paper's size too: spectra_full.nc, spectra_sionna_full.nc (an hour or two)"
    )


def run(options: Options, job: Job) -> None:
    """Make what is missing of the named steps.

    Raises:
        ValueError: for an unknown step, or photos and spectra without a scene.
        ImportError: if the extra ``sionna`` is not installed.
    """
    unknown = sorted(set(options.only) - set(STEPS))
    if unknown:
        raise ValueError(f"only: got {', '.join(unknown)}, expected some of {', '.join(STEPS)}")
    data = Path(options.data)
    if "scene" in options.only:
        scene.build(data, progress=job.progress)
    if not (data / "scene.xml").is_file():
        raise ValueError(f"data: {data} holds no scene.xml; make the scene first (step scene)")
    if "photos" in options.only:
        photos.make_photos(data, progress=job.progress)
    if "spectra" in options.only:
        with connected(None, options.workers, 1) as client:
            for whole in (False, True) if options.full else (False,):
                spectra.make(data, full=whole, client=client, progress=job.progress, device=job.device)


BENCHMARKS = {"data": Benchmark("data", Options, run, HELP)}
