"""Tests that an agent that writes into the arrays of its observations does not change what the other one observes."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.givers.reactions import CooperativeGiver
from handover_marl.receivers.baselines import HoldReceiver
from tests.envs.test_handover_env import START

pytestmark = pytest.mark.slow

STEPS = 32


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


def rollout(agent: str, partner: Any, scribbles: bool) -> list[dict[str, np.ndarray]]:
    """Simulate random actions of one agent, which may overwrite its observations, and return copies of these."""
    env = handover_marl.freeze(
        handover_marl.parallel_env(dataset="synthetic", physics="fast", split="test"), agent, partner
    )
    observations: Any = env.reset(seed=0, options={"scene_id": 209})[0]
    start, spread = (START, 0.1) if agent == "receiver" else (np.zeros(8), 0.3)
    rng, found = np.random.default_rng(0), []
    for _ in range(STEPS):
        found.append({key: value.copy() for key, value in observations[agent].items()})
        action = start + spread * rng.uniform(-1.0, 1.0, len(start))
        action[7:] = start[7:]
        if scribbles:
            spoil(observations[agent])
        observations = env.step({agent: action.astype(np.float32)})[0]
    assert env.agents
    env.close()
    return found


@pytest.mark.parametrize(
    ("agent", "partner", "scribbling_partner"),
    [("receiver", CooperativeGiver, ScribblingGiver), ("giver", NoddingReceiver, ScribblingReceiver)],
)
def test_neither_a_live_nor_a_frozen_agent_spoils_what_the_other_sees(
    agent: str, partner: Any, scribbling_partner: Any
) -> None:
    clean = rollout(agent, partner, False)
    assert any((first["object_poses"] != clean[0]["object_poses"]).any() for first in clean)
    # Both agents overwrite their arrays; the arrays of either one would change what the other observes and does.
    for expected, found in zip(clean, rollout(agent, scribbling_partner, True), strict=True):
        for key, value in expected.items():
            np.testing.assert_array_equal(found[key], value, err_msg=key)
