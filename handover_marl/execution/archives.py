"""Unpacking of archives from untrusted sources."""

import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.execution.files import shorten_text


@contextmanager
def open_folder(source: Path) -> Iterator[Path]:
    """Yield a folder, or a temporary folder with the content of a .tar, .tar.gz, .tar.bz2, .tar.xz or .zip archive.

    Raises:
        DataNotFoundError: The source does not exist or is not a folder or plain file.
        UnsafeFileError: The archive contains devices, links or paths to places outside itself.
        DataFormatError: The archive is damaged, or the file is not an archive.
    """
    try:
        is_folder, is_file = source.is_dir(), source.is_file()
    except OSError as error:  # such as a name that is too long
        raise DataNotFoundError(f"cannot read {source} ({error.strerror or error})") from error
    if is_folder:
        yield source
        return
    if not is_file:
        raise DataNotFoundError(f"{source} must be a folder or an archive, got no such file")
    with tempfile.TemporaryDirectory() as folder:
        try:
            if zipfile.is_zipfile(source):
                with zipfile.ZipFile(source) as zip_archive:
                    zip_archive.extractall(folder)
            else:
                with tarfile.open(source) as archive:
                    archive.extractall(folder, filter="data")
        except tarfile.FilterError as error:
            raise UnsafeFileError(
                f"{source}: refused to unpack, {shorten_text(error)}; download it again, or unpack an archive that "
                "you trust and pass the folder"
            ) from error
        except Exception as error:  # tarfile and zipfile raise exceptions of many kinds on damaged bytes
            raise DataFormatError(
                f"{source}: not a readable archive ({shorten_text(error)}); download it again"
            ) from error
        yield Path(folder)


def find_plain_files(folder: Path) -> list[Path]:
    """Return the paths of all regular files in a folder, sorted; links are left out."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
