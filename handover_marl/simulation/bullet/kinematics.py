"""Inverse kinematics of the Panda by PyBullet; each solver has its own physics client. Quaternions are xyzw."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF, PandaConfig
from handover_marl.geometry.arm import IkSolver, ReachabilityBound
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.geometry.poses import invert_pose, transform_points
from handover_marl.geometry.rotations import compute_rotation_angles, multiply_quaternions
from handover_marl.simulation.bullet.bodies import INERTIAL_POSE, PandaBody, reset_base
from handover_marl.simulation.bullet.client import connect, load_urdf

Array = npt.NDArray[np.float64]

# HandoverSim's tolerances of a converged solution (m, rad), and its limit of iterations.
_POSITION_TOLERANCE = 1e-3
_ANGLE_TOLERANCE = 0.1
_MAX_ROUNDS = 1000
_ARM_JOINTS = tuple(range(ARM_DOF))


class BulletIKStep:
    """Inverse kinematics of the Panda by one call of PyBullet, which may not converge.

    The Panda is loaded as in `ExactWorld`, so that the solution equals, bit for bit, the solution of a query in the
    physics client of `ExactWorld` with the same joints. Bullet makes at most 20 damped least-squares steps, stops at
    0.1 mm, and uses no joint limits and no rest pose. Queries are independent of each other.

    Args:
        urdf: Model of the Panda.
        config: Base pose of the Panda.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._panda = PandaBody(self._client, urdf, config)
        self._base = (config.base_position, config.base_orientation)
        self._base_from_world = self._client.invertTransform(*self._base)

    def solve_step(self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: Array | None = None) -> Array:
        """Return joint positions that move the hand link to a world pose, or nearer to that pose.

        Args:
            joints: Nine joint positions to start from (rad, m), preferably unrounded.
            position: (3,) world position of the hand link (m).
            orientation: (4,) world orientation, quaternion xyzw; None leaves it free.

        Returns:
            (9,) joint positions (rad, m); finger positions are meaningless.
        """
        self._panda.reset_joints(np.asarray(joints, dtype=np.float64).tolist())
        target = [np.asarray(part, dtype=np.float64).tolist() for part in (position, orientation) if part is not None]
        return np.array(self._client.calculateInverseKinematics(self._panda.id, self._panda.hand_link, *target))

    def to_base_frame(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """Transform a pose (7,) (quaternion xyzw) from the world to the robot's base frame, rounded to float32."""
        return self._multiply(self._base_from_world, (world_from_hand[:3].tolist(), world_from_hand[3:].tolist()))

    def to_world_frame(self, base_from_hand: Array) -> Array:
        """Transform a pose (7,) (quaternion xyzw) from the robot's base frame to the world, rounded to float32."""
        return self._multiply(self._base, (base_from_hand[:3].tolist(), base_from_hand[3:].tolist()))

    def _multiply(self, first: tuple[object, object], second: tuple[object, object]) -> Array:
        position, orientation = self._client.multiplyTransforms(*first, *second)
        return np.array([*position, *orientation])


class BulletIKSolver(IkSolver):
    """Iterative inverse kinematics of the Panda by PyBullet, as in HandoverSim's baselines; see `BulletIKStep`."""

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._body = load_urdf(self._client, urdf)
        # Unlike in the world the base is not fixed and its pose is not rounded: the results depend on both.
        world_from_base = np.array([*config.base_position, *config.base_orientation])
        reset_base(self._client, self._body, world_from_base)
        self._hand_link = read_tree(urdf).get_link(HAND_LINK)
        # Bullet reports link states at the center of mass.
        hand_from_mass = np.concatenate(self._client.getDynamicsInfo(self._body, self._hand_link)[INERTIAL_POSE])
        self._mass_from_hand = invert_pose(hand_from_mass)
        self._reachability = ReachabilityBound(world_from_base)

    def solve_many(
        self, starts: npt.NDArray[np.floating], positions: Array, orientations: Array | None = None
    ) -> Array:
        """Return arm joints (n, 7) in rad that move the hand link to n world poses; rows without convergence are nan.

        Arguments are as in `IkSolver.solve_many`. For one pose after another, Bullet's damped steps are repeated until
        the hand link is within 1 mm and 0.1 rad of the pose. Joint limits are ignored, as in HandoverSim.
        """
        found, targets = np.full((len(starts), ARM_DOF), np.nan), positions.astype(np.float64)
        # For a pose out of reach, the iteration would not converge, but take minutes.
        tolerances = 2.0 * _POSITION_TOLERANCE, 1.1 * _ANGLE_TOLERANCE
        for row in np.flatnonzero(~self._reachability.is_unreachable(targets, orientations, *tolerances)).tolist():
            orientation = None if orientations is None else orientations[row]
            goal = [np.asarray(part, np.float64).tolist() for part in (targets[row], orientation) if part is not None]
            self._reset_arm(starts[row].astype(np.float64).tolist())
            for _ in range(_MAX_ROUNDS):
                joints = self._client.calculateInverseKinematics(self._body, self._hand_link, *goal)
                self._reset_arm(joints)
                if self._is_hand_at(targets[row], orientation):
                    found[row] = joints[:ARM_DOF]
                    break
        return found

    def _reset_arm(self, joints: Sequence[float]) -> None:
        # One call for all joints: after each call Bullet updates all links.
        self._client.resetJointStatesMultiDof(self._body, _ARM_JOINTS, [[joint] for joint in joints[:ARM_DOF]])

    def _is_hand_at(self, target: Array, orientation: npt.ArrayLike | None) -> bool:
        # Items 0 and 1 are the center of mass in double precision; Bullet rounds link frames to float32.
        position, rotation = self._client.getLinkState(self._body, self._hand_link)[:2]
        hand = transform_points([*position, *rotation], self._mass_from_hand[:3])
        if np.linalg.norm(hand - target) >= _POSITION_TOLERANCE:
            return False
        turned = multiply_quaternions(rotation, self._mass_from_hand[3:])
        return orientation is None or bool(compute_rotation_angles(turned, orientation) < _ANGLE_TOLERANCE)
