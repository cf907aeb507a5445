"""Preset rewards of both agents: named terms, weighted by a frozen configuration and summed.

The default is a sparse reward: 1 to both agents in the step that completes the handover. `SHAPED`
adds potential-based shaping for the receiver and costs for the giver. A shaping term (Ng et al.,
"Policy invariance under reward transformations", ICML 1999) is gamma times the potential after a
step minus the potential before it; the potential is 0 once the episode has terminated. The
discounted sum of a shaping term over an episode depends only on the first state, so that shaping
does not change the optimal policy.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from handover_marl.config import CheckedConfig, bounded
from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, check_name
from handover_marl.geometry.arrays import AnyArray, AnyIndices, ArrayFactory
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import compute_lengths, transform_points

Terms = dict[str, float]
#: Values (r,) of terms by name.
ArrayTerms: TypeAlias = dict[str, AnyArray]

# Terms with the value 1 in the step in which the status has a bit.
_OUTCOMES = {
    "task": EpisodeStatus.SUCCESS,
    "contact": EpisodeStatus.HUMAN_CONTACT,
    "drop": EpisodeStatus.OBJECT_DROP,
}
# Columns of the stored states: time (s), wrist displacement (m) and rotation (rad), whether the object is offered, and
# potentials of the shaping terms.
_TIME, _DISPLACEMENT, _ROTATION, _OFFERED, _POTENTIALS, _SIZE = 0, slice(1, 4), slice(4, 7), 7, slice(8, 11), 11


@dataclass(frozen=True)
class ReceiverWeights(CheckedConfig):
    """Weights of the receiver's reward terms.

    Attributes:
        task: Weight of the reward 1 in the step that completes the handover.
        distance: Weight of shaping with the potential 1 minus the distance (m) between the center
            of the fingertips and the object's origin; the potential is 1 while the object is grasped.
        grasp: Weight of shaping with the potential 1 while both fingers touch the object, else 0.
        goal: Weight of shaping with the potential 1 minus the distance (m) between hand link and
            goal while the object is grasped, else 0.
        contact: Weight of the value 1 in the step in which the robot touches the person.
        drop: Weight of the value 1 in the step in which the object is dropped.
    """

    task: float = 1.0
    distance: float = 0.0
    grasp: float = 0.0
    goal: float = 0.0
    contact: float = 0.0
    drop: float = 0.0


@dataclass(frozen=True)
class GiverWeights(CheckedConfig):
    """Weights of the giver's reward terms.

    Attributes:
        task: Weight of the reward 1 in the step that completes the handover.
        effort: Weight of the squared speed at which the wrist's displacement from the recording
            changes, integrated over time (m^2/s).
        discomfort: Weight of the wrist's offset from the recording, integrated over time; the offset
            is the displacement (m) plus a third of the rotation (rad).
        waiting: Weight of the time (s) for which the object is held out and not yet taken.
        contact: Weight of the value 1 in the step in which the robot touches the person.
        drop: Weight of the value 1 in the step in which the object is dropped.
    """

    task: float = 1.0
    effort: float = 0.0
    discomfort: float = 0.0
    waiting: float = 0.0
    contact: float = 0.0
    drop: float = 0.0


@dataclass(frozen=True)
class RewardConfig(CheckedConfig):
    """Weights of the terms of both agents' preset rewards.

    Attributes:
        receiver: Weights of the receiver's terms.
        giver: Weights of the giver's terms.
        gamma: Discount factor of the shaping terms; should equal the learner's discount factor.
    """

    receiver: ReceiverWeights = field(default_factory=ReceiverWeights)
    giver: GiverWeights = field(default_factory=GiverWeights)
    gamma: float = bounded(0.99, 0.0, 1.0)


SPARSE = RewardConfig()
SHAPED = RewardConfig(
    # The task outweighs the potentials that are lost at the end of the episode.
    receiver=ReceiverWeights(task=3.0, distance=0.5, grasp=0.5, goal=0.5, contact=-0.5, drop=-0.5),
    giver=GiverWeights(effort=-0.05, discomfort=-0.02, waiting=-0.02, contact=-0.5, drop=-0.5),
)
REWARDS = {"sparse": SPARSE, "shaped": SHAPED}


def make_reward_config(rewards: str | RewardConfig) -> RewardConfig:
    """Return the reward configuration with a name; return a `RewardConfig` unchanged.

    Raises:
        UnknownNameError: There is no reward of that name.
        OptionError: `rewards` is neither a name nor a configuration.
    """
    if isinstance(rewards, RewardConfig):
        return rewards
    if not isinstance(rewards, str):
        raise OptionError(f"rewards must be one of {', '.join(REWARDS)} or a RewardConfig, got {rewards!r}")
    check_name("rewards", rewards, REWARDS)
    return REWARDS[rewards]


class PresetRewards:
    """Weighted terms of the preset rewards of both agents in n episodes, on arrays with the episode as first axis.

    The argument `state` of methods has arrays (r, ...): `time`, `gripper_pose`, `object_poses`, `deviation`, `holding`
    and `released` of the giver's observation, and `grasped` (r,), whether both fingers of the robot touch the object.

    Args:
        config: Weights of the terms.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
        count: Number n of episodes.
        arrays: Creator of the arrays.

    Attributes:
        needs_state: Whether a term with a weight depends on the state; if not, `state` may be empty.
    """

    def __init__(self, config: RewardConfig, goal: tuple[float, ...], count: int, arrays: ArrayFactory) -> None:
        self._config, self._arrays = config, arrays
        self._goal, self._fingertips = (arrays.asarray(point, "float64") for point in (goal, FINGERTIPS))
        self._weights = {GIVER: vars(config.giver), RECEIVER: vars(config.receiver)}
        weights = [item for own in self._weights.values() for item in own.items()]
        self.needs_state = any(weight for name, weight in weights if name not in _OUTCOMES)
        self._last = arrays.zeros((count, _SIZE))

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of the terms by agent."""
        return {agent: tuple(weights) for agent, weights in self._weights.items()}

    def start(self, rows: AnyIndices, state: Mapping[str, AnyArray]) -> None:
        """Start episodes `rows` (r,) in a state."""
        if self.needs_state:
            self._last[rows] = self._summarize(state)

    def compute_terms(self, rows: AnyIndices, status: AnyArray, state: Mapping[str, AnyArray]) -> dict[str, ArrayTerms]:
        """Return the weighted reward terms of a control step by agent, and store the states after it.

        Args:
            rows: Indices (r,) of the episodes.
            status: Bits (r,) of `EpisodeStatus` after the step.
            state: State after the step.
        """
        xp = self._arrays.xp
        values = {name: xp.astype((status & int(bit)) != 0, xp.float64) for name, bit in _OUTCOMES.items()}
        if self.needs_state:
            now, before = self._summarize(state), self._last[rows]
            self._last[rows] = now
            values |= self._compute_giver_costs(before, now) | self._compute_shaping(before, now, status)
        zeros = xp.zeros_like(values["task"])
        return {
            agent: {name: weight * values.get(name, zeros) for name, weight in weights.items()}
            for agent, weights in self._weights.items()
        }

    def _compute_giver_costs(self, before: AnyArray, now: AnyArray) -> ArrayTerms:
        xp, change = self._arrays.xp, now - before
        period, path = change[:, _TIME], compute_lengths(change[:, _DISPLACEMENT])
        offset = compute_lengths(now[:, _DISPLACEMENT]) + compute_lengths(now[:, _ROTATION]) / 3.0
        is_later = period > 0.0
        return {
            "effort": xp.where(is_later, path**2 / xp.where(is_later, period, 1.0), 0.0),
            "discomfort": offset * period,
            "waiting": before[:, _OFFERED] * period,
        }

    def _compute_shaping(self, before: AnyArray, now: AnyArray, status: AnyArray) -> ArrayTerms:
        # A timeout truncates an episode; only termination ends its potential.
        goes_on = (status & ~int(EpisodeStatus.TIMEOUT)) == 0
        new = self._arrays.xp.where(goes_on[:, None], now[:, _POTENTIALS], 0.0)
        shaping = self._config.gamma * new - before[:, _POTENTIALS]
        return {"distance": shaping[:, 0], "grasp": shaping[:, 1], "goal": shaping[:, 2]}

    def _summarize(self, state: Mapping[str, AnyArray]) -> AnyArray:
        """Return what the terms depend on, (r, 11) float64."""
        xp, gripper, grasped = self._arrays.xp, state["gripper_pose"], state["grasped"]
        to_object = transform_points(gripper, self._fingertips) - state["object_poses"][:, 0, :3]
        columns = [
            state["time"],
            state["deviation"][:, 1:],
            xp.astype((state["holding"] > 0) & (state["released"] <= 0), xp.float64),
            xp.where(grasped, 1.0, 1.0 - compute_lengths(to_object))[:, None],
            grasped[:, None],
            xp.where(grasped, 1.0 - compute_lengths(gripper[:, :3] - self._goal), 0.0)[:, None],
        ]
        return xp.concat([xp.astype(column, xp.float64) for column in columns], axis=1)
