"""Reading MANO's model files, which are pickles of Python 2, without trusting them.

An official file names classes of numpy, scipy and chumpy. None of them is imported for it: arrays are collected by
stand-ins, the others are records whose parts are looked at here. Files that were saved again by newer programs, with
plain arrays in the place of chumpy's objects, are read as well.
"""

import math
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.pickled_arrays import ARRAY_NAMES, PickledArray
from handover_marl.datasets.plain_pickle import Function, Names, Record, RecordClass, decoded, load_plain, refuse
from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError

Array = npt.NDArray[Any]

#: Official files have 3.8 MB.
_LARGEST = 50_000_000  # bytes
_LARGEST_MATRIX = 10_000  # rows or columns
_VARIABLE, _SELECTION, _MATRIX = "chumpy's Ch", "chumpy's Select", "scipy's csc_matrix"
_SET = Function(lambda *_: [])
_NAMES: Names = {
    **ARRAY_NAMES,
    # Chumpy's bookkeeping is in sets, of which nothing is needed.
    ("__builtin__", "set"): _SET,
    ("builtins", "set"): _SET,
    ("chumpy.ch", "Ch"): RecordClass(_VARIABLE),
    ("chumpy.reordering", "Select"): RecordClass(_SELECTION),
    **{
        (module, name): RecordClass(_MATRIX)
        for module in ("scipy.sparse.csc", "scipy.sparse._csc")
        for name in ("csc_matrix", "csc_array")
    },
}


def read_mano_pickle(path: Path, wanted: tuple[str, ...]) -> dict[str, Array | csc_matrix]:
    """Some of the arrays in a MANO model file.

    Args:
        path: `MANO_RIGHT.pkl` or `MANO_LEFT.pkl`.
        wanted: The keys to read; what is under others is not looked at.

    Returns:
        An array, or a sparse matrix whose indices have been checked, for each key, in whatever shape and type.

    Raises:
        DataNotFoundError: There is no such file.
        UnsafeFileError: The pickle asks for something other than a model consists of.
        DataFormatError: It is no model, lacks a key, or is damaged.
    """
    data = _read(path)
    try:
        content = load_plain(data, _NAMES)
        if not isinstance(content, dict):
            refuse(f"expected a pickled dict, found {type(content).__name__}")
        by_name = {decoded(key): value for key, value in content.items()}
        missing = [key for key in wanted if key not in by_name]
        if missing:
            refuse(f"it lacks {', '.join(missing)}")
        return {key: _value(key, by_name[key]) for key in wanted}
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. Replace it by the file of this "
            "name in the original mano_v1_2.zip."
        ) from None
    except Exception as error:  # what damaged pickles raise has no end
        raise DataFormatError(
            f"{path}: not a readable MANO model ({str(error)[:200] or type(error).__name__}). Copy it again from "
            "mano_v1_2.zip."
        ) from error


def _read(path: Path) -> bytes:
    try:
        # Opening a pipe would wait for somebody to write into it, so it is looked at before.
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataFormatError(f"{path}: not a plain file; give MANO_RIGHT.pkl or MANO_LEFT.pkl of mano_v1_2.zip")
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > _LARGEST:
                raise DataFormatError(
                    f"{path}: more than {_LARGEST // 1_000_000} MB, which no MANO model has; "
                    "copy it again from mano_v1_2.zip"
                )
            return stream.read(size)
    except FileNotFoundError as error:
        raise DataNotFoundError(
            f"{path} does not exist; MANO_RIGHT.pkl and MANO_LEFT.pkl are in mano_v1_2.zip, under models/"
        ) from error
    except (OSError, ValueError) as error:
        if isinstance(error, DataFormatError):
            raise
        raise DataFormatError(f"{path} cannot be read ({error}); check its name and its rights") from error


def _value(key: str, value: object) -> Array | csc_matrix:
    """What is under a key, whichever way it was written."""
    if isinstance(value, Record):
        parts = {decoded(name): part for name, part in value.state.items()}
        if value.kind == _MATRIX:
            return _matrix(key, parts)
        if value.kind == _SELECTION:
            return _selection(key, parts)
    return _array(key, value)


def _array(key: str, value: object) -> Array:
    """An array, also as a chumpy variable."""
    if isinstance(value, Record) and value.kind == _VARIABLE:
        value = next((part for name, part in value.state.items() if decoded(name) == "x"), None)
    if not isinstance(value, PickledArray) or value.value is None:
        refuse(f"{key} is no array")
    return value.value


def _numbers(key: str, parts: dict[str, object], name: str) -> npt.NDArray[np.int64]:
    """One of a record's arrays of whole numbers."""
    array = _array(f"{key}.{name}", parts.get(name))
    if array.ndim != 1 or array.dtype.kind not in "iu":
        refuse(f"{key}.{name} is no list of whole numbers")
    if array.size and (array.min() < 0 or array.max() > np.iinfo(np.int64).max):
        refuse(f"{key}.{name} has a number out of range")
    return array.astype(np.int64)


def _shape(key: str, shape: object) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not shape or len(shape) > 8:
        refuse(f"{key} lacks its shape")
    if not all(type(length) is int and length >= 0 for length in shape):
        refuse(f"{key} has an impossible shape")
    return shape


def _selection(key: str, parts: dict[str, object]) -> Array:
    """The elements of an array that chumpy picked out of it, in their own shape."""
    source = _array(key, parts.get("a")).ravel()
    picked = _numbers(key, parts, "idxs")
    shape = _shape(key, parts.get("preferred_shape"))
    if math.prod(shape) != len(picked) or (len(picked) and picked.max() >= len(source)):
        refuse(f"{key} picks elements that are not there")
    return source[picked].reshape(shape)


def _matrix(key: str, parts: dict[str, object]) -> csc_matrix:
    """A sparse matrix; scipy would believe the indices and read outside of memory."""
    shape = _shape(key, parts.get("_shape"))
    if len(shape) != 2 or max(shape) > _LARGEST_MATRIX:
        refuse(f"{key} has an impossible shape")
    starts, rows = _numbers(key, parts, "indptr"), _numbers(key, parts, "indices")
    values = _array(key, parts.get("data"))
    if len(starts) != shape[1] + 1 or starts[0] != 0 or (np.diff(starts) < 0).any():
        refuse(f"{key} has no proper columns")
    # Scipy may leave room at the end.
    count = int(starts[-1])
    if values.ndim != 1 or values.dtype.kind != "f" or count > min(len(rows), len(values)):
        refuse(f"{key} lacks elements")
    if count and rows[:count].max() >= shape[0]:
        refuse(f"{key} has an element in a row that is not there")
    own_order = values[:count].astype(values.dtype.newbyteorder("="))
    return csc_matrix((own_order, rows[:count], starts), shape=shape)
