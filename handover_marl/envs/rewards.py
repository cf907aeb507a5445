"""Reward terms and their weighted sums; the preset rewards are weights.

`docs/reference/rewards.md` has the formula and the unit of every term. The object is grasped while both fingers touch
it. If the unit of a term contains a length or a time, the sum of the term over an episode hardly depends on the control
period.

A shaping term (Ng et al., "Policy invariance under reward transformations", ICML 1999) is gamma times the potential
after a step minus the potential before it; the potential is 0 once the episode has terminated. The discounted sum of a
shaping term over a terminated episode depends only on the first state: shaping does not change the optimal policy.
"""

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from handover_marl.config import check_number
from handover_marl.envs.agents import AGENTS
from handover_marl.envs.transition import Transition
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, check_name
from handover_marl.geometry.arrays import (
    AnyArray,
    AnyIndices,
    ArrayFactory,
    as_arrays,
    get_namespace,
    make_constant,
    to_float64,
)
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import inverse_transform_points, transform_points
from handover_marl.geometry.vectors import compute_box_distances, compute_lengths
from handover_marl.planning.robot_clearance import GRIPPER_BOX_CENTERS, GRIPPER_BOX_HALF_SIZES

#: Values (r,) of terms by name.
ArrayTerms: TypeAlias = dict[str, AnyArray]
#: Names of terms by agent.
TermNames: TypeAlias = Mapping[str, Iterable[str]]

#: Distance beyond which the term `clearance` is 0 (m).
CLEARANCE_MARGIN = 0.1
# Columns of a stored state: time (s), pose of the hand link, position of the object (m), whether both fingers touch it,
# wrist (m, NaN if there is no hand) and its displacement from the recording (m), whether the person holds the object.
_TIME, _GRIPPER, _HAND_LINK, _OBJECT, _GRASPED = 0, slice(1, 8), slice(1, 4), slice(8, 11), 11
_WRIST, _DISPLACEMENT, _OFFERED, _SIZE = slice(12, 15), slice(15, 18), 18, 19
# Number of stored states of an episode: four positions determine a third difference.
_COUNT = 4
# Times have single precision: durations are rounded to 1 ms, and are equal if they differ by less than 0.1 ms.
_STEPS_PER_SECOND, _SAME_DURATION = 1000.0, 1e-4


@dataclass(frozen=True, eq=False)
class StepBatch:
    """Last control step of r episodes, as arrays with the episode as first axis.

    Attributes:
        states: Stored states (r, 4, 19), summaries of the last four states, the newest last; NaN before the start of an
            episode. The constants `_TIME` to `_OFFERED` are the indices of the 19 columns.
        state: Full state after the step, the arrays that `StepData.read_state` returns; {} if no term needs them.
        status: Bits (r,) of `EpisodeStatus` after the step.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
        gamma: Discount factor of the shaping terms.
    """

    states: AnyArray
    state: Mapping[str, AnyArray]
    status: AnyArray
    goal: AnyArray
    gamma: float

    @property
    def duration(self) -> AnyArray:
        """Durations (r,) of the control steps (s)."""
        steps = (self.states[:, -1, _TIME] - self.states[:, -2, _TIME]) * _STEPS_PER_SECOND
        return get_namespace(steps).round(steps) / _STEPS_PER_SECOND


def compute_outcome(outcome: EpisodeStatus, steps: StepBatch) -> AnyArray:
    """Return 1.0 for episodes whose status after the step has the bit `outcome`, 0.0 for the others, (r,)."""
    return to_float64((steps.status & int(outcome)) != 0)


def compute_distance_potential(steps: StepBatch, states: AnyArray) -> AnyArray:
    """Return potentials (r,) of stored states (r, 19): 1 if grasped, else 1 - distance (m) of fingertips to object."""
    fingertips = transform_points(states[:, _GRIPPER], make_constant(FINGERTIPS, states))
    is_grasped = states[:, _GRASPED]
    return 1.0 - (1.0 - is_grasped) * compute_lengths(fingertips - states[:, _OBJECT])


def compute_grasp_potential(steps: StepBatch, states: AnyArray) -> AnyArray:
    """Return potentials (r,) of stored states (r, 19): 1 if both fingers touch the object, else 0."""
    return states[:, _GRASPED]


def compute_goal_potential(steps: StepBatch, states: AnyArray) -> AnyArray:
    """Return potentials (r,) of stored states (r, 19): 1 - distance (m) from hand link to goal if grasped, else 0."""
    return states[:, _GRASPED] * (1.0 - compute_lengths(states[:, _HAND_LINK] - steps.goal))


def compute_shaping(potential: Callable[[StepBatch, AnyArray], AnyArray], steps: StepBatch) -> AnyArray:
    """Return the shaping reward (r,) of each step: gamma times the potential after it, minus the potential before it.

    The potential after a step that terminates the episode is 0.
    """
    # A timeout truncates an episode; only termination ends its potential.
    goes_on = to_float64((steps.status & ~int(EpisodeStatus.TIMEOUT)) == 0)
    return steps.gamma * goes_on * potential(steps, steps.states[:, -1]) - potential(steps, steps.states[:, -2])


