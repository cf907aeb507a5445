"""Tests of XYZ Euler angles against SciPy."""

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import quaternions_from_euler

ANGLES = arrays(np.float64, st.tuples(st.integers(1, 8), st.just(3)), elements=st.floats(-7.0, 7.0))


@given(ANGLES)
def test_quaternions_are_scipys(angles: npt.NDArray[np.float64]) -> None:
    found, wanted = quaternions_from_euler(angles), Rotation.from_euler("XYZ", angles).as_quat()
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-15)


def test_quaternions_are_bit_equal_to_scipy() -> None:
    angles = np.random.default_rng(5).normal(size=(2000, 3))
    np.testing.assert_array_equal(quaternions_from_euler(angles), Rotation.from_euler("XYZ", angles).as_quat())
    single = angles.astype(np.float32)
    np.testing.assert_array_equal(
        quaternions_from_euler(single),
        Rotation.from_euler("XYZ", single.astype(np.float64)).as_quat(),
        "float32 counts in full",
    )
