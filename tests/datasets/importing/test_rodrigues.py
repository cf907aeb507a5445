import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.rodrigues import matrices_from_vectors

VECTORS = st.lists(st.floats(-4.0, 4.0, width=32), min_size=3, max_size=3)


@given(vector=VECTORS)
def test_matrices_of_vectors(vector: list[float]) -> None:
    vectors = np.array([vector], dtype=np.float32)
    found = matrices_from_vectors(vectors)
    assert found.shape == (1, 3, 3)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(found[0] @ found[0].T, np.eye(3), atol=1e-6)


def test_no_rotation_and_hardly_any() -> None:
    vectors = np.array([[0.0, 0.0, 0.0], [1e-30, 0.0, 0.0], [0.0, 1e-22, 0.0], [0.0, 0.0, 1e-4]], dtype=np.float32)
    found = matrices_from_vectors(vectors)
    np.testing.assert_array_equal(found[:2], [np.eye(3)] * 2)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)


def test_angle_and_axis_round_differently() -> None:
    """Values that transforms3d 0.4.2 gave under NumPy 1.23.5; with one sum of squares the eighth digit differs."""
    vectors = np.array([[-0.7454434, -0.04336259, -0.16392876], [0.502127, -0.9361622, -0.81068945]], dtype=np.float32)
    expected = [float.fromhex("0x1.4f7c5caa122b2p-3"), float.fromhex("0x1.8d4af38ed3b14p-2")]
    np.testing.assert_allclose(matrices_from_vectors(vectors)[:, 0, 1], expected, rtol=1e-13)
