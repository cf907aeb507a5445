"""Comparison of results on a device with results as NumPy arrays."""

from typing import Any

import numpy as np

from handover_marl.geometry.arrays import ArrayFactory, to_numpy
from tests.fake_device import DeviceTensor


def move_to_device(values: Any, arrays: ArrayFactory) -> Any:
    """Return the arrays in dictionaries and tuples as tensors on a device."""
    if isinstance(values, dict):
        return {key: move_to_device(value, arrays) for key, value in values.items()}
    if isinstance(values, tuple):
        moved = [move_to_device(value, arrays) for value in values]
        return type(values)(*moved) if hasattr(values, "_fields") else tuple(moved)
    return arrays.asarray(values)


def assert_same(found: Any, expected: Any, on_host: tuple[str, ...] = ("final_obs", "_final_obs")) -> None:
    """Compare a result on a device with a result as NumPy arrays.

    Args:
        found: Tensors on the device, in dictionaries, tuples and arrays of objects.
        expected: NumPy arrays in the same containers.
        on_host: Keys whose values are NumPy arrays in both results.
    """
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            if key in on_host:
                assert type(found[key]) is np.ndarray, key
            assert_same(found[key], value, on_host) if key != "_final_obs" else np.testing.assert_array_equal(
                found[key], value, strict=True
            )
    elif isinstance(expected, (tuple, list)):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other, on_host)
    elif isinstance(expected, np.ndarray) and expected.dtype == object:
        assert_same(list(found), list(expected), on_host)
    elif isinstance(expected, (np.ndarray, np.generic)):
        assert isinstance(found, DeviceTensor)
        values = to_numpy(found)
        assert (values.dtype, values.shape) == (expected.dtype, expected.shape)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
    else:
        assert found == expected
