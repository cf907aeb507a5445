"""Taking an object away."""

from dataclasses import replace

import numpy as np
import pytest

from handover_marl.config import ProtocolConfig
from handover_marl.models.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.models.poses import rotate
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.gripper_room import Balls, rooms
from handover_marl.receivers.reactive.choice import HOME
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig, RetreatConfig
from handover_marl.receivers.reactive.retreat import Retreat
from tests.planning.robots import ARM

GOAL = np.array(ProtocolConfig().goal_center)
BASE = np.array([0.61, -0.5, 0.875, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
LIMITS = np.array(LOWER_LIMITS[:7]) + 0.03, np.array(UPPER_LIMITS[:7]) - 0.03
PERIOD = 0.05
# Before the waiting pose, to the side.
START = HOME + np.array([0.6, 0.5, 0.0, 0.4, 0.0, 0.0, 0.0])


def gone(person: Balls | None = None, config: RetreatConfig | None = None, seconds: float = 2.5) -> np.ndarray:
    """(n, 7) the hand on its way, with motors that follow at once."""
    arm, servo = ArmInWorld(ARM, BASE, LIMITS), ArmServo(ReactiveConfig().servo, 0.01, 0.05, 0.001)
    joints = START.copy()
    held = np.array([[0.0, 0.0, 0.1]])
    retreat = Retreat(arm, servo, GOAL, config or RetreatConfig(), arm.hand(joints), held, person)
    hands = [arm.hand(joints)]
    for step in range(round(seconds / PERIOD)):
        velocity = servo.limited(retreat.velocity(PERIOD * step, joints, hands[-1]))
        joints = np.clip(joints + PERIOD * velocity, *LIMITS)
        hands.append(arm.hand(joints))
    return np.array(hands)


def test_goes_straight_back_first_and_then_to_the_goal() -> None:
    hands = gone()
    back = hands[2, :3] - hands[0, :3]
    assert np.linalg.norm(hands[0, :3] - GOAL) > 0.2
    assert np.linalg.norm(hands[-1, :3] - GOAL) < ProtocolConfig().goal_radius
    approach = rotate(hands[0, 3:], np.array([0.0, 0.0, 1.0]))
    assert -back @ approach > 0.7 * np.linalg.norm(back)


def test_gets_there_though_back_is_the_wrong_way() -> None:
    # As if it had to back out without end: only time ends that.
    config = RetreatConfig(back=100.0)
    assert np.linalg.norm(gone(config=config)[-1, :3] - GOAL) < ProtocolConfig().goal_radius
    never = replace(config, back_time=1000.0, stall=1000.0)
    assert np.linalg.norm(gone(config=never)[-1, :3] - GOAL) > ProtocolConfig().goal_radius


@pytest.mark.parametrize("aside", [(0.12, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.0, -0.12, 0.0)])
def test_passes_beside_the_persons_hand(aside: tuple[float, float, float]) -> None:
    free = gone()
    person = Balls(free[-1:, :3] + np.array(aside), np.array([0.03]))
    assert rooms(free, person).min() < RetreatConfig().room
    other = gone(person)
    assert rooms(other, person).min() > RetreatConfig().room
    assert np.linalg.norm(other[-1, :3] - GOAL) < ProtocolConfig().goal_radius