def compute_effort(steps: StepBatch) -> AnyArray:
    """Return the effort (r,) in m^2/s: squared speed of the wrist's displacement from the recording, times duration."""
    change = steps.states[:, -1, _DISPLACEMENT] - steps.states[:, -2, _DISPLACEMENT]
    return compute_lengths(change) ** 2 / steps.duration


def compute_discomfort(steps: StepBatch) -> AnyArray:
    """Return the discomfort (r,): length of the wrist's displacement (m) + rotation (rad) / 3, times duration (s)."""
    deviation = to_float64(steps.state["deviation"])
    return (compute_lengths(deviation[:, 1:4]) + compute_lengths(deviation[:, 4:]) / 3.0) * steps.duration


def compute_path(position: slice, steps: StepBatch) -> AnyArray:
    """Return the distances (r,) in m between the positions before and after each step; 0 if a position is NaN.

    `position` has the columns of the positions in the stored states of `StepBatch`.
    """
    return _replace_nan(compute_lengths(steps.states[:, -1, position] - steps.states[:, -2, position]))


def compute_jerk(position: slice, steps: StepBatch) -> AnyArray:
    """Return the norms (r,) of the third difference of the last four positions, over duration^2 (m/s^2).

    A norm is 0 if a position is NaN, or if the three steps differ in duration. For `position` see `compute_path`.
    """
    a, b, c, d = (steps.states[:, number, position] for number in range(_COUNT))
    jerk = compute_lengths(d - 3.0 * c + 3.0 * b - a) / steps.duration**2
    xp, durations = get_namespace(jerk), steps.states[:, 1:, _TIME] - steps.states[:, :-1, _TIME]
    is_regular = xp.max(durations, axis=1) - xp.min(durations, axis=1) < _SAME_DURATION
    return _replace_nan(xp.where(is_regular, jerk, 0.0))


def compute_clearance(steps: StepBatch) -> AnyArray:
    """Return duration * (min(d, 0.1) - 0.1), (r,) in m s, for distances d to the human hand; 0 without a hand."""
    distances, is_present = compute_hand_distances(steps.state), steps.state["hand_present"][:, 0] != 0.0
    missing = distances.clip(max=CLEARANCE_MARGIN) - CLEARANCE_MARGIN
    return to_float64(is_present) * missing * steps.duration


def compute_hand_distances(state: Mapping[str, AnyArray]) -> AnyArray:
    """Return the distances (r,) in m between the open gripper (four boxes) and the nearest human hand joint."""
    points = inverse_transform_points(state["gripper_pose"][:, None], state["hand_keypoints"])
    xp, points, centers, halves = as_arrays(points, GRIPPER_BOX_CENTERS, GRIPPER_BOX_HALF_SIZES)
    return xp.min(compute_box_distances(points[:, :, None] - centers, halves), axis=(1, 2)).clip(0.0)


def _replace_nan(values: AnyArray) -> AnyArray:
    xp = get_namespace(values)
    return xp.where(xp.isnan(values), 0.0, values)


#: Functions that return the values (r,) of each reward term for a `StepBatch`; units: docs/reference/rewards.md.
TERMS: dict[str, Callable[[StepBatch], AnyArray]] = {
    "success": functools.partial(compute_outcome, EpisodeStatus.SUCCESS),
    "contact": functools.partial(compute_outcome, EpisodeStatus.HUMAN_CONTACT),
    "drop": functools.partial(compute_outcome, EpisodeStatus.OBJECT_DROP),
    "distance": functools.partial(compute_shaping, compute_distance_potential),
    "grasp": functools.partial(compute_shaping, compute_grasp_potential),
    "goal": functools.partial(compute_shaping, compute_goal_potential),
    "effort": compute_effort,
    "discomfort": compute_discomfort,
    "waiting": lambda steps: steps.states[:, -2, _OFFERED] * steps.duration,
    "gripper_path": functools.partial(compute_path, _HAND_LINK),
    "giver_path": functools.partial(compute_path, _WRIST),
    "gripper_jerk": functools.partial(compute_jerk, _HAND_LINK),
    "giver_jerk": functools.partial(compute_jerk, _WRIST),
    "robot_object_force": lambda steps: steps.state["robot_object_force"] * steps.duration,
    "robot_hand_force": lambda steps: steps.state["robot_hand_force"] * steps.duration,
    "time": lambda steps: steps.duration,
    "clearance": compute_clearance,
}
# Terms that depend on the status alone, and terms that depend on forces.
_OUTCOMES, _FORCES = {"success", "contact", "drop"}, {"robot_object_force", "robot_hand_force"}


