import os
from pathlib import Path

import pytest

from handover_marl.errors import ResultsError
from handover_marl.files import write_atomically


def test_writes_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_atomically(path, "first")
    write_atomically(path, b"second")
    assert path.read_bytes() == b"second"
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("failure", "seen"),
    [(KeyboardInterrupt, KeyboardInterrupt), (MemoryError, MemoryError), (OSError, ResultsError)],
)
def test_a_failed_write_leaves_what_was_there(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    failure: type[BaseException],
    seen: type[BaseException],
) -> None:
    path = tmp_path / "a.txt"
    path.write_text("before")

    def fail(handle: int) -> None:
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(seen):
        write_atomically(path, "after")
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "before"


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"cannot write .*a\.txt"):
        write_atomically(tmp_path / "none" / "a.txt", "text")
