"""The tutorial is executed from its first cell to its last, as a reader does."""

from __future__ import annotations

import nbformat
from nbclient import NotebookClient

from saccade.shared.config import PACKAGE


def test_every_cell_of_the_tutorial_runs(tmp_path):
    notebook = nbformat.read(PACKAGE / "docs" / "tutorial.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "outputs are not kept: clear them before you commit"
    here = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=here).execute()
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
    assert "reached: True" in printed
    assert ": reached after" in printed
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", ())
                if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
