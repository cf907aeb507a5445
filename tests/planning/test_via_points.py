"""Tests of via points around obstacles."""

import numpy as np

from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.collision_avoidance import PathObstacles, find_via_point, is_path_clear
from handover_marl.planning.robot_clearance import Spheres
from tests.planning.robots import ARM, LIMITS

ARM_ = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
SPEEDS = np.full(7, 2.0)
START = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.785])
FAR, TABLE, CLEARANCE = Spheres(np.array([[5.0, 5.0, 5.0]]), np.array([0.1])), 0.5, 0.01
# Joint positions on both sides of START, which differ in the first joint.
LEFT, RIGHT = (START + side * np.eye(7)[0] for side in (-0.7, 0.7))
NO_CANDIDATES = np.zeros((0, 7))


def blocking_sphere() -> Spheres:
    """Return a sphere at the hand's position in the middle of the path."""
    return Spheres(ARM_.compute_hand_pose(START)[None, :3], np.array([0.05]))


def obstacles(bodies: Spheres) -> PathObstacles:
    return PathObstacles(bodies, TABLE, CLEARANCE)


def is_clear(joints: np.ndarray, goal: np.ndarray, bodies: Spheres, table: float = TABLE) -> bool:
    return is_path_clear(ARM_, joints, goal, PathObstacles(bodies, table, CLEARANCE))


def test_obstacle_blocks_the_path() -> None:
    assert is_clear(LEFT, RIGHT, FAR)
    assert not is_clear(LEFT, RIGHT, blocking_sphere())
    assert is_clear(LEFT, LEFT + 0.2 * (RIGHT - LEFT), blocking_sphere())


def test_via_point_avoids_the_obstacle() -> None:
    found = find_via_point(ARM_, LEFT, RIGHT, NO_CANDIDATES, SPEEDS, obstacles(blocking_sphere()), 24)
    assert found is not None
    assert is_clear(LEFT, found, blocking_sphere())
    assert is_clear(found, RIGHT, blocking_sphere())
    low, high = ARM_.limits
    assert ((found >= low) & (found <= high)).all()
