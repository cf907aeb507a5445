"""The objects on the table, each on a chain of three prismatic and three continuous joints."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import ObjectConfig
from handover_marl.models.ycb import SCENE_CLASSES
from handover_marl.sim.bullet.body import Body, Start
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.hand_body import HAND_MASK
from handover_marl.sim.object_path import object_motors

#: A released object collides with everything but the hand.
RELEASED_MASK = -1 - HAND_MASK


class Object(Body):
    """One object, driven along its trajectory until it is released.

    Attributes:
        link_id: Number of the link that carries the mesh; its pose is the object's pose.
    """

    def __init__(self, client: BulletClient, urdf: Path, class_id: int, start: Start, config: ObjectConfig) -> None:
        super().__init__(client, urdf, object_motors(config), object_mask(class_id), start)
        self.link_id = self.n_links - 1

    def pose(self) -> npt.NDArray[np.float32]:
        """World pose (7,) of the object, xyz (m) and quaternion xyzw, float32."""
        pose: npt.NDArray[np.float32] = self.link_poses([self.link_id])[0]
        return pose

    def release(self) -> None:
        """Let it move freely and touch table and other objects from now on."""
        self.collide(RELEASED_MASK)
        self.go_limp()


def object_mask(class_id: int) -> int:
    """Collision group of a class: each has its own, so that objects touch the robot but not each other."""
    return int(2 ** (SCENE_CLASSES.index(class_id) + 1))
