"""Reading HandoverSim's grasp files, which are pickles, without trusting them.

An official file is a `.npy` with one pickled dict whose key `transforms` holds (n, 4, 4) gripper poses in the
object's frame. A pickle can run any code when it is loaded, and numpy's own builders can be made to take bytes
for pointers. So the pickle meets neither: its arrays are collected by stand-ins, which make them by safe means.
"""

import io
import math
import pickle
import pickletools
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, UnsafeFileError

#: Official files have about 120 operations. The limit keeps hostile nesting from exhausting stack and memory.
_MAX_OPERATIONS = 10_000
_FARTHEST = 100.0
_MEMO_WRITES = ("PUT", "BINPUT", "LONG_BINPUT")
_DTYPE_NAME = re.compile(r"[biuf][0-9]{1,2}|[SU][0-9]{1,6}|O[48]?")


class _Dtype:
    """Stands in for numpy.dtype: booleans, numbers, text and objects, without fields or sub-arrays."""

    __slots__ = ("value",)

    def __init__(self, name: bytes | str) -> None:
        text = _text(name)
        if not _DTYPE_NAME.fullmatch(text):
            raise pickle.UnpicklingError(f"arrays of type {text!r} are not admitted")
        self.value: np.dtype[Any] = np.dtype(object if text.startswith("O") else text)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, order, subarray, names, fields, itemsize, *_ = state
        if not subarray is names is fields is None or itemsize not in (-1, self.value.itemsize):
            raise pickle.UnpicklingError("arrays with fields or of odd element size are not admitted")
        if _text(order) not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"unknown byte order {order!r}")
        self.value = self.value.newbyteorder(_text(order))  # type: ignore[arg-type]


class _Array:
    """Stands in for numpy.ndarray; `value` is the array once its state has been read."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: npt.NDArray[Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C")


class _Admitted:
    """What the pickle gets for a name it asks for; it can be called, but not changed by a BUILD operation."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: object) -> NoReturn:
        raise pickle.UnpicklingError("functions have no state")


def _text(value: object) -> str:
    # Python 2 wrote names as bytes.
    if isinstance(value, bytes):
        return value.decode("ascii")
    if isinstance(value, str):
        return value
    raise pickle.UnpicklingError(f"expected text, found {type(value).__name__}")


def _array(data: object, dtype: object, shape: object, order: str) -> npt.NDArray[Any]:
    if not isinstance(dtype, _Dtype) or not isinstance(shape, tuple):
        raise pickle.UnpicklingError("an array lacks its type or shape")
    if not all(type(length) is int and length >= 0 for length in shape):
        raise pickle.UnpicklingError(f"impossible array shape {shape!r}")
    size = math.prod(shape)
    if dtype.value.hasobject:
        if not isinstance(data, list) or len(data) != size:
            raise pickle.UnpicklingError("an array of objects does not hold what its shape says")
        flat = np.empty(size, dtype=object)
        for index, element in enumerate(data):
            flat[index] = element
        return flat.reshape(shape)  # numpy lists objects in C order, whatever the order in memory
    if not isinstance(data, bytes | bytearray) or len(data) != size * dtype.value.itemsize:
        raise pickle.UnpicklingError("an array does not hold the bytes that its shape and type say")
    if dtype.value.kind == "U":
        letters = np.frombuffer(data, dtype=np.dtype(np.uint32).newbyteorder(dtype.value.byteorder))
        if (letters > sys.maxunicode).any():
            raise pickle.UnpicklingError("an array of text holds what is no text")
    flat = np.frombuffer(bytes(data), dtype=dtype.value) if size else np.empty(0, dtype=dtype.value)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _not_callable(*_: object) -> NoReturn:
    raise pickle.UnpicklingError("numpy writes no call of numpy.ndarray")


def _reconstruct(*_: object) -> _Array:
    # Its arguments say "an empty array"; all that matters comes with the state.
    return _Array()


def _from_buffer(
    data: object, dtype: object, shape: object, order: object, axes: tuple[int, ...] | None = None
) -> _Array:
    # Protocol 5; order "K" is an array in C order seen along permuted axes.
    made = _Array()
    array = _array(data, dtype, shape, _text(order))
    made.value = array if axes is None else array.transpose(axes)
    return made


