"""Tests of functions, modules and files that are adapted to receivers and givers."""

import functools
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import (
    ActionError,
    DataNotFoundError,
    HandoverError,
    OptionError,
    UnknownNameError,
)
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyReference
from handover_marl.testing import check_giver, check_receiver

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from tests.evaluation.quick import SHORT  # noqa: E402
from tests.learning.adapters import networks  # noqa: E402
from tests.learning.adapters.networks import CHOICES, Counting, DictModule, NoisyModule, make_net, stay  # noqa: E402

DATA = SyntheticDataset()
SCENES = (5, 6)


@pytest.fixture(scope="module")
def observations() -> dict[str, Any]:
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast")
    observed, _ = env.reset(seed=0)
    env.close()
    found: dict[str, Any] = observed
    return found


def adapt(agent: str, policy: Any, **options: Any) -> PolicyReference:
    function = handover_marl.as_receiver if agent == "receiver" else handover_marl.as_giver
    reference = function(policy, **options)
    # References are pickled when they are sent to a worker process.
    found: PolicyReference = pickle.loads(pickle.dumps(reference))
    return found


def make(agent: str, policy: Any, **options: Any) -> Policy:
    made = adapt(agent, policy, **options).make(DATA)
    made.reset(0)
    return made


def test_functions_get_the_observation(observations: dict[str, Any]) -> None:
    seen = observations["receiver"]
    policy = make("receiver", stay, control_period=0.05)
    np.testing.assert_array_equal(policy.act(seen), seen["robot_joint_position"])
    assert (policy.hold_time, policy.obs_mode, policy.name) == (0.05, "state", "stay")
    assert make("giver", networks.replay).act(observations["giver"]).tolist() == [0.0] * 8
    scaled = functools.partial(lambda observation, gain: gain * observation["robot_joint_position"], gain=0.5)
    np.testing.assert_array_equal(make("receiver", scaled).act(seen), 0.5 * seen["robot_joint_position"])


