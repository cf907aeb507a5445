"""Simulation of many worlds in MuJoCo, in one thread. The states of a world do not depend on other worlds."""

import functools
import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import quaternion_from_matrix
from handover_marl.simulation.mujoco.batches.world_data import WorldData
from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.engine import configure_engine
from handover_marl.simulation.mujoco.models.scene_model import RobotOnlyModel, SceneModel
from handover_marl.simulation.mujoco.quaternions import wxyz_from_xyzw
from handover_marl.simulation.mujoco.sleep import RobotOnlySimulation

Array = npt.NDArray[np.float64]


class HandKinematics:
    """Forward kinematics of a human hand by MuJoCo, much faster than array operations.

    Args:
        urdf: Model of the hand.
        links: Numbers (k,) of the links whose poses are computed.
    """

    def __init__(self, urdf: Path, links: npt.NDArray[np.integer]) -> None:
        self._model = _compile_tree(urdf, urdf.stat().st_mtime_ns)
        self._data = mujoco.MjData(self._model)
        self._joints, self._positions, self._quaternions = self._data.qpos, self._data.xpos, self._data.xquat
        # Body 0 is the world, body 1 the base.
        self._bodies = links + 2

    def compute_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute the links' positions (k, 3) (m) and quaternions wxyz (k, 4) in the base frame.

        Args:
            joints: Positions (d,) of the moving joints (m, rad).
        """
        self._joints[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._positions[self._bodies], self._quaternions[self._bodies]

    def compute_trajectory(self, joints: Array) -> tuple[Array, Array]:
        """Compute positions (n, k, 3) (m) and quaternions wxyz (n, k, 4) for joint positions (n, d)."""
        count, place = len(joints), self._joints
        positions = np.empty((count, *self._positions.shape))
        quaternions = np.empty((count, *self._quaternions.shape))
        for number in range(count):
            place[:] = joints[number]
            mujoco.mj_kinematics(self._model, self._data)
            positions[number], quaternions[number] = self._positions, self._quaternions
        return positions[:, self._bodies], quaternions[:, self._bodies]


@functools.lru_cache(maxsize=64)
def _compile_tree(urdf: Path, mtime: int) -> "mujoco.MjModel":
    """Compile the joints of a URDF file as a MuJoCo model without shapes."""
    tree, spec = read_tree(urdf), mujoco.MjSpec()
    bodies = {-1: spec.worldbody.add_body()}
    # Links are numbered depth first, like MuJoCo's bodies.
    for number, joint in enumerate(tree.joints):
        rotation = wxyz_from_xyzw(quaternion_from_matrix(joint.rotation))
        body = bodies[number] = bodies[joint.parent].add_body(pos=joint.offset, quat=rotation)
        # MuJoCo refuses moving bodies without mass.
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        if joint.kind != "fixed":
            slides = joint.kind == "prismatic"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=joint.axis)
    return spec.compile()


# Number of batches that are kept. A batch takes 2 MB and 1 ms to make; the scenes of s0 train need 37.
_MAX_BATCHES = 64


@dataclass(frozen=True, eq=False)
class MujocoRollout:
    """Rollout of k physics steps of n worlds, valid until the next rollout of the simulation.

    Attributes:
        worlds: The worlds.
        controls: Controls (n, k, c) of all steps.
        sensordata: Sensor data (n, k, s) of all steps.
        step_states: Part (n, k, p) of the state that a step changes, after each step; see `WorldData`.
    """

    worlds: Sequence[WorldData]
    controls: Array
    sensordata: Array
    step_states: Array

    def make_readings(self) -> SensorReadings:
        """Return the contact-sensor readings of k steps of n worlds."""
        world = self.worlds[0]
        qpos = world.get_joint_positions(self.step_states)
        return SensorReadings(world.scene.contact_sensors, self.sensordata.swapaxes(0, 1), qpos.swapaxes(0, 1))

    def set_world(self, number: int, steps: int) -> None:
        """Set a world to its state after some steps of the rollout.

        Args:
            number: Index of the world in the rollout.
            steps: Number of steps, 1 to k.
        """
        place = number, steps - 1
        self.worlds[number].set_step(self.controls[place], self.sensordata[place], self.step_states[place])


class BatchSimulation:
    """Simulation of any number of worlds in MuJoCo, in one thread."""

    def __init__(self) -> None:
        configure_engine()
        # Memory of rollouts by name.
        self._buffers: dict[str, Array] = {}
        self._batches: OrderedDict[tuple[int, ...], Batch] = OrderedDict()
        self._robots: dict[RobotOnlyModel, RobotOnlySimulation] = {}
        self._hand_kinematics: dict[tuple[Path, int, tuple[int, ...]], HandKinematics] = {}

    def load_scene(self, scene: SceneModel) -> WorldData:
        """Return a world of a scene in the initial state of its model."""
        layout = _get_layout(scene.model)
        batch = self._batches.pop(layout, None)
        if batch is None or not _accepts(batch, scene.model):
            # One thread: further cores have simulations of their own.
            batch = Batch(scene.model, 1, nthread=1)
        self._batches[layout] = batch
        if len(self._batches) > _MAX_BATCHES:
            self._batches.popitem(last=False)
        return WorldData(scene, batch)

    def simulate(
        self, worlds: Sequence[WorldData], hands_collide: Sequence[bool], controls: Sequence[Array]
    ) -> MujocoRollout:
        """Simulate k physics steps of worlds whose states have equal sizes.

        Args:
            worlds: The worlds, which are set to their states after the last step.
            hands_collide: Whether the hand can collide in these steps, for each world.
            controls: Controls (k, c) of each world: actuator targets, mocap positions, mocap
                quaternions wxyz.

        Raises:
            SimulationError: The engine failed; the states of these worlds are invalid.
        """
        first, shape = worlds[0], (len(worlds), len(controls[0]))
        stacked = np.stack(controls, out=self._get_buffer("controls", (*shape, controls[0].shape[1])))
        sensordata = self._get_buffer("sensordata", (*shape, len(first.sensordata)))
        step_states = self._get_buffer("step_states", (*shape, first.step_state_size))
        rollout = MujocoRollout(worlds, stacked, sensordata, step_states)
        for number, (world, hand_collides) in enumerate(zip(worlds, hands_collide, strict=True)):
            world.simulate(hand_collides, stacked[number], sensordata[number], step_states[number])
            rollout.set_world(number, shape[1])
        return rollout

    def get_robot(self, model: RobotOnlyModel) -> RobotOnlySimulation:
        """Return the simulation of the robot without hand and objects, shared by all worlds."""
        if model not in self._robots:
            self._robots[model] = RobotOnlySimulation(model)
        return self._robots[model]

    def get_hand_kinematics(self, urdf: Path, links: Sequence[int]) -> HandKinematics:
        """Return forward kinematics of a hand, shared by all worlds.

        Args:
            urdf: Model of the hand.
            links: Numbers of the links whose poses are computed.
        """
        key = urdf, urdf.stat().st_mtime_ns, tuple(links)
        if key not in self._hand_kinematics:
            self._hand_kinematics[key] = HandKinematics(urdf, np.array(links))
        return self._hand_kinematics[key]

    def _get_buffer(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return an uninitialized array of a shape, in memory that is reused for this name."""
        size = math.prod(shape)
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size)
        return self._buffers[name][:size].reshape(shape)


def _get_layout(model: "mujoco.MjModel") -> tuple[int, ...]:
    """Return the array sizes of a model that models of one layout share."""
    return model.nq, model.nv, model.nu, model.nbody, model.ngeom, model.nbvh, model.nmocap, model.nsensordata


def _accepts(batch: Batch, model: "mujoco.MjModel") -> bool:
    """Return whether a model has the layout of a batch."""
    try:
        batch.set_models(model)
    except (ValueError, mujoco.FatalError):
        return False
    return True
