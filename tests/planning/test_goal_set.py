"""From grasps to goals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.models.distance_field import field_of
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK
from handover_marl.planning.body_samples import body_samples
from handover_marl.planning.capsules import Capsules
from handover_marl.planning.goal_set import GoalFinder, GoalSet
from handover_marl.planning.grasp_rules import usable
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner import hand_obstacle
from handover_marl.planning.planner_config import HandAvoidance, PlannerConfig
from tests.planning.robots import ARM, LIMITS, START

URDF = SyntheticDataset().panda_urdf
CONFIG = PlannerConfig()


def finder(config: PlannerConfig = CONFIG) -> GoalFinder:
    body = body_samples(URDF, tuple(ARM.link_names), config.points_per_link)
    return GoalFinder(ARM, body, body_samples(URDF, (HAND_LINK, *FINGER_LINKS), 60), START, LIMITS, config)


def grasps(count: int = 12) -> np.ndarray:
    """(n, 7) hand poses around a place in front of the robot, pointing forward, turned about that way."""
    forward = Rotation.from_euler("y", 90.0, degrees=True)
    turns = Rotation.from_euler("z", np.linspace(0.0, 330.0, count)[:, None], degrees=True)
    place = np.tile([0.5, 0.0, 0.5], (count, 1))
    return np.concatenate([place, (forward * turns).as_quat()], axis=1)


@pytest.fixture(scope="module")
def found() -> GoalSet:
    return finder().find(grasps(), [], None)


def test_tails_are_straight_and_end_at_their_grasps(found: GoalSet) -> None:
    assert len(found) > 5
    config = CONFIG.goals
    for step in range(config.tail):
        chain = ARM.chain(found.tails[:, step])
        back = config.standoff / config.tail * (config.tail - 1 - step)
        wanted = grasps()[found.grasps]
        axis = chain.rotations[-1][:, 2]
        np.testing.assert_allclose(chain.origins[-1].T, wanted[:, :3] - back * axis.T, atol=1e-5)
        half_turns = (
            Rotation.from_matrix(chain.rotations[-1].transpose(2, 0, 1)).inv() * Rotation.from_quat(wanted[:, 3:])
        ).as_rotvec()
        # Either as the grasp is, or with the wrist half a turn about the approach.
        off = np.minimum(np.linalg.norm(half_turns, axis=1), np.abs(np.linalg.norm(half_turns, axis=1) - np.pi))
        np.testing.assert_allclose(off, 0.0, atol=1e-5)
        np.testing.assert_allclose(half_turns[:, :2], 0.0, atol=1e-5)


def test_goals_are_within_limits_upright_and_apart(found: GoalSet) -> None:
    assert (found.tails >= LIMITS[0]).all()
    assert (found.tails <= LIMITS[1]).all()
    for number, standoff in enumerate(found.standoffs):
        others = np.delete(found.standoffs, number, axis=0)
        assert np.linalg.norm(others - standoff, axis=1).min() >= CONFIG.goals.diversity
    first = ARM.chain(START[None]).rotations[-1][..., 0]
    for share in (1 / 6, 0.5, 5 / 6):
        turned = ARM.chain(START + share * (found.goals - START)).rotations[-1].transpose(2, 0, 1)
        angle = Rotation.from_matrix(turned @ first.T).magnitude()
        assert angle.max() <= np.radians(120.0) + 1e-9
        assert turned[:, 2, 0].min() >= -0.3


def test_the_same_goals_each_time(found: GoalSet) -> None:
    again = finder().find(grasps(), [], None)
    np.testing.assert_array_equal(again.tails, found.tails)
    np.testing.assert_array_equal(again.grasps, found.grasps)


def wall(x: float) -> Obstacle:
    """Solid from x on, where the wrist is at the standoff."""
    corner = np.array([1.0, 1.0, 1.0])
    field = field_of(lambda points: x - points[:, 0], -corner, corner, 0.02)
    return Obstacle(field, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), 0.2)


def test_goals_in_an_obstacle_are_left_out(found: GoalSet) -> None:
    assert len(finder().find(grasps(), [wall(0.2)], None)) == 0
    assert len(finder().find(grasps(), [wall(0.9)], None)) == len(found)
    slipped = finder(PlannerConfig(unchecked_last=True)).find(grasps(), [wall(0.2)], None)
    assert 0 < len(slipped) <= 5


def test_nothing_in_reach_is_no_goal() -> None:
    far = grasps() + np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert len(finder().find(far, [], None)) == 0
    assert len(finder().find(np.zeros((0, 7)), [], None)) == 0


def test_goals_beside_the_hand_come_first(found: GoalSet) -> None:
    # A rod beside the place: a gripper that opens towards it comes nearer than one turned away.
    rod = Capsules(np.array([[0.58, 0.08, 0.5]]), np.array([[0.75, 0.08, 0.5]]), np.array([0.02]))
    config = PlannerConfig(hand=HandAvoidance(room=0.02))
    assert config.hand is not None
    roomy = finder(config).find(grasps(), [], hand_obstacle(rod, config.hand))
    assert len(roomy) > 0
    assert roomy.rooms.min() >= 0.02
    assert set(roomy.grasps) < set(np.arange(12))
    assert np.isinf(found.rooms).all()


def test_without_room_the_roomiest_is_kept() -> None:
    rod = Capsules(np.array([[0.6, 0.0, 0.5]]), np.array([[0.62, 0.0, 0.5]]), np.array([0.08]))
    config = PlannerConfig(hand=HandAvoidance())
    assert config.hand is not None
    cramped = finder(config).find(grasps(), [], hand_obstacle(rod, config.hand))
    assert len(cramped) >= 1
    assert cramped.rooms.max() < config.hand.room


def test_rules_of_single_objects() -> None:
    level = Rotation.identity()
    tilted = Rotation.from_euler("y", 40.0, degrees=True)
    poses = np.array([[0.0, 0.05, 0.1, *turn.as_quat()] for turn in (level, tilted)])
    assert usable("024_bowl", poses).tolist() == [False, True]
    assert usable("025_mug", poses).tolist() == [False, True]
    assert usable("003_cracker_box", poses).tolist() == [True, True]
    assert usable("037_scissors", poses).tolist() == [False, True]
    near = poses.copy()
    near[:, 2] = -0.08
    assert not usable("037_scissors", near).any()
    aside = poses.copy()
    aside[:, 0] = -0.06
    assert not usable("037_scissors", aside).any()
