"""`python -m benchmarks lobby` and `data`: the main job, and what it works on."""

from __future__ import annotations

import argparse
from pathlib import Path

from warprrf.cli.bars import Bars
from warprrf.cli.inputs import Add
from warprrf.cli.tables import table

HELP_LOBBY = """\
Continues where a killed run stopped; each stage is redone only if its inputs or its code changed. Writes report.html,
report.json (every figure), geometry.ply (Gaussians, opens in any splat viewer), mesh.ply, field.safetensors and
cameras.json. About 15 minutes on two cores, no GPU.

examples:
  python -m benchmarks lobby
  python -m benchmarks lobby --reduced --out runs/quick        few photos and steps, to see it run
"""

HELP_DATA = """\
Builds the scene (meshes, textures, materials), renders the photos with Mitsuba and simulates the spectra with both
engines; needs the extras photos and sionna, and an LLVM of at least 17 for Dr.Jit. Finished photos and receivers are
kept, so that a killed run continues.

examples:
  python -m benchmarks data
  python -m benchmarks data --only spectra
"""


def add_lobby(add: Add) -> None:
    """Define `lobby`."""
    lobby = add("lobby", _lobby, "the main job: photos -> geometry -> radio -> evaluation", HELP_LOBBY)
    lobby.add_argument("--out", default="runs/lobby", help="folder of the results (default runs/lobby)")
    lobby.add_argument("--data", default="data/lobby", help="the lobby's photos, scene and spectra")
    lobby.add_argument(
        "--reduced", action="store_true", help="few photos and steps: shows that it runs, in minutes"
    )
    lobby.add_argument("--fresh", action="store_true", help="start over instead of continuing")


def _lobby(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks.lobby import pipeline

    report = pipeline.run(
        args.out,
        args.data,
        seed=args.seed,
        device=args.device,
        progress=bars,
        reduced=args.reduced,
        fresh=args.fresh,
    )
    bars.close()
    print(pipeline.summary(report))
    for truth, key in (("exact", "methods"), ("Sionna RT", "methods_sionna")):
        print(f"\nheld-out receivers, truth: {truth}\n{table(report[key])}")
    print(f"\n{Path(args.out) / 'report.html'}: the report with pictures; report.json: every figure")


def add_data(add: Add) -> None:
    """Define `data`."""
    data = add("data", _data, "regenerate data/lobby/ from nothing (hours; resumable)", HELP_DATA)
    data.add_argument("--data", default="data/lobby", help="folder to write (default data/lobby)")
    data.add_argument("--only", nargs="+", choices=("scene", "photos", "spectra"), help="these steps alone")
    data.add_argument(
        "--full",
        action="store_true",
        help="all 800 receivers too (spectra_full.nc and spectra_sionna_full.nc)",
    )


def _data(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks.lobby import make_data

    make_data.run(args.data, steps=args.only, full=args.full, progress=bars, device=args.device)
