"""Putting files into a folder of models without changing any that is there."""

from collections.abc import Mapping
from pathlib import Path

from handover_marl.datasets.official_files import stands_in
from handover_marl.errors import ResultsError
from handover_marl.files import create_exclusively, holds, remove_abandoned, write_atomically


def put_files(folder: Path, files: Mapping[str, bytes], over_stand_ins: bool = False) -> None:
    """Write the files that are missing, each whole or not at all, and compare those that are there.

    Args:
        folder: Where they go; it is made if need be.
        files: Path relative to the folder -> content.
        over_stand_ins: Whether what only stands in for these files makes way for them.

    Raises:
        ResultsError: A file is there with other content, or one cannot be written.
    """
    for parent in {(folder / name).parent for name in files}:
        remove_abandoned(parent)
    for name, content in files.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ResultsError(f"cannot make the folder {path.parent} ({error.strerror or error})") from error
        if over_stand_ins and stands_in(path):
            write_atomically(path, content)
        create_exclusively(path, content)
        if not _holds(path, content):
            raise ResultsError(
                f"{path} is there already with other content, perhaps made from other data. It was left as it is; "
                "remove it, or give another folder."
            )


def _holds(path: Path, content: bytes) -> bool:
    try:
        return holds(path, content)
    except OSError as error:
        raise ResultsError(f"cannot read {path} ({error.strerror or error}); check its rights") from error
