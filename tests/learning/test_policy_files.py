"""Policies on disk: what may be loaded, and that nothing in a file runs."""

import io
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
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError, UnsafeFileError
from handover_marl.learning.network import Network
from handover_marl.learning.observing import n_features
from handover_marl.learning.policy import LearnedPolicy, PolicySpec
from handover_marl.learning.policy_files import read_policy, write_policy

RAN = "HANDOVER_MARL_TEST_CODE_RAN"


class Evil:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.environ[{RAN!r}] = '1'",)


@pytest.fixture(autouse=True)
def _nothing_ran(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.delenv(RAN, raising=False)
    yield
    assert RAN not in os.environ
    monkeypatch.delenv(RAN, raising=False)


def network(n_inputs: int, n_outputs: int, **options: str) -> Network:
    rng = np.random.default_rng(0)
    sizes = [n_inputs, 8, n_outputs]
    weights = tuple(rng.normal(0, 0.1, (b, a)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    return Network(weights, tuple(np.zeros(len(w), np.float32) for w in weights), **options)


def offer_file(path: Path) -> Path:
    write_policy(path, PolicySpec("giver", "giver", "offer", origin="a test"), network(n_features("giver", "giver"), 7))
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    spec = PolicySpec("receiver", "grasp", "cartesian_delta", 0.2, "a test")
    wanted = network(n_features("receiver", "grasp"), 7, activation="relu", output="tanh")
    write_policy(tmp_path / "policy.npz", spec, wanted)
    found = read_policy(tmp_path / "policy.npz", "receiver")
    assert found.spec == spec
    assert found.label.startswith("policy@")
    seen = np.linspace(-1, 1, wanted.n_inputs, dtype=np.float32)
    np.testing.assert_array_equal(found.function(seen), wanted(seen))


def test_a_giver_from_a_file_is_named_by_its_content(tmp_path: Path) -> None:
    first, second = offer_file(tmp_path / "policy.npz"), tmp_path / "other" / "policy.npz"
    second.parent.mkdir()
    write_policy(
        second, PolicySpec("giver", "giver", "offer", origin="another"), network(n_features("giver", "giver"), 7)
    )
    labels = [givers.make(f"learned:{path}").label for path in (first, second)]
    assert labels[0] != labels[1]
    assert all(label.startswith("learned:policy@") for label in labels)
    assert givers.make("learned").label == "learned"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": "smell"}, "features of the giver 'smell'; valid: giver"),
        ({"actions": "cartesian_delta"}, "action scheme of the giver"),
        ({"actions": "deviation"}, "gives 7; features 'giver' are 39 and actions 'deviation' are 8"),
        ({"agent": "receiver"}, "this policy is a receiver's; a giver's is wanted"),
        ({"control_period": -1.0}, "control period of -1.0 s"),
        ({"control_period": "soon"}, "control_period is 'soon'"),
    ],
)
def test_policies_that_do_not_fit(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    spec = PolicySpec(**({"agent": "giver", "features": "giver", "actions": "offer"} | change))
    write_policy(tmp_path / "policy.npz", spec, network(39, 7))
    with pytest.raises(HandoverError, match=message):
        givers.make(f"learned:{tmp_path / 'policy.npz'}")


def test_networks_that_are_none() -> None:
    good, bias = np.zeros((3, 2), np.float32), np.zeros(3, np.float32)
    for weights, biases in (((), ()), ((good,), (bias[:2],)), ((good, good), (bias, bias)), ((good[0],), (bias,))):
        with pytest.raises(DataFormatError):
            Network(weights, biases)
    with pytest.raises(DataFormatError, match="not finite"):
        Network((np.full_like(good, np.nan),), (bias,))
    with pytest.raises(DataFormatError, match="unknown activation 'sine'; valid: tanh"):
        Network((good,), (bias,), activation="sine")


def test_files_that_are_not_there_or_of_no_known_kind(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match="no such policy file"):
        givers.make(f"learned:{tmp_path / 'none.npz'}")
    (tmp_path / "policy.txt").write_text("hello")
    with pytest.raises(OptionError, match=r"policy files are \.npz, \.zip"):
        givers.make(f"learned:{tmp_path / 'policy.txt'}")
    with pytest.raises(OptionError, match="giver 'replay' is not made from a file"):
        givers.make(f"replay:{tmp_path / 'policy.npz'}")
    with pytest.raises(OptionError, match="needs a policy file: learned:FILE"):
        receivers.make("learned", SyntheticDataset())


@given(st.binary(max_size=300))
def test_noise_is_no_policy(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(DataFormatError):
        read_policy(path, "giver")


def test_a_file_cut_in_half(tmp_path: Path) -> None:
    path = offer_file(tmp_path / "policy.npz")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataFormatError, match="no policy file of handover_marl"):
        read_policy(path, "giver")


def test_pickles_in_our_files_are_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    np.savez(path, about=np.array([Evil()], dtype=object))
    with pytest.raises(DataFormatError, match="no policy file"):
        givers.make(f"learned:{path}", trust=True)


def zipped(path: Path, weights: bytes, data: bytes = b"{}") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", data)
        archive.writestr("policy.pth", weights)
    return path


def test_foreign_pickles_in_place_of_weights(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    stream = io.BytesIO()
    torch.save({"action_net.weight": Evil()}, stream)
    for content in (stream.getvalue(), pickle.dumps(Evil())):
        with pytest.raises(UnsafeFileError, match="more than weights"):
            givers.make(f"learned:{zipped(tmp_path / 'policy.zip', content)}", trust=True)


def test_pickles_in_the_description_are_left_alone(tmp_path: Path) -> None:
    """Stable-Baselines3 keeps Python objects as pickles in its JSON; loading the weights does not need them."""
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    env = gymnasium.make("HandoverMARL/Giver-v0", partner="hold", dataset="synthetic", physics="fast")
    model = sb3.PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, policy_kwargs={"net_arch": [16]})
    model.save(tmp_path / "ppo.zip")
    import base64

    with zipfile.ZipFile(tmp_path / "ppo.zip") as archive:
        about, weights = json.loads(archive.read("data")), archive.read("policy.pth")
    for value in about.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = base64.b64encode(pickle.dumps(Evil())).decode()
    givers.make(f"learned:{zipped(tmp_path / 'evil.zip', weights, json.dumps(about).encode())}")
    env.close()


@pytest.mark.parametrize("kind", ["PPO", "SAC", "TD3", "A2C"])
@pytest.mark.parametrize("name", ["Giver", "Receiver"])
def test_stable_baselines_policies_act_as_they_do_there(tmp_path: Path, kind: str, name: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    partner = "hold" if name == "Giver" else "replay"
    env = gymnasium.make(f"HandoverMARL/{name}-v0", partner=partner, dataset="synthetic", physics="fast")
    options = {"buffer_size": 100} if kind in ("SAC", "TD3") else {}
    model = getattr(sb3, kind)("MultiInputPolicy", env, policy_kwargs={"net_arch": [16, 16]}, seed=0, **options)
    model.save(tmp_path / "policy.zip")
    found = read_policy(tmp_path / "policy.zip", name.lower())
    policy = LearnedPolicy(found.spec, found.function, receivers.context_of(SyntheticDataset()))
    space = giver_action_space() if name == "Giver" else receiver_action_space()
    seen, _ = env.reset(seed=0)
    for _ in range(3):
        expected, _ = model.predict(seen, deterministic=True)
        np.testing.assert_allclose(np.clip(policy.act(seen), space.low, space.high), expected, atol=2e-5)
        seen, *_ = env.step(expected)
    env.close()


def scripted(path: Path, n_inputs: int, n_outputs: int) -> Path:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")
    torch.manual_seed(0)
    torch.jit.script(torch.nn.Linear(n_inputs, n_outputs)).save(path)
    return path


def test_torch_script_is_code_and_wants_trust(tmp_path: Path) -> None:
    path = scripted(tmp_path / "policy.pt", n_features("giver", "flat_giver"), 8)
    with pytest.raises(UnsafeFileError, match="is code; pass trust=True"):
        givers.make(f"learned:{path}")
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast")
    seen: Observation = env.reset(seed=0)[0]["giver"]
    assert givers.make(f"learned:{path}", trust=True).act(seen).shape == (8,)
    env.close()


def test_torch_script_of_other_spaces(tmp_path: Path) -> None:
    n_inputs = n_features("giver", "flat_giver")
    with pytest.raises(DataFormatError, match=f"takes the {n_inputs} numbers"):
        givers.make(f"learned:{scripted(tmp_path / 'a.pt', 5, 8)}", trust=True)
    with pytest.raises(DataFormatError, match=r"gives \(1, 9\)"):
        givers.make(f"learned:{scripted(tmp_path / 'b.pt', n_inputs, 9)}", trust=True)
    (tmp_path / "c.pt").write_bytes(b"no torch script")
    with pytest.raises(DataFormatError, match="no TorchScript policy"):
        givers.make(f"learned:{tmp_path / 'c.pt'}", trust=True)
