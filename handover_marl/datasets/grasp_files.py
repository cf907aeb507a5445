"""Reader of HandoverSim's grasp files and of other untrusted pickles of arrays.

A grasp file is a `.npy` with one pickled dict whose key `transforms` holds (n, 4, 4) gripper poses
in the object's frame. NumPy's own functions for pickles can take bytes for pointers, so arrays are
collected by `PickledArray` and made from checked buffers.
"""

import io
import math
import re
import sys
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.restricted_pickle import (
    AllowedNames,
    decode_name,
    load_restricted,
    reject,
    sanitize_text,
)
from handover_marl.errors import DataFormatError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file

_DTYPE_NAME = re.compile(r"[biuf][0-9]{1,2}|[SU][0-9]{1,6}|O[48]?")
_MAX_ABS_VALUE = 100.0  # m
_MAX_BYTES = 20_000_000  # official files have less than 1 MB


class PickledDtype:
    """Array type in a pickle: booleans, numbers, text or objects, without fields or sub-arrays.

    Attributes:
        value: NumPy's array type.
    """

    def __init__(self, name: object, *_: object) -> None:
        text = decode_name(name)
        if not _DTYPE_NAME.fullmatch(text):
            reject(f"arrays of type '{sanitize_text(text)}' are not admitted")
        self.value: np.dtype[Any] = np.dtype(object if text.startswith("O") else text)

    def __setstate__(self, state: object) -> None:
        """Set the byte order of the array type; reject any other state."""
        if not isinstance(state, tuple) or len(state) < 6:
            reject("the type of an array lacks its state")
        _version, order, subarray, names, fields, itemsize, *_ = state
        if not subarray is names is fields is None or itemsize not in (-1, self.value.itemsize):
            reject("arrays with fields or of odd element size are not admitted")
        if decode_name(order) not in ("<", ">", "|", "="):
            reject(f"unknown byte order '{sanitize_text(decode_name(order))}'")
        self.value = self.value.newbyteorder(decode_name(order))  # type: ignore[arg-type]


class PickledArray:
    """Array in a pickle.

    Attributes:
        value: NumPy array, or None before its state is set.
    """

    value: npt.NDArray[Any] | None = None

    def __init__(self, *_: object) -> None:
        # The arguments describe an empty array; the state sets everything.
        pass

    def __setstate__(self, state: object) -> None:
        """Set shape, element type and content of the array as given by the pickle."""
        if not isinstance(state, tuple) or len(state) != 5:
            reject("an array lacks its state")
        _version, shape, dtype, fortran, data = state
        self.value = _make_array(data, dtype, shape, "F" if fortran is True else "C")


def _make_array(data: object, dtype: object, shape: object, order: str) -> npt.NDArray[Any]:
    if not isinstance(dtype, PickledDtype) or not isinstance(shape, tuple):
        reject("an array lacks its type or shape")
    for length in shape:
        if type(length) is not int or not 0 <= length <= _MAX_BYTES:
            reject("an array has an impossible shape")
    size = math.prod(shape)
    if dtype.value.hasobject:
        if not isinstance(data, list) or len(data) != size:
            reject("an array of objects does not hold what its shape says")
        flat = np.empty(size, dtype=object)
        for index, element in enumerate(data):
            flat[index] = element
        return flat.reshape(shape)  # NumPy lists objects in C order, whatever the order in memory
    if not isinstance(data, bytes | bytearray) or len(data) != size * dtype.value.itemsize:
        reject("an array does not hold the bytes that its shape and type say")
    if dtype.value.kind == "U":
        letters = np.frombuffer(data, dtype=np.dtype(np.uint32).newbyteorder(dtype.value.byteorder))
        if (letters > sys.maxunicode).any():
            reject("an array of text holds what is no text")
    # A read-only view, not a copy: many arrays of a pickle can share one buffer.
    content = memoryview(data).toreadonly()
    flat = np.frombuffer(content, dtype=dtype.value) if size else np.empty(0, dtype=dtype.value)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _reject_call(*_: object) -> NoReturn:
    reject("numpy writes no call of numpy.ndarray")


def _make_from_buffer(
    data: object, dtype: object, shape: object, order: object, axes: tuple[int, ...] | None = None
) -> PickledArray:
    # Pickle protocol 5. Order "K" is an array in C order with permuted axes.
    result = PickledArray()
    array = _make_array(data, dtype, shape, decode_name(order))
    result.value = array if axes is None else array.transpose(axes)
    return result


