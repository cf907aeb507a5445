"""An object that follows its targets by kinematics until the Panda comes near, and is simulated from then on."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import ObjectConfig
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.sim.bullet.body import Start
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.object_body import Object
from handover_marl.sim.object_path import ObjectPath


class DormantObject:
    """One object of a scene.

    Args:
        client: The physics server.
        urdf: Its model file.
        class_id: YCB class number.
        start: (6,) its joints at first (m, rad).
        config: How its joints are driven.

    Attributes:
        urdf: Its model file.
        body: The simulated object, once it is awake.
        reach: How far it reaches from its origin (m).
    """

    def __init__(
        self,
        client: BulletClient,
        urdf: Path,
        class_id: int,
        start: npt.NDArray[np.float32],
        config: ObjectConfig,
    ) -> None:
        self.urdf = urdf
        self.body: Object | None = None
        self.tree = read_tree(urdf)
        self.reach = self.tree.reach(len(self.tree.joints) - 1, link_spheres(urdf))
        self._client, self._class_id, self._config = client, class_id, config
        self._path = ObjectPath(config, start)

    def lead(self, targets: npt.NDArray[np.float32]) -> None:
        """Work out where it will be in the coming steps, given (n, 6) targets."""
        self._targets: list[list[float]] = targets.tolist()
        if self.body is None:
            self._path.lead(targets)

    @property
    def awake(self) -> bool:
        """Whether it is simulated."""
        return self.body is not None

    def centers(self, row: int) -> npt.NDArray[np.float64]:
        """(n - row, 3) where its origin will be after the steps from `row` on (m), while it sleeps."""
        return self._path.centers(row)

    def wake(self, row: int) -> None:
        """Put it into Bullet before step `row` of the present motion is simulated."""
        if self.awake:
            return
        start = Start(self._path.joints(row - 1).tolist(), self._path.speeds(row - 1).tolist())
        self.body = Object(self._client, self.urdf, self._class_id, start, self._config)

    def drive(self, row: int) -> None:
        """Lead the simulated object to the target of step `row`."""
        if self.body is not None:
            self.body.drive(self._targets[row])

    def dof(self, row: int) -> npt.NDArray[np.float32]:
        """(6,) its joints after step `row`, -1 being before the first (m, rad)."""
        return self._path.joints(row).astype(np.float32) if self.body is None else self.body.joint_positions()

    def pose(self, row: int) -> npt.NDArray[np.float32]:
        """(7,) its world pose after step `row`, xyz (m) and quaternion xyzw."""
        if self.body is not None:
            return self.body.pose()
        last = len(self.tree.joints) - 1
        pose: npt.NDArray[np.float32] = self.tree.poses(self._path.joints(row)[None], [last])[0, 0].astype(np.float32)
        return pose

    def remove(self) -> None:
        """Take it out of the world."""
        if self.body is not None:
            self._client.removeBody(self.body.id)
            self.body = None
