"""README is short, its map shows the house as it stands, and what tells versions tells the same."""

import configparser
import re

import yaml

import handover_marl
from tests.docs.pages import REPOSITORY, blocks

README = REPOSITORY / "README.md"
WORKFLOWS = REPOSITORY / ".github" / "workflows"
#: What is put together into a line of the map, or only told on the page of the house.
ROOT_FILES = {"__init__.py", "_version.py", "py.typed", "__main__.py"}


def setup_cfg() -> configparser.ConfigParser:
    setup = configparser.ConfigParser()
    setup.read(REPOSITORY / "setup.cfg")
    return setup


def test_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) < 120


def test_the_map_shows_every_room() -> None:
    (drawn,) = blocks(README, "text")
    inside = re.findall(r"^  ([\w/]+)/ ", drawn.text, re.MULTILINE)
    outside = re.findall(r"^([\w/]+)/ ", drawn.text, re.MULTILINE)
    rooms = {path.parent.name for path in (REPOSITORY / "handover_marl").glob("*/__init__.py")}
    assert set(inside) == rooms
    assert len(inside) == len(rooms)
    top = {path.name for path in REPOSITORY.iterdir() if path.is_dir() and next(path.glob("*.py"), None)}
    assert set(outside) == top - {"docs"}


def test_the_house_names_what_is_at_the_root() -> None:
    told = set(re.findall(r"`(\w+\.py)`", (REPOSITORY / "docs" / "house.md").read_text().partition("\n\nRooms")[0]))
    files = {path.name for path in (REPOSITORY / "handover_marl").iterdir() if path.is_file()}
    assert told == files - ROOT_FILES


def test_supported_pythons_are_tested() -> None:
    classifiers = setup_cfg()["metadata"]["classifiers"]
    supported = re.findall(r"Python :: (3\.\d+)$", classifiers, re.MULTILINE)
    jobs = yaml.safe_load((WORKFLOWS / "tests.yml").read_text())["jobs"]
    tested = []
    for job, command in (("tests", "make test"), ("without-pybullet", "make newer")):
        tested += jobs[job]["strategy"]["matrix"]["python"]
        assert {"run": command} in jobs[job]["steps"]
    assert tested == supported
    assert "make test " in README.read_text()


def test_the_site_is_built_by_the_same_command() -> None:
    steps = yaml.safe_load((WORKFLOWS / "docs.yml").read_text())["jobs"]["build"]["steps"]
    assert {"run": "make docs"} in steps
    built = next(step["with"]["path"] for step in steps if "upload-pages-artifact" in step.get("uses", ""))
    assert f" docs {built}\n" in (REPOSITORY / "Makefile").read_text()
    assert "make docs" in (REPOSITORY / ".ci" / "run").read_text().splitlines()


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["version"] == handover_marl.__version__
    page = (REPOSITORY / "docs" / "citing.md").read_text()
    assert citation["title"] in page
    for reference in citation["references"]:
        assert reference["title"].partition(": ")[2] in page
