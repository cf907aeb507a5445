"""Writing files so that a reader never meets half of one, and reading those of strangers with care."""

import contextlib
import fcntl
import io
import os
import stat
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import yaml

from handover_marl.errors import ResultsError

_MOST_PACKING = 1_000_000  # bytes that an archive may have beyond its contents


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it.

    Raises:
        ResultsError: The file cannot be written, e.g. because the disk is full; what was there before stays.
    """
    _write(path, content, Path.replace)


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary file to fill by its name, which takes the place of `path` when the block ends well.

    For what does not fit into memory.

    Raises:
        ResultsError: The file cannot be written; what was there before stays.
    """
    with _placed(path, Path.replace) as (_, temporary):
        yield temporary


def create_exclusively(path: Path, content: bytes | str) -> None:
    """The same, but a file that is there already stays as it is, even if it appears at this very moment.

    Raises:
        ResultsError: The file cannot be written.
    """
    if not os.path.lexists(path):
        _write(path, content, _link)


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files whose writer was killed; those that are being written stay, as does all else.

    Args:
        folder: Where files were written; it need not exist.
    """
    for path in folder.glob(f".*.{'[a-z0-9_]' * 8}.part"):  # as Python names temporary files
        # A writer holds a lock on its file for as long as it lives.
        with contextlib.suppress(OSError), _opened(path) as handle:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for it out of a folder; on a file system without locks nobody is kept out.

    Raises:
        ResultsError: Another one is in.
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


def holds(path: Path, content: bytes) -> bool:
    """Whether there is a plain file of just this content.

    Raises:
        OSError: It cannot be read.
    """
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


def check_archive(path: Path, largest: int) -> None:
    """Look whether a zip archive may be read without harm.

    Args:
        path: The archive.
        largest: Bytes that it may unpack to.

    Raises:
        ValueError: It is no plain file, no archive, far larger than it should be, or packed in a way that NumPy
            never does.
        OSError: It cannot be opened.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        raise ValueError("not a plain file")
    # Before it is opened, since even a list of contents may be endless.
    if state.st_size > largest + _MOST_PACKING:
        raise ValueError(f"it has more than {largest // 1_000_000} MB")
    with zipfile.ZipFile(path) as archive:
        parts = archive.infolist()
    if sum(part.file_size for part in parts) > largest:
        raise ValueError(f"it unpacks to more than {largest // 1_000_000} MB")
    if len({part.filename for part in parts}) < len(parts):
        raise ValueError("it holds two files of one name")
    # Python unpacks the other methods without minding the size that the archive states.
    if any(part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for part in parts):
        raise ValueError("it is packed by another method than deflate")


def read_arrays(path: Path, names: tuple[str, ...], largest: int) -> dict[str, npt.NDArray[Any]]:
    """Arrays of an `.npz` file, without unpickling anything.

    Args:
        path: The file.
        names: Arrays that it must have.
        largest: Bytes that it may unpack to.

    Raises:
        Exception: What NumPy and zipfile raise on damaged bytes has no end.
    """
    check_archive(path, largest)
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in names}
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # NumPy gives the bytes of what it does not know
            raise TypeError(f"{name} is no array")
    return arrays


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays as an `.npz` file, whole or not at all.

    Raises:
        ResultsError: It cannot be written.
    """
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    write_atomically(path, stream.getvalue())


def read_yaml(path: Path, largest: int) -> object:
    """Content of a plain YAML file: numbers, text, lists and mappings, without aliases.

    Args:
        path: The file.
        largest: Bytes that it may have.

    Raises:
        ValueError: It is no plain file, too large, or not such YAML.
        OSError: It cannot be opened.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode) or state.st_size > largest:
        raise ValueError(f"no file of less than {largest // 1000} kB")
    data = path.read_bytes()
    try:
        return yaml.load(data.decode(), _PlainLoader)
    except Exception as error:  # YAML lets errors of its constructors through
        raise ValueError(brief(error)) from error


def brief(value: object) -> str:
    """Something strange in a few words on one line, for messages."""
    try:
        text = f"{type(value).__name__}: {value}" if isinstance(value, BaseException) else str(value)
    except (ValueError, RecursionError):  # numbers of thousands of digits, what contains itself
        text = type(value).__name__
    text = " ".join(text[:1000].split())
    return text if len(text) <= 200 else f"{text[:200]}..."


class _PlainLoader(yaml.SafeLoader):
    """Plain YAML without aliases, which can make a few lines mean gigabytes, or themselves."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not admitted")
        return super().compose_node(parent, index)


def _link(temporary: Path, path: Path) -> None:
    # Unlike renaming, linking fails when the name is taken.
    with contextlib.suppress(FileExistsError):
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            path.open("xb").close()
            # The name is ours now; what comes there comes whole.
            with _removed_on_failure(path):
                temporary.replace(path)
            return
    temporary.unlink()


def _write(path: Path, content: bytes | str, put: Callable[[Path, Path], object]) -> None:
    data = content.encode() if isinstance(content, str) else content
    with _placed(path, put) as (stream, _):
        stream.write(data)


@contextlib.contextmanager
def _placed(path: Path, put: Callable[[Path, Path], object]) -> Iterator[tuple[BinaryIO, Path]]:
    """A temporary file, open and by name, that is put into its place when it has been filled."""
    try:
        handle, temporary = _temporary(path)
        with os.fdopen(handle, "wb") as stream, _removed_on_failure(temporary):
            yield stream, temporary
            stream.flush()
            os.fsync(stream.fileno())
            temporary.chmod(0o644)
            put(temporary, path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise ResultsError(
            f"cannot write {path} ({reason or error}); finished scenes are kept, free space or fix the "
            "folder and run the same command again to go on"
        ) from error


def _temporary(path: Path) -> tuple[int, Path]:
    """A new file beside `path`, open and locked, so that `remove_abandoned` lets it be."""
    while True:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with contextlib.suppress(OSError):  # a file system without locks, on which nothing is removed either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:
            return handle, Path(name)
        os.close(handle)  # somebody removed it before it was locked


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    # Neither through links, nor waiting for whoever writes into a pipe.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        yield handle
    finally:
        os.close(handle)


@contextlib.contextmanager
def _removed_on_failure(temporary: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:  # Ctrl-C too must leave no litter
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