@pytest.mark.parametrize("agent", ["receiver", "giver"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_modules_act_as_in_pytorch(agent: str, dtype: Any, observations: dict[str, Any]) -> None:
    net = make_net(agent).to(dtype)
    policy = make(agent, net, **CHOICES[agent], control_period=0.2)
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast")
    context = env.unwrapped.policy_context
    from handover_marl.learning.features import make_features
    from handover_marl.learning.schemes import make_scheme

    features = make_features(agent, CHOICES[agent]["features"], context)
    scheme = make_scheme(agent, CHOICES[agent]["action_scheme"], context)
    with torch.no_grad():
        scheme.set_outputs(net(torch.from_numpy(features(observations[agent]))[None].to(dtype))[0].float().numpy())
    np.testing.assert_array_equal(policy.act(observations[agent]), scheme.compute_action(observations[agent]))
    env.close()


def test_later_training_does_not_change_the_policy(observations: dict[str, Any]) -> None:
    net = make_net()
    reference = handover_marl.as_receiver(net, **CHOICES["receiver"])
    before = make("receiver", net, **CHOICES["receiver"]).act(observations["receiver"])
    with torch.no_grad():
        net[0].weight += 1.0
    made = reference.make(DATA)
    made.reset()
    np.testing.assert_array_equal(made.act(observations["receiver"]), before)
    assert net.training, "the module itself is left as it is"


def test_modules_that_take_observations(observations: dict[str, Any]) -> None:
    policy = make("receiver", DictModule(), features="observation")
    seen = observations["receiver"]
    np.testing.assert_array_equal(policy.act(seen), seen["robot_joint_position"])
    camera = handover_marl.as_receiver(DictModule(), obs_mode="pointcloud").resolve(DATA)
    assert camera.obs_mode == "pointcloud"


def test_random_numbers_of_modules_come_from_the_seed(observations: dict[str, Any]) -> None:
    policy = make("receiver", NoisyModule(), **CHOICES["receiver"])

    def act(seed: int, outside: int) -> Any:
        policy.reset(seed)
        torch.manual_seed(outside)
        actions = [policy.act(observations["receiver"]) for _ in range(2)]
        assert torch.initial_seed() == outside
        return np.stack(actions)

    np.testing.assert_array_equal(act(1, 5), act(1, 6))
    assert not np.array_equal(act(1, 5), act(2, 5))
    assert not np.array_equal(*act(1, 5))


@pytest.mark.parametrize(
    ("outputs", "fault"),
    [
        (np.full(9, np.nan), "component 0 is nan"),
        (np.zeros(8), r"got shape \(8,\), expected \(9,\)"),
        (np.zeros((1, 9)), r"got shape \(1, 9\)"),
        ("left", "got str"),
    ],
)
def test_wrong_outputs_are_refused(outputs: Any, fault: str, observations: dict[str, Any]) -> None:
    policy = make("receiver", lambda _: outputs, name="mine")
    with pytest.raises(ActionError, match=f"outputs of the receiver 'mine' must be .*{fault}"):
        policy.act(observations["receiver"])


def test_modules_of_wrong_sizes_are_refused() -> None:
    for net, fault in (
        (torch.nn.Linear(3, 7), r"must accept features of shape \(1, 64\), got RuntimeError"),
        (torch.nn.Linear(64, 3), r"outputs of shape \(1, 7\) for action scheme 'cartesian_delta', got shape \(3,\)"),
        (torch.nn.LSTM(64, 7), "got tuple"),
        (torch.nn.Embedding(64, 7), "must accept features"),
    ):
        with pytest.raises(OptionError, match=fault):
            handover_marl.as_receiver(net, **CHOICES["receiver"]).resolve(DATA)


@pytest.mark.parametrize(
    ("policy", "options", "error", "fault"),
    [
        (stay, {"control_period": 0.0}, OptionError, "control_period must be a time from 0.001 to 60 s"),
        (stay, {"obs_mode": "smell"}, UnknownNameError, "unknown obs_mode 'smell'"),
        (stay, {"action_scheme": "smell"}, UnknownNameError, "unknown action scheme 'smell'"),
        (stay, {"action_scheme": 3}, OptionError, "action scheme must be a name, a class or a function, got 3"),
        (stay, {"features": "grasp", "obs_mode": "pointcloud"}, OptionError, r"take 'state\+pointcloud'"),
        (3, {}, OptionError, "policy must be a function, a PyTorch module, .*, got 3"),
        (receivers.Receiver, {}, OptionError, "got the policy .*; pass it directly"),
        ("nowhere.zip", {}, DataNotFoundError, "no such policy file"),
        ("setup.cfg", {}, OptionError, r"policy files are \.npz or \.zip"),
        (threading.Lock().acquire, {}, OptionError, "cannot be sent to worker processes"),
    ],
)
def test_wrong_arguments_are_refused(policy: Any, options: dict[str, Any], error: type, fault: str) -> None:
    with pytest.raises(error, match=fault):
        handover_marl.as_receiver(policy, **options)


def test_names_and_labels() -> None:
    assert adapt("receiver", stay, name="mine").resolve(DATA).label == "mine"
    label = adapt("receiver", stay).resolve(DATA).label
    assert label.startswith("stay@")
    labels = {adapt("receiver", make_net(seed=n), **CHOICES["receiver"]).resolve(DATA).label for n in (0, 0, 1)}
    assert len(labels) == 2
    assert "pickled" not in repr(adapt("receiver", stay))


def hash_of(policy: Any, agent: str = "receiver", **options: Any) -> str:
    return adapt(agent, policy, **options).resolve(DATA).code_hash


def test_hash_covers_weights_code_values_and_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    net = make_net()
    reference = hash_of(net, **CHOICES["receiver"])
    assert hash_of(make_net(), **CHOICES["receiver"]) == reference
    assert hash_of(net, **CHOICES["receiver"], control_period=0.2) != reference
    assert hash_of(net, features="grasp", action_scheme="grasp_servo") != reference
    with torch.no_grad():
        net[2].bias[0] += 1e-6
    assert hash_of(net, **CHOICES["receiver"]) != reference
    assert hash_of(make_net(activation=torch.nn.ReLU), **CHOICES["receiver"]) != reference
    before = hash_of(stay)
    assert hash_of(Counting(0.1)) != hash_of(Counting(0.2))
    assert hash_of(stay) == before
    monkeypatch.setattr(networks, "SCALE", 2.0)
    assert hash_of(stay) != before


def list_hashes() -> list[str]:
    policies: tuple[tuple[Any, dict[str, Any]], ...] = (
        *((stay, {}), (Counting(), {}), (make_net(), CHOICES["receiver"])),
        (lambda observation: {"a", "b"} and stay(observation), {}),
    )
    return [hash_of(policy, **options) for policy, options in policies]


@pytest.mark.slow
def test_hash_is_equal_in_every_process() -> None:
    program = "from tests.learning.adapters.test_as_policy import list_hashes; print(*list_hashes())"
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == list_hashes()


@pytest.mark.slow
def test_adapted_policies_pass_the_conformance_tests() -> None:
    check_receiver(handover_marl.as_receiver(make_net(), **CHOICES["receiver"]), steps=600)
    check_giver(handover_marl.as_giver(make_net("giver"), **CHOICES["giver"]), steps=600)
    with pytest.raises(HandoverError, match=r"another order|second run|repeat"):
        check_receiver(handover_marl.as_receiver(Forgetful()), steps=300)


class Forgetful:
    """Function without `reset`, whose count of calls continues in the next episode."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, observation: dict[str, Any]) -> Any:
        self.count += 1
        return observation["robot_joint_position"] + 0.0001 * self.count


@pytest.mark.slow
def test_adapted_policies_are_taken_everywhere(tmp_path: Path) -> None:
    robot = handover_marl.as_receiver(make_net(), **CHOICES["receiver"], name="net")
    human = handover_marl.as_giver(networks.replay, name="person")
    options: dict[str, Any] = {"dataset": "synthetic", "scenes": SCENES, "physics": "fast", "split": "train"}
    options["world_config"] = SHORT

    def evaluate(workers: int) -> handover_marl.Report:
        return handover_marl.evaluate_pair(
            human, robot, workers=workers, out=tmp_path / str(workers), progress=False, **options
        )

    one, two = evaluate(1), evaluate(2)
    assert [episode.status for episode in one.episodes] == [episode.status for episode in two.episodes]
    assert "person" in str(one)
    assert handover_marl.verify(tmp_path / "1", giver=human, world_config=SHORT).is_verified
    assert evaluate(1).n_resumed == len(SCENES)
    table = handover_marl.crossplay(["replay", human], [robot, "hold"], workers=1, progress=False, **options)
    assert set(table.reports) == {(giver, robot) for giver in ("replay", "person") for robot in ("net", "hold")}
    page = handover_marl.render_scene(
        SCENES[0],
        tmp_path / "scene.png",
        receiver=robot,
        giver=human,
        dataset="synthetic",
        physics="fast",
        world_config=SHORT,
        key_frames=1,
    )
    assert page.is_file()
    env = handover_marl.freeze(handover_marl.parallel_env(dataset="synthetic", physics="fast"), "giver", robot)
    env.reset(seed=0)
    env.step({"giver": np.zeros(8, np.float32)})
    env.close()
