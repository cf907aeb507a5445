"""Base class of scripted givers, and functions of their observations; arrays have one row per episode."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np

from handover_marl.config import CheckedConfig
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, ArrayFactory, get_namespace, to_float64
from handover_marl.geometry.vectors import compute_lengths
from handover_marl.policies.batch import Actions, ArrayPolicy, make_giver_actions
from handover_marl.policies.policy import Giver, PolicyContext

_PAUSE = -1.0  # playback rate minus 1


@dataclass(frozen=True)
class NoConfig(CheckedConfig):
    """Configuration of a giver without options."""


class ArrayGiver(ArrayPolicy, Giver):
    """Base class of givers that keep their state in arrays (n, ...), with one row for each of n episodes.

    Subclasses define `decide`, `initial_state` if they keep a state, and `start` if a part of the state is random. The
    argument `rows` (r,) of methods has the indices of r episodes, to which the other arrays (r, ...) belong.

    Args:
        context: Robot and task.
        options: Values that replace defaults of the configuration, by name of the field.

    Attributes:
        config: Configuration: the default of the class, changed by `options`.
        state: Arrays (n, ...) by the names in `initial_state`.
        rngs: Random generator of each episode.
        arrays: Creator of the arrays, NumPy arrays or PyTorch tensors.

    Raises:
        OptionError: An option does not exist, or its value is out of range.
    """

    config: Any = NoConfig()
    #: Initial state of each episode: numbers, booleans or vectors (k,) by name.
    initial_state: ClassVar[Mapping[str, float | tuple[float, ...]]] = {}

    def __init__(self, context: PolicyContext | None = None, **options: float) -> None:
        super().__init__(context)
        names = [field.name for field in fields(self.config)]
        unknown = [name for name in options if name not in names]
        if unknown:
            known = f"valid options: {', '.join(names)}" if names else "it takes no options"
            raise OptionError(f"giver {self.name!r} has no option {unknown[0]!r}; {known}")
        self.config = replace(self.config, **options)
        self.allocate(1, NUMPY_ARRAYS)

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the state of `count` episodes, in arrays that `arrays` creates."""
        self.arrays, self.rngs = arrays, [np.random.default_rng(0)] * count
        self.state: dict[str, AnyArray] = {}
        for name, value in self.initial_state.items():
            self.state[name] = arrays.asarray(np.full((count, *np.shape(value)), value))

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`; `seed` seeds its random numbers."""
        self.rngs[row] = np.random.default_rng(seed)
        for name, value in self.initial_state.items():
            self.state[name][row] = self.arrays.asarray(value)

    def make_actions(self, rows: AnyIndices, **components: float | AnyArray) -> Actions:
        """Make actions (r, 8) for `rows` (r,) from keywords of `make_giver_actions`, such as `rate`; others are 0."""
        return make_giver_actions(len(rows), arrays=self.arrays, **components)

    def make_pauses(self, rows: AnyIndices, is_paused: AnyArray) -> Actions:
        """Make actions (r, 8) that pause the recording in episodes where `is_paused` (r,) is true, else replay it."""
        return self.make_actions(rows, rate=self.arrays.xp.where(is_paused, _PAUSE, 0.0))


def is_hand_previewed(observation: Observation) -> AnyArray:
    """Return a mask (r,): whether there is a hand now, and in the last previewed pose (by default 0.5 s ahead)."""
    is_recorded = get_namespace(observation["time"]).any(observation["replay_wrist_poses"][:, -1] != 0.0, axis=1)
    return is_recorded & (observation["hand_present"][:, 0] != 0.0)


def compute_gripper_object_distances(observation: Observation) -> AnyArray:
    """Return the distances (r,) from the Panda's hand link to the target object's origin (m), float64."""
    return to_float64(compute_lengths(observation["gripper_pose"][:, :3] - observation["object_poses"][:, 0, :3]))


def compute_withdrawals(observation: Observation, distance: float | AnyArray) -> AnyArray:
    """Return displacements (r, 3; world, m) of wrists by `distance`, a number or (r, 1), away from the gripper."""
    away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
    return distance * away / compute_lengths(away).clip(1e-6)[:, None]
