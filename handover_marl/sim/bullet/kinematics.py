"""Kinematics of the Panda for receivers, in a physics server of its own."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS, PandaConfig
from handover_marl.models.arm_range import ArmRange
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import HAND_LINK
from handover_marl.models.poses import IDENTITY, compose, inverse, rotation_angle
from handover_marl.sim.bullet.body import inertial_offset, place_base
from handover_marl.sim.bullet.client import connect, load_urdf

_POSITION_TOLERANCE = 1e-3
_ANGLE_TOLERANCE = 0.1
_MAX_ROUNDS = 1000


class PandaKinematics:
    """Inverse kinematics as HandoverSim's baselines compute it.

    Args:
        urdf: The Panda's model file.
        config: Where the Panda stands.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._body = load_urdf(self._client, urdf)
        # Unlike in the world the base is not fixed and its pose stays double: the answers depend on both.
        place_base(self._client, self._body, [*config.base_position, *config.base_orientation])
        names = [
            self._client.getJointInfo(self._body, joint)[12].decode()
            for joint in range(self._client.getNumJoints(self._body))
        ]
        self._hand_link = names.index(HAND_LINK)
        hand_from_mass = inertial_offset(self._client, self._body, self._hand_link)
        self._mass_is_hand = np.array_equal(hand_from_mass, IDENTITY)
        self._mass_from_hand = inverse(hand_from_mass)
        world_from_base = np.array([*config.base_position, *config.base_orientation])
        self._range = ArmRange(read_tree(urdf), self._hand_link, world_from_base)

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> npt.NDArray[np.float64] | None:
        """Arm joints that bring the hand link to a pose, or None if the search does not converge.

        Repeats Bullet's damped steps until the hand is within 1 mm and 0.1 rad of the target. Joint limits are
        not respected, as in the reference.

        Args:
            start: Nine joint positions to start from (rad, m); fingers are ignored.
            position: World position of the hand link (m).
            orientation: World orientation, quaternion xyzw; None leaves it free.

        Returns:
            (7,) arm joint positions (rad).
        """
        target = np.asarray(position, dtype=np.float64)
        if self._range.excludes(target, orientation, 2.0 * _POSITION_TOLERANCE, 1.1 * _ANGLE_TOLERANCE):
            # The search would end so too, after minutes for an object that stays out of reach.
            return None
        rest = [float(value) for value in np.asarray(start)]
        options = {} if orientation is None else {"targetOrientation": np.asarray(orientation, np.float64).tolist()}
        self._place(rest)
        for _ in range(_MAX_ROUNDS):
            rest = self._client.calculateInverseKinematics(
                self._body, self._hand_link, target.tolist(), restPoses=rest, **options
            )
            self._place(rest)
            hand = self._hand_pose()
            if np.linalg.norm(hand[:3] - target) < _POSITION_TOLERANCE and (
                orientation is None or rotation_angle(hand[3:], orientation) < _ANGLE_TOLERANCE
            ):
                return np.array(rest[:ARM_JOINTS])
        return None

    def _hand_pose(self) -> npt.NDArray[np.float64]:
        # Items 0 and 1 are the centre of mass in double; Bullet rounds the link frame itself to float32.
        position, orientation = self._client.getLinkState(self._body, self._hand_link)[:2]
        world_from_mass = np.array([*position, *orientation])
        return world_from_mass if self._mass_is_hand else compose(world_from_mass, self._mass_from_hand)

    def _place(self, joints: list[float]) -> None:
        for joint in range(ARM_JOINTS):
            self._client.resetJointState(self._body, joint, joints[joint])
