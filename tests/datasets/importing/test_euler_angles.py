import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.euler_angles import angles_of_matrices, angles_of_rotations

PI = math.pi
ANGLES = st.one_of(st.floats(-4.0, 4.0), st.sampled_from([quarter * PI / 4 for quarter in range(-4, 5)]))

#: Quaternions xyzw, and what SciPy 1.10.1 gave for them. At y = +-pi / 2 only eight digits of y mean anything.
OF_SCIPY = [
    ((1.0, 2.0, 3.0, 4.0), ("-0x1.94441f8f72600p-3", "0x1.a57c0a4edcbdcp-1", "0x1.5f97315254858p+0")),
    ((-3.0, 1.0, 2.0, 1.0), ("-0x1.0468a8ace4df6p+1", "-0x1.759edd04f68e0p-1", "0x1.1b6e192ebbe40p+0")),
    ((1.0, 0.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "0x0.0p+0")),
    ((-1.0, 0.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "0x0.0p+0")),
    ((0.0, 1.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, 0.0, 1.0, 0.0), ("0x0.0p+0", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((0.0, 0.0, 0.0, 1.0), ("0x0.0p+0", "0x0.0p+0", "0x0.0p+0")),
    ((1.0, 1.0, 0.0, 0.0), ("0x1.921fb54442d18p+1", "0x0.0p+0", "-0x1.921fb54442d18p+0")),
    ((0.0, 1.0, 0.0, 1.0), ("0x0.0p+0", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    ((0.0, -1.0, 0.0, 1.0), ("0x0.0p+0", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((1.0, 1.0, 1.0, 1.0), ("0x1.921fb54442d18p+0", "0x1.921fb54442d18p+0", "0x0.0p+0")),
    ((1.0, 0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    # Negative zeros in the matrix must not turn x.
    ((-1.0, -0.0, 1.0, 0.0), ("0x1.921fb54442d18p+1", "-0x1.921fb59ec54b0p+0", "0x0.0p+0")),
    ((0.5, -0.0, 0.5, -0.0), ("0x1.921fb54442d18p+1", "0x1.921fb59ec54b2p+0", "0x0.0p+0")),
    ((0.0, 1.0, 1.0, 0.0), ("-0x1.921fb54442d18p+0", "0x0.0p+0", "-0x1.921fb54442d18p+1")),
    ((-0.5, 0.5, 0.5, 0.25), ("-0x1.d0d6a1369bd34p+0", "-0x1.4045eb6810728p-2", "0x1.d0d6a1369bd34p+0")),
]


@pytest.mark.parametrize(("quaternion", "expected"), OF_SCIPY)
def test_angles_are_those_of_older_scipy(quaternion: tuple[float, ...], expected: tuple[str, ...]) -> None:
    found = angles_of_rotations(Rotation.from_quat([quaternion]))[0]
    # As float32, which is what is kept; the last bits of float64 are the C library's.
    np.testing.assert_array_equal(
        found.astype(np.float32), np.array([float.fromhex(text) for text in expected], dtype=np.float32)
    )


@given(x=ANGLES, y=ANGLES, z=ANGLES)
def test_angles_give_the_rotation_back(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    for angles in (angles_of_rotations(rotation), angles_of_matrices(rotation.as_matrix())):
        again = Rotation.from_euler("XYZ", angles)
        assert (again * rotation.inv()).magnitude()[0] < 1e-6
        assert np.abs(angles[:, 1]).max() <= PI / 2 + 1e-7
        assert np.abs(angles).max() <= PI


@given(x=ANGLES, z=ANGLES, y=st.sampled_from([-PI / 2, PI / 2]))
def test_locked_angles(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    assert angles_of_rotations(rotation)[0, 2] == 0.0
    exact = np.round(Rotation.from_euler("XYZ", [[0.0, y, 0.0]]).as_matrix())
    np.testing.assert_allclose(angles_of_matrices(exact), [[0.0, y, 0.0]], atol=1e-12)


@given(x=st.floats(-3.1, 3.1), y=st.floats(-1.5, 1.5), z=st.floats(-3.1, 3.1))
def test_both_ways_agree_where_they_must(x: float, y: float, z: float) -> None:
    rotation = Rotation.from_euler("XYZ", [[x, y, z]])
    np.testing.assert_allclose(angles_of_rotations(rotation), [[x, y, z]], atol=1e-7)
    np.testing.assert_allclose(angles_of_matrices(rotation.as_matrix()), [[x, y, z]], atol=1e-7)
