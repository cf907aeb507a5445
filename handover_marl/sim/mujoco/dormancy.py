"""A scene in which nothing that the giver moves is near the robot: each goes its way, and nothing can touch.

The robot is simulated alone, and objects follow their targets as Bullet's motors make them do. A scene is dormant
from its start until something comes near, or is let go.
In which step that is follows from where things are then, so it does not depend on how steps are divided.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import OBJECT_DOF, TIME_STEP, PhysicsConfig
from handover_marl.sim.hand_path import HandPath
from handover_marl.sim.motion import Motion
from handover_marl.sim.mujoco.chain import XYZW, quaternions_wxyz
from handover_marl.sim.mujoco.lanes import Lane
from handover_marl.sim.mujoco.lone_robot import LoneRobot
from handover_marl.sim.object_path import ObjectPath

Array = npt.NDArray[np.float64]

_HALF = OBJECT_DOF // 2


class Dormancy:
    """The dormant part of an episode. Rows are those of the present motion; -1 is before its first.

    Args:
        lane: Where its state is written to.
        robot: Works out what its robot does.
        config: How things are driven.
        start: Where they are at first, a motion of one row.

    Attributes:
        items: The objects' ways.
    """

    def __init__(self, lane: Lane, robot: LoneRobot, config: PhysicsConfig, start: Motion) -> None:
        self.items = [ObjectPath(config.objects, joints) for joints in start.objects[0]]
        self._lane, self._robot = lane, robot
        self._path = robot.start(config.panda.start_joints)
        # The row of the path's first step, for how many of its steps nothing is near, and how many were before it.
        self._first, self._clear, self._passed = 0, 0, 0

    def turn_over(self, rows: int) -> None:
        """Go on to another motion after so many rows of the present one."""
        self._first -= rows

    def go(self, row: int, target: list[float], hand: HandPath) -> None:
        """Work out what the robot does from a row on, and for how long nothing is near it.

        Args:
            row: The first step to come.
            target: Nine joint targets (rad, m).
            hand: The hand, led by the present motion.

        Raises:
            SimulationError: The engine warned.
        """
        done = row - self._first
        self._first, self._passed = row, self._passed + done
        centers = np.stack([hand.centers(row), *(item.centers(row) for item in self.items)], axis=1)
        self._path = self._robot.go_on(self._path, done, target, len(centers), self._passed)
        scene = self._lane.scene
        radii = np.array([scene.hand_reach, *scene.object_reaches])
        near = scene.stage.clearance.near(self._path.balls, centers, radii)
        self._clear = int(near.argmax()) if near.any() else len(near)

    def ahead(self, row: int) -> int:
        """For how many steps from a row on nothing is near."""
        return self._clear - (row - self._first)

    def write(self, row: int) -> None:
        """Put the state after a row into the lane; objects' speeds are told when they are simulated."""
        lane, scene, done = self._lane, self._lane.scene, row + 1 - self._first
        lane.qpos[scene.robot_qpos], lane.qvel[scene.robot_qvel] = self._path.joints[done], self._path.speeds[done]
        lane.qpos[scene.object_qpos] = self._free(row).ravel()

    def wake(self, row: int) -> None:
        """Let the lane go on from the state after a row."""
        self.write(row)
        lane, now, before = self._lane, self._free(row), self._free(row - 1)
        speeds = np.empty((len(self.items), OBJECT_DOF))
        speeds[:, :_HALF] = now[:, :_HALF] - before[:, :_HALF]
        turned, earlier = (Rotation.from_quat(free[:, _HALF:][:, XYZW]) for free in (now, before))
        speeds[:, _HALF:] = (earlier.inv() * turned).as_rotvec()
        lane.qvel[lane.scene.object_qvel] = speeds.ravel() / TIME_STEP
        lane.tell_time(TIME_STEP * (self._passed + row + 1 - self._first))

    def _free(self, row: int) -> Array:
        """(m, 7) places (m) and quaternions wxyz of the objects after a row, or two rows before the first one."""
        joints = np.array([item.joints(row) for item in self.items])
        return np.concatenate([joints[:, :_HALF], quaternions_wxyz(joints[:, _HALF:])], axis=1)
