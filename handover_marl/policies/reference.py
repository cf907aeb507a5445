"""References to policies: small picklable values that name a policy and can construct it.

| Accepted value | Example |
|---|---|
| registered name, with options | `"yang2021"`, `"omg_hand_aware:wait=1.5"` |
| registered name and a file | `"learned:runs/policy.npz"` |
| module and class | `"my_package.robots:MyReceiver"`, `"my_package.robots:MyReceiver:speed=2"` |
| class | `MyReceiver` |
| instance | `MyReceiver(...)` |
| adapted function, network or file | `handover_marl.as_receiver(network)` |
| pair of one of these and a dict of options | `("omg_hand_aware", {"wait": 1.5})` |
"""

import functools
import importlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from platform import node
from typing import Any, TypeAlias

from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.episode.spaces import STATE, parse_obs_mode
from handover_marl.errors import (
    DataFormatError,
    DataNotFoundError,
    HandoverError,
    OptionError,
    PolicyError,
    UnknownNameError,
)
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_boolean
from handover_marl.execution.reading import read_plain_file
from handover_marl.execution.tasks import pickle_by_value, unpickle
from handover_marl.policies.hashing import find_package, hash_package, hash_policy
from handover_marl.policies.policy import (
    Policy,
    PolicyContext,
    check_policy_class,
    check_policy_options,
    get_parameters,
    make_policy_context,
    milliseconds_from_wait,
)
from handover_marl.policies.registry import import_reference, list_available, load_registered

_MAX_TEXT = 1000  # characters of a label or a hash of weights
_OPTIONS = re.compile(r"[A-Za-z_]\w*=[^=,]*(,[A-Za-z_]\w*=[^=,]*)*")
_MAX_FILE_BYTES = 20_000_000_000
Options: TypeAlias = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class PolicyReference:
    """Reference to a policy, made by `parse_policy`.

    Attributes:
        agent: The policy's agent, "giver" or "receiver".
        name: Registered name, "module:Class", or the name of a pickled class.
        pickled: Pickled class, instance, or `functools.partial` of a class; empty if the class can be imported by
            its `name`.
        file: Path of the policy file, or None.
        options: Keyword arguments of the constructor, sorted by name.
        trust: Whether modules that the policy file names may be imported.
        label: Name of the policy with its options in tables and result folders; empty until
            `resolve`.
        code_hash: Hash of the policy's code and weights (`hash_policy`); empty until `resolve`.
        wait: Time (s) for which the robot waits at the start of an episode, None if unknown; set by `resolve`.
        obs_mode: Observation mode that the policy declares; set by `resolve`.
        packages: Top-level packages, beside that of the class, from which `pickled` imports functions when it is read.
    """

    agent: str
    name: str
    pickled: bytes = field(default=b"", repr=False)
    file: str | None = None
    options: Options = ()
    trust: bool = False
    label: str = ""
    code_hash: str = ""
    wait: float | None = None
    obs_mode: str = STATE
    packages: tuple[str, ...] = ()

    @property
    def policy_class(self) -> type[Policy]:
        """Class of the referenced policy."""
        found = self._load()
        if isinstance(found, functools.partial):
            found = found.func
        policy_class: type[Policy] = found if isinstance(found, type) else type(found)
        return policy_class

    def make(
        self, dataset: Dataset | None = None, config: WorldConfig = OFFICIAL_CONFIG, setup: str | None = None
    ) -> Policy:
        """Construct the policy that this reference names; raise PolicyError if the policy's constructor fails.

        Args:
            dataset: Robot model, objects and grasps for the policy; default: `open_dataset()`.
            config: World and rules for the policy.
            setup: Setup of the scenes; default: the first of the dataset.
        """
        return self.make_from_context(make_policy_context(dataset or open_dataset(), config, setup))

    def make_from_context(self, context: PolicyContext | None) -> Policy:
        """Construct the policy with a context, None if it needs none; raise PolicyError if its constructor fails."""
        found = self._load()
        if isinstance(found, Policy):
            return found
        parameters = get_parameters(found)
        given = {"agent": self.agent, "context": context, "path": self.file, "trust": self.trust}
        given = {name: value for name, value in given.items() if name in parameters}
        try:
            policy = found(**dict(self.options) | given)
        except HandoverError:
            raise
        except (Exception, SystemExit) as error:
            raise PolicyError(f"{self.agent} {self.name!r} cannot be made ({type(error).__name__}: {error})") from error
        if not isinstance(policy, Policy):
            raise OptionError(f"{self.agent} {self.name!r} must make a policy, got {policy!r}")
        return policy

    def resolve(
        self, dataset: Dataset, config: WorldConfig = OFFICIAL_CONFIG, setup: str | None = None
    ) -> "PolicyReference":
        """Return a copy of this reference in which label, code hash, wait and observation mode are set.

        The policy is constructed once, so that errors of its constructor show early. Arguments are those of `make`.
        """
        policy = self.make(dataset, config, setup)
        try:
            obs_mode, wait, label, weights = policy.obs_mode, policy.wait, policy.label, policy.weights_hash
        except HandoverError:
            raise
        except Exception as error:  # properties of the user's class
            what = f"attributes of {self.agent} {self.name!r}"
            raise PolicyError(f"{what} cannot be read ({type(error).__name__}: {error})") from error
        parse_obs_mode(obs_mode)
        texts = (str, os.PathLike)
        listed = ",".join(f"{key}={value if isinstance(value, texts) else repr(value)}" for key, value in self.options)
        for name, text in (("label", label), ("weights_hash", weights), ("label", f"{label}:{listed}")):
            # Labels are printed and written to files.
            if not isinstance(text, str) or not text.isprintable() or len(text) > _MAX_TEXT:
                raise OptionError(
                    f"{name} of {self.agent} {self.name!r} must be text without control characters, at most "
                    f"{_MAX_TEXT} characters, got {ascii(text)[:100]}"
                )
        found = self._load()
        state = vars(found) if isinstance(found, Policy) else self.options
        content = weights.encode() + b"".join(content for *_, content in self.read_files())
        return replace(
            self,
            label=f"{label}:{listed}" if listed else label,
            code_hash=hash_policy(policy, state, content),
            wait=None if wait is None else milliseconds_from_wait(wait) / 1000.0,
            obs_mode=obs_mode,
        )

    def read_files(self) -> list[tuple[str, str, bytes]]:
        """Read the policy file, and the files that options in `file_options` of the policy name.

        Returns:
            A tuple for each file: the option that names the file ("" for the policy file), the name of the file
            ("folder/file" if the option names a folder), and its content. Options without a file are left out.
        """
        named = [] if self.file is None else [("", Path(self.file))]
        for option, value in self.options:
            if option in self.policy_class.file_options and isinstance(value, (str, os.PathLike)):
                named += [(option, Path(value))] if value not in self.policy_class.non_file_values else []
        paths = [(option, path.expanduser()) for option, path in named]
        return [
            (option, file.relative_to(path.parent).as_posix(), read_policy_file(file))
            for option, path in paths
            if path.exists() or not option
            for file in list_policy_files(path)
        ]

    def _load(self) -> Any:
        if self.pickled:
            return unpickle(self.pickled)
        if ":" in self.name:
            return import_reference(self.agent, self.name)
        return load_registered(self.agent, self.name)


