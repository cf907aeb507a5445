"""Which grasp to go for: soonest reached, and beside the hand."""

import functools
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.models.panda import HALF_TURN
from handover_marl.models.poses import compose, inverse, inverse_transform_points, rotate
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.object_grasps import ObjectGrasps

Array = npt.NDArray[np.float64]

#: More room than this is as good as this (m).
MOST_ROOM = 0.2

# The gripper's body from behind its palm to its fingertips, on the hand link's z axis (m).
_BEHIND, _TIPS = -0.05, 0.11
# What a choice depends on.
_SEEN = ("gripper_pose", "object_poses", "object_classes", "hand_present", "hand_keypoints")
# Choices that are remembered: environments that are played beside each other ask in turns.
_REMEMBERED = 256


@dataclass(frozen=True, eq=False)
class _Grasps:
    """An object's grasps in its frame: poses (n, 7) of the hand link (m), and its z axes (n, 3)."""

    poses: Array
    axes: Array


class GraspChoice:
    """Chooses the grasp with the least distance plus turn from where the gripper is, with room for the hand.

    A gripper may also take a grasp turned by half a turn. What is chosen depends on the observation alone; who asks
    again about the same one, as features and action schemes do, gets the same answer without the work.

    Args:
        context: Knows the objects' grasps.
    """

    turn_weight = 0.25  # m/rad
    wanted_room, room_weight = 0.09, 4.0  # m from the hand's joints to the gripper's axis, and what lacks of it

    def __init__(self, context: PolicyContext) -> None:
        self._grasps = ObjectGrasps(context.grasps)
        self._known: dict[int, _Grasps | None] = {}
        self._chosen: OrderedDict[bytes, tuple[Array, float] | None] = OrderedDict()

    def choose(self, observation: Observation) -> tuple[Array, float] | None:
        """The world pose (7,) of the hand link, not to be written to, and its room (m); None if there is no grasp."""
        seen = b"".join(np.asarray(observation[name]).tobytes() for name in _SEEN)
        if seen not in self._chosen:
            self._chosen[seen] = self._best(observation)
            if len(self._chosen) > _REMEMBERED:
                self._chosen.popitem(last=False)
        return self._chosen[seen]

    def _best(self, observation: Observation) -> tuple[Array, float] | None:
        classes = int(observation["object_classes"][0])
        if classes not in self._known:
            self._known[classes] = self._own_frame(CLASS_NAMES[classes])
        grasps = self._known[classes]
        if grasps is None:
            return None
        # All is seen from the object, so that only what moves has to be carried over.
        item, gripper = (observation[name].astype(np.float64) for name in ("object_poses", "gripper_pose"))
        gripper = compose(inverse(item[0]), gripper)
        turns = 2.0 * np.arccos(np.minimum(np.abs(grasps.poses[:, 3:] @ gripper[3:]), 1.0))
        room = self._room(grasps, item[0], observation)
        lacking = np.maximum(0.0, self.wanted_room - room)
        ways = np.linalg.norm(grasps.poses[:, :3] - gripper[:3], axis=1)
        best = int(np.argmin(ways + self.turn_weight * turns + self.room_weight * lacking))
        chosen = compose(item[0], grasps.poses[best])
        chosen.flags.writeable = False
        return chosen, float(room[best])

    def _own_frame(self, object_name: str) -> "_Grasps | None":
        poses = self._grasps.in_object(object_name)
        if poses is None:
            return None
        poses = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
        return _Grasps(poses, rotate(poses[:, 3:], np.array([0.0, 0.0, 1.0])))

    def _room(self, grasps: "_Grasps", item: Array, observation: Observation) -> Array:
        """(n,) smallest distance of wrist and finger joints to the gripper's axis (m)."""
        if not observation["hand_present"][0]:
            return np.full(len(grasps.poses), MOST_ROOM)
        joints = inverse_transform_points(item, observation["hand_keypoints"])
        away = joints - grasps.poses[:, None, :3]
        along = np.clip(np.einsum("gki,gi->gk", away, grasps.axes), _BEHIND, _TIPS)
        beside = away - along[..., None] * grasps.axes[:, None]
        room: Array = np.minimum(np.sqrt(np.einsum("gki,gki->gk", beside, beside).min(axis=1)), MOST_ROOM)
        return room


@functools.lru_cache(maxsize=16)
def grasp_choice(context: PolicyContext) -> GraspChoice:
    """The one for a context, whoever asks."""
    return GraspChoice(context)
