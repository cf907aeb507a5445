"""Tests of the capsules of a person's hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import read_link_vertices
from handover_marl.geometry.model_files.urdf import read_urdf_shapes
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.hand_tracker import Capsules, hand_capsules_from_observation
from handover_marl.receivers import WAITING_JOINTS

coordinates = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@given(coordinates, coordinates, coordinates)
def test_capsule_distance_is_axis_distance_minus_radius(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> None:
    capsules = Capsules(start[None], end[None], np.array([0.1]))
    along = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    nearest = np.linalg.norm(along - point, axis=1).min()
    assert capsules.compute_distances(point[None])[0] == pytest.approx(nearest - 0.1, abs=1e-3)


def observe_resting_hand(scene_id: int) -> Observation:
    """Return the observation once the hand has come to rest."""
    episode = Episode("fast")
    episode.reset(SyntheticDataset().load_scene(scene_id))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 2900)
    observation = episode.observe()
    episode.close()
    return observation


@pytest.mark.parametrize("scene_id", [5, 16])
def test_capsules_fill_the_simulated_hand(scene_id: int) -> None:
    observation = observe_resting_hand(scene_id)
    capsules = hand_capsules_from_observation(observation)
    assert capsules is not None
    urdf = SyntheticDataset().load_scene(scene_id).assets.hand
    tree = read_tree(urdf)
    shaped = sorted({shape.link for shape in read_urdf_shapes(urdf, tree, "collision") if shape.link >= 0})
    vertices = read_link_vertices(urdf, "collision", [tree.joints[link].link for link in shaped])
    poses = tree.compute_link_poses(observation["hand_dof_position"][None], shaped)[0]
    surface = np.concatenate([transform_points(pose, points) for pose, points in zip(poses, vertices, strict=True)])
    distances = capsules.compute_distances(surface)
    # The flesh beside the palm's bones lies outside of the capsules; the fingers match them.
    assert np.quantile(distances, 0.9) < 0.012
    assert distances.min() > -0.02
    assert distances.max() < 0.025
    # Fingertips follow the angles of the last joints.
    tips = [index for index, link in enumerate(shaped) if not any(joint.parent == link for joint in tree.joints)]
    assert len(tips) == 5
    for index in tips:
        assert capsules.compute_distances(transform_points(poses[index], vertices[index])).max() < 0.0
