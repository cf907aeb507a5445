"""Rules of release and end for many episodes in lockstep, on arrays."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.episode.referee import RELEASE_REASONS, EpisodeStatus, RefereeState, ReleaseReason
from handover_marl.geometry.arrays import AnyArray, AnyIndices, get_namespace, is_tensor, make_constant
from handover_marl.simulation.contacts import ContactBatch, JudgeFunction, RolloutEnd

Counts = npt.NDArray[np.int_]

_ACTIVE, _PASSIVE = RELEASE_REASONS.index(ReleaseReason.ACTIVE), RELEASE_REASONS.index(ReleaseReason.PASSIVE)


def make_judge(referees: RefereeState, rules: ProtocolConfig) -> JudgeFunction:
    """Return the function by which worlds in a rollout apply the rules of release and end to their steps.

    Args:
        referees: Referee states of the n episodes in the rollout, which the function updates.
        rules: Rules of release and end.
    """

    def judge(rows: AnyIndices, contacts: ContactBatch) -> RolloutEnd:
        before = referees.select_rows(rows)
        last, after = judge_steps(before, contacts, rules)
        taken, released = last + 1, (after.release_reason >= 0) & (before.release_reason < 0)
        if is_tensor(last):
            # Worlds on a device are simulated after their ends, too.
            xp, running = get_namespace(last), before.status == 0
            taken, released = xp.where(running, taken, 0), running & released
            after = RefereeState(*(xp.where(running, new, old) for new, old in zip(after, before, strict=True)))
        referees.assign_rows(rows, after)
        return RolloutEnd(taken, released, after.status != 0)

    return judge


def judge_steps(before: RefereeState, contacts: ContactBatch, config: ProtocolConfig) -> tuple[AnyArray, RefereeState]:
    """Apply release and end rules to k steps of n episodes, up to the first release or end of each.

    The states are the same as with `Referee.update` after every step, but there is no loop over steps.

    Args:
        before: Referee states before these steps, arrays or tensors; all episodes are running.
        contacts: Contacts of the steps. Steps after a release or an episode's end are ignored.
        config: Thresholds of the protocol's rules.

    Returns:
        Index (n,) from 0 of the last step that was applied in each episode, and the referee
        states after that step.
    """
    xp = get_namespace(before.steps)
    n_steps = len(contacts.robot_touches_hand)
    # Reading tensors of a GPU takes more time than the rules.
    if not is_tensor(before.steps) and _is_uneventful(before, contacts, config):
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


def _is_uneventful(before: RefereeState, contacts: ContactBatch, config: ProtocolConfig) -> bool:
    """Return whether only the time limit can end episodes: nothing is released, and the robot touches nothing."""
    return not (
        (before.release_reason >= 0).any()
        or contacts.robot_touches_object.any()
        or contacts.robot_touches_hand.any()
        or min(config.release_steps, config.success_steps) < 1
    )


def _judge_time_limit(before: RefereeState, n_steps: int, config: ProtocolConfig) -> tuple[Counts, RefereeState]:
    """Apply the time limit alone to k steps; see `judge_steps`."""
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
