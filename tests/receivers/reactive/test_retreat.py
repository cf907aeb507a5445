"""Tests of the retreat."""

import numpy as np
import pytest

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import compose
from handover_marl.geometry.rotations import rotate_points
from handover_marl.planning.arm_control import ArmInWorld, ArmServo
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances
from handover_marl.receivers.reactive.config import ReactiveConfig, RetreatConfig
from handover_marl.receivers.reactive.retreat import DESIRED_CLEARANCE, RetreatController
from handover_marl.receivers.reactive.selector import HOME
from tests.planning.robots import ARM, BASE

GOAL = np.array(ProtocolConfig().goal_center)
LIMITS = np.array(LOWER_LIMITS[:7]) + 0.03, np.array(UPPER_LIMITS[:7]) - 0.03
PERIOD = 0.05
# The start is in front of the waiting pose and to its side.
START = HOME + np.array([0.6, 0.5, 0.0, 0.4, 0.0, 0.0, 0.0])


def simulate_retreat(person: Spheres | None = None, obstacles: Spheres | None = None) -> np.ndarray:
    """Return the hand poses (n, 7) of a retreat of 2.5 s with ideal motors."""
    arm, servo = ArmInWorld(ARM, BASE, LIMITS), ArmServo(ReactiveConfig().servo, 0.01, 0.05, 0.001)
    joints = START.copy()
    held = np.array([[0.0, 0.0, 0.1]])
    retreat = RetreatController(
        arm, servo, GOAL, RetreatConfig(), arm.compute_hand_pose(joints), held, person, obstacles
    )
    hands = [arm.compute_hand_pose(joints)]
    for step in range(50):
        velocity = servo.limit_speed(retreat.compute_velocity(PERIOD * step, joints, hands[-1]))
        joints = np.clip(joints + PERIOD * velocity, *LIMITS)
        hands.append(arm.compute_hand_pose(joints))
    return np.array(hands)


def test_backs_out_straight_and_reaches_the_goal() -> None:
    hands = simulate_retreat()
    back = hands[2, :3] - hands[0, :3]
    assert np.linalg.norm(hands[0, :3] - GOAL) > 0.2
    assert np.linalg.norm(hands[-1, :3] - GOAL) < ProtocolConfig().goal_radius
    approach = rotate_points(hands[0, 3:], np.array([0.0, 0.0, 1.0]))
    assert -back @ approach > 0.7 * np.linalg.norm(back)


@pytest.mark.parametrize("offset", [(0.12, 0.0, 0.0), (0.0, -0.12, 0.0)])
def test_path_is_clear_of_the_hand(offset: tuple[float, float, float]) -> None:
    free = simulate_retreat()
    person = Spheres(free[-1:, :3] + np.array(offset), np.array([0.03]))
    assert compute_grasp_clearances(free, person).min() < DESIRED_CLEARANCE
    other = simulate_retreat(person)
    assert compute_grasp_clearances(other, person).min() > DESIRED_CLEARANCE
    assert np.linalg.norm(other[-1, :3] - GOAL) < ProtocolConfig().goal_radius


def test_held_object_keeps_clear_of_other_objects() -> None:
    free = simulate_retreat()
    tip = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    path = compose(free, tip)[:, :3]
    obstacles = Spheres(path[10][None], np.array([0.04]))
    assert np.linalg.norm(path - obstacles.centers, axis=1).min() < 0.01
    other = simulate_retreat(obstacles=obstacles)
    assert np.linalg.norm(compose(other, tip)[:, :3] - obstacles.centers, axis=1).min() > 0.04
    assert np.linalg.norm(other[-1, :3] - GOAL) < ProtocolConfig().goal_radius
