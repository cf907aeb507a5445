"""HandoverSim's rules of release and status (Chao et al., ICRA 2022, Sec. IV-B, C), for one episode and for many.

`Referee` judges one episode after each step; `judge_steps` applies the same rules to many steps of many episodes.
"""

import math
from enum import Enum, IntFlag
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.arrays import AnyArray, AnyIndices, get_namespace, is_tensor, make_constant
from handover_marl.simulation.world import (
    Contacts,
    JudgeFunction,
    RolloutContacts,
    RolloutEnd,
    find_points_in_grasp_region,
)

Counts = npt.NDArray[np.int_]


class ReleaseReason(Enum):
    """Reason why the person released the object.

    ACTIVE: both fingers touched the object inside their grasp regions for 0.1 s.
    PASSIVE: the robot touched the object for 0.1 s, with no finger inside its grasp region.
    VOLUNTARY: the giver's action requested the release. HandoverSim has no such release.
    """

    ACTIVE = "active"
    PASSIVE = "passive"
    VOLUNTARY = "voluntary"


#: Reasons by their number in infos and referee states; -1 is no release.
RELEASE_REASONS = tuple(ReleaseReason)
_ACTIVE, _PASSIVE = RELEASE_REASONS.index(ReleaseReason.ACTIVE), RELEASE_REASONS.index(ReleaseReason.PASSIVE)


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
        """Return the states of some of n episodes; `rows` (r,) are their indices."""
        return RefereeState(*(array[rows] for array in self))

    def assign_rows(self, rows: AnyIndices, states: "RefereeState") -> None:
        """Set the states of the episodes with the indices `rows` (r,) to `states`."""
        for array, values in zip(self, states, strict=True):
            array[rows] = values


