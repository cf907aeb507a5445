"""Tests of population files, and of policies that act as a randomly drawn member in each episode."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import givers, receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from handover_marl.policies.populations import DEFAULT_POPULATION, PopulationPolicy, list_populations, load_population
from handover_marl.policies.reference import parse_policy
from tests.evaluation.strangers.populations import GIVERS, RECEIVERS, write_population
from tests.givers.test_givers import seen


def test_own_file(tmp_path: Path) -> None:
    found = load_population(write_population(tmp_path))
    assert found.label == f"small 1.0 ({found.content_hash})"
    assert [partner.name for partner in found.select("giver", "test")] == ["fast", "slow"]
    assert [partner.name for partner in found.select("giver", "all")] == ["recorded", "fast", "slow"]
    assert [partner.policy for partner in found.select("receiver", "test")] == ["hold"]


def test_the_hash_covers_the_content_and_policy_files(tmp_path: Path) -> None:
    first = load_population(write_population(tmp_path)).content_hash
    assert load_population(write_population(tmp_path, version="1.1")).content_hash != first
    learned = GIVERS[0] | {"policy": "learned:{folder}/giver.npz"}
    path = write_population(tmp_path, givers=[learned])
    with pytest.raises(DataNotFoundError, match=r"giver\.npz cannot be read"):
        load_population(path)
    (tmp_path / "giver.npz").write_bytes(b"1")
    found = load_population(path)
    assert found.get_policy(found.givers[0]) == f"learned:{tmp_path}/giver.npz"


@pytest.mark.parametrize("file", ["weights.pth", "weights.pth/actor.pth"])
@pytest.mark.parametrize("folder", ["{folder}/", ""])
@pytest.mark.parametrize("option", ["learned:", "gaddpg:wait=1,weights=", "not_installed.robots:MyReceiver:weights="])
def test_the_hash_covers_the_files_that_policies_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, folder: str, file: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / file).parent.mkdir(exist_ok=True)
    path = write_population(tmp_path, receivers=[RECEIVERS[0] | {"policy": f"{option}{folder}weights.pth"}])
    hashes = set()
    for content in (b"1", b"2"):
        (tmp_path / file).write_bytes(content)
        hashes.add(load_population(path, trust=True).content_hash)
    assert len(hashes) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"givers": [GIVERS[0], GIVERS[0]]}, "every name must be unique, got 'recorded' twice"),
        ({"givers": [GIVERS[1], GIVERS[2] | {"split": "train"}]}, "family in one split must be unique, got 'timing'"),
        ({"givers": [{"name": "a"}]}, "not a readable population .*missing 4 required"),
    ],
)
def test_malformed_files(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        load_population(write_population(tmp_path, **changes))


@pytest.mark.slow
def test_shipped_populations() -> None:
    """All partners of the default population can be parsed, and all givers made; train and test share no family."""
    assert DEFAULT_POPULATION in list_populations()
    dataset = SyntheticDataset()
    found = load_population(DEFAULT_POPULATION)
    # One version names one content: whoever changes the file or a policy file beside it raises the version.
    assert found.label == "strangers-v1 1.1 (55138fb9c728)"
    assert len(found.givers) >= 24
    assert len({giver.family for giver in found.givers}) >= 6
    for agent in ("giver", "receiver"):
        families = [{partner.family for partner in found.select(agent, split)} for split in ("train", "test")]
        assert not families[0] & families[1]
        references = [parse_policy(agent, found.get_policy(partner)) for partner in found.select(agent, "all")]
        if agent == "giver":
            labels = [reference.resolve(dataset).label for reference in references]
            assert len(set(labels)) == len(labels)


def make_giver(path: Path, partners: str = "all") -> PopulationPolicy:
    policy = givers.make(("population", {"population": os.fspath(path), "partners": partners}))
    assert isinstance(policy, PopulationPolicy)
    return policy


def test_members_are_those_of_the_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_population(tmp_path)
    assert [member.name for member in make_giver(path).members] == ["replay", "hurried", "hurried"]
    assert [member.name for member in make_giver(path, "train").members] == ["replay"]
    assert make_giver(path).weights_hash == make_giver(path).weights_hash != make_giver(path, "train").weights_hash
    # A file with the name of a shipped population is not read.
    monkeypatch.chdir(tmp_path)
    Path(DEFAULT_POPULATION).touch()
    assert parse_policy("giver", f"population:population={DEFAULT_POPULATION}").read_files() == []


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
    network = DenseNetwork((np.zeros((7, 56), np.float32),), (np.zeros(7, np.float32),))
    spec = PolicySpec("receiver", "receiver", "cartesian_delta", 0.1, "", "state+pointcloud")
    write_policy(tmp_path / "camera.npz", spec, network)
    vision = {**RECEIVERS[0], "name": "camera", "policy": "gaddpg"}
    learned = {**RECEIVERS[0], "name": "learned", "policy": "learned:{folder}/camera.npz"}
    path = write_population(tmp_path, receivers=[*RECEIVERS, vision, learned])
    policy = receivers.make(("population", {"population": os.fspath(path), "partners": "test"}))
    assert isinstance(policy, PopulationPolicy)
    assert [member.name for member in policy.members] == ["hold"]
    only = write_population(tmp_path, receivers=[vision])
    with pytest.raises(OptionError, match="receivers that act on the state"):
        receivers.make(("population", {"population": os.fspath(only), "partners": "test"}))


@pytest.mark.slow
def test_a_vector_environment_equals_single_environments(tmp_path: Path) -> None:
    interrupting = {**GIVERS[0], "name": "interrupting", "policy": "interrupting"}
    path = write_population(tmp_path, givers=[*GIVERS, interrupting])
    partner = ("population", {"population": os.fspath(path), "partners": "all"})
    fields: dict[str, Any] = {"dataset": "synthetic", "physics": "mujoco", "control_period": 0.2, "max_cycles": 8}
    envs = handover_marl.vector_env(3, "receiver", partner, autoreset="disabled", threads=1, **fields)
    batch = [envs.reset(seed=3)[0]]
    action = batch[0]["robot_joint_position"][0]
    batch += [envs.step(np.tile(action, (3, 1)))[0] for _ in range(8)]
    envs.close()
    env = handover_marl.control_agent(handover_marl.parallel_env(**fields), "receiver", partner)
    for number in range(3):
        single = [env.reset(seed=3 + number)[0], *(env.step({"receiver": action})[0] for _ in range(8))]
        for step, found in enumerate(single):
            for key, values in found["receiver"].items():
                np.testing.assert_array_equal(batch[step][key][number], values, err_msg=f"{step}, {key}")
    env.close()
