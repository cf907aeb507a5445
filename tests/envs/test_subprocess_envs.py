"""Tests of environments in several processes, as training libraries run them."""

import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl.errors import OptionError

# The name includes the module, so that worker processes import it, whatever their start method.
NAME = "handover_marl:HandoverMARL/Receiver-v0"
OPTIONS: dict[str, Any] = {"setup": "s0", "dataset": "synthetic", "physics": "fast", "max_cycles": 6}


def rollout(envs: gymnasium.vector.VectorEnv[Any, Any, Any]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the last observations, and the sums of rewards, after more steps than those of an episode."""
    envs.action_space.seed(5)
    envs.reset(seed=5)
    total = np.zeros(envs.num_envs)
    for _ in range(8):
        seen, rewards, _, _, _ = envs.step(envs.action_space.sample())
        total += rewards
    envs.close()
    return seen, total


@pytest.mark.slow
def test_processes_of_gymnasium_repeat_from_their_seed() -> None:
    first, again = (
        rollout(gymnasium.make_vec(NAME, 2, vectorization_mode=mode, **OPTIONS)) for mode in ("async", "sync")
    )
    for key, value in first[0].items():
        np.testing.assert_array_equal(value, again[0][key])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0]["object_poses"][0], first[0]["object_poses"][1]), "seeds 5 and 6 differ"


def test_vector_environments_cannot_be_copied() -> None:
    envs = handover_marl.vector_env(2, **OPTIONS)
    with pytest.raises(OptionError, match="make another one"):
        pickle.dumps(envs)
    envs.close()
