"""Tests of batches of environments for Stable-Baselines3: they equal single environments."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3.common.vec_env", reason="needs the extra `train`")

from stable_baselines3.common.vec_env import DummyVecEnv

import handover_marl
from handover_marl.errors import OptionError
from handover_marl.learning.training.batch_vec_env import BatchVecEnv
from handover_marl.learning.training.run_folder import spawn_seeds

COUNT = 2
OPTIONS: dict[str, Any] = {
    **{"setup": "s0", "split": "train", "dataset": "synthetic", "physics": "mujoco"},
    **{"control_period": 0.13, "max_cycles": 7},
}


def batch() -> BatchVecEnv:
    options: dict[str, Any] = {"features": "giver", "action_scheme": "deviation", "autoreset": "same_step"}
    return BatchVecEnv(handover_marl.vector_env(COUNT, "giver", "hold", threads=1, **options, **OPTIONS))


def alone() -> Any:
    live = handover_marl.control_agent(handover_marl.parallel_env(**OPTIONS), "giver", "hold")
    return handover_marl.encode(live, api="gymnasium")


def rollout(envs: Any, steps: int = 16) -> list[Any]:
    if isinstance(envs, DummyVecEnv):
        envs._seeds = list(spawn_seeds(COUNT, 5))
    else:
        envs.seed(5)
    rng, said = np.random.default_rng(0), [envs.reset()]
    for _ in range(steps):
        seen, rewards, ended, infos = envs.step(rng.uniform(-1, 1, (COUNT, *envs.action_space.shape)))
        said += [seen, rewards, ended, [info if over else {} for info, over in zip(infos, ended, strict=True)]]
    envs.close()
    return said


@pytest.mark.slow
def test_batches_equal_single_environments() -> None:
    expected = rollout(DummyVecEnv([alone] * COUNT))
    found = rollout(batch())
    assert sum(int(ended.sum()) for ended in expected[3::4]) > COUNT
    for one, other in zip(found, expected, strict=True):
        if isinstance(one, list):
            for mine, theirs in zip(one, other, strict=True):
                assert mine.keys() == theirs.keys()
                for key, value in mine.items():
                    np.testing.assert_array_equal(value, theirs[key], err_msg=key)
        else:
            np.testing.assert_array_equal(one, other)


def test_runs_of_different_seeds_share_no_environment() -> None:
    envs = batch()
    seeds = [seed for run in range(3) for seed in envs.seed(run)]
    assert len(set(seeds)) == 3 * COUNT
    assert envs.seed(2) == seeds[-COUNT:]
    envs.close()


def test_environments_must_reset_in_the_same_step() -> None:
    for autoreset in ("next_step", "disabled"):
        with pytest.raises(OptionError, match=f"envs must have autoreset='same_step', got '{autoreset}'"):
            BatchVecEnv(handover_marl.vector_env(1, autoreset=autoreset, threads=1, **OPTIONS))
