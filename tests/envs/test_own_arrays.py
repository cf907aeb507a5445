"""Tests that an agent that writes into the arrays of its observations does not change what the other one observes."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.givers.reactions import CooperativeGiver
from tests.envs.test_handover_env import START
from tests.episode.test_play import ScribblingGiver
from tests.helpers.equality import assert_equal


def rollout(giver: type[CooperativeGiver]) -> list[dict[str, np.ndarray]]:
    """Simulate random actions of the receiver, which overwrites its observations if the giver does."""
    env = handover_marl.freeze(
        handover_marl.parallel_env(dataset="synthetic", physics="fast", split="test"), "receiver", giver
    )
    observations: Any = env.reset(seed=0, options={"scene_id": 209})[0]
    rng, found = np.random.default_rng(0), []
    for _ in range(32):
        found.append({key: value.copy() for key, value in observations["receiver"].items()})
        if giver is ScribblingGiver:
            for value in observations["receiver"].values():
                value[...] = 0.0
        action = START + np.float32(0.1) * rng.uniform(-1.0, 1.0, 9).astype(np.float32)
        observations = env.step({"receiver": action})[0]
    assert env.agents
    env.close()
    return found


@pytest.mark.slow
def test_neither_a_live_nor_a_frozen_agent_spoils_what_the_other_sees() -> None:
    clean = rollout(CooperativeGiver)
    assert any((first["object_poses"] != clean[0]["object_poses"]).any() for first in clean)
    # Both agents overwrite their arrays; the arrays of either one would change what the other observes and does.
    assert_equal(rollout(ScribblingGiver), clean)
