"""Sleeping MuJoCo worlds: while no body is near the robot, robot and objects are simulated separately.

The robot is simulated alone, and objects follow their references as Bullet's motors would move them. A world sleeps
from the start of a scene until a body comes near the robot or the target object is released; then it wakes. The step in
which it wakes depends only on the positions of the bodies, not on how steps are divided into calls.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from handover_marl.config import OBJECT_DOF, TIME_STEP, ObjectConfig
from handover_marl.simulation.mujoco.engine import XYZW, check_warnings, wxyz_from_euler
from handover_marl.simulation.mujoco.models.scene_model import RobotOnlyModel, SceneModel
from handover_marl.simulation.reference_tracking import BodyTrajectory, ReferenceMotion, list_object_motors

Array = npt.NDArray[np.float64]

# State that determines the robot's motion, apart from its target.
_STATE = ("qpos", "qvel", "qacc_warmstart")
# Number of cached rollouts. A rollout of 200 steps takes 100 kB; two seconds take ten rollouts.
_CACHE_SIZE = 256
#: Largest number of worlds that are simulated in one call; sensor data of more do not fit into the CPU's cache.
MAX_WORLDS = 32
_HALF = OBJECT_DOF // 2


@dataclass(frozen=True, eq=False)
class RobotTrajectory:
    """Motion of the robot in n physics steps: the state before the first and after each step.

    Attributes:
        joints: Joint positions (n + 1, 9) (rad, m).
        velocities: Joint velocities (n + 1, 9) (rad/s, m/s).
        warm_start: Joint accelerations (n + 1, 9) with which the constraint solver starts the next step.
        sphere_centers: World centers (n, b, 3) of the bounding spheres of the robot's links before each step (m).
    """

    joints: Array
    velocities: Array
    warm_start: Array
    sphere_centers: Array


class RobotOnlySimulation:
    """Simulation of the robot without human hand and objects in MuJoCo, with a cache of trajectories.

    Most episodes start with the same motion from the initial pose to the waiting pose. Equal states and targets give
    bit-equal motions, so the cache does not change results.

    Args:
        model: Model of robot and table.
    """

    def __init__(self, model: RobotOnlyModel) -> None:
        self._model = model
        self._batch, self._data = Batch(model.model, MAX_WORLDS, nthread=1), mujoco.MjData(model.model)
        self._state = [self._batch.bind(name) for name in _STATE]
        self._cache: OrderedDict[tuple[bytes, int], RobotTrajectory] = OrderedDict()

    def compute_body_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute world positions (b, 3) in m and quaternions wxyz (b, 4) of the b bodies at nine joints (rad, m).

        The arrays are valid until the next call.
        """
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model.model, self._data)
        return self._data.xpos, self._data.xquat

    def simulate(
        self, starts: Sequence[tuple[RobotTrajectory, int]], targets: Sequence[list[float]], steps: int
    ) -> list[RobotTrajectory]:
        """Simulate up to 32 robots, and return their trajectories.

        Args:
            starts: For each robot, a trajectory, and the index of its state from which the robot starts.
            targets: Nine joint targets of each robot (rad, m).
            steps: Number of steps to simulate.
        """
        states = [
            np.stack([motion.joints[row], motion.velocities[row], motion.warm_start[row], target])
            for (motion, row), target in zip(starts, targets, strict=True)
        ]
        keys = [(state.tobytes(), steps) for state in states]
        new = {key: state for key, state in zip(keys, states, strict=True) if key not in self._cache}
        if new:
            self._cache.update(zip(new, self._simulate(np.stack(list(new.values())), steps), strict=True))
        for key in keys:
            self._cache.move_to_end(key)
        found = [self._cache[key] for key in keys]
        while len(self._cache) > _CACHE_SIZE:
            self._cache.popitem(last=False)
        return found

    def _simulate(self, states: Array, steps: int) -> list[RobotTrajectory]:
        batch, count = self._batch, len(states)
        for number, array in enumerate(self._state):
            array[:count] = states[:, number]
        batch.warning[:count] = 0
        controls = np.repeat(states[:, -1:], steps, axis=1)
        records, kind = (*_STATE, "site_xpos"), int(mujoco.mjtState.mjSTATE_CTRL)
        rollout = batch.rollout(steps, controls, kind, records, ids=np.arange(count))
        check_warnings(batch, count)
        motions = [
            np.concatenate([states[:, number, None], rollout[name]], axis=1) for number, name in enumerate(_STATE)
        ]
        centers = rollout["site_xpos"][:, :, self._model.spheres]
        return [RobotTrajectory(*(part[number] for part in (*motions, centers))) for number in range(count)]


