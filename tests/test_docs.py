"""README and documentation say what is so: current tables, links that lead somewhere, code that parses."""

import ast
import inspect
import json
import pydoc
import re
import sys
import textwrap
import typing
from functools import reduce

import pytest
from fuzz.calls import public
from places import ROOT

import warprrf as wr
import warprrf.viewer
from warprrf.geometry import pipeline
from warprrf.rf.fields.base import ResponseOptions
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.options import FitOptions
from warprrf.rf.fields.harmonic.fitting import FieldOptions
from warprrf.rf.maps.radio_map import MapOptions
from warprrf.rf.relevance.search import Setting
from warprrf.steps import digest

sys.path.append(str(ROOT / "tools" / "docs"))
import reference  # noqa: E402
import results  # noqa: E402
import tables  # noqa: E402

from warprrf import cli  # noqa: E402

README = (ROOT / "README.md").read_text()
GENERATED = ("docs/reference", "docs/figures", "docs/build")
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if not str(p.relative_to(ROOT)).startswith(GENERATED))
CODE = {p: "".join(re.findall(r"```.*?```", p.read_text(), re.DOTALL)) for p in (ROOT / "README.md", *PAGES)}


def test_the_readme_is_short():
    assert len(README.splitlines()) < 150 and not re.search(r"\basked\b", README)
    assert all(len(b.split("\n")) <= 11 for b in re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL))


@pytest.mark.parametrize("page", results.PAGES, ids=lambda p: p.name)
def test_tables_of_a_page_are_current(page):
    text = page.read_text()
    assert results.with_tables(text) == text, "run: python tools/docs/results.py write"


SETTINGS = {"0.05 dB", "0.1 mm", "12.5 mm"}
"""Thresholds and assumed values in the prose of these pages: nothing that was measured."""


@pytest.mark.parametrize(
    "page",
    [p for p in results.PAGES if p.parent.name == "results" or p.name in ("README.md", "limits.md")],
    ids=lambda p: p.name,
)
def test_no_figure_is_typed(page):
    typed = results.TABLE.sub("", page.read_text())
    assert not re.findall(r"^\|.*\d\.\d.*$", typed, re.MULTILINE)
    assert {*re.findall(r"\d+\.\d+ (?:dB|%|n?s|ms|mm|cm|degrees|times)(?!\w)", typed)} <= SETTINGS


STALE: set[str] = set()
"""Result files of before what they depend on computed something else; their pages say so. What is made anew leaves this list."""


def test_result_files_say_which_code_made_them_and_whether_it_is_todays():
    depends = tables.common.DEPENDS
    files = {p.stem: json.loads(p.read_text()) for p in tables.common.FOLDER.glob("*.json")}
    kinds = {tables.common.kind_of(name) for name in files}
    assert kinds == {*depends, "paper", "published", "measured_flat_noise", "measured_office_noise"}
    for name, found in files.items():
        kind = tables.common.kind_of(name)
        if kind in depends:
            assert found["machine"]["commit"] and set(depends[kind]) <= set(found["machine"]["computes"])
    assert {name for name in files if tables.common.older(name)} == STALE
    for name in STALE:
        assert "**Not run since" in tables.table(f"machine-{name}")


GOLDENS = {
    "bistatic": (
        15,
        "d2bcbb07",
        ("bistatic_field", "bistatic_field_of_a_bare_mesh", "bistatic_field_with_held_out_receivers"),
    ),
    "exact": (2, "3322cb96", ("simulated", "spectra_of_the_lobby")),
    "harmonic": (1, "68b51cb8", ("rf3dgs", "rf3dgs_plus")),
    "metrics": (1, "7197e128", ("scores",)),
    "renderer": (1, "38e459e9", ("render_pinhole", "render_spherical")),
}
"""Number of a part in ``VERSIONS``, and goldens that are as they were when it was counted up last."""


