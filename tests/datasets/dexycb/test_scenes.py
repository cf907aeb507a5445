"""Tests of the conversion of recordings to scenes, against the recorded poses and independent formulas."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.rotations import STRIDE, TagFrame
from handover_marl.datasets.dexycb.scenes import (
    compute_finger_poses,
    compute_hand_trajectory,
    compute_object_trajectory,
    find_first_betas,
    import_scene,
)
from handover_marl.datasets.official import CACHE_FOLDER
from handover_marl.errors import DataFormatError
from tests.datasets.dexycb.raw_files import RawScene, hand_poses, made_up_model, object_poses, tag_pose

MODELS = {side: made_up_model(side, seed) for seed, side in enumerate(("right", "left"))}
MODEL = MODELS["right"]
WRIST = MODEL.locate_wrist([0.5] * 10)
SUBJECT = "20200709-subject-01"


def trajectory(poses: np.ndarray, seed: int = 0) -> np.ndarray:
    return compute_hand_trajectory(poses, TagFrame.from_extrinsics(tag_pose(seed)), MODEL, WRIST, WRIST)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_keyframes_are_the_recorded_ones_in_the_tag_frame(seed: int) -> None:
    """Object, wrist and fingers; the articulated hand rotates about its origin, but MANO rotates about the wrist."""
    poses, pose = object_poses(6, seed=seed)[:, 0], tag_pose(seed)
    tag_from_world = Rotation.from_matrix(pose[:, :3]).inv()
    found = compute_object_trajectory(poses, TagFrame.from_extrinsics(pose))
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


@pytest.mark.parametrize(("first", "last"), [(0, 9), (2, 5)])
def test_frames_without_a_hand_are_zero(first: int, last: int) -> None:
    found = trajectory(hand_poses(10, first, last))
    assert found.dtype == np.float32
    assert found.shape == (361, 51)
    np.testing.assert_array_equal(np.flatnonzero(found.any(axis=1)), np.arange(first * STRIDE, last * STRIDE + 1))


def test_base_angles_are_unwrapped() -> None:
    poses = hand_poses(12)
    start, turn = Rotation.from_matrix(tag_pose()[:, :3]), np.linspace(0.0, 7.0, 12)[:, None]
    poses[:, :3] = (start * Rotation.from_rotvec(turn * [1.0, 0.0, 0.0])).as_rotvec()
    found = trajectory(poses)
    assert found[-1, 3] - found[0, 3] == pytest.approx(7.0, abs=1e-4)
    assert np.abs(np.diff(found[:, 3:6], axis=0)).max() < 0.02


def test_scene_in_the_cache(tmp_path: Path) -> None:
    objects = object_poses(10, 3)
    raw = RawScene(objects=objects, hand=hand_poses(10, 2, 8), side="left", meta={"ycb_ids": [9, 2, 5]})
    sequence = raw.write(tmp_path / "raw", scene_id=42)
    import_scene(sequence, MODELS, find_first_betas([sequence]), tmp_path / "out")
    cache = tmp_path / "out" / CACHE_FOLDER
    assert sorted(path.name for path in cache.iterdir()) == ["meta_042.json", "pose_042.npz"]
    meta = {"name": f"{SUBJECT}/20200709_141754", "ycb_ids": [9, 2, 5], "ycb_grasp_ind": 1, "mano_sides": ["left"]}
    assert (cache / "meta_042.json").read_text() == json.dumps({**meta, "mano_betas": [raw.betas]})
    arrays = dict(np.load(cache / "pose_042.npz", allow_pickle=False))
    assert list(arrays) == ["pose_y", "pose_m"]
    assert all(array.flags.c_contiguous for array in arrays.values())
    tag = TagFrame.from_extrinsics(tag_pose())
    expected = np.stack([compute_object_trajectory(objects[:, k], tag) for k in range(3)], axis=1)
    np.testing.assert_array_equal(arrays["pose_y"], expected)
    assert arrays["pose_m"].shape == (361, 1, 51)
    np.testing.assert_array_equal(np.flatnonzero(arrays["pose_m"].any(axis=(1, 2)))[[0, -1]], [80, 320])
    # A different motion, if only by the sign of a zero, is reported and not overwritten.
    assert arrays["pose_m"][0, 0, 3] == 0.0
    arrays["pose_m"][0, 0, 3] = -0.0
    np.savez_compressed(cache / "pose_042.npz", **arrays)
    before = (cache / "pose_042.npz").read_bytes()
    with pytest.raises(DataFormatError, match=r"pose_042\.npz exists, but differs.*remove it"):
        import_scene(sequence, MODELS, find_first_betas([sequence]), tmp_path / "out")
    assert (cache / "pose_042.npz").read_bytes() == before


def test_base_joint_is_from_the_first_recording(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    scenes = [
        RawScene(name="20200709_100000", betas=[0.1] * 10, mano="one"),
        RawScene(name="20200709_110000", betas=[0.3] * 10, mano="three"),
        RawScene(name="20200709_120000", side="left", betas=[0.2] * 10, mano="two"),
    ]
    sequences = [scene.write(raw, number) for number, scene in enumerate(scenes)]
    first = find_first_betas(sequences)
    assert {key: value[0] for key, value in first.items()} == {(SUBJECT, "right"): 0.1, (SUBJECT, "left"): 0.2}
    base, tag = MODEL.locate_wrist([0.1] * 10), TagFrame.from_extrinsics(tag_pose())
    import_scene(sequences[1], MODELS, first, tmp_path / "out")
    with np.load(tmp_path / "out" / CACHE_FOLDER / "pose_001.npz") as archive:
        expected = compute_hand_trajectory(hand_poses(), tag, MODEL, MODEL.locate_wrist([0.3] * 10), base)
        np.testing.assert_array_equal(archive["pose_m"][:, 0], expected)
    # Recordings that cannot be read are skipped.
    (sequences[0].folder / "meta.yml").write_text("[]")
    assert find_first_betas(sequences)[SUBJECT, "right"][0] == 0.3
