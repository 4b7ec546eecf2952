"""`python -m benchmarks NAME`: the commands that make the tables and pictures."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warprrf.cli.bars import Bars
from warprrf.cli.inputs import Add

HELP_BENCH = """\
Prints a table and writes it as JSON and Markdown.

examples:
  python -m benchmarks channel
  python -m benchmarks relevance
  python -m benchmarks newrf
  python -m benchmarks newrf --data external/newrf --out runs/newrf
  python -m benchmarks bistatic --truths exact --counts 10 50
  python -m benchmarks engine
  python -m benchmarks map --field field.safetensors
  python -m benchmarks table1
  python -m benchmarks sparsity
  python -m benchmarks beams
"""

HELP_BENCH_BISTATIC = """\
Fits the bistatic field, RF-3DGS+ and lookups on the same receivers and scores them on held-out ones; then ablation,
stated uncertainty, delays, a second transmitter, Sionna against itself, Gauss-Newton against Adam. Every row is kept:
a killed run loses one, and a row is made again only if its data, geometry, options or code changed.

examples:
  python -m benchmarks bistatic
  python -m benchmarks bistatic --truths exact --counts 10 --every 4 --out runs/quick     a first look, in minutes
  python -m benchmarks bistatic --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""

HELP_BENCH_ENGINE = """\
Turns each knob of the rasteriser (cutoff, clamp, top K, precision, resolution, number of Gaussians, interaction point,
form of the response and of the exponential) and writes its time and its error as tables and pictures, with the settings
that follow; then growth, mesh rays against Embree, blending against torch, and the transport of 800 receivers on disk.
--opensplat adds the CPU rasteriser of https://github.com/pierotofy/OpenSplat (AGPL), compiled from your own checkout.
Each measurement is kept: a killed run loses one. For figures worth quoting leave the machine alone meanwhile.

examples:
  python -m benchmarks engine
  python -m benchmarks engine --quick --out runs/engine-quick
  python -m benchmarks engine --opensplat ../OpenSplat
"""

HELP_BENCH_EVALUATION = """\
Every method on the same receivers: bistatic, RF-3DGS+ and RF-3DGS (opacity frozen and trained), NeRF2, a conditional
GAN, Sionna RT with assumed and with calibrated materials, lookups. Both commands share one folder: a finished run is
kept in a file of its own, a killed sweep loses the run at work, and a run is done again only if its data, geometry,
options or code changed. The truth `paper-law` is made: scattering that falls with the whole path's length, as the
paper's law has it. Needs the extras plots, baselines, sionna and cluster; --workers 0 does without the last.

examples:
  python -m benchmarks table1
  python -m benchmarks sparsity --workers 0
  python -m benchmarks table1 --methods bistatic rf3dgs+ rf3dgs --counts 10 --every 10      a first look, in minutes
  python -m benchmarks table1 --scale paper --data spectra_full.nc spectra_sionna_full.nc --scheduler tcp://lab:8786
"""

