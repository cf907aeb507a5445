import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.rotations import STRIDE, KeyframeSpan, TagFrame
from handover_marl.datasets.dexycb.scenes import (
    compute_finger_poses,
    compute_hand_trajectory,
    compute_object_trajectory,
    find_hand_span,
)
from tests.datasets.dexycb.mano_files import made_up_model
from tests.datasets.dexycb.raw_files import hand_poses, object_poses, tag_pose


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_keyframes_in_the_tag_frame(seed: int) -> None:
    poses, pose = object_poses(6, seed=seed)[:, 0], tag_pose(seed)
    found = compute_object_trajectory(poses, TagFrame.from_extrinsics(pose))
    assert found.shape == (201, 6)
    assert found.dtype == np.float32
    keys = found[::STRIDE].astype(np.float64)
    np.testing.assert_allclose(keys[:, :3], (poses[:, 4:] - pose[:, 3]) @ pose[:, :3], atol=1e-5)
    expected = Rotation.from_matrix(pose[:, :3]).inv() * Rotation.from_quat(poses[:, :4])
    assert (Rotation.from_euler("XYZ", keys[:, 3:]) * expected.inv()).magnitude().max() < 1e-5


MODEL = made_up_model()
WRIST = MODEL.locate_wrist([0.5] * 10)


def trajectory(poses: np.ndarray, seed: int = 0, base: np.ndarray = WRIST) -> np.ndarray:
    return compute_hand_trajectory(poses, TagFrame.from_extrinsics(tag_pose(seed)), MODEL, WRIST, base)


@pytest.mark.parametrize(("first", "last"), [(0, 9), (2, 5)])
def test_frames_without_a_hand_are_zero(first: int, last: int) -> None:
    found = trajectory(hand_poses(10, first, last))
    assert found.shape == (361, 51)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.flatnonzero(found.any(axis=1)), np.arange(first * STRIDE, last * STRIDE + 1))
    assert find_hand_span(hand_poses(10, first, last)) == KeyframeSpan(first, last)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_wrist_position_is_the_recorded_one(seed: int) -> None:
    """The articulated hand has its wrist at the recorded position.

    The articulated hand rotates about its origin, but MANO rotates about the wrist.
    """
    poses, pose = hand_poses(6, seed=seed), tag_pose(seed)
    found = trajectory(poses, seed)[::STRIDE].astype(np.float64)
    base = Rotation.from_euler("XYZ", found[:, 3:6])
    recorded = (poses[:, 48:].astype(np.float64) + WRIST - pose[:, 3]) @ pose[:, :3]
    np.testing.assert_allclose(found[:, :3] + base.apply(WRIST), recorded, atol=2e-5)
    turned = Rotation.from_matrix(pose[:, :3]).inv() * Rotation.from_rotvec(poses[:, :3])
    assert (base * turned.inv()).magnitude().max() < 1e-5


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_finger_rotations_are_the_recorded_ones(seed: int) -> None:
    poses = hand_poses(6, seed=seed)
    vectors = poses[:, 3:48] @ MODEL.hands_components + MODEL.hands_mean
    np.testing.assert_allclose(compute_finger_poses(MODEL, poses[:, 3:48]), vectors, atol=1e-4)
    found = trajectory(poses)[::STRIDE, 6:].reshape(-1, 3)
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3))
    assert (Rotation.from_euler("XYZ", found) * expected.inv()).magnitude().max() < 1e-3


def test_base_angles_are_unwrapped() -> None:
    poses = hand_poses(12)
    start, pose = Rotation.from_matrix(tag_pose()[:, :3]), np.linspace(0.0, 7.0, 12)[:, None]
    poses[:, :3] = (start * Rotation.from_rotvec(pose * [1.0, 0.0, 0.0])).as_rotvec()
    found = trajectory(poses)
    assert found[-1, 3] - found[0, 3] == pytest.approx(7.0, abs=1e-4)
    assert np.abs(np.diff(found[:, 3:6], axis=0)).max() < 0.02
