"""An arm where it stands: its hand, its inverse kinematics and its velocities in the world's frame."""

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS, PandaConfig
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.models.poses import compose, inverse, poses_from_rotations
from handover_marl.planning.inverse_kinematics import solve

Array = npt.NDArray[np.float64]

# Regularises velocities near singular configurations (m^2).
_DAMPING = 1e-3


class ArmInWorld:
    """Kinematics of an arm in the world's frame.

    Args:
        arm: The arm.
        base: (7,) pose of its base.
        limits: Lowest and highest joints, (7,) each (rad).

    Attributes:
        arm: The arm.
        limits: Lowest and highest joints.
        base: (7,) pose of its base.
    """

    def __init__(self, arm: Arm, base: Array, limits: tuple[Array, Array]) -> None:
        self.arm, self.limits = arm, limits
        self.base, self._base_from_world = base, inverse(base)
        self._turn = Rotation.from_quat(base[3:]).as_matrix()

    @classmethod
    def of_panda(cls, urdf: Path, panda: PandaConfig, padding: float = 0.0) -> "ArmInWorld":
        """A Panda where it stands.

        Args:
            urdf: Its model.
            panda: Where it stands.
            padding: Its joint limits are narrowed by so much on each side (rad).

        Raises:
            SimulationError: The model cannot be read.
        """
        limits = np.array(LOWER_LIMITS[:ARM_JOINTS]) + padding, np.array(UPPER_LIMITS[:ARM_JOINTS]) - padding
        base = np.array([*panda.base_position, *panda.base_orientation])
        return cls(Arm(read_tree(urdf)), base, limits)

    def hands(self, joints: Array) -> Array:
        """(n, 7) poses of the hand link for configurations (n, 7)."""
        chain = self.arm.chain(joints)
        return compose(self.base, poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0)))

    def hand(self, joints: Array) -> Array:
        """(7,) pose of the hand link for one configuration (7,)."""
        found: Array = self.hands(joints[None])[0]
        return found

    def frames(self, joints: Array) -> tuple[Array, Array]:
        """(n, 7, 3) origins (m) and (n, 7, 3, 3) rotations of the turning links for configurations (n, 7)."""
        chain = self.arm.chain(joints)
        origins = chain.origins[:-1].transpose(2, 0, 1) @ self._turn.T + self.base[:3]
        return origins, self._turn @ chain.rotations[:-1].transpose(3, 0, 1, 2)

    def jacobian(self, joints: Array) -> Array:
        """(6, 7): how the hand's origin moves (m/rad) and turns with each joint at one configuration (7,)."""
        local = self.arm.jacobian(self.arm.chain(joints[None]))[..., 0]
        found: Array = np.concatenate([self._turn @ local[:3], self._turn @ local[3:]])
        return found

    def point_jacobian(self, joints: Array, point: Array, link: int) -> Array:
        """(3, 7): how a point (3,) of the world that is fixed to a turning link, from 0, moves with each joint."""
        chain = self.arm.chain(joints[None])
        axes = chain.rotations[:-1, :, 2, 0] @ self._turn.T
        origins = chain.origins[:-1, :, 0] @ self._turn.T + self.base[:3]
        columns = np.cross(axes, point - origins)
        columns[link + 1 :] = 0.0
        found: Array = columns.T
        return found

    def solve(
        self, poses: Array, seeds: Array, iterations: int, tolerance: float = 1e-3
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Configurations (n, 7) at poses (n, 7) of the hand link, from seeds (n, 7), and whether they are there (n,).

        Args:
            poses: Of the hand link.
            seeds: Where each search starts (rad).
            iterations: Steps at most.
            tolerance: On every component of the remaining way (m) and rotation vector (rad).
        """
        local = compose(self._base_from_world, poses)
        turns = Rotation.from_quat(local[:, 3:]).as_matrix()
        return solve(self.arm, local[:, :3], turns, seeds, self.limits, tolerance, iterations)

    def velocity(self, joints: Array, linear: Array, angular: Array, turn_weight: float, period: float) -> Array:
        """(7,) joint velocities (rad/s) that move the hand, with joints that reach their limits left out.

        Args:
            joints: (7,) where the arm is.
            linear: (3,) wanted velocity of the hand's origin (m/s).
            angular: (3,) wanted angular velocity of the hand (rad/s).
            turn_weight: Weight of the angular velocity against the linear one (m/rad).
            period: How long the velocity is to last (s).
        """
        weights = np.array([1.0, 1.0, 1.0, turn_weight, turn_weight, turn_weight])
        rows = weights[:, None] * self.jacobian(joints)
        wanted = weights * np.concatenate([linear, angular])
        free = np.ones(len(joints), dtype=bool)
        for _ in itertools.repeat(None, len(joints)):
            moving = rows * free
            found: Array = moving.T @ np.linalg.solve(moving @ moving.T + _DAMPING * np.eye(6), wanted)
            soon = joints + period * found
            over = ((soon < self.limits[0]) & (found < 0.0)) | ((soon > self.limits[1]) & (found > 0.0))
            if not (free & over).any():
                return found
            free &= ~over
        return np.zeros(len(joints))