def _encode_latin1(text: str, encoding: str) -> bytes:
    # Protocol-2 pickles store bytes as latin-1 text and name codecs.encode to turn them back.
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"codec {encoding!r} is not admitted")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    # How protocol-2 pickles write the content of an empty array.
    return b""


_ADMITTED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _not_callable,
    ("numpy", "dtype"): lambda name, *_: _Dtype(name),
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _encode_latin1,
    ("__builtin__", "bytes"): _no_bytes,
    ("collections", "OrderedDict"): lambda: {},
}


class _ArrayUnpickler(pickle.Unpickler):
    """An unpickler for plain containers, numbers, text and the stand-ins of arrays; nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _Admitted(_ADMITTED[module, name])
        except KeyError:
            raise UnsafeFileError(f"asks for {module}.{name}") from None


def _check_operations(data: bytes) -> None:
    """Refuse pickles that would exhaust memory or stack by themselves, before any of it is built."""
    for count, (operation, argument, _) in enumerate(pickletools.genops(data)):
        memo_index = int(argument or 0) if operation.name in _MEMO_WRITES else 0
        if count >= _MAX_OPERATIONS or not 0 <= memo_index < _MAX_OPERATIONS:
            raise pickle.UnpicklingError("the pickle is far more intricate than a dict of arrays")


def _unpickle(stream: io.BytesIO) -> Any:
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    _, _, dtype = read_header(stream)
    if dtype.hasobject is False:
        raise pickle.UnpicklingError("it holds a plain array where a pickled dict belongs")
    data = stream.read()
    _check_operations(data)
    content = _ArrayUnpickler(io.BytesIO(data), encoding="bytes").load()
    content = content.value.item() if isinstance(content, _Array) and content.value is not None else content
    if not isinstance(content, dict):
        raise pickle.UnpicklingError(f"expected a pickled dict, found {type(content).__name__}")
    return content


def load_pickled_dict(path: Path) -> dict[str, Any]:
    """The dict inside an official `.npy` file, its byte keys turned to text and its array values to arrays.

    Raises:
        UnsafeFileError: The pickle holds something other than numpy arrays and plain values.
        DataFormatError: The file is no such file, or is damaged.
    """
    try:
        content = _unpickle(io.BytesIO(path.read_bytes()))
        return {_text(key): value.value if isinstance(value, _Array) else value for key, value in content.items()}
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. "
            "Replace it by the original HandoverSim file."
        ) from None
    except Exception as error:
        raise DataFormatError(
            f"{path}: not a readable grasp file ({str(error) or type(error).__name__}). "
            "Copy it again from the HandoverSim data."
        ) from error


def unpickle_plain(data: bytes) -> dict[str, npt.NDArray[Any]] | npt.NDArray[Any]:
    """A pickled array, or the arrays in a pickled dict of arrays.

    Raises:
        DataFormatError: The pickle is something else, asks for more, or is damaged.
    """
    try:
        _check_operations(data)
        content = _ArrayUnpickler(io.BytesIO(data), encoding="bytes").load()
        if isinstance(content, _Array) and content.value is not None:
            return content.value
        if not isinstance(content, dict):
            raise pickle.UnpicklingError(f"expected a dict, found {type(content).__name__}")
        return {_text(key): value.value for key, value in content.items() if value.value is not None}
    except Exception as error:  # what damaged pickles raise has no end
        raise DataFormatError(f"no pickled dict of arrays ({str(error) or type(error).__name__})") from error


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """The (n, 4, 4) gripper poses `object_from_gripper` of a grasp file (m), float64.

    Raises:
        UnsafeFileError: As `load_pickled_dict`.
        DataFormatError: The file is damaged or holds no such array.
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
    if np.abs(transforms).max(initial=0.0) > _FARTHEST:
        raise DataFormatError(f"{path}: 'transforms' has numbers beyond {_FARTHEST:g}, which no pose in metres has")
    return transforms
