"""Tests of arm kinematics in the world frame, and of velocity control by position targets."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.planning.arm_control import ArmInWorld, ArmServo, ServoConfig

ARM = ArmInWorld.for_panda(SyntheticDataset().panda_urdf, OFFICIAL_CONFIG.physics.panda)
JOINTS = np.array([0.2, 0.1, -0.3, -2.0, 0.4, 2.1, 0.5])
GAIN, STEPS = 0.01, 50
vectors = st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7).map(np.array)


def test_velocity_moves_the_hand_as_wanted_within_joint_limits() -> None:
    linear, angular = np.array([0.1, -0.2, 0.05]), np.array([0.2, 0.0, -0.1])
    velocity = ARM.compute_joint_velocity(JOINTS, linear, angular, 1.0, 0.05)
    np.testing.assert_allclose(ARM.compute_jacobian(JOINTS) @ velocity, [*linear, *angular], atol=0.02)
    worst, joints = int(np.argmax(np.abs(velocity))), JOINTS.copy()
    joints[worst] = ARM.limits[1][worst] if velocity[worst] > 0 else ARM.limits[0][worst]
    after = joints + 0.05 * ARM.compute_joint_velocity(joints, linear, angular, 1.0, 0.05)
    assert ((after >= ARM.limits[0] - 1e-9) & (after <= ARM.limits[1] + 1e-9)).all()


def make_servo(**changes: float) -> ArmServo:
    return ArmServo(ServoConfig(**changes), GAIN, STEPS * 0.001, 0.001)  # type: ignore[arg-type]


def simulate_motors(joints: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the joints after one command to motors that correct 1 % of their error per step."""
    for _ in range(STEPS):
        joints = joints + GAIN * (target - joints)
    return joints


@given(vectors, vectors)
def test_targets_compensate_for_the_lag(joints: np.ndarray, velocity: np.ndarray) -> None:
    target = make_servo(max_acceleration=1e6).compute_motor_targets(joints, velocity)
    np.testing.assert_allclose(simulate_motors(joints, target), joints + 0.05 * velocity, atol=1e-9)


@given(vectors, vectors)
def test_acceleration_and_speed_are_limited(first: np.ndarray, second: np.ndarray) -> None:
    servo = make_servo(max_acceleration=10.0)
    servo.compute_motor_targets(np.zeros(7), first)
    before = servo.velocity.copy()
    assert np.abs(before).max() <= 0.5 + 1e-9
    servo.compute_motor_targets(np.zeros(7), second)
    assert np.abs(servo.velocity - before).max() <= 0.5 + 1e-9
    servo.reset()
    assert not servo.velocity.any()
    limited = servo.limit_speed(first)
    assert (np.abs(limited) <= servo.max_speeds + 1e-9).all()
    np.testing.assert_allclose(limited * np.abs(first).max(), first * np.abs(limited).max(), atol=1e-9)


def test_brakes_before_the_goal() -> None:
    servo, joints, goal = make_servo(), np.zeros(7), np.array([1.0, -0.5, 0.2, 0.0, 0.3, -0.8, 0.1])
    errors = []
    for _ in range(60):
        velocity = servo.limit_speed(servo.compute_goal_velocity(joints, goal))
        joints = simulate_motors(joints, servo.compute_motor_targets(joints, velocity))
        errors.append(goal - joints)
    assert np.abs(errors[-1]).max() < 1e-3
    assert (np.array(errors) * np.sign(goal) > -0.02).all(), "little overshoot"
