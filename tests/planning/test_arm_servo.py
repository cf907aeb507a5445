"""Commands that make lagging motors keep up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.planning.arm_servo import ArmServo, ServoConfig

GAIN, STEPS = 0.01, 50
vectors = st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7).map(np.array)


def servo(**changes: float) -> ArmServo:
    return ArmServo(ServoConfig(**changes), GAIN, STEPS * 0.001, 0.001)  # type: ignore[arg-type]


def motors(joints: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Where motors that make up a hundredth of their error in a step are after a command."""
    for _ in range(STEPS):
        joints = joints + GAIN * (target - joints)
    return joints


@given(vectors, vectors)
def test_the_arm_arrives_when_it_should(joints: np.ndarray, velocity: np.ndarray) -> None:
    arm = servo(acceleration=1e6)
    target = arm.command(joints, velocity)
    np.testing.assert_allclose(motors(joints, target), joints + 0.05 * velocity, atol=1e-9)


@given(vectors, vectors)
def test_speed_changes_no_faster_than_allowed(first: np.ndarray, second: np.ndarray) -> None:
    arm = servo(acceleration=10.0)
    arm.command(np.zeros(7), first)
    before = arm.velocity.copy()
    assert np.abs(before).max() <= 0.5 + 1e-9
    arm.command(np.zeros(7), second)
    assert np.abs(arm.velocity - before).max() <= 0.5 + 1e-9
    arm.reset()
    assert not arm.velocity.any()


@given(vectors)
def test_limits_keep_the_direction(velocity: np.ndarray) -> None:
    arm = servo()
    limited = arm.limited(velocity)
    assert (np.abs(limited) <= arm.limits + 1e-9).all()
    np.testing.assert_allclose(limited * np.abs(velocity).max(), velocity * np.abs(limited).max(), atol=1e-9)
    np.testing.assert_allclose(arm.limited(limited), limited, rtol=1e-12)


def test_it_comes_to_rest_at_the_goal() -> None:
    arm = servo()
    joints, goal = np.zeros(7), np.array([1.0, -0.5, 0.2, 0.0, 0.3, -0.8, 0.1])
    ways = []
    for _ in range(60):
        velocity = arm.limited(arm.towards(joints, goal))
        joints = motors(joints, arm.command(joints, velocity))
        ways.append(goal - joints)
    assert np.abs(ways[-1]).max() < 1e-3
    # Past the goal only a little.
    assert (np.array(ways)[:, 0] > -0.02).all()
    assert (np.array(ways)[:, 1] < 0.02).all()


def test_it_goes_as_fast_as_it_may() -> None:
    arm = servo()
    joints, goal = np.zeros(7), np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    steps = 0
    while goal[0] - joints[0] > 0.05 and steps < 100:
        joints = motors(joints, arm.command(joints, arm.limited(arm.towards(joints, goal))))
        steps += 1
    assert steps * 0.05 == pytest.approx(2.0 / 2.175, abs=0.35)
