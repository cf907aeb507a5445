"""The Franka Panda in the world."""

from pathlib import Path

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.sim.body import Body
from handover_marl.sim.client import BulletClient, float32_list, load_urdf

#: The Panda collides with everything.
PANDA_MASK = -1


class Panda(Body):
    """The robot, at its start pose after loading.

    Attributes:
        hand_link: Number of the hand link, whose pose is the gripper pose.
        finger_links: Numbers of the left and right finger links.
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
        client.resetBasePositionAndOrientation(body_id, position, orientation)
        super().__init__(client, body_id, [config.motor] * PANDA_DOF)
        self.hand_link = self.link("panda_hand")
        self.finger_links = (self.link("panda_leftfinger"), self.link("panda_rightfinger"))
        self.collide(PANDA_MASK)
        self.place(float32_list(config.start_joints))
