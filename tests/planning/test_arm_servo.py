"""Tests of velocity control by position targets."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.planning.arm_control import ArmServo, ServoConfig

GAIN, STEPS = 0.01, 50
vectors = st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7).map(np.array)


def servo(**changes: float) -> ArmServo:
    return ArmServo(ServoConfig(**changes), GAIN, STEPS * 0.001, 0.001)  # type: ignore[arg-type]


def simulate_motors(joints: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the joints after one command to motors that correct 1 % of their error per step."""
    for _ in range(STEPS):
        joints = joints + GAIN * (target - joints)
    return joints


@given(vectors, vectors)
def test_targets_compensate_for_the_lag(joints: np.ndarray, velocity: np.ndarray) -> None:
    arm = servo(max_acceleration=1e6)
    target = arm.compute_motor_targets(joints, velocity)
    np.testing.assert_allclose(simulate_motors(joints, target), joints + 0.05 * velocity, atol=1e-9)


@given(vectors, vectors)
def test_acceleration_is_limited(first: np.ndarray, second: np.ndarray) -> None:
    arm = servo(max_acceleration=10.0)
    arm.compute_motor_targets(np.zeros(7), first)
    before = arm.velocity.copy()
    assert np.abs(before).max() <= 0.5 + 1e-9
    arm.compute_motor_targets(np.zeros(7), second)
    assert np.abs(arm.velocity - before).max() <= 0.5 + 1e-9
    arm.reset()
    assert not arm.velocity.any()


@given(vectors)
def test_speed_limits_keep_the_direction(velocity: np.ndarray) -> None:
    arm = servo()
    limit_speed = arm.limit_speed(velocity)
    assert (np.abs(limit_speed) <= arm.max_speeds + 1e-9).all()
    np.testing.assert_allclose(limit_speed * np.abs(velocity).max(), velocity * np.abs(limit_speed).max(), atol=1e-9)
    np.testing.assert_allclose(arm.limit_speed(limit_speed), limit_speed, rtol=1e-12)


def test_brakes_before_the_goal() -> None:
    arm = servo()
    joints, goal = np.zeros(7), np.array([1.0, -0.5, 0.2, 0.0, 0.3, -0.8, 0.1])
    errors = []
    for _ in range(60):
        velocity = arm.limit_speed(arm.compute_goal_velocity(joints, goal))
        joints = simulate_motors(joints, arm.compute_motor_targets(joints, velocity))
        errors.append(goal - joints)
    assert np.abs(errors[-1]).max() < 1e-3
    # Little overshoot.
    assert (np.array(errors)[:, 0] > -0.02).all()
    assert (np.array(errors)[:, 1] < 0.02).all()
