"""Atomic writing of files, locks, and text of errors for messages."""

import contextlib
import fcntl
import io
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import ResultsError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name in the same folder, then rename it.

    Raises:
        ResultsError: The file cannot be written, e.g. because the disk is full. An existing file
            stays as it was.
    """
    _write(path, content, Path.replace)


def create_exclusively(path: Path, content: bytes | str) -> None:
    """Write a file atomically, unless it exists already; safe if several processes do it at once.

    Raises:
        ResultsError: The file cannot be written.
    """
    if not os.path.lexists(path):
        _write(path, content, _link)


def remove_stale_temporaries(folder: Path) -> None:
    """Remove temporary files of processes that were killed, but not of running processes.

    Args:
        folder: Folder of the temporary files; it need not exist.
    """
    for path in folder.glob(f".*.{'[a-z0-9_]' * 8}.part"):  # the pattern of tempfile.mkstemp
        # A writer holds a lock on its file until it ends.
        with contextlib.suppress(OSError), _open_read_only(path) as handle:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


@contextlib.contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on a folder during a `with` block.

    On a file system without locks this has no effect.

    Raises:
        ResultsError: Another process holds the lock.
        OSError: The folder cannot be opened.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ResultsError(
                f"another process is writing to {folder}; wait for it, or choose another folder"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def wait_for_lock(path: Path, on_wait: Callable[[], object]) -> Iterator[None]:
    """Hold a lock file during a `with` block; wait while another process or thread holds it.

    The file is removed at the end; the lock of a process that is killed ends with the process. In a folder that
    cannot be written and on a file system without locks this has no effect.

    Args:
        path: Lock file; its folder must exist.
        on_wait: Function that is called once before a wait.
    """
    handle = _lock_file(path, on_wait)
    try:
        yield
    finally:
        if handle is not None:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(handle)


def has_content(path: Path, content: bytes) -> bool:
    """Check whether a path is a regular file with exactly this content.

    Raises:
        OSError: The file cannot be read.
    """
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays as an `.npz` file, atomically.

    Raises:
        ResultsError: The file cannot be written.
    """
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    write_atomically(path, stream.getvalue())


def shorten_text(value: object) -> str:
    """Return a value or exception as one line of at most 200 characters, for messages."""
    try:
        text = f"{type(value).__name__}: {value}" if isinstance(value, BaseException) else str(value)
    except (ValueError, RecursionError):  # huge integers, containers that contain themselves
        text = type(value).__name__
    text = " ".join(text[:1000].split())
    return text if len(text) <= 200 else f"{text[:200]}..."


def _link(temporary: Path, path: Path) -> None:
    # Unlike renaming, linking fails when the name exists.
    with contextlib.suppress(FileExistsError):
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            path.open("xb").close()
            # The name belongs to this process now, so renaming is safe.
            with _delete_on_failure(path):
                temporary.replace(path)
            return
    temporary.unlink()


def _write(path: Path, content: bytes | str, put: Callable[[Path, Path], object]) -> None:
    data = content.encode() if isinstance(content, str) else content
    try:
        handle, temporary = _create_locked_temporary(path)
        with os.fdopen(handle, "wb") as stream, _delete_on_failure(temporary):
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            temporary.chmod(0o644)
            put(temporary, path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise ResultsError(
            f"cannot write {path} ({reason or error}); finished scenes are kept: free space or fix the "
            "folder, then run the same command again to resume"
        ) from error


def _create_locked_temporary(path: Path) -> tuple[int, Path]:
    """Create a file in the folder of `path` and return its handle and path.

    The file is locked, so that `remove_stale_temporaries` does not remove it.
    """
    while True:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with contextlib.suppress(OSError):  # without locks, nothing is removed either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:
            return handle, Path(name)
        os.close(handle)  # another process removed it before it was locked


def _lock_file(path: Path, on_wait: Callable[[], object]) -> int | None:
    """Create and lock a file, and return its handle; None if that is not possible."""
    is_first = True
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except OSError:
            return None
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if is_first:
                    on_wait()
                is_first = False
                fcntl.flock(handle, fcntl.LOCK_EX)
            if os.fstat(handle).st_nlink:
                return handle
        except OSError:  # a file system without locks
            os.close(handle)
            return None
        except BaseException:  # Ctrl-C while waiting
            os.close(handle)
            raise
        os.close(handle)  # another process removed it before it was locked


@contextlib.contextmanager
def _open_read_only(path: Path) -> Iterator[int]:
    # Without following links, and without waiting for the writer of a pipe.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        yield handle
    finally:
        os.close(handle)


@contextlib.contextmanager
def _delete_on_failure(temporary: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:  # also after Ctrl-C no temporary file may stay
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
