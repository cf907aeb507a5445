"""Atomic writing of files, locks, rendering of templates, and short text of values for messages."""

import contextlib
import fcntl
import io
import os
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import ResultsError

_STALE_S = 24 * 3600.0


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name in the same folder, then rename it; raise `ResultsError` if this fails."""
    with _write_temporary(path, content) as temporary:
        temporary.replace(path)


def create_exclusively(path: Path, content: bytes | str) -> None:
    """Write a file atomically, unless it exists already; if several processes do so at once, one of them writes it.

    Errors are those of `write_atomically`.
    """
    if os.path.lexists(path):
        return
    # Unlike renaming, making a hard link fails when the name exists.
    with _write_temporary(path, content) as temporary, contextlib.suppress(FileExistsError):
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            temporary.replace(path)


def remove_stale_temporaries(folder: Path) -> None:
    """Remove temporary files older than a day, left by killed processes, from a folder, which need not exist."""
    for path in folder.glob(".*.part"):
        with contextlib.suppress(OSError):
            if time.time() - path.lstat().st_mtime > _STALE_S:
                path.unlink()


@contextlib.contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on a folder during a `with` block; raise `ResultsError` if another process holds it.

    On a file system without locks this has no effect.
    """

    def refuse() -> None:
        raise ResultsError(f"another process is writing to {folder}; wait for it, or choose another folder")

    with _lock(os.open(folder, os.O_RDONLY), refuse):
        yield


@contextlib.contextmanager
def wait_for_lock(path: Path, on_wait: Callable[[], object]) -> Iterator[None]:
    """Hold a lock file during a `with` block; call `on_wait` once and wait while another process or thread holds it.

    The lock of a process that is killed ends with the process; the empty file stays. In a folder that cannot be written
    and on a file system without locks this has no effect.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    except OSError:
        yield
        return
    with _lock(handle, on_wait):
        yield


def has_content(path: Path, content: bytes) -> bool:
    """Check whether a path is a regular file with exactly this content."""
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays as an `.npz` file, atomically."""
    write_atomically(path, encode_arrays(arrays))


def encode_arrays(arrays: Mapping[str, Any]) -> bytes:
    """Return the bytes of an `.npz` file with arrays; equal arrays give equal bytes."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def render_template(package: str, template: str, **content: Any) -> str:
    """Render a Jinja template, in `templates/` of a package, with the variables `content`, escaped in `.html` files."""
    # Imported here: simulations write no such files.
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=PackageLoader(package),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**content)


def shorten_text(value: object) -> str:
    """Return a value or exception as one line for messages, cut after 200 characters."""
    try:
        text = f"{type(value).__name__}: {value}" if isinstance(value, BaseException) else str(value)
    except (ValueError, RecursionError):  # huge integers, containers that contain themselves
        text = type(value).__name__
    text = " ".join(text[:1000].split())
    return text if len(text) <= 200 else f"{text[:200]}..."


@contextlib.contextmanager
def _write_temporary(path: Path, content: bytes | str) -> Iterator[Path]:
    """Yield a temporary file with this content in the folder of `path`; remove it if the caller did not rename it."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with temporary.open("xb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        yield temporary
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise ResultsError(
            f"cannot write {path} ({reason or error}); finished scenes are kept: free space or fix the "
            "folder, then run the same command again to resume"
        ) from error
    finally:
        with contextlib.suppress(OSError, ValueError):
            temporary.unlink()


@contextlib.contextmanager
def _lock(handle: int, on_wait: Callable[[], object]) -> Iterator[None]:
    """Lock an open file descriptor during a `with` block, then close it; call `on_wait` before waiting for the lock."""
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_wait()
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(handle)
