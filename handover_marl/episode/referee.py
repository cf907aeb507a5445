"""Referee with HandoverSim's rules of release and status (Chao et al., ICRA 2022, Sec. IV-B, C)."""

import math
from enum import Enum, IntFlag
from typing import NamedTuple

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.arrays import AnyArray, AnyIndices
from handover_marl.simulation.contacts import Contacts, find_points_in_grasp_region


class ReleaseReason(Enum):
    """Reason why the person released the object.

    ACTIVE: both fingers touched the object inside their grasp regions for 0.1 s.
    PASSIVE: the robot pushed the object for 0.1 s with neither finger's grasp region on it.
    VOLUNTARY: the giver's action requested the release, which HandoverSim does not have.
    """

    ACTIVE = "active"
    PASSIVE = "passive"
    VOLUNTARY = "voluntary"


#: Reasons by number, as infos and referee states contain them; -1 is no release.
RELEASE_REASONS = tuple(ReleaseReason)


class EpisodeStatus(IntFlag):
    """Official status of an episode as bits; an episode can fail in several ways at once."""

    RUNNING = 0
    SUCCESS = 1
    HUMAN_CONTACT = 2
    OBJECT_DROP = 4
    TIMEOUT = 8

    @property
    def label(self) -> str:
        """Name of the status, e.g. `contact+drop`."""
        words = {1: "success", 2: "contact", 4: "drop", 8: "timeout"}
        return "+".join(word for bit, word in words.items() if self & bit) or "running"


class RefereeState(NamedTuple):
    """State of the referee of an episode as integers, or of n episodes as arrays or tensors (n,).

    Attributes:
        status: Bits of the `EpisodeStatus`.
        steps: Number of physics steps since the start of the episode.
        release_reason: Reason why the person released the object, an index into `RELEASE_REASONS`; -1
            before a release.
        release_step: Physics step of the release; -1 before a release.
        active_steps: Consecutive steps in which the condition of `ReleaseReason.ACTIVE` has held.
        passive_steps: Consecutive steps in which the condition of `ReleaseReason.PASSIVE` has held.
        goal_steps: Consecutive steps for which the gripper has held the object at the goal.
    """

    status: AnyArray
    steps: AnyArray
    release_reason: AnyArray
    release_step: AnyArray
    active_steps: AnyArray
    passive_steps: AnyArray
    goal_steps: AnyArray

    def select_rows(self, rows: AnyIndices) -> "RefereeState":
        """Return the states of the episodes with these indices."""
        return RefereeState(*(array[rows] for array in self))

    def assign_rows(self, rows: AnyIndices, states: "RefereeState") -> None:
        """Set the states of the episodes with these indices."""
        for array, values in zip(self, states, strict=True):
            array[rows] = values


class Referee:
    """Referee of one episode: applies the rules of release and status after each physics step.

    Attributes:
        status: Status after the last step; any status but RUNNING ends the episode.
        steps: Number of physics steps since the start of the episode.
        release_reason: Reason why the person released the object; None before a release.
        release_step: Physics step (from 1) of the release, or the step after which a voluntary
            release took effect; None before a release.
        released: Whether the person has released the object. Status rules use it in the same step, the
            simulation from the next step on.
    """

    def __init__(self, config: ProtocolConfig) -> None:
        self.status = EpisodeStatus.RUNNING
        self.steps = 0
        self.release_reason: ReleaseReason | None = None
        self.release_step: int | None = None
        self.released = False
        self._config = config
        # Consecutive steps in which the condition of an active or a passive release, or of success, has held.
        self._active_steps = self._passive_steps = self._goal_steps = 0

    def release_voluntarily(self) -> None:
        """Release the object before the next step, by the giver's choice, if still held."""
        if not self.released:
            self.release_reason, self.release_step, self.released = ReleaseReason.VOLUNTARY, self.steps, True

    def update(self, contacts: Contacts) -> EpisodeStatus:
        """Update status and release with the contacts of a physics step; return the status."""
        self.steps += 1
        if not self.released:
            self.release_reason = self._judge_release(contacts)
            if self.release_reason is not None:
                self.release_step, self.released = self.steps, True
        self.status = self._judge_status(contacts)
        return self.status

    def get_state(self) -> RefereeState:
        """Return the referee's state as integers."""
        return RefereeState(
            status=int(self.status),
            steps=self.steps,
            release_reason=-1 if self.release_reason is None else RELEASE_REASONS.index(self.release_reason),
            release_step=-1 if self.release_step is None else self.release_step,
            active_steps=self._active_steps,
            passive_steps=self._passive_steps,
            goal_steps=self._goal_steps,
        )

    def restore(self, state: RefereeState) -> None:
        """Restore a state of one episode."""
        status, self.steps, reason, release_step, *counts = map(int, state)
        self.status, self.released = EpisodeStatus(status), reason >= 0
        self.release_reason = RELEASE_REASONS[reason] if self.released else None
        self.release_step = release_step if self.released else None
        self._active_steps, self._passive_steps, self._goal_steps = counts

    def _judge_release(self, contacts: Contacts) -> ReleaseReason | None:
        if not contacts.robot_touches_object:
            self._active_steps = self._passive_steps = 0
            return None
        left, right = (find_points_in_grasp_region(points, self._config).any() for points in contacts.finger_points)
        self._active_steps = self._active_steps + 1 if left and right else 0
        self._passive_steps = self._passive_steps + 1 if not (left or right) else 0
        if self._active_steps >= self._config.release_steps:
            return ReleaseReason.ACTIVE
        return ReleaseReason.PASSIVE if self._passive_steps >= self._config.release_steps else None

    def _judge_status(self, contacts: Contacts) -> EpisodeStatus:
        status = EpisodeStatus.HUMAN_CONTACT if contacts.robot_touches_hand else EpisodeStatus.RUNNING
        if self.released:
            if self._has_dropped(contacts):
                status |= EpisodeStatus.OBJECT_DROP
            if not status and self._is_held_at_goal(contacts):
                return EpisodeStatus.SUCCESS
        if self.steps >= self._config.horizon_steps:
            status |= EpisodeStatus.TIMEOUT
        return status

    def _has_dropped(self, contacts: Contacts) -> bool:
        is_low = contacts.object_height < self._config.drop_height
        return not contacts.both_fingers_touch and (contacts.object_supported or is_low)

    def _is_held_at_goal(self, contacts: Contacts) -> bool:
        is_near = math.dist(contacts.gripper_position, self._config.goal_center) < self._config.goal_radius
        self._goal_steps = self._goal_steps + 1 if is_near and contacts.both_fingers_touch else 0
        return self._goal_steps >= self._config.success_steps
