"""Tests of hashes of policies (code, values, arrays, files), and of bundles, which are sent to other machines."""

import functools
import importlib
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.datasets import open_dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataNotFoundError, PolicyError
from handover_marl.policies import hashing
from handover_marl.policies.hashing import hash_object, hash_policy
from handover_marl.policies.populations import POPULATION_FOLDER, TRAIN, Partner, format_population
from handover_marl.policies.reference import PolicyBundle, parse_policy
from handover_marl.receivers.baselines import HoldReceiver
from handover_marl.version import __version__

WEIGHTS = np.arange(3.0)

NAMED = """
from handover_marl.givers import Giver, make_giver_action
from handover_marl.learning.encodings.custom import declare_size

@declare_size(1)
def count(observation):
    return [{number}]

class Mine(Giver):
    name = "mine"
    def reset(self, seed=None): ...
    def act(self, observation):
        return make_giver_action(rate={number} / 10)
"""


class Weighted(HoldReceiver):
    """Receiver that holds an array of a file, or any state."""

    name = "weighted"
    file_options = ("weights",)

    def __init__(self, context: Any = None, weights: str = "", state: Any = None) -> None:
        super().__init__(context)
        self._target = np.load(weights) if weights else None
        self._state = state


def use_weights(value: float) -> float:
    return float(WEIGHTS.sum()) * value


def use_helper(value: float) -> float:
    return use_weights(value)


def make(gain: float, table: Any = None) -> Callable[[float], float]:
    def multiply(value: float, power: int = 2) -> float:
        return gain * value**power if table is None else float(table["weights"][0])

    return multiply


class Linear:
    def __init__(self, slope: float) -> None:
        self.slope = slope

    def __call__(self, value: float) -> float:
        return self.slope * value


SLOPES = [Linear(1.0), Linear(2.0)]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (lambda: make(1.0), lambda: make(2.0)),
        (lambda: lambda value: value + 1, lambda: lambda value: value + 2),
        (lambda: eval("lambda value: value.real"), lambda: eval("lambda value: value.imag")),
        (lambda: math.sin, lambda: math.cos),
        (lambda: Linear(1.0), lambda: Linear(2.0)),
        (lambda: functools.partial(make(1.0), power=1), lambda: functools.partial(make(1.0), power=3)),
        (lambda: make(1.0, {"weights": np.zeros(2)}), lambda: make(1.0, {"weights": np.ones(2)})),
        (lambda: Path("a"), lambda: Path("b")),
        (lambda: eval("lambda: [0.1, 0.2, 0.3]"), lambda: eval("lambda: [0.5, 0.2, 0.3]")),
        (lambda: {"all": SLOPES, "used": SLOPES[0]}, lambda: {"all": SLOPES, "used": SLOPES[1]}),
    ],
)
def test_values_differ(first: Callable[[], Any], second: Callable[[], Any]) -> None:
    assert hash_object(first()) == hash_object(first())
    assert hash_object(first()) != hash_object(second())


