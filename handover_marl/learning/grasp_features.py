"""Features that point to a grasp: where the gripper would have to be to take the object beside the hand."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.learning.features import receiver_features
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.grasp_choice import grasp_choice

#: How many numbers are added to `receiver_features`.
N_ADDED = 8
#: How many numbers `CloseFeatures` are.
N_CLOSE = 12
_WAY = 5.0  # 1/m


class GraspFeatures:
    """`receiver_features`, and a grasp seen from the gripper: way (3), turn (3), room (1), whether there is one.

    Args:
        context: Knows the objects' grasps.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._choice = grasp_choice(context)
        self._protocol = context.protocol

    def __call__(self, observation: Observation) -> npt.NDArray[np.float32]:
        """(64,) for an observation."""
        return np.concatenate([receiver_features(observation, self._protocol), self.grasp(observation)])

    def grasp(self, observation: Observation) -> npt.NDArray[np.float32]:
        """(8,) the grasp alone; zeros where there is none."""
        chosen = self._choice.choose(observation)
        if chosen is None:
            return np.zeros(N_ADDED, dtype=np.float32)
        grasp, room = chosen
        gripper = observation["gripper_pose"].astype(np.float64)
        own = Rotation.from_quat(gripper[3:]).inv()
        turn = (own * Rotation.from_quat(grasp[3:])).as_rotvec()
        return np.array([*_WAY * own.apply(grasp[:3] - gripper[:3]), *turn, 10.0 * room, 1.0], dtype=np.float32)


class CloseFeatures:
    """Only what it takes to close in time, to learn it from few episodes: how near and how aligned a grasp is.

    Way to the grasp (3) and turn (3) from the gripper; two numbers that are 1 at the grasp and fall off within some
    centimetres and a fraction of a radian; fingers (2), whether the object was let go, whether there is a grasp.

    Args:
        context: Knows the objects' grasps.
    """

    near, aligned = 0.03, 0.2  # m and rad at which the numbers have fallen to 0.37

    def __init__(self, context: PolicyContext) -> None:
        self._grasp = GraspFeatures(context)

    def __call__(self, observation: Observation) -> npt.NDArray[np.float32]:
        """(12,) for an observation."""
        way, turn, (_, there) = np.split(self._grasp.grasp(observation), [3, 6])
        metres = float(np.linalg.norm(way)) / _WAY
        nearness = np.exp([-metres / self.near, -float(np.linalg.norm(turn)) / self.aligned]) * there
        fingers = 50.0 * observation["robot_joint_position"][7:] - 1.0
        return np.concatenate([way, turn, nearness, fingers, observation["released"], [there]]).astype(np.float32)
