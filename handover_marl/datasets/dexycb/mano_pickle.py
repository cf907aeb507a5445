"""Reader of MANO's model files, untrusted pickles of Python 2.

Official files use classes of NumPy, SciPy and chumpy, none of which is imported: arrays are made
from checked buffers, other objects are records whose parts are checked here. Files that other tools
saved again, with plain arrays instead of chumpy's objects, are accepted too.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.grasp_files import ARRAY_NAMES, PickledArray
from handover_marl.datasets.restricted_pickle import (
    AllowedNames,
    PickledRecord,
    decode_name,
    load_restricted,
    reject,
)
from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file

Array = npt.NDArray[Any]

_MAX_BYTES = 20_000_000  # official files have 3.8 MB
_MAX_MATRIX_SIZE = 10_000  # rows or columns
_MAX_DIMENSIONS = 8


class _Variable(PickledRecord):
    """Array of chumpy, `Ch`."""


class _Selection(PickledRecord):
    """Elements of an array of chumpy, `Select`."""


class _Matrix(PickledRecord):
    """Sparse matrix of SciPy."""


_ALLOWED: AllowedNames = {
    **ARRAY_NAMES,
    # Sets hold bookkeeping of chumpy that is not needed.
    ("__builtin__", "set"): lambda *_: [],
    ("builtins", "set"): lambda *_: [],
    ("chumpy.ch", "Ch"): _Variable,
    ("chumpy.reordering", "Select"): _Selection,
    ("scipy.sparse.csc", "csc_matrix"): _Matrix,
    ("scipy.sparse.csc", "csc_array"): _Matrix,
    ("scipy.sparse._csc", "csc_matrix"): _Matrix,
    ("scipy.sparse._csc", "csc_array"): _Matrix,
}


def read_mano_pickle(path: Path, keys: tuple[str, ...]) -> dict[str, Array | csc_matrix]:
    """Read some of the arrays of a MANO model file.

    Args:
        path: `MANO_RIGHT.pkl` or `MANO_LEFT.pkl`.
        keys: Names of the arrays; values of other names are not checked.

    Returns:
        Array, or sparse matrix with checked indices, by name; shapes and types are not checked.

    Raises:
        DataNotFoundError: The file is missing.
        UnsafeFileError: The pickle uses something that a model does not need.
        DataFormatError: The file is not a model, lacks a name, or is damaged.
    """
    data = _read(path)
    try:
        content = load_restricted(data, _ALLOWED)
        if not isinstance(content, dict):
            reject(f"expected a pickled dict, found {type(content).__name__}")
        by_name = {decode_name(key): value for key, value in content.items()}
        missing = [key for key in keys if key not in by_name]
        if missing:
            reject(f"it lacks {', '.join(missing)}")
        return {key: _extract_value(key, by_name[key]) for key in keys}
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. Replace it by the file of this "
            "name in the original mano_v1_2.zip."
        ) from None
    except Exception as error:  # Damaged pickles raise exceptions of many types.
        raise DataFormatError(
            f"{path}: not a readable MANO model ({shorten_text(error)}). Copy it again from mano_v1_2.zip."
        ) from error


def _read(path: Path) -> bytes:
    try:
        return read_plain_file(path, _MAX_BYTES)
    except FileNotFoundError as error:
        raise DataNotFoundError(
            f"{path} does not exist; MANO_RIGHT.pkl and MANO_LEFT.pkl are in mano_v1_2.zip, under models/"
        ) from error
    except (OSError, ValueError) as error:
        raise DataFormatError(
            f"{path} cannot be read ({error}); give MANO_RIGHT.pkl or MANO_LEFT.pkl of mano_v1_2.zip, and check its "
            "rights"
        ) from error


def _extract_value(key: str, value: object) -> Array | csc_matrix:
    """Return the array or sparse matrix of a key, from any of the accepted classes."""
    if isinstance(value, _Matrix | _Selection):
        parts = {decode_name(name): part for name, part in value.state.items()}
        return _make_sparse_matrix(key, parts) if isinstance(value, _Matrix) else _select_elements(key, parts)
    return _extract_array(key, value)


def _extract_array(key: str, value: object) -> Array:
    """Return an array that may be the value of a chumpy variable."""
    if isinstance(value, _Variable):
        value = next((part for name, part in value.state.items() if decode_name(name) == "x"), None)
    if not isinstance(value, PickledArray) or value.value is None:
        reject(f"{key} is no array")
    return value.value


def _extract_integers(key: str, parts: dict[str, object], name: str) -> npt.NDArray[np.int64]:
    """Return a one-dimensional array of non-negative integers in a record."""
    array = _extract_array(f"{key}.{name}", parts.get(name))
    if array.ndim != 1 or array.dtype.kind not in "iu":
        reject(f"{key}.{name} is no list of integers")
    if array.size and (array.min() < 0 or array.max() > np.iinfo(np.int64).max):
        reject(f"{key}.{name} has a number out of range")
    return array.astype(np.int64)


def _extract_shape(key: str, shape: object) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not shape or len(shape) > _MAX_DIMENSIONS:
        reject(f"{key} lacks its shape")
    if not all(type(length) is int and length >= 0 for length in shape):
        reject(f"{key} has an impossible shape")
    return shape


def _select_elements(key: str, parts: dict[str, object]) -> Array:
    """Return the selected elements of an array, in the shape of the selection."""
    source = _extract_array(key, parts.get("a")).ravel()
    selected = _extract_integers(key, parts, "idxs")
    shape = _extract_shape(key, parts.get("preferred_shape"))
    if math.prod(shape) != len(selected) or (len(selected) and selected.max() >= len(source)):
        reject(f"{key} selects elements that do not exist")
    return source[selected].reshape(shape)


def _make_sparse_matrix(key: str, parts: dict[str, object]) -> csc_matrix:
    """Return a sparse matrix after a check of its indices, which SciPy would not check."""
    shape = _extract_shape(key, parts.get("_shape"))
    if len(shape) != 2 or max(shape) > _MAX_MATRIX_SIZE:
        reject(f"{key} has an impossible shape")
    starts, rows = _extract_integers(key, parts, "indptr"), _extract_integers(key, parts, "indices")
    values = _extract_array(key, parts.get("data"))
    if len(starts) != shape[1] + 1 or starts[0] != 0 or (np.diff(starts) < 0).any():
        reject(f"{key} has no proper columns")
    # SciPy may allocate more elements than it uses.
    count = int(starts[-1])
    if values.ndim != 1 or values.dtype.kind != "f" or count > min(len(rows), len(values)):
        reject(f"{key} lacks elements")
    if count and rows[:count].max() >= shape[0]:
        reject(f"{key} has an element in a row that does not exist")
    own_order = values[:count].astype(values.dtype.newbyteorder("="))
    return csc_matrix((own_order, rows[:count], starts), shape=shape)
