"""Sleeping MuJoCo worlds: while no body is near the robot, robot and objects move separately.

The robot is simulated alone, and objects follow their reference as Bullet's motors would move them.
A world sleeps from the start of a scene until a body comes near the robot or the target object is
released. The step in which the world wakes depends on the positions of the bodies only, not on how
steps are divided into calls.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from handover_marl.config import OBJECT_DOF, TIME_STEP, ObjectConfig
from handover_marl.simulation.mujoco.engine import check_warnings
from handover_marl.simulation.mujoco.models.scene_model import RobotOnlyModel, SceneModel
from handover_marl.simulation.mujoco.quaternions import XYZW, wxyz_from_euler
from handover_marl.simulation.reference_tracking import BodyTrajectory, ReferenceMotion, list_object_motors

Array = npt.NDArray[np.float64]

# State that determines the robot's motion, apart from its target.
_STATE = ("qpos", "qvel", "qacc_warmstart")
# Number of cached rollouts. One of 200 steps takes 100 kB; waiting for two seconds takes ten.
_CACHE_SIZE = 256
_HALF = OBJECT_DOF // 2


@dataclass(frozen=True, eq=False)
class RobotTrajectory:
    """Motion of the robot in n physics steps: the state before the first and after each step.

    Attributes:
        joints: Joint positions (n + 1, 9) (rad, m).
        velocities: Joint velocities (n + 1, 9) (rad/s, m/s).
        warm_start: Joint accelerations (n + 1, 9) with which the constraint solver starts the next
            step.
        sphere_centers: Centers (n, b, 3) of the bounding spheres of the robot's links before each
            step (m).
    """

    joints: Array
    velocities: Array
    warm_start: Array
    sphere_centers: Array


class RobotOnlySimulation:
    """Simulation of the robot without hand and objects in MuJoCo, with a cache of rollouts.

    Most episodes start with the same motion from the initial pose to the waiting pose. Equal states
    and targets give bit-equal motions, so the cache does not change results.

    Args:
        model: Model of robot and table.
    """

    def __init__(self, model: RobotOnlyModel) -> None:
        self._model = model
        self._batch, self._data = Batch(model.model, 1, nthread=1), mujoco.MjData(model.model)
        self._state = [self._batch.bind(name) for name in _STATE]
        self._simulate = functools.lru_cache(_CACHE_SIZE)(self._simulate_uncached)

    def compute_body_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute the world positions (b, 3) (m) and quaternions wxyz (b, 4) of all bodies, valid until the next call.

        Args:
            joints: Nine joint positions of the robot (rad, m).
        """
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model.model, self._data)
        return self._data.xpos, self._data.xquat

    def make_resting_trajectory(self, joints: npt.ArrayLike) -> RobotTrajectory:
        """Return the trajectory, still without steps, of a robot at rest at joint positions (9,) (rad, m)."""
        position = np.array([joints], dtype=np.float64)
        return RobotTrajectory(position, np.zeros(position.shape), np.zeros(position.shape), np.zeros((0, 0, 3)))

    def simulate(self, trajectory: RobotTrajectory, row: int, target: list[float], steps: int) -> RobotTrajectory:
        """Simulate the robot from a row of its trajectory on, and return the new trajectory.

        Args:
            trajectory: Previous motion of the robot.
            row: Row of the previous motion to start from.
            target: Nine joint targets of the robot (rad, m).
            steps: Number of steps to simulate.

        Raises:
            SimulationError: MuJoCo warned; the robot's state is invalid.
        """
        state = np.stack([trajectory.joints[row], trajectory.velocities[row], trajectory.warm_start[row], target])
        return self._simulate(state.tobytes(), steps)

    def _simulate_uncached(self, content: bytes, steps: int) -> RobotTrajectory:
        state = np.frombuffer(content).reshape(len(_STATE) + 1, -1)
        batch = self._batch
        for array, part in zip(self._state, state[:-1], strict=True):
            array[0] = part
        batch.warning[0] = 0
        controls = np.repeat(state[None, -1:], steps, axis=1)
        rollout = batch.rollout(steps, controls, int(mujoco.mjtState.mjSTATE_CTRL), (*_STATE, "site_xpos"))
        check_warnings(batch)
        joints, velocities, warm_start = (
            np.concatenate([first[None], rollout[name][0]]) for first, name in zip(state[:-1], _STATE, strict=True)
        )
        return RobotTrajectory(joints, velocities, warm_start, rollout["site_xpos"][0][:, self._model.spheres])


