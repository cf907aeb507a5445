"""The human hand: a base on six joints and fifteen finger joints of three axes each."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig
from handover_marl.sim.bullet.body import Body, Start, Surface
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.hand_path import hand_motors, keypoint_links

#: The hand's own collision group: of all bodies, only the Panda's mask admits it.
HAND_MASK = 2**22


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
