"""Tests of the conversion of recordings to scenes, against the recorded poses and independent formulas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.mano_rotations import STRIDE, TagFrame
from handover_marl.datasets.dexycb.scenes import (
    compute_finger_poses,
    compute_hand_trajectory,
    compute_object_trajectory,
)
from tests.datasets.dexycb.raw_files import hand_poses, made_up_model, object_poses, tag_pose

MODELS = {side: made_up_model(side, seed) for seed, side in enumerate(("right", "left"))}
MODEL = MODELS["right"]
WRIST = MODEL.locate_wrist([0.5] * 10)


def trajectory(poses: np.ndarray, seed: int = 0) -> np.ndarray:
    return compute_hand_trajectory(poses, TagFrame(tag_pose(seed)), MODEL, WRIST, WRIST)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_keyframes_are_the_recorded_ones_in_the_tag_frame(seed: int) -> None:
    """Object, wrist and fingers; the articulated hand rotates about its origin, but MANO rotates about the wrist."""
    poses, pose = object_poses(6, seed=seed)[:, 0], tag_pose(seed)
    tag_from_world = Rotation.from_matrix(pose[:, :3]).inv()
    found = compute_object_trajectory(poses, TagFrame(pose))
    assert found.dtype == np.float32
    assert found.shape == (201, 6)
    keys = found[::STRIDE].astype(np.float64)
    np.testing.assert_allclose(keys[:, :3], (poses[:, 4:] - pose[:, 3]) @ pose[:, :3], atol=1e-5)
    expected = tag_from_world * Rotation.from_quat(poses[:, :4])
    assert (Rotation.from_euler("XYZ", keys[:, 3:]) * expected.inv()).magnitude().max() < 1e-5
    hand = hand_poses(6, seed=seed)
    found = trajectory(hand, seed)[::STRIDE].astype(np.float64)
    base = Rotation.from_euler("XYZ", found[:, 3:6])
    recorded = (hand[:, 48:].astype(np.float64) + WRIST - pose[:, 3]) @ pose[:, :3]
    np.testing.assert_allclose(found[:, :3] + base.apply(WRIST), recorded, atol=2e-5)
    assert (base * (tag_from_world * Rotation.from_rotvec(hand[:, :3])).inv()).magnitude().max() < 1e-5
    vectors = hand[:, 3:48] @ MODEL.hands_components + MODEL.hands_mean
    np.testing.assert_allclose(compute_finger_poses(MODEL, hand[:, 3:48]), vectors, atol=1e-4)
    fingers = Rotation.from_euler("XYZ", found[:, 6:].reshape(-1, 3))
    assert (fingers * Rotation.from_rotvec(vectors.reshape(-1, 3)).inv()).magnitude().max() < 1e-3


def test_base_angles_are_unwrapped() -> None:
    poses = hand_poses(12)
    start, turn = Rotation.from_matrix(tag_pose()[:, :3]), np.linspace(0.0, 7.0, 12)[:, None]
    poses[:, :3] = (start * Rotation.from_rotvec(turn * [1.0, 0.0, 0.0])).as_rotvec()
    found = trajectory(poses)
    assert found[-1, 3] - found[0, 3] == pytest.approx(7.0, abs=1e-4)
    assert np.abs(np.diff(found[:, 3:6], axis=0)).max() < 0.02
