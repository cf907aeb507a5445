"""Reading the files of a folder or an archive of strangers, without being led out of it or drowned by it."""

import bz2
import gzip
import io
import lzma
import os
import stat
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError

#: Bytes of one file, of all files together with what separates them, and how many there may be. HandoverSim's archive
#: has 155 MB packed.
LARGEST_FILE, LARGEST_ARCHIVE, MOST_FILES = 300_000_000, 2_000_000_000, 20_000
_UNPACKERS: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}


@dataclass(frozen=True)
class Member:
    """One plain file.

    Attributes:
        path: Where it lies within the folder or archive.
        read: Its content; for an archive, only until the next one is asked for.
    """

    path: PurePosixPath
    read: Callable[[], bytes]


def read_members(source: Path) -> Iterator[Member]:
    """The plain files of a folder, or of a .tar, .tar.gz, .tar.bz2, .tar.xz or .zip archive.

    Links in a folder are passed over; an archive that has any is refused, since what they lead to is not known.

    Raises:
        DataNotFoundError: The source is not there or cannot be read.
        UnsafeFileError: The archive has links or devices, leads out of itself, or is far too large.
        DataFormatError: It is damaged, or no archive.
    """
    if source.is_dir():
        yield from _in_folder(source)
        return
    try:
        if not stat.S_ISREG(source.stat().st_mode):
            raise DataNotFoundError(f"{source} is neither a folder nor an archive")
        with source.open("rb") as file:
            beginning = file.read(512)
    except OSError as error:
        if isinstance(error, DataNotFoundError):
            raise
        raise DataNotFoundError(f"cannot read {source} ({error.strerror or error})") from error
    with _told(source):
        yield from _in_zip(source) if beginning.startswith(b"PK\x03\x04") else _in_tar(source, beginning)


@contextmanager
def _told(source: Path) -> Iterator[None]:
    try:
        yield
    except (UnsafeFileError, DataNotFoundError):
        raise
    except Exception as error:  # what tarfile and zipfile raise on damaged bytes has no end
        raise DataFormatError(
            f"{source}: no readable archive ({type(error).__name__}: {str(error)[:200]}); download it again"
        ) from error


def _in_folder(folder: Path) -> Iterator[Member]:
    count = 0
    for place, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            path = Path(place) / name
            state = path.lstat()
            if not stat.S_ISREG(state.st_mode):
                continue
            count += 1
            inside = PurePosixPath(path.relative_to(folder).as_posix())
            _check(folder, inside, state.st_size, count)
            yield Member(inside, lambda path=path: _content(path))  # type: ignore[misc]


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataNotFoundError(f"cannot read {path} ({error.strerror or error}); check its rights") from error


def _in_zip(source: Path) -> Iterator[Member]:
    with zipfile.ZipFile(source) as archive:
        parts = [part for part in archive.infolist() if not part.is_dir()]
        if sum(part.file_size for part in parts) > LARGEST_ARCHIVE:
            raise _too_large(source)
        for count, part in enumerate(parts, start=1):
            if stat.S_IFMT(part.external_attr >> 16) not in (0, stat.S_IFREG):
                raise UnsafeFileError(_refused(source, f"{part.filename!r} is a link or a device"))
            path = _inside(source, part.filename)
            _check(source, path, part.file_size, count)
            yield Member(path, lambda part=part: _unpacked(source, archive, part))  # type: ignore[misc]


def _unpacked(source: Path, archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> bytes:
    with _told(source), archive.open(part) as file:
        content = file.read(part.file_size + 1)
    if len(content) != part.file_size:
        raise UnsafeFileError(_refused(source, f"{part.filename!r} is not as large as it says"))
    return content


def _in_tar(source: Path, beginning: bytes) -> Iterator[Member]:
    unpacker = next((unpacker for start, unpacker in _UNPACKERS.items() if beginning.startswith(start)), None)
    with unpacker(source) if unpacker else source.open("rb") as file:
        bounded = _Bounded(file, source)
        with tarfile.open(fileobj=bounded, mode="r:") as archive:
            count = 0
            for entry in archive:
                if entry.isdir():
                    _inside(source, entry.name)
                    continue
                if not entry.isreg() or entry.issparse():
                    raise UnsafeFileError(_refused(source, f"{entry.name[:200]!r} is a link or a device"))
                count += 1
                path = _inside(source, entry.name)
                _check(source, path, entry.size, count)
                yield Member(path, lambda entry=entry: _extracted(source, archive, entry))  # type: ignore[misc]


def _extracted(source: Path, archive: tarfile.TarFile, entry: tarfile.TarInfo) -> bytes:
    with _told(source):
        file = archive.extractfile(entry)
        content = b"" if file is None else file.read()
        if len(content) != entry.size:
            raise EOFError(f"{entry.name!r} is cut off")
    return content


class _Bounded(io.RawIOBase):
    """A file that does not go on for ever, whatever it was compressed from.

    Args:
        file: What is read.
        source: Named in messages.
    """

    def __init__(self, file: IO[bytes], source: Path) -> None:
        self._file, self._source = file, source

    def read(self, size: int = -1, /) -> bytes:
        """So many bytes; never all there are."""
        if not 0 <= size <= LARGEST_FILE or self._file.tell() + size > LARGEST_ARCHIVE:
            raise _too_large(self._source)
        return self._file.read(size)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go to an absolute place."""
        if whence != os.SEEK_SET or offset > LARGEST_ARCHIVE:
            raise _too_large(self._source)
        return self._file.seek(offset)

    def tell(self) -> int:
        """Where it stands."""
        return self._file.tell()

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True


def _inside(source: Path, name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise UnsafeFileError(_refused(source, f"{name[:200]!r} leads out of it"))
    return path


def _check(source: Path, path: PurePosixPath, size: int, count: int) -> None:
    if size > LARGEST_FILE:
        raise UnsafeFileError(_refused(source, f"'{path}' has {size // 1_000_000} MB"))
    if count > MOST_FILES:
        raise UnsafeFileError(_refused(source, f"it has more than {MOST_FILES} files"))


def _too_large(source: Path) -> UnsafeFileError:
    return UnsafeFileError(_refused(source, f"it unpacks to more than {LARGEST_ARCHIVE // 1_000_000} MB"))


def _refused(source: Path, why: str) -> str:
    return (
        f"{source}: refused to unpack, {why}. HandoverSim's archive has nothing like it; download it again, or unpack "
        "what you trust yourself and give the folder"
    )
