"""Features that point to a grasp: where the gripper would have to be to take the object beside the hand."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry import compose, compose_point, rotate
from handover_marl.learning.features import receiver_features
from handover_marl.observations import Observation
from handover_marl.receivers.base import ReceiverContext
from handover_marl.receivers.grasps import ObjectGrasps

Array = npt.NDArray[np.float64]

#: How many numbers are added to `receiver_features`.
N_ADDED = 8

_HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
# The gripper's body from behind its palm to its fingertips, on the hand link's z axis (m).
_BEHIND, _TIPS = -0.05, 0.11


class GraspFeatures:
    """`receiver_features`, and a grasp seen from the gripper: way (3), turn (3), room (1), whether there is one.

    The grasp is the one that is soonest reached: least distance plus turn, and far enough from wrist and fingers.
    A gripper may also take it turned by half a turn.

    Args:
        context: Knows the objects' grasps.
    """

    turn_weight = 0.25  # m/rad
    wanted_room, room_weight = 0.09, 4.0  # m from the hand's joints to the gripper's axis, and what lacks of it

    def __init__(self, context: ReceiverContext) -> None:
        self._grasps = ObjectGrasps(context.grasps)

    def __call__(self, observation: Observation) -> npt.NDArray[np.float32]:
        """(64,) for an observation."""
        return np.concatenate([receiver_features(observation), self._grasp(observation)])

    def _grasp(self, observation: Observation) -> npt.NDArray[np.float32]:
        grasps = self._grasps.in_world(observation)
        if grasps is None:
            return np.zeros(N_ADDED, dtype=np.float32)
        grasps = np.concatenate([grasps, compose(grasps, _HALF_TURN)])
        gripper = observation["gripper_pose"].astype(np.float64)
        own = Rotation.from_quat(gripper[3:])
        turns = (own.inv() * Rotation.from_quat(grasps[:, 3:])).as_rotvec()
        ways = grasps[:, :3] - gripper[:3]
        room = self._room(grasps, observation)
        lacking = np.maximum(0.0, self.wanted_room - room)
        costs = np.linalg.norm(ways, axis=1) + self.turn_weight * np.linalg.norm(turns, axis=1)
        best = int(np.argmin(costs + self.room_weight * lacking))
        way = own.inv().apply(ways[best])
        return np.array([*5.0 * way, *turns[best], 10.0 * room[best], 1.0], dtype=np.float32)

    def _room(self, grasps: Array, observation: Observation) -> Array:
        """(n,) smallest distance of wrist and finger joints to the gripper's axis (m); at most 0.2."""
        if not observation["hand_present"][0]:
            return np.full(len(grasps), 0.2)
        axis = rotate(grasps[:, 3:], np.array([0.0, 0.0, 1.0]))
        away = observation["hand_keypoints"].astype(np.float64) - compose_point(grasps, np.zeros(3))[:, None]
        along = np.clip(np.einsum("gki,gi->gk", away, axis), _BEHIND, _TIPS)
        beside = away - along[..., None] * axis[:, None]
        room: Array = np.minimum(np.linalg.norm(beside, axis=-1).min(axis=1), 0.2)
        return room
