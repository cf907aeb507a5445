"""Bounded reading of files in folders and archives from untrusted sources."""

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

#: Largest size of one file and of the whole unpacked archive (bytes), and largest number of files.
#: HandoverSim's compressed archive has 155 MB.
MAX_FILE_BYTES, MAX_ARCHIVE_BYTES, MAX_FILES = 300_000_000, 2_000_000_000, 20_000
_UNPACKERS: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}


@dataclass(frozen=True)
class ArchiveMember:
    """Regular file in a folder or archive.

    Attributes:
        path: Path relative to the folder or archive.
        read: Function that returns the content; for an archive, it must be called before the next
            member is requested.
    """

    path: PurePosixPath
    read: Callable[[], bytes]


def read_members(source: Path) -> Iterator[ArchiveMember]:
    """Yield the regular files of a folder, or of a .tar, .tar.gz, .tar.bz2, .tar.xz or .zip archive.

    Links in a folder are skipped; an archive with links is refused, since their targets are unknown.

    Raises:
        DataNotFoundError: The source does not exist or cannot be read.
        UnsafeFileError: The archive contains links, devices or paths outside itself, or is too large.
        DataFormatError: The archive is damaged, or the file is not an archive.
    """
    try:
        is_folder = source.is_dir()
        if not is_folder and not stat.S_ISREG(source.stat().st_mode):
            raise DataNotFoundError(f"{source} is neither a folder nor an archive")
        beginning = b""
        if not is_folder:
            with source.open("rb") as file:
                beginning = file.read(512)
    except OSError as error:
        if isinstance(error, DataNotFoundError):
            raise
        raise DataNotFoundError(f"cannot read {source} ({error.strerror or error})") from error
    if is_folder:
        yield from _iterate_folder(source)
        return
    with _translate_errors(source):
        yield from _iterate_zip(source) if beginning.startswith(b"PK\x03\x04") else _iterate_tar(source, beginning)


@contextmanager
def _translate_errors(source: Path) -> Iterator[None]:
    try:
        yield
    except (UnsafeFileError, DataNotFoundError):
        raise
    except Exception as error:  # tarfile and zipfile raise exceptions of many kinds on damaged bytes
        raise DataFormatError(
            f"{source}: not a readable archive ({type(error).__name__}: {str(error)[:200]}); download it again"
        ) from error


def _iterate_folder(folder: Path) -> Iterator[ArchiveMember]:
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
            _check_limits(folder, inside, state.st_size, count)
            yield ArchiveMember(inside, lambda path=path: _read_content(path))  # type: ignore[misc]


def _read_content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataNotFoundError(f"cannot read {path} ({error.strerror or error}); check its permissions") from error


def _iterate_zip(source: Path) -> Iterator[ArchiveMember]:
    with zipfile.ZipFile(source) as archive:
        parts = [part for part in archive.infolist() if not part.is_dir()]
        if sum(part.file_size for part in parts) > MAX_ARCHIVE_BYTES:
            raise _size_error(source)
        for count, part in enumerate(parts, start=1):
            if stat.S_IFMT(part.external_attr >> 16) not in (0, stat.S_IFREG):
                raise UnsafeFileError(_refusal_message(source, f"{part.filename!r} is a link or a device"))
            path = _check_member_path(source, part.filename)
            _check_limits(source, path, part.file_size, count)
            yield ArchiveMember(path, lambda part=part: _read_zip_member(source, archive, part))  # type: ignore[misc]


def _read_zip_member(source: Path, archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> bytes:
    with _translate_errors(source), archive.open(part) as file:
        content = file.read(part.file_size + 1)
    if len(content) != part.file_size:
        raise UnsafeFileError(_refusal_message(source, f"the size of {part.filename!r} is not the stated one"))
    return content


def _iterate_tar(source: Path, beginning: bytes) -> Iterator[ArchiveMember]:
    unpacker = next((unpacker for start, unpacker in _UNPACKERS.items() if beginning.startswith(start)), None)
    with unpacker(source) if unpacker else source.open("rb") as file:
        bounded = _BoundedReader(file, source)
        with tarfile.open(fileobj=bounded, mode="r:") as archive:
            count = 0
            for entry in archive:
                if entry.isdir():
                    _check_member_path(source, entry.name)
                    continue
                if not entry.isreg() or entry.issparse():
                    raise UnsafeFileError(_refusal_message(source, f"{entry.name[:200]!r} is a link or a device"))
                count += 1
                path = _check_member_path(source, entry.name)
                _check_limits(source, path, entry.size, count)
                yield ArchiveMember(path, lambda entry=entry: _read_tar_member(source, archive, entry))  # type: ignore[misc]


def _read_tar_member(source: Path, archive: tarfile.TarFile, entry: tarfile.TarInfo) -> bytes:
    with _translate_errors(source):
        file = archive.extractfile(entry)
        content = b"" if file is None else file.read()
        if len(content) != entry.size:
            raise EOFError(f"{entry.name!r} is truncated")
    return content


class _BoundedReader(io.RawIOBase):
    """Stream of an unpacked archive that raises an error when a size limit is exceeded.

    Args:
        file: Stream of unpacked bytes.
        source: Path of the archive, for messages.
    """

    def __init__(self, file: IO[bytes], source: Path) -> None:
        self._file, self._source = file, source

    def read(self, size: int = -1, /) -> bytes:
        """Return the next `size` bytes of the archive; `size` is required."""
        if not 0 <= size <= MAX_FILE_BYTES or self._file.tell() + size > MAX_ARCHIVE_BYTES:
            raise _size_error(self._source)
        return self._file.read(size)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Move to an absolute position in the stream (bytes)."""
        if whence != os.SEEK_SET or offset > MAX_ARCHIVE_BYTES:
            raise _size_error(self._source)
        return self._file.seek(offset)

    def tell(self) -> int:
        """Return the current position in the stream (bytes)."""
        return self._file.tell()

    def readable(self) -> bool:
        """Return True: the stream can be read."""
        return True

    def seekable(self) -> bool:
        """Return True: the stream has positions to move to."""
        return True


def _check_member_path(source: Path, name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise UnsafeFileError(_refusal_message(source, f"{name[:200]!r} is a path outside the archive"))
    return path


def _check_limits(source: Path, path: PurePosixPath, size: int, count: int) -> None:
    if size > MAX_FILE_BYTES:
        raise UnsafeFileError(_refusal_message(source, f"'{path}' has {size // 1_000_000} MB"))
    if count > MAX_FILES:
        raise UnsafeFileError(_refusal_message(source, f"it has more than {MAX_FILES} files"))


def _size_error(source: Path) -> UnsafeFileError:
    return UnsafeFileError(_refusal_message(source, f"it unpacks to more than {MAX_ARCHIVE_BYTES // 1_000_000} MB"))


def _refusal_message(source: Path, why: str) -> str:
    return (
        f"{source}: refused to unpack, {why}. HandoverSim's archive contains nothing like this; "
        "download it again, or unpack an archive that you trust and pass the folder"
    )
