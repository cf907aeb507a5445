"""Tests of the planner OMG: goal sets, goal selection and trajectory optimization."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.distance_field import sample_distance_field
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK
from handover_marl.planning import goal_set
from handover_marl.planning.goal_set import GoalSet, GoalSetBuilder, is_usable_grasp
from handover_marl.planning.hand_tracker import Capsules
from handover_marl.planning.planner import Chomp, Planner, PlannerConfig, make_initial_trajectory
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost, sample_body_points
from tests.planning.robots import ARM, LIMITS, START

URDF = SyntheticDataset().panda_urdf
BODY = sample_body_points(URDF, tuple(ARM.link_names), 15)
GOAL = np.array([0.4, 0.2, -0.3, -1.8, 0.3, 2.2, 0.6])
N_APPROACH = 5


def make_cost(obstacles: tuple[Obstacle, ...] = ()) -> ObstacleCost:
    return ObstacleCost(ARM, BODY, obstacles, N_APPROACH)


def make_sphere(center: np.ndarray, radius: float = 0.1, is_hand: bool = False) -> Obstacle:
    corner = np.full(3, radius + 0.25)
    field = sample_distance_field(lambda points: np.linalg.norm(points, axis=1) - radius, -corner, corner, 0.01)
    return Obstacle(field, np.array([*center, 0.0, 0.0, 0.0, 1.0]), 0.2, active_in_approach=is_hand)


def chomp(cost: ObstacleCost) -> Chomp:
    return Chomp(cost, START, LIMITS, 30)


def test_goals_behind_an_obstacle_are_expensive() -> None:
    goals = START + np.array([[0.8], [-0.8]]) * np.eye(7)[0]
    way = ARM.compute_chain_frames((START + 0.5 * np.eye(7)[0])[None])
    cost = make_cost((make_sphere(way.origins[-1][:, 0], 0.05),))
    free = np.zeros((2, 30), dtype=bool)
    blocked, clear = cost.evaluate_lines(START, goals, 30, free)
    assert blocked > 1.3 * clear


def test_approaches_have_no_cost_except_for_the_hand() -> None:
    end = ARM.compute_chain_frames(GOAL[None]).origins[-1][:, 0]
    goals, free = GOAL[None], np.zeros((1, 30), dtype=bool)
    charged = make_cost((make_sphere(end),)).evaluate_lines(START, goals, 30, free)
    free[:, -N_APPROACH:] = True
    assert make_cost((make_sphere(end),)).evaluate_lines(START, goals, 30, free) < charged
    assert make_cost((make_sphere(end, is_hand=True),)).evaluate_lines(START, goals, 30, free) == pytest.approx(charged)


def test_steps_avoid_an_obstacle() -> None:
    path = make_initial_trajectory(START, GOAL, 30)
    place = ARM.compute_chain_frames(path[12:13]).origins[-1][:, 0] + [0.0, 0.0, -0.15]
    optimizer = chomp(make_cost((make_sphere(place),)))
    approach = np.repeat(GOAL[None], N_APPROACH, axis=0)
    before = np.linalg.norm(ARM.compute_chain_frames(path).origins[-1] - place[:, None], axis=0).min()
    for number in range(1, 15):
        path = optimizer.step(path, approach, number)
    after = np.linalg.norm(ARM.compute_chain_frames(path).origins[-1] - place[:, None], axis=0).min()
    assert after > before + 0.02


def make_builder(unchecked_last: bool = False) -> GoalSetBuilder:
    gripper = sample_body_points(URDF, (HAND_LINK, *FINGER_LINKS), 60)
    return GoalSetBuilder(ARM, BODY, gripper, START, LIMITS, unchecked_last)


def grasps(count: int = 12) -> np.ndarray:
    """Return hand poses (n, 7) in front of the robot, pointing forward, with different rotations."""
    forward = Rotation.from_euler("y", 90.0, degrees=True)
    rotations = Rotation.from_euler("z", np.linspace(0.0, 330.0, count)[:, None], degrees=True)
    positions = np.tile([0.5, 0.0, 0.5], (count, 1))
    return np.concatenate([positions, (forward * rotations).as_quat()], axis=1)


@pytest.fixture(scope="module")
def goals() -> GoalSet:
    return make_builder().build(grasps(), [], None)


def test_tails_are_straight_and_end_at_the_grasps(goals: GoalSet) -> None:
    assert len(goals) > 5
    for step in range(goal_set.N_APPROACH):
        chain = ARM.compute_chain_frames(goals.approaches[:, step])
        back = goal_set._STANDOFF / goal_set.N_APPROACH * (goal_set.N_APPROACH - 1 - step)
        wanted = grasps()[goals.grasps]
        axis = chain.rotations[-1][:, 2]
        np.testing.assert_allclose(chain.origins[-1].T, wanted[:, :3] - back * axis.T, atol=1e-5)
        half_turns = (
            Rotation.from_matrix(chain.rotations[-1].transpose(2, 0, 1)).inv() * Rotation.from_quat(wanted[:, 3:])
        ).as_rotvec()
        # Either the grasp, or with the wrist rotated by half a turn.
        off = np.minimum(np.linalg.norm(half_turns, axis=1), np.abs(np.linalg.norm(half_turns, axis=1) - np.pi))
        np.testing.assert_allclose(off, 0.0, atol=1e-5)
        np.testing.assert_allclose(half_turns[:, :2], 0.0, atol=1e-5)


def test_goals_satisfy_all_limits(goals: GoalSet) -> None:
    assert (goals.approaches >= LIMITS[0]).all()
    assert (goals.approaches <= LIMITS[1]).all()
    for number, standoff in enumerate(goals.standoffs):
        others = np.delete(goals.standoffs, number, axis=0)
        assert np.linalg.norm(others - standoff, axis=1).min() >= goal_set._MIN_GOAL_DISTANCE
    first = ARM.compute_chain_frames(START[None]).rotations[-1][..., 0]
    for share in (1 / 6, 0.5, 5 / 6):
        rotated = ARM.compute_chain_frames(START + share * (goals.goals - START)).rotations[-1].transpose(2, 0, 1)
        angle = Rotation.from_matrix(rotated @ first.T).magnitude()
        assert angle.max() <= np.radians(120.0) + 1e-9
        assert rotated[:, 2, 0].min() >= -0.3


def make_wall(x: float) -> Obstacle:
    """Return an obstacle that fills all space at x coordinates above `x` (m); the wrist at the standoff is in it."""
    corner = np.array([1.0, 1.0, 1.0])
    field = sample_distance_field(lambda points: x - points[:, 0], -corner, corner, 0.02)
    return Obstacle(field, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), 0.2)


@pytest.mark.slow
def test_colliding_goals_are_dropped(goals: GoalSet) -> None:
    assert len(make_builder().build(grasps(), [make_wall(0.2)], None)) == 0
    assert len(make_builder().build(grasps(), [make_wall(0.9)], None)) == len(goals)
    unchecked = make_builder(unchecked_last=True).build(grasps(), [make_wall(0.2)], None)
    assert 0 < len(unchecked) <= 5


@pytest.mark.parametrize("avoids_hand", [True, False])
def test_goals_keep_clear_of_the_hand(goals: GoalSet, avoids_hand: bool) -> None:
    # A gripper that opens towards the capsule is closer than one that is rotated away.
    capsule = Capsules(np.array([[0.58, 0.08, 0.5]]), np.array([[0.75, 0.08, 0.5]]), np.array([0.02]))
    planner = Planner(URDF, START, PlannerConfig(n_waypoints=10, avoids_hand=avoids_hand))
    plan = planner.plan(grasps(), [], capsule)
    assert plan is not None
    if avoids_hand:
        assert plan.goals.clearances.min() >= goal_set.MIN_HAND_CLEARANCE
        assert set(plan.goals.grasps) < set(np.arange(12))
    else:
        assert np.isinf(plan.goals.clearances).all()
        assert len(plan.goals) == len(goals)


def test_rules_of_usable_grasps() -> None:
    rotations = Rotation.identity(), Rotation.from_euler("y", 40.0, degrees=True)
    poses = np.array([[0.0, 0.05, 0.1, *rotation.as_quat()] for rotation in rotations])
    for name in ("024_bowl", "025_mug", "037_scissors"):
        assert is_usable_grasp(name, poses).tolist() == [False, True]
    assert is_usable_grasp("003_cracker_box", poses).tolist() == [True, True]
    for column, value in ((2, -0.08), (0, -0.06)):
        moved = poses.copy()
        moved[:, column] = value
        assert not is_usable_grasp("037_scissors", moved).any()
