"""Populations of partners: named givers and receivers in families, read from a JSON file.

A population's file has the keys `name`, `version`, `description`, `givers` and `receivers`. A giver or receiver has
the keys of `Partner`. In its key `policy`, `{folder}` stands for the folder of the population's file.
"""

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import handover_marl.assets
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import STATE
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, UnknownNameError, check_name
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.hashing import hash_policy
from handover_marl.policies.policy import Action, Giver, Policy, PolicyContext, Receiver
from handover_marl.policies.reference import list_policy_files, parse_policy, read_policy_file
from handover_marl.policies.registry import check_stored_reference, list_available

#: Folder of the shipped populations.
POPULATION_FOLDER = Path(handover_marl.assets.__file__).parent / "populations"
#: Shipped population of givers and receivers.
DEFAULT_POPULATION = "strangers-v1"
#: Splits of a population: a family is in "train" or "test"; "all" has all families.
TRAIN, TEST, ALL = "train", "test", "all"

_SUFFIX = ".json"
_FOLDER = "{folder}"
_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Partner:
    """Giver or receiver in a population of partners.

    Attributes:
        name: Unique name in the population.
        family: Name of a kind of behavior that partners share; each family is in one split only.
        split: "train" or "test".
        policy: Text that names the policy and its options, e.g. "omg:wait=1.5"; `{folder}` is the folder of the file.
        description: One sentence on the behavior.
    """

    name: str
    family: str
    split: str
    policy: str
    description: str


@dataclass(frozen=True)
class Population:
    """Population of givers and receivers, the partners with which policies are trained and evaluated.

    Attributes:
        name: Name of the population.
        version: Version of its content.
        description: Sentence on its purpose.
        givers: Givers, partners of receivers.
        receivers: Receivers, partners of givers.
        content_hash: Hash (12 hex digits) of the file's content and of the files that its policies name.
        path: Path of the file.
    """

    name: str
    version: str
    description: str
    givers: tuple[Partner, ...]
    receivers: tuple[Partner, ...]
    content_hash: str
    path: Path

    @property
    def label(self) -> str:
        """Name, version and hash, for reports."""
        return f"{self.name} {self.version} ({self.content_hash})"

    def get_policy(self, partner: Partner) -> str:
        """Return a partner's `policy` with the folder of this population's file in place of `{folder}`."""
        return partner.policy.replace(_FOLDER, str(self.path.parent))

    def select(self, agent: str, split: str) -> tuple[Partner, ...]:
        """Return the partners of one agent in a split.

        Args:
            agent: Agent of the partners, "giver" or "receiver".
            split: "train", "test" or "all".

        Raises:
            UnknownNameError: There is no such split.
            OptionError: The population has no such partners.
        """
        check_name("partners", split, (TRAIN, TEST, ALL))
        candidates = self.givers if agent == "giver" else self.receivers
        chosen = tuple(partner for partner in candidates if split in (ALL, partner.split))
        if not chosen:
            raise OptionError(
                f"population must have {agent}s in {split!r}, got none in {self.path}; choose another one"
            )
        return chosen


def load_population(population: str | os.PathLike[str] = DEFAULT_POPULATION, trust: bool = False) -> Population:
    """Read a population of partners from its file.

    Args:
        population: Name of a shipped population, or path of a JSON file.
        trust: Whether modules that the file names may be imported.

    Raises:
        UnknownNameError: There is no shipped population of this name.
        DataNotFoundError: The file, or a policy file that it names, cannot be read.
        DataFormatError: The file is malformed.
        UnsafeFileError: A policy is `module:Class`, and the file is not trusted.
    """
    path = _find_path(population)
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        partners = {key: tuple(Partner(**entry) for entry in content[key]) for key in ("givers", "receivers")}
        found = Population(**content | partners, content_hash="", path=path)
    except OSError as error:
        raise DataNotFoundError(f"population {path} cannot be read ({error.strerror or error})") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise DataFormatError(f"{path}: not a readable population ({shorten_text(error)})") from error
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for agent, members in (("giver", found.givers), ("receiver", found.receivers)):
        _check_partners(path, members)
        for partner in members:
            check_stored_reference(path, agent, partner.policy, trust, list_available(agent))
            for word in re.split("[:,=]", partner.policy):
                # The class may be one that is not installed here; which options name files is not known.
                if "/" in word or (Path(word).suffix and Path(word).exists()):
                    for file in list_policy_files(Path(word.replace(_FOLDER, str(path.parent))).expanduser()):
                        digest.update(hashlib.sha256(read_policy_file(file)).digest())
    return replace(found, content_hash=digest.hexdigest()[:12])


def format_population(
    name: str, version: str, description: str, givers: Sequence[Partner], receivers: Sequence[Partner]
) -> str:
    """Return the JSON text of a population's file, which `load_population` reads; arguments as in `Population`."""
    content = {"name": name, "version": version, "description": description}
    partners = {"givers": list(map(asdict, givers)), "receivers": list(map(asdict, receivers))}
    return json.dumps(content | partners, indent=1) + "\n"


