"""One runner: options are the command's, figures go to files."""

import json
import math
from dataclasses import dataclass

from benchmarks import __main__ as command
from benchmarks.report import Report
from benchmarks.runner import Benchmark, option


@dataclass(frozen=True)
class _Options:
    """Options of a benchmark that measures nothing."""

    count: int = option(3, "a number")
    names: tuple[str, ...] = option(("a", "b"), "some names")
    every: int | None = option(None, "one in so many", kind=int)
    quick: bool = option(False, "a flag")
    hidden: float = 0.5


def _run(options, job):
    if options.count < 0:
        raise ValueError("count: got a negative number,\n expected one of at least 0")
    figures = {"options": vars(options), "seed": job.seed, "value": math.nan, "count": options.count}
    return Report("nothing", figures, "some text")


def test_options_of_the_command_reach_the_benchmark_and_its_figures_the_files(tmp_path, monkeypatch, capsys):
    one = Benchmark("nothing", _Options, _run, "examples:")
    monkeypatch.setitem(command.NAMES, "nothing", ("nowhere", "measures nothing"))
    monkeypatch.setattr(command, "benchmark", lambda name: one)
    words = f"nothing --out {tmp_path} --count 2 --names x --quick --seed 7 --quiet --every 5"
    assert command.main(words.split()) == 0
    kept = json.loads((tmp_path / "nothing.json").read_text())
    assert kept["options"] == {"count": 2, "names": ["x"], "every": 5, "quick": True, "hidden": 0.5}
    assert (kept["seed"], kept["value"]) == (7, None)
    assert (tmp_path / "nothing.md").read_text() == "some text\n"
    assert "nothing.md" in capsys.readouterr().out
    assert command.main(["nothing", "--out", str(tmp_path), "--count", "-1", "--quiet"]) == 2
    told = "error: count: got a negative number, expected one of at least 0\n"
    assert capsys.readouterr().err == f"python -m benchmarks: {told}"
