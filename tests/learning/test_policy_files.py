"""Tests of reading policy files of all kinds, without running code in them."""

import base64
import itertools
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl import givers
from handover_marl.errors import DataFormatError, HandoverError, UnsafeFileError
from handover_marl.learning.features import count_features
from handover_marl.learning.policy_files import read_policy, write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec

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
        ({"actions": "deviation"}, "must have 39 inputs and 8 outputs, got 39 and 7"),
        ({"agent": "receiver"}, "policy must be for the giver, got one for the receiver"),
        ({"control_period": -1.0}, "control_period must be a time from 0.001 to 60 s, got -1.0"),
    ],
)
def test_policies_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    spec = PolicySpec(**({"agent": "giver", "features": "giver", "actions": "offer"} | change))
    write_policy(tmp_path / "policy.npz", spec, network(39, 7))
    with pytest.raises(HandoverError, match=message):
        givers.make(f"learned:{tmp_path / 'policy.npz'}")


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


def test_files_of_stable_baselines_need_trust(tmp_path: Path) -> None:
    path = tmp_path / "policy.zip"
    with zipfile.ZipFile(path, "w") as archive:
        about = {"policy_class": {":serialized:": base64.b64encode(pickle.dumps(Evil())).decode()}}
        archive.writestr("data", json.dumps(about))
    for make in (lambda: givers.make(f"learned:{path}"), lambda: handover_marl.as_giver(path)):
        with pytest.raises(UnsafeFileError, match=r"can run code; pass trust=True \(--trust\)"):
            make()
