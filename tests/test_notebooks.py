"""The notebooks run from beginning to end, and what is committed was made from the text beside it."""

import pytest
from places import ROOT

jupytext = pytest.importorskip("jupytext")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
MAX_BYTES = 1_500_000


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_committed_notebook_is_its_text(source):
    text, paired = jupytext.read(source), jupytext.read(source.with_suffix(".ipynb"))
    kept = [(cell.cell_type, cell.source) for cell in paired.cells]
    assert kept == [(cell.cell_type, cell.source) for cell in text.cells]
    code = [cell for cell in paired.cells if cell.cell_type == "code"]
    assert all(cell.get("execution_count") for cell in code), "not executed"
    assert source.with_suffix(".ipynb").stat().st_size < MAX_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(source):
    nbclient = pytest.importorskip("nbclient")
    notebook = jupytext.read(source)
    where = {"metadata": {"path": str(source.parent)}}
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=where).execute()
    printed = [o.get("text", "") for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    assert any("all of it" in text for text in printed)
