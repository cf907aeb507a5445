"""Tests that names in files import no module unless the caller trusts the file or passes the name."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.errors import HandoverError, UnsafeFileError
from handover_marl.evaluation.comparison import compare
from handover_marl.evaluation.reports.report import load_report
from handover_marl.evaluation.strangers.protocol import strangers
from handover_marl.evaluation.verification import verify
from handover_marl.learning.encodings.registry import count_features
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from handover_marl.policies.populations import load_population
from handover_marl.policies.reference import parse_policy
from tests.evaluation.strangers.populations import GIVERS, RECEIVERS, write_population

pytestmark = pytest.mark.slow

MODULE = "module_of_a_stranger"
CODE = f"""
from pathlib import Path
from handover_marl.givers.variations import HurriedGiver
from handover_marl.learning.encodings.custom import declare_size
from handover_marl.receivers.baselines import HoldReceiver

Path("imported").touch()

class OwnGiver(HurriedGiver):
    name = "{MODULE}:OwnGiver"

class OwnReceiver(HoldReceiver):
    name = "own"

@declare_size(2)
def features(observation):
    raise NotImplementedError

@declare_size(9)
def scheme(outputs, observation):
    raise NotImplementedError
"""
ENCODING = {"features": f"{MODULE}:features", "actions": f"{MODULE}:scheme"}
SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=100))
VERIFY: Any = {"workers": 1, "progress": False, "world_config": SHORT}
DATA = open_dataset("synthetic")


@pytest.fixture(autouse=True)
def planted_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put a module into the working folder, which is searched for modules."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path(f"{MODULE}.py").write_text(CODE)
    yield
    sys.modules.pop(MODULE, None)


def write_strangers_population(agent: str = "giver") -> Path:
    entries = [dict(each) for each in (GIVERS if agent == "giver" else RECEIVERS)]
    entries[-1]["policy"] = f"{MODULE}:Own{agent.capitalize()}"
    return write_population(Path(), **{f"{agent}s": entries})


def write_results(giver: str = f"{MODULE}:OwnGiver") -> Path:
    """Write a result folder that names a giver."""
    options: Any = {"physics": "fast", "dataset": "synthetic", "progress": False, "workers": 1, "world_config": SHORT}
    handover_marl.evaluate_pair("hurried", "hold", "s0", "val", scenes=[19], out="results", overwrite=True, **options)
    content = yaml.safe_load(Path("results/config.yaml").read_text())
    content["HANDOVER_MARL"]["giver"] = giver
    Path("results/config.yaml").write_text(yaml.safe_dump(content))
    return Path("results")


def make_receiver(policy: Any, trust: bool) -> None:
    parse_policy("receiver", policy, trust).make(DATA)


def write_npz(control_period: float = 0.1, **names: str) -> str:
    chosen = {"features": "close", "actions": "receiver"} | names
    size = 2 if chosen["features"] == ENCODING["features"] else count_features("receiver", chosen["features"])
    network = DenseNetwork((np.zeros((9, size), np.float32),), (np.zeros(9, np.float32),))
    write_policy(Path("policy.npz"), PolicySpec("receiver", control_period=control_period, **chosen), network)
    return "policy.npz"


def verify_results(trust: bool, **options: Any) -> None:
    verify(write_results(), trust=trust, **VERIFY, **options)


def evaluate_strangers(trust: bool) -> None:
    options: Any = {"dataset": "synthetic", "progress": False, "workers": 1, "trust": trust}
    strangers("hold", population=write_strangers_population(), n_scenes=1, **options)


def play_population(trust: bool) -> None:
    policy = f"population:population={write_strangers_population()},partners=test"
    parse_policy("giver", policy, trust).make(DATA)


READERS: dict[str, Callable[[bool], object]] = {
    "features of learned:FILE": lambda trust: make_receiver(f"learned:{write_npz(**ENCODING)}", trust),
    "action scheme of learned:FILE": lambda trust: make_receiver(
        f"learned:{write_npz(actions=ENCODING['actions'])}", trust
    ),
    "features of as_receiver(npz)": lambda trust: make_receiver(
        handover_marl.as_receiver(write_npz(**ENCODING), trust=trust), False
    ),
    "giver of a result folder": verify_results,
    "givers of a population": lambda trust: parse_policy(
        "giver", load_population(write_strangers_population(), trust).givers[-1].policy
    ),
    "receivers of a population": lambda trust: parse_policy(
        "receiver", load_population(write_strangers_population("receiver"), trust).receivers[-1].policy
    ),
    "policy population": play_population,
}


@pytest.mark.parametrize("reader", READERS)
def test_names_in_files_need_trust(reader: str) -> None:
    with pytest.raises(UnsafeFileError, match=rf"{MODULE}:\w+' must not be imported .* pass trust=True \(--trust\)"):
        READERS[reader](False)
    assert not Path("imported").exists()
    READERS[reader](True)
    assert Path("imported").exists()


@pytest.mark.parametrize(
    "read",
    [
        lambda: evaluate_strangers(False),
        lambda: verify(write_results(f"population:population={write_strangers_population()},partners=test"), **VERIFY),
        lambda: load_report(write_results()),
        lambda: compare(write_results(), "results"),
    ],
    ids=["strangers", "nested", "report", "compare"],
)
def test_other_readers_import_nothing(read: Callable[[], object]) -> None:
    with contextlib.suppress(HandoverError):
        read()
    assert not Path("imported").exists()


def test_what_the_caller_passes_is_imported() -> None:
    verify_results(False, giver=f"{MODULE}:OwnGiver")
    assert Path("imported").exists()
    sys.modules.pop(MODULE)
    Path("imported").unlink()
    chosen = {"features": ENCODING["features"], "action_scheme": ENCODING["actions"]}
    handover_marl.as_receiver(lambda features: np.zeros(9), **chosen).make(DATA)
    assert Path("imported").exists()
