"""Tests of names and prose: plain words and docstrings that describe. Ruff checks that functions begin with a verb."""

import ast
import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = ("handover_marl", "givers", "receivers", "assets", "experiments", "tests")
#: Words that may not begin a docstring: they begin a clause, not a description.
CLAUSES = {"what", "who", "where", "how", "when", "if", "with", "whose", "whom", "which", "why"}
#: Metaphors and private terms, for which the field has words.
METAPHORS = re.compile(
    r"crews?|companion|dismissed|dormancy|felt|fleet|ghosts?|hired|lanes?|parcels?|percepts?|rooms?|rulers?|scribes?|"
    r"shelf|shelves|sleeper|sought|studio|teller|told|tells|watchers?|workshop|worsened"
)
PHRASES = re.compile(r"gets? on with|parts? ways|and its kin|hung on|hangs on", re.IGNORECASE)
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Za-z][a-z]*")


def list_files(top: str) -> list[Path]:
    return [path for path in sorted((REPOSITORY / top).rglob("*.py")) if path != Path(__file__).resolve()]


def find_wrong_words(text: str) -> set[str]:
    """Return the forbidden words and phrases of a text; identifiers are taken apart."""
    words = {word.lower() for word in _WORD.findall(text)}
    return {word for word in words if METAPHORS.fullmatch(word)} | {found.lower() for found in PHRASES.findall(text)}


def test_docstrings_start_with_a_description() -> None:
    kinds, wrong = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef), []
    for path in (path for top in SOURCES[:-1] for path in list_files(top)):
        for node in ast.walk(ast.parse(path.read_text())):
            text = ast.get_docstring(node) if isinstance(node, kinds) else None
            if text and re.split(r"\W+", text.lower(), maxsplit=1)[0] in CLAUSES:
                wrong.append(f"{path.relative_to(REPOSITORY)}: {text.splitlines()[0]}")
    assert wrong == []


def test_code_and_pages_have_no_metaphors() -> None:
    files = [path for top in SOURCES for path in list_files(top)]
    pages = [*(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("*.md")]
    # The changelog has names of earlier versions, as code.
    texts = {
        path: path.read_text() if path in files else re.sub("`[^`]*`", "", path.read_text()) for path in files + pages
    }
    wrong = {str(path): found for path, text in texts.items() if (found := find_wrong_words(text))}
    assert wrong == {}


def test_wrong_words_are_found() -> None:
    assert find_wrong_words("RulerLanes.told_once gets on with HTTPStudio") == {
        *("ruler", "lanes", "told", "studio", "gets on with")
    }
