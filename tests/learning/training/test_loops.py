"""Tests of training with other libraries at the smallest size; the policies run without these libraries."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from handover_marl import givers, receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.policy_spec import DenseNetwork
from tests.learning.training.scripts import REWARDS, files, reward_terms_of, script, steps_of
from tests.short_episodes import shorten_episodes

pytest.importorskip("torch", reason="needs an extra with PyTorch")
pytest.importorskip("mujoco", reason="needs MuJoCo")
pytestmark = pytest.mark.filterwarnings("ignore")
SCRIPTS = {
    "train_both_torchrl": "torchrl",
    "train_both_rllib": "ray.rllib",
    "train_both_benchmarl": "benchmarl",
    "train_both_tianshou": "tianshou",
}
MADE = {
    *("arguments.json", "giver.npz", "receiver.npz", "learning_curve.csv", "learning_curve.png", "reward_terms.csv")
}


def module(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip(SCRIPTS[name], reason="another library; see `make loops`")
    return script(name, monkeypatch)


@pytest.mark.parametrize("name", SCRIPTS)
def test_training_writes_policies_that_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = module(name, monkeypatch)
    shorten_episodes(monkeypatch, 3000)
    written: list[dict[str, DenseNetwork]] = []
    evaluate = train.TrainingRun.evaluate

    def record(run: Any, decisions: int, networks: dict[str, DenseNetwork]) -> Any:
        written.append(networks)
        return evaluate(run, decisions, networks)

    monkeypatch.setattr(train.TrainingRun, "evaluate", record)
    args = train.Args(dataset="synthetic", smoke_test=True, out=str(tmp_path / "run"), rewards=REWARDS)
    run = train.main(args)
    assert reward_terms_of(tmp_path / "run", "receiver") >= {"task", "distance", "approach"}
    assert reward_terms_of(tmp_path / "run", "giver") >= {"task", "effort"}
    assert run.folder.path == tmp_path / "run"
    assert files(tmp_path / "run") >= MADE
    assert steps_of(tmp_path / "run") == ["steps", "0", "32"]
    last = run.folder.points[-1]
    assert (last.dataset, last.physics, last.episodes) == ("synthetic", "mujoco", 1)
    for agent, package in (("giver", givers), ("receiver", receivers)):
        path = tmp_path / "run" / f"{agent}.npz"
        package.make(f"learned:{path}", SyntheticDataset())  # type: ignore[attr-defined]
        found = read_policy(path, agent)
        assert name in found.spec.origin
        # The last networks were written, and differ from the first.
        before, after = (networks[agent] for networks in written)
        inputs = np.random.default_rng(0).normal(size=found.function.n_inputs).astype(np.float32)
        np.testing.assert_allclose(found.function(inputs), after(inputs))
        assert not np.allclose(before(inputs), after(inputs), atol=1e-7)
    with pytest.raises(ResultsError, match="cannot be resumed; choose another --out"):
        train.main(args)


def test_torchrl_policies_equal_the_policy_files(monkeypatch: pytest.MonkeyPatch) -> None:
    train = module("train_both_torchrl", monkeypatch)
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    args = train.Args(dataset="synthetic", smoke_test=True).shrink_for_smoke_test()
    env = train.make_env(args)
    actors = {group: train.make_actor(env, group, args) for group in train.AGENTS}
    networks = train.extract_policy_networks(actors)
    start = env.reset()
    for group, actor in actors.items():
        seen = start[group, "observation"]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            done = actor(TensorDict({group: {"observation": seen}}))[group, "action"]
        np.testing.assert_allclose(networks[group](seen[0].numpy()), done[0].detach().numpy(), atol=1e-5)
    env.close()


@pytest.mark.parametrize("critic", ["centralised", "own"])
def test_torchrl_critics_have_the_chosen_inputs(critic: str, monkeypatch: pytest.MonkeyPatch) -> None:
    train = module("train_both_torchrl", monkeypatch)
    args = train.Args(dataset="synthetic", smoke_test=True, critic=critic).shrink_for_smoke_test()
    env = train.make_env(args)
    keys = {}
    for group in train.AGENTS:
        loss = train.make_loss(env, group, train.make_actor(env, group, args), args)
        keys[group] = {key[0] for key in loss.critic_network.in_keys}
    env.close()
    assert keys == {group: set(train.AGENTS) if critic == "centralised" else {group} for group in train.AGENTS}


def test_tianshou_policies_are_extracted_from_the_shared_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each extracted policy gives the outputs of the shared network for the padded observation."""
    train = module("train_both_tianshou", monkeypatch)
    import torch

    args = train.Args(dataset="synthetic", smoke_test=True).shrink_for_smoke_test()
    world = train.homogeneous(train.make_pair_env(args))
    algorithm = train.make_algorithm(world, args)
    with torch.no_grad():
        algorithm.policy.actor.mu.model[-1].weight.mul_(100.0)
    networks = train.extract_policy_networks(algorithm, world)
    seen, _ = world.reset(seed=0)
    for agent in train.AGENTS:
        with torch.no_grad():
            (means, _), _ = algorithm.policy.actor(torch.as_tensor(seen[agent][None]))
        own = networks[agent](seen[agent][: world.get_sizes(agent)[0]])
        np.testing.assert_allclose(own, world.unpad_action(agent, means[0].numpy())[: len(own)].clip(-1, 1), atol=1e-5)
    assert not np.allclose(*(networks[agent].biases[0] for agent in train.AGENTS))


