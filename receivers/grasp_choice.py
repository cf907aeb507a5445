"""Which grasp to go for: soonest reached, and beside the hand."""

import functools
from collections import OrderedDict

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.models.panda import HALF_TURN
from handover_marl.models.poses import compose, compose_point, rotate
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
        grasps = self._grasps.in_world(observation)
        if grasps is None:
            return None
        grasps = np.concatenate([grasps, compose(grasps, np.array(HALF_TURN))])
        gripper = observation["gripper_pose"].astype(np.float64)
        turns = (Rotation.from_quat(gripper[3:]).inv() * Rotation.from_quat(grasps[:, 3:])).magnitude()
        room = self._room(grasps, observation)
        lacking = np.maximum(0.0, self.wanted_room - room)
        ways = np.linalg.norm(grasps[:, :3] - gripper[:3], axis=1)
        best = int(np.argmin(ways + self.turn_weight * turns + self.room_weight * lacking))
        chosen = grasps[best].copy()
        chosen.flags.writeable = False
        return chosen, float(room[best])

    def _room(self, grasps: Array, observation: Observation) -> Array:
        """(n,) smallest distance of wrist and finger joints to the gripper's axis (m)."""
        if not observation["hand_present"][0]:
            return np.full(len(grasps), MOST_ROOM)
        axis = rotate(grasps[:, 3:], np.array([0.0, 0.0, 1.0]))
        away = observation["hand_keypoints"].astype(np.float64) - compose_point(grasps, np.zeros(3))[:, None]
        along = np.clip(np.einsum("gki,gi->gk", away, axis), _BEHIND, _TIPS)
        beside = away - along[..., None] * axis[:, None]
        room: Array = np.minimum(np.linalg.norm(beside, axis=-1).min(axis=1), MOST_ROOM)
        return room


@functools.lru_cache(maxsize=16)
def grasp_choice(context: PolicyContext) -> GraspChoice:
    """The one for a context, whoever asks."""
    return GraspChoice(context)
