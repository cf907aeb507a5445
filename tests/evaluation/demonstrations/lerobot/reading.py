"""Functions that read data sets in LeRobot's format as NumPy arrays, with pyarrow only."""

import json
from pathlib import Path
from typing import Any

import numpy as np


def data_set_contents(out: Path) -> dict[str, bytes]:
    """Return the content of every file of a data set, by its path in the data set."""
    files = sorted(path for path in (out / "lerobot").rglob("*") if path.is_file())
    return {str(path.relative_to(out / "lerobot")): path.read_bytes() for path in files}


def read_info(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "lerobot" / "meta" / "info.json").read_text())
    return found


def read_rows(out: Path) -> list[dict[str, Any]]:
    """Return the rows of the table of episodes."""
    from pyarrow import parquet

    rows: list[dict[str, Any]] = parquet.read_table(
        out / "lerobot" / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    ).to_pylist()
    return rows


def read_frames(out: Path, number: int) -> dict[str, np.ndarray]:
    """Return the columns of an episode's table of frames, by their names."""
    from pyarrow import parquet

    table = parquet.ParquetFile(out / "lerobot" / "data" / "chunk-000" / f"file-{number:03d}.parquet").read()
    return {name: as_array(table.column(name).combine_chunks()) for name in table.column_names}


def as_array(column: Any) -> np.ndarray:
    """Convert a column of numbers, or of nested lists of equal lengths, to an array."""
    shape = [len(column)]
    while hasattr(column, "flatten") and "list<" in str(column.type):
        column = column.flatten()
        shape.append(len(column) // int(np.prod(shape)))
    return np.array(column.to_numpy(zero_copy_only=False)).reshape(shape)
