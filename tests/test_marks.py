"""The mark of code follows what a module runs when it is loaded, and nothing else."""

import pytest

from warprrf import marks
from warprrf.marks import code_mark

SOURCES = {
    "__init__": "",
    "top": "import numpy\nfrom marked.deep import middle\nfrom marked.deep.taken import VALUE\n",
    "deep/__init__": "",
    "deep/middle": "class A:\n    from ..bottom import low\n    def late(self):\n        from marked import later\n",
    "deep/taken": "VALUE = 1\n",
    "bottom/__init__": "",
    "bottom/low": "if 1:\n    import marked.lowest\n",
    "lowest": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from marked import typed\n",
    "later": "",
    "typed": "",
    "apart": "",
}
RUN = ("top", "deep/middle", "deep/taken", "bottom/low", "lowest")


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of modules that import each other, and ``write(name, source)`` to change one."""

    def write(name, source):
        file = tmp_path / "marked" / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source)
        marks._read.cache_clear()

    for name, source in SOURCES.items():
        write(name, source)
    monkeypatch.syspath_prepend(tmp_path)
    yield write
    marks._read.cache_clear()


@pytest.mark.parametrize("name", RUN)
def test_a_change_in_anything_that_is_run_changes_the_mark(package, name):
    before = code_mark("marked.top")
    package(name, SOURCES[name] + "CHANGED = 1\n")
    assert code_mark("marked.top") != before
    package(name, SOURCES[name])
    assert code_mark("marked.top") == before


@pytest.mark.parametrize("name", ["apart", "later", "typed"])
def test_a_change_elsewhere_leaves_the_mark(package, name):
    before = code_mark("marked.top")
    package(name, "CHANGED = 1\n")
    assert code_mark("marked.top") == before
    assert code_mark("marked.top", f"marked.{name}") != before


def test_a_package_stands_for_all_modules_below_it(package):
    before = code_mark("marked.deep"), code_mark("marked")
    package("deep/new", "")
    assert code_mark("marked.deep") != before[0] and code_mark("marked") != before[1]


def test_the_version_of_a_package_is_part_of_the_mark(monkeypatch):
    marks._versions.cache_clear()
    before = code_mark("warprrf.device", packages=("numpy",))
    assert before != code_mark("warprrf.device")
    monkeypatch.setattr(marks, "version", lambda name: "99")
    marks._versions.cache_clear()
    assert code_mark("warprrf.device", packages=("numpy",)) != before
    monkeypatch.undo()
    marks._versions.cache_clear()
    assert code_mark("warprrf.device", packages=("numpy",)) == before
    assert code_mark("warprrf.device", packages=("no_such_package",))  # missing is a state too


@pytest.mark.parametrize("name", ["warprrf.no_such_module", "no_such_package", "sys"])
def test_a_module_without_source_is_refused(name):
    with pytest.raises(ValueError, match=f"modules: '{name}' has no source file"):
        code_mark(name)