@pytest.mark.parametrize("part", GOLDENS)
def test_a_part_whose_goldens_change_is_counted_up(part):
    number, known, cases = GOLDENS[part]
    found = digest(*(ROOT / f"tests/golden/{case}.npz" for case in cases))[:8]
    assert (tables.common.VERSIONS[part], found) == (number, known), (
        "count the part up in VERSIONS, and write both here"
    )


def test_geometry_is_counted_up_with_its_steps():
    assert (tables.common.VERSIONS["geometry"], pipeline.VERSIONS) == (
        8,
        {
            "features": 3,
            "matches": 2,
            "model": 4,
            "photos": 1,
            "initial": 4,
            "refined": 2,
            "depth": 4,
            "surface": 12,  # 80 photos and fewer alone: no result is of so few
        },
    )


def test_a_file_that_is_older_than_what_it_depends_on_is_found(monkeypatch):
    made = json.loads((tables.common.FOLDER / "bare_mesh.json").read_text())["machine"]["computes"][
        "bistatic"
    ]
    monkeypatch.setitem(tables.common.VERSIONS, "bistatic", made)
    assert tables.common.older("bare_mesh") == []
    monkeypatch.setitem(tables.common.VERSIONS, "bistatic", 99)
    assert tables.common.older("bare_mesh") == ["bistatic"] and tables.common.older("truths") == []


def test_where_the_field_is_behind_is_a_line_a_figure_with_the_worst_margin(monkeypatch):
    figures = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "beam_gain_loss_db")
    even = {figure + part: 0.0 for figure in figures for part in ("", "_blocked")}
    place = {"truth": "exact", "split": "random", "method": "nearest"}
    # ahead in PSNR at 10 and in RMSE at 100, behind in RMSE at 10 and in PSNR at 100 and 20
    at = {10: (1.0, 0.5), 100: (-3.0, -0.5), 20: (-2.0, 0.0)}
    rows = [{**place, **even, "count": n, "psnr_db": p, "rmse_db": e} for n, (p, e) in at.items()]
    monkeypatch.setattr(tables.paper, "margins", lambda runs: rows)
    text = tables.paper._paper_behind()
    assert "Of 30 comparisons the bistatic field is behind in 3:" in text
    assert "| PSNR [dB] | 20, 100 | -3 |" in text and "| RMSE [dB] | 10 | +0.5 |" in text
    assert text.count("our own engine") == 2


def test_every_table_that_a_page_names_can_be_made():
    named = {name for page in results.PAGES for name in results.TABLE.findall(page.read_text())}
    assert named >= set(tables.TABLES), "a table that no page shows"
    for name in named:
        assert tables.table(name)


def test_figures_of_a_settled_question_say_when_of_what_and_what_they_answer():
    files = list((ROOT / "benchmarks" / "results" / "settled").glob("*.json"))
    for file in files:
        found = json.loads(file.read_text())
        assert re.fullmatch(r"20\d\d-\d\d-\d\d", found["date"])
        assert re.fullmatch(r"[0-9a-f]{7,40}", found["commit"])
        assert found["question"].endswith("?") and found["answer"], file.name
    assert len(files) > 5


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CHANGELOG.md", *PAGES], ids=lambda p: p.name)
def test_files_that_a_page_links_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert (page.parent / target).exists() or "reference/" in target, target
    for target in re.findall(r"`((?:tests|warprrf|benchmarks|data|tools|docs|notebooks)/[\w./]+)`", text):
        assert (ROOT / target).exists(), f"{target} is named and not there"


def examples(source):
    """Python on a page, calls in its lines, or examples in the docstrings of a module."""
    text, blocks = source.read_text(), r"Example::\n\n((?: +[^\s\"].*\n)+)"
    if source.suffix == ".md":
        blocks, text = r"```python\n(.*?)```", re.sub(r"`(\w[^`\n]*[^=]\))`", r"```python\n\1```", text)
    if source.parent.name == "notebooks":
        return [text]
    found = re.findall(blocks, text, flags=0 if source.suffix == ".py" else re.DOTALL)
    return [textwrap.dedent(block) for block in found]