class SleepState:
    """Trajectories of robot and objects in a sleeping MuJoCo world.

    Row k is step k of the current reference motion; row -1 is the state before its first step.

    Args:
        scene: Model of the scene.
        robot: Simulation of the robot without hand and objects.
        motors: Motors of the objects.
        start: Reference motion of one row: the initial state of the objects.
        robot_joints: Nine joint positions of the robot at the start (rad, m).

    Attributes:
        objects: Trajectories of the objects.
    """

    def __init__(
        self,
        scene: SceneModel,
        robot: RobotOnlySimulation,
        motors: ObjectConfig,
        start: ReferenceMotion,
        robot_joints: Sequence[float],
    ) -> None:
        self.objects = [BodyTrajectory(list_object_motors(motors), joints) for joints in start.objects[0]]
        self._scene, self._simulation = scene, robot
        self._robot = robot.make_resting_trajectory(robot_joints)
        # Row of the robot trajectory's first step, and number of its steps without a body near it.
        self._first, self._free = 0, 0

    def advance_rows(self, rows: int) -> None:
        """Start to count rows from the next reference motion, which follows the current one.

        Args:
            rows: Number of simulated rows of the current reference motion.
        """
        self._first -= rows

    def simulate_robot(self, row: int, target: list[float], hand: BodyTrajectory) -> None:
        """Simulate the robot alone from a step on, and store the first step with a body near it.

        A body is near if the spheres around it and around the robot's links may touch.

        Args:
            row: First step of the reference motion to simulate.
            target: Nine joint targets of the robot (rad, m).
            hand: Trajectory of the human hand under the current reference motion.

        Raises:
            SimulationError: MuJoCo warned; the robot's state is invalid.
        """
        done, self._first = row - self._first, row
        centers = np.stack([body.predict_positions(row) for body in [hand, *self.objects]], axis=1)
        self._robot = self._simulation.simulate(self._robot, done, target, len(centers))
        radii = np.array([self._scene.hand_reach, *self._scene.object_reaches])
        near = self._scene.robot_only.motion_bounds.is_near(self._robot.sphere_centers, centers, radii)
        self._free = int(near.argmax()) if near.any() else len(near)

    def count_free_steps(self, row: int) -> int:
        """Return the number of steps from `row` on before a body comes near the robot."""
        return self._free - (row - self._first)

    def write_state(self, row: int, qpos: Array, qvel: Array) -> None:
        """Write the state after step `row`, but for the velocities of the objects, to the arrays of a world."""
        scene, done = self._scene, row + 1 - self._first
        qpos[scene.robot_qpos], qvel[scene.robot_qvel] = self._robot.joints[done], self._robot.velocities[done]
        qpos[scene.object_qpos] = self._compute_object_poses(row).ravel()

    def _compute_object_poses(self, row: int) -> Array:
        """Return the poses (m, 7) of m objects after step `row`: xyz (m), quaternions wxyz."""
        joints = np.array([item.get_joints(row) for item in self.objects])
        return np.concatenate([joints[:, :_HALF], wxyz_from_euler(joints[:, _HALF:])], axis=1)

    def compute_object_velocities(self, row: int) -> Array:
        """Return the velocities (m, 6) of m objects after step `row` of the reference motion.

        Linear velocities are in the world frame (m/s), angular ones in the object's (rad/s).
        """
        now, before = self._compute_object_poses(row), self._compute_object_poses(row - 1)
        change = np.empty((len(self.objects), OBJECT_DOF))
        change[:, :_HALF] = now[:, :_HALF] - before[:, :_HALF]
        rotation, previous = (Rotation.from_quat(poses[:, _HALF:][:, XYZW]) for poses in (now, before))
        change[:, _HALF:] = (previous.inv() * rotation).as_rotvec()
        return change / TIME_STEP
