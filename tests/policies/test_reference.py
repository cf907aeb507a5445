"""Tests of all ways to refer to a policy: names, files, classes, instances and options."""

import importlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Mapping
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any, ClassVar

import pytest

from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.datasets import Dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataNotFoundError, OptionError, PolicyError, UnknownNameError
from handover_marl.givers import Action, Giver, make_giver_action
from handover_marl.givers.variations import ReplayGiver
from handover_marl.learning.adapters.function_policy import LearnedPolicy
from handover_marl.policies import registry
from handover_marl.policies.populations import POPULATION_FOLDER
from handover_marl.policies.reference import PolicyLike, PolicyReference, parse_policy
from handover_marl.receivers.baselines import HoldReceiver

DATA = SyntheticDataset()
HERE = __name__
GIVER_FILE = POPULATION_FOLDER / "turning_final.npz"


class Mine(Giver):
    """Giver that plays the recorded motion at `speed` times its rate."""

    name = "mine"

    def __init__(self, speed: float = 1.0, word: Any = "hello") -> None:
        self.speed, self.word = speed, word

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: Observation) -> Action:
        return make_giver_action(rate=self.speed - 1.0)


class Anything(Mine):
    name = "anything"

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options


class Eithers(Mine):
    """Policy of either agent, whose constructor takes all arguments that the library can pass."""

    agent: ClassVar[str | None] = None
    name = "eithers"

    def __init__(self, agent: str, context: Any, path: str | None = None, trust: bool = False) -> None:
        super().__init__()
        self.whose, self.context, self.path, self.trust = agent, context, path, trust


class Robot(HoldReceiver):
    name = "robot"


class Unfinished(Giver):
    name = "unfinished"

    def reset(self, seed: int | None = None) -> None:
        pass


class Fails(Mine):
    name = "fails"

    def __init__(self) -> None:
        raise ZeroDivisionError("nought")


class Locked(Mine):
    name = "locked"

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


def make(policy: PolicyLike, agent: str = "giver", **options: Any) -> Any:
    """Return a policy made from a pickled reference, as in a worker process."""
    reference = pickle.loads(pickle.dumps(parse_policy(agent, policy, **options)))
    assert isinstance(reference, PolicyReference)
    return reference.make(DATA)


@pytest.mark.parametrize(
    ("policy", "speed", "word"),
    [
        (f"{HERE}:Mine", 1.0, "hello"),
        (f"{HERE}:Mine:speed=2", 2, "hello"),
        (f"{HERE}:Mine:speed=-0.5,word=", -0.5, ""),
        (f"{HERE}:Mine:word=null", 1.0, None),
        (f"{HERE}:Mine:word=a:b/c d", 1.0, "a:b/c d"),
        (Mine, 1.0, "hello"),
        (Mine(3.0, "x"), 3.0, "x"),
        ((Mine, {"speed": 2.0}), 2.0, "hello"),
        ((f"{HERE}:Mine", {"word": ("a", "b")}), 1.0, ("a", "b")),
        ((f"{HERE}:Mine:speed=2,word=x", {"word": "y"}), 2, "y"),
        ((parse_policy("giver", (Mine, {"speed": 2.0})), {"word": "z"}), 2.0, "z"),
    ],
)
def test_ways_to_name_a_class(policy: PolicyLike, speed: float, word: object) -> None:
    made = make(policy)
    assert type(made) is Mine
    assert (made.speed, made.word) == (speed, word)
    assert type(made.word) is type(word)


def test_registered_names_and_files(tmp_path: Path) -> None:
    assert type(make("replay")) is ReplayGiver
    assert type(make("hold", "receiver")) is HoldReceiver
    assert parse_policy("receiver", "omg_hand_aware:wait=1.5").options == (("wait", 1.5),)
    assert parse_policy("receiver", ("omg:wait=1.5", {"wait": 2})).options == (("wait", 2),)
    odd = tmp_path / "a=1,b:control_period=9,x=2.npz"
    odd.write_bytes(GIVER_FILE.read_bytes())
    for file in (GIVER_FILE, odd):
        for policy in (f"learned:{file}", f"learned:{file}:control_period=0.1", (f"learned:{file}", {})):
            reference = parse_policy("giver", policy)
            assert reference.file == str(file)
            assert isinstance(reference.make(DATA), LearnedPolicy)
    with pytest.raises(OptionError, match="needs a policy file: learned:FILE"):
        make("learned")
    with pytest.raises(DataNotFoundError, match=r"none\.npz"):
        make(f"learned:{tmp_path / 'none.npz'}")


