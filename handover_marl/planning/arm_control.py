"""Kinematics of an arm in the world frame, and position targets with which its motors follow joint velocities."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF, CheckedConfig, PandaConfig, bounded
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import compose, invert_pose, poses_from_rotations
from handover_marl.planning.ik_solvers import solve_ik

Array = npt.NDArray[np.float64]

# Regularizes velocities near singular configurations (m^2).
_DAMPING = 1e-3


class ArmInWorld:
    """Kinematics of an arm whose base has a fixed pose in the world.

    Args:
        arm: Kinematics in the base frame.
        base: (7,) pose of the arm's base in the world, position (m) and quaternion xyzw.
        limits: Lower and upper joint limits, (7,) each (rad).
    """

    def __init__(self, arm: ArmKinematics, base: Array, limits: tuple[Array, Array]) -> None:
        self.arm, self.limits = arm, limits
        self.base, self._base_from_world = base, invert_pose(base)
        self._world_from_base_rotation = Rotation.from_quat(base[3:]).as_matrix()

    @classmethod
    def for_panda(cls, urdf: Path, panda: PandaConfig, padding: float = 0.0) -> "ArmInWorld":
        """Create the kinematics of a Panda at its configured base pose, with each limit narrowed by `padding` (rad)."""
        limits = np.array(LOWER_LIMITS[:ARM_DOF]) + padding, np.array(UPPER_LIMITS[:ARM_DOF]) - padding
        base = np.array([*panda.base_position, *panda.base_orientation])
        return cls(ArmKinematics(read_tree(urdf)), base, limits)

    def compute_hand_poses(self, joints: Array) -> Array:
        """Return the world poses (n, 7) (quaternion xyzw) of the hand link at configurations (n, 7) (rad)."""
        chain = self.arm.compute_chain_frames(joints)
        return np.asarray(
            compose(self.base, poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0)))
        )

    def compute_hand_pose(self, joints: Array) -> Array:
        """Return the world pose (7,) (quaternion xyzw) of the hand link at one configuration (7,) (rad)."""
        return np.asarray(self.compute_hand_poses(joints[None])[0])

    def compute_link_frames(self, joints: Array) -> tuple[Array, Array]:
        """Return world origins (n, 7, 3) in m and rotations (n, 7, 3, 3) of the arm's links at joints (n, 7) in rad."""
        chain = self.arm.compute_chain_frames(joints)
        rotation = self._world_from_base_rotation
        origins = chain.origins[:-1].transpose(2, 0, 1) @ rotation.T + self.base[:3]
        return origins, rotation @ chain.rotations[:-1].transpose(3, 0, 1, 2)

    def compute_jacobian(self, joints: Array) -> Array:
        """Return the world-frame Jacobian (6, 7) of the hand link at joints (7,) in rad: linear rows (m/rad) first."""
        local = self.arm.compute_jacobian(self.arm.compute_chain_frames(joints[None]))[..., 0]
        rotation = self._world_from_base_rotation
        return np.concatenate([rotation @ local[:3], rotation @ local[3:]])

    def compute_point_jacobian(self, joints: Array, point: Array, link: int) -> Array:
        """Return the world-frame Jacobian (3, 7) of a world point (3,) in m on a link, at joints (7,) in rad.

        `link` is the number of the link on which the point is fixed: 0 to 6, or 7 for the hand link.
        """
        chain = self.arm.compute_chain_frames(joints[None])
        rotation = self._world_from_base_rotation
        axes = chain.rotations[:-1, :, 2, 0] @ rotation.T
        origins = chain.origins[:-1, :, 0] @ rotation.T + self.base[:3]
        columns = np.cross(axes, point - origins)
        columns[link + 1 :] = 0.0
        return np.asarray(columns.T)

    def solve(
        self, poses: Array, starts: Array, iterations: int, tolerance: float = 1e-3
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Solve inverse kinematics for world poses (n, 7; xyzw) of the hand link from joints `starts` (n, 7) in rad.

        The tolerance is the maximum error of each component of position (m) and rotation vector (rad). Returns
        configurations (n, 7) in rad after at most `iterations` steps, and whether each one reaches its pose (n,).
        """
        local = compose(self._base_from_world, poses)
        rotations = Rotation.from_quat(local[:, 3:]).as_matrix()
        return solve_ik(self.arm, local[:, :3], rotations, starts, self.limits, tolerance, iterations)

    def compute_joint_velocity(
        self, joints: Array, linear: Array, angular: Array, rotation_weight: float, period: float
    ) -> Array:
        """Return joint velocities (7,) in rad/s, at joints (7,) in rad, that best give the hand link a wanted velocity.

        The wanted velocity in the world is `linear` (3,) in m/s and `angular` (3,) in rad/s. Its error is minimized by
        damped least squares; `rotation_weight` (m/rad) is the weight of the angular error. A joint that would exceed
        its limit within the control `period` (s) is not moved.
        """
        weights = np.array([1.0, 1.0, 1.0, rotation_weight, rotation_weight, rotation_weight])
        rows = weights[:, None] * self.compute_jacobian(joints)
        wanted = weights * np.concatenate([linear, angular])
        is_free = np.ones(len(joints), dtype=bool)
        for _ in range(len(joints)):
            moving = rows * is_free
            velocity: Array = moving.T @ np.linalg.solve(moving @ moving.T + _DAMPING * np.eye(6), wanted)
            after = joints + period * velocity
            passes_lower = (after < self.limits[0]) & (velocity < 0.0)
            is_blocked = passes_lower | ((after > self.limits[1]) & (velocity > 0.0))
            if not (is_free & is_blocked).any():
                return velocity
            is_free &= ~is_blocked
        return np.zeros(len(joints))


@dataclass(frozen=True)
class ServoConfig(CheckedConfig):
    """Limits on the speeds and accelerations of the Panda's joints.

    Attributes:
        max_joint_speeds: Speed limits of the Panda's joints (rad/s).
        speed_scale: Factor on `max_joint_speeds`, above 0 to 1.
        max_acceleration: Maximum acceleration of each joint (rad/s^2).
        deceleration: Joint deceleration with which the arm stops at a goal configuration (rad/s^2).
    """

    default_limits: ClassVar[tuple[float, float]] = (1e-6, math.inf)

    max_joint_speeds: tuple[float, ...] = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
    speed_scale: float = bounded(1.0, 1e-6, 1.0)
    max_acceleration: float = 20.0
    deceleration: float = 12.0


class ArmServo:
    """Controller that converts joint velocities to position targets of the arm's motors.

    The arm lags behind the targets of position motors. The targets therefore lead the wanted motion by the same amount.

    Args:
        config: Limits on joint speeds and accelerations.
        gain: Share of the position error that a motor corrects in one physics step.
        period: Control period (s).
        time_step: Duration of a physics step (s).

    Attributes:
        period: Control period (s), which may be changed before each command.
        max_speeds: (7,) joint speed limits, scaled by `config.speed_scale` (rad/s).
        velocity: (7,) joint velocities of the last `compute_motor_targets` (rad/s).
    """

    def __init__(self, config: ServoConfig, gain: float, period: float, time_step: float) -> None:
        self.config = config
        self.period = period
        self.max_speeds = config.speed_scale * np.array(config.max_joint_speeds)
        self._gain, self._time_step = gain, time_step
        self.velocity = np.zeros(len(config.max_joint_speeds))

    def reset(self) -> None:
        """Set the stored joint velocities of the last command to zero; call it at the start of an episode."""
        self.velocity = np.zeros(len(self.config.max_joint_speeds))

    def compute_goal_velocity(self, joints: Array, goal: Array) -> Array:
        """Return joint velocities (7,) in rad/s from joints towards a goal, (7,) in rad, low enough to stop there."""
        error = goal - joints
        # Speeds change once in a period, so braking starts half a period early.
        half = 0.5 * self.config.deceleration * self.period
        max_speed = float(np.sqrt(half**2 + 2.0 * self.config.deceleration * np.abs(error).max())) - half
        wanted = error / self.period
        fastest = float(np.abs(wanted).max())
        if fastest > max_speed:
            wanted = wanted * (max_speed / fastest)
        return wanted

    def limit_speed(self, velocity: Array) -> Array:
        """Return joint velocities (7,) in rad/s, all scaled down by one factor if any exceeds its speed limit."""
        excess = float((np.abs(velocity) / self.max_speeds).max())
        return velocity / excess if excess > 1.0 else velocity

    def limit_acceleration(self, velocity: Array, acceleration: float | None = None) -> Array:
        """Return joint velocities (..., 7) in rad/s, clipped to those that can be reached in one control period.

        They differ from `velocity` of the last command by at most the period times `acceleration` (rad/s^2), by default
        `config.max_acceleration`.
        """
        # Each joint is clipped on its own: with a common factor, a reversing joint would make the others overshoot.
        most = (self.config.max_acceleration if acceleration is None else acceleration) * self.period
        return np.asarray(self.velocity + np.clip(velocity - self.velocity, -most, most))

    def compute_motor_targets(self, joints: Array, velocity: Array, acceleration: float | None = None) -> Array:
        """Return motor position targets (7,) in rad that make the arm, now at joints (7,), move at a velocity (7,).

        The velocity (rad/s) is first clipped by `limit_acceleration`, and then stored in the attribute `velocity`.
        """
        self.velocity = self.limit_acceleration(velocity, acceleration)
        lead = 1.0 / (1.0 - (1.0 - self._gain) ** (self.period / self._time_step))
        return np.asarray(joints + lead * self.period * self.velocity)
