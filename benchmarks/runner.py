"""What a benchmark is, and the one way to run it.

A benchmark's options are the fields of a frozen dataclass, which are those of its command as well; it gets them and a
:class:`Job`, and returns a :class:`~benchmarks.report.Report`, which the runner writes and prints.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from benchmarks.report import Report
from warprrf.cli.output import Output
from warprrf.device import Progress


def _silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Job:
    """Where a benchmark runs, and for whom.

    Attributes:
        out: folder of the results; what an earlier run finished there is kept.
        seed: every random choice follows from it.
        device: Warp device.
        fresh: start over instead of continuing.
        progress: ``progress(stage, done, total)``.
    """

    out: Path
    seed: int = 0
    device: Any = None
    fresh: bool = False
    progress: Progress = _silent


@dataclass(frozen=True)
class Benchmark:
    """One command.

    Attributes:
        name: of the command.
        config: frozen dataclass of its options; see :func:`option`.
        run: does it, from options and job to a report; None if it writes all that there is itself.
        help: what the command explains of itself, with examples.
        out: default folder of the results.
    """

    name: str
    config: type[Any]
    run: Callable[[Any, Job], Report | None]
    help: str
    out: str = ""


def option(
    default: Any,
    text: str,
    *,
    choices: tuple[str, ...] | None = None,
    kind: Any = None,
    positional: bool = False,
) -> Any:
    """A field of a benchmark's options that its command has too, as ``--name-of-the-field``.

    Args:
        default: its type is the option's; a tuple takes several values, a bool is a flag.
        text: one line of help.
        choices: what is allowed.
        kind: type of a value where the default does not tell (None, or an empty tuple); text by default.
        positional: a word of the command without a name before it.
    """
    known = {"help": text, "choices": choices, "kind": kind, "positional": positional}
    return field(default=default, metadata=known)


def execute(benchmark: Benchmark, config: Any, job: Job) -> dict[str, Any]:
    """Run ``benchmark``, write its report into the job's folder, and return the figures as they were written."""
    report = benchmark.run(config, job)
    return {} if report is None else report.write(job.out)


def add_options(parser: argparse.ArgumentParser, benchmark: Benchmark) -> None:
    """Give ``parser`` the options of ``benchmark``."""
    folder = benchmark.out or f"runs/{benchmark.name}"
    parser.add_argument("--out", default=folder, help=f"folder of the results (default {folder})")
    parser.add_argument("--fresh", action="store_true", help="start over instead of continuing")
    for one in fields(benchmark.config):
        if "help" not in one.metadata:
            continue
        default = one.default if one.default is not MISSING else None
        first = default[0] if isinstance(default, tuple) and default else default
        named: dict[str, Any] = {"dest": one.name, "default": default, "help": one.metadata["help"]}
        if isinstance(default, bool):
            named["action"] = argparse.BooleanOptionalAction
        else:
            named["type"] = one.metadata["kind"] or (str if first is None or first == () else type(first))
            named["choices"] = one.metadata["choices"]
        if isinstance(default, tuple):
            named["nargs"] = "+"
        if default is not None and default != () and not isinstance(default, bool):
            shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
            named["help"] += f" (default {shown})"
        if one.metadata["positional"]:
            del named["dest"]
            parser.add_argument(one.name, nargs="?", **named)
        else:
            parser.add_argument(f"--{one.name.replace('_', '-')}", **named)


def run_command(benchmark: Benchmark, args: argparse.Namespace, out: Output) -> None:
    """Run ``benchmark`` with parsed options, and say what it found and where it lies."""
    asked = {one.name: getattr(args, one.name) for one in fields(benchmark.config) if "help" in one.metadata}
    asked = {name: tuple(value) if isinstance(value, list) else value for name, value in asked.items()}
    job = Job(Path(args.out), args.seed, args.device, args.fresh, out)
    out.resumes(job.out)
    report = benchmark.run(benchmark.config(**asked), job)
    if report is None:
        return
    figures = report.write(job.out)
    page, data = report.page(job.out), job.out / f"{report.name}.json"
    text = f"{report.text}\n\n{page}: tables and pictures; {data.name}: every figure"
    out.result(text, files=[page, data], figures=figures)
