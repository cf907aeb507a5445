"""Tests of batches of givers, which act as single givers do, on arrays and on tensors."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from handover_marl import givers
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, is_tensor, to_numpy
from handover_marl.policies.batch import ArrayPolicyBatch
from tests.givers.test_givers import seen
from tests.helpers.tensors import make_device_tensors, make_observe_function

pytestmark = pytest.mark.slow

COUNT = 6
NAMES = (
    "replay",
    "hesitant:pauses_per_second=1.5,longest_pause=0.5",
    "hurried:min_rate=-0.4,max_rate=0.2",
    "stop_when_near:distance=0.5",
    "noisy:displacement=0.05,rotation=0,rate=0,time_constant=1",
    "withdrawing:max_speed=0.1,max_distance=0.6,withdrawal=0.3,return_after=0.2",
    *("displaced", "early_release", "interrupting", "recording_spread", "tired", "adaptive:offers=8"),
    "cooperative:approach_share=0.5,min_distance=0.3,max_displacement=0.1,max_rotation=0.3,rate=0.5,withdrawal=0.3",
)


def draw_observations(seed: int, decisions: int) -> Iterator[list[Observation]]:
    """Yield observations in which grippers approach, fingers rest, and objects are released."""
    rng = np.random.default_rng(seed)
    gripper = seen()["gripper_pose"] + np.zeros((COUNT, 7), dtype=np.float32)
    for decision in range(decisions):
        gripper[:, :3] += rng.normal([0.0, 0.012, 0.0], 0.012, (COUNT, 3)).astype(np.float32)
        rests = rng.random(COUNT) < 0.8
        found = []
        for number in range(COUNT):
            changes: Observation = {
                "time": np.float32([0.1 * decision]),
                "gripper_pose": gripper[number].copy(),
                "hand_present": np.float32([decision > 2]),
                "holding": np.float32([decision > 5 + number]),
                "released": np.float32([decision > 45 + number]),
                "robot_joint_position": np.float32([0.0] * 7 + [0.02, 0.02]),
                "robot_joint_velocity": np.full(9, 0.0 if rests[number] else 0.1, dtype=np.float32),
            }
            one = seen(**changes)
            moving = max(0.0, 0.1 - 0.01 * decision)
            one["replay_wrist_poses"] = one["replay_wrist_poses"] + np.float32(moving * np.arange(5)[:, None])
            one["hand_keypoints"] = one["hand_keypoints"] + rng.normal(0, 0.01, (16, 3)).astype(np.float32)
            found.append(one)
        yield found


@pytest.mark.parametrize("name", NAMES)
def test_batches_act_as_single_givers(name: str) -> None:
    """Actions are equal if only some rows decide together, and after resets of single rows."""
    releases = name.startswith(("cooperative", "early_release"))
    with make_device_tensors() as tensors:
        makers = (NUMPY_ARRAYS, tensors)
        own: Any = givers.make(name)
        batches = [ArrayPolicyBatch(own.copy_for(COUNT, arrays), COUNT, "giver", arrays) for arrays in makers]
        singles = [givers.make(name) for _ in range(COUNT)]
        starts, acted = np.zeros(COUNT, dtype=np.int64), []
        for decision, observations in enumerate(draw_observations(1, 60 if releases else 30)):
            observation = {key: np.stack([one[key] for one in observations]) for key in observations[0]}
            for row in range(COUNT) if decision == 0 else [decision // 7] if decision in (7, 14) else []:
                starts[row] = 100 * decision
                # A new giver remembers nothing of the episode before.
                singles[row] = givers.make(name)
                singles[row].reset(10 * decision + row)
                for batch in batches:
                    batch.reset(row, 10 * decision + row, ("025_mug",))
            for rows in (np.array([1, 3, 4, 0]), np.array([5, 2]))[: 1 + (decision % 3 > 0)]:
                expected = np.array([singles[row].act(observations[row]) for row in rows])
                for batch, arrays in zip(batches, makers, strict=True):
                    steps = arrays.asarray(100 * decision - starts[rows])
                    found, _ = batch.act(arrays.asarray(rows), make_observe_function(observation, arrays), steps)
                    assert is_tensor(found) == (arrays is tensors)
                    assert to_numpy(found).dtype == np.float32
                    np.testing.assert_allclose(to_numpy(found), expected, rtol=0, atol=1e-6)
                acted += list(expected)
        if name != "replay":
            assert np.ptp(acted, axis=0).any()
        if releases:
            assert np.array(acted)[..., 7].any(), "no object was released"
