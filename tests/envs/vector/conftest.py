"""Fixtures of vector environments on a device."""

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def emulated_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let Warp simulate and render on the processor, with tensors of an emulated GPU."""
    # Imported here: other tests of this folder need no extra.
    import torch
    import warp

    from handover_marl.simulation.mujoco.batches import warp_model
    from tests.helpers.fake_device import DeviceTensor, FakeDevice

    scoped_device, to_torch, from_torch = warp.ScopedDevice, warp.to_torch, warp.from_torch

    def share(tensor: torch.Tensor, *arguments: Any) -> Any:
        assert isinstance(tensor, DeviceTensor)
        with torch._C.DisableTorchFunctionSubclass():
            return from_torch(tensor.as_subclass(torch.Tensor), *arguments)

    monkeypatch.setattr(warp, "ScopedDevice", lambda _: scoped_device("cpu"))
    monkeypatch.setattr(warp, "to_torch", lambda array: to_torch(array).as_subclass(DeviceTensor))
    monkeypatch.setattr(warp, "from_torch", share)
    monkeypatch.setattr(torch.cuda, "Stream", lambda _: None)
    monkeypatch.setattr(warp_model, "is_device_available", lambda _: True)
    with FakeDevice():
        yield
