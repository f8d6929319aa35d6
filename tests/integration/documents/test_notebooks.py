"""Tutorials run as notebooks, in the kernel of Jupyter."""

import sys
from importlib import import_module
from pathlib import Path

import pytest

from service.pages.documentation.guides import list_notebooks, make_notebook
from tests.documents.tutorials import find_free_port
from tests.support.checkout import ROOT
from tests.support.requirements import report_missing

CELL_SECONDS = 400


@pytest.mark.night
@pytest.mark.parametrize("path", list_notebooks())
def test_the_cells_of_a_notebook_run(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        jupyter = {name: import_module(name) for name in ("ipykernel", "nbclient", "nbformat")}
    except ImportError as error:
        report_missing("notebook", f"there is no {error.name}")
    port = find_free_port()
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=":")
    monkeypatch.setenv("LAGID_PORT", str(port))
    monkeypatch.setenv("LAGID_URL", f"http://127.0.0.1:{port}")
    notebook = jupyter["nbformat"].reads(make_notebook(path), as_version=4)
    jupyter["nbformat"].validate(notebook)
    folder = {"metadata": {"path": str(tmp_path)}}
    options = {"timeout": CELL_SECONDS, "resources": folder}
    jupyter["nbclient"].NotebookClient(notebook, **options).execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)
    assert any(cell.outputs for cell in code)
