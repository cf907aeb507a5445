"""Tests of the capsules of a person's hand, and of tracking it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import read_link_vertices
from handover_marl.geometry.model_files.urdf import read_urdf_shapes
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.hand_tracker import Capsules, HandTracker, hand_capsules_from_observation
from tests.helpers.playing import observe_handover

SCENE = SyntheticDataset().load_scene(5)
numbers = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@pytest.fixture(scope="module")
def observation() -> Observation:
    return observe_handover(SCENE, 0)


@given(numbers, numbers, numbers)
def test_capsule_distance_is_axis_distance_minus_radius(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> None:
    capsules = Capsules(start[None], end[None], np.array([0.1]))
    along = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    nearest = np.linalg.norm(along - point, axis=1).min()
    assert capsules.compute_distances(point[None])[0] == pytest.approx(nearest - 0.1, abs=1e-3)


def test_capsules_fill_the_simulated_hand(observation: Observation) -> None:
    capsules, urdf = hand_capsules_from_observation(observation), SCENE.assets.hand
    assert capsules is not None
    tree = read_tree(urdf)
    shaped = sorted({shape.link for shape in read_urdf_shapes(urdf, tree, "collision") if shape.link >= 0})
    vertices = read_link_vertices(urdf, "collision", [tree.joints[link].link for link in shaped])
    poses = tree.compute_link_poses(observation["hand_dof_position"][None], shaped)[0]
    surfaces = [transform_points(pose, points) for pose, points in zip(poses, vertices, strict=True)]
    distances = capsules.compute_distances(np.concatenate(surfaces))
    # The flesh beside the palm's bones lies outside of the capsules; the fingers match them.
    assert np.quantile(distances, 0.9) < 0.012
    assert -0.02 < distances.min() < distances.max() < 0.025
    # Fingertips follow the angles of the last joints.
    tips = [index for index, link in enumerate(shaped) if not any(joint.parent == link for joint in tree.joints)]
    assert len(tips) == 5
    assert max(capsules.compute_distances(surfaces[index]).max() for index in tips) < 0.0


@pytest.mark.slow
@given(numbers, numbers, numbers)
def test_attached_pose_moves_with_the_hand(
    observation: Observation, translation: np.ndarray, rotation_vector: np.ndarray, position: np.ndarray
) -> None:
    tracker, rotation = HandTracker(), Rotation.from_rotvec(rotation_vector)
    tracker.update(0.0, observation)
    before = tracker.points.copy()
    center = before.mean(axis=0)
    tracker.update(0.1, {**observation, "hand_keypoints": center + translation + rotation.apply(before - center)})
    pose = np.concatenate([position, [0.0, 0.0, 0.0, 1.0]])
    found = tracker.predict_attached_pose(before, pose, 0.0)
    np.testing.assert_allclose(found[:3], center + translation + rotation.apply(position - center), atol=1e-4)
    assert abs(float(found[3:] @ rotation.as_quat())) == pytest.approx(1.0, abs=1e-5)
    # Without a hand the pose stays.
    tracker.update(0.2, {**observation, "hand_present": np.zeros(1, dtype=np.float32)})
    np.testing.assert_array_equal(tracker.predict_attached_pose(before, pose, 0.1), pose)
    assert tracker.spheres is None
