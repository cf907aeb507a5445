"""Tests of PPO in plain PyTorch: advantages, updates, and a short training whose policy runs without PyTorch."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import handover_marl
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import OptionError
from handover_marl.learning.policy_files import DenseNetwork, InputNormalization, PolicySpec, read_policy, write_policy
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import REWARDS, script, simulate_here

torch = pytest.importorskip("torch", reason="needs the extra `train`")
VECTOR_ENV = handover_marl.vector_env
SCENES = SyntheticDataset().list_scenes("s0", "val")[:1]


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    simulate_here(monkeypatch)
    return script("train_ppo", monkeypatch)


@pytest.mark.slow
def test_training_and_evaluation(
    train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shorten_episodes(monkeypatch, 1000)
    out = tmp_path / "new" / "ppo.npz"
    small = {"num_envs": 2, "batch_size": 4, "epochs": 2, "minibatch_size": 2, "val_physics": "mujoco"}
    args = train.Args(dataset="synthetic", out=out, decisions=5, val_scenes=1, workers=1, **small)
    assert train.main(args) == out
    printed = capsys.readouterr().out
    assert re.findall(r"^(\d+) decisions,", printed, re.MULTILINE) == ["4", "8"]
    (result,) = re.findall(r"s0 val with the partner cooperative: success (.*?) %, .*1 scenes of synthetic", printed)
    # A policy that has learned little may succeed by chance.
    assert result in ("0.0 (0.0 to 79.3)", "100.0 (20.7 to 100.0)")
    monkeypatch.setitem(sys.modules, "torch", None)
    where = {"split": "val", "dataset": "synthetic", "physics": "fast", "workers": 1}
    report = handover_marl.evaluate_pair("replay", f"learned:{out}", scenes=SCENES, **where)
    assert len(report.episodes) == 1


@pytest.mark.slow
def test_a_giver_learns_with_own_rewards(train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode is one decision of the giver."""
    shorten_episodes(monkeypatch, 2800)
    out = tmp_path / "giver.npz"
    small = {"num_envs": 2, "batch_size": 4, "minibatch_size": 2, "decisions": 4, "workers": 1, "time_limit": 3.0}
    where = {"dataset": "synthetic", "val_scenes": 0, "rewards": REWARDS}
    train.main(train.Args(agent="giver", partner="hold", out=out, **small, **where))
    spec, _, _ = read_policy(out, "giver")
    assert (spec.agent, spec.features, spec.actions) == ("giver", "giver", "offer")


@pytest.mark.slow
def test_own_features_and_action_schemes_are_trained_and_evaluated(
    train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 500)
    own, out = "tests.learning.custom", tmp_path / "own.npz"
    small = {"num_envs": 2, "batch_size": 4, "minibatch_size": 2, "decisions": 4, "workers": 1, "time_limit": 0.6}
    named = {"features": f"{own}:OffsetAndCount", "action_scheme": f"{own}:FirstJoint"}
    train.main(train.Args(dataset="synthetic", out=out, val_scenes=1, **small, **named))
    assert read_policy(out, "receiver", trust=True)[0].features == named["features"]


