"""Arrays in pickles that are not trusted.

numpy's own builders can be made to take bytes for pointers. So a pickle does not meet them: its arrays are collected
by stand-ins, which make them by safe means.
"""

import math
import re
import sys
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.plain_pickle import Function, Names, Stateful, decoded, refuse, shown

_DTYPE_NAME = re.compile(r"[biuf][0-9]{1,2}|[SU][0-9]{1,6}|O[48]?")


class PickledDtype(Stateful):
    """Stands in for numpy.dtype: booleans, numbers, text and objects, without fields or sub-arrays."""

    __slots__ = ("value",)

    def __init__(self, name: object) -> None:
        text = decoded(name)
        if not _DTYPE_NAME.fullmatch(text):
            refuse(f"arrays of type '{shown(text)}' are not admitted")
        self.value: np.dtype[Any] = np.dtype(object if text.startswith("O") else text)

    def set_state(self, state: object) -> None:
        """Take over byte order and element size; anything more is refused."""
        if not isinstance(state, tuple) or len(state) < 6:
            refuse("the type of an array lacks its state")
        _version, order, subarray, names, fields, itemsize, *_ = state
        if not subarray is names is fields is None or itemsize not in (-1, self.value.itemsize):
            refuse("arrays with fields or of odd element size are not admitted")
        if decoded(order) not in ("<", ">", "|", "="):
            refuse(f"unknown byte order '{shown(decoded(order))}'")
        self.value = self.value.newbyteorder(decoded(order))  # type: ignore[arg-type]


class PickledArray(Stateful):
    """Stands in for numpy.ndarray; `value` is the array once its state has been read."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: npt.NDArray[Any] | None = None

    def set_state(self, state: object) -> None:
        """Take over shape, type and content."""
        if not isinstance(state, tuple) or len(state) != 5:
            refuse("an array lacks its state")
        _version, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran is True else "C")


def _array(data: object, dtype: object, shape: object, order: str) -> npt.NDArray[Any]:
    if not isinstance(dtype, PickledDtype) or not isinstance(shape, tuple):
        refuse("an array lacks its type or shape")
    if not all(type(length) is int and length >= 0 for length in shape):
        refuse("an array has an impossible shape")
    size = math.prod(shape)
    if dtype.value.hasobject:
        if not isinstance(data, list) or len(data) != size:
            refuse("an array of objects does not hold what its shape says")
        flat = np.empty(size, dtype=object)
        for index, element in enumerate(data):
            flat[index] = element
        return flat.reshape(shape)  # numpy lists objects in C order, whatever the order in memory
    if not isinstance(data, bytes | bytearray) or len(data) != size * dtype.value.itemsize:
        refuse("an array does not hold the bytes that its shape and type say")
    if dtype.value.kind == "U":
        letters = np.frombuffer(data, dtype=np.dtype(np.uint32).newbyteorder(dtype.value.byteorder))
        if (letters > sys.maxunicode).any():
            refuse("an array of text holds what is no text")
    # Read-only, and no copy: one piece of content can be named by many arrays.
    content = memoryview(data).toreadonly()
    flat = np.frombuffer(content, dtype=dtype.value) if size else np.empty(0, dtype=dtype.value)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _not_callable(*_: object) -> NoReturn:
    refuse("numpy writes no call of numpy.ndarray")


def _reconstruct(*_: object) -> PickledArray:
    # Its arguments say "an empty array"; all that matters comes with the state.
    return PickledArray()


def _from_buffer(
    data: object, dtype: object, shape: object, order: object, axes: tuple[int, ...] | None = None
) -> PickledArray:
    # Protocol 5; order "K" is an array in C order seen along permuted axes.
    made = PickledArray()
    array = _array(data, dtype, shape, decoded(order))
    made.value = array if axes is None else array.transpose(axes)
    return made


def _encode_latin1(text: object, encoding: object) -> bytes:
    # Protocol-2 pickles store bytes as latin-1 text and name codecs.encode to turn them back.
    if not isinstance(text, str) or encoding != "latin1":
        refuse("a codec other than latin1 is not admitted")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    # How protocol-2 pickles write the content of an empty array.
    return b""


#: What arrays are written with, in all of numpy's versions, and the dicts they are put in.
ARRAY_NAMES: Names = {
    ("numpy", "ndarray"): Function(_not_callable),
    ("numpy", "dtype"): Function(lambda name, *_: PickledDtype(name)),
    ("numpy.core.multiarray", "_reconstruct"): Function(_reconstruct),
    ("numpy._core.multiarray", "_reconstruct"): Function(_reconstruct),
    ("numpy.core.numeric", "_frombuffer"): Function(_from_buffer),
    ("numpy._core.numeric", "_frombuffer"): Function(_from_buffer),
    ("_codecs", "encode"): Function(_encode_latin1),
    ("__builtin__", "bytes"): Function(_no_bytes),
    ("collections", "OrderedDict"): Function(lambda: {}),
}
