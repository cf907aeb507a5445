"""Tests of policy files that are exported from models of Stable-Baselines3 and modules of PyTorch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, OptionError
from handover_marl.learning.adapters.export import dense_network_from_module
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.policy_spec import PolicySpec

torch = pytest.importorskip("torch", reason="needs the extra `train`")
sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

from tests.learning.adapters.networks import CHOICES, make_net  # noqa: E402

DATA = SyntheticDataset()
NAMES: dict[str, Any] = {"agent": "receiver", **CHOICES["receiver"]}


def make_env(encoded: bool = True, agent: str = "receiver") -> Any:
    partner = "replay" if agent == "receiver" else "hold"
    base = handover_marl.parallel_env(dataset="synthetic", physics="fast", control_period=0.2)
    env = handover_marl.freeze(base, agent, partner)
    if not encoded:
        return handover_marl.envs.wrappers.wrapper.SingleAgentEnv(env)  # type: ignore[attr-defined]
    choice = CHOICES[agent]
    return handover_marl.encode(env, choice["features"], choice["action_scheme"], api="gymnasium")


def make_model(kind: str, env: Any, **options: Any) -> Any:
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
    if kind in ("SAC", "TD3", "DDPG"):
        options["buffer_size"] = 10
    options["policy_kwargs"] = {"net_arch": [16], **options.get("policy_kwargs", {})}
    model = getattr(sb3, kind)(policy, env, seed=0, device="cpu", **options)
    for parameter in model.policy.parameters():
        parameter.data *= 20.0  # so that outputs leave their bounds
    return model


def normalize(env: Any, observations: list[Any], **options: Any) -> VecNormalize:
    """Return the environment in a VecNormalize that has the statistics of some observations."""
    wrapped = VecNormalize(DummyVecEnv([lambda: env]), **options)
    for observation in observations:
        wrapped.obs_rms.update(observation[None]) if not isinstance(observation, dict) else [
            wrapped.obs_rms[key].update(value[None]) for key, value in observation.items() if key in wrapped.obs_rms
        ]
    return wrapped


def collect(env: Any, count: int = 5) -> list[Any]:
    found = [env.reset(seed=0)[0]]
    env.action_space.seed(0)
    for _ in range(count):
        found.append(env.step(env.action_space.sample())[0])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PPO", "A2C", "SAC", "TD3"])
@pytest.mark.parametrize("normalized", [False, True])
def test_encoded_models_act_as_there(kind: str, normalized: bool, tmp_path: Path) -> None:
    env = make_env()
    seen = collect(env)
    training = normalize(env, seen, clip_obs=0.5) if normalized else env
    model = make_model(kind, training)
    path = handover_marl.export_policy(model, tmp_path / "policy.npz", origin="a test")
    spec, network, _ = read_policy(path, "receiver")
    assert spec == PolicySpec("receiver", "grasp", "cartesian_delta", 0.2, "a test")
    for observation in seen:
        inputs = training.normalize_obs(observation) if normalized else observation
        expected, _ = model.predict(inputs, deterministic=True)
        # Features without normalization are large, and processors sum their products in different orders.
        np.testing.assert_allclose(network(observation), expected, atol=1e-5 if normalized else 1e-4)
    direct = handover_marl.as_receiver(model).make(DATA)
    assert direct.hold_time == 0.2
    np.testing.assert_array_equal(direct.evaluate(seen[0]), network(seen[0]))  # type: ignore[attr-defined]
    env.close()


def test_normalization_equals_that_of_vec_normalize_to_the_bit() -> None:
    from handover_marl.learning.adapters.sb3_models import find_input_normalization

    env = make_env()
    seen = collect(env)
    wrapped = normalize(env, seen, clip_obs=1.0)
    normalization = find_input_normalization(wrapped)
    assert normalization is not None
    for observation in seen:
        np.testing.assert_array_equal(normalization(observation), wrapped.normalize_obs(observation))
    assert find_input_normalization(VecNormalize(DummyVecEnv([lambda: env]), norm_obs=False)) is None
    env.close()


@pytest.mark.parametrize("keys", [None, ["robot_joint_position", "time"]])
def test_normalized_observations_of_plain_environments(keys: list[str] | None, tmp_path: Path) -> None:
    env = make_env(encoded=False)
    seen = collect(env)
    training = normalize(env, seen, norm_obs_keys=keys)
    model = make_model("PPO", training)
    path = handover_marl.export_policy(model, tmp_path / "policy.npz")
    policy = receivers.make(f"learned:{path}", DATA)
    policy.reset()
    for observation in seen:
        expected, _ = model.predict(training.normalize_obs(observation), deterministic=True)
        np.testing.assert_allclose(policy.act(observation), expected, atol=1e-4)
    env.close()


def test_files_of_encoded_models_need_no_export(tmp_path: Path) -> None:
    """Files of encoded models can be read directly, because their action space records how inputs are encoded."""
    env = make_env()
    seen, model = collect(env, 1), make_model("PPO", env)
    model.save(tmp_path / "model.zip")
    policy = receivers.make(f"learned:{tmp_path / 'model.zip'}", DATA, trust=True)
    assert policy.hold_time == 0.2
    for made in (policy, handover_marl.as_receiver(tmp_path / "model.zip", trust=True).make(DATA)):
        expected, _ = model.predict(seen[0], deterministic=True)
        np.testing.assert_allclose(made.evaluate(seen[0]), expected, atol=1e-5)  # type: ignore[attr-defined]
    with pytest.raises(DataFormatError, match="must be for the giver, got one for the receiver"):
        handover_marl.as_giver(tmp_path / "model.zip", trust=True)
    with pytest.raises(OptionError, match=r"control_period must be 0\.2 as in training, got 0\.1"):
        handover_marl.as_receiver(tmp_path / "model.zip", control_period=0.1, trust=True)
    other = {"features": "close", "action_scheme": "grasp_servo", "trust": True}
    with pytest.raises(OptionError, match=r"must accept features of shape \(1, 12\)"):
        handover_marl.as_receiver(tmp_path / "model.zip", **other).make(DATA)
    env.close()


def test_models_that_record_nothing(tmp_path: Path) -> None:
    """A model of another environment, with inputs and outputs of the same sizes, requires the missing options."""

    class Elsewhere(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (64,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)

        def reset(self, **_: Any) -> Any:
            return np.zeros(64, np.float32), {}

    model = make_model("PPO", Elsewhere())
    with pytest.raises(OptionError, match="agent must be given, because the model does not record it"):
        handover_marl.export_policy(model, tmp_path / "policy.npz")
    with pytest.raises(OptionError, match="features must be given, because the model does not record it"):
        handover_marl.as_receiver(model)
    handover_marl.export_policy(model, tmp_path / "policy.npz", **NAMES)
    model.save(tmp_path / "model.zip")
    with pytest.raises(OptionError, match="features must be given"):
        handover_marl.as_receiver(tmp_path / "model.zip", trust=True)
    inputs = np.ones(64, np.float32)
    expected, _ = model.predict(inputs, deterministic=True)
    for policy in (model, tmp_path / "model.zip", tmp_path / "policy.npz"):
        options = {} if str(policy).endswith(".npz") else CHOICES["receiver"]
        made: Any = handover_marl.as_receiver(policy, **options, trust=True).make(DATA)
        np.testing.assert_allclose(made.evaluate(inputs), expected, atol=1e-5)


@pytest.mark.parametrize("activation", ["Tanh", "ReLU", "ELU", "LeakyReLU", "SiLU", "Sigmoid", "Identity"])
def test_modules_of_dense_layers(activation: str, tmp_path: Path) -> None:
    net = make_net(activation=getattr(torch.nn, activation))
    for module in (net, torch.nn.Sequential(net, torch.nn.Tanh())):
        found = read_policy(handover_marl.export_policy(module, tmp_path / "p.npz", **NAMES), "receiver")[1]
        inputs = np.linspace(-3, 3, 64, dtype=np.float32)
        with torch.no_grad():
            expected = module(torch.from_numpy(inputs)[None])[0].numpy()
        np.testing.assert_allclose(found(inputs), expected, atol=1e-5)
        assert net.training


class Functional(torch.nn.Module):  # type: ignore[misc, name-defined]
    """Module with an activation in `forward`, dropout, and a layer without bias."""

    def __init__(self, faulty: bool = False) -> None:
        super().__init__()
        self.first, self.last = torch.nn.Linear(64, 16, bias=False), torch.nn.Linear(16, 7)
        self.dropout, self.faulty = torch.nn.Dropout(0.5), faulty

    def forward(self, inputs: Any) -> Any:
        outputs = self.last(self.dropout(torch.relu(self.first(inputs))))
        return outputs**2 if self.faulty else outputs


def test_given_activations_are_compared_with_the_module() -> None:
    net = make_net(activation=torch.nn.ReLU)
    assert dense_network_from_module(net, "relu").activation == "relu"
    with pytest.raises(DataFormatError, match=r"one activation between them \(tanh\)"):
        dense_network_from_module(net, "tanh")
    squashed = dense_network_from_module(torch.nn.Sequential(net, torch.nn.Tanh()), "relu")
    assert (squashed.activation, squashed.output) == ("relu", "tanh")
    with torch.no_grad():
        net[-1].weight.mul_(0.001)
        net[-1].bias.zero_()
    assert dense_network_from_module(net, "relu").output == "identity"


def test_modules_with_functional_activations(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = Functional()
    found = read_policy(handover_marl.export_policy(net, tmp_path / "p.npz", **NAMES), "receiver")[1]
    inputs = np.linspace(-1, 1, 64, dtype=np.float32)
    with torch.no_grad():
        np.testing.assert_allclose(found(inputs), net.eval()(torch.from_numpy(inputs)[None])[0], atol=1e-5)


@pytest.mark.parametrize(
    ("make", "error", "fault"),
    [
        (lambda: Functional(faulty=True), DataFormatError, "must consist of linear layers with one activation"),
        (lambda: torch.nn.Sequential(torch.nn.Linear(64, 7), torch.nn.LayerNorm(7)), DataFormatError, "must consist"),
        (lambda: torch.nn.Conv1d(64, 7, 1), DataFormatError, "must have one bias vector per weight matrix, got 0"),
        (lambda: torch.nn.Linear(64, 6), DataFormatError, "64 inputs .* 7 outputs .* got 64 and 6"),
        (lambda: lambda inputs: inputs, OptionError, "model must be a model of Stable-Baselines3 or a PyTorch"),
    ],
)
def test_other_modules_are_refused(make: Callable[[], Any], error: type, fault: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=fault):
        handover_marl.export_policy(make(), tmp_path / "p.npz", **NAMES)
    assert not list(tmp_path.iterdir())
