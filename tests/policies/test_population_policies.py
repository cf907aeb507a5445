"""Tests of policies that act as a randomly drawn member of a population in each episode."""

import os
from pathlib import Path

import numpy as np
import pytest

import handover_marl
from handover_marl import givers, receivers
from handover_marl.errors import OptionError
from handover_marl.policies.populations import PopulationPolicy, load_population
from tests.evaluation.strangers.populations import GIVERS, RECEIVERS, write_population
from tests.givers.test_givers import seen


def make_giver(path: Path, partners: str = "all") -> PopulationPolicy:
    policy = givers.make(("population", {"population": os.fspath(path), "partners": partners}))
    assert isinstance(policy, PopulationPolicy)
    return policy


@pytest.mark.slow
def test_members_are_those_of_the_split(tmp_path: Path) -> None:
    path = write_population(tmp_path)
    assert [member.name for member in make_giver(path).members] == ["replay", "hurried", "hurried"]
    assert [member.name for member in make_giver(path, "train").members] == ["replay"]
    assert make_giver(path).weights_hash == load_population(path).content_hash
    shipped = givers.make("population")
    assert isinstance(shipped, PopulationPolicy)
    assert len(shipped.members) == len(load_population().select("giver", "train"))


def test_the_seed_draws_the_member_that_acts(tmp_path: Path) -> None:
    policy, observation = make_giver(write_population(tmp_path)), seen()
    rates, counts = [], np.zeros(3, dtype=int)
    for seed in range(300):
        counts[policy.draw_member(seed)[0]] += 1
        policy.reset(seed)
        rates.append(float(policy.act(observation)[0]))
    assert counts.min() > 70
    assert np.sum(np.equal(rates, 0.0)) == counts[0]
    assert np.sum(np.greater(rates, 0.4)) == counts[1]
    assert np.sum(np.less(rates, -0.4)) == counts[2]
    again = make_giver(write_population(tmp_path))
    again.reset(7)
    assert float(again.act(observation)[0]) == rates[7]


def test_receivers_with_a_camera_are_left_out(tmp_path: Path) -> None:
    vision = {**RECEIVERS[0], "name": "camera", "policy": "gaddpg"}
    path = write_population(tmp_path, receivers=[*RECEIVERS, vision])
    policy = receivers.make(("population", {"population": os.fspath(path), "partners": "test"}))
    assert isinstance(policy, PopulationPolicy)
    assert [member.name for member in policy.members] == ["hold"]
    only = write_population(tmp_path, receivers=[vision])
    with pytest.raises(OptionError, match="receivers that act on the state"):
        receivers.make(("population", {"population": os.fspath(only), "partners": "test"}))


@pytest.mark.slow
def test_a_vector_environment_equals_single_environments(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    interrupting = {**GIVERS[0], "name": "interrupting", "policy": "interrupting"}
    partner = ("population", {"population": os.fspath(write_population(tmp_path, givers=[*GIVERS, interrupting]))})
    partner[1]["partners"] = "all"
    fields = {"dataset": "synthetic", "physics": "mujoco", "control_period": 0.2, "max_cycles": 12}
    envs = handover_marl.vector_env(5, "receiver", partner, autoreset="disabled", threads=2, **fields)
    observations, _ = envs.reset(seed=3)
    singles = []
    for number in range(5):
        env = handover_marl.freeze(handover_marl.parallel_env(**fields), "receiver", partner)
        singles.append((env, env.reset(seed=3 + number)[0]["receiver"]))
    actions = np.tile(observations["robot_joint_position"][:1], (5, 1))
    for step in range(13):
        for number, (env, observation) in enumerate(singles):
            for key, values in observation.items():
                np.testing.assert_array_equal(observations[key][number], values, err_msg=f"{step}, {key}")
            if step < 12:
                singles[number] = env, env.step({"receiver": actions[number]})[0]["receiver"]
        if step < 12:
            observations = envs.step(actions)[0]
    envs.close()
    for env, _ in singles:
        env.close()