def called(call):
    """Signatures of what a call may mean: ``wr.NAME``, or a method of that name of anything public."""
    if not isinstance(call.func, ast.Attribute):
        return []
    root, name = ast.unparse(call.func.value), call.func.attr
    if re.fullmatch(r"wr(\.\w+)*", root):
        return [inspect.signature(reduce(getattr, [*root.split(".")[1:], name], wr))]
    if root in ("np", "ax", "axes", "plt", "plan"):
        return []
    kinds = [BistaticField] if root == "field" else [wr.viewer.Viewer, *(getattr(wr, n) for n in dir(wr))]
    own = [getattr(kind, name, None) for kind in kinds if isinstance(kind, type)]
    return [inspect.signature(f.__get__(0) if inspect.isfunction(f) else f) for f in own if callable(f)]


OPTIONS = [FitOptions, FieldOptions, MapOptions, Setting, ResponseOptions, wr.Readings, wr.Material]
"""What ``**options`` are."""
SOURCES = [ROOT / "README.md", *PAGES, *(ROOT / "notebooks").glob("*.py"), *(ROOT / "warprrf").rglob("*.py")]


@pytest.mark.parametrize("source", sorted(s for s in SOURCES if examples(s)), ids=lambda p: p.name)
def test_documented_calls_go_with_the_signatures(source):
    known = {name for options in OPTIONS for name in typing.get_type_hints(options)}
    for block in examples(source):
        for call in (node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Call)):
            given = [a for a in call.args if not isinstance(a, ast.Starred) and ast.unparse(a) != "..."]
            words, wrong = {word.arg: None for word in call.keywords if word.arg}, []
            for signature in called(call):
                wide = [p.name for p in signature.parameters.values() if p.kind is p.VAR_KEYWORD]
                try:
                    taken = signature.bind_partial(*given, **words).arguments
                    wrong.append(set(taken.get(wide[0], ())) - known if wide else None)
                except TypeError as error:
                    wrong.append(error)
            assert not wrong or not all(wrong), f"{ast.unparse(call)}: {wrong}"


def test_names_of_the_reference_are_reached_as_it_prints_them():
    found = re.findall(r"^\.\. auto\w+:: (\S+)", "\n".join(reference.pages().values()), re.MULTILINE)
    assert len(found) > 80
    assert [name for name in found if pydoc.locate(name) is None] == []


def test_terms_of_the_glossary_are_those_of_the_library():
    glossary = (ROOT / "docs/glossary.md").read_text()
    terms = re.findall(r"^\| (?!term)([^|]+) \| [^|]+\. \|", glossary, re.MULTILINE)
    assert len(terms) >= 50 and len(terms) == len(set(terms))
    texts = [p.read_text() for p in (*(ROOT / "warprrf").rglob("*.py"), *PAGES) if p.stem != "glossary"]
    used = re.sub(r"[\s_-]+", " ", " ".join(texts)).lower()
    words = [word for term in terms for word in term.split(", ")]
    assert [word for word in words if re.sub(r"[\s_-]+|\$.*", " ", word).strip().lower() not in used] == []


def test_public_names_are_words_of_the_field():
    own = "look skin crumb sort sent shown told recipe adopt tied lit".split()
    calls = {name: inspect.signature(call).parameters for name, call in public().items()}
    names = [n for call, given in calls.items() for n in (call, *given)]
    assert [n for n in names if {*re.split(r"[._]", n)} & {*own}] == []


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
        every = [line for code in CODE.values() for line in code.splitlines()]
        lines = [line for line in every if name in line and "open" not in line]
        assert len({"".join(re.findall(r"field\.(\w+)\(.*store=", line)) for line in lines}) == 1, lines
    places = [w for code in CODE.values() for w in re.findall(r"workspace=(\"\S+?\")", code)]
    assert stores and len(places) == len(set(places)), "two reconstructions in one workspace"
