"""People who help the robot to take what they offer."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.givers.patience import Patience
from handover_marl.policies.giver import Giver, deviation
from handover_marl.policies.policy import Action

Vector = npt.NDArray[np.float64]


class CooperativeGiver(Giver):
    """Meets the robot, turns the free side of the object to it, holds still, lets go and draws back.

    While the recording carries the object to where it is offered, the hand swings round so that it is behind the
    object as seen from the gripper, and comes towards the gripper. Once it has arrived there or the gripper is
    near, nothing changes any more: robots take best what does not move; only when nobody comes for two seconds is
    the object offered otherwise. When both fingers have stopped on the object, the hand lets go; when the object
    has been let go, for whatever reason, the hand draws back.
    """

    name = "cooperative"
    meet = 0.3  # share of the way to the gripper
    keep_off = 0.45  # m, from gripper to object while coming nearer
    most = 0.25  # m, way of the object
    turn = 0.8  # rad
    near = 0.25  # m, gripper to object; from here on hold still
    at_rest = 0.01  # m, what the recording may still move
    firm_after = 0.2  # s that both fingers must stand on something
    withdraw = 0.15  # m

    def reset(self, seed: int | None = None) -> None:
        """Forget the last handover."""
        self._shift, self._turn = np.zeros(3), np.zeros(3)
        self._settled = False
        self._patience = Patience()
        self._firm_since: float | None = None
        self._drawn_back: Vector | None = None

    def act(self, observation: Observation) -> Action:
        """Help."""
        if observation["released"][0]:
            return self._draw_back(observation)
        if not self._settled and observation["hand_present"][0]:
            self._offer(observation)
        self._settled = self._settled or self._near(observation) or self._at_rest(observation)
        if self._settled:
            self._patience.watch(observation)
        share = self._patience.share
        return deviation(displacement=share * self._shift, rotation=share * self._turn, release=self._firm(observation))

    def _near(self, observation: Observation) -> bool:
        gripper, item = observation["gripper_pose"][:3], observation["object_poses"][0, :3]
        return float(np.linalg.norm(gripper - item)) < self.near

    def _at_rest(self, observation: Observation) -> bool:
        """Whether the recording has arrived where it offers the object."""
        wrist = observation["replay_wrist_poses"][:, :3]
        return bool(observation["holding"][0]) and float(np.abs(wrist - wrist[0]).max()) < self.at_rest

    def _offer(self, observation: Observation) -> None:
        """Choose where to hold the object from what the recording is about to do."""
        gripper = observation["gripper_pose"][:3].astype(np.float64)
        wrist = observation["replay_wrist_poses"][-1, :3].astype(np.float64)
        item = observation["replay_object_poses"][-1, :3].astype(np.float64)
        turn = self._turn_towards(item - wrist, gripper - item)
        way = gripper - item
        distance = float(np.linalg.norm(way))
        length = float(np.clip(min(self.meet * distance, distance - self.keep_off), 0.0, self.most))
        place = item + way / max(distance, 1e-6) * length
        self._turn = turn
        # The object swings about the wrist; the wrist makes up for it.
        self._shift = place - Rotation.from_rotvec(turn).apply(item - wrist) - wrist

    def _turn_towards(self, arm: Vector, way: Vector) -> Vector:
        """The rotation vector, at most `turn` long, that brings the direction hand to object to the way."""
        axis = np.cross(arm, way)
        size = float(np.linalg.norm(axis))
        if size < 1e-9:
            return np.zeros(3)
        angle = float(np.arctan2(size, np.dot(arm, way)))
        return axis / size * min(angle, self.turn)

    def _firm(self, observation: Observation) -> bool:
        """Whether the fingers have stood still on something for long enough."""
        now = float(observation["time"][0])
        fingers, speeds = observation["robot_joint_position"][7:], observation["robot_joint_velocity"][7:]
        still = bool((np.abs(speeds) < 2e-3).all() and (fingers > 1e-3).all() and (fingers < 0.0385).all())
        if not (still and self._near(observation)):
            self._firm_since = None
            return False
        self._firm_since = now if self._firm_since is None else self._firm_since
        return now - self._firm_since >= self.firm_after

    def _draw_back(self, observation: Observation) -> Action:
        if self._drawn_back is None:
            away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
            shift = self._patience.share * self._shift
            self._drawn_back = shift + self.withdraw * away / max(float(np.linalg.norm(away)), 1e-6)
        return deviation(displacement=self._drawn_back, rotation=self._patience.share * self._turn)
