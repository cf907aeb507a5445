"""The tutorial as it lies in git: without what a run leaves. `make docs` runs it, and fails if a cell does."""

import json

from tests.docs.pages import REPOSITORY

TUTORIAL = REPOSITORY / "docs" / "tutorial.ipynb"


def test_no_outputs_are_kept() -> None:
    notebook = json.loads(TUTORIAL.read_text())
    programs = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert programs
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in programs)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}


def test_every_build_runs_it() -> None:
    told: dict[str, object] = {}
    exec((REPOSITORY / "docs" / "conf.py").read_text(), told)
    assert told["nb_execution_mode"] == "force"
    assert told["nb_execution_raise_on_error"] is True
