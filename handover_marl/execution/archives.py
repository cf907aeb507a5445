"""Unpacking of archives from untrusted sources."""

import os
import stat
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, UnsafeFileError
from handover_marl.execution.files import shorten_text

#: Largest size of the unpacked archive (bytes). HandoverSim's compressed archive has 155 MB.
MAX_ARCHIVE_BYTES = 2_000_000_000


@contextmanager
def open_folder(source: Path) -> Iterator[Path]:
    """Yield a folder, or a temporary folder with the content of a .tar, .tar.gz, .tar.bz2, .tar.xz or .zip archive.

    Raises:
        DataNotFoundError: The source does not exist or cannot be read.
        UnsafeFileError: The archive contains devices, links or paths to places outside itself, or is too large.
        DataFormatError: The archive is damaged, or the file is not an archive.
        OptionError: This version of Python cannot unpack archives safely.
    """
    try:
        mode = source.stat().st_mode
        if stat.S_ISREG(mode):
            source.open("rb").close()
        elif not stat.S_ISDIR(mode):
            raise DataNotFoundError(f"{source} is neither a folder nor an archive")
    except OSError as error:
        raise DataNotFoundError(f"cannot read {source} ({error.strerror or error})") from error
    if stat.S_ISDIR(mode):
        yield source
        return
    with tempfile.TemporaryDirectory() as folder:
        _unpack(source, Path(folder))
        yield Path(folder)


def find_plain_files(folder: Path) -> list[Path]:
    """Return the paths of all regular files in a folder, sorted; links are left out."""
    paths = (Path(place) / name for place, _, names in os.walk(folder) for name in names)
    return sorted(path for path in paths if stat.S_ISREG(path.lstat().st_mode))


def _unpack(source: Path, folder: Path) -> None:
    try:
        if zipfile.is_zipfile(source):
            with zipfile.ZipFile(source) as archive:
                _check_size(source, sum(part.file_size for part in archive.infolist()))
                archive.extractall(folder)
            return
        if not hasattr(tarfile, "data_filter"):  # before Python 3.10.12 and 3.11.4
            raise OptionError(f"{source} must be a folder with this version of Python; unpack the archive yourself")
        size = 0
        with tarfile.open(source) as archive:
            for entry in archive:
                size += entry.size
                _check_size(source, size)
                archive.extract(entry, folder, filter="data")
    except (UnsafeFileError, OptionError):
        raise
    except tarfile.FilterError as error:
        raise UnsafeFileError(_format_refusal(source, shorten_text(error))) from error
    except Exception as error:  # tarfile and zipfile raise exceptions of many kinds on damaged bytes
        raise DataFormatError(f"{source}: not a readable archive ({shorten_text(error)}); download it again") from error


def _check_size(source: Path, size: int) -> None:
    if size > MAX_ARCHIVE_BYTES:
        raise UnsafeFileError(_format_refusal(source, f"it unpacks to more than {MAX_ARCHIVE_BYTES // 1_000_000} MB"))


def _format_refusal(source: Path, why: str) -> str:
    return (
        f"{source}: refused to unpack, {why}. HandoverSim's archive contains nothing like this; "
        "download it again, or unpack an archive that you trust and pass the folder"
    )
