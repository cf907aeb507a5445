"""Custom features and a custom action scheme, to which tests refer directly or by `module:name`."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.learning.encodings.action_scheme import ActionScheme
from handover_marl.learning.encodings.custom import FeatureExtractor, declare_size


@declare_size(3)
def offset_to_object(observation: Observation) -> np.ndarray:
    return observation["object_poses"][0, :3] - observation["gripper_pose"][:3]


class OffsetAndCount(FeatureExtractor):
    """Features (4,): offset to the object (3,), and the number of observations since the start of the episode."""

    agent, size = "receiver", 4

    def reset(self) -> None:
        self.count = 0

    def __call__(self, observation: Observation) -> np.ndarray:
        self.count = getattr(self, "count", 0) + 1
        return np.array([*offset_to_object(observation), self.count], dtype=np.float32)


class FirstJoint(ActionScheme):
    """Action scheme with one output, which moves the first joint."""

    name, agent, size = "first_joint", "receiver", 1

    def compute_action(self, observation: Observation) -> np.ndarray:
        target = observation["robot_joint_position"].copy()
        target[0] += 0.1 * self.outputs[0]
        return target


@declare_size(1)
def move_first_joint(outputs: np.ndarray, observation: Observation) -> np.ndarray:
    target = observation["robot_joint_position"].copy()
    target[0] += np.float32(0.1 * outputs[0])
    return target