@dataclass(frozen=True)
class RewardWeights:
    """Weights of reward terms, a value that `rewards` and `combine_rewards` accept.

    Attributes:
        receiver: Weights of the receiver's terms by name, see `handover_marl.envs.rewards`.
        giver: Weights of the giver's terms by name.
        gamma: Discount factor of the shaping terms; should equal the learner's discount factor.

    Raises:
        UnknownNameError: A name is not the name of a reward term.
        OptionError: A weight is not a finite number, or `gamma` is not from 0 to 1.
    """

    receiver: Mapping[str, float] = field(default_factory=dict)
    giver: Mapping[str, float] = field(default_factory=dict)
    gamma: float = 0.99

    def __post_init__(self) -> None:
        for agent in AGENTS:
            weights = getattr(self, agent)
            if not isinstance(weights, Mapping):
                raise OptionError(f"{agent} of RewardWeights must be a dict of weights by term, got {weights!r}")
            for name, weight in weights.items():
                check_name("reward term", name, TERMS)
                check_number(f"weight of term {name!r} of the {agent}", weight)
            # Copies, which the caller does not change; numbers of NumPy cannot multiply tensors on a GPU.
            object.__setattr__(self, agent, {name: float(weight) for name, weight in weights.items()})
        check_number("gamma of RewardWeights", self.gamma, limits=(0.0, 1.0))
        object.__setattr__(self, "gamma", float(self.gamma))


#: Reward 1 to both agents in the step that completes the handover.
SPARSE = RewardWeights({"success": 1.0}, {"success": 1.0})
#: Success, contact and drop for both agents, shaping for the receiver, and costs of motion and waiting for the giver.
#: The receiver's reward for success outweighs the potentials that it loses at the end of the episode.
SHAPED = RewardWeights(
    {"success": 3.0, "distance": 0.5, "grasp": 0.5, "goal": 0.5, "contact": -0.5, "drop": -0.5},
    {"success": 1.0, "effort": -0.05, "discomfort": -0.02, "waiting": -0.02, "contact": -0.5, "drop": -0.5},
)
REWARDS = {"sparse": SPARSE, "shaped": SHAPED}


@dataclass(frozen=True, eq=False)
class StepData:
    """Data of r episodes after a control step; rewards call the functions only if they need the data.

    Attributes:
        status: Bits (r,) of `EpisodeStatus`.
        read_state: Function that returns arrays (r, ...) by key: the full state; the giver's `deviation` and `holding`;
            `grasped` (r,), whether both fingers of the robot touch the object; and, if its argument is True,
            `robot_object_force` and `robot_hand_force` (r,), sums of the robot's normal forces (N).
        read_transitions: Function that returns the r transitions.
    """

    status: AnyArray
    read_state: Callable[[bool], Mapping[str, AnyArray]]
    read_transitions: Callable[[], Sequence[Transition]]


class WeightedRewardSource:
    """Reward terms of the library (`TERMS`) in `count` episodes, each multiplied by its weight.

    `goal` (3,) is the position to which the gripper must bring the object, world frame (m).
    """

    def __init__(self, weights: RewardWeights, goal: tuple[float, ...], count: int, arrays: ArrayFactory) -> None:
        self._weights: dict[str, Mapping[str, float]] = {agent: dict(getattr(weights, agent)) for agent in AGENTS}
        self._names = {name for own in self._weights.values() for name in own}
        self._needs_state, self._needs_forces = bool(self._names - _OUTCOMES), bool(self._names & _FORCES)
        self._xp, self._goal, self._gamma = arrays.xp, arrays.asarray(goal, "float64"), weights.gamma
        self._states = arrays.full((count, _COUNT, _SIZE), math.nan)

    def start(self, rows: AnyIndices, step: StepData) -> TermNames:
        """Start the episodes `rows`; return the names of the terms by agent, see `RewardSource.start`."""
        if self._needs_state:
            self._states[rows] = math.nan
            self._states[rows, -1] = self._summarize(step.read_state(self._needs_forces))
        return self._weights

    def compute(self, rows: AnyIndices, step: StepData) -> dict[str, ArrayTerms]:
        """Return the weighted values (r,) of the terms by agent and name; see `RewardSource.compute`."""
        states, state = self._states[rows], step.read_state(self._needs_forces) if self._needs_state else {}
        if self._needs_state:
            states = self._xp.concat([states[:, 1:], self._summarize(state)[:, None]], axis=1)
            self._states[rows] = states
        steps = StepBatch(states, state, step.status, self._goal, self._gamma)
        values = {name: TERMS[name](steps) for name in self._names}
        return {agent: {name: own[name] * values[name] for name in own} for agent, own in self._weights.items()}

    def _summarize(self, state: Mapping[str, AnyArray]) -> AnyArray:
        """Convert a state, as `StepData.read_state` returns it, to the form (r, 19) of `StepBatch.states`, float64."""
        xp = self._xp
        columns = [
            state["time"],
            state["gripper_pose"],
            state["object_poses"][:, 0, :3],
            state["grasped"][:, None],
            xp.where(state["hand_present"] != 0.0, state["hand_keypoints"][:, 0], math.nan),
            state["deviation"][:, 1:4],
            (state["holding"] > 0) & (state["released"] <= 0),
        ]
        return xp.concat([xp.astype(column, xp.float64) for column in columns], axis=1)
