"""Which grasp to go for: soonest reached, and beside the hand."""

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


class GraspChoice:
    """Chooses the grasp with the least distance plus turn from where the gripper is, with room for the hand.

    A gripper may also take a grasp turned by half a turn. Nothing is remembered from one choice to the next.

    Args:
        context: Knows the objects' grasps.
    """

    turn_weight = 0.25  # m/rad
    wanted_room, room_weight = 0.09, 4.0  # m from the hand's joints to the gripper's axis, and what lacks of it

    def __init__(self, context: PolicyContext) -> None:
        self._grasps = ObjectGrasps(context.grasps)

    def choose(self, observation: Observation) -> tuple[Array, float] | None:
        """The world pose (7,) of the hand link and its room (m), or None for an object without grasps."""
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
        return grasps[best], float(room[best])

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
