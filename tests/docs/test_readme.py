"""Tests of the README's content, and of versions and commands that several files name."""

import configparser
import re
import subprocess
import sys
from pathlib import Path

import yaml

import handover_marl
from tests.docs.pages import REPOSITORY

README = REPOSITORY / "README.md"
WORKFLOWS = REPOSITORY / ".github" / "workflows"


def setup_cfg() -> configparser.ConfigParser:
    setup = configparser.ConfigParser()
    setup.read(REPOSITORY / "setup.cfg")
    return setup


def test_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) < 120


def test_the_first_screen_shows_how_to_start() -> None:
    first = "\n".join(README.read_text().splitlines()[:30])
    for part in ("![", "pip install", "parallel_env(", "docs/results/s0_test.svg"):
        assert part in first


def test_a_script_beside_the_clone_imports_the_library(tmp_path: Path) -> None:
    clone = re.search(r"^git clone <.+> ([\w-]+)", README.read_text(), re.MULTILINE)
    assert clone is not None
    (tmp_path / clone[1]).symlink_to(REPOSITORY)
    script = tmp_path / "script.py"
    script.write_text("import handover_marl; print(handover_marl.parallel_env)")
    subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, check=True)


def test_supported_pythons_are_tested() -> None:
    classifiers = setup_cfg()["metadata"]["classifiers"]
    supported = re.findall(r"Python :: (3\.\d+)$", classifiers, re.MULTILINE)
    job = yaml.safe_load((WORKFLOWS / "tests.yml").read_text())["jobs"]["tests"]
    assert {"run": "${{ matrix.command }}"} in job["steps"]
    tested = {entry["python"]: entry["command"] for entry in job["strategy"]["matrix"]["include"]}
    assert list(tested) == supported
    assert all(re.search(r"\.ci/run|make .*(test|newer)", command) for command in tested.values())
    assert "make test " in README.read_text()


def test_the_site_is_built_by_the_same_command() -> None:
    steps = yaml.safe_load((WORKFLOWS / "docs.yml").read_text())["jobs"]["build"]["steps"]
    assert {"run": "make docs"} in steps
    built = next(step["with"]["path"] for step in steps if "upload-pages-artifact" in step.get("uses", ""))
    assert f" docs {built}\n" in (REPOSITORY / "Makefile").read_text()
    assert "make docs" in (REPOSITORY / ".ci" / "run").read_text()


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["version"] == handover_marl.__version__
    page = (REPOSITORY / "docs" / "index.md").read_text()
    assert citation["title"] in page
    for reference in citation["references"]:
        assert reference["title"].partition(": ")[2] in page
