"""Policies as values: one description of which policy is meant, small and picklable, from which it is made.

| what may be passed | example |
|---|---|
| a registered name, with options | `"yang2021"`, `"omg_hand_aware:wait=1.5"` |
| a registered name and a file | `"learned:runs/policy.npz"` |
| where a class is | `"my_package.robots:MyReceiver"`, `"my_package.robots:MyReceiver:speed=2"` |
| a class | `MyReceiver` |
| an instance | `MyReceiver(...)` |
| one of these and a dict of options | `("omg_hand_aware", {"wait": 1.5})` |
"""

import importlib
import inspect
import json
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cloudpickle

from handover_marl.config import OFFICIAL, WorldConfig
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.episode.observations import ALL, check_observes
from handover_marl.errors import HandoverError, OptionError, PolicyError, UnknownNameError
from handover_marl.policies.context import context_of
from handover_marl.policies.policy import Policy
from handover_marl.policies.registry import available, registered
from handover_marl.policies.source_hash import source_hash
from handover_marl.policies.waiting import wait_ms

_OPTIONS = re.compile(r"[A-Za-z_]\w*=[^=,]*(,[A-Za-z_]\w*=[^=,]*)*")
# What a constructor gets if it asks for it; not for users to set by name.
_GIVEN = ("self", "context", "agent", "path", "trust")


@dataclass(frozen=True)
class PolicyReference:
    """Which policy is meant. Made by `policy_reference`.

    Attributes:
        agent: Whose policy, "giver" or "receiver".
        text: How it was named, or the class's name.
        pickled: The class or instance, pickled; empty where `text` says where the class is.
        file: The policy file, or None.
        options: What its constructor gets, by name.
        trust: Whether code in its file may run.
        label: What tables and folders call it; known once it is `resolved`, and so are
        source: the hash of its code, options and file,
        wait: how long it stays away at the start (s), None if unknown,
        sight: what it wants to be shown of the wrist camera, and
        observes: whether it sees all, or by sight alone.
    """

    agent: str
    text: str
    pickled: bytes = b""
    file: str | None = None
    options: tuple[tuple[str, Any], ...] = ()
    trust: bool = False
    label: str = ""
    source: str = ""
    wait: float | None = None
    sight: str | None = None
    observes: str = ALL

    @property
    def kind(self) -> type[Policy]:
        """The policy's class.

        Raises:
            UnknownNameError: It cannot be imported.
        """
        found = self._found()
        kind: type[Policy] = found if isinstance(found, type) else type(found)
        return kind

    def make(self, dataset: Dataset | None = None, config: WorldConfig = OFFICIAL, setup: str = "s0") -> Policy:
        """The policy itself, for the robot, the objects of a dataset and a setup; default: what `open_dataset()` gives.

        Raises:
            PolicyError: Its constructor fails.
            HandoverError: Its file is not there, or is no policy that may be loaded.
        """
        found = self._found()
        if isinstance(found, Policy):
            return found
        taken = _parameters(found)
        given: dict[str, Any] = {"agent": self.agent, "path": self.file, "trust": self.trust}
        if "context" in taken:
            given["context"] = context_of(dataset or open_dataset(), config, setup)
        options = dict(self.options) | {name: value for name, value in given.items() if name in taken}
        try:
            made = found(**options)
        except HandoverError:
            raise
        except (Exception, SystemExit) as error:
            raise PolicyError(f"{self.agent} {self.text!r} cannot be made ({type(error).__name__}: {error})") from error
        if not isinstance(made, Policy):
            raise OptionError(f"{self.agent} {self.text!r} made {made!r}, which is no policy")
        return made

    def resolved(self, dataset: Dataset, config: WorldConfig = OFFICIAL, setup: str = "s0") -> "PolicyReference":
        """The same with its label and the hash of its code; making it once shows whether it can be made.

        Raises:
            HandoverError: As `make`.
        """
        made = self.make(dataset, config, setup)
        label = made.label
        if self.options:
            label += ":" + ",".join(f"{key}={_shown(value)}" for key, value in self.options)
        content = repr(self.options).encode()
        found = self._found()
        if isinstance(found, Policy):
            # Its state; a pickled class that was typed in has another number in every process.
            content += cloudpickle.dumps(vars(found))
        if self.file is not None:
            content += Path(self.file).expanduser().read_bytes()
        content += made.weights_hash.encode()
        check_observes(made.observes, made.sight)
        return replace(
            self,
            label=label,
            source=source_hash(type(made), content),
            wait=_told_wait(made),
            sight=made.sight,
            observes=made.observes,
        )

    def _found(self) -> Any:
        return pickle.loads(self.pickled) if self.pickled else _named(self.agent, self.text)


