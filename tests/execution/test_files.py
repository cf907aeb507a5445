import fcntl
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from handover_marl.errors import ResultsError
from handover_marl.execution.files import (
    create_exclusively,
    remove_stale_temporaries,
    wait_for_lock,
    write_atomically,
)
from tests.evaluation.deadline import ends_within

WRITERS = [write_atomically, create_exclusively]
Write = Callable[[Path, bytes | str], None]


def test_write_atomically(tmp_path: Path) -> None:
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
def test_failed_write_keeps_the_existing_file(
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
def test_failed_creation_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: type[BaseException]
) -> None:
    def fail(handle: int) -> None:
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises((KeyboardInterrupt, ResultsError)):
        create_exclusively(tmp_path / "a.txt", "text")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", WRITERS)
def test_missing_folder(tmp_path: Path, write: Write) -> None:
    with pytest.raises(ResultsError, match=r"cannot write .*a\.txt"):
        write(tmp_path / "none" / "a.txt", "text")
    assert not list(tmp_path.iterdir())


@pytest.fixture(params=[True, False], ids=["links", "no links"])
def links(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Return whether the file system supports hard links; without them, making a link fails."""

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    if not request.param:
        monkeypatch.setattr(Path, "hardlink_to", refuse)
    return bool(request.param)


@pytest.mark.usefixtures("links")
def test_create_exclusively_keeps_existing_files(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    create_exclusively(path, "first")
    assert path.read_text() == "first"
    assert path.stat().st_mode & 0o777 == 0o644
    create_exclusively(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("links")
def test_create_exclusively_is_atomic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, sync = tmp_path / "a.txt", os.fsync

    def sync_late(handle: int) -> None:
        sync(handle)
        path.write_text("another's")

    monkeypatch.setattr(os, "fsync", sync_late)
    create_exclusively(path, "mine")
    assert path.read_text() == "another's"
    assert list(tmp_path.iterdir()) == [path]
    # In contrast, `write_atomically` replaces the file.
    write_atomically(path, "mine")
    assert path.read_text() == "mine"


_KILLED = """
import os, pathlib, signal, sys
from handover_marl.execution import files
os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
files.create_exclusively(pathlib.Path(sys.argv[1]), "text")
"""


def test_temporary_files_of_killed_writers_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    subprocess.run([sys.executable, "-c", _KILLED, str(path)], check=False)
    assert [name.suffix for name in tmp_path.iterdir()] == [".part"]
    others = [tmp_path / name for name in ("a.part", ".a.part", ".a.txt.part", "b.txt", ".a.txt.long-name.part")]
    for other in others:
        other.write_text("mine")
    (tmp_path / ".a.txt.abcdefgh.part").mkdir()
    os.mkfifo(tmp_path / ".b.txt.abcdefgh.part")
    (tmp_path / ".c.txt.abcdefgh.part").symlink_to(tmp_path / "b.txt")
    with ends_within(5.0):
        remove_stale_temporaries(tmp_path)
    assert sorted(name for name in tmp_path.iterdir() if name.is_file() and not name.is_symlink()) == sorted(others)
    assert (tmp_path / "b.txt").read_text() == "mine"
    remove_stale_temporaries(tmp_path / "nowhere")


@pytest.mark.parametrize("write", WRITERS)
def test_temporary_files_in_use_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Write) -> None:
    sync, seen = os.fsync, []

    def sync_late(handle: int) -> None:
        sync(handle)
        remove_stale_temporaries(tmp_path)
        seen.extend(tmp_path.iterdir())

    monkeypatch.setattr(os, "fsync", sync_late)
    write(tmp_path / "a.txt", "text")
    assert len(seen) == 1
    assert [path.read_text() for path in tmp_path.iterdir()] == ["text"]


def test_temporary_file_removed_before_it_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make, made = tempfile.mkstemp, []

    def make_and_lose(**where: object) -> tuple[int, str]:
        handle, name = make(**where)  # type: ignore[call-overload]
        made.append(name)
        if len(made) == 1:
            remove_stale_temporaries(tmp_path)
            assert not Path(name).exists()
        return handle, name

    monkeypatch.setattr(tempfile, "mkstemp", make_and_lose)
    create_exclusively(tmp_path / "a.txt", "text")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["text"]
    assert len(made) == 2


def test_failed_creation_on_a_file_system_without_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(ResultsError):
        create_exclusively(tmp_path / "a.txt", "text")
    assert not list(tmp_path.iterdir())


def test_lock_is_held_by_one_thread(tmp_path: Path) -> None:
    path, held, waits = tmp_path / "a.lock", [], []

    def work(number: int) -> None:
        with wait_for_lock(path, lambda: waits.append(number)):
            held.append(("start", number))
            time.sleep(0.05)
            held.append(("end", number))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    numbers = [number for _, number in held]
    assert numbers[::2] == numbers[1::2]
    assert sorted(numbers[::2]) == [0, 1, 2, 3]
    assert sorted(set(waits)) == sorted(waits), "called once a wait"
    assert not list(tmp_path.iterdir())


def test_lock_that_cannot_be_made_has_no_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with wait_for_lock(tmp_path / "nowhere" / "a.lock", pytest.fail):
        pass

    def refuse(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with wait_for_lock(tmp_path / "a.lock", pytest.fail), wait_for_lock(tmp_path / "a.lock", pytest.fail):
        pass


def test_lock_of_a_failed_block_is_released(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), wait_for_lock(tmp_path / "a.lock", pytest.fail):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