class SleepState:
    """State of a sleeping MuJoCo world: separate trajectories of robot and objects.

    Row k is step k of the current reference motion; row -1 is the state before its first step.

    Args:
        scene: Model of the scene.
        robot: Simulation of the robot without hand and objects.
        motors: Motors of the objects.
        start: Reference motion of one row: the initial state of the objects.
        robot_joints: Nine joint positions of the robot at the start (rad, m).

    Attributes:
        objects: Trajectories of the objects, the target first.
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
        position, rest = np.array([robot_joints], dtype=np.float64), np.zeros((1, len(robot_joints)))
        self._robot = RobotTrajectory(position, rest, rest, np.zeros((0, 0, 3)))
        # Row of the robot trajectory's first step, and number of its steps without a body near it.
        self._first_row, self._n_free_steps = 0, 0

    def advance_rows(self, rows: int) -> None:
        """Renumber rows for the next reference motion, which begins after `rows` steps of the current one."""
        self._first_row -= rows

    @staticmethod
    def simulate_robots(
        worlds: "Sequence[SleepState]",
        rows: Sequence[int],
        targets: Sequence[list[float]],
        hands: Sequence[BodyTrajectory],
    ) -> None:
        """Simulate the robots alone to the end of the reference motions; store when a body is first near each robot.

        A body is near if the sphere around it is less than 3 cm from a sphere around a link of the robot.

        Args:
            worlds: Sleeping worlds, at most 32.
            rows: Index of the first step to simulate in the reference motion of each world.
            targets: Nine joint targets of each robot (rad, m).
            hands: Trajectory of each human hand under its current reference motion.
        """
        groups: dict[tuple[RobotOnlySimulation, tuple[int, ...]], list[tuple[SleepState, int, list[float], Array]]] = {}
        for world, row, target, hand in zip(worlds, rows, targets, hands, strict=True):
            centers = np.stack([body.get_positions(row) for body in [hand, *world.objects]], axis=1)
            groups.setdefault((world._simulation, centers.shape), []).append((world, row, target, centers))
        for (simulation, shape), group in groups.items():
            starts = [(world._robot, row - world._first_row) for world, row, *_ in group]
            robots = simulation.simulate(starts, [target for *_, target, _ in group], shape[0])
            radii = np.array([[world._scene.hand_reach, *world._scene.object_radii] for world, *_ in group])
            near = group[0][0]._scene.robot_only.motion_bounds.is_near(
                np.stack([robot.sphere_centers for robot in robots]),
                np.stack([centers for *_, centers in group]),
                radii[:, None],
            )
            free = np.where(near.any(axis=1), near.argmax(axis=1), shape[0]).tolist()
            for (world, row, *_), robot, count in zip(group, robots, free, strict=True):
                world._robot, world._first_row, world._n_free_steps = robot, row, count

    def count_free_steps(self, row: int) -> int:
        """Return the number of steps from step `row` on before a body is near the robot; see `simulate_robots`."""
        return self._n_free_steps - (row - self._first_row)

    def write_state(self, row: int, qpos: Array, qvel: Array) -> None:
        """Write joint positions of robot and objects after step `row` to `qpos`, the robot's velocities to `qvel`."""
        scene, done = self._scene, row + 1 - self._first_row
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
