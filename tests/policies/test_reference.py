"""All ways of saying which policy is meant."""

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

import numpy as np
import pytest

from handover_marl import givers, receivers
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.datasets import Dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataNotFoundError, OptionError, PolicyError, UnknownNameError
from handover_marl.givers import Action, Giver, deviation
from handover_marl.givers.replay import ReplayGiver
from handover_marl.learning.learned_policy import SHIPPED_GIVER, LearnedPolicy
from handover_marl.policies import registry
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, PolicyReference, policy_reference, split_names
from handover_marl.receivers import Receiver
from handover_marl.receivers.hold import HoldReceiver

DATA = SyntheticDataset()
HERE = __name__


class Mine(Giver):
    """Plays at another speed."""

    name = "mine"

    def __init__(self, speed: float = 1.0, word: Any = "hello") -> None:
        self.speed, self.word = speed, word

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: Observation) -> Action:
        return deviation(rate=self.speed - 1.0)


class Anything(Mine):
    name = "anything"

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options


class Eithers(Mine):
    """A policy of either agent, which asks for all there is to ask for."""

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


class Nameless(Giver):
    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: Observation) -> Action:
        return deviation()


class Never(Mine):
    name = "never"
    control_period = "often"  # type: ignore[assignment]


class Fails(Mine):
    name = "fails"

    def __init__(self) -> None:
        raise ZeroDivisionError("nought")


class Quits(Mine):
    name = "quits"

    def __init__(self) -> None:
        sys.exit("bye")


class Demanding(Mine):
    name = "demanding"

    def __init__(self, needed: float) -> None:
        super().__init__(needed)


class Locked(Mine):
    name = "locked"

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


class Impostor(Mine):
    name = "impostor"

    def __new__(cls) -> Any:
        return "no policy"


def make(policy: PolicyLike, agent: str = "giver", **options: Any) -> Any:
    """A policy that went through a pickle, as on its way to a worker process."""
    reference = pickle.loads(pickle.dumps(policy_reference(agent, policy, **options)))
    assert isinstance(reference, PolicyReference)
    return reference.make(DATA)


@pytest.mark.parametrize(
    ("policy", "speed", "word"),
    [
        (f"{HERE}:Mine", 1.0, "hello"),
        (f"{HERE}:Mine:speed=2", 2, "hello"),
        (f"{HERE}:Mine:speed=-0.5,word=bye", -0.5, "bye"),
        (f"{HERE}:Mine:word=", 1.0, ""),
        (f"{HERE}:Mine:word=true", 1.0, True),
        (f"{HERE}:Mine:word=null", 1.0, None),
        (f"{HERE}:Mine:word=a:b/c d", 1.0, "a:b/c d"),
        (Mine, 1.0, "hello"),
        (Mine(3.0, "x"), 3.0, "x"),
        ((Mine, {"speed": 2.0}), 2.0, "hello"),
        ((f"{HERE}:Mine", {"word": ("a", "b")}), 1.0, ("a", "b")),
        ((f"{HERE}:Mine:speed=2,word=x", {"word": "y"}), 2, "y"),
        ((Mine(3.0), {}), 3.0, "hello"),
        (policy_reference("giver", (Mine, {"speed": 2.0})), 2.0, "hello"),
        ((policy_reference("giver", (Mine, {"speed": 2.0})), {"word": "z"}), 2.0, "z"),
    ],
)
def test_every_way_of_naming_a_class(policy: PolicyLike, speed: float, word: object) -> None:
    made = make(policy)
    assert type(made) is Mine
    assert (made.speed, made.word) == (speed, word)
    assert type(made.word) is type(word)


def test_registered_names() -> None:
    assert type(make("replay")) is ReplayGiver
    assert type(make("hold", "receiver")) is HoldReceiver
    assert make("omg:wait=1.5", "receiver").context.grasps is not None
    assert policy_reference("receiver", "omg_hand_aware:wait=1.5").options == (("wait", 1.5),)
    assert policy_reference("receiver", ("omg:wait=1.5", {"wait": 2})).options == (("wait", 2),)


def test_files(tmp_path: Path) -> None:
    odd = tmp_path / "a=1,b:control_period=9,x=2"
    odd.write_bytes(SHIPPED_GIVER.read_bytes())
    for file in (SHIPPED_GIVER, odd.rename(odd.with_name(f"{odd.name}.npz"))):
        for policy in (f"learned:{file}", f"learned:{file}:control_period=0.1", (f"learned:{file}", {})):
            reference = policy_reference("giver", policy)
            assert reference.file == str(file)
            assert isinstance(reference.make(DATA), LearnedPolicy)
    assert policy_reference("giver", f"learned:{SHIPPED_GIVER}:control_period=0.1").options == (
        ("control_period", 0.1),
    )
    assert policy_reference("giver", "learned").file is None
    with pytest.raises(DataNotFoundError, match=r"none\.npz"):
        make(f"learned:{tmp_path / 'none.npz'}")


