"""Array namespaces: the same code for NumPy arrays and for PyTorch tensors on any device.

A namespace has the functions of the Python array API standard: NumPy, or PyTorch as `array-api-compat` wraps it.
Functions that take arrays use the namespace of their arguments; objects with arrays as state get an `ArrayFactory`.
"""

import contextlib
import functools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

#: NumPy array or PyTorch tensor.
AnyArray: TypeAlias = Any
#: NumPy array or PyTorch tensor of indices.
AnyIndices: TypeAlias = AnyArray
#: NumPy array or PyTorch tensor of integers that are not indices.
AnyIntegers: TypeAlias = AnyArray
#: NumPy array of indices.
Indices: TypeAlias = npt.NDArray[np.int_]


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
    return np


def as_arrays(*values: Any) -> tuple[Any, ...]:
    """Return the common array namespace of values, followed by each value as an array of that namespace.

    If a value is a tensor, all become tensors on its device; tensors must be on one device. Numbers and lists get
    NumPy's type for them, e.g. float64.
    """
    torch = sys.modules.get("torch")
    if torch is None or not any(isinstance(value, torch.Tensor) for value in values):
        return np, *map(np.asarray, values)
    xp = get_namespace(*values)
    (device,) = {value.device for value in values if is_tensor(value)}
    return xp, *(value if is_tensor(value) else xp.asarray(np.asarray(value), device=device) for value in values)


def make_constant(values: tuple[float, ...], like: AnyArray) -> AnyArray:
    """Return numbers as a float64 array (k,) in the namespace and on the device of the array `like`.

    The array is cached and must not be changed.
    """
    return _make_constant(values, like.device if is_tensor(like) else None)


@functools.lru_cache(maxsize=256)
def _make_constant(values: tuple[float, ...], device: Any) -> AnyArray:
    if device is None:
        array = np.array(values, dtype=np.float64)
        array.flags.writeable = False
        return array
    return make_tensor_factory(device).asarray(values, "float64")


def to_numpy(array: AnyArray) -> npt.NDArray[Any]:
    """Return an array as a NumPy array: itself, a view of a tensor on the CPU, or a copy of one on a GPU."""
    return np.asarray(array.detach().cpu() if is_tensor(array) else array)


def to_float64(array: AnyArray) -> AnyArray:
    """Convert an array or tensor to float64."""
    xp = get_namespace(array)
    return xp.astype(array, xp.float64)


def expand_mask(mask: AnyArray, like: AnyArray) -> AnyArray:
    """Append axes of length 1 to a mask (n,), so that it broadcasts to the array `like` (n, ...)."""
    return mask.reshape(-1, *[1] * (like.ndim - 1))


def stack_last(parts: Sequence[AnyArray]) -> AnyArray:
    """Stack arrays of one shape and number type along a new last axis."""
    first = parts[0]
    if not isinstance(first, (np.ndarray, np.generic)):
        return get_namespace(first).stack(parts, axis=-1)
    # Several times as fast as `np.stack`.
    stacked = np.empty((*first.shape, len(parts)), first.dtype)
    for place, part in enumerate(parts):
        stacked[..., place] = part
    return stacked


@contextlib.contextmanager
def use_default_torch_settings() -> Iterator[None]:
    """Compute with PyTorch's initial settings in a `with` block: float32 in full precision, on the CPU, no autocast.

    Results then do not depend on what the program has set. The float type and precision change for all threads.
    """
    import torch

    backends: Any = torch.backends
    # PyTorch before 2.9 has one precision for all devices.
    parts = [backends.mkldnn.matmul, backends.mkldnn.conv] if hasattr(backends.mkldnn, "matmul") else []
    parts += [backends.cuda.matmul] if parts else []
    dtype, precisions = torch.get_default_dtype(), [part.fp32_precision for part in parts]
    precision = None if parts else torch.get_float32_matmul_precision()
    is_on_cpu = torch.get_default_device().type == "cpu"
    try:
        torch.set_default_dtype(torch.float32)
        for part in parts:
            part.fp32_precision = "ieee"
        if precision is not None:
            torch.set_float32_matmul_precision("highest")
        with (
            contextlib.nullcontext() if is_on_cpu else torch.device("cpu"),
            torch.autocast("cpu", enabled=False),
            torch.autocast("cuda", enabled=False),
        ):
            yield
    finally:
        torch.set_default_dtype(dtype)
        for part, before in zip(parts, precisions, strict=True):
            part.fp32_precision = before
        if precision is not None:
            torch.set_float32_matmul_precision(precision)


