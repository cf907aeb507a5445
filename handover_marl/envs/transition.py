"""Transition of the environment: everything about one control step that user-defined rewards may use."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.envs.agents import GIVER, RECEIVER
from handover_marl.episode.observations import Observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.simulation.world import Contacts

Observations = Mapping[str, Observation]
_NO_CONTACTS = Contacts()


@dataclass(frozen=True, eq=False)
class Transition:
    """One control step: observations before it, actions, observations after it.

    World frame; m, rad, s, N; quaternions xyzw. Observations and actions are read-only copies of those of the
    innermost environment, without the changes by wrappers, features and action schemes.

    Attributes:
        observations: Observation before the step, by agent ("giver", "receiver"); elements of the observation spaces.
            The receiver's observation depends on `obs_mode`, the giver's always contains the full state.
        next_observations: Observation after the step, by agent.
        actions: Action by agent at the start of the step: giver (8,), clipped to its bounds; receiver (9,)
            target joint positions (rad, m); float32. A fixed partner may act again within the step.
        infos: Infos after the step by agent, without reward terms: `scene_id`, `status`, `steps` (physics steps of
            1 ms), `release_step` and `release_reason`; for a receiver with cameras also their matrices.
        contacts: Contacts of robot, object and human hand in the last physics step (1 ms) of the step; forces in N.
        status: Status of the episode after the step, e.g. `EpisodeStatus.SUCCESS`; `RUNNING` (no bit) until its end.
        duration: Simulated time of the step (s): the control period, or less in the last step of an episode.
        step: Number of the control step in the episode; 0 for the first.
        terminated: Whether the episode has ended by success, contact or drop.
        truncated: Whether the episode was cut off by the time limit or `max_cycles`.
    """

    observations: Observations
    next_observations: Observations
    actions: Mapping[str, npt.NDArray[np.float32]]
    infos: Mapping[str, Mapping[str, float]]
    duration: float
    contacts: Contacts = _NO_CONTACTS
    status: EpisodeStatus = EpisodeStatus.RUNNING
    step: int = 0
    terminated: bool = False
    truncated: bool = False

    @property
    def state(self) -> Observation:
        """Giver's observation before the step; it contains the full state in every observation mode."""
        return self.observations[GIVER]

    @property
    def next_state(self) -> Observation:
        """Giver's observation after the step; it contains the full state in every observation mode."""
        return self.next_observations[GIVER]

    @property
    def is_success(self) -> bool:
        """Whether this step completed the handover."""
        return bool(self.status & EpisodeStatus.SUCCESS)


class TransitionRecorder:
    """Recorder that makes the transition of each control step from the observations before and after it.

    `control_period` is the time for which an action holds (s).
    """

    def __init__(self, control_period: float) -> None:
        self._control_period = control_period
        self._last: Observations = {}
        self._step = 0

    def start(self, observations: Observations, infos: Mapping[str, Mapping[str, float]]) -> Transition:
        """Start an episode with its first observations and infos by agent; return a transition that changes nothing.

        The transition lasts one control period, replays the recording and keeps the robot's joint positions.
        """
        start = self._last = {agent: copy_read_only(own) for agent, own in observations.items()}
        self._step = 0
        joints = start[RECEIVER]["robot_joint_position"].astype(np.float32)
        actions = copy_read_only({GIVER: np.zeros(8, dtype=np.float32), RECEIVER: joints})
        return Transition(start, start, actions, infos, self._control_period)

    def record(
        self, observations: Observations, actions: Mapping[str, npt.NDArray[np.float32]], **outcome: Any
    ) -> Transition:
        """Return the transition of a control step and keep its observations for the next one.

        `observations` and `actions` are by agent, and the observations are those after the step. `outcome` has the
        fields `infos`, `contacts`, `status`, `terminated` and `truncated` of the transition.
        """
        before, after = self._last, {agent: copy_read_only(own) for agent, own in observations.items()}
        duration = float(after[GIVER]["time"][0]) - float(before[GIVER]["time"][0])
        step, self._last, self._step = self._step, after, self._step + 1
        return Transition(before, after, copy_read_only(actions), duration=round(duration, 3), step=step, **outcome)


def copy_read_only(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return read-only copies of the arrays in a dictionary, by the same keys."""
    copies = {key: value.copy() for key, value in arrays.items()}
    for value in copies.values():
        value.setflags(write=False)
    return copies
