"""Tests of functions, modules and files that are adapted to receivers and givers."""

import functools
import pickle
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import HandoverError, OptionError
from handover_marl.learning.adapters.function_policy import reset_function
from handover_marl.learning.encodings.registry import make_action_scheme
from handover_marl.policies.policy import Policy, make_policy_context
from handover_marl.policies.reference import PolicyReference
from tests.givers.test_givers import seen

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from tests.evaluation.quick import SHORT  # noqa: E402
from tests.learning.adapters import networks  # noqa: E402
from tests.learning.adapters.networks import CHOICES, Counting, DictModule, NoisyModule, Restarting, make_net, stay  # noqa: E402
from tests.learning.array_encodings import SingleFeatures  # noqa: E402

DATA = SyntheticDataset()
JOINTS = seen()["robot_joint_position"]


def adapt(agent: str, policy: Any, **options: Any) -> PolicyReference:
    function = handover_marl.as_receiver if agent == "receiver" else handover_marl.as_giver
    # References are pickled when they are sent to a worker process.
    found: PolicyReference = pickle.loads(pickle.dumps(function(policy, **options)))
    return found


def make(agent: str, policy: Any, **options: Any) -> Policy:
    made = adapt(agent, policy, **options).make(DATA)
    made.reset(0)
    return made


def test_functions_get_the_observation() -> None:
    policy = make("receiver", stay, control_period=0.05)
    np.testing.assert_array_equal(policy.act(seen()), JOINTS)
    assert (policy.hold_time, policy.obs_mode, policy.name) == (0.05, "state", "stay")
    assert make("giver", lambda observation: np.zeros(8)).act(seen()).tolist() == [0.0] * 8
    scaled = functools.partial(lambda observation, gain: gain * observation["robot_joint_position"], gain=0.5)
    np.testing.assert_array_equal(make("receiver", scaled).act(seen()), 0.5 * JOINTS)
    for counting in (make("receiver", Counting()), make("receiver", Restarting())):
        for _ in range(2):
            counting.reset(3)
            np.testing.assert_allclose(counting.act(seen()), JOINTS + 0.001)


@pytest.mark.parametrize("agent", ["receiver", "giver"])
def test_modules_act_as_before_later_training(agent: str) -> None:
    net, choice, context = make_net(agent).to(torch.float64), CHOICES[agent], make_policy_context(DATA)
    reference = adapt(agent, net, **choice, control_period=0.2)
    scheme = make_action_scheme(agent, choice["action_scheme"], context)
    inputs = torch.from_numpy(SingleFeatures(agent, choice["features"], context)(seen()))[None].double()
    with torch.no_grad():
        scheme.set_outputs(net(inputs)[0].float().numpy())
        net[0].weight += 1.0
    assert net.training, "the module itself is left as it is"
    policy = reference.make(DATA)
    policy.reset()
    np.testing.assert_array_equal(policy.act(seen()), scheme.compute_action(seen()))


def test_modules_that_take_observations() -> None:
    np.testing.assert_array_equal(make("receiver", DictModule(), features="observation").act(seen()), JOINTS)
    camera = handover_marl.as_receiver(DictModule(), obs_mode="pointcloud").resolve(DATA)
    assert camera.obs_mode == "pointcloud"


def test_random_numbers_of_modules_come_from_the_seed() -> None:
    policy = make("receiver", NoisyModule(), **CHOICES["receiver"])

    def act(seed: int, outside: int) -> Any:
        policy.reset(seed)
        torch.manual_seed(outside)
        actions = [policy.act(seen()) for _ in range(2)]
        assert torch.initial_seed() == outside
        return np.stack(actions)

    np.testing.assert_array_equal(act(1, 5), act(1, 6))
    assert not np.array_equal(act(1, 5), act(2, 5))
    assert not np.array_equal(*act(1, 5))