def list_policy_files(path: Path) -> list[Path]:
    """Return the files in a folder and its subfolders, sorted; [path] for the path of a file, even if there is none."""
    return sorted(file for file in path.rglob("*") if not file.is_dir()) if path.is_dir() else [path]


def read_policy_file(path: Path) -> bytes:
    """Return the content of a file that a policy reads; raise DataNotFoundError or DataFormatError if that fails."""
    try:
        return read_plain_file(path, _MAX_FILE_BYTES)
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise DataFormatError(f"{path} cannot be read ({error})") from error


@dataclass(frozen=True)
class PolicyBundle:
    """Policy reference with the contents of the policy's files, to send the policy to machines without shared folders.

    Attributes:
        reference: Reference to the policy on the machine that packed it.
        packages: Pairs (name, hash) of the packages from which the policy's code is imported; code that is pickled in
            the reference has none. The other machine must have packages with these hashes.
        files: Files of the policy, see `PolicyReference.read_files`.
    """

    reference: PolicyReference
    packages: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str, bytes], ...]

    @classmethod
    def pack(cls, reference: PolicyReference) -> "PolicyBundle":
        """Make a bundle of a policy reference and the contents of the files that `PolicyReference.read_files` reads."""
        names = {find_package(reference.policy_class), *reference.packages} - {""}
        packages = tuple((name, hash_package(name)) for name in sorted(names))
        return cls(reference, packages, tuple(reference.read_files()))

    def unpack(self, folder: Path) -> PolicyReference:
        """Write files to a folder, return a reference to them; raise PolicyError if a package is missing or differs.

        Args:
            folder: Existing folder for the bundle's files.
        """
        try:
            _ = self.reference.policy_class
            for name, code in self.packages:
                importlib.import_module(name)
                if hash_package(name) != code:
                    raise PolicyError("it has other code there")
        except Exception as error:  # importing a user's module may raise anything
            raise PolicyError(
                f"on node {node()}: {self.reference.agent} {self.reference.name!r} must be installed as here, got "
                f"{type(error).__name__}: {error}; install the same version there, or pass a class of a script or a "
                "notebook, which is sent along"
            ) from error
        options, policy_file = dict(self.reference.options), self.reference.file
        for option, name, content in self.files:
            root = folder / self.reference.agent / (option or "file")
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            # The files of a folder are named "folder/file"; the option names the folder.
            if option:
                options[option] = str(root / Path(name).parts[0])
            else:
                policy_file = str(path)
        return replace(self.reference, file=policy_file, options=_sort_options(options))


PolicyLike: TypeAlias = str | type[Policy] | Policy | PolicyReference | tuple[Any, Mapping[str, Any]]


