"""The notebooks run from beginning to end, on less than they show; what is committed was made from the text beside it."""

import json

import pytest
from places import ROOT
from views import lobby_cameras

jupytext = pytest.importorskip("jupytext")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
MAX_BYTES = 1_500_000
VIEWS = [f"view_{k:03d}.jpg" for k in range(22, 28)]
FEWER = {
    "01_lobby_walkthrough": {
        "*range(16, 30), *range(48, 62), 69, 70, 72, 75, 78, 79, 82, 83, 84, 86, 89, 92, 93, 94, 96, 97, 99, 100, 105, 108,"
        "\n    110, 113, 114, 117, 119,\n": "*range(22, 28)",
        '(DATA / "surveyed.json")': 'Path("{surveyed}")',
        'DATA.parent.parent / "runs" / "notebook"': 'Path("{work}")',
        "max_features=1200": "max_features=600",
        "gaussians=8000": "gaussians=2000, sweep=False, stereo=False, completion=False",
        "iterations=100": "iterations=4",
        "iterations=60": "iterations=4",
        'model="bistatic"': 'model="bistatic", quick=True',
        "split(16)": "split(4)",
        "range(16)": "range(4)",
    },
    "02_beamforming": {
        "RECEIVERS = 24": "RECEIVERS = 4",
        "effects=single)": "effects=single, quick=True)",
        "(np.arange(8) + 0.5) / 8": "(np.arange(2) + 0.5) / 2",
        "split(10)": "split(4)",
        "(4, 8, 16, 32)": "(4, 8, 16)",
        "[16, 64, 256, 1024]": "[16, 64, 256]",
    },
    "03_speed_against_error": {
        "repeats=2": "repeats=1",
        "3_000": "500",
        "of_strongest(256)": "of_strongest(64)",
        '"mirrors": 3': '"mirrors": 2',
        "split(10)": "split(3)",
        "images(8)": "images(3)",
        "(1, 2, 3, 4, 6)": "(1, 2)",
        "[:6]": "[:2]",
        ", (20, 40), (40, 80))": ")",
        "radio_map(1.5, 1.0": "radio_map(1.5, 3.0",
        "radio_map(1.5, 0.6": "radio_map(1.5, 3.0",
    },
    "04_your_measurements": {
        "split(40)": "split(8)",
        "(room, nothing)": "(room, nothing, quick=True)",
        "quick=True)": 'quick=True, effects="single")',
        "choice(40": "choice(8",
        "np.arange(0, 100, 4)": "[0, 30]",
        "range(5)": "range(1)",
    },
}
"""What each notebook's text says, and what it says where it runs here: enough for every cell, and no figure worth a look."""


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_committed_notebook_is_its_text(source):
    text, paired = jupytext.read(source), jupytext.read(source.with_suffix(".ipynb"))
    kept = [(cell.cell_type, cell.source) for cell in paired.cells]
    assert kept == [(cell.cell_type, cell.source) for cell in text.cells]
    code = [cell for cell in paired.cells if cell.cell_type == "code"]
    assert all(cell.get("execution_count") for cell in code), "not executed"
    assert source.with_suffix(".ipynb").stat().st_size < MAX_BYTES


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(p, marks=[pytest.mark.long] * p.stem.startswith(("02", "03")), id=p.stem)
        for p in NOTEBOOKS
    ],
)
def test_notebook_runs(source, tmp_path):
    nbclient = pytest.importorskip("nbclient")
    text, surveyed = source.read_text(), tmp_path / "surveyed.json"
    surveyed.write_text(json.dumps({n: c.position.tolist() for n, c in lobby_cameras(VIEWS).items()}))
    for whole, fewer in FEWER[source.stem].items():
        assert whole in text
        text = text.replace(whole, fewer.format(surveyed=surveyed, work=tmp_path))
    notebook = jupytext.reads(text, fmt="py:percent")
    where = {"metadata": {"path": str(source.parent)}}
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=where).execute()
    printed = [o.get("text", "") for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    assert any("all of it" in text for text in printed)
