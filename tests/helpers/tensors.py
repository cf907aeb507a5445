"""Tensors for tests that run without a GPU."""

import contextlib
from collections.abc import Iterator

import pytest

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import ArrayFactory, make_tensor_factory, to_numpy
from handover_marl.policies.batch import ObserveFunction


@contextlib.contextmanager
def make_device_tensors() -> Iterator[ArrayFactory]:
    """Yield the factory of tensors on an emulated GPU, which refuses what a GPU refuses; see `fake_device`."""
    pytest.importorskip("torch")
    from tests.helpers.fake_device import DEVICE, FakeDevice

    with FakeDevice():
        yield make_tensor_factory(DEVICE.type)


def make_observe_function(observation: Observation, arrays: ArrayFactory) -> ObserveFunction:
    """Return the function that selects rows of an observation, in the namespace of `arrays`."""
    return lambda rows: {key: arrays.asarray(values[to_numpy(rows)]) for key, values in observation.items()}
