"""The Franka Panda in the world."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.geometry import IDENTITY, compose
from handover_marl.sim.body import Body, inertial_offset
from handover_marl.sim.client import BulletClient, float32_list, load_urdf

#: The Panda collides with everything.
PANDA_MASK = -1


def place_base(
    client: BulletClient, body_id: int, position: Sequence[float], orientation: Sequence[float]
) -> None:
    """Put the base link's frame at a world pose (m, quaternion xyzw)."""
    offset = inertial_offset(client, body_id, -1)
    if np.array_equal(offset, IDENTITY):
        client.resetBasePositionAndOrientation(body_id, position, orientation)
    else:
        pose = compose(np.array([*position, *orientation]), offset)
        client.resetBasePositionAndOrientation(body_id, pose[:3].tolist(), pose[3:].tolist())


class Panda(Body):
    """The robot, at its start pose after loading.

    Attributes:
        hand_link: Number of the hand link, whose pose is the gripper pose.
        finger_links: Numbers of the left and right finger links.

    Raises:
        SimulationError: The model cannot be loaded, has not nine moving joints, or lacks one of these links.
    """

    def __init__(self, client: BulletClient, urdf: Path, config: PandaConfig) -> None:
        position = float32_list(config.base_position)
        orientation = float32_list(config.base_orientation)
        body_id = load_urdf(
            client,
            urdf,
            basePosition=position,
            baseOrientation=orientation,
            useFixedBase=True,
            flags=client.URDF_USE_SELF_COLLISION,
        )
        # loadURDF and this call round the base pose differently (1e-16); the reference does both.
        place_base(client, body_id, position, orientation)
        super().__init__(client, body_id, [config.motor] * PANDA_DOF)
        self.hand_link = self.link("panda_hand")
        self.finger_links = (self.link("panda_leftfinger"), self.link("panda_rightfinger"))
        self.collide(PANDA_MASK)
        self._start = float32_list(config.start_joints)
        self.place(self._start)

    def restart(self) -> None:
        """Be as after loading: at rest at the start pose, and forgotten by Bullet's contact cache."""
        self._target = None
        self.place([0.0] * len(self.joints))
        # Entering the broad phase anew drops all pairs and their remembered impulses, whose number and order
        # would show in the last bits of what follows.
        self.collide(PANDA_MASK)
        self.place(self._start)
