"""The person's hand as an obstacle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.meshes import link_vertices
from handover_marl.models.poses import compose_point
from handover_marl.models.urdf_shapes import read_urdf_shapes
from handover_marl.planning.capsules import Capsules, hand_capsules
from handover_marl.receivers import WAITING_JOINTS

coordinates = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@given(coordinates, coordinates, coordinates)
def test_distance_to_a_capsule_is_that_to_its_axis_less_the_radius(
    start: np.ndarray, end: np.ndarray, point: np.ndarray
) -> None:
    capsules = Capsules(start[None], end[None], np.array([0.1]))
    along = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    nearest = np.linalg.norm(along - point, axis=1).min()
    assert capsules.distances(point[None])[0] == pytest.approx(nearest - 0.1, abs=1e-3)


def offered(scene_id: int) -> Observation:
    """What there is to see when the hand has come to rest."""
    episode = Episode("fast")
    episode.reset(SyntheticDataset().scene(scene_id))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 2900)
    observation = episode.observe()
    episode.close()
    return observation


@pytest.mark.parametrize("scene_id", [5, 16])
def test_capsules_fill_the_simulated_hand(scene_id: int) -> None:
    observation = offered(scene_id)
    capsules = hand_capsules(observation)
    assert capsules is not None
    urdf = SyntheticDataset().scene(scene_id).assets.hand
    tree = read_tree(urdf)
    shaped = sorted({shape.link for shape in read_urdf_shapes(urdf, tree, "collision") if shape.link >= 0})
    vertices = link_vertices(urdf, "collision", [tree.joints[link].link for link in shaped])
    poses = tree.poses(observation["hand_dof_position"][None], shaped)[0]
    surface = np.concatenate([compose_point(pose, points) for pose, points in zip(poses, vertices, strict=True)])
    away = capsules.distances(surface)
    # The flesh beside the bones of the palm stands out; fingers are as thick as the capsules, give or take.
    assert np.quantile(away, 0.9) < 0.012
    assert away.min() > -0.02
    assert away.max() < 0.025
    # Fingertips are where the last joints' angles put them.
    tips = [place for place, link in enumerate(shaped) if not any(joint.parent == link for joint in tree.joints)]
    assert len(tips) == 5
    for place in tips:
        assert capsules.distances(compose_point(poses[place], vertices[place])).max() < 0.0


def test_no_hand_no_capsules() -> None:
    observation = offered(5) | {"hand_present": np.zeros(1, dtype=np.float32)}
    assert hand_capsules(observation) is None
