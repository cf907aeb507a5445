"""Base classes of policies, and the context that their constructors may take."""

import functools
import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import MAX_CONTROL_PERIOD, OFFICIAL_CONFIG, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.datasets.dataset import Dataset
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import STATE, check_vector
from handover_marl.errors import ActionError, OptionError, ResetNeededError, UnknownNameError
from handover_marl.execution.files import shorten_text
from handover_marl.geometry.ycb import CLASS_NAMES

Action = npt.NDArray[np.float32]
_Part = TypeVar("_Part")
_Config = TypeVar("_Config")

_MAX_WAIT = 60.0  # s
# Largest set-points of a giver (m, rad); larger ones are probably in mm or degrees.
_MAX_DISPLACEMENT, _MAX_ROTATION = 3.0, 7.0
# Constructor parameters that the library fills in; not available as options.
_RESERVED_PARAMETERS = ("self", "context", "agent", "path", "trust")


@dataclass(frozen=True)
class PolicyContext:
    """Context for constructors of policies: robot, protocol, objects and known grasps.

    Attributes:
        panda_urdf: URDF file of the robot.
        load_grasps: Function that returns the known grasps of an object by class name: (n, 4, 4) gripper
            poses in the object's frame (m), or None for an object without grasps.
        find_object_urdf: Function that returns the URDF file of an object by class name.
        config: Simulated world, protocol and limits of the giver.
        setup: Official setup, "s0" to "s3", for policies with different weights for each setup; or a
            setup of other data.
        object_names: Class name of each class number in observations (`object_classes`), e.g.
            `context.object_names[14]` is "025_mug".
        quick_validation: Whether to validate grasps with few simulations if no validation of the object's grasps
            is stored; see `Dataset.quick_validation`.
    """

    panda_urdf: Path
    load_grasps: Callable[[str], npt.NDArray[np.float64] | None]
    find_object_urdf: Callable[[str], Path]
    config: WorldConfig = OFFICIAL_CONFIG
    setup: str = "s0"
    object_names: Mapping[int, str] = field(default_factory=lambda: dict(CLASS_NAMES), hash=False, repr=False)
    quick_validation: bool = False

    @property
    def panda(self) -> PandaConfig:
        """Base pose, start joints and motors of the robot."""
        return self.config.physics.panda

    @property
    def protocol(self) -> ProtocolConfig:
        """Rules of release, success and failure, including the goal position."""
        return self.config.protocol


def make_policy_context(
    dataset: Dataset, config: WorldConfig = OFFICIAL_CONFIG, setup: str | None = None
) -> PolicyContext:
    """Make the context for policies that act in the scenes of a dataset.

    Args:
        dataset: Dataset with robot and objects.
        config: Simulated world, protocol and limits of the giver.
        setup: Setup of the dataset; default: its first.
    """
    if not isinstance(dataset, Dataset):
        raise OptionError(f"dataset must be env.dataset or handover_marl.datasets.open_dataset(...), got {dataset!r}")
    return PolicyContext(
        dataset.panda_urdf,
        dataset.load_grasps,
        dataset.find_object_urdf,
        config,
        dataset.resolve_setup(setup),
        dataset.object_names,
        dataset.quick_validation,
    )


