"""Features that point to a grasp: where the gripper would have to be to take the object beside the hand."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.learning.features import receiver_features
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.grasp_choice import GraspChoice

#: How many numbers are added to `receiver_features`.
N_ADDED = 8


class GraspFeatures:
    """`receiver_features`, and a grasp seen from the gripper: way (3), turn (3), room (1), whether there is one.

    Args:
        context: Knows the objects' grasps.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._choice = GraspChoice(context)
        self._protocol = context.protocol

    def __call__(self, observation: Observation) -> npt.NDArray[np.float32]:
        """(64,) for an observation."""
        return np.concatenate([receiver_features(observation, self._protocol), self._grasp(observation)])

    def _grasp(self, observation: Observation) -> npt.NDArray[np.float32]:
        chosen = self._choice.choose(observation)
        if chosen is None:
            return np.zeros(N_ADDED, dtype=np.float32)
        grasp, room = chosen
        gripper = observation["gripper_pose"].astype(np.float64)
        own = Rotation.from_quat(gripper[3:]).inv()
        turn = (own * Rotation.from_quat(grasp[3:])).as_rotvec()
        return np.array([*5.0 * own.apply(grasp[:3] - gripper[:3]), *turn, 10.0 * room, 1.0], dtype=np.float32)
