"""Writing files so that a reader never meets half of one."""

import contextlib
import os
import tempfile
from pathlib import Path

from handover_marl.errors import ResultsError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it.

    Raises:
        ResultsError: The file cannot be written, e.g. because the disk is full; what was there before stays.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
        raise ResultsError(
            f"cannot write {path} ({error.strerror or error}); finished scenes are kept, free space or fix the "
            "folder and run the same command again to go on"
        ) from error
