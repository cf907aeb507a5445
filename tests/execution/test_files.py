"""Tests of atomic writing of files, and of locks."""

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from handover_marl.errors import ResultsError
from handover_marl.execution.files import (
    create_exclusively,
    exclusive_lock,
    remove_stale_temporaries,
    wait_for_lock,
    write_atomically,
)


def test_write_atomically(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_atomically(path, "first")
    write_atomically(path, b"second")
    assert path.read_bytes() == b"second"
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("write", [write_atomically, create_exclusively])
@pytest.mark.parametrize(("failure", "seen"), [(KeyboardInterrupt, KeyboardInterrupt), (OSError, ResultsError)])
def test_failed_writes_leave_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Any, failure: type[BaseException], seen: type[BaseException]
) -> None:
    path = tmp_path / "a.txt"

    def fail(handle: int) -> None:
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(seen):
        write(path, "after")
    assert list(tmp_path.iterdir()) == []
    path.write_text("before")
    with pytest.raises(seen):
        write_atomically(path, "after")
    assert path.read_text() == "before"
    with pytest.raises(ResultsError, match=r"cannot write .*a\.txt"):
        write(tmp_path / "none" / "a.txt", "text")


def test_create_exclusively(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, sync = tmp_path / "a.txt", os.fsync

    def sync_late(handle: int) -> None:
        sync(handle)
        path.write_text("another's")

    for content in ("first", "second"):
        create_exclusively(path, content)
        assert path.read_text() == "first"
    path.unlink()
    monkeypatch.setattr(os, "fsync", sync_late)
    create_exclusively(path, "mine")
    assert path.read_text() == "another's"
    assert list(tmp_path.iterdir()) == [path]


def test_temporary_files_of_killed_writers_are_removed(tmp_path: Path) -> None:
    old, new, other = (tmp_path / name for name in (".a.txt.abc.part", ".b.txt.abc.part", "c.txt"))
    for path in (old, new, other):
        path.write_text("text")
    for path in (old, other):
        os.utime(path, (0, 0))
    remove_stale_temporaries(tmp_path)
    assert sorted(tmp_path.iterdir()) == [new, other]
    remove_stale_temporaries(tmp_path / "nowhere")


def test_lock_is_held_by_one_thread(tmp_path: Path) -> None:
    path, held, waits = tmp_path / "a.lock", [], []

    def work(number: int) -> None:
        with wait_for_lock(path, lambda: waits.append(number)):
            held.append(number)
            time.sleep(0.05)
            held.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert held[::2] == held[1::2]
    assert sorted(held[::2]) == [0, 1, 2, 3]
    assert len(set(waits)) == len(waits) > 0, "called once a wait"


def test_locks_of_folders(tmp_path: Path) -> None:
    for _ in range(2):
        with (
            exclusive_lock(tmp_path),
            pytest.raises(ResultsError, match="another process is writing to"),
            exclusive_lock(tmp_path),
        ):
            pass