HELP_BENCH_BEAMS = """\
Fits the bistatic field and RF-3DGS+, picks each test receiver's beam without pilots, and compares received SNR and
spectral efficiency on the true channel with exhaustive and hierarchical search, the nearest training receiver's beam,
pointing at the transmitter, zero spectra and random beams. Fitted fields are kept: a killed run continues.

examples:
  python -m benchmarks beams
  python -m benchmarks beams --truths exact --counts 10 --every 4 --sides 4 16 --out runs/quick     a first look
  python -m benchmarks beams --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""


def add_benches(add: Add) -> None:
    """Define every benchmark with ``add``, which makes one command."""
    newrf = add("newrf", _bench, "rays and channels of NeWRF's conference room", HELP_BENCH)
    newrf.add_argument("--out", help="folder of the results (default runs/newrf)")
    newrf.add_argument("--data", help="folder of its files")
    worth = add("relevance", _bench, "what each effect is worth, at two bands and roughnesses", HELP_BENCH)
    worth.add_argument("--out", help="folder of the results (default runs/relevance)")
    worth.add_argument("--data", help="folder of the scene (default data/lobby)")
    ours = add("bistatic", _bench, "the bistatic field beside other systems", HELP_BENCH_BISTATIC)
    _compares_fields(ours, "runs/bistatic", counts="10 50 400")
    ours.add_argument("--second", metavar="FILE", help="spectra under another transmitter (default: made)")
    ours.add_argument(
        "--repeat", type=int, default=10, metavar="N", help="receivers of Sionna's second solve (10; 0: none)"
    )
    engine = add("engine", _bench, "the engine's speed against error", HELP_BENCH_ENGINE)
    engine.add_argument("--out", help="folder of the results (default runs/engine)")
    engine.add_argument("--scene", default="data/lobby/scene.xml", help="scene that rays are cast at (XML)")
    engine.add_argument(
        "--opensplat", metavar="FOLDER", help="checkout of OpenSplat: its CPU rasteriser is a peer too"
    )
    engine.add_argument("--quick", action="store_true", help="tiny sizes: shows that it runs, in a minute")
    _continues(engine)
    radio = add(
        "channel",
        _bench,
        "channels: closed forms, Sionna RT, wide responses, the near field",
        HELP_BENCH,
    )
    radio.add_argument("--out", help="folder of the results (default runs/channel)")
    radio.add_argument("--scene", metavar="XML", help="scene compared with Sionna RT (default the lobby)")
    radio.add_argument(
        "--small", action="store_true", help="leave out 1e5 paths between 1024 and 16 elements"
    )
    radio.add_argument("--no-sionna", action="store_true", help="leave out the comparison with Sionna RT")
    plan = add("map", _bench, "the radio map beside Sionna RT's RadioMapSolver", HELP_BENCH)
    plan.add_argument("--out", help="folder of the results (default runs/map)")
    plan.add_argument("--field", metavar="FILE", help="bistatic field (default: fitted to 50 spectra)")
    plan.add_argument("--geometry", help="a reconstruction's folder (default runs/lobby/reconstruction)")
    plan.add_argument("--scene", metavar="XML", help="true scene (default the lobby)")
    plan.add_argument("--spectra", metavar="FILE", help="what the field is fitted to (default the lobby's)")
    plan.add_argument("--cell", type=float, metavar="M", help="width of a cell (default 0.25)")
    plan.add_argument(
        "--reference", type=float, metavar="N", help="samples of Sionna's reference (default 1e8)"
    )
    for name, line in (
        ("table1", "every method of the paper's table, and more, side by side"),
        ("sparsity", "PSNR and SSIM over the number of training receivers"),
    ):
        _add_evaluation(add(name, _bench, line, HELP_BENCH_EVALUATION))
    beams = add("beams", _bench, "beams chosen from the field, beside pilots", HELP_BENCH_BEAMS)
    _compares_fields(beams, "runs/beams", counts="5 10 50")
    beams.add_argument(
        "--sides", nargs="+", type=int, metavar="N", help="elements a side of an array (4 8 16 32 64)"
    )


def _compares_on_data(one: argparse.ArgumentParser, out: str) -> None:
    """Options of what compares methods on data sets."""
    one.add_argument("--out", help=f"folder of the results (default {out})")
    one.add_argument(
        "--data", nargs="+", help="folder of spectra and scene, or NetCDF files (default data/lobby)"
    )
    one.add_argument("--geometry", help="a reconstruction's folder (default runs/lobby/reconstruction)")
    one.add_argument("--scene", metavar="XML", help="true scene (default: the one beside the data)")
    _continues(one)


def _compares_fields(one: argparse.ArgumentParser, out: str, *, counts: str) -> None:
    """Options of what compares fields on both truths."""
    _compares_on_data(one, out)
    one.add_argument("--counts", nargs="+", type=int, metavar="N", help=f"training receivers ({counts})")
    one.add_argument("--truths", nargs="+", choices=("exact", "sionna"), help="default: both")
    one.add_argument("--every", type=int, default=1, metavar="K", help="each K-th test receiver (1)")


def _continues(one: argparse.ArgumentParser) -> None:
    one.add_argument("--fresh", action="store_true", help="start over instead of continuing")


def _add_evaluation(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--scale", choices=("small", "paper"), default="small",
        help="small: within an hour on two cores; paper: full schedules, all subsets and seeds (default small)",
    )  # fmt: skip
    _compares_on_data(one, "runs/evaluation, for both commands")
    one.add_argument("--methods", nargs="+", metavar="METHOD", help="only these")
    one.add_argument("--truths", nargs="+", metavar="TRUTH", help="exact, sionna, paper-law (the scale's)")
    one.add_argument("--splits", nargs="+", metavar="SPLIT", help="random, region (the scale's)")
    one.add_argument("--counts", nargs="+", type=int, metavar="N", help="training receivers (the scale's)")
    one.add_argument("--seeds", nargs="+", type=int, metavar="S", help="orders of the training receivers")
    one.add_argument("--every", type=int, metavar="K", help="each K-th test receiver (the scale's)")
    one.add_argument("--scheduler", metavar="ADDRESS", help="of a dask scheduler, such as tcp://lab:8786")
    one.add_argument(
        "--workers", type=int, default=1, metavar="N",
        help="processes of a local cluster without --scheduler (default 1; 0: in this process)",
    )  # fmt: skip


def _bench_newrf(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import newrf

    report = newrf.run(args.out or "runs/newrf", args.data or newrf.DATA, device=args.device, progress=bars)
    bars.close()
    print(newrf.summary_text(report))


def _bench_bistatic(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import bistatic

    out = args.out or "runs/bistatic"
    report = bistatic.run(
        out,
        every=args.every,
        repeat=args.repeat,
        seed=args.seed,
        fresh=args.fresh,
        device=args.device,
        progress=bars,
        **_given(args, "data", "geometry", "scene", "second", "counts", "truths"),
    )
    bars.close()
    print(bistatic.summary_text(report))
    print(f"\n{Path(out) / 'bistatic.md'}: the tables with pictures; bistatic.json: every figure")


def _bench_relevance(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import relevance

    report = relevance.run(
        args.out or "runs/relevance", args.data or relevance.DATA, device=args.device, progress=bars
    )
    bars.close()
    print(relevance.summary_text(report))


def _bench_engine(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import engine

    out = args.out or "runs/engine"
    sizes = engine.QUICK if args.quick else engine.Sizes()
    report = engine.run_engine(
        out,
        scene=args.scene,
        sizes=sizes,
        seed=args.seed,
        device=args.device,
        opensplat=args.opensplat,
        fresh=args.fresh,
        progress=bars,
    )
    bars.close()
    print(engine.summary_text(report))
    print(f"\n{Path(out) / 'engine.md'}: the tables with pictures; engine.json: every figure")


def _bench_channel(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import channel

    report = channel.run_channel(
        args.out or "runs/channel",
        scene=args.scene or channel.SCENE,
        large=not args.small,
        sionna=not args.no_sionna,
        device=args.device,
        progress=bars,
    )
    bars.close()
    print(channel.table(report))


def _bench_map(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import radio_map

    named = _given(args, "field", "geometry", "scene", "spectra", "cell")
    if args.reference is not None:
        named["reference"] = int(args.reference)
    report = radio_map.run_map(
        args.out or "runs/map",
        seed=args.seed,
        device=args.device,
        progress=bars,
        **named,
    )
    bars.close()
    print(radio_map.table(report))


def _bench_evaluation(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import evaluation

    out = args.out or "runs/evaluation"
    given = _given(
        args, "data", "geometry", "scene", "methods", "truths", "splits", "counts", "seeds", "every"
    )
    if args.seed and "seeds" not in given:
        given["seeds"] = [args.seed]
    report = evaluation.run(
        args.name,
        out,
        scale=args.scale,
        scheduler=args.scheduler,
        workers=args.workers,
        device=args.device,
        fresh=args.fresh,
        progress=bars,
        **given,
    )
    bars.close()
    print(evaluation.markdown(args.name, report))
    print(f"\n{Path(out) / args.name}.md: the tables with pictures; .csv and .json: every figure")


def _bench_beams(args: argparse.Namespace, bars: Bars) -> None:
    from benchmarks import beams

    out = args.out or "runs/beams"
    report = beams.run_beams(
        out,
        every=args.every,
        seed=args.seed,
        fresh=args.fresh,
        device=args.device,
        progress=bars,
        **_given(args, "data", "geometry", "scene", "counts", "truths", "sides"),
    )
    bars.close()
    print(beams.summary_text(report))
    print(f"\n{Path(out) / 'beams.md'}: the tables with pictures; beams.json: every figure")


def _given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the options that were given; one file or folder of data by itself."""
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if len(given.get("data", ())) == 1:
        given["data"] = given["data"][0]
    return given


BENCHES: dict[str, Callable[[argparse.Namespace, Bars], None]] = {
    "newrf": _bench_newrf,
    "bistatic": _bench_bistatic,
    "relevance": _bench_relevance,
    "engine": _bench_engine,
    "channel": _bench_channel,
    "map": _bench_map,
    "table1": _bench_evaluation,
    "sparsity": _bench_evaluation,
    "beams": _bench_beams,
}
"""Benchmarks by name: what `python -m benchmarks NAME` runs."""


def _bench(args: argparse.Namespace, bars: Bars) -> None:
    BENCHES[args.name](args, bars)