PolicyLike: TypeAlias = str | type[Policy] | Policy | PolicyReference | tuple[Any, Mapping[str, Any]]


def policy_reference(agent: str, policy: PolicyLike, trust: bool = False) -> PolicyReference:
    """What is meant by a policy, checked as far as that goes without making it.

    Args:
        agent: Whose policy is wanted, "giver" or "receiver".
        policy: One of what the module's table shows.
        trust: Whether code in a policy file may run.

    Raises:
        UnknownNameError: Nothing is registered under the name, or there is no such agent.
        OptionError: What is named cannot be imported, is no policy of this agent, takes no file or no such option,
            or cannot be sent to worker processes.
    """
    extra: Mapping[str, Any] = {}
    if isinstance(policy, tuple):
        policy, extra = _split_pair(agent, policy)
    if isinstance(policy, PolicyReference):
        if policy.agent != agent:
            raise OptionError(f"this is a {policy.agent}'s policy ({policy.text}); a {agent}'s is wanted")
        if not extra:
            return policy
        return replace(policy, options=_merged(policy.options, extra), label="", source="", wait=None)
    if isinstance(policy, str):
        return _read_text(agent, policy, extra, trust)
    if isinstance(policy, (type, Policy)):
        return _of_object(agent, policy, extra, trust)
    raise OptionError(
        f"a {agent} is a name, a class or an instance of a policy, not {policy!r}; a class must derive from "
        f"handover_marl.{agent}s.{agent.capitalize()}"
    )


def split_names(agent: str, text: str) -> list[str]:
    """Policies from a comma-separated list; commas inside options and file names stay."""
    names: list[str] = []
    for part in text.split(","):
        head = part.strip().partition(":")[0]
        starts = head in available(agent) or (":" in part and "=" not in head and "/" not in head)
        if names and not starts and (":" in names[-1]):
            names[-1] += f",{part}"
        else:
            names.append(part.strip())
    return names


def _split_pair(agent: str, pair: tuple[Any, ...]) -> tuple[Any, Mapping[str, Any]]:
    if len(pair) != 2 or not isinstance(pair[1], Mapping):
        raise OptionError(f"a {agent} with options is a pair (policy, dict of options), not {pair!r}")
    return pair[0], pair[1]


def _read_text(agent: str, text: str, extra: Mapping[str, Any], trust: bool) -> PolicyReference:
    head, colon, tail = text.partition(":")
    kind = registered(agent, head)
    name, file = head, None
    if kind is None:
        # Registered names have no dots and no second part, places of classes have.
        if not colon or not tail:
            raise UnknownNameError(agent, text, available(agent))
        attribute, _, rest = tail.partition(":")
        name, tail = f"{head}:{attribute}", rest
        kind = _imported(agent, head, attribute)
    elif colon and "path" in _parameters(kind):
        file, tail = _split_file(tail)
        if not file:
            raise OptionError(f"{agent} {text!r} names no file; write {head}:FILE")
    _check_kind(agent, kind, name)
    options = _merged((), _parse_options(agent, text, tail) | dict(extra))
    _check_options(agent, kind, name, options)
    return PolicyReference(agent, name, file=file, options=options, trust=trust)


