"""`python -m benchmarks NAME`: the lobby, its data, and every table and figure."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from functools import partial

from benchmarks.runner import Benchmark, add_options, run_command
from warprrf import cli
from warprrf.cli.output import Output

NAMES = {
    "lobby": ("benchmarks.lobby.pipeline", "the main job: photos -> geometry -> radio -> evaluation"),
    "lobby-seeds": ("benchmarks.lobby.seeds", "the main job's figures over several seeds: mean and spread"),
    "data": ("benchmarks.lobby.make_data", "regenerate data/lobby/ from nothing (hours; resumable)"),
    "paper": (
        "benchmarks.evaluation",
        "the paper's evaluation on any data set and room: fields, networks, a ray tracer",
    ),
    "bistatic": (
        "benchmarks.bistatic",
        "what the bistatic field's parts are worth, its uncertainty and delays",
    ),
    "beams": ("benchmarks.beams", "beams chosen from the field without pilots"),
    "engine": ("benchmarks.engine.table", "the engine's speed against error"),
    "truths": (
        "benchmarks.engine.truths",
        "the exact engine beside Sionna RT: time against noise, to depth 3",
    ),
    "gpu": ("benchmarks.gpu", "tests and times on a CUDA device; without one a dry run"),
    "map": ("benchmarks.radio_map", "the radio map beside Sionna RT's RadioMapSolver"),
    "relevance": ("benchmarks.relevance", "what each effect is worth, at two carriers and three roughnesses"),
    "newrf": ("benchmarks.newrf", "data of the second room: NeWRF's conference room"),
    "photos": ("benchmarks.photos", "photos of any place: every eighth held out, rendered and compared"),
    "bare-mesh": ("benchmarks.bare_mesh", "a mesh without names, and a scan, beside the scene with names"),
    "filmed": ("benchmarks.filmed", "a filmed room against an RGB-D camera's depth"),
    "stage1": ("benchmarks.stage1", "the reconstruction with every stage off, one at a time"),
    "measurements": (
        "benchmarks.measurements",
        "horns, power alone, delay profiles and one spectrum, beside ten spectra",
    ),
    "arrays": ("benchmarks.arrays", "spectra of coherent arrays at places that were not measured"),
    "suggest": (
        "benchmarks.suggest",
        "receivers that the field suggests beside random ones, from none to ten",
    ),
    "locate": (
        "benchmarks.locate",
        "receivers located from a spectrum or a horn's pointings, beside the nearest measurement",
    ),
    "times": ("benchmarks.times", "what each verb takes in the lobby or in a city: seconds and memory"),
    "measured": (
        "benchmarks.measured.command",
        "a measured place: links held out, fields beside simple rivals and the measurement's noise",
    ),
    "office": ("benchmarks.office", "two rooms parted by glass and plasterboard: a field behind the walls"),
    "edited": ("benchmarks.edited", "a room that changed: a person across a link, a cabinet moved"),
    "outside": (
        "benchmarks.outside",
        "measurements by others: an array's pictures over carriers",
    ),
}
"""Benchmarks: name to the module that has it in ``BENCHMARKS``, and a line about it."""

EPILOG = """\
  python -m benchmarks lobby            photos -> geometry -> radio -> evaluation, into runs/lobby/
  python -m benchmarks data             regenerate data/lobby/
  python -m benchmarks bistatic         one table of figures; `python -m benchmarks NAME --help` explains each
"""


def benchmark(name: str) -> Benchmark:
    """The benchmark of that name; its module is imported now."""
    found: Benchmark = importlib.import_module(NAMES[name][0]).BENCHMARKS[name]
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark and return its exit status: 0 done, 2 bad input, 130 interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    asked = next((word for word in words if word in NAMES), None)
    definitions = [partial(_define, name=name, whole=name == asked) for name in NAMES]
    text = "Experiments: every table and figure from one command each."
    return cli.run(cli.make_parser("python -m benchmarks", text, EPILOG, definitions), words)


def _define(add: Callable[..., argparse.ArgumentParser], name: str, whole: bool) -> None:
    """One command; its options are read from its module only where it is the one that was asked for."""
    line = NAMES[name][1]
    if not whole:
        add(name, _nothing, line, "")
        return
    one = benchmark(name)
    add_options(add(name, partial(_run, one), line, one.help), one)


def _run(one: Benchmark, args: argparse.Namespace, out: Output) -> None:
    run_command(one, args, out)


def _nothing(args: argparse.Namespace, out: Output) -> None:
    """Stands for the commands that were not asked for."""


if __name__ == "__main__":
    sys.exit(main())
