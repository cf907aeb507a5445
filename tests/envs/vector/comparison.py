"""Comparison of results on a device with results as NumPy arrays."""

from typing import Any

import numpy as np
import pytest

from handover_marl.geometry.arrays import to_numpy
from tests.helpers.fake_device import DeviceTensor


def assert_same(found: Any, expected: Any, is_on_device: bool = True) -> None:
    """Compare a result on a device with a result as NumPy arrays.

    Args:
        found: Tensors on the device, in dictionaries, tuples and arrays of objects.
        expected: NumPy arrays in the same containers.
        is_on_device: Whether arrays must be on the device; the mask of an array of objects must not.
    """
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            assert_same(found[key], value, is_on_device and key != "_final_obs")
    elif isinstance(expected, (tuple, list)):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other, is_on_device)
    elif isinstance(expected, np.ndarray) and expected.dtype == object:
        assert type(found) is np.ndarray
        assert_same(list(found), list(expected), is_on_device)
    elif isinstance(expected, (np.ndarray, np.generic)):
        assert isinstance(found, DeviceTensor if is_on_device else np.ndarray)
        values = to_numpy(found)
        assert (values.dtype, values.shape) == (expected.dtype, expected.shape)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
    else:
        assert type(found) is type(expected)
        assert found == expected or found == pytest.approx(expected, rel=1e-5, abs=1e-5)