def test_instances_are_copied_for_every_player() -> None:
    """What one player's policy remembers is not known to another's."""
    instance = Mine(word=["state"])
    reference = policy_reference("giver", instance)
    first, second = reference.make(DATA), reference.make(DATA)
    assert isinstance(first, Mine)
    assert isinstance(second, Mine)
    first.word.append("more")
    assert second.word == instance.word == ["state"]


def test_constructors_get_what_they_ask_for() -> None:
    config = WorldConfig(protocol=ProtocolConfig(horizon_steps=77))
    for agent in ("giver", "receiver"):
        made = policy_reference(agent, Eithers, trust=True).make(DATA, config)
        assert isinstance(made, Eithers)
        assert (made.whose, made.path, made.trust) == (agent, None, True)
        assert made.context.config is config
        assert made.context.panda_urdf == DATA.panda_urdf
    with_file = policy_reference("giver", f"learned:{SHIPPED_GIVER}", trust=True)
    assert with_file.trust
    assert not policy_reference("giver", f"learned:{SHIPPED_GIVER}").trust


def test_givers_and_receivers_are_made_from_all_of_these() -> None:
    assert type(givers.make((f"{HERE}:Mine", {"speed": 2.0}), DATA)) is Mine
    assert type(receivers.make(Robot, DATA)) is Robot


@pytest.mark.parametrize("name", ["agent", "context", "path", "trust", "self", "size"])
def test_unknown_options(name: str) -> None:
    """Nor may files be trusted by way of their name."""
    for policy in (f"{HERE}:Mine:{name}=1", (Mine, {name: 1}), (f"{HERE}:Mine", {name: 1})):
        with pytest.raises(OptionError, match=rf"Mine' has no option '{name}'; it takes speed, word"):
            policy_reference("giver", policy)
    with pytest.raises(OptionError, match=rf"giver 'replay' has no option '{name}'; it takes none"):
        policy_reference("giver", f"replay:{name}=1")
    with pytest.raises(OptionError, match=rf"giver 'learned' has no option '{name}'; it takes control_period"):
        policy_reference("giver", f"learned:{SHIPPED_GIVER}:{name}=true")


def test_any_option_where_any_is_taken() -> None:
    assert make((Anything, {"a": 1, "b": "x"})).options == {"a": 1, "b": "x"}


@pytest.mark.parametrize("tail", ["speed", "=2", "speed=2=3", "speed=2, word=x", "1=2", "a b=2"])
def test_malformed_options(tail: str) -> None:
    for agent, name in (("giver", f"{HERE}:Mine"), ("receiver", "hold")):
        with pytest.raises(OptionError, match="options are written key=value,key=value, not"):
            policy_reference(agent, f"{name}:{tail}")


@pytest.mark.parametrize("tail", ["speed=2,", "word=a,b", ",speed=2"])
def test_commas_separate_options(tail: str) -> None:
    with pytest.raises(OptionError, match=r"no option|are written"):
        policy_reference("giver", f"{HERE}:Mine:{tail}")


@pytest.mark.parametrize("name", ["polite", "", ":", "polite:", ":Mine", "replay2:speed=1", "no_such_module:Mine"])
def test_unknown_names(name: str) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown giver .*valid: cooperative, hesitant"):
        policy_reference("giver", name)


@pytest.mark.parametrize("place", [f"{HERE}:Nobody", ".relative:Mine", f"{HERE}:", "os.path.nowhere:join"])
def test_places_where_nothing_is(place: str) -> None:
    with pytest.raises(UnknownNameError, match="unknown giver"):
        policy_reference("giver", place)


