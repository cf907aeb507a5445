"""Tests of links between pages and from pages to files, and of words that users search for."""

import re
from pathlib import Path

import pytest

from tests.docs.pages import PAGES, REPOSITORY, name

_LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
_FILE = re.compile(r"`((?:handover_marl|receivers|givers|assets|experiments|tests)/[\w/]+\.py)`")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files(page: Path) -> None:
    text = page.read_text()
    links = [link for link in _LINK.findall(text) if not link.startswith(("http", "mailto"))]
    missing = [link for link in links if not (page.parent / link).exists()]
    missing += [file for file in _FILE.findall(text) if not (REPOSITORY / file).exists()]
    assert missing == []


def test_users_words_are_found() -> None:
    texts = [page.read_text() for page in PAGES]
    for word in ("mesh", "own object", "GPU", "UR5", "reward", "resume", "verify"):
        assert any(word.lower() in text.lower() for text in texts), word
