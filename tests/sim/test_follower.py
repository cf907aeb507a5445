import numpy as np

from handover_marl.config import MotorConfig
from handover_marl.sim.follower import Follower

MOTORS = [MotorConfig(1.0, 0.2), MotorConfig(1.0, 0.1)]


def test_a_fixed_share_of_the_way_in_every_step() -> None:
    follower = Follower(MOTORS, [0.0, 1.0])
    follower.follow(np.array([[1.0, 0.0], [1.0, 0.0]], dtype=np.float32))
    np.testing.assert_allclose(follower.path, [[0.2, 0.9], [0.36, 0.81]])
    np.testing.assert_array_equal(follower.position, follower.path[-1])


def test_how_targets_are_cut_does_not_matter() -> None:
    targets = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    whole, cut = Follower(MOTORS, [0.0, 0.0]), Follower(MOTORS, [0.0, 0.0])
    whole.follow(targets)
    parts = []
    for part in np.split(targets, [1, 8, 30]):
        cut.follow(part)
        parts.append(cut.path)
    np.testing.assert_array_equal(whole.path, np.concatenate(parts))


def test_what_lies_still_stays_where_it_is_and_can_be_moved_again() -> None:
    start = np.float32([0.3, -0.7])
    follower = Follower(MOTORS, start)
    follower.follow(np.tile(start, (5, 1)))
    np.testing.assert_array_equal(follower.path, np.tile(start, (5, 1)).astype(np.float64))
    follower.follow(np.array([[0.4, -0.7]], dtype=np.float32))
    np.testing.assert_allclose(follower.path, [[0.32, -0.7]], atol=1e-7)
