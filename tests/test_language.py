"""Tests of names and prose: plain words, imperative docstrings, no metaphors."""

import ast
import re
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = ("handover_marl", "givers", "receivers", "assets", "experiments")
#: Words that may not begin a docstring: they begin a clause, not a description.
CLAUSES = {"what", "who", "where", "how", "when", "if", "with", "whose", "whom", "which", "why"}
#: Metaphors and private terms of versions before 0.8; each stands for a term of the field.
METAPHORS = {
    "crew": "worker pool",
    "crews": "worker pools",
    "companion": "batch key",
    "dismissed": "terminated",
    "dormancy": "sleep state",
    "felt": "sensor readings",
    "fleet": "environment batch",
    "ghost": "visual body",
    "ghosts": "visual bodies",
    "handiness": "grasp ranking",
    "hired": "spawned",
    "lane": "batch slot",
    "lanes": "batch slots",
    "parcel": "policy bundle",
    "parcels": "policy bundles",
    "percept": "tracker",
    "percepts": "trackers",
    "room": "clearance, or package",
    "rooms": "clearances, or packages",
    "ruler": "distance query",
    "rulers": "distance queries",
    "scribe": "writer",
    "scribes": "writers",
    "shelf": "store",
    "shelves": "stores",
    "sleeper": "sleeping body",
    "sought": "render targets",
    "studio": "rollouts",
    "teller": "predictor",
    "told": "given, reported, predicted",
    "tells": "returns, reports, predicts",
    "watcher": "callback",
    "watchers": "callbacks",
    "workshop": "data generator",
    "worsened": "noise applied",
}
PHRASES = (
    "gets on with",
    "get on with",
    "part ways",
    "parts ways",
    "looked at once",
    "and its kin",
    "hung on",
    "hangs on",
    "ways of their own",
    "grasp book",
)
#: Phrases that pages avoid: clipped captions and words of earlier versions.
PAGE_PHRASES = ("looked at", "stand in for")
#: Base forms of verbs that a function's docstring may begin with.
VERBS = frozenset(Path(__file__).with_name("verbs.txt").read_text().split())
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Za-z][a-z]*")


def python_files(*tops: str) -> list[Path]:
    """Return the tracked Python files below some folders of the repository."""
    listed = subprocess.run(["git", "ls-files", *tops], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    paths = [REPOSITORY / line for line in listed.stdout.splitlines() if line.endswith(".py")]
    return [path for path in paths if path.exists()] or [
        path for top in tops for path in sorted((REPOSITORY / top).rglob("*.py"))
    ]


def docstrings(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield line, name and text of every docstring of a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), getattr(node, "name", path.stem), text


@pytest.mark.parametrize("top", SOURCES)
def test_docstrings_start_with_a_description(top: str) -> None:
    wrong = [
        f"{path.relative_to(REPOSITORY)}:{line} {name}: {text.splitlines()[0]}"
        for path in python_files(top)
        for line, name, text in docstrings(path)
        if re.split(r"\W+", text.lower(), maxsplit=1)[0] in CLAUSES
    ]
    assert not wrong, "\n".join(wrong)


def is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Return whether a function is a property."""
    return any("property" in ast.unparse(decorator) for decorator in node.decorator_list)


@pytest.mark.parametrize("top", SOURCES)
def test_functions_are_described_by_a_verb(top: str) -> None:
    wrong = []
    for path in python_files(top):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not is_property(node):
                first = re.split(r"\W+", (ast.get_docstring(node) or "return").lower(), maxsplit=1)[0]
                if first not in VERBS:
                    wrong.append(f"{path.relative_to(REPOSITORY)}:{node.lineno} {node.name}: {first}")
    assert not wrong, "\n".join(wrong)


def words_of(text: str) -> Iterator[str]:
    """Yield the lower-case words of text; identifiers are taken apart."""
    yield from (word.lower() for word in _WORD.findall(text))


def found_metaphors(path: Path, phrases: Sequence[str] = PHRASES) -> list[str]:
    """Return every forbidden word or phrase of a file with its line."""
    found, text = [], path.read_text()
    if path.name == "CHANGELOG.md":
        text = re.sub(r"`[^`]*`", "", text)  # names of earlier versions
    for number, line in enumerate(text.splitlines(), start=1):
        bad = sorted(METAPHORS.keys() & set(words_of(line)))
        bad += [phrase for phrase in phrases if phrase in line.lower()]
        found += [f"{path.relative_to(REPOSITORY)}:{number} {word}: {line.strip()}" for word in bad]
    return found


@pytest.mark.parametrize("top", [*SOURCES, "tests"])
def test_code_has_no_metaphors(top: str) -> None:
    files = [path for path in python_files(top) if path != Path(__file__).resolve()]
    wrong = [line for path in files for line in found_metaphors(path)]
    assert not wrong, "\n".join(wrong)


def test_pages_have_no_metaphors() -> None:
    pages = [*(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("*.md")]
    wrong = [line for page in pages for line in found_metaphors(page, PHRASES + PAGE_PHRASES)]
    assert not wrong, "\n".join(wrong)


def test_wrong_words_are_found() -> None:
    file = REPOSITORY / "tests" / "test_language.py"
    assert any("crew" in line for line in found_metaphors(file))
    assert list(words_of("RulerLanes.told_once")) == ["ruler", "lanes", "told", "once"]
    assert list(words_of("MAX_LANES HTTPStudio")) == ["max", "lanes", "http", "studio"]