@pytest.mark.parametrize(
    "function", [use_weights, use_helper, lambda value: use_helper(value), lambda: [WEIGHTS[n] for n in range(2)]]
)
def test_variables_of_the_module_count_where_they_are_used(function: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    before, other = hash_object(function), hash_object(make)
    monkeypatch.setitem(globals(), "WEIGHTS", np.arange(4.0))
    assert hash_object(function) != before
    assert hash_object(make) == other


@pytest.mark.parametrize("kind", ["array", "tensor", "network", "list", "dictionary", "object"])
def test_arrays_and_tensors_of_a_policy(kind: str) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `train`")

    def hash_state(value: float) -> str:
        layer, array = torch.nn.Linear(2, 2), np.full(3, value)
        for part in layer.parameters():
            torch.nn.init.constant_(part, value)
        states = {
            "array": array,
            "tensor": torch.full((3,), value, dtype=torch.bfloat16, requires_grad=True),
            "network": torch.jit.script(layer),
            "list": [1, "a", array],
            "dictionary": {"a": {"b": array}},
            "object": functools.partial(max, Linear(layer)),  # type: ignore[arg-type]
        }
        return hash_object(Weighted(state=states[kind]), arrays_only=True)

    assert hash_state(1.0) == hash_state(1.0) != hash_state(2.0)


def test_version_and_weights_count(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, code = HoldReceiver(), hash_policy(HoldReceiver(), ())
    assert parse_policy("receiver", "hold").resolve(open_dataset("synthetic")).code_hash == code
    assert hash_policy(policy, (), b"1").startswith(f"{code}.")
    assert hash_policy(policy, (), b"1") != hash_policy(policy, (), b"2")
    assert hash_policy(Weighted(state=np.zeros(2)), ()) != hash_policy(Weighted(state=np.ones(2)), ())
    monkeypatch.setattr(hashing, "__version__", "0.0.1")
    assert hash_policy(policy, ()) != code


def test_code_without_a_file_gets_another_hash_every_time() -> None:
    module = ModuleType("typed_module")
    exec("def act(value):\n    return value\nclass Typed:\n    pass", vars(module))
    for value in (module.act, module.Typed, module.Typed()):
        assert hash_object(value) != hash_object(value)


def test_code_that_files_name_is_hashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Features of a policy and members of a population that are named as `module:name` count with their code."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    population = tmp_path / "mine.json"
    population.write_text(format_population("mine", "1", "", [Partner("a", "a", TRAIN, "named_code:Mine", "")], []))
    found = []
    for number in (1, 2):
        (tmp_path / "named_code.py").write_text(NAMED.format(number=number))
        sys.modules.pop("named_code", None)
        importlib.invalidate_caches()
        function = handover_marl.as_receiver(max, features="named_code:count", action_scheme="joint_delta", name="a")
        options = {"population": str(population)}
        giver = parse_policy("giver", ("population", options), trust=True)
        found.append([each.resolve(SyntheticDataset()).code_hash for each in (function, giver)])
    assert not set(found[0]) & set(found[1])


CODE = """
from handover_marl.receivers import Receiver
from sway_of_mine import SWAY

class Mine(Receiver):
    name = "mine"

    def reset(self, seed=None):
        pass

    def act(self, observation):
        return observation["robot_joint_position"] + SWAY
"""


class Reads(HoldReceiver):
    """Receiver that reads a constant from a file, or from all files of a folder."""

    name = "reads"
    file_options = ("weights",)

    def __init__(self, context: Any, weights: str, other: str = "") -> None:
        path = Path(weights)
        files = [file for file in sorted(path.rglob("*")) if file.is_file()] if path.is_dir() else [path]
        self.names = [path.name, *(file.name for file in files if path.is_dir())]
        self.constant = sum(float(file.read_text()) for file in files)
        self.other = other


@pytest.mark.parametrize(("kind", "folder"), [(str, False), (Path, False), (str, True), (Path, True)])
def test_files_go_along(tmp_path: Path, kind: Callable[[Path], Any], folder: bool) -> None:
    given = tmp_path / "here" / "weights.txt"
    (given.parent / "deep").mkdir(parents=True)
    given.write_text("1.5")
    (given.parent / "deep" / "more.txt").write_text("2.0")
    named = given.parent if folder else given
    reference = parse_policy("receiver", (Reads, {"weights": kind(named), "other": str(given)}))
    reference = reference.resolve(SyntheticDataset())
    bundle = PolicyBundle.pack(reference)
    shutil.rmtree(given.parent)
    there = bundle.unpack(tmp_path / "there")
    made = there.make(SyntheticDataset())
    assert isinstance(made, Reads)
    assert made.constant == (3.5 if folder else 1.5)
    assert made.names == (["here", "more.txt", "weights.txt"] if folder else ["weights.txt"])
    assert made.other == str(given), "what names no file stays as it is"
    assert (there.label, there.code_hash) == (reference.label, reference.code_hash)


def test_policy_files_go_along(tmp_path: Path) -> None:
    given = tmp_path / "mine.npz"
    shutil.copy(POPULATION_FOLDER / "turning_final.npz", given)
    reference = parse_policy("giver", f"learned:{given}").resolve(SyntheticDataset())
    bundle = PolicyBundle.pack(reference)
    given.unlink()
    with pytest.raises(DataNotFoundError):
        reference.make(SyntheticDataset())
    assert bundle.unpack(tmp_path / "there").make(SyntheticDataset()).label == reference.label
    with pytest.raises(DataNotFoundError, match=r"mine\.npz cannot be read"):
        PolicyBundle.pack(reference)


def test_code_that_is_sent_is_not_compared() -> None:
    class Local(Reads):
        pass

    for kind in (Local, type("Typed", (Local,), {"__module__": "__main__"})):
        assert PolicyBundle.pack(parse_policy("receiver", (kind, {"weights": __file__}))).packages == ()
    assert PolicyBundle.pack(parse_policy("receiver", (Reads, {"weights": __file__}))).packages[0][0] == "tests"
    assert PolicyBundle.pack(parse_policy("receiver", "yang2021")).packages == (("handover_marl", __version__),)


def test_other_code_there_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    homes = [tmp_path / name for name in ("here", "copy", "other")]
    for home in homes:
        home.mkdir()
        (home / "robots_of_mine.py").write_text(CODE)
        (home / "sway_of_mine.py").write_text(f"SWAY = {0.1 if home.name == 'other' else 0.0}\n")

    def at(home: Path | None) -> None:
        """Make the code importable from one folder only, as on a machine that has it there; from none if it is None."""
        for name in ("robots_of_mine", "sway_of_mine"):
            sys.modules.pop(name, None)
        monkeypatch.setattr(
            sys, "path", [path for path in sys.path if Path(path) not in homes] + [str(home)] * bool(home)
        )
        importlib.invalidate_caches()

    for named in ("robots_of_mine:Mine", None):
        at(homes[0])
        kind = named or importlib.import_module("robots_of_mine").Mine
        bundle = PolicyBundle.pack(parse_policy("receiver", kind))
        at(homes[1])
        assert bundle.unpack(tmp_path).policy_class.name == "mine"
        at(homes[2])
        with pytest.raises(
            PolicyError, match=r"on node .*Mine' must be installed as here, got PolicyError: it has other code"
        ):
            bundle.unpack(tmp_path)
        at(None)
        with pytest.raises(PolicyError, match=r"on node .*Mine' must be installed as here, got .*robots_of_mine"):
            bundle.unpack(tmp_path)