def parse_policy(agent: str, policy: PolicyLike, trust: bool = False) -> PolicyReference:
    """Parse a name, class or instance of a policy into a reference; raise UnknownNameError or OptionError if it fails.

    Args:
        agent: Agent that needs a policy, "giver" or "receiver".
        policy: A value of the table in this module's docstring.
        trust: Whether modules that a policy file names may be imported.
    """
    check_boolean("trust", trust)
    extra: Mapping[str, Any] = {}
    if isinstance(policy, tuple):
        if len(policy) != 2 or not isinstance(policy[1], Mapping):
            raise OptionError(f"a {agent} with options must be a pair (policy, dict of options), got {policy!r}")
        policy, extra = policy
    if isinstance(policy, PolicyReference):
        if policy.agent != agent:
            raise OptionError(f"{agent} must be a {agent}'s policy, got {policy.name} of the {policy.agent}")
        if not extra:
            return policy
        if isinstance(policy.pickled and unpickle(policy.pickled), Policy):
            raise OptionError(f"options must be passed with a class, got an instance of {policy.name}; pass the class")
        options = _sort_options(dict(policy.options) | dict(extra))
        return replace(policy, options=options, label="", code_hash="", wait=None)
    if isinstance(policy, str):
        return _parse_text(agent, policy, extra, trust)
    if isinstance(policy, (type, Policy)):
        return _parse_object(agent, policy, extra, trust)
    raise OptionError(
        f"{agent} must be a name, a class or an instance of a policy, got {shorten_text(repr(policy))}; derive the "
        f"class from handover_marl.{agent}s.{agent.capitalize()}, or wrap a function or module by as_{agent}"
    )


def _parse_text(agent: str, text: str, extra: Mapping[str, Any], trust: bool) -> PolicyReference:
    head, colon, tail = text.partition(":")
    policy_class, name, file = load_registered(agent, head), head, None
    if policy_class is None:
        # Registered names have no second part, classes are named "module:Class".
        if not colon or not tail or head.endswith(".py"):
            other = "giver" if agent == "receiver" else "receiver"
            hint = {
                ".py": f"the name of a class in this file is {Path(head).stem}:CLASS",
                ".npz": f"for a policy file, write learned:{text}",
                ".zip": "convert a model by handover_marl.export_policy, and write learned:FILE.npz",
            }.get(Path(head).suffix, f"{text!r} is a {other}" if text in list_available(other) else "")
            raise UnknownNameError(agent, text, list_available(agent), hint)
        attribute, _, rest = tail.partition(":")
        name, tail = f"{head}:{attribute}", rest
        policy_class = import_reference(agent, name, list_available(agent))
    elif colon and "path" in get_parameters(policy_class):
        file, tail = _split_file(tail)
        if not file:
            raise OptionError(f"{agent} {text!r} must name a file; write {head}:FILE")
    check_policy_class(agent, policy_class, name)
    options = _sort_options(_parse_options(agent, text, tail) | dict(extra))
    check_policy_options(agent, policy_class, name, dict(options))
    return PolicyReference(agent, name, file=file, options=options, trust=trust)


def _parse_object(agent: str, policy: Any, extra: Mapping[str, Any], trust: bool) -> PolicyReference:
    policy_class = policy if isinstance(policy, type) else type(policy)
    name = policy_class.__name__
    check_policy_class(agent, policy_class, name)
    if extra and not isinstance(policy, type):
        raise OptionError(f"options must be passed with a class, got an instance of {name}; pass the class")
    check_policy_options(agent, policy_class, name, extra)
    try:
        pickled = pickle_by_value(policy)
    except Exception as error:  # pickling a user's object may raise anything
        raise OptionError(
            f"{agent} {name} cannot be sent to worker processes ({type(error).__name__}: {error}); "
            "pass its class, which makes what it needs in reset()"
        ) from error
    return PolicyReference(agent, name, pickled, options=_sort_options(extra), trust=trust)


def _split_file(tail: str) -> tuple[str, str]:
    """Split "FILE:options" into file name and options, "" without options."""
    file, colon, options = tail.rpartition(":")
    try:
        is_file_name = Path(tail).exists()
    except (OSError, ValueError):  # not a possible file name
        is_file_name = False
    return (file, options) if colon and not is_file_name and _OPTIONS.fullmatch(options) else (tail, "")


def _parse_options(agent: str, text: str, tail: str) -> dict[str, Any]:
    """Return the options in `tail`, "key=value,key=value" with JSON values or other text; `text` is for errors."""
    if tail and not _OPTIONS.fullmatch(tail):
        raise OptionError(f"options of {agent} {text!r} must be key=value,key=value, got {tail!r}")
    options: dict[str, Any] = {}
    for part in tail.split(",") if tail else ():
        key, _, value = part.partition("=")
        if key in options:
            raise OptionError(f"options of {agent} {text!r} must have different names, got {tail!r}")
        try:
            options[key] = json.loads(value)
        except (ValueError, RecursionError):  # deeply nested lists
            options[key] = value
    return options


def _sort_options(options: Mapping[str, Any]) -> Options:
    return tuple(sorted(options.items()))
