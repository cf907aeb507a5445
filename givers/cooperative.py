"""Giver that helps the robot, and a schedule that varies the handover pose while the robot stays away."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action

Vector = npt.NDArray[np.float64]


class HandoverPoseVariation:
    """Schedule of the scale of a giver's deviation, which changes whenever the gripper has not approached for 2 s.

    Attributes:
        scale: Factor, from -0.5 to 1, by which the giver multiplies its deviation from the recorded
            handover pose; 0 gives the recorded pose.
        timeout: Time without an approach after which `scale` changes (s).
        min_approach: Decrease of the distance from gripper to object that counts as an approach (m).
        scales: Values that `scale` takes one after the other; the first follows the last.
    """

    timeout = 2.0
    min_approach = 0.02
    scales = (1.0, 0.0, 0.5, -0.5)

    def __init__(self) -> None:
        self.scale = self.scales[0]
        self._timeouts = 0
        self._min_distance = np.inf
        self._since: float | None = None

    def update(self, observation: Observation) -> None:
        """Update `scale`; to be called in every decision once the hand is at its handover pose."""
        now = float(observation["time"][0])
        distance = float(np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3]))
        if self._since is None or distance < self._min_distance - self.min_approach:
            self._min_distance, self._since = distance, now
        elif now - self._since >= self.timeout:
            self._timeouts += 1
            self.scale = self.scales[self._timeouts % len(self.scales)]
            self._min_distance, self._since = np.inf, now


@dataclass(frozen=True)
class CooperativeConfig(CheckedConfig):
    """Configuration of `CooperativeGiver`.

    Attributes:
        approach_share: Share of the distance to the gripper by which the object is moved.
        min_distance: Distance from gripper to object below which the object is not moved closer (m).
        max_displacement: Largest displacement of the object from its recorded position (m).
        max_rotation: Largest rotation of hand and object from their recorded orientation (rad).
        rate: Playback rate minus 1; positive values are faster than recorded.
        withdrawal: Distance by which the hand withdraws after the release (m).
    """

    limits: ClassVar[Limits] = {
        "approach_share": (0.0, 1.0),
        "min_distance": (0.0, 2.0),
        "max_displacement": (0.0, 0.3),
        "max_rotation": (0.0, 1.0),
        "rate": (-0.8, 1.0),
        "withdrawal": (0.0, 0.3),
    }

    approach_share: float = 0.3
    min_distance: float = 0.45
    max_displacement: float = 0.25
    max_rotation: float = 0.8
    rate: float = 0.0
    withdrawal: float = 0.15


class CooperativeGiver(Giver):
    """Giver that offers the object towards the gripper, waits for a grasp, releases and withdraws.

    While the recorded hand moves to its handover pose, the hand turns behind the object as seen
    from the gripper and moves towards the gripper. The pose is fixed once the recorded hand has
    stopped or the gripper is near, because robots take resting objects best. `HandoverPoseVariation` varies
    the pose if the gripper does not approach. The hand releases the object when both fingers have
    stopped on the object, and withdraws after any release.

    Args:
        context: Robot and task, which this giver does not use.
        approach_share: Share of the distance to the gripper by which the object is moved.
        min_distance: Distance from gripper to object below which the object is not moved closer, up to 2 m.
        max_displacement: Largest displacement of the object from its recorded position, up to 0.3 m.
        max_rotation: Largest rotation of hand and object from their recorded orientation, up to 1 rad.
        rate: Playback rate minus 1, from -0.8 (a fifth of the recorded speed) to 1 (twice).
        withdrawal: Distance by which the hand withdraws after the release, up to 0.3 m.

    Attributes:
        near_distance: Distance from gripper to object at which the pose is fixed (m).
        arrival_tolerance: Remaining motion of the recorded wrist below which the hand counts as
            stopped (m).
        grasp_time: Time for which the fingers must rest on the object before the release (s).
    """

    name = "cooperative"
    near_distance = 0.25
    arrival_tolerance = 0.01
    grasp_time = 0.2

    def __init__(
        self,
        context: PolicyContext | None = None,
        approach_share: float = CooperativeConfig.approach_share,
        min_distance: float = CooperativeConfig.min_distance,
        max_displacement: float = CooperativeConfig.max_displacement,
        max_rotation: float = CooperativeConfig.max_rotation,
        rate: float = CooperativeConfig.rate,
        withdrawal: float = CooperativeConfig.withdrawal,
    ) -> None:
        super().__init__(context)
        self.config = CooperativeConfig(approach_share, min_distance, max_displacement, max_rotation, rate, withdrawal)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode without deviation from the recording."""
        self._displacement, self._rotation = np.zeros(3), np.zeros(3)
        self._is_fixed = False
        self._pose_variation = HandoverPoseVariation()
        self._grasped_since: float | None = None
        self._withdrawn: Vector | None = None

    def act(self, observation: Observation) -> Action:
        """Return the action (8,): deviation towards the gripper, or withdrawal after a release."""
        if observation["released"][0]:
            return self._withdraw(observation)
        if not self._is_fixed and observation["hand_present"][0]:
            self._choose_pose(observation)
        self._is_fixed = self._is_fixed or self._is_near(observation) or self._has_arrived(observation)
        if self._is_fixed:
            self._pose_variation.update(observation)
        scale = self._pose_variation.scale
        return make_giver_action(
            self.config.rate,
            displacement=scale * self._displacement,
            rotation=scale * self._rotation,
            release=self._is_grasped(observation),
        )

    def _is_near(self, observation: Observation) -> bool:
        gripper, item = observation["gripper_pose"][:3], observation["object_poses"][0, :3]
        return float(np.linalg.norm(gripper - item)) < self.near_distance

    def _has_arrived(self, observation: Observation) -> bool:
        """Return whether the recorded hand has stopped at its handover pose."""
        wrist = observation["replay_wrist_poses"][:, :3]
        return bool(observation["holding"][0]) and float(np.abs(wrist - wrist[0]).max()) < self.arrival_tolerance

    def _choose_pose(self, observation: Observation) -> None:
        """Choose the deviation from the recorded poses half a second ahead."""
        config = self.config
        gripper = observation["gripper_pose"][:3].astype(np.float64)
        wrist = observation["replay_wrist_poses"][-1, :3].astype(np.float64)
        item = observation["replay_object_poses"][-1, :3].astype(np.float64)
        rotation = self._rotate_towards(item - wrist, gripper - item)
        direction = gripper - item
        distance = float(np.linalg.norm(direction))
        length = float(
            np.clip(min(config.approach_share * distance, distance - config.min_distance), 0.0, config.max_displacement)
        )
        target = item + direction / max(distance, 1e-6) * length
        self._rotation = rotation
        # The rotation moves the object about the wrist; the displacement compensates for it.
        self._displacement = target - Rotation.from_rotvec(rotation).apply(item - wrist) - wrist

    def _rotate_towards(self, arm: Vector, direction: Vector) -> Vector:
        """Return the limited rotation vector that turns direction `arm` towards another one."""
        axis = np.cross(arm, direction)
        size = float(np.linalg.norm(axis))
        if size < 1e-9:
            return np.zeros(3)
        angle = float(np.arctan2(size, np.dot(arm, direction)))
        return axis / size * min(angle, self.config.max_rotation)

    def _is_grasped(self, observation: Observation) -> bool:
        """Return whether the fingers have rested on something for long enough."""
        now = float(observation["time"][0])
        fingers, speeds = observation["robot_joint_position"][7:], observation["robot_joint_velocity"][7:]
        is_resting = bool((np.abs(speeds) < 2e-3).all() and (fingers > 1e-3).all() and (fingers < 0.0385).all())
        if not (is_resting and self._is_near(observation)):
            self._grasped_since = None
            return False
        self._grasped_since = now if self._grasped_since is None else self._grasped_since
        return now - self._grasped_since >= self.grasp_time

    def _withdraw(self, observation: Observation) -> Action:
        if self._withdrawn is None:
            away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
            displacement = self._pose_variation.scale * self._displacement
            self._withdrawn = displacement + self.config.withdrawal * away / max(float(np.linalg.norm(away)), 1e-6)
        return make_giver_action(displacement=self._withdrawn, rotation=self._pose_variation.scale * self._rotation)
