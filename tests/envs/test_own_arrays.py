"""Tests that an agent that writes into the arrays of its observations does not change what the other one observes."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.givers.reactions import CooperativeGiver
from handover_marl.receivers.hold import HoldReceiver

pytestmark = pytest.mark.slow

STEPS = 45


class ScribblingGiver(CooperativeGiver):
    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        action = np.array(super().act({key: value.copy() for key, value in observation.items()}))
        spoil(observation)
        return action


class NoddingReceiver(HoldReceiver):
    """Receiver near the start pose, whose first three joints are shifted by 0.2 times the first object's position."""

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        nod = np.float32(0.2) * observation["object_poses"][0, :3]
        return super().act(observation) + np.concatenate([nod, np.zeros(6, dtype=np.float32)])


class ScribblingReceiver(NoddingReceiver):
    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        action = super().act(observation)
        spoil(observation)
        return action


def spoil(observation: dict[str, np.ndarray]) -> None:
    for value in observation.values():
        value[...] = 0.0


def seen_alone(agent: str, partner: Any, scribbles: bool, api: Any) -> list[dict[str, np.ndarray]]:
    """Simulate random actions of one agent and return copies of its observations.

    If `scribbles` is true, the agent overwrites the arrays of each observation.
    """
    world = handover_marl.parallel_env(dataset="synthetic", physics="fast", split="test")
    env = handover_marl.freeze(world, agent, partner, api=api)
    parallel = api == "parallel"
    observation: Any = env.reset(seed=0, options={"scene_id": 209})[0]
    start = np.array(world.config.world_config.physics.panda.start_joints) if agent == "receiver" else np.zeros(8)
    spread = np.array([0.1] * 7 + [0.0, 0.0]) if agent == "receiver" else np.array([0.3] * 7 + [0.0])
    rng, found = np.random.default_rng(0), []
    for _ in range(STEPS):
        mine = observation[agent] if parallel else observation
        found.append({key: value.copy() for key, value in mine.items()})
        action = (start + spread * rng.uniform(-1.0, 1.0, len(spread))).astype(np.float32)
        if scribbles:
            spoil(mine)
        observation, _, ended, timed_out, _ = env.step({agent: action} if parallel else action)
        assert not (any(ended.values()) or any(timed_out.values()) if parallel else ended or timed_out)
    env.close()
    return found


@pytest.mark.parametrize("api", ["parallel", "gymnasium"])
@pytest.mark.parametrize(
    ("agent", "partner", "scribbling_partner"),
    [("receiver", CooperativeGiver, ScribblingGiver), ("giver", NoddingReceiver, ScribblingReceiver)],
)
def test_neither_a_live_nor_a_frozen_agent_spoils_what_the_other_sees(
    agent: str, partner: Any, scribbling_partner: Any, api: str
) -> None:
    clean = seen_alone(agent, partner, False, api)
    assert any((first["object_poses"] != clean[0]["object_poses"]).any() for first in clean)
    # Both agents overwrite their arrays; the arrays of either one would change what the other observes and does.
    spoilt = seen_alone(agent, scribbling_partner, True, api)
    for number, (expected, found) in enumerate(zip(clean, spoilt, strict=True)):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_array_equal(found[key], value, err_msg=f"{key} in step {number}")
