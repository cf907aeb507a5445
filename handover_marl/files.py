"""Writing files so that a reader never meets half of one."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from handover_marl.errors import ResultsError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it.

    Raises:
        ResultsError: The file cannot be written, e.g. because the disk is full; what was there before stays.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with _removed_on_failure(Path(name)) as temporary:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
    except OSError as error:
        raise ResultsError(
            f"cannot write {path} ({error.strerror or error}); finished scenes are kept, free space or fix the "
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