class Policy(ABC):
    """Base class of policies: a policy maps observations of one agent to its actions.

    A policy has no access to the environment. Its constructor may take `context`, a `PolicyContext`, and options with
    default values; users can set options in the text that names the policy (`omg:wait=1.5`).

    Args:
        context: Robot, protocol, objects and known grasps; default: none, for policies that are
            constructed by hand and do not use it.

    Attributes:
        agent: Agent that the policy acts for, "giver" or "receiver"; None for either.
        name: Name of the policy in tables and files.
        control_period: Time between two decisions (s); a whole number of milliseconds.
        obs_mode: Observation mode of a receiver: "state", or camera data such as "pointcloud" or
            "state+rgbd"; see `handover_marl.episode.spaces.OBS_PARTS`. Images are rendered only when the
            policy acts, and rendering does not count as planning time.
        file_options: Names of constructor options whose value is a file or folder, which is sent to other machines.
        non_file_values: Values of `file_options` that are not files, such as the name of a shipped population.
    """

    agent: ClassVar[str | None] = None
    name: ClassVar[str]
    control_period: ClassVar[float] = 0.1
    file_options: ClassVar[tuple[str, ...]] = ()
    non_file_values: ClassVar[tuple[str, ...]] = ()
    obs_mode: str = STATE

    def __init__(self, context: PolicyContext | None = None) -> None:
        if context is not None:
            self.context = context

    @functools.cached_property
    def context(self) -> PolicyContext:
        """Robot, protocol, objects and known grasps.

        Raises:
            OptionError: The policy was constructed without a context.
        """
        raise OptionError(
            f"context must be given to the constructor of {type(self).__name__}, got none; pass the class instead of "
            "an instance, or call super().__init__(context)"
        )

    def prepare(self, object_names: Sequence[str]) -> None:  # noqa: B027
        """Prepare for episodes with objects of these classes; may be called several times before `reset`.

        Slow computations whose results are cached, such as grasp validation, belong here. The results must depend on
        the objects only.

        Args:
            object_names: Class names such as "025_mug"; the first object is handed over.
        """

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Start an episode; the actions in it must not depend on earlier episodes.

        Args:
            seed: Seed of the policy's random generator. In evaluations it is a hash of the run's seed and, for a
                receiver, the first observation, or for a giver, the scene number.
        """

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Return an action, an element of the agent's action space, for an observation; it is held for `hold_time`.

        Args:
            observation: Element of the agent's observation space.
        """

    @property
    def label(self) -> str:
        """Unique label of the policy in result files; default: its name."""
        return self.name

    @property
    def weights_hash(self) -> str:
        """Hash of the policy's network weights; empty without weights."""
        return ""

    @property
    def wait(self) -> float | None:
        """Time (s) for which the robot waits at the start of each episode; None if unknown."""
        return 0.0

    @property
    def planned_goal(self) -> npt.NDArray[np.float64] | None:
        """Planned poses (k, 7) of the robot's hand link, the grasp last; None if there is no plan.

        World frame, xyz (m) and quaternion xyzw; shown in replays of episodes.
        """
        return None

    @property
    def hold_time(self) -> float:
        """Time (s) for which the last action is held; default: the control period.

        Subclasses may override it to act more often in some phases. Evaluations, and environments in which
        the policy is a fixed partner, call `act` again after exactly this time.
        """
        return self.control_period


class Giver(Policy):
    """Base class of givers, policies of the human side.

    User-defined givers can be passed as a class or an instance, or registered in the entry-point group
    `handover_marl.givers`. A giver that is passed as a class or a name gets a context.
    """

    agent: ClassVar[str | None] = "giver"

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Return the giver's action (8,) float32, a deviation from the recording; see `make_giver_action`.

        Args:
            observation: Element of `handover_marl.episode.observations.giver_observation_space`.
        """


class Receiver(Policy):
    """Base class of receivers, policies of the robot.

    User-defined receivers can be passed as a class or an instance, or registered in the entry-point group
    `handover_marl.receivers`.
    """

    agent: ClassVar[str | None] = "receiver"

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Return the robot's target joint positions (9,): 7 arm (rad), 2 fingers (m), float32.

        Args:
            observation: Element of `handover_marl.episode.observations.receiver_observation_space`.
        """


def make_giver_action(
    rate: float = 0.0,
    displacement: npt.ArrayLike = (0.0, 0.0, 0.0),
    rotation: npt.ArrayLike = (0.0, 0.0, 0.0),
    release: bool = False,
) -> Action:
    """Make a giver's action (8,) from its components; see `handover_marl.episode.spaces.giver_action_space`.

    Args:
        rate: Playback rate minus 1, from -1 to 1.
        displacement: (3,) set-point of the wrist's displacement, world frame (m).
        rotation: (3,) set-point of the rotation vector about the wrist, world frame (rad).
        release: Whether to release the object.

    Raises:
        ActionError: A value does not have the stated number of finite numbers, or its unit is probably mm or degrees.
    """
    move = check_vector("displacement", displacement, 3, "a set-point (m)")
    turn = check_vector("rotation", rotation, 3, "a rotation vector (rad)")
    if np.abs(move).max() > _MAX_DISPLACEMENT or np.abs(turn).max() > _MAX_ROTATION:
        raise ActionError(f"displacement must be in m and rotation in rad, got {move.tolist()} and {turn.tolist()}")
    speed = check_vector("rate", [rate], 1, "the playback rate minus 1")
    return np.array([*speed, *move, *turn, float(release)], dtype=np.float32)


