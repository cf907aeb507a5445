import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from handover_marl.errors import ResultsError
from handover_marl.files import check_archive, create_exclusively, write_atomically
from tests.benchmarking.deadline import ends_within

WRITERS = [write_atomically, create_exclusively]
Write = Callable[[Path, bytes | str], None]


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


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_a_failed_creation_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: type[BaseException]
) -> None:
    def fail(handle: int) -> None:
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises((KeyboardInterrupt, ResultsError)):
        create_exclusively(tmp_path / "a.txt", "text")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", WRITERS)
def test_a_folder_that_is_not_there(tmp_path: Path, write: Write) -> None:
    with pytest.raises(ResultsError, match=r"cannot write .*a\.txt"):
        write(tmp_path / "none" / "a.txt", "text")
    assert not list(tmp_path.iterdir())


@pytest.fixture(params=[True, False], ids=["links", "no links"])
def links(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """With and without hard links on the file system."""

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    if not request.param:
        monkeypatch.setattr(Path, "hardlink_to", refuse)
    return bool(request.param)


@pytest.mark.usefixtures("links")
def test_creates_and_leaves_what_is_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    create_exclusively(path, "first")
    assert path.read_text() == "first"
    assert path.stat().st_mode & 0o777 == 0o644
    create_exclusively(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("links")
def test_leaves_what_appears_at_the_very_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, sync = tmp_path / "a.txt", os.fsync

    def sync_late(handle: int) -> None:
        sync(handle)
        path.write_text("another's")

    monkeypatch.setattr(os, "fsync", sync_late)
    create_exclusively(path, "mine")
    assert path.read_text() == "another's"
    assert list(tmp_path.iterdir()) == [path]
    # Whereas this one replaces.
    write_atomically(path, "mine")
    assert path.read_text() == "mine"


def test_archives_that_may_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one", b"0" * 600)
        archive.writestr("two", b"0" * 401)
    check_archive(path, 1001)
    with pytest.raises(ValueError, match="unpacks to more than"):
        check_archive(path, 1000)
    path.write_bytes(b"PK")
    with pytest.raises(zipfile.BadZipFile):
        check_archive(path, 1000)
    os.mkfifo(tmp_path / "pipe.npz")
    for other in (tmp_path / "pipe.npz", tmp_path):
        with ends_within(5.0), pytest.raises(ValueError, match="not a plain file"):
            check_archive(other, 1000)
