"""Bounded reading of plain files from untrusted sources: bytes, zip archives, arrays and YAML.

Pipes, sockets, devices and folders are refused before they are opened, since opening or reading them
may never end; files and archives that are too large are refused before they are read.
"""

import contextlib
import functools
import io
import os
import stat
import zipfile
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import yaml

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, UnsafeFileError
from handover_marl.execution.files import shorten_text

_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Largest accepted size (bytes) of a file of data or weights, unless the file has another limit.
MAX_FILE_BYTES = 500_000_000
_MAX_ARCHIVE_OVERHEAD = 1_000_000  # bytes of an archive in addition to its contents


def read_mtime(path: Path | str) -> int:
    """Return the modification time of a file (ns); 0 if it cannot be read."""
    try:
        return os.stat(path).st_mtime_ns  # noqa: PTH116 (faster than Path.stat)
    except (OSError, ValueError):
        return 0


def cached_by_file(
    maxsize: int | None, read_version: Callable[[Any], Hashable] = read_mtime
) -> Callable[[_Function], _Function]:
    """Return a decorator that caches results of a function that reads a file, until the file changes.

    The file is the function's first argument. The cache keeps the last `maxsize` results, None for all; `read_version`
    returns the file's version, by default the modification time.
    """

    def decorate(function: _Function) -> _Function:
        @functools.lru_cache(maxsize)
        def call(version: Hashable, *args: Any, **keywords: Any) -> Any:
            return function(*args, **keywords)

        @functools.wraps(function)
        def call_cached(file: Any, *args: Any, **keywords: Any) -> Any:
            return call(read_version(file), file, *args, **keywords)

        return cast(_Function, call_cached)

    return decorate


def check_plain_file(path: Path, largest: int = MAX_FILE_BYTES) -> int:
    """Check that a path is a plain file, or a link to one, of at most `largest` bytes; return its size (bytes).

    Other paths raise `ValueError` or `OSError`. Call it before code that opens the path itself.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        raise ValueError("it is not a plain file")
    if state.st_size > largest:
        raise ValueError(f"it is larger than {largest / 1e6:g} MB")
    return state.st_size


def read_plain_file(path: Path, largest: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a plain file of at most `largest` bytes; errors are those of `check_plain_file`."""
    size = check_plain_file(path, largest)
    with path.open("rb") as stream:
        return stream.read(size)  # which may be less than the file has by now


def check_archive(source: Path | bytes, largest: int) -> None:
    """Raise ValueError if the stated sizes of a zip archive's unpacked files sum up to more than `largest` bytes."""
    if isinstance(source, Path):
        check_plain_file(source, largest + _MAX_ARCHIVE_OVERHEAD)
    with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
        if sum(part.file_size for part in archive.infolist()) > largest:
            raise ValueError(f"it unpacks to more than {largest / 1e6:g} MB")


def read_arrays(
    source: Path | bytes, names: tuple[str, ...] | None = None, largest: int = MAX_FILE_BYTES
) -> dict[str, npt.NDArray[Any]]:
    """Return arrays of an `.npz` file, by name, without unpickling objects.

    Args:
        source: The file, or its content.
        names: Names of the arrays to read, which the file must contain; None for all its arrays.
        largest: Largest allowed total size of the file's unpacked members (bytes).
    """
    check_archive(source, largest)
    with np.load(io.BytesIO(source) if isinstance(source, bytes) else source, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in (archive.files if names is None else names)}
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # NumPy returns unknown members as bytes
            raise TypeError(f"{name} is not an array")
    return arrays


def read_yaml(path: Path, largest: int) -> object:
    """Read numbers, text, lists and mappings from a YAML file of at most `largest` bytes; aliases raise ValueError."""
    data = read_plain_file(path, largest)
    try:
        return yaml.load(data, _LoaderWithoutAliases)
    except Exception as error:  # PyYAML passes on errors of its constructors
        raise ValueError(shorten_text(error)) from error


class _LoaderWithoutAliases(yaml.SafeLoader):
    """YAML loader without aliases, with which a few lines can expand to gigabytes of text."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return a node, see `yaml.SafeLoader`; raise an error for an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not allowed")
        return super().compose_node(parent, index)


@contextlib.contextmanager
def report_damage(path: Path, what: str, advice: str) -> Iterator[None]:
    """Turn exceptions in a `with` block that reads a file into errors of the library.

    A missing file gives `DataNotFoundError`, an unsafe pickle `UnsafeFileError`, anything else `DataFormatError`, whose
    message also names the kind of file, `what`. All messages have the path and `advice`. Other errors of the library
    are kept if their message begins with the path.
    """
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(f"{path} does not exist; {advice}") from error
    except UnsafeFileError as error:
        fault = f"refused to load, the pickle {error} and may run foreign code"
        raise UnsafeFileError(f"{path}: {fault}; {advice}") from None
    except Exception as error:
        if isinstance(error, HandoverError) and str(error).startswith(str(path)):
            raise
        reason = str(error) if isinstance(error, HandoverError) else shorten_text(error)
        raise DataFormatError(f"{path}: not a readable {what} ({reason}); {advice}") from error
