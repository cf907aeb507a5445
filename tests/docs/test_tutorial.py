"""Tests of the notebook: it is stored without outputs, and `make docs` executes it and fails if a cell fails."""

import json

from tests.docs.pages import REPOSITORY

TUTORIAL = REPOSITORY / "docs" / "tutorials" / "tutorial.ipynb"


def test_no_outputs_are_kept() -> None:
    notebook = json.loads(TUTORIAL.read_text())
    programs = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert programs
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in programs)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}


def test_every_build_runs_it() -> None:
    names: dict[str, object] = {"__file__": str(REPOSITORY / "docs" / "conf.py")}
    exec((REPOSITORY / "docs" / "conf.py").read_text(), names)
    assert names["nb_execution_mode"] == "force"
    assert names["nb_execution_raise_on_error"] is True
