"""Unreadable files for tests: opening or reading one would never end, or would fill the memory."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest


def _make_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(30_000_000_000)  # takes no space on the disk


#: Functions that make an unreadable file at a path that does not exist, by the kind of the file.
UNREADABLE: dict[str, Callable[[Path], object]] = {
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "large": _make_large,
}


def check_refusal(read: Callable[[Path], object], path: Path, kind: str, error: type[Exception]) -> None:
    """Check that a reader refuses an unreadable file, made at a path, within 5 s and with an error that states why."""
    UNREADABLE[kind](path)
    with refuses_within(5.0, error, kind):
        read(path)


@contextlib.contextmanager
def refuses_within(seconds: float, error: type[Exception] | tuple[type[Exception], ...], kind: str) -> Iterator[None]:
    """Check that a block ends within some seconds, with an error that states why the file is unreadable."""
    match = "larger than" if kind == "large" else "not a plain file"
    with ends_within(seconds), pytest.raises(error, match=match):
        yield


class TooSlowError(BaseException):
    """Error of an exceeded time limit; it is no `Exception`, so that the code under test does not catch it."""


@contextlib.contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Fail if the body does not end within some seconds, e.g. because it waits for the writer of a pipe."""

    def stop(*_: object) -> None:
        raise TooSlowError(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