@contextlib.contextmanager
def disable_gradients() -> Iterator[None]:
    """Compute without gradients and with PyTorch's initial settings in a `with` block.

    Tensors that are made in the block can be changed later, even if the caller is in PyTorch's inference mode.
    """
    import torch

    with use_default_torch_settings(), torch.inference_mode(False), torch.no_grad():
        yield


@dataclass(frozen=True)
class ArrayFactory:
    """Creator of arrays in one namespace and on one device.

    Attributes:
        xp: Array namespace.
        device: Device of the arrays: "cpu" for NumPy, a `torch.device` for PyTorch.
    """

    xp: Any
    device: Any

    def zeros(self, shape: int | tuple[int, ...], dtype: str = "float64") -> AnyArray:
        """Return an array of zeros, or of False with the number type "bool"."""
        return self.xp.zeros(shape, dtype=self._get_dtype(dtype), device=self.device)

    def full(self, shape: int | tuple[int, ...], value: float, dtype: str = "float64") -> AnyArray:
        """Return an array whose entries are all `value`."""
        return self.xp.full(shape, value, dtype=self._get_dtype(dtype), device=self.device)

    def arange(self, count: int) -> AnyArray:
        """Return the integers from 0 to count - 1, int64."""
        return self.xp.arange(count, dtype=self.xp.int64, device=self.device)

    def asarray(self, values: Any, dtype: str | None = None) -> AnyArray:
        """Return values as an array of type `dtype`, None for their own type; NumPy arrays are copied to tensors."""
        own = values if is_tensor(values) else np.asarray(values)
        is_copied = None if is_tensor(own) or self.xp is np else True
        number_type = None if dtype is None else self._get_dtype(dtype)
        return self.xp.asarray(own, dtype=number_type, device=self.device, copy=is_copied)

    def _get_dtype(self, name: str) -> Any:
        return getattr(self.xp, name)


#: Creator of NumPy arrays.
NUMPY_ARRAYS = ArrayFactory(np, "cpu")
#: Indices (1,) of a batch that has one row.
ONLY_ROW = np.zeros(1, dtype=np.int64)
ONLY_ROW.flags.writeable = False


def make_tensor_factory(device: Any) -> ArrayFactory:
    """Return the creator of PyTorch tensors on a device, a PyTorch device or its name, e.g. "cuda"."""
    from array_api_compat import torch as torch_namespace

    xp: Any = torch_namespace
    return ArrayFactory(xp, xp.device(device))


class GrowableArray:
    """Array of rows of one shape that grows: its capacity is at least doubled whenever it is too small.

    Args:
        arrays: Creator of the array.
        shape: Shape of a row.
        dtype: Number type.

    Attributes:
        rows: Array (c, *shape) with the capacity c; its last rows may be unused.
    """

    def __init__(self, arrays: ArrayFactory, shape: tuple[int, ...], dtype: str) -> None:
        self._arrays, self._dtype, self._count = arrays, dtype, 0
        self.rows = arrays.zeros((0, *shape), dtype)

    def extend(self, values: AnyArray) -> int:
        """Append rows (k, *shape), or one row (*shape), and return the index in `rows` of the first new row."""
        new = self._arrays.asarray(values, self._dtype).reshape(-1, *self.rows.shape[1:])
        first, self._count = self._count, self._count + len(new)
        if self._count > len(self.rows):
            missing = max(self._count, 2 * len(self.rows)) - len(self.rows)
            more = self._arrays.zeros((missing, *self.rows.shape[1:]), self._dtype)
            self.rows = self._arrays.xp.concat([self.rows, more])
        self.rows[first : self._count] = new
        return first
