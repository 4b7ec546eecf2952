"""The command line: every step of the library as a command.

`main` parses, calls one public function and writes what came back; nothing is computed here. Bad input ends with one
line on standard error and status 2 (`--debug` shows the traceback instead), Ctrl-C with 130. With `--json` all of it is
one JSON object a line on standard output; see :class:`~warprrf.cli.output.Output`.
"""

from __future__ import annotations

import argparse
import inspect
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import warprrf as wr
from warprrf.cli import steps, views
from warprrf.cli.inputs import Add, Parser
from warprrf.cli.output import INTERRUPTED, Output

COMMANDS = (
    steps.add_reconstruct, steps.add_sample, steps.add_simulate, steps.add_fit, steps.add_suggest, steps.add_locate,
    steps.add_relevance, views.add_render, steps.add_evaluate, views.add_map, views.add_twin, views.add_view,
)  # fmt: skip
"""What defines a command each, in the order of the help."""

EPILOG = """\
a walk through:
  warprrf reconstruct photos/ -o room --known-positions surveyed.json
  warprrf sample data/lobby/scene.xml -o receivers.csv -n 60
  warprrf simulate data/lobby/scene.xml -o spectra.nc --transmitter 2 3 3.2 --receivers receivers.csv
  warprrf fit room spectra.nc -o field.safetensors
  warprrf suggest field.safetensors candidates.csv -n 3
  warprrf evaluate field.safetensors spectra.nc
  warprrf render field.safetensors --receiver 7 4 1.5 -o spectrum.png
  warprrf map field.safetensors -o map.nc --height 1.5 --cell 0.25
  warprrf view room field.safetensors              in the browser: drag a receiver
  warprrf twin field.safetensors -o twin           scene.xml and materials.json for Sionna RT

Metres, seconds, hertz, world z up. `warprrf COMMAND --help` explains each with examples. With --json, standard output
holds one JSON object a line and nothing else: {"event": "progress", "stage", "done", "total", "seconds_left"}, one
{"event": "result", "files", figures ...} or {"event": "error", "message", "status"}. Ctrl-C ends a command at once
with status 130; what reconstruct and simulate have finished is kept, and the same command goes on from there.
"""

_NEGATIVE = re.compile(r"-[.\d][-+.,\deE]*")  # numbers such as -1, -1e-3 and -1,4,1.5


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 2 bad input, 130 interrupted."""
    return run(_parser(), argv)


def run(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> int:
    """Run one command of ``parser`` (see :func:`make_parser`) and return its exit status."""
    words = sys.argv[1:] if argv is None else argv
    out, debug = Output(parser.prog, lines="--json" in words), False
    try:
        # A space before a number that is negative keeps argparse from taking it for an option; whoever reads it drops it.
        args = parser.parse_args([f" {word}" if _NEGATIVE.fullmatch(word) else word for word in words])
        out, debug = Output(parser.prog, args.json, args.quiet), args.debug
        _spare_inputs(args)
        with out.speaking():
            args.command(args, out)
            out.close()
    except KeyboardInterrupt:
        out.interrupted()
        return INTERRUPTED
    except Exception as error:
        bad = isinstance(error, (ValueError, TypeError, OSError, ImportError, MemoryError))
        if out.lines or (bad and not debug):
            out.error(f"error: {_one_line(error)}", 2 if bad else 1)
        if debug or not bad:
            raise
        return 2
    return 0


def _spare_inputs(args: argparse.Namespace) -> None:
    """Refuse a result in the place of a file that the command reads: it cannot be made again."""
    given = {name: value for name, value in vars(args).items() if name != "out"}
    words = [w for value in given.values() for w in (value if isinstance(value, list) else [value])]
    out = Path(getattr(args, "out", None) or "")
    if out.is_file() and any(isinstance(w, str) and os.path.exists(w) and out.samefile(w) for w in words):
        raise ValueError(f"--out: got {args.out!r}, which the command reads; expected another name")


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _parser() -> argparse.ArgumentParser:
    about = "Radio radiance fields from photos and a few radio measurements."
    return make_parser("warprrf", about, EPILOG, COMMANDS)


def make_parser(
    prog: str, description: str, epilog: str, definitions: Sequence[Callable[[Add], None]]
) -> argparse.ArgumentParser:
    """A parser of commands, each with the common options; every one of ``definitions`` adds some.

    A command is explained by the docstring of the function that runs it, unless a line and a text are given.
    """
    common = Parser(add_help=False)
    common.add_argument("--seed", type=int, default=0, help="every random choice follows from it (default 0)")
    common.add_argument("--device", default=None, help="cpu or cuda:0 (default: the GPU where there is one)")
    common.add_argument("--quiet", action="store_true", help="no progress")
    common.add_argument(
        "--json", action="store_true", help="progress, result and errors as JSON, an object a line"
    )
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")

    parser = Parser(
        prog=prog,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{prog} {wr.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(
        name: str,
        run: Callable[..., None],
        line: str | None = None,
        text: str | None = None,
    ) -> argparse.ArgumentParser:
        summary, _, explained = inspect.cleandoc(run.__doc__ or "").partition("\n\n")
        line = summary.removesuffix(".") if line is None else line
        one: argparse.ArgumentParser = commands.add_parser(
            name,
            help=line,
            description=f"{line[0].upper()}{line[1:]}.",
            epilog=explained if text is None else text,
            parents=[common],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        one.set_defaults(command=run)
        return one

    for define in definitions:
        define(add)
    return parser
