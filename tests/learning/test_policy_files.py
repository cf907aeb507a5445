"""Tests of reading policy files of all kinds, without running code in them."""

import base64
import itertools
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl import givers, receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError, HandoverError, OptionError, UnsafeFileError
from handover_marl.learning.adapters.function_policy import LearnedPolicy
from handover_marl.learning.features import count_features
from handover_marl.learning.policy_files import read_policy, write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.policies.policy import Policy

RAN = "HANDOVER_MARL_TEST_CODE_RAN"


class Evil:
    """Object that runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.environ[{RAN!r}] = '1'",)


@pytest.fixture(autouse=True)
def _no_code_ran(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.delenv(RAN, raising=False)
    yield
    assert RAN not in os.environ
    monkeypatch.delenv(RAN, raising=False)


def network(n_inputs: int, n_outputs: int, **options: str) -> DenseNetwork:
    rng = np.random.default_rng(0)
    sizes = [n_inputs, 8, n_outputs]
    weights = tuple(rng.normal(0, 0.1, (b, a)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    return DenseNetwork(weights, tuple(np.zeros(len(w), np.float32) for w in weights), **options)


def offer_file(path: Path) -> Path:
    write_policy(
        path, PolicySpec("giver", "giver", "offer", origin="a test"), network(count_features("giver", "giver"), 7)
    )
    return path


def test_written_policy_is_read_back(tmp_path: Path) -> None:
    spec = PolicySpec("receiver", "grasp", "cartesian_delta", 0.2, "a test")
    wanted = network(count_features("receiver", "grasp"), 7, activation="relu", output="tanh")
    write_policy(tmp_path / "policy.npz", spec, wanted)
    found, function, label = read_policy(tmp_path / "policy.npz", "receiver")
    assert found == spec
    assert label.startswith("policy@")
    seen = np.linspace(-1, 1, wanted.n_inputs, dtype=np.float32)
    np.testing.assert_array_equal(function(seen), wanted(seen))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": "smell"}, "features of the giver 'smell'; valid: giver"),
        ({"actions": "cartesian_delta"}, "action scheme of the giver"),
        ({"actions": "deviation"}, r"outputs of shape \(1, 8\) for action scheme 'deviation', got shape \(7,\)"),
        ({"agent": "receiver"}, "policy must be for the giver, got one for the receiver"),
        ({"control_period": -1.0}, "control_period must be a time from 0.001 to 60 s, got -1.0"),
    ],
)
def test_policies_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    spec = PolicySpec(**({"agent": "giver", "features": "giver", "actions": "offer"} | change))
    write_policy(tmp_path / "policy.npz", spec, network(39, 7))
    with pytest.raises(HandoverError, match=message):
        givers.make(f"learned:{tmp_path / 'policy.npz'}")


def test_networks_that_are_none() -> None:
    good, bias = np.zeros((3, 2), np.float32), np.zeros(3, np.float32)
    for weights, biases in (((), ()), ((good,), (bias[:2],)), ((good, good), (bias, bias)), ((good[0],), (bias,))):
        with pytest.raises(DataFormatError):
            DenseNetwork(weights, biases)
    with pytest.raises(DataFormatError, match="not finite"):
        DenseNetwork((np.full_like(good, np.nan),), (bias,))
    with pytest.raises(DataFormatError, match="unknown activation 'sine'; valid: tanh"):
        DenseNetwork((good,), (bias,), activation="sine")


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(DataFormatError):
        read_policy(path, "giver")


def test_pickles_in_npz_files_are_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    np.savez(path, about=np.array([Evil()], dtype=object))
    with pytest.raises(DataFormatError, match="not a policy file"):
        givers.make(f"learned:{path}", trust=True)


def view(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    partner = "hold" if name == "Giver" else "replay"
    return gymnasium.make(
        f"HandoverMARL/{name}-v0",
        partner=partner,
        dataset="synthetic",
        physics="fast",
        disable_env_checker=True,
        **options,
    )


def make_policy(path: Path, agent: str, **options: Any) -> Policy:
    name, module = f"learned:{path}", givers if agent == "giver" else receivers
    return module.make((name, options) if options else name, SyntheticDataset(), trust=True)


def trained(path: Path, env: Any, policy: str = "MultiInputPolicy", **options: Any) -> Path:
    """Train PPO for a few steps, and return the path of the saved model."""
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    options = {"policy_kwargs": {"net_arch": [8]}, "seed": 0} | options
    sb3.PPO(policy, env, n_steps=8, batch_size=8, n_epochs=1, **options).learn(8).save(path)
    env.close()
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PPO", "SAC", "TD3", "A2C", "DDPG"])
@pytest.mark.parametrize("name", ["Giver", "Receiver"])
def test_stable_baselines_policies_act_as_they_do_there(tmp_path: Path, kind: str, name: str) -> None:
    """Learned policies act as their models do, also with weights so large that outputs exceed the space's bounds."""
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    env = view(name)
    options = {"buffer_size": 100} if kind in ("SAC", "TD3", "DDPG") else {}
    model = getattr(sb3, kind)("MultiInputPolicy", env, policy_kwargs={"net_arch": [16, 16]}, seed=0, **options)
    seen, _ = env.reset(seed=0)
    at_bounds = 0
    for scale, atol in ((1.0, 2e-5), (100.0, 1e-4)):
        for parameter in model.policy.parameters():
            parameter.data *= scale
        model.save(tmp_path / "policy.zip")
        policy = make_policy(tmp_path / "policy.zip", name.lower())
        assert isinstance(policy, LearnedPolicy)
        assert policy.hold_time == 0.1
        policy.reset()
        for _ in range(3):
            expected, _ = model.predict(seen, deterministic=True)
            action = policy.act(seen)
            assert action.dtype == np.float32
            np.testing.assert_allclose(action, expected, rtol=0, atol=atol)
            space = env.action_space
            assert isinstance(space, gymnasium.spaces.Box)
            at_bounds += int(((expected == space.low) | (expected == space.high)).sum())
            seen, *_ = env.step(expected)
    assert at_bounds > 6, "the bounds mattered"
    env.close()


