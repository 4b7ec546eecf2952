"""README and documentation say what is so: current tables, links that lead somewhere, code that parses."""

import ast
import re
import sys

import pytest
from places import ROOT

sys.path.append(str(ROOT / "tools" / "docs"))
import results  # noqa: E402

README = (ROOT / "README.md").read_text()
GENERATED = ("docs/reference", "docs/figures", "docs/build")
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if not str(p.relative_to(ROOT)).startswith(GENERATED))


def test_the_readme_is_short_and_its_table_is_current():
    assert len(README.splitlines()) <= 150 and not re.search(r"\basked\b", README)
    assert results.readme() in README, "run: python tools/docs/results.py readme"


def test_every_table_that_a_page_names_can_be_made():
    named = {name for page in PAGES for name in re.findall(r"<!-- table: ([\w-]+) -->", page.read_text())}
    assert named >= set(results.TABLES), "a table that no page shows"
    for name in named:
        assert results.table(name)


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CHANGELOG.md", *PAGES], ids=lambda p: p.name)
def test_files_that_a_page_links_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert (page.parent / target).exists() or "reference/" in target, target
    for target in re.findall(r"`((?:tests|warprrf|benchmarks|data|tools|docs|notebooks)/[\w./]+)`", text):
        assert (ROOT / target).exists(), f"{target} is named and not there"


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda p: p.name)
def test_python_on_a_page_parses(page):
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        ast.parse(block)
        if page.name == "README.md":
            assert len([line for line in block.splitlines() if line.strip()]) <= 10