def _split_file(tail: str) -> tuple[str, str]:
    """A file's name and the options behind it."""
    file, colon, options = tail.rpartition(":")
    try:
        whole = Path(tail).exists()
    except (OSError, ValueError):  # no name that a file could have
        whole = False
    return (file, options) if colon and not whole and _OPTIONS.fullmatch(options) else (tail, "")


def _parse_options(agent: str, text: str, tail: str) -> dict[str, Any]:
    if not tail:
        return {}
    if not _OPTIONS.fullmatch(tail):
        raise OptionError(f"{agent} {text!r}: options are written key=value,key=value, not {tail!r}")
    return {key: _value(value) for key, _, value in (part.partition("=") for part in tail.split(","))}


def _value(text: str) -> Any:
    """A number, true, false or null as such; anything else is text."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _of_object(agent: str, policy: Any, extra: Mapping[str, Any], trust: bool) -> PolicyReference:
    kind = policy if isinstance(policy, type) else type(policy)
    _check_kind(agent, kind, kind.__name__)
    if extra and not isinstance(policy, type):
        raise OptionError(f"{agent} {kind.__name__} is made already; options go with its class")
    options = _merged((), extra)
    _check_options(agent, kind, kind.__name__, options)
    try:
        pickled = cloudpickle.dumps(policy)
    except Exception as error:  # what pickling meets has no end
        raise OptionError(
            f"{agent} {kind.__name__} cannot be sent to worker processes ({type(error).__name__}: {error}); pass its "
            "class, which makes what it needs in reset()"
        ) from error
    return PolicyReference(agent, kind.__name__, pickled, options=options, trust=trust)


def _named(agent: str, text: str) -> Any:
    module, colon, attribute = text.partition(":")
    return _imported(agent, module, attribute) if colon else registered(agent, text)


def _imported(agent: str, module: str, attribute: str) -> Any:
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:  # a module of somebody's own may do anything
        raise UnknownNameError(
            agent, f"{module}:{attribute}", available(agent), f"and it cannot be imported ({error})"
        ) from error


def _check_kind(agent: str, kind: Any, name: str) -> None:
    if not (isinstance(kind, type) and issubclass(kind, Policy)) or kind.agent not in (agent, None):
        base = f"handover_marl.{agent}s.{agent.capitalize()}"
        raise OptionError(f"{agent} {name!r} ({kind!r}) must be a subclass of {base}")
    if inspect.isabstract(kind):
        missing = ", ".join(sorted(kind.__abstractmethods__))
        raise OptionError(f"{agent} {name!r} lacks {missing}; write them")
    period = getattr(kind, "control_period", None)
    if isinstance(period, (bool, str)) or not isinstance(period, (int, float, property)):
        raise OptionError(f"{agent} {name!r} has control_period {period!r}; it must be a number (s)")
    if not isinstance(getattr(kind, "name", None), (str, property)):
        raise OptionError(f'{agent} {name!r} has no name; give the class one: name = "mine"')


def _parameters(kind: Any) -> dict[str, inspect.Parameter]:
    return dict(inspect.signature(kind).parameters)


def _told_wait(policy: Policy) -> float | None:
    """How long a policy says it waits (s), in whole milliseconds."""
    return None if policy.wait is None else wait_ms(policy.wait) / 1000.0


def _merged(options: tuple[tuple[str, Any], ...], extra: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted((dict(options) | dict(extra)).items()))


def _check_options(agent: str, kind: Any, name: str, options: tuple[tuple[str, Any], ...]) -> None:
    parameters = _parameters(kind)
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    valid = [key for key in parameters if key not in _GIVEN]
    for key, _ in options:
        if key not in valid:
            known = f"it takes {', '.join(valid)}" if valid else "it takes none"
            raise OptionError(f"{agent} {name!r} has no option {key!r}; {known}")


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)
