"""The Franka Panda in the world."""

from pathlib import Path

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK
from handover_marl.sim.bullet.body import Body, Start
from handover_marl.sim.bullet.client import BulletClient, float32_list

#: The Panda collides with everything.
PANDA_MASK = -1


class Panda(Body):
    """The robot, at its start pose after loading.

    Attributes:
        hand_link: Number of the hand link, whose pose is the gripper pose.
        finger_links: Numbers of the left and right finger links.

    Raises:
        SimulationError: The model cannot be loaded, has not nine moving joints, or lacks one of these links.
    """

    def __init__(self, client: BulletClient, urdf: Path, config: PandaConfig) -> None:
        self._start = float32_list(config.start_joints)
        base = float32_list([*config.base_position, *config.base_orientation])
        start = Start(self._start, base=base)
        flags = client.URDF_USE_SELF_COLLISION
        super().__init__(client, urdf, [config.motor] * PANDA_DOF, PANDA_MASK, start, flags=flags)
        self.hand_link = self.link(HAND_LINK)
        left, right = (self.link(name) for name in FINGER_LINKS)
        self.finger_links = (left, right)

    def withdraw(self) -> None:
        """Stand at the start pose and touch nothing, until the restart."""
        self.place(self._start)
        self.collide(0)

    def restart(self) -> None:
        """Be as after loading: at rest at the start pose, and forgotten by Bullet's contact cache."""
        self._target = None
        self.place(self._start)
        # Entering the broad phase anew drops all pairs and their remembered impulses, whose number and order
        # would show in the last bits of what follows.
        self.collide(PANDA_MASK)
