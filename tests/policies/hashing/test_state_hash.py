from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from handover_marl.datasets import open_dataset
from handover_marl.errors import ResultsError
from handover_marl.evaluation.benchmark import benchmark
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.policies.hashing.state_hash import hash_constructed_state, record_opened_files
from handover_marl.policies.policy import Action, Policy
from handover_marl.policies.reference import parse_policy
from handover_marl.receivers import Receiver


class Weighted(Receiver):
    """Receiver whose state is an array that it reads from a file, or any object that is passed."""

    name = "weighted"

    def __init__(self, weights: str = "", state: Any = None) -> None:
        if weights:
            self._target = np.load(weights)
        self._state = state

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: dict[str, Any]) -> Action:
        return np.zeros(9, dtype=np.float32)


class Holder:
    def __init__(self, content: Any) -> None:
        self.content = content


def hash_of(policy: Policy) -> bytes:
    return hash_constructed_state(policy, set())


def states(value: float) -> dict[str, Any]:
    layer = torch.nn.Linear(2, 2)
    torch.nn.init.constant_(layer.weight, value)
    torch.nn.init.zeros_(layer.bias)
    array = np.full(3, value)
    return {
        "array": array,
        "tensor": torch.full((3,), value, requires_grad=True),
        "network": layer,
        "list": [1, "a", array],
        "dictionary": {"a": {"b": array}},
        "object": Holder(Holder(layer)),
    }


@pytest.mark.parametrize("kind", states(0.0))
def test_arrays_and_tensors_are_hashed(kind: str) -> None:
    hashes = [hash_of(Weighted(state=states(value)[kind])) for value in (1.0, 1.0, 2.0)]
    assert hashes[0]
    assert hashes[0] == hashes[1]
    assert hashes[0] != hashes[2]


def test_a_policy_without_arrays_has_no_hash() -> None:
    assert hash_of(Weighted()) == b""
    assert hash_of(Weighted(state=[1, "a", None, np])) == b""


def test_loops_of_objects_end() -> None:
    holder = Holder(None)
    holder.content = [holder, np.ones(2)]
    assert hash_of(Weighted(state=holder))


def test_opened_files_are_hashed_and_code_is_not(tmp_path: Path) -> None:
    path, code = tmp_path / "w.bin", tmp_path / "code.py"
    path.write_bytes(b"1")
    code.write_text("x = 1")
    with record_opened_files() as opened:
        path.read_bytes()
        code.read_text()
        Path("/proc/self/stat").read_text()
    assert str(path) in opened
    first = hash_constructed_state(Weighted(), opened)
    code.write_text("x = 2")
    assert hash_constructed_state(Weighted(), opened) == first != b""
    path.write_bytes(b"2")
    assert hash_constructed_state(Weighted(), opened) != first


def test_the_hash_of_a_registered_policy_has_no_state() -> None:
    reference = parse_policy("receiver", "yang2021").resolve(open_dataset("synthetic"))
    assert reference.code_hash.count(".") == 1


def test_results_of_other_weights_are_not_mixed(tmp_path: Path) -> None:
    weights, out = tmp_path / "w.npy", tmp_path / "out"
    options: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "workers": 1, "progress": False, "out": out}
    np.save(weights, np.zeros(9))
    benchmark("s0", "val", (Weighted, {"weights": str(weights)}), scenes=[9], **options)
    report = benchmark("s0", "val", (Weighted, {"weights": str(weights)}), scenes=[9, 14], **options)
    assert "1 of the 2 episodes come from an earlier run" in str(report)
    np.save(weights, np.ones(9))
    with pytest.raises(ResultsError, match="receiver hash"):
        benchmark("s0", "val", (Weighted, {"weights": str(weights)}), scenes=[9, 14, 19], **options)
    assert len(evaluate(out).episodes) == 2
