"""Samples of a training by imitation: arrays that are generated in parallel processes and kept in files.

The samples of a training are a named tuple of arrays (n, ...). A file has the samples of one key, such as a scene. The
content does not depend on the number of processes, so that an interrupted generation can be resumed.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataNotFoundError, ResultsError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.execution.reading import read_arrays

_MAX_BYTES = 1_000_000_000

#: Named tuple of arrays.
Samples = TypeVar("Samples", bound=tuple[npt.NDArray[Any], ...])


def generate_samples(
    kind: type[Samples],
    folder: Path,
    keys: Sequence[int],
    make_generator: Callable[[], Callable[[int], Samples]],
    description: str,
    workers: int | None,
) -> list[Samples]:
    """Return the samples of each key, in the order of `keys`; generate samples that have no file yet.

    Args:
        kind: Class of the samples, a named tuple of arrays.
        folder: Folder of the files, for one configuration only.
        keys: Numbers that name the files, such as scene numbers.
        make_generator: Factory of a function from a key to its samples; called once in every process.
        description: Label of the progress bar.
        workers: Number of worker processes; default: one per core.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def make_writer() -> Callable[[int], None]:
        generate: Callable[[int], Any] = make_generator()
        return lambda key: write_arrays(get_samples_path(folder, key), generate(key)._asdict())

    missing = [key for key in keys if not get_samples_path(folder, key).exists()]
    if missing:
        for _ in map_with_progress(make_writer, missing, description, PoolConfig(workers), progress=True):
            pass
    return [read_samples(kind, get_samples_path(folder, key)) for key in keys]


def get_samples_path(folder: Path, key: int) -> Path:
    """Return the path of the file in a folder that has the samples of a key, such as a scene number."""
    return folder / f"{key:06d}.npz"


def read_samples(kind: type[Samples], path: Path) -> Samples:
    """Read the samples in a file (.npz) as a named tuple of the class `kind`; raise ResultsError if that fails."""
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    try:
        return kind(*read_arrays(path, names, _MAX_BYTES).values())
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise ResultsError(f"{path}: not a file of samples ({shorten_text(error)}); remove it and resume") from error


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Concatenate samples, named tuples of arrays (n, ...), in their order; raise DataNotFoundError for none."""
    if not parts:
        raise DataNotFoundError("a training needs samples, got none; pass at least two scenes")
    return type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))


def stack_samples(
    kind: type[Samples], rows: Sequence[tuple[Any, ...]], columns: Sequence[tuple[npt.DTypeLike, tuple[int, ...]]]
) -> Samples:
    """Return samples as a named tuple of arrays (n, ...), from a list with the values of each of the n samples.

    Args:
        kind: Class of the samples, a named tuple of arrays.
        rows: Values of each sample, one for each field of `kind`; there may be no rows.
        columns: Data type and shape of one value for each field of `kind`.
    """
    values = zip(*rows, strict=True) if rows else [()] * len(columns)
    return kind(
        *(
            np.array(column, dtype=dtype).reshape(len(rows), *shape)
            for column, (dtype, shape) in zip(values, columns, strict=True)
        )
    )
