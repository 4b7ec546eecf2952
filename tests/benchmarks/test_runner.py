"""One runner: options are the command's, figures go to files."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as command
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option


@pytest.mark.parametrize("name", command.NAMES)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main([name, "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert "examples:" in said and f"python -m benchmarks {name}" in said and "--out" in said


def test_the_library_never_imports_a_benchmark() -> None:
    code = "import sys, warprrf; [getattr(warprrf, n) for n in dir(warprrf)]; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "warprrf.rf.simulate" in out.split()
    assert not [name for name in out.split() if name.split(".")[0] == "benchmarks"]


@dataclass(frozen=True)
class _Options:
    """Options of a benchmark that measures nothing."""

    count: int = option(3, "a number")
    names: tuple[str, ...] = option(("a", "b"), "some names")
    every: int | None = option(None, "one in so many", kind=int)
    quick: bool = option(False, "a flag")
    hidden: float = 0.5


def _run(options: _Options, job: Job) -> Report:
    if options.count < 0:
        raise ValueError("count: got a negative number,\n expected one of at least 0")
    figures = {"options": vars(options), "seed": job.seed, "value": math.nan, "count": options.count}
    return Report("nothing", figures, "some text")


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Benchmark("nothing", _Options, _run, "examples:")
    monkeypatch.setitem(command.NAMES, "nothing", ("nowhere", "measures nothing"))
    monkeypatch.setattr(command, "benchmark", lambda name: one)


def test_options_of_the_command_reach_the_benchmark_and_its_figures_the_files(
    nothing: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = f"nothing --out {tmp_path} --count 2 --names x --quick --seed 7 --quiet --every 5"
    assert command.main(words.split()) == 0
    kept = json.loads((tmp_path / "nothing.json").read_text())
    assert kept["options"] == {"count": 2, "names": ["x"], "every": 5, "quick": True, "hidden": 0.5}
    assert (kept["seed"], kept["value"]) == (7, None)
    assert (tmp_path / "nothing.md").read_text() == "some text\n"
    assert "nothing.md" in capsys.readouterr().out


def test_bad_input_is_one_line_and_status_two(nothing: None, tmp_path: Path, capsys: Any) -> None:
    assert command.main(["nothing", "--out", str(tmp_path), "--count", "-1", "--quiet"]) == 2
    assert capsys.readouterr().err == (
        "python -m benchmarks: error: count: got a negative number, expected one of at least 0\n"
    )


def test_columns_that_no_row_fills_are_left_out() -> None:
    columns = (("a", "A", "{:.1f}"), ("b", "B", "{}"), ("c", "C", "{}"))
    text = columns_table(columns, [{"a": 1.0, "b": None}, {"c": "x"}])
    assert text.splitlines() == ["| A | C |", "| --- | --- |", "| 1.0 | - |", "| - | x |"]


def test_a_page_with_a_title_is_html_with_its_tables(tmp_path: Path) -> None:
    Report("page", {}, "## A & B\n\nwords\n\n| a | b |\n| --- | --- |\n| 1 | <2 |", title="T").write(tmp_path)
    text = (tmp_path / "page.html").read_text()
    assert "<h1>T</h1>" in text and "<h2>A &amp; B</h2>" in text and "<p>words</p>" in text
    assert "<tr><th>a</th><th>b</th></tr><tr><td>1</td><td>&lt;2</td></tr>" in text
