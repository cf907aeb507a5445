"""Tests of the pages: their links, the README, the notebook, and versions and commands that several files name."""

import json
import re
from pathlib import Path

import pytest
import yaml

import handover_marl
from tests.docs.pages import PAGES, REPOSITORY, name
from tests.helpers.setup_file import list_supported

README = (REPOSITORY / "README.md").read_text()
WORKFLOWS = REPOSITORY / ".github" / "workflows"
_LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
_FILE = re.compile(r"`((?:handover_marl|receivers|givers|assets|experiments|tests)/[\w/]+\.py)`")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files(page: Path) -> None:
    text = page.read_text()
    links = [link for link in _LINK.findall(text) if not link.startswith(("http", "mailto"))]
    missing = [link for link in links if not (page.parent / link).exists()]
    missing += [file for file in _FILE.findall(text) if not (REPOSITORY / file).exists()]
    assert missing == []


def test_the_readme_is_short_and_starts_with_what_runs() -> None:
    lines = README.splitlines()
    assert len(lines) < 120
    for part in ("![", "pip install", "parallel_env(", "docs/results/s0_test.svg"):
        assert part in "\n".join(lines[:30])
    # A clone called handover_marl would hide the library from programs beside it.
    assert re.search(r"^git clone <.+> handover-marl;", README, re.MULTILINE)


def test_supported_pythons_are_tested_and_the_site_is_built() -> None:
    job = yaml.safe_load((WORKFLOWS / "tests.yml").read_text())["jobs"]["tests"]
    assert {"run": ".ci/run"} in job["steps"]
    assert job["strategy"]["matrix"]["python"] == list_supported()
    steps = yaml.safe_load((WORKFLOWS / "docs.yml").read_text())["jobs"]["build"]["steps"]
    assert {"run": "make docs"} in steps
    built = next(step["with"]["path"] for step in steps if "upload-pages-artifact" in step.get("uses", ""))
    assert f" docs {built}\n" in (REPOSITORY / "Makefile").read_text()


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["version"] == handover_marl.__version__
    assert citation["title"] in (REPOSITORY / "docs" / "index.md").read_text()


def test_the_notebook_has_no_outputs_and_runs_in_every_build() -> None:
    notebook = json.loads((REPOSITORY / "docs" / "tutorials" / "episode_and_benchmark.ipynb").read_text())
    programs = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert programs
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in programs)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    conf = (REPOSITORY / "docs" / "conf.py").read_text()
    assert 'nb_execution_mode = "force"\n' in conf
    assert "nb_execution_raise_on_error = True\n" in conf
