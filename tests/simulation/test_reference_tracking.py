"""Tests of the motor models of joints without contact."""

import numpy as np

from handover_marl.config import MotorConfig
from handover_marl.simulation.reference_tracking import MotorModel, simulate_motors

MOTORS = [MotorConfig(1.0, 0.2), MotorConfig(1.0, 0.1)]


def test_errors_fall_by_a_fixed_ratio_in_every_step() -> None:
    model = MotorModel(MOTORS, [0.0, 1.0])
    simulate_motors([model], [np.array([[1.0, 0.0], [1.0, 0.0]], dtype=np.float32)])
    np.testing.assert_allclose(model.trajectory, [[0.2, 0.9], [0.36, 0.81]])
    np.testing.assert_array_equal(model.position, model.trajectory[-1])


def test_results_do_not_depend_on_the_division_of_targets() -> None:
    targets = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    whole, cut = MotorModel(MOTORS, [0.0, 0.0]), MotorModel(MOTORS, [0.0, 0.0])
    simulate_motors([whole], [targets])
    parts = []
    for part in np.split(targets, [1, 8, 30]):
        simulate_motors([cut], [part])
        parts.append(cut.trajectory)
    np.testing.assert_array_equal(whole.trajectory, np.concatenate(parts))


def test_joints_at_rest_stay_and_can_move_again() -> None:
    start = np.float32([0.3, -0.7])
    model = MotorModel(MOTORS, start)
    simulate_motors([model], [np.tile(start, (5, 1))])
    np.testing.assert_array_equal(model.trajectory, np.tile(start, (5, 1)).astype(np.float64))
    simulate_motors([model], [np.array([[0.4, -0.7]], dtype=np.float32)])
    np.testing.assert_allclose(model.trajectory, [[0.32, -0.7]], atol=1e-7)