def test_instances_are_copied() -> None:
    """Policies made from an instance are copies, which do not share state with it or with each other."""
    instance = Mine(word=["state"])
    reference = parse_policy("giver", instance)
    first, second = reference.make(DATA), reference.make(DATA)
    assert isinstance(first, Mine)
    assert isinstance(second, Mine)
    first.word.append("more")
    assert second.word == instance.word == ["state"]


def test_constructor_arguments() -> None:
    config = WorldConfig(protocol=ProtocolConfig(horizon_steps=77))
    for agent in ("giver", "receiver"):
        made = parse_policy(agent, Eithers, trust=True).make(DATA, config)
        assert isinstance(made, Eithers)
        assert (made.whose, made.path, made.trust) == (agent, None, True)
        assert made.context.config is config
        assert made.context.panda_urdf == DATA.panda_urdf
    with_file = parse_policy("giver", f"learned:{GIVER_FILE}", trust=True)
    assert with_file.trust
    assert not parse_policy("giver", f"learned:{GIVER_FILE}").trust


@pytest.mark.parametrize("name", ["agent", "context", "path", "trust", "self", "size"])
def test_unknown_options(name: str) -> None:
    """Unknown options are refused, and so are arguments that only the library passes, such as `trust`."""
    for policy in (f"{HERE}:Mine:{name}=1", (Mine, {name: 1}), (f"{HERE}:Mine", {name: 1})):
        with pytest.raises(OptionError, match=rf"Mine' has no option '{name}'; valid options: speed, word"):
            parse_policy("giver", policy)
    with pytest.raises(OptionError, match=rf"giver 'replay' has no option '{name}'"):
        make(f"replay:{name}=1")


IS_NO_GIVER = r"must be a subclass of handover_marl\.givers\.Giver"


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        *((f"{HERE}:Mine:{tail}", "must be key=value,key=value, got") for tail in ("speed", "=2", "speed=2=3", "1=2")),
        *((f"{HERE}:Mine:{tail}", "must be key=value,key=value, got") for tail in ("speed=2, word=x", "word=a,b")),
        (f"{HERE}:Mine:speed=1,speed=2", "must have different names, got 'speed=1,speed=2'"),
        *((name, r"unknown giver .*valid: adaptive, cooperative") for name in ("polite", "", ":", "polite:", ":Mine")),
        *((name, r"unknown giver .*") for name in ("no_module:Mine", f"{HERE}:Nobody", ".relative:Mine", "os.path:no")),
        (Unfinished, "'Unfinished' must define act; add"),
        (Giver, "must define act, reset"),
        *((policy, IS_NO_GIVER) for policy in (Robot, f"{HERE}:Robot", Dataset, "math:pi")),
        (Locked(), "cannot be sent to worker processes .*pass its class"),
        ((Mine(), {"speed": 2.0}), "options must be passed with a class, got an instance of Mine"),
        ((Mine, ["speed"]), "a pair"),
        (3, "giver must be a name, a class or an instance of a policy, got 3"),
        (parse_policy("receiver", "hold"), "giver must be a giver's policy, got hold of the receiver"),
        (Fails, r"giver 'Fails' cannot be made \(ZeroDivisionError: nought\)"),
    ],
)
def test_invalid_givers(policy: Any, message: str) -> None:
    with pytest.raises((OptionError, PolicyError, UnknownNameError), match=message):
        make(policy)


SCRIPT = """
import pickle, sys
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.givers import Giver, make_giver_action
from handover_marl.policies.reference import parse_policy
from script_helper import SHARED

class Typed(Giver):
    name = "typed"

    def __init__(self, speed=1.0):
        self.speed = speed

    def reset(self, seed=None):
        pass

    def act(self, observation):
        return make_giver_action(rate={gain} * SHARED * self.speed)

if __name__ == "__main__":
    references = [parse_policy("giver", policy) for policy in (Typed, (Typed, {{"speed": 0.5}}), Typed(0.25))]
    references = [reference.resolve(SyntheticDataset()) for reference in references]
    with open(sys.argv[1], "wb") as stream:
        pickle.dump(references, stream)
"""