def list_populations() -> tuple[str, ...]:
    """List the names of the shipped populations."""
    return tuple(sorted(file.stem for file in POPULATION_FOLDER.glob(f"*{_SUFFIX}")))


def _find_path(population: str | os.PathLike[str]) -> Path:
    path = check_path("population", population)
    if path.suffix == _SUFFIX:
        return path
    if str(population) not in list_populations():
        raise UnknownNameError("population", str(population), list_populations(), "or the path of a .json file")
    return POPULATION_FOLDER / f"{population}{_SUFFIX}"


def _check_partners(path: Path, partners: Sequence[Partner]) -> None:
    splits = {partner.split for partner in partners}
    if not splits <= {TRAIN, TEST}:
        raise DataFormatError(f"{path}: split must be {TRAIN} or {TEST}, got {sorted(splits)}")
    families = [family for family, _ in {(partner.family, partner.split) for partner in partners}]
    names, policies = ([getattr(partner, key) for partner in partners] for key in ("name", "policy"))
    for what, values in (("family in one split", families), ("name", names), ("policy", policies)):
        for value, count in Counter(values).items():
            if count > 1:
                raise DataFormatError(f"{path}: every {what} must be unique, got {value!r} twice")


class PopulationPolicy(Policy):
    """Base class of policies that act as a randomly drawn member of a population in each episode.

    The seed of the episode determines the member, and all members are equally likely. Members that observe camera
    data are left out, because this policy observes the state and passes its observations to the members.

    Args:
        context: Context from which the members are constructed.
        population: Name of a shipped population, or path of a file; see `handover_marl.policies.populations`.
        partners: Families to draw from: "train", "test" or "all".
        trust: Whether modules that the population or its policy files name may be imported.

    Attributes:
        members: Policies of the members.
    """

    name = "population"
    file_options = ("population",)
    non_file_values = list_populations()

    def __init__(
        self,
        context: PolicyContext | None = None,
        population: str = DEFAULT_POPULATION,
        partners: str = TRAIN,
        trust: bool = False,
    ) -> None:
        super().__init__(context)
        self._given_context = context
        agent, found = str(self.agent), load_population(population, trust)
        self._content_hash = found.content_hash
        chosen = found.select(agent, partners)
        references = [parse_policy(agent, found.get_policy(partner), trust) for partner in chosen]
        # A class with a camera is not constructed, because it may need an extra; a policy file states its own mode.
        state_only = [one for one in references if one.policy_class.obs_mode == STATE]
        made = [(one, one.make_from_context(context)) for one in state_only]
        kept = [(one, member) for one, member in made if member.obs_mode == STATE]
        self._references, self.members = [one for one, _ in kept], [member for _, member in kept]
        if not self.members:
            raise OptionError(f"population must have {agent}s that act on the state, got none in {population!r}")
        self._member = self.members[0]

    @property
    def weights_hash(self) -> str:
        """Hash of the population's file, of the policy files that it names, and of the members' code."""
        codes = (hash_policy(member, (), member.weights_hash.encode()) for member in self.members)
        return hashlib.sha256(" ".join([self._content_hash, *codes]).encode()).hexdigest()

    @property
    def wait(self) -> float | None:
        """Time (s) for which every member waits at the start of an episode; None if it differs between members."""
        waits = {member.wait for member in self.members}
        return waits.pop() if len(waits) == 1 else None

    @property
    def hold_time(self) -> float:
        """Time (s) for which the action of the member that acts in this episode is held."""
        return self._member.hold_time

    def prepare(self, object_names: Sequence[str]) -> None:
        """Prepare all members for episodes with these objects."""
        for member in self.members:
            member.prepare(object_names)

    def make_member(self, number: int) -> Policy:
        """Return a new policy of the member with the index `number`."""
        return self._references[number].make_from_context(self._given_context)

    def draw_member(self, seed: int | None) -> tuple[int, int]:
        """Draw a member at random, by the seed of an episode; return the member's index and a seed for the member."""
        rng = np.random.default_rng(seed)
        return int(rng.integers(len(self.members))), int(rng.integers(2**32))

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with a member drawn at random; without a seed, the draw is not reproducible."""
        number, member_seed = self.draw_member(seed)
        self._member = self.members[number]
        self._member.reset(member_seed)

    def act(self, observation: Observation) -> Action:
        """Return the action of the member that acts in this episode."""
        return self._member.act(observation)


class PopulationGiver(PopulationPolicy, Giver):
    """Giver that acts as a randomly drawn giver of a population in each episode; see `PopulationPolicy`."""


class PopulationReceiver(PopulationPolicy, Receiver):
    """Receiver that acts as a randomly drawn receiver of a population in each episode; see `PopulationPolicy`."""
