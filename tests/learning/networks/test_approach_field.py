"""Tests of the approach field."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.networks.approach_field import ApproachFieldConfig, compute_approach_steps

CONFIG = ApproachFieldConfig()
GOAL = np.array([0.4, 0.1, 0.3, *Rotation.from_euler("xyz", [2.6, 0.3, -0.4]).as_quat()])


def step(hand: np.ndarray, remaining: float = 10.0, config: ApproachFieldConfig = CONFIG) -> np.ndarray:
    return compute_approach_steps(hand[None], GOAL[None], np.array([remaining]), config)[0]


def apply_step(hand: np.ndarray, motion: np.ndarray, share: float = 1.0) -> np.ndarray:

    rotation = Rotation.from_rotvec(share * Rotation.from_euler("xyz", motion[3:]).as_rotvec())
    return compose(hand, np.array([*share * motion[:3], *rotation.as_quat()]))


@pytest.mark.parametrize("seed", range(8))
def test_reaches_the_grasp_with_a_lagging_arm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    offset = np.array([*rng.uniform(-0.2, 0.2, 2), -0.35, *Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_quat()])
    hand = compose(GOAL, offset)
    for remaining in range(20, 0, -1):
        motion = step(hand, remaining)
        assert np.abs(motion[:3]).max() <= CONFIG.max_translation + 1e-9
        assert np.abs(motion[3:]).max() <= CONFIG.max_rotation + 1e-9
        hand = apply_step(hand, motion, 0.78)
    error = compose(invert_pose(GOAL), hand)
    assert np.linalg.norm(error[:3]) < 0.005
    assert Rotation.from_quat(error[3:]).magnitude() < 0.02


def test_moves_in_from_the_standoff_in_one_step() -> None:
    motion = step(compose(GOAL, np.array([0.0, 0.0, -CONFIG.standoff, 0.0, 0.0, 0.0, 1.0])))
    np.testing.assert_allclose(motion, [0.0, 0.0, CONFIG.standoff, 0.0, 0.0, 0.0], atol=1e-9)


def test_stops_at_the_standoff() -> None:
    back = CONFIG.standoff + 0.04
    motion = step(compose(GOAL, np.array([0.0, 0.0, -back, 0.0, 0.0, 0.0, 1.0])))
    np.testing.assert_allclose(motion[:3], [0.0, 0.0, 0.04], atol=1e-9)


def test_retreats_beside_the_grasp() -> None:
    assert step(compose(GOAL, np.array([0.04, 0.0, -0.02, 0.0, 0.0, 0.0, 1.0])))[2] < -0.02


def test_pace_depends_on_remaining_decisions() -> None:
    hand = compose(GOAL, np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0, 1.0]))
    early, late = (
        np.linalg.norm(step(hand, remaining, ApproachFieldConfig(spare_steps=5))[:3]) for remaining in (20.0, 8.0)
    )
    assert early < late <= CONFIG.max_translation + 1e-9
