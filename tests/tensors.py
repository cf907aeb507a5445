"""Tensors for tests that run without a GPU."""

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import ArrayFactory, make_tensor_factory, to_numpy
from handover_marl.policies.batch import ObserveFunction


@contextlib.contextmanager
def make_strict_tensors() -> Iterator[ArrayFactory]:
    """Yield the creator of tensors that NumPy refuses, as those on a GPU, unless they are copied with `Tensor.cpu`."""
    torch: Any = pytest.importorskip("torch")
    original = torch.Tensor.__array__

    class HostTensor(torch.Tensor):  # type: ignore[misc]
        __array__ = original
        __torch_function__ = torch._C._disabled_torch_function_impl

    def refuse(*_: object) -> None:
        raise TypeError("NumPy cannot read this tensor; copy it with to_numpy()")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.Tensor, "__array__", refuse)
        patch.setattr(torch.Tensor, "cpu", lambda tensor: tensor.as_subclass(HostTensor))
        yield make_tensor_factory("cpu")


def make_observe_function(observation: Observation, arrays: ArrayFactory) -> ObserveFunction:
    """Return the function that selects rows of an observation, in the namespace of `arrays`."""
    return lambda rows: {key: arrays.asarray(values[to_numpy(rows)]) for key, values in observation.items()}