def test_tianshou_steps_every_agent_as_an_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    train = module("train_both_tianshou", monkeypatch)
    args = train.Args(dataset="synthetic", smoke_test=True).shrink_for_smoke_test()
    worlds = [train.homogeneous(train.make_pair_env(args)) for _ in range(2)]
    envs = train.AgentsVectorEnv(worlds)
    envs.seed(3)
    seen, _ = envs.reset()
    assert seen.shape == (4, *worlds[0].observation_space("giver").shape)
    np.testing.assert_array_equal(seen[:, -2:], np.tile(np.eye(2), (2, 1)))
    # Only environment 1 is stepped, with its agents in reverse order.
    size = worlds[0].action_space("giver").shape
    after, rewards, ended, timed_out, infos = envs.step(np.zeros((2, *size)), id=[3, 2])
    np.testing.assert_array_equal(after[:, -2:], [[0, 1], [1, 0]])
    assert [info["env_id"] for info in infos] == [3, 2]
    assert infos[0]["steps"] == 200
    assert rewards.shape == ended.shape == timed_out.shape == (2,)
    again, _ = envs.reset([2, 3])
    assert not np.array_equal(again, seen[2:])
    envs.seed(3)
    np.testing.assert_array_equal(envs.reset()[0], seen)
    envs.close()


def test_benchmarl_task_has_the_specs_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("benchmarl", reason="another library; see `make loops`")
    from torchrl.envs.utils import check_env_specs

    from handover_marl.learning.training.arguments import PairArgs
    from handover_marl.learning.training.benchmarl_task import HandoverTask, make_task_config

    args = PairArgs(dataset="synthetic", smoke_test=True).shrink_for_smoke_test()
    task = HandoverTask.TAKE.get_task(make_task_config(args))
    env = task.get_env_fun(1, continuous_actions=True, seed=0, device="cpu")()
    check_env_specs(env)
    assert task.max_steps(env) == task.config["max_cycles"] == 5
    assert task.has_state()
    assert task.state_spec(env)["state"].shape == (172,)
    assert task.group_map(env) == {"giver": ["giver"], "receiver": ["receiver"]}
    for group in ("giver", "receiver"):
        # The first axis is the number of agents; the inputs are vectors.
        assert task.observation_spec(env)[group, "observation"].ndim == 2
    assert task.supports_continuous_actions()
    assert not task.supports_discrete_actions()
    env.close()
