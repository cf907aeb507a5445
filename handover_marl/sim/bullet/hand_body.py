"""The human hand: a base on six joints and fifteen finger joints of three axes each."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig, MotorConfig
from handover_marl.sim.bullet.body import Body, Start, Surface
from handover_marl.sim.bullet.client import BulletClient

#: The hand's own collision group: of all bodies, only the Panda's mask admits it.
HAND_MASK = 2**22

#: Joints that carry the whole hand: three that slide, three that turn.
BASE_JOINTS = 6
_WRIST_LINK = 6


def hand_motors(config: HandConfig) -> list[MotorConfig]:
    """The motors of the 51 joints."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3 + [config.finger_motor] * 45


def keypoint_links(joints: Sequence[int]) -> list[int]:
    """Numbers of the wrist's link and of the 15 finger joints' first links, given those of the moving joints.

    Every third finger joint is the first of its three axes; its link frame is the joint's origin.
    """
    return [_WRIST_LINK, *joints[BASE_JOINTS::3]]


class Hand(Body):
    """A hand at the pose it appears with."""

    def __init__(self, client: BulletClient, urdf: Path, start: list[float], config: HandConfig) -> None:
        surface = Surface(config.friction, config.restitution, config.base_damping)
        super().__init__(client, urdf, hand_motors(config), HAND_MASK, Start(start), surface)
        self._keypoint_links = keypoint_links(self.joints)

    def keypoints(self) -> npt.NDArray[np.float32]:
        """(16, 3) world positions (m) of the wrist and of the 15 finger-joint origins, float32.

        Order as in MANO: wrist, then index, middle, little, ring finger and thumb, three joints each from
        the knuckle outwards.
        """
        return self.link_poses(self._keypoint_links)[:, :3]

    def remove(self) -> None:
        """Take the hand out of the world."""
        self.client.removeBody(self.id)
