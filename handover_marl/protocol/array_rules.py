"""The same rules as arrays: many episodes, and many steps of each, judged at once.

What counts steps in a row is worked out from where rows begin, so that no loop goes over the steps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.referee import Standing
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus

Flags = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.int_]

_ACTIVE, _PASSIVE = tuple(Release).index(Release.ACTIVE), tuple(Release).index(Release.PASSIVE)


class ContactArrays(NamedTuple):
    """Contacts of k steps of n episodes; what `protocol.contacts.Contacts` is of one step.

    Attributes:
        robot_hand: (k, n) the Panda touches the human hand.
        robot_object: (k, n) it touches the target object.
        fingers: (k, n, 2) the left and the right finger touch the target object.
        in_region: (k, n, 2) they do in their grasp region.
        object_supported: (k, n) the target object touches the table or another object.
        object_height: (k, n) world z of its origin (m).
        gripper_position: (k, n, 3) of the Panda's hand link (m).
    """

    robot_hand: Flags
    robot_object: Flags
    fingers: Flags
    in_region: Flags
    object_supported: Flags
    object_height: npt.NDArray[np.floating]
    gripper_position: npt.NDArray[np.floating]

    @classmethod
    def of(cls, steps: Sequence[Contacts], config: ProtocolConfig) -> "ContactArrays":
        """Contacts of k steps of one episode, n = 1.

        Args:
            steps: The contacts.
            config: Where fingers grasp.
        """
        rows = [
            (
                step.robot_hand,
                step.robot_object,
                [len(points) > 0 for points in step.finger_points],
                [bool(in_region(points, config).any()) for points in step.finger_points],
                step.object_supported,
                step.object_height,
                step.gripper_position,
            )
            for step in steps
        ]
        return cls(*(np.array(column)[:, None] for column in zip(*rows, strict=True)))

    @classmethod
    def none(cls, steps: int, episodes: int) -> "ContactArrays":
        """No contacts in k steps of n episodes."""
        shape, nothing = (steps, episodes), Contacts()
        flags, fingers = np.zeros(shape, dtype=bool), np.zeros((*shape, 2), dtype=bool)
        height, place = np.full(shape, nothing.object_height), np.full((*shape, 3), nothing.gripper_position)
        return cls(flags, flags, fingers, fingers, flags, height, place)


class Verdicts(NamedTuple):
    """How n episodes stand, as arrays (n,) of what `protocol.referee.Standing` has of one."""

    status: Counts
    steps: Counts
    release: Counts
    release_step: Counts
    active_steps: Counts
    passive_steps: Counts
    goal_steps: Counts

    @classmethod
    def of(cls, standings: list[Standing]) -> "Verdicts":
        """Those of some episodes."""
        return cls(*np.array(standings, dtype=np.int_).reshape(-1, len(Standing._fields)).T)

    def standing(self, number: int) -> Standing:
        """That of one episode."""
        return Standing(*(int(array[number]) for array in self))


def in_region(points: npt.NDArray[np.float32], config: ProtocolConfig) -> Flags:
    """(...) whether points (..., 3) in a finger's frame (m) are in its grasp region."""
    inside = (points > np.array(config.region_lower)) & (points < np.array(config.region_upper))
    return np.asarray(inside.all(axis=-1))


def judge(before: Verdicts, seen: ContactArrays, config: ProtocolConfig) -> tuple[Counts, Verdicts]:
    """Judge steps until something has to happen: a person lets go, or an episode ends.

    Args:
        before: How the episodes stood before these steps, all running.
        seen: What touched in them. Steps after that in which something has to happen count for nothing.
        config: The rules.

    Returns:
        (n,) the last step that counts, from 0, and how the episodes stand after it.
    """
    n_steps, n_episodes = seen.robot_hand.shape
    number = np.arange(n_steps)[:, None]
    left, right = seen.in_region[..., 0], seen.in_region[..., 1]
    active = _in_a_row(seen.robot_object & left & right, before.active_steps)
    passive = _in_a_row(seen.robot_object & ~(left | right), before.passive_steps)
    held = before.release < 0
    lets_go = held & ((active >= config.release_steps) | (passive >= config.release_steps))
    released = ~held | np.logical_or.accumulate(lets_go, axis=0)
    both = seen.fingers.all(axis=-1)
    dropped = released & ~both & (seen.object_supported | (seen.object_height < config.drop_height))
    fails = seen.robot_hand | dropped
    away = seen.gripper_position - np.array(config.goal_center)
    near = np.sqrt((away**2).sum(axis=-1)) < config.goal_radius
    goal = _in_a_row(released & ~fails & near & both, before.goal_steps)
    wins = goal >= config.success_steps
    late = before.steps + number + 1 >= config.horizon_steps
    happens = lets_go | fails | wins | late
    last = np.where(happens.any(axis=0), happens.argmax(axis=0), n_steps - 1)
    now = (last, np.arange(n_episodes))
    status = (
        int(EpisodeStatus.HUMAN_CONTACT) * seen.robot_hand[now]
        + int(EpisodeStatus.OBJECT_DROP) * dropped[now]
        + int(EpisodeStatus.TIMEOUT) * late[now]
    )
    steps = before.steps + last + 1
    chosen = np.where(active[now] >= config.release_steps, _ACTIVE, _PASSIVE)
    return last, Verdicts(
        status=np.where(wins[now], int(EpisodeStatus.SUCCESS), status),
        steps=steps,
        release=np.where(lets_go[now], chosen, before.release),
        release_step=np.where(lets_go[now], steps, before.release_step),
        active_steps=np.where(held, active[now], before.active_steps),
        passive_steps=np.where(held, passive[now], before.passive_steps),
        goal_steps=goal[now],
    )


def _in_a_row(holds: Flags, before: Counts) -> Counts:
    """(k, n) for how many steps in a row something has held after each step.

    Args:
        holds: (k, n) in which steps it does.
        before: (n,) for how many it had before the first.
    """
    number = np.arange(len(holds))[:, None]
    missed = np.maximum.accumulate(np.where(holds, -1, number), axis=0)
    return np.where(missed < 0, before + number + 1, number - missed)