@pytest.mark.slow
def test_a_training_repeats_from_its_seed(train: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers, which collect in any order, give the same policy in this process and in others."""
    small = {"dataset": "synthetic", "num_envs": 2, "batch_size": 4, "epochs": 1, "decisions": 4, "val_scenes": 0}
    monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 2.0)
    found = []
    for name, make in (("here", handover_marl.vector_env), ("apart", VECTOR_ENV)):
        monkeypatch.setattr(handover_marl, "vector_env", make)
        found.append(read_numbers(train.main(train.Args(out=tmp_path / f"{name}.npz", seed=1, workers=2, **small))))
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.slow
def test_a_training_continues_from_a_policy_file(train: ModuleType, tmp_path: Path) -> None:
    """Train with a learning rate of zero: the policy that is written acts as the first one."""
    rng = np.random.default_rng(0)
    sizes = ((32, 70), (32, 32), (7, 32))
    weights = tuple(rng.normal(0, 0.1, size).astype(np.float32) for size in sizes)
    biases = tuple(rng.normal(0, 0.1, size[0]).astype(np.float32) for size in sizes)
    scaling = InputNormalization(rng.normal(size=70), rng.uniform(0.5, 2, 70), np.full(70, 5.0))
    network = DenseNetwork(weights, biases, "tanh", normalization=scaling)
    first = tmp_path / "first.npz"
    write_policy(first, PolicySpec("receiver", "grasp_velocity", "cartesian_delta", 0.1, "a test"), network)
    small = {"dataset": "synthetic", "num_envs": 2, "batch_size": 8, "epochs": 1, "decisions": 8, "val_scenes": 0}
    out = train.main(train.Args(out=tmp_path / "out.npz", initial=first, learning_rate=0.0, workers=1, **small))
    spec, found, _ = read_policy(out, "receiver")
    assert (spec.features, spec.actions, spec.control_period) == ("grasp_velocity", "cartesian_delta", 0.1)
    write_policy(first, spec, replace(network, activation="relu"))
    with pytest.raises(OptionError, match=r"initial must be a network with tanh layers .* with relu layers"):
        train.main(train.Args(out=out, initial=first, workers=1, **small))
    with pytest.raises(OptionError, match="num_envs must be a multiple of workers"):
        train.main(train.Args(out=out, workers=3, **small))
    inputs = rng.normal(size=70).astype(np.float32)
    np.testing.assert_allclose(found(inputs), network(inputs), atol=1e-6)


def read_numbers(file: Path) -> np.ndarray:
    with np.load(file) as arrays:
        return np.concatenate([arrays[name].ravel() for name in arrays.files if arrays[name].dtype.kind == "f"])


def test_advantages_are_discounted_sums_of_errors(train: ModuleType) -> None:
    args = train.Args(discount=0.5, gae_lambda=0.8)
    rewards, values = torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([[0.5], [1.0], [2.0]])
    found = train.compute_advantages(rewards, values, torch.tensor([[1.0], [0.0], [1.0]]), torch.tensor([8.0]), args)
    # The episode ends in the second step.
    np.testing.assert_allclose(found[:, 0], [1.0 + 0.5 * 1.0 - 0.5 + 0.4 * 1.0, 2.0 - 1.0, 4.0 + 0.5 * 8.0 - 2.0])


def test_only_the_value_function_observes_the_other_agent(train: ModuleType) -> None:
    learner = train.ActorCritic(2, [0.1, 0.1, 0.1], 8, n_features=5)
    features = torch.randn(4, 5)
    changed = torch.cat([features[:, :2], features[:, 2:] + 1.0], 1)
    mean = learner.compute_distribution(features).mean
    torch.testing.assert_close(learner.compute_distribution(changed).mean, mean, rtol=0, atol=0)
    assert (learner.compute_value(changed) != learner.compute_value(features)).all()


def test_updates_favor_actions_with_larger_advantages(train: ModuleType) -> None:
    torch.manual_seed(0)
    args = train.Args(epochs=20, minibatch_size=64, learning_rate=3e-3)
    model = train.ActorCritic(3, [0.15, 0.45], args.width)
    features = torch.randn(8, 32, 3)
    with torch.no_grad():
        policy = model.compute_distribution(features)
        actions = policy.sample()
        log_probs = policy.log_prob(actions).sum(-1)
    advantages = actions[..., 1]
    batch = train.Batch(features, actions, log_probs, advantages, torch.ones_like(advantages))
    train.update(model, torch.optim.Adam(model.parameters(), args.learning_rate), batch, args)
    with torch.no_grad():
        mean, value = model.compute_distribution(features).mean, model.compute_value(features)
    assert mean[..., 1].mean() > policy.mean[..., 1].mean() + 0.1
    assert abs(mean[..., 0] - policy.mean[..., 0]).mean() < 0.1
    assert abs(value - 1.0).mean() < 0.3