def milliseconds_from_wait(wait: float) -> int:
    """Convert a waiting time, 0 to 60 s, to whole milliseconds; raise OptionError for another value."""
    if isinstance(wait, bool) or not isinstance(wait, (int, float)) or not 0.0 <= wait <= _MAX_WAIT:
        raise OptionError(f"wait must be a time from 0 to {_MAX_WAIT:g} s, got {shorten_text(repr(wait))}")
    return round(1000.0 * wait)


def check_policy_class(agent: str, policy_class: Any, name: str) -> None:
    """Raise OptionError unless `policy_class` is a complete policy class for an agent; `name` is for messages."""
    is_policy = isinstance(policy_class, type) and issubclass(policy_class, Policy)
    if not is_policy or policy_class.agent not in (agent, None):
        base = f"handover_marl.{agent}s.{agent.capitalize()}"
        given = shorten_text(repr(policy_class)) + f"; in Python, handover_marl.as_{agent} makes one of a function"
        if is_policy:
            given = f"a {policy_class.agent}; pass it as the {policy_class.agent}"
        raise OptionError(f"{agent} {name!r} must be a subclass of {base}, got {given}")
    if inspect.isabstract(policy_class):
        missing = ", ".join(sorted(policy_class.__abstractmethods__))
        raise OptionError(f"{agent} {name!r} must define {missing}; add the missing methods")
    period = getattr(policy_class, "control_period", None)
    is_time = isinstance(period, (int, float)) and not isinstance(period, bool) and 0.0 < period <= MAX_CONTROL_PERIOD
    if not is_time and not isinstance(period, property):
        rule = f"must be a time of at most {MAX_CONTROL_PERIOD:g} s"
        raise OptionError(f"control_period of {agent} {name!r} {rule}, got {period!r}; for 100 ms set 0.1")
    if not isinstance(getattr(policy_class, "name", None), (str, property)):
        raise OptionError(f'{agent} {name!r} has no name; add the class attribute name = "mine"')


def check_policy_options(agent: str, policy_class: type, name: str, option_names: Iterable[str]) -> None:
    """Raise `OptionError` unless a class's constructor has all `option_names`; `agent` and `name` are for messages."""
    parameters = get_parameters(policy_class)
    any_name = {key for key, parameter in parameters.items() if parameter.kind is parameter.VAR_KEYWORD}
    valid = [key for key in parameters if key not in (*_RESERVED_PARAMETERS, *any_name)]
    for key in option_names:
        if key in _RESERVED_PARAMETERS or not (any_name or key in valid):
            known = f"valid options: {', '.join(valid)}" if valid else "it takes no options"
            raise OptionError(f"{agent} {name!r} has no option {key!r}; {known}")


def get_parameters(policy_class: type) -> dict[str, inspect.Parameter]:
    """Return the parameters of the constructor of a class by name."""
    return dict(inspect.signature(policy_class).parameters)


def require_reset(part: _Part | None, receiver_name: str) -> _Part:
    """Return `part`, which a receiver's `reset` creates; raise `ResetNeededError` if it is None (before `reset`)."""
    if part is None:
        raise ResetNeededError(f"receiver {receiver_name!r} cannot act before reset(); call reset() first")
    return part


def override_options(config: _Config, options: Mapping[str, object]) -> _Config:
    """Return a copy of a policy's configuration with the numbers in `options`.

    Args:
        config: Configuration to change, a dataclass whose fields may be dataclasses, too (sections).
        options: Numbers by name: FIELD for a field of the configuration, such as `near_period`, or SECTION_FIELD for
            a field of one of its sections, such as `approach_standoff` for `config.approach.standoff`.
    """
    sections: dict[str, Any] = {name: part for name, part in vars(config).items() if is_dataclass(part)}
    parts = {"": config} | {f"{name}_": part for name, part in sections.items()}
    numbers = {
        prefix + name: (prefix, name)
        for prefix, part in parts.items()
        for name, value in vars(part).items()
        if _is_number(value)
    }
    for option, value in options.items():
        if option not in numbers:
            raise UnknownNameError("option", option, list(numbers), "docs/reference/policies.md has the others")
        prefix, name = numbers[option]
        known = getattr(parts[prefix], name)
        if isinstance(value, bool) or not isinstance(value, (int, type(known))) or not math.isfinite(value):
            raise OptionError(f"{option} must be a finite {type(known).__name__}, got {value!r}")
        parts[prefix] = replace(parts[prefix], **{name: value})
    return replace(parts[""], **{name: parts[f"{name}_"] for name in sections})  # type: ignore[no-any-return]


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
