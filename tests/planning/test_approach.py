"""The field leads from anywhere near a grasp into it, by steps that a decision allows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose, inverse
from handover_marl.planning.approach import ApproachConfig, steps_to_goals

CONFIG = ApproachConfig()
GOAL = np.array([0.4, 0.1, 0.3, *Rotation.from_euler("xyz", [2.6, 0.3, -0.4]).as_quat()])


def step(hand: np.ndarray, remaining: float = 10.0, config: ApproachConfig = CONFIG) -> np.ndarray:
    return steps_to_goals(hand[None], GOAL[None], np.array([remaining]), config)[0]


def taken(hand: np.ndarray, way: np.ndarray, share: float = 1.0) -> np.ndarray:
    turn = Rotation.from_rotvec(share * Rotation.from_euler("xyz", way[3:]).as_rotvec())
    return compose(hand, np.array([*share * way[:3], *turn.as_quat()]))


@pytest.mark.parametrize("seed", range(8))
def test_it_arrives_even_with_an_arm_that_lags(seed: int) -> None:
    rng = np.random.default_rng(seed)
    away = np.array([*rng.uniform(-0.2, 0.2, 2), -0.35, *Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_quat()])
    hand = compose(GOAL, away)
    for remaining in range(20, 0, -1):
        way = step(hand, remaining)
        assert np.abs(way[:3]).max() <= CONFIG.shift + 1e-9
        assert np.abs(way[3:]).max() <= CONFIG.turn + 1e-9
        hand = taken(hand, way, 0.78)
    left = compose(inverse(GOAL), hand)
    assert np.linalg.norm(left[:3]) < 0.005
    assert Rotation.from_quat(left[3:]).magnitude() < 0.02


def test_it_goes_in_from_the_standoff_in_one_step() -> None:
    way = step(compose(GOAL, np.array([0.0, 0.0, -CONFIG.standoff, 0.0, 0.0, 0.0, 1.0])))
    np.testing.assert_allclose(way, [0.0, 0.0, CONFIG.standoff, 0.0, 0.0, 0.0], atol=1e-9)


def test_it_stops_before_the_standoff_from_farther_away() -> None:
    back = CONFIG.standoff + 0.04
    way = step(compose(GOAL, np.array([0.0, 0.0, -back, 0.0, 0.0, 0.0, 1.0])))
    np.testing.assert_allclose(way[:3], [0.0, 0.0, 0.04], atol=1e-9)


def test_beside_the_grasp_it_draws_back() -> None:
    assert step(compose(GOAL, np.array([0.04, 0.0, -0.02, 0.0, 0.0, 0.0, 1.0])))[2] < -0.02


def test_it_takes_its_time_if_it_is_to() -> None:
    hand = compose(GOAL, np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0, 1.0]))
    early, late = (np.linalg.norm(step(hand, remaining, ApproachConfig(spare=5))[:3]) for remaining in (20.0, 8.0))
    assert early < late <= CONFIG.shift + 1e-9
