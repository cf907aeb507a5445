"""Tests of XYZ Euler angles against SciPy."""

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import quaternions_from_euler, unwrap_euler

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


@given(ANGLES, arrays(np.float64, 3, elements=st.floats(-7.0, 7.0)))
def test_unwrapped_angles_keep_rotations(angles: npt.NDArray[np.float64], before: npt.NDArray[np.float64]) -> None:
    found = unwrap_euler(angles, before)
    same = np.abs((quaternions_from_euler(found) * quaternions_from_euler(angles)).sum(axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)
    jumps = np.abs(np.diff(found, axis=0, prepend=before[None])).sum(axis=1)
    recorded = np.abs(angles - np.concatenate([before[None], found[:-1]])).sum(axis=1)
    assert (jumps <= recorded + 1e-9).all()
