"""README and documentation say what is so: current tables, links that lead somewhere, code that parses."""

import ast
import re
import sys
from functools import reduce

import pytest
from places import ROOT

sys.path.append(str(ROOT / "tools" / "docs"))
import reference  # noqa: E402
import results  # noqa: E402
import tables  # noqa: E402

import warprrf as wr  # noqa: E402
from warprrf import cli  # noqa: E402

README = (ROOT / "README.md").read_text()
GENERATED = ("docs/reference", "docs/figures", "docs/build")
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if not str(p.relative_to(ROOT)).startswith(GENERATED))
CODE = {p: "".join(re.findall(r"```.*?```", p.read_text(), re.DOTALL)) for p in (ROOT / "README.md", *PAGES)}


def test_the_readme_is_short_and_its_table_is_current():
    assert len(README.splitlines()) <= 150 and not re.search(r"\basked\b", README)
    assert results.readme() in README, "run: python tools/docs/results.py readme"


def test_where_the_field_is_behind_is_a_line_a_figure_with_the_worst_margin(monkeypatch):
    figures = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "beam_gain_loss_db")
    even = {figure + part: 0.0 for figure in figures for part in ("", "_blocked")}
    place = {"truth": "exact", "split": "random", "method": "nearest"}
    # ahead in PSNR at 10 and in RMSE at 100, behind in RMSE at 10 and in PSNR at 100 and 20
    at = {10: (1.0, 0.5), 100: (-3.0, -0.5), 20: (-2.0, 0.0)}
    rows = [{**place, **even, "count": n, "psnr_db": p, "rmse_db": e} for n, (p, e) in at.items()]
    monkeypatch.setattr(tables.paper, "read", lambda name: {"margins": rows})
    text = tables.paper._paper_behind()
    assert "Of 30 comparisons the bistatic field is behind in 3:" in text
    assert "| PSNR [dB] | 20, 100 | -3 |" in text and "| RMSE [dB] | 10 | +0.5 |" in text
    assert text.count("exact engine") == 2


def test_every_table_that_a_page_names_can_be_made():
    named = {name for page in PAGES for name in re.findall(r"<!-- table: ([\w-]+) -->", page.read_text())}
    assert named >= set(tables.TABLES), "a table that no page shows"
    for name in named:
        assert tables.table(name)


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CHANGELOG.md", *PAGES], ids=lambda p: p.name)
def test_files_that_a_page_links_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert (page.parent / target).exists() or "reference/" in target, target
    for target in re.findall(r"`((?:tests|warprrf|benchmarks|data|tools|docs|notebooks)/[\w./]+)`", text):
        assert (ROOT / target).exists(), f"{target} is named and not there"


def test_names_of_the_reference_are_reached_as_it_prints_them():
    listed = set(re.findall(r" as (\w+)$", (ROOT / "warprrf/__init__.pyi").read_text(), re.MULTILINE))
    found = re.findall(r"^\.\. auto\w+:: \w+\.(\S+)", "\n".join(reference.pages().values()), re.MULTILINE)
    assert len(found) > 80
    for first, *rest in (name.split(".") for name in found):
        assert first in listed and reduce(getattr, rest, getattr(wr, first)), (first, *rest)


def test_commands_on_pages_are_taken_by_the_parser():
    seen = set()
    for line in re.findall(r"^(?:\$ )?warprrf (\w.*)", "\n".join(CODE.values()), re.MULTILINE):
        words = re.split(r"  |#", line)[0].split()
        seen.add(words[0])
        args = cli._parser().parse_args(words)
        own = [f"--{word}" for word in getattr(args, "measurements", ()) if "=" in word]
        cli._parser().parse_args([*words, *own])
    assert seen >= {"fit", "sample", "suggest", "render", "simulate", "view", "evaluate", "reconstruct"}


def test_what_a_page_writes_has_a_name_that_no_other_page_gives_to_something_else():
    stores = {name for code in CODE.values() for name in re.findall(r"store=(\"\S+?\")", code)}
    for name in stores:
        lines = [
            line
            for code in CODE.values()
            for line in code.splitlines()
            if f"{name}" in line and "open" not in line
        ]
        assert len({"".join(re.findall(r"field\.(\w+)\(.*store=", line)) for line in lines}) == 1, lines
    places = [w for code in CODE.values() for w in re.findall(r"workspace=(\"\S+?\")", code)]
    assert stores and len(places) == len(set(places)), "two reconstructions in one workspace"


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda p: p.name)
def test_python_on_a_page_parses(page):
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        ast.parse(block)
        if page.name == "README.md":
            assert len([line for line in block.splitlines() if line.strip()]) <= 10
