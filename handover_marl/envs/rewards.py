"""Preset rewards of both agents: named terms, weighted by a frozen configuration and summed.

The default is a sparse reward: 1 to both agents in the step that completes the handover. `SHAPED`
adds potential-based shaping for the receiver and costs for the giver. A shaping term (Ng et al.,
"Policy invariance under reward transformations", ICML 1999) is gamma times the potential after a
step minus the potential before it; the potential is 0 once the episode has terminated. The
discounted sum of a shaping term over an episode depends only on the first state, so that shaping
does not change the optimal policy.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import CheckedConfig, Limits
from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResetNeededError, check_name
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import transform_points

Terms = dict[str, float]

# Terms that depend only on the status of the episode.
_OUTCOME_TERMS = ("task", "contact", "drop")


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

    limits: ClassVar[Limits] = {"gamma": (0.0, 1.0)}

    receiver: ReceiverWeights = field(default_factory=ReceiverWeights)
    giver: GiverWeights = field(default_factory=GiverWeights)
    gamma: float = 0.99


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


@dataclass(frozen=True)
class RewardState:
    """Part of the simulation's state that the reward terms depend on; world frame.

    Attributes:
        time: Time since the start of the episode (s).
        gripper: (3,) position of the Panda's hand link (m).
        fingertip_center: (3,) midpoint of the fingertips (m).
        object_position: (3,) position of the object's origin (m).
        grasped: Whether both fingers of the robot touch the object.
        deviation: (6,) wrist displacement (m) and rotation vector (rad) of the giver.
        object_offered: Whether the person holds the object, picked up and not released.
    """

    time: float
    gripper: tuple[float, ...]
    fingertip_center: tuple[float, ...]
    object_position: tuple[float, ...]
    grasped: bool
    deviation: tuple[float, ...]
    object_offered: bool


def make_reward_state(state: Mapping[str, npt.NDArray[np.floating]], grasped: bool) -> RewardState:
    """Make the part of an episode's state that the reward terms depend on.

    Args:
        state: `time`, `gripper_pose`, `object_poses`, `deviation`, `holding` and `released` of the giver's observation.
        grasped: Whether both fingers of the robot touch the object.
    """
    gripper = state["gripper_pose"]
    return RewardState(
        time=float(state["time"][0]),
        gripper=tuple(gripper[:3].tolist()),
        fingertip_center=tuple(transform_points(gripper, FINGERTIPS).tolist()),
        object_position=tuple(state["object_poses"][0, :3].tolist()),
        grasped=grasped,
        deviation=tuple(state["deviation"][1:].tolist()),
        object_offered=bool(state["holding"][0]) and not bool(state["released"][0]),
    )


class RewardFunction:
    """Reward function of both agents: weighted terms of each control step.

    Args:
        config: Weights of the terms.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
    """

    def __init__(self, config: RewardConfig, goal: tuple[float, ...]) -> None:
        self._config, self._goal = config, goal
        self._last: RewardState | None = None
        weights = [*vars(config.receiver).items(), *vars(config.giver).items()]
        self._only_outcomes = not any(weight for name, weight in weights if name not in _OUTCOME_TERMS)

    def reset(self, state: RewardState) -> dict[str, Terms]:
        """Start an episode in a state; return the reward terms, all 0, by agent."""
        self._last = state
        return {
            GIVER: dict.fromkeys(vars(self._config.giver), 0.0),
            RECEIVER: dict.fromkeys(vars(self._config.receiver), 0.0),
        }

    def compute_terms(self, status: EpisodeStatus, read_state: Callable[[], RewardState]) -> dict[str, Terms]:
        """Return the weighted reward terms of a control step by agent, and store the state after it.

        The shaping terms of the next step are computed from the stored state.

        Args:
            status: Status of the episode after the step.
            read_state: Function that returns the simulation's state after the step; not called if
                no term with a weight depends on the state.

        Raises:
            ResetNeededError: No episode has been started.
        """
        if self._last is None:
            raise ResetNeededError("no episode is running; call reset() before step()")
        giver, receiver = self._config.giver, self._config.receiver
        outcome = _compute_outcome_terms(status)
        if self._only_outcomes:
            return {
                agent: _weigh(weights, {**dict.fromkeys(vars(weights), 0.0), **outcome})
                for agent, weights in ((GIVER, giver), (RECEIVER, receiver))
            }
        before, now = self._last, read_state()
        self._last = now
        return {
            GIVER: _weigh(giver, {**_compute_giver_costs(before, now), **outcome}),
            RECEIVER: _weigh(receiver, {**self._compute_guidance(before, now, status), **outcome}),
        }

    def _compute_guidance(self, before: RewardState, now: RewardState, status: EpisodeStatus) -> Terms:
        old, new = compute_potentials(before, self._goal), compute_potentials(now, self._goal)
        # A timeout truncates an episode; only termination ends its potential.
        if status & ~EpisodeStatus.TIMEOUT:
            new = dict.fromkeys(new, 0.0)
        return {name: self._config.gamma * new[name] - old[name] for name in old}


def compute_potentials(state: RewardState, goal: tuple[float, ...]) -> Terms:
    """Return the potential of each shaping term in a state, by the name of the term.

    Args:
        state: State of the simulation.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
    """
    return {
        "distance": 1.0 if state.grasped else 1.0 - math.dist(state.fingertip_center, state.object_position),
        "grasp": float(state.grasped),
        "goal": 1.0 - math.dist(state.gripper, goal) if state.grasped else 0.0,
    }


def _compute_giver_costs(before: RewardState, now: RewardState) -> Terms:
    period = now.time - before.time
    path = math.dist(now.deviation[:3], before.deviation[:3])
    offset = math.hypot(*now.deviation[:3]) + math.hypot(*now.deviation[3:]) / 3.0
    return {
        "effort": path**2 / period if period > 0.0 else 0.0,
        "discomfort": offset * period,
        "waiting": period if before.object_offered else 0.0,
    }


@functools.cache
def _compute_outcome_terms(status: EpisodeStatus) -> Mapping[str, float]:
    return {
        "task": float(bool(status & EpisodeStatus.SUCCESS)),
        "contact": float(bool(status & EpisodeStatus.HUMAN_CONTACT)),
        "drop": float(bool(status & EpisodeStatus.OBJECT_DROP)),
    }


def _weigh(weights: ReceiverWeights | GiverWeights, values: Mapping[str, float]) -> Terms:
    return {name: weight * values[name] for name, weight in vars(weights).items()}
