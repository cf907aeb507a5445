"""Tests of the trajectories of bodies without contact."""

import numpy as np

from handover_marl.config import MotorConfig
from handover_marl.simulation.reference_tracking import BodyTrajectory, track_references

MOTORS = [MotorConfig(1.0, 0.2), MotorConfig(1.0, 0.1)]


def test_errors_fall_by_a_fixed_ratio_in_every_step() -> None:
    body = BodyTrajectory(MOTORS, np.float32([0.0, 1.0]))
    track_references([(body, np.float32([[1.0, 0.0], [1.0, 0.0]]), None)])
    np.testing.assert_allclose(body.joints, [[0.0, 1.0], [0.0, 1.0], [0.2, 0.9], [0.36, 0.81]])
    np.testing.assert_array_equal(body.get_joints(1), body.joints[-1])
    # Joints at rest stay, and can move again.
    rest = BodyTrajectory(MOTORS, np.float32([0.3, -0.7]))
    track_references([(rest, np.tile(np.float32([0.3, -0.7]), (5, 1)), None)])
    np.testing.assert_array_equal(rest.joints[2:], np.tile(np.float32([0.3, -0.7]), (5, 1)).astype(np.float64))
    track_references([(rest, np.float32([[0.4, -0.7]]), None)])
    np.testing.assert_allclose(rest.joints[2:], [[0.32, -0.7]], atol=1e-7)


def test_results_do_not_depend_on_the_division_of_targets_or_other_bodies() -> None:
    rng = np.random.default_rng(0)
    targets, present = rng.uniform(-1, 1, (50, 2)).astype(np.float32), rng.random(50) < 0.7
    whole, cut, other = (BodyTrajectory(MOTORS, np.float32([0.0, 0.0])) for _ in range(3))
    track_references([(whole, targets, present)])
    parts = []
    for rows in np.split(np.arange(50), [1, 8, 30]):
        track_references([(other, targets[rows], None), (cut, targets[rows], present[rows])])
        parts.append(cut.joints[2:])
    np.testing.assert_array_equal(whole.joints[2:], np.concatenate(parts))
    np.testing.assert_array_equal(np.isinf(whole.get_positions(0)).all(axis=1), ~present)
    appears = np.flatnonzero(present[1:] & ~present[:-1])[0] + 1
    np.testing.assert_array_equal(whole.get_joints(int(appears)), targets[appears], "absent bodies appear there")