@pytest.mark.parametrize(
    ("policy", "options", "fault"),
    [
        (lambda _: np.full(9, np.nan), {"name": "mine"}, "outputs of the receiver 'mine' must be .*component 0 is nan"),
        (stay, {"control_period": 0.0}, "control_period must be a time from 0.001 to 5 s"),
        (stay, {"features": "grasp", "obs_mode": "pointcloud"}, r"take 'state\+pointcloud'"),
        (stay, {"features": "graps"}, "unknown features of the receiver 'graps'; .*did you mean 'grasp'"),
        (stay, {"action_scheme": "joint"}, "unknown action scheme of the receiver 'joint'"),
        (3, {}, "policy must be a function, a PyTorch module, .*, got 3"),
        (receivers.Receiver, {}, "got the policy .*; pass it directly"),
        ("nowhere.npz", {}, "nowhere.npz does not exist; give one that handover_marl.export_policy"),
        (torch.nn.Linear(10, 7), {"features": "grasp", "action_scheme": "cartesian_delta"}, "64 inputs .*'grasp'"),
        (torch.nn.Linear(172, 7), {}, "9 outputs, got 7 outputs"),
        (threading.Lock().acquire, {}, "cannot be sent to worker processes"),
    ],
)
def test_invalid_policies(policy: Any, options: dict[str, Any], fault: str) -> None:
    with pytest.raises(HandoverError, match=fault):
        make("receiver", policy, **options).act(seen())


class WithReset:
    def __init__(self, reset: Callable[..., None]) -> None:
        self.seeds: list[Any] = []
        self.reset = functools.partial(reset, self)


@pytest.mark.parametrize(
    ("reset", "seeds"),
    [
        (lambda self: self.seeds.append(None), [None]),
        (lambda self, seed=None: self.seeds.append(seed), [7]),
        (lambda self, **keywords: self.seeds.append(keywords["seed"]), [7]),
        (lambda self, options=None: self.seeds.append(options), [None]),
        (lambda self, episode_seed: self.seeds.append(episode_seed), [7]),
    ],
)
def test_functions_are_reset(reset: Callable[..., None], seeds: list[Any]) -> None:
    function = WithReset(reset)
    reset_function(function, 7)
    assert function.seeds == seeds
    with pytest.raises(OptionError, match="at most the argument seed, got a, b"):
        reset_function(WithReset(lambda self, a, b: None), 7)


def hash_of(policy: Any, **options: Any) -> str:
    return adapt("receiver", policy, **options).resolve(DATA).code_hash


def test_labels_and_hashes_cover_weights_code_values_and_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    assert adapt("receiver", stay, name="mine").resolve(DATA).label == "mine"
    assert adapt("receiver", stay).resolve(DATA).label.startswith("stay@")
    net, choice = make_net(), CHOICES["receiver"]
    labels = {adapt("receiver", make_net(seed=n), **choice).resolve(DATA).label for n in (0, 0, 1)}
    assert len(labels) == 2
    reference = hash_of(net, **choice)
    assert hash_of(make_net(), **choice) == reference
    assert hash_of(net, **choice, control_period=0.2) != reference
    assert hash_of(net, features="grasp", action_scheme="grasp_servo") != reference
    with torch.no_grad():
        net[2].bias[0] += 1e-6
    assert hash_of(net, **choice) != reference
    assert hash_of(make_net(activation=torch.nn.ReLU), **choice) != reference
    assert hash_of(Counting(0.1)) != hash_of(Counting(0.2))
    before = hash_of(stay)
    assert hash_of(stay) == before
    monkeypatch.setattr(networks, "SCALE", 2.0)
    assert hash_of(stay) != before


@pytest.mark.slow
def test_adapted_policies_are_taken_everywhere(tmp_path: Path) -> None:
    robot = handover_marl.as_receiver(make_net(), **CHOICES["receiver"], name="net")
    human = handover_marl.as_giver(lambda observation: np.zeros(8), name="person")
    options: dict[str, Any] = {"world_config": SHORT, "workers": 1, "progress": False}
    where = {"dataset": "synthetic", "scenes": (5,), "physics": "fast", "split": "train", **options}
    report = handover_marl.evaluate_pair(human, robot, out=tmp_path, **where)
    assert "person" in str(report)
    assert handover_marl.evaluate_pair(human, robot, out=tmp_path, **where).n_resumed == 1
    assert handover_marl.verify(tmp_path, giver=human, **options).is_verified
    env = handover_marl.control_agent(handover_marl.parallel_env(dataset="synthetic", physics="fast"), "giver", robot)
    env.reset(seed=0)
    env.step({"giver": np.zeros(8, np.float32)})
    env.close()
