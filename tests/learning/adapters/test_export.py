"""Tests of policy files and policies that are made from models of Stable-Baselines3 and modules of PyTorch."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, HandoverError, OptionError
from handover_marl.learning.policy_files import PolicySpec, read_policy

torch = pytest.importorskip("torch", reason="needs the extra `train`")
sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

from handover_marl.learning.adapters.sb3_models import find_input_normalization  # noqa: E402
from tests.learning.adapters.networks import CHOICES, make_net  # noqa: E402

DATA = SyntheticDataset()
NAMES: dict[str, Any] = {"agent": "receiver", **CHOICES["receiver"]}
OFF_POLICY = ("SAC", "TD3", "DDPG")


def make_env(name: str, **options: Any) -> Any:
    partner = "hold" if name == "Giver" else "replay"
    options |= {"dataset": "synthetic", "physics": "fast", "disable_env_checker": True}
    return gymnasium.make(f"HandoverMARL/{name}-v0", partner=partner, **options)


@pytest.fixture(scope="module")
def encoded() -> Iterator[Any]:
    """Return an environment with features and action scheme, and the control period 0.2 s."""
    options: Any = {"dataset": "synthetic", "physics": "fast", "control_period": 0.2, "obs_mode": "state+depth"}
    env = handover_marl.control_agent(handover_marl.parallel_env(**options), "receiver", "replay")
    choice = CHOICES["receiver"]
    env = handover_marl.encode(env, choice["features"], choice["action_scheme"], api="gymnasium")
    yield env
    env.close()


def make_model(kind: str, env: Any, scale: float = 20.0, **options: Any) -> Any:
    """Return a model, by default with weights so large that outputs leave their bounds."""
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
    options |= (
        {"buffer_size": 10} if kind in OFF_POLICY else {"n_steps": 2} | ({"batch_size": 2} if kind == "PPO" else {})
    )
    options["policy_kwargs"] = {"net_arch": [16], **options.get("policy_kwargs", {})}
    model = getattr(sb3, kind)(policy, env, seed=0, device="cpu", **options)
    for parameter in model.policy.parameters():
        parameter.data *= scale
    return model


def normalize(env: Any, observations: list[Any], **options: Any) -> VecNormalize:
    """Return the environment in a VecNormalize that has the statistics of some observations."""
    wrapped = VecNormalize(DummyVecEnv([lambda: env]), **options)
    for observation in observations:
        if isinstance(observation, dict):
            for key, statistics in wrapped.obs_rms.items():
                statistics.update(observation[key][None])
        else:
            wrapped.obs_rms.update(observation[None])
    return wrapped


def collect(env: Any, count: int = 4) -> list[Any]:
    env.action_space.seed(0)
    return [env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(count))]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PPO", "A2C", "SAC", "TD3"])
def test_encoded_models_act_as_there(kind: str, encoded: Any, tmp_path: Path) -> None:
    seen = collect(encoded)
    for training in (encoded, normalize(encoded, seen, clip_obs=0.5)):
        is_normalized = training is not encoded
        model = make_model(kind, training)
        path = handover_marl.export_policy(model, tmp_path / "policy.npz", origin="a test")
        spec, network, _ = read_policy(path, "receiver")
        assert spec == PolicySpec("receiver", "grasp", "cartesian_delta", 0.2, "a test", "state+depth")
        for observation in seen:
            inputs = training.normalize_obs(observation) if is_normalized else observation
            expected, _ = model.predict(inputs, deterministic=True)
            # Features without normalization are large, and processors sum their products in different orders.
            np.testing.assert_allclose(network(observation), expected, atol=1e-5 if is_normalized else 1e-4)
        direct: Any = handover_marl.as_receiver(model).make(DATA)
        assert (direct.hold_time, direct.obs_mode) == (0.2, "state+depth")
        np.testing.assert_array_equal(direct.function(seen[0]), network(seen[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"), [("PPO", "Giver"), ("A2C", "Receiver"), ("SAC", "Giver"), ("DDPG", "Receiver")]
)
def test_models_of_plain_environments(kind: str, name: str) -> None:
    env, agent = make_env(name, control_period=0.5), name.lower()
    seen, at_bounds, space = collect(env, 1), 0, env.action_space
    for scale, atol in ((1.0, 2e-5), (50.0, 1e-4)):
        model = make_model(kind, env, scale)
        policy = getattr(handover_marl, f"as_{agent}")(model).make(DATA)
        assert policy.hold_time == 0.5
        policy.reset()
        for observation in seen:
            expected, _ = model.predict(observation, deterministic=True)
            np.testing.assert_allclose(policy.act(observation), expected, rtol=0, atol=atol)
            at_bounds += int(((expected == space.low) | (expected == space.high)).sum())
    assert at_bounds > 4, "the bounds mattered"
    env.close()


@pytest.mark.parametrize("keys", [None, ["robot_joint_position", "time"]])
def test_normalized_observations_of_plain_environments(keys: list[str] | None, tmp_path: Path) -> None:
    env = make_env("Receiver")
    seen = collect(env, 2)
    training = normalize(env, seen, norm_obs_keys=keys)
    model = make_model("PPO", training)
    policy = receivers.make(f"learned:{handover_marl.export_policy(model, tmp_path / 'policy.npz')}", DATA)
    policy.reset()
    for observation in seen:
        expected, _ = model.predict(training.normalize_obs(observation), deterministic=True)
        np.testing.assert_allclose(policy.act(observation), expected, atol=1e-4)
    env.close()


def test_normalization_equals_that_of_vec_normalize_to_the_bit(encoded: Any) -> None:
    seen = collect(encoded)
    wrapped = normalize(encoded, seen, clip_obs=1.0)
    normalization = find_input_normalization(wrapped)
    assert normalization is not None
    for observation in seen:
        np.testing.assert_array_equal(normalization(observation), wrapped.normalize_obs(observation))
    assert find_input_normalization(VecNormalize(DummyVecEnv([lambda: encoded]), norm_obs=False)) is None


def test_models_that_do_not_fit_are_refused(encoded: Any, tmp_path: Path) -> None:
    model = make_model("PPO", encoded)
    plain = make_env("Receiver")
    rescaled = make_model("PPO", gymnasium.wrappers.RescaleAction(plain, -1.0, 1.0))
    squashed = make_model("PPO", plain, use_sde=True, policy_kwargs={"squash_output": True})
    gelu = make_model("PPO", plain, policy_kwargs={"activation_fn": torch.nn.GELU})
    other = {"features": "close", "action_scheme": "grasp_servo"}
    for policy, options, fault in (
        (model, {"control_period": 0.1}, r"control_period must be 0\.2 as in training, got 0\.1"),
        (model, other, "must have 12 inputs and 7 outputs, got 64 and 7"),
        (squashed, {}, "computes something else"),
        (make_model("PPO", gymnasium.wrappers.NormalizeObservation(encoded)), {}, "normalized by VecNormalize, got"),
        (gelu, {}, "must consist of linear layers with one activation"),
        (rescaled, {}, "features must be given, because the model does not record it"),
    ):
        with pytest.raises(HandoverError, match=fault):
            handover_marl.as_receiver(policy, **options).make(DATA)
    with pytest.raises(DataFormatError, match="must be for the giver, got one for the receiver"):
        handover_marl.as_giver(model)
    with pytest.raises(OptionError, match="agent must be given, because the model does not record it"):
        handover_marl.export_policy(rescaled, tmp_path / "policy.npz")


class Functional(torch.nn.Module):  # type: ignore[misc, name-defined]
    """Module with an activation in `forward`, dropout, and a layer without bias."""

    def __init__(self, faulty: bool = False) -> None:
        super().__init__()
        self.first, self.last = torch.nn.Linear(64, 16, bias=False), torch.nn.Linear(16, 7)
        self.dropout, self.faulty = torch.nn.Dropout(0.5), faulty

    def forward(self, inputs: Any) -> Any:
        outputs = self.last(self.dropout(torch.relu(self.first(inputs))))
        return outputs**2 if self.faulty else outputs


@pytest.mark.parametrize("activation", ["Tanh", "ReLU", "ELU", "LeakyReLU", "SiLU", "Sigmoid", "Identity", ""])
def test_modules_of_dense_layers(activation: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = make_net(activation=getattr(torch.nn, activation)) if activation else Functional()
    inputs = np.linspace(-3, 3, 64, dtype=np.float32)
    for module in (net, torch.nn.Sequential(net, torch.nn.Tanh())):
        found = read_policy(handover_marl.export_policy(module, tmp_path / "p.npz", **NAMES), "receiver")[1]
        assert module.training
        with torch.no_grad():
            expected = module.eval()(torch.from_numpy(inputs)[None])[0].numpy()
        module.train()
        np.testing.assert_allclose(found(inputs), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: Functional(faulty=True), "must consist of linear layers with one activation"),
        (lambda: torch.nn.Sequential(torch.nn.Linear(64, 7), torch.nn.LayerNorm(7)), "must consist"),
        (lambda: torch.nn.Conv1d(64, 7, 1), "must have one bias vector per weight matrix, got 0"),
        (lambda: torch.nn.Linear(64, 6), "64 inputs .* 7 outputs .* got 64 and 6"),
        (lambda: lambda inputs: inputs, "model must be a model of Stable-Baselines3 or a PyTorch"),
    ],
)
def test_other_modules_are_refused(make: Callable[[], Any], fault: str, tmp_path: Path) -> None:
    with pytest.raises(HandoverError, match=fault):
        handover_marl.export_policy(make(), tmp_path / "p.npz", **NAMES)
    assert not list(tmp_path.iterdir())
