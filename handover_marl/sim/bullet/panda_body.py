"""The Franka Panda in the world."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF, PandaConfig
from handover_marl.models.panda import CAMERA_LINK, FINGER_LINKS, HAND_FROM_CAMERA_LINK, HAND_LINK
from handover_marl.models.poses import compose
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
        self._camera_link = self.link(CAMERA_LINK) if CAMERA_LINK in self._link_names else None
        self._camera_rgba: tuple[float, ...] | None = None

    def camera_pose(self) -> npt.NDArray[np.float32]:
        """World pose (7,) of the wrist camera's link, float32; where it would be on a Panda without one."""
        if self._camera_link is not None:
            pose: npt.NDArray[np.float32] = self.link_poses([self._camera_link])[0]
            return pose
        return compose(self.link_poses([self.hand_link])[0], HAND_FROM_CAMERA_LINK).astype(np.float32)

    @contextmanager
    def without_camera(self) -> Iterator[None]:
        """Leave the wrist camera's own body out of what is drawn."""
        if self._camera_link is None:
            yield
            return
        rgba = self._camera_rgba or self._read_camera_rgba()
        self._tint_camera((*rgba[:3], 0.0))
        try:
            yield
        finally:
            self._tint_camera(rgba)

    def _read_camera_rgba(self) -> tuple[float, ...]:
        shapes = self.client.getVisualShapeData(self.id)
        self._camera_rgba = next(tuple(shape[7]) for shape in shapes if shape[1] == self._camera_link)
        return self._camera_rgba

    def _tint_camera(self, rgba: tuple[float, ...]) -> None:
        self.client.changeVisualShape(self.id, self._camera_link, rgbaColor=rgba)

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
