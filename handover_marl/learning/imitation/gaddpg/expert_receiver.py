"""Receiver that runs the imitation expert in GA-DDPG's protocol, as an upper bound for imitation."""

from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import FULL_POINTCLOUD, STATE
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.imitation.gaddpg.expert import GraspExpert, GraspExpertConfig, KinematicArm
from handover_marl.learning.imitation.gaddpg.grasp_costs import GraspCostConfig, GraspCostTable, compute_travel_costs
from handover_marl.policies.policy import Action, PolicyContext
from handover_marl.receivers.gaddpg import GaddpgReceiver

Array = npt.NDArray[np.float64]


class ExpertReceiver(GaddpgReceiver):
    """Receiver `gaddpg` with the imitation expert in place of the network.

    The expert knows the true pose of the object, but not the person's hand.

    Args:
        context: Robot and objects.
        wait: Time for which the robot waits at its start pose (s).
        replan_distance: Distance of the object from its position at the last choice of goals above
            which the expert chooses goals anew (m); the choice takes much processor time.
        config: Configuration of the expert's selection of grasps.
        costs: Configuration of the costs of grasps.
    """

    name = "gaddpg_expert"
    obs_mode = f"{STATE}+{FULL_POINTCLOUD}"

    def __init__(
        self,
        context: PolicyContext,
        wait: float | None = None,
        replan_distance: float = 0.1,
        config: GraspExpertConfig | None = None,
        costs: GraspCostConfig | None = None,
    ) -> None:
        super().__init__(context, network=self._compute_step, wait=wait)
        self._replan_distance, arm = replan_distance, KinematicArm(context)
        table = GraspCostTable(context, costs or GraspCostConfig())
        self._expert = GraspExpert(context, table, arm, config or GraspExpertConfig())
        self._goals: tuple[Array, Array] | None = None
        self._object_position, self._observation = np.zeros(3), dict[str, Any]()

    def reset(self, seed: int | None = None) -> None:
        """Clear the state of the previous episode."""
        super().reset(seed)
        self._goals = None

    def act(self, observation: Observation) -> Action:
        """Return the target positions (9,) of arm and fingers for the expert's step (rad, m)."""
        self._observation = observation
        return super().act(observation)

    def _compute_step(self, points: Array, remaining: int) -> Array:
        observation = self._observation
        pose = observation["object_poses"][0].astype(np.float64)
        hand = observation["gripper_pose"].astype(np.float64)
        if self._goals is None or np.linalg.norm(pose[:3] - self._object_position) > self._replan_distance:
            joints = observation["robot_joint_position"][:ARM_DOF].astype(np.float64)
            name = self.context.object_names[int(observation["object_classes"][0])]
            goals, costs = self._expert.find_goals(name, pose, joints, np.zeros(4))
            if len(goals):
                self._goals, self._object_position = (compose(invert_pose(pose), goals), costs), pose[:3]
        if self._goals is None:
            return np.zeros(6)
        goals = compose(pose, self._goals[0])
        best = int(np.argmin(self._goals[1] + compute_travel_costs(hand, goals)))
        return self._expert.compute_step(hand, goals[best], remaining)
