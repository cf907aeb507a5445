"""Emulation of the PyTorch device "cuda" on the processor, for tests of code that runs on a GPU.

Tensors of this device are in the processor's memory. They cannot be converted to NumPy arrays before `cpu()`, and no
function takes them together with NumPy arrays or with tensors of the processor, except for numbers.
"""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("cuda")


class DeviceTensor(torch.Tensor):
    """Tensor of the device."""

    @property
    def device(self) -> Any:
        """The device."""
        return DEVICE

    def cpu(self) -> Any:
        """Return a copy on the processor."""
        with torch._C.DisableTorchFunctionSubclass():
            return self.as_subclass(torch.Tensor).clone()

    def __array__(self, *arguments: object, **options: object) -> Any:
        """Raise the error of tensors on a GPU."""
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    numpy = __array__


class FakeDevice(TorchFunctionMode):
    """Context in which PyTorch creates and computes tensors of the device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = dict(kwargs or {})
        leaves = [one for one in tree_leaves((args, options)) if isinstance(one, (torch.Tensor, np.ndarray))]
        is_on_device = any(isinstance(one, DeviceTensor) for one in leaves)
        if options.get("device") is not None:
            is_copied, is_on_device = not is_on_device, torch.device(options["device"]).type == DEVICE.type
            result = func(*args, **{**options, "device": "cpu"})
            # Memory of the processor is not that of the device.
            result = result.clone() if is_copied else result
        elif is_on_device and any(one.ndim for one in leaves if not isinstance(one, DeviceTensor)):
            raise RuntimeError(f"{func} got arrays of the device and of the processor")
        else:
            result = func(*args, **options)
        kind = DeviceTensor if is_on_device else torch.Tensor
        return tree_map(lambda one: one.as_subclass(kind) if isinstance(one, torch.Tensor) else one, result)
