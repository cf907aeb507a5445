"""Array namespaces: the same code for NumPy arrays and for PyTorch tensors on any device.

A namespace is that of the Python array API standard, as `array-api-compat` provides it. Functions that take arrays use
the namespace of their arguments; objects with arrays as state get an `ArrayFactory`.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import array_api_compat.numpy as numpy_namespace
import numpy as np
import numpy.typing as npt

#: NumPy array or PyTorch tensor.
AnyArray: TypeAlias = Any


def is_tensor(array: object) -> bool:
    """Return whether an object is a PyTorch tensor."""
    # A tensor exists only if PyTorch has been imported; importing it takes a second.
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(array, torch.Tensor)


def get_namespace(*arrays: object) -> Any:
    """Return the array namespace of PyTorch if an argument is a tensor, else that of NumPy."""
    for array in arrays:
        if type(array) is not np.ndarray and is_tensor(array):
            from array_api_compat import torch as torch_namespace

            return torch_namespace
    return numpy_namespace


def as_arrays(*values: Any) -> tuple[Any, ...]:
    """Return the common namespace of values, and the values as arrays of it, tensors on one device.

    Numbers and lists become float64.
    """
    xp = get_namespace(*values)
    if xp is numpy_namespace:
        return xp, *map(np.asarray, values)
    (device,) = {value.device for value in values if is_tensor(value)}
    return xp, *(value if is_tensor(value) else xp.asarray(np.asarray(value), device=device) for value in values)


def to_numpy(array: AnyArray) -> npt.NDArray[Any]:
    """Return an array as a NumPy array; a tensor on the processor shares its memory, others are copied."""
    return np.asarray(array.detach().cpu() if is_tensor(array) else array)


def stack_last(parts: Sequence[AnyArray]) -> AnyArray:
    """Stack arrays of one shape along a new last axis."""
    first = parts[0]
    xp = get_namespace(first)
    if xp is not numpy_namespace:
        return xp.stack(parts, axis=-1)
    # Several times as fast as `np.stack`.
    stacked = np.empty((*first.shape, len(parts)), first.dtype)
    for place, part in enumerate(parts):
        stacked[..., place] = part
    return stacked


@dataclass(frozen=True)
class ArrayFactory:
    """Creator of arrays in one namespace and on one device.

    Attributes:
        xp: Array namespace.
        device: Device in the namespace's notation.
    """

    xp: Any
    device: Any

    def zeros(self, shape: int | tuple[int, ...], dtype: str = "float64") -> AnyArray:
        """Return an array of zeros (or False)."""
        return self.xp.zeros(shape, dtype=self._get_dtype(dtype), device=self.device)

    def full(self, shape: int | tuple[int, ...], value: float, dtype: str = "float64") -> AnyArray:
        """Return an array of one value."""
        return self.xp.full(shape, value, dtype=self._get_dtype(dtype), device=self.device)

    def arange(self, count: int) -> AnyArray:
        """Return the integers from 0 to count - 1, int64."""
        return self.xp.arange(count, dtype=self.xp.int64, device=self.device)

    def asarray(self, values: Any, dtype: str | None = None) -> AnyArray:
        """Return values as an array, with their own number type by default."""
        own = values if is_tensor(values) else np.asarray(values)
        return self.xp.asarray(own, dtype=None if dtype is None else self._get_dtype(dtype), device=self.device)

    def _get_dtype(self, name: str) -> Any:
        return getattr(self.xp, name)


#: Creator of NumPy arrays.
NUMPY_ARRAYS = ArrayFactory(numpy_namespace, "cpu")


def make_tensor_factory(device: str) -> ArrayFactory:
    """Return the creator of PyTorch tensors on a device, e.g. "cuda"."""
    from array_api_compat import torch as torch_namespace

    xp: Any = torch_namespace
    return ArrayFactory(xp, xp.device(device))