def pickle_references(folder: Path, prompt: bool, gain: float = 2.0, shared: float = 1.0) -> list[PolicyReference]:
    """Return the references that a script pickled of a class that it defines.

    If `prompt` is true, the code runs with `python -c` instead, where the class has no file.
    """
    out, text = folder / "references.pickle", SCRIPT.format(gain=gain)
    (folder / "script.py").write_text(text)
    (folder / "script_helper.py").write_text(f"SHARED = {shared}")
    how = ["-c", text] if prompt else [str(folder / "script.py")]
    subprocess.run([sys.executable, *how, str(out)], check=True, cwd=folder, env=dict(os.environ), timeout=120)
    references: list[PolicyReference] = pickle.loads(out.read_bytes())
    return references


@pytest.mark.slow
@pytest.mark.parametrize("prompt", [False, True])
def test_classes_of_scripts(tmp_path: Path, prompt: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """References to classes of a script work in processes that have not run it.

    Hashes cover script and imports, and are those of its module; without a file, every hash is another one.
    """
    first = pickle_references(tmp_path, prompt)
    (tmp_path / "unrelated.py").write_text("x = 1")
    again = pickle_references(tmp_path, prompt)
    assert "Typed" not in vars(sys.modules["__main__"])
    assert [float(reference.make(DATA).act({})[0]) for reference in first] == [2.0, 1.0, 0.5]
    assert [reference.label for reference in first] == ["typed", "typed:speed=0.5", "typed"]
    hashes = [reference.code_hash for reference in first]
    assert len(set(hashes)) == 3
    assert ([reference.code_hash for reference in again] == hashes) != prompt
    if not prompt:
        monkeypatch.syspath_prepend(str(tmp_path))
        assert resolve("script:Typed").code_hash == hashes[0]
        monkeypatch.delitem(sys.modules, "script")
        changed = pickle_references(tmp_path, prompt, shared=5.0)
        assert not set(hashes) & {reference.code_hash for reference in changed}


def resolve(policy: PolicyLike, agent: str = "giver") -> PolicyReference:
    return parse_policy(agent, policy).resolve(DATA)


def test_labels() -> None:
    assert resolve("replay").label == "replay"
    assert resolve(f"{HERE}:Mine").label == resolve(Mine).label == resolve(Mine()).label == "mine"
    assert resolve(f"{HERE}:Mine:word=x,speed=2").label == "mine:speed=2,word=x"
    assert resolve((Mine, {"word": Path("x"), "speed": 2})).label == "mine:speed=2,word=x"
    assert resolve(f"learned:{GIVER_FILE}").label.startswith("learned:turning_final@")


PACKAGE = {
    "__init__.py": "",
    "policy.py": "import own_side\nfrom handover_marl.givers.variations import ReplayGiver\nfrom .helping import HELP\n"
    "class Own(ReplayGiver):\n    name = 'own'\n    def act(self, observation):\n        return HELP()\n",
    "helping.py": "def HELP():\n    return 1\n",
    "../own_side.py": "SHIFT = 1\n",
}


def test_hashes_cover_the_authors_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_package").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def hash_with(changes: Mapping[str, str]) -> str:
        for name, text in (PACKAGE | changes).items():
            (tmp_path / "own_package" / name).write_text(text)
        importlib.invalidate_caches()
        found = resolve("own_package.policy:Own").code_hash
        for name in [name for name in sys.modules if name.startswith(("own_package", "own_side"))]:
            del sys.modules[name]
        return found

    first = hash_with({})
    assert hash_with({}) == first
    changed = [{"policy.py": PACKAGE["policy.py"] + "    extra = 1\n"}, {"helping.py": "def HELP():\n    return 2\n"}]
    assert len({first, *map(hash_with, [*changed, {"../own_side.py": "SHIFT = 2\n"}])}) == 4


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([("theirs", f"{HERE}:Mine"), ("theirs", f"{HERE}:Anything")], "giver 'theirs' is claimed by .* and "),
        ([("theirs", f"{HERE}:Nobody")], "giver 'theirs' .* but cannot be imported"),
        ([("theirs", f"{HERE}:Robot")], r"giver 'theirs' .*must be a subclass of handover_marl\.givers\.Giver"),
        ([("other", f"{HERE}:Mine"), ("more", f"{HERE}:Anything")], "unknown giver 'theirs'; valid: more, other"),
    ],
)
def test_names_of_other_packages(points: list[tuple[str, str]], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = EntryPoints(EntryPoint(name, value, registry.GROUPS["giver"]) for name, value in points)
    monkeypatch.setattr(registry, "_find_points", lambda group: found.select(group=group))
    with pytest.raises((OptionError, UnknownNameError), match=message):
        parse_policy("giver", "theirs")
    assert registry.list_available("receiver") == ()
    if "valid" in message:
        assert type(make("other:speed=2")) is Mine