class Referee:
    """Referee of one episode: applies the rules of release and status after each physics step.

    Args:
        config: Thresholds of the protocol's rules.

    Attributes:
        status: Status after the last step; any status but RUNNING ends the episode.
        steps: Number of physics steps since the start of the episode.
        release_reason: Reason why the person released the object; None before a release.
        release_step: Physics step (from 1) of the release, or the step after which a voluntary
            release took effect; None before a release.
        released: Whether the person has released the object. The rules of the status count the object as released
            from the step of the release on, the simulation from the next step on.
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
        """Record that the giver releases the object before the next physics step; do nothing after a release."""
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
        """Restore a state of one episode, as `get_state` returns it."""
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


def make_judge(referees: RefereeState, rules: ProtocolConfig) -> JudgeFunction:
    """Return a function that applies the rules of release and status to the contacts of a rollout (`JudgeFunction`).

    Args:
        referees: Referee states of the n episodes in the rollout; the function updates these arrays.
        rules: Thresholds of the protocol's rules.
    """

    def judge(rows: AnyIndices, contacts: RolloutContacts) -> RolloutEnd:
        before = referees.select_rows(rows)
        last, after = judge_steps(before, contacts, rules)
        taken, released = last + 1, (after.release_reason >= 0) & (before.release_reason < 0)
        if is_tensor(last):
            # Worlds on a device are simulated further after their episodes have ended; these steps do not count.
            xp, running = get_namespace(last), before.status == 0
            taken, released = xp.where(running, taken, 0), running & released
            after = RefereeState(*(xp.where(running, new, old) for new, old in zip(after, before, strict=True)))
        referees.assign_rows(rows, after)
        return RolloutEnd(taken, released, after.status != 0)

    return judge


def judge_steps(
    before: RefereeState, contacts: RolloutContacts, config: ProtocolConfig
) -> tuple[AnyArray, RefereeState]:
    """Apply the rules of release and status to k steps of n episodes, in each one up to a release or its end.

    The states are the same as those of `Referee.update` called after every step.

    Args:
        before: Referee states before these steps, arrays or tensors; results are valid for running episodes only.
        contacts: Contacts of the k steps; those after the first release or the end of an episode are ignored.
        config: Thresholds of the protocol's rules.

    Returns:
        Indices (n,), 0 to k - 1, of the last step that was applied in each episode, and the states after this step.
    """
    xp = get_namespace(before.steps)
    n_steps = len(contacts.robot_touches_hand)
    # Reading tensors of a GPU takes more time than the rules.
    if not is_tensor(before.steps) and _is_uneventful(before, contacts):
        return _judge_time_limit(before, n_steps, config)
    indices = xp.cumsum(xp.ones_like(contacts.robot_touches_hand, dtype=xp.int64), axis=0) - 1
    left, right = contacts.in_grasp_region[..., 0], contacts.in_grasp_region[..., 1]
    active = _count_consecutive(contacts.robot_touches_object & left & right, before.active_steps)
    passive = _count_consecutive(contacts.robot_touches_object & ~(left | right), before.passive_steps)
    held = before.release_reason < 0
    releases = held & ((active >= config.release_steps) | (passive >= config.release_steps))
    released = ~held | (xp.cumsum(xp.astype(releases, xp.int64), axis=0) > 0)
    both = xp.all(contacts.fingers_touch, axis=-1)
    dropped = released & ~both & (contacts.object_supported | (contacts.object_height < config.drop_height))
    fails = contacts.robot_touches_hand | dropped
    away = contacts.gripper_position - make_constant(config.goal_center, contacts.gripper_position)
    near = xp.sqrt(xp.sum(away**2, axis=-1)) < config.goal_radius
    goal = _count_consecutive(released & ~fails & near & both, before.goal_steps)
    succeeds = goal >= config.success_steps
    late = before.steps + indices + 1 >= config.horizon_steps
    stops = xp.astype(releases | fails | succeeds | late, xp.int64)
    last = xp.where(xp.any(stops, axis=0), xp.argmax(stops, axis=0), n_steps - 1)
    now = (last, xp.cumsum(xp.ones_like(last), axis=0) - 1)
    status = (
        int(EpisodeStatus.HUMAN_CONTACT) * contacts.robot_touches_hand[now]
        + int(EpisodeStatus.OBJECT_DROP) * dropped[now]
        + int(EpisodeStatus.TIMEOUT) * late[now]
    )
    steps = before.steps + last + 1
    reason = xp.where(active[now] >= config.release_steps, _ACTIVE, _PASSIVE)
    return last, RefereeState(
        status=xp.where(succeeds[now], int(EpisodeStatus.SUCCESS), status),
        steps=steps,
        release_reason=xp.where(releases[now], reason, before.release_reason),
        release_step=xp.where(releases[now], steps, before.release_step),
        active_steps=xp.where(held, active[now], before.active_steps),
        passive_steps=xp.where(held, passive[now], before.passive_steps),
        goal_steps=goal[now],
    )


def _is_uneventful(before: RefereeState, contacts: RolloutContacts) -> bool:
    """Return whether only the time limit can end episodes: no release so far, and no contacts of the robot."""
    return not (
        (before.release_reason >= 0).any() or contacts.robot_touches_object.any() or contacts.robot_touches_hand.any()
    )


def _judge_time_limit(before: RefereeState, n_steps: int, config: ProtocolConfig) -> tuple[Counts, RefereeState]:
    """Apply the time limit alone to `n_steps` steps; arguments and result as in `judge_steps`."""
    last = np.clip(config.horizon_steps - before.steps - 1, 0, n_steps - 1)
    steps, none = before.steps + last + 1, np.zeros_like(last)
    return last, before._replace(
        status=int(EpisodeStatus.TIMEOUT) * (steps >= config.horizon_steps),
        steps=steps,
        active_steps=none,
        passive_steps=none,
        goal_steps=none,
    )


def _count_consecutive(condition: AnyArray, before: AnyArray) -> AnyArray:
    """Count, after each step, for how many consecutive steps a condition has held.

    Args:
        condition: Truth value (k, n) of the condition in k steps of n episodes.
        before: Count (n,) before the first step.

    Returns:
        Counts (k, n).
    """
    xp = get_namespace(condition)
    number = xp.cumsum(xp.ones_like(condition, dtype=xp.int64), axis=0) - 1
    missed = xp.where(condition, -1, number)
    missed = xp.cummax(missed, 0).values if is_tensor(missed) else np.maximum.accumulate(missed, axis=0)
    return xp.where(missed < 0, before + number + 1, number - missed)