def _encode_latin1(text: object, encoding: object) -> bytes:
    # Pickles of protocol 2 store bytes as latin-1 text and call codecs.encode.
    if not isinstance(text, str) or encoding != "latin1":
        reject("a codec other than latin1 is not admitted")
    return text.encode("latin1")


#: Names in pickles of arrays, and of dicts of arrays, by all versions of NumPy.
ARRAY_NAMES: AllowedNames = {
    ("numpy", "ndarray"): _reject_call,
    ("numpy", "dtype"): PickledDtype,
    ("numpy.core.multiarray", "_reconstruct"): PickledArray,
    ("numpy._core.multiarray", "_reconstruct"): PickledArray,
    ("numpy.core.numeric", "_frombuffer"): _make_from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _make_from_buffer,
    ("_codecs", "encode"): _encode_latin1,
    # Content of an empty array in protocol 2.
    ("__builtin__", "bytes"): lambda: b"",
    ("collections", "OrderedDict"): lambda: {},
}


def load_pickled_dict(path: Path) -> dict[str, Any]:
    """Load the dict of a grasp file, with keys as text and NumPy arrays.

    Raises:
        UnsafeFileError: The pickle uses something other than arrays and plain values.
        DataFormatError: The file is not a pickled dict in a `.npy`, or is damaged.
    """
    try:
        pickled = _remove_npy_header(read_plain_file(path, _MAX_BYTES))
        content: Any = load_restricted(pickled, ARRAY_NAMES)
        if isinstance(content, PickledArray) and content.value is not None:
            content = content.value.item()
        if not isinstance(content, dict):
            reject(f"expected a pickled dict, found {type(content).__name__}")
        return {
            decode_name(key): value.value if isinstance(value, PickledArray) else value
            for key, value in content.items()
        }
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. "
            "Replace it by the original HandoverSim file."
        ) from None
    except Exception as error:
        raise DataFormatError(
            f"{path}: not a readable grasp file ({shorten_text(error)}). Copy it again from the HandoverSim data."
        ) from error


def _remove_npy_header(data: bytes) -> bytes:
    """Return the pickle in a `.npy` file."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    _, _, dtype = read_header(stream)
    if dtype.hasobject is False:
        reject("it holds a plain array where a pickled dict belongs")
    return stream.read()


def unpickle_arrays(data: bytes) -> dict[str, npt.NDArray[Any]] | npt.NDArray[Any]:
    """Load a pickled array, or a pickled dict of arrays.

    Raises:
        DataFormatError: The pickle holds or uses something else, or is damaged.
    """
    try:
        content = load_restricted(data, ARRAY_NAMES)
        if isinstance(content, PickledArray) and content.value is not None:
            return content.value
        if not isinstance(content, dict):
            reject(f"expected a dict, found {type(content).__name__}")
        return {decode_name(key): value.value for key, value in content.items() if value.value is not None}
    except Exception as error:  # Damaged pickles raise exceptions of many types.
        raise DataFormatError(f"no pickled dict of arrays ({shorten_text(error)})") from error


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """Load the gripper poses (n, 4, 4) `object_from_gripper` (m) of a grasp file.

    Raises:
        UnsafeFileError: The pickle uses something other than arrays and plain values.
        DataFormatError: The file is damaged, or has no finite poses.
    """
    content = load_pickled_dict(path)
    if "transforms" not in content:
        raise DataFormatError(f"{path}: no key 'transforms' among {sorted(content)}")
    transforms = content["transforms"]
    if not isinstance(transforms, np.ndarray) or transforms.dtype.kind not in "iuf":
        raise DataFormatError(f"{path}: 'transforms' is no array of numbers")
    transforms = transforms.astype(np.float64)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not np.isfinite(transforms).all():
        raise DataFormatError(
            f"{path}: 'transforms' must be finite numbers of shape (n, 4, 4), found shape {transforms.shape}"
        )
    if np.abs(transforms).max(initial=0.0) > _MAX_ABS_VALUE:
        raise DataFormatError(f"{path}: 'transforms' has numbers beyond {_MAX_ABS_VALUE:g}; poses must be in metres")
    return transforms