def test_policies_of_flat_observations_act_as_in_stable_baselines(tmp_path: Path) -> None:
    env = view("Receiver")
    path = trained(tmp_path / "flat.zip", gymnasium.wrappers.FlattenObservation(view("Receiver")), "MlpPolicy")
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    model = sb3.PPO.load(path, device="cpu")
    seen, _ = env.reset(seed=0)
    expected, _ = model.predict(gymnasium.spaces.flatten(env.observation_space, seen), deterministic=True)
    policy = make_policy(path, "receiver")
    policy.reset()
    np.testing.assert_allclose(policy.act(seen), expected, atol=2e-5)
    env.close()


def test_files_of_stable_baselines_need_trust(tmp_path: Path) -> None:
    path = tmp_path / "policy.zip"
    with zipfile.ZipFile(path, "w") as archive:
        about = {"policy_class": {":serialized:": base64.b64encode(pickle.dumps(Evil())).decode()}}
        archive.writestr("data", json.dumps(about))
    for make in (lambda: givers.make(f"learned:{path}"), lambda: handover_marl.as_giver(path)):
        with pytest.raises(UnsafeFileError, match=r"can run code; pass trust=True \(--trust\)"):
            make()


@pytest.mark.slow
def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    squashed = {"use_sde": True, "policy_kwargs": {"net_arch": [8], "squash_output": True}}
    other = {"policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.GELU}}
    for options, fault in (
        (squashed, "computes something else"),
        (other, "activation of the PPO model must be one of"),
    ):
        path = trained(tmp_path / "policy.zip", view("Receiver"), **options)
        with pytest.raises(DataFormatError, match=fault):
            make_policy(path, "receiver")
    path = trained(tmp_path / "giver.zip", view("Giver", control_period=0.5))
    assert make_policy(path, "giver").hold_time == 0.5
    with pytest.raises(OptionError, match=r"must be 0\.5 as in training, got 0\.1"):
        make_policy(path, "giver", control_period=0.1)
    with pytest.raises(DataFormatError, match="must be for the receiver, got one for the giver"):
        make_policy(path, "receiver")
    path.write_bytes(b"no model")
    with pytest.raises(DataFormatError, match="not a model of Stable-Baselines3"):
        make_policy(path, "giver")
    rescaled = gymnasium.wrappers.RescaleAction(view("Receiver"), -1.0, 1.0)
    with pytest.raises(OptionError, match="features must be given, because the model does not record it"):
        make_policy(trained(path, rescaled), "receiver")
