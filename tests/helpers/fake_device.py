"""Emulation of the PyTorch device "cuda" on the processor, for tests of code that runs on a GPU.

Tensors of this device are in the processor's memory. They cannot be converted to NumPy arrays before `cpu()`, and no
function takes them together with NumPy arrays or with tensors of the processor, except for numbers.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map

DEVICE = torch.device("cuda")


class DeviceTensor(torch.Tensor):
    """Tensor of the emulated device, in the processor's memory."""

    @property
    def device(self) -> Any:
        """Emulated device, "cuda"."""
        return DEVICE

    def cpu(self) -> Any:
        """Return a copy on the processor."""
        with torch._C.DisableTorchFunctionSubclass():
            return self.as_subclass(torch.Tensor).clone()

    def __array__(self, *arguments: object, **options: object) -> Any:
        """Raise the error of tensors on a GPU."""
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    numpy = __array__


def list_arrays(values: Iterable[Any]) -> list[Any]:
    """Return the tensors and NumPy arrays in arguments of a function; general tools for trees are much slower."""
    found: list[Any] = []
    for value in values:
        if isinstance(value, (torch.Tensor, np.ndarray)):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += list_arrays(value)
        elif isinstance(value, dict):
            found += list_arrays(value.values())
    return found


class FakeDevice(TorchFunctionMode):
    """Context in which PyTorch creates and computes tensors of the device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options, arrays = {}, list_arrays(args)
        if kwargs:
            options, arrays = dict(kwargs), arrays + list_arrays(kwargs.values())
        others = [one for one in arrays if not isinstance(one, DeviceTensor)]
        is_on_device, is_copied = len(others) < len(arrays), False
        if options.get("device") is not None:
            is_copied, is_on_device = not is_on_device, torch.device(options["device"]).type == DEVICE.type
            options["device"] = "cpu"
        elif is_on_device and others and any(one.ndim for one in others):
            raise RuntimeError(f"{func} got arrays of the device and of the processor")
        # The kind of the result is chosen below.
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **options)
            # Memory of the processor is not that of the device.
            result = result.clone() if is_copied else result
            kind = DeviceTensor if is_on_device else torch.Tensor
            if isinstance(result, torch.Tensor):
                return result if type(result) is kind else result.as_subclass(kind)
        if isinstance(result, (bool, int, float, torch.Size, torch.dtype)):
            return result
        return tree_map(lambda one: one.as_subclass(kind) if isinstance(one, torch.Tensor) else one, result)
