"""Writing files so that a reader never meets half of one, and reading those of strangers with care."""

import contextlib
import os
import stat
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from handover_marl.errors import ResultsError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it.

    Raises:
        ResultsError: The file cannot be written, e.g. because the disk is full; what was there before stays.
    """
    _write(path, content, Path.replace)


def create_exclusively(path: Path, content: bytes | str) -> None:
    """The same, but a file that is there already stays as it is, even if it appears at this very moment.

    Raises:
        ResultsError: The file cannot be written.
    """
    if not path.exists():
        _write(path, content, _link)


def check_archive(path: Path, largest: int) -> None:
    """Look whether a zip archive may be read without harm.

    Args:
        path: The archive.
        largest: Bytes that it may unpack to.

    Raises:
        ValueError: It is no plain file, no archive, or far larger than it should be.
        OSError: It cannot be opened.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("not a plain file")
    with zipfile.ZipFile(path) as archive:
        if sum(part.file_size for part in archive.infolist()) > largest:
            raise ValueError(f"it unpacks to more than {largest // 1_000_000} MB")


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
        return {name: archive[name] for name in names}


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
            with path.open("xb") as stream:
                stream.write(temporary.read_bytes())
    temporary.unlink()


def _write(path: Path, content: bytes | str, put: Callable[[Path, Path], object]) -> None:
    data = content.encode() if isinstance(content, str) else content
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with _removed_on_failure(Path(name)) as temporary:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
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


@contextlib.contextmanager
def _removed_on_failure(temporary: Path) -> Iterator[Path]:
    try:
        yield temporary
    except BaseException:  # Ctrl-C too must leave no litter
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