def test_unknown_agents() -> None:
    with pytest.raises(UnknownNameError, match="agent 'robot'; valid: giver, receiver"):
        policy_reference("robot", "replay")
    with pytest.raises(UnknownNameError, match="agent 'robot'; valid: giver, receiver"):
        registry.available("robot")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Unfinished, "'Unfinished' lacks act; write them"),
        (f"{HERE}:Unfinished", "lacks act; write them"),
        (Nameless, r"'Nameless' has no name; give the class one: name = \"mine\""),
        (Never, "'Never' has control_period 'often'; it must be a number"),
        (Robot, r"must be a subclass of handover_marl\.givers\.Giver"),
        (f"{HERE}:Robot", r"must be a subclass of handover_marl\.givers\.Giver"),
        (Giver, "lacks act, reset"),
        (Policy, "lacks act, reset"),
        (Dataset, r"must be a subclass of handover_marl\.givers\.Giver"),
        ("math:pi", "must be a subclass"),
        (Locked(), "cannot be sent to worker processes .*pass its class"),
        ((Mine(), {"speed": 2.0}), "Mine is made already; options go with its class"),
        ((Mine, {"speed": 2.0}, 3), "a pair"),
        ((Mine, ["speed"]), "a pair"),
        (3, "a giver is a name, a class or an instance of a policy, not 3"),
        (None, "not None"),
        (policy_reference("receiver", "hold"), r"this is a receiver's policy \(hold\); a giver's is wanted"),
    ],
)
def test_what_is_no_giver(policy: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        policy_reference("giver", policy)


def test_what_is_no_receiver() -> None:
    for policy in (Mine, Mine(), f"{HERE}:Mine", ReplayGiver):
        with pytest.raises(OptionError, match=r"must be a subclass of handover_marl\.receivers\.Receiver"):
            policy_reference("receiver", policy)


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (Fails, PolicyError, r"giver 'Fails' cannot be made \(ZeroDivisionError: nought\)"),
        (Quits, PolicyError, r"giver 'Quits' cannot be made \(SystemExit: bye\)"),
        (Demanding, PolicyError, "giver 'Demanding' cannot be made .*needed"),
        (Impostor, OptionError, "made 'no policy', which is no policy"),
    ],
)
def test_what_cannot_be_made(policy: type[Policy], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make(policy)


def test_a_class_of_a_function_travels() -> None:
    factor = 3.0

    class Local(Mine):
        name = "local"

        def act(self, observation: Observation) -> Action:
            return deviation(rate=factor * self.speed)

    for policy in (Local, (Local, {"speed": 0.1}), Local(0.1)):
        made = make(policy)  # type: ignore[arg-type]
        assert made.name == "local"
        assert made.act({})[0] == pytest.approx(np.float32(factor * made.speed))


SCRIPT = """
import pickle, sys
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.givers import Giver, deviation
from handover_marl.policies.reference import policy_reference

SHARED = {shared}

class Typed(Giver):
    name = "typed"

    def __init__(self, speed=1.0):
        self.speed = speed

    def reset(self, seed=None):
        pass

    def act(self, observation):
        return deviation(rate={gain} * SHARED * self.speed)

if __name__ == "__main__":
    references = [policy_reference("giver", policy) for policy in (Typed, (Typed, {{"speed": 0.5}}), Typed(0.25))]
    references = [reference.resolved(SyntheticDataset()) for reference in references]
    with open(sys.argv[1], "wb") as stream:
        pickle.dump(references, stream)
"""


def typed(folder: Path, prompt: bool = False, gain: float = 2.0, shared: float = 1.0) -> list[PolicyReference]:
    """What a script made of a class of its own, or a prompt, where the class has no file."""
    folder.mkdir(parents=True, exist_ok=True)
    out, text = folder / "references.pickle", SCRIPT.format(gain=gain, shared=shared)
    (folder / "script.py").write_text(text)
    how = ["-c", text] if prompt else [str(folder / "script.py")]
    subprocess.run([sys.executable, *how, str(out)], check=True, cwd=folder, env=dict(os.environ), timeout=120)
    references: list[PolicyReference] = pickle.loads(out.read_bytes())
    return references


@pytest.mark.parametrize("prompt", [False, True])
def test_a_class_of_a_script_travels(tmp_path: Path, prompt: bool) -> None:
    """To a process that has never seen the script."""
    references = typed(tmp_path, prompt)
    assert "Typed" not in vars(sys.modules["__main__"])
    assert [float(reference.make(DATA).act({})[0]) for reference in references] == [2.0, 1.0, 0.5]
    assert [reference.label for reference in references] == ["typed", "typed:speed=0.5", "typed"]
    assert len({reference.source for reference in references}) == 3


@pytest.mark.parametrize("prompt", [False, True])
def test_another_script_is_another_policy(tmp_path: Path, prompt: bool) -> None:
    first, again, changed = (typed(tmp_path / "a", prompt, gain) for gain in (2.0, 2.0, 3.0))
    for number in (0, 1):
        assert first[number].source == again[number].source
        assert first[number].source != changed[number].source


@pytest.mark.parametrize(
    "prompt",
    [False, True],
)
def test_what_a_scripts_class_uses_belongs_to_it(tmp_path: Path, prompt: bool) -> None:
    first, changed = (typed(tmp_path / "a", prompt, shared=shared) for shared in (1.0, 5.0))
    assert first[0].make(DATA).act({})[0] != changed[0].make(DATA).act({})[0]
    assert first[0].source != changed[0].source


@pytest.mark.parametrize("prompt", [False, True])
def test_an_instance_of_a_scripts_class_is_known_again(tmp_path: Path, prompt: bool) -> None:
    first, again = (typed(tmp_path / "a", prompt) for _ in range(2))
    assert first[2].source == again[2].source


def test_classes_that_enclose_different_things_are_different_policies() -> None:
    def sped_up(factor: float) -> type[Giver]:
        class Local(Mine):
            name = "local"

            def act(self, observation: Observation) -> Action:
                return deviation(rate=factor)

        return Local

    slow, fast = (resolved(sped_up(factor)) for factor in (0.5, 1.0))
    assert slow.make(DATA).act({})[0] != fast.make(DATA).act({})[0]
    assert slow.source != fast.source


def resolved(policy: PolicyLike, agent: str = "giver") -> PolicyReference:
    return policy_reference(agent, policy).resolved(DATA)


def test_labels_tell_options() -> None:
    assert resolved("replay").label == "replay"
    assert resolved(f"{HERE}:Mine").label == resolved(Mine).label == resolved(Mine()).label == "mine"
    assert resolved(f"{HERE}:Mine:word=x,speed=2").label == "mine:speed=2,word=x"
    assert resolved((Mine, {"word": "x", "speed": 2})).label == "mine:speed=2,word=x"
    assert resolved(f"learned:{SHIPPED_GIVER}").label.startswith("learned:for_yang2021@")


def test_hashes_tell_policies_apart() -> None:
    sources = [
        resolved(policy).source
        for policy in (
            Mine,
            (Mine, {"speed": 2}),
            (Mine, {"speed": 3}),
            Mine(2.0),
            Mine(3.0),
            Anything,
            "replay",
            "noisy",
        )
    ]
    assert all(len(source) == 8 for source in sources)
    assert len(set(sources)) == len(sources)
    assert resolved(Mine).source == resolved(f"{HERE}:Mine").source
    assert resolved((Mine, {"speed": 2})).source == resolved(f"{HERE}:Mine:speed=2").source
    assert resolved(Mine(2.0)).source == resolved(Mine(2.0)).source


def test_another_file_is_another_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    with np.load(SHIPPED_GIVER) as archive:
        parts = dict(archive)
    found = []
    for gain in (1.0, 2.0):
        np.savez(path, **parts | {"bias_0": gain * parts["bias_0"]})
        found.append(resolved(f"learned:{path}"))
    assert found[0].label != found[1].label
    assert found[0].source != found[1].source


def test_options_added_to_a_resolved_reference_make_it_another() -> None:
    first = resolved(Mine)
    assert policy_reference("giver", first) is first
    changed = policy_reference("giver", (first, {"speed": 2}))
    assert (changed.label, changed.source) == ("", "")
    assert changed.resolved(DATA).label == "mine:speed=2"


PACKAGE = {
    "__init__.py": "",
    "policy.py": "from handover_marl.givers.replay import ReplayGiver\nfrom own_package.helping import HELP\n\n"
    "class Own(ReplayGiver):\n    name = 'own'\n    def act(self, observation):\n        return HELP()\n",
    "helping.py": "from own_package import deeper\n\ndef HELP():\n    return deeper.VALUE\n",
    "deeper.py": "VALUE = 1\n",
    "unused.py": "VALUE = 1\n",
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "own_package"
    folder.mkdir()
    for name, text in PACKAGE.items():
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def hash_of(changes: Mapping[str, str], folder: Path) -> str:
    for name, text in (PACKAGE | changes).items():
        (folder / name).write_text(text)
    for name in [name for name in sys.modules if name.partition(".")[0] == "own_package"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    source = resolved("own_package.policy:Own").source
    for name in [name for name in sys.modules if name.partition(".")[0] == "own_package"]:
        del sys.modules[name]
    return source


def test_hashes_follow_the_source(package: Path) -> None:
    """Of the class and of all that it uses from its own package, and of nothing else."""
    first = hash_of({}, package)
    assert hash_of({}, package) == first
    assert hash_of({"unused.py": "VALUE = 2\n"}, package) == first
    changed = {
        hash_of({"policy.py": PACKAGE["policy.py"] + "    extra = 1\n"}, package),
        hash_of({"helping.py": PACKAGE["helping.py"] + "\nMORE = 1\n"}, package),
        hash_of({"deeper.py": "VALUE = 2\n"}, package),
    }
    assert len(changed | {first}) == 4


@pytest.mark.parametrize(
    ("agent", "text", "names"),
    [
        ("receiver", "hold", ["hold"]),
        ("receiver", "hold,yang2021", ["hold", "yang2021"]),
        ("receiver", " hold , yang2021 ", ["hold", "yang2021"]),
        ("receiver", "omg:wait=1.5,hold", ["omg:wait=1.5", "hold"]),
        ("receiver", "hold,omg:wait=1.5,more=2,omg", ["hold", "omg:wait=1.5,more=2", "omg"]),
        ("receiver", "a.b:C,d.e:F", ["a.b:C", "d.e:F"]),
        ("receiver", "a.b:C:x=1,y=2,d.e:F:z=3,hold", ["a.b:C:x=1,y=2", "d.e:F:z=3", "hold"]),
        ("receiver", "learned:a,b.npz,hold", ["learned:a,b.npz", "hold"]),
        ("receiver", "learned:runs/a.npz,learned:runs/b.npz", ["learned:runs/a.npz", "learned:runs/b.npz"]),
        (
            "receiver",
            "learned:runs/lr=1,seed=2/p.npz:control_period=0.1,yang2021",
            ["learned:runs/lr=1,seed=2/p.npz:control_period=0.1", "yang2021"],
        ),
        ("receiver", "learned:C:/x,y/p.npz,hold", ["learned:C:/x,y/p.npz", "hold"]),
        ("giver", "replay,learned,learned:x.npz", ["replay", "learned", "learned:x.npz"]),
        ("giver", "replay,hold", ["replay", "hold"]),
        ("giver", "polite,rude", ["polite", "rude"]),
    ],
)
def test_lists_of_names(agent: str, text: str, names: list[str]) -> None:
    assert split_names(agent, text) == names


class Package:
    def __init__(self, name: str) -> None:
        self.name = name


def register(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str, str | None], agent: str = "giver") -> None:
    """Pretend that packages registered policies: name, place and package of each."""
    made = []
    for name, value, package in points:
        point = EntryPoint(name, value, registry.GROUPS[agent])
        made.append(point if package is None else point._for(Package(package)))  # type: ignore[attr-defined]
    monkeypatch.setattr(registry, "entry_points", EntryPoints(made).select)


def test_packages_add_names(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("theirs", f"{HERE}:Mine", "one"), ("other", f"{HERE}:Anything", "two"))
    assert registry.available("giver") == ("other", "theirs")
    assert registry.available("receiver") == ()
    assert type(make("theirs:speed=2")) is Mine
    with pytest.raises(UnknownNameError, match="unknown giver 'replay'; valid: other, theirs"):
        policy_reference("giver", "replay")


def test_two_packages_that_claim_one_name(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("theirs", f"{HERE}:Mine", "one"), ("theirs", f"{HERE}:Anything", "two"))
    assert registry.available("giver") == ("theirs",)
    for name in ("theirs", "theirs:speed=2"):
        with pytest.raises(
            OptionError, match=rf"'theirs' is claimed by one \({HERE}:Mine\) and two \({HERE}:Anything\)"
        ):
            policy_reference("giver", name)
    register(monkeypatch, ("theirs", f"{HERE}:Mine", None), ("theirs", f"{HERE}:Anything", None))
    with pytest.raises(OptionError, match="claimed by an unknown package"):
        policy_reference("giver", "theirs")


def test_one_package_installed_twice_is_no_conflict(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("theirs", f"{HERE}:Mine", "one"), ("theirs", f"{HERE}:Mine", "one"))
    assert type(make("theirs")) is Mine


@pytest.mark.parametrize("value", ["no_such_module:Mine", f"{HERE}:Nobody"])
def test_registered_names_that_lead_nowhere(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    register(monkeypatch, ("theirs", value, "one"))
    with pytest.raises(OptionError, match=rf"giver 'theirs' is registered as {value} but cannot be imported"):
        policy_reference("giver", "theirs")


def test_what_is_registered_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("theirs", f"{HERE}:Robot", "one"), ("unfinished", f"{HERE}:Unfinished", "one"))
    with pytest.raises(OptionError, match=r"'theirs' .*must be a subclass of handover_marl\.givers\.Giver"):
        policy_reference("giver", "theirs")
    with pytest.raises(OptionError, match="'unfinished' lacks act"):
        policy_reference("giver", "unfinished")


def test_receivers_see_the_world_they_are_made_for() -> None:
    made = policy_reference("receiver", Robot).make(DATA)
    assert isinstance(made, Receiver)
    assert made.context.object_urdf == DATA.object_urdf
