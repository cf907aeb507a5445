"""Script that trains with a population; the script that it calls writes random networks."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from handover_marl.policies.reference import parse_policy
from tests.learning.training.scripts import script

pytest.importorskip("torch", reason="needs the extra `train`")

SIZES = {"receiver": (12, 7, "close", "grasp_servo"), "giver": (39, 7, "giver", "offer")}


def write(agent: str, path: Path) -> Path:
    n_inputs, n_outputs, features, actions = SIZES[agent]
    weights = np.random.default_rng(0).normal(size=(n_outputs, n_inputs)).astype(np.float32)
    network = DenseNetwork((weights,), (np.zeros(n_outputs, np.float32),))
    write_policy(path, PolicySpec(agent, features, actions, 0.1), network)
    return path


@pytest.fixture
def calls() -> list[Any]:
    return []


@pytest.fixture
def train(calls: list[Any], monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = script("train_with_population", monkeypatch)

    def train(args: Any) -> Path:
        calls.append(args)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        return write(args.agent, args.out)

    monkeypatch.setattr(module.train_ppo, "main", train)
    return module


@pytest.mark.parametrize(
    ("method", "giver", "features"),
    [
        ("best_response", "replay", ""),
        ("population", "population:population=strangers-v1", ""),
        ("history", "population:population=strangers-v1", "close_stack"),
    ],
)
def test_receivers(method: str, giver: str, features: str, train: ModuleType, calls: list[Any], tmp_path: Path) -> None:
    args = train.Args(dataset="synthetic", method=method, seeds=(3, 5), out=tmp_path)
    paths = train.main(args)
    assert paths == [tmp_path / f"receiver_{method}" / f"{seed}.npz" for seed in (3, 5)]
    assert [(call.partner, call.features, call.seed, call.setup) for call in calls] == [
        (giver, features, seed, "s0") for seed in (3, 5)
    ]
    paths[0].unlink()
    train.main(args)
    assert [call.seed for call in calls[2:]] == [3]


def test_fictitious_co_play(train: ModuleType, calls: list[Any], tmp_path: Path) -> None:
    common = {"dataset": "synthetic", "method": "fictitious_co_play", "out": tmp_path, "pairs": 2, "seeds": (0,)}
    (receiver,) = train.main(train.Args(**common))
    (giver,) = train.main(train.Args(**common, agent="giver"))
    policies = [parse_policy("receiver", calls[8].partner), parse_policy("giver", calls[8].partner)]
    assert receiver == tmp_path / "receiver_fictitious_co_play" / "0.npz"
    for policy in (policies[1], parse_policy("receiver", calls[9].partner)):
        made: Any = policy.make(SyntheticDataset())
        assert len(made.members) == 4
    assert [call.decisions for call in calls[:4]] == [6144, 12288, 4096, 8192]
    assert calls[2].partner == calls[3].partner == f"learned:{tmp_path}/pairs/receiver_final_1000.npz"
    assert len(calls) == 10
    assert giver.is_file()


def test_policies_of_other_arguments_are_not_taken(train: ModuleType, tmp_path: Path) -> None:
    args = {"dataset": "synthetic", "method": "best_response", "out": tmp_path, "seeds": (0,)}
    train.main(train.Args(**args))
    with pytest.raises(ResultsError, match=r"other arguments \(partner\)"):
        train.main(train.Args(**args, partner="noisy"))
