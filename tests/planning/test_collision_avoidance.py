"""Tests of speed and separation monitoring near moving bodies, and of via points around obstacles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.geometry.poses import transform_points
from handover_marl.planning.collision_avoidance import (
    MovingBody,
    PathObstacles,
    SeparationConfig,
    enforce_separation,
    find_via_point,
    is_path_clear,
    select_safe_velocity,
)
from handover_marl.planning.robot_clearance import Spheres, find_closest_arm_points, find_closest_points
from tests.planning.robots import IN_WORLD, START

CONFIG = SeparationConfig()
HAND = IN_WORLD.compute_hand_pose(START)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


def make_body(clearance: float, min_clearance: float, moving: float = 0.0) -> MovingBody:
    """Return a sphere in front of a fingertip that moves along the gripper's axis (m/s)."""
    position = transform_points(HAND, np.array([0.0, 0.05, 0.1126 + clearance + 0.01]))
    axis = transform_points(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3]
    return MovingBody(Spheres(position[None], np.array([0.01])), moving * axis, min_clearance)


def approach_speed(velocity: np.ndarray, body: MovingBody) -> float:
    """Return the rate at which the clearance decreases (m/s), by finite differences."""
    step = 1e-5
    clearances = [
        find_closest_points(IN_WORLD.compute_hand_pose(START + duration * velocity), body.spheres).distance
        for duration in (0.0, step)
    ]
    return (clearances[0] - clearances[1]) / step


@given(vectors, st.floats(0.005, 0.2))
def test_clearance_decreases_slowly(velocity: np.ndarray, clearance: float) -> None:
    body = make_body(clearance, 0.03)
    found = enforce_separation(velocity, IN_WORLD, START, [body], CONFIG)
    distance = find_closest_points(HAND, body.spheres).distance
    assert (
        approach_speed(found, body) <= max((distance - 0.03) / CONFIG.time_constant, -CONFIG.max_evasion_speed) + 5e-3
    )


def test_all_bodies_are_respected() -> None:
    """The robot moves away from both of two spheres that are too close, at a fingertip and beside the forearm."""
    origins, rotations = IN_WORLD.compute_link_frames(START[None])
    cover = origins[0, 4] + rotations[0, 4] @ np.array([0.0, 0.15, -0.05])
    bodies = [MovingBody(Spheres(cover[None], np.array([0.01])), np.zeros(3), 0.03), make_body(0.01, 0.03)]
    found = enforce_separation(np.array([0.5, 0.5, -0.5, 0.5, 0.5, 0.5, 0.5]), IN_WORLD, START, bodies, CONFIG)
    assert approach_speed(found, bodies[1]) < 0.0
    before, after = (
        find_closest_arm_points(IN_WORLD, q, bodies[0].spheres)[0].distance for q in (START, START + 1e-5 * found)
    )
    assert after > before


def test_first_safe_velocity_is_selected() -> None:
    body = make_body(0.05, 0.03)
    towards = np.linalg.pinv(IN_WORLD.compute_jacobian(START)[:3]) @ (
        transform_points(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3]
    )
    wanted = np.array([1.0, 0.5, 0.2, 0.0])[:, None] * towards

    def chosen(reached: np.ndarray) -> np.ndarray:
        return select_safe_velocity(wanted, reached, IN_WORLD, START, [body], 0.0, CONFIG)

    # The clearance may decrease by 2 cm and the slack within the lookahead.
    found = approach_speed(chosen(wanted), body) * CONFIG.lookahead
    assert 0.005 < found <= 0.02 + CONFIG.slack + 1e-3
    # The reached velocity counts: without braking, no candidate is better than the first.
    np.testing.assert_array_equal(chosen(np.repeat(wanted[:1], 4, axis=0)), wanted[0])
    np.testing.assert_array_equal(chosen(wanted[[0, 0, 0, 3]]), wanted[3])


MIDDLE = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.785])
# Joint positions on both sides of MIDDLE, which differ in the first joint.
LEFT, RIGHT = (MIDDLE + side * np.eye(7)[0] for side in (-0.7, 0.7))
#: Spheres far away, and at the hand's position in the middle of the path.
FAR = Spheres(np.array([[5.0, 5.0, 5.0]]), np.array([0.1]))
NEAR = Spheres(IN_WORLD.compute_hand_pose(MIDDLE)[None, :3], np.array([0.05]))
TABLE, CLEARANCE = 0.5, 0.01


def is_clear(joints: np.ndarray, goal: np.ndarray, bodies: Spheres) -> bool:
    return is_path_clear(IN_WORLD, joints, goal, PathObstacles(bodies, TABLE, CLEARANCE))


def test_via_point_avoids_the_obstacle_that_blocks_the_path() -> None:
    assert is_clear(LEFT, RIGHT, FAR)
    assert not is_clear(LEFT, RIGHT, NEAR)
    assert is_clear(LEFT, LEFT + 0.2 * (RIGHT - LEFT), NEAR)
    obstacles = PathObstacles(NEAR, TABLE, CLEARANCE)
    found = find_via_point(IN_WORLD, LEFT, RIGHT, np.zeros((0, 7)), np.full(7, 2.0), obstacles, 24)
    assert found is not None
    assert is_clear(LEFT, found, NEAR)
    assert is_clear(found, RIGHT, NEAR)
    low, high = IN_WORLD.limits
    assert ((found >= low) & (found <= high)).all()
