"""Tests of speed and separation monitoring, which limits joint velocities near moving bodies and the table."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.geometry.poses import transform_points
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.collision_avoidance import (
    MovingBody,
    SeparationConfig,
    enforce_separation,
    select_safe_velocity,
)
from handover_marl.planning.robot_clearance import (
    Spheres,
    find_closest_arm_points,
    find_closest_points,
)
from tests.planning.robots import ARM, LIMITS, START

CONFIG = SeparationConfig()
IN_WORLD = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
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
