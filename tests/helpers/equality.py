"""Equality of nested results and of folders, for tests."""

from pathlib import Path
from typing import Any

import numpy as np


def assert_equal(first: Any, second: Any) -> None:
    """Check that nested containers have the same types and keys, and that all their arrays and numbers are equal."""
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    elif isinstance(first, (list, tuple)) or (isinstance(first, np.ndarray) and first.dtype == object):
        for one, other in zip(first, second, strict=True):
            assert_equal(one, other)
    else:
        np.testing.assert_array_equal(first, second, strict=True)


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder, also of hidden ones, by relative path."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
