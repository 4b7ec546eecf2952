"""Run the notebooks (`notebooks/*.py`, percent format) and store them with their outputs beside the text (`.ipynb`)."""

from __future__ import annotations

from pathlib import Path

import jupytext
import nbclient
import nbformat


def noise(output: nbformat.NotebookNode) -> bool:
    """Whether an output is what a native library says about this machine, and no result."""
    return output.get("name") == "stderr" or "Open3D" in output.get("text", "")


for source in sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.py")):
    notebook = jupytext.read(source)
    client = nbclient.NotebookClient(
        notebook,
        timeout=1800,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(source.parent)}},
    )
    client.execute()
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not noise(output)]
    notebook.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata.pop("language_info", None)
    target = source.with_suffix(".ipynb")
    nbformat.write(notebook, target)
    print(f"{target.name}: {target.stat().st_size / 1e6:.2f} MB")
