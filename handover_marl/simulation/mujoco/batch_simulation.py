"""State and simulation of worlds in MuJoCo, batches that worlds share, and forward kinematics of human hands."""

from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.rotations import quaternions_from_matrices
from handover_marl.simulation.mujoco.engine import check_warnings, configure_engine, wxyz_from_xyzw
from handover_marl.simulation.mujoco.models.scene_model import RobotOnlyModel, SceneModel, select_variant
from handover_marl.simulation.mujoco.sleep import RobotOnlySimulation

Array = npt.NDArray[np.float64]

_STATE = mujoco.mjtState
# Controls of a step in MuJoCo's order: actuator targets, then mocap poses.
_CONTROLS = int(_STATE.mjSTATE_CTRL | _STATE.mjSTATE_MOCAP_POS | _STATE.mjSTATE_MOCAP_QUAT)
# Part of the state that a step changes, the first in a state vector: all components from time to warm start.
_STEP_STATE = 2 * int(_STATE.mjSTATE_WARMSTART) - 1
# Number of batches that are kept. A batch takes 2 MB and 1 ms to make; the scenes of s0 train need 37.
_MAX_BATCHES = 64


class WorldData:
    """Model and state of a world during one episode; at first the initial state of the model.

    Args:
        scene: Model of the scene.
        batch: MuJoCo batch of one world, for models with the array sizes of the scene's model. Worlds may share it,
            since each rollout sets its state first.

    Attributes:
        batch: MuJoCo batch that simulates the world.
        released: Whether the person has released the target object.
        qpos: Joint positions (q,); this and the following arrays are writable views.
        qvel: Joint velocities (v,).
        ctrl: Actuator targets (u,).
        mocap_pos: Positions (m, 3) of the mocap bodies (m).
        mocap_quat: Quaternions wxyz (m, 4) of the mocap bodies.
        sensordata: Data (s,) of the sensors in the last step.
        step_state_size: Number p of values in the part of the state that a step changes: time, joint positions and
            velocities, warm start.
    """

    def __init__(self, scene: SceneModel, batch: Batch) -> None:
        self.scene, self.batch, self.released = scene, batch, False
        # Variants that were used in this episode are held, since they are likely to be used again.
        self._variants: dict[tuple[bool, bool], mujoco.MjModel] = {}
        batch.set_models(scene.model)
        batch.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._state = batch.state[0].copy()
        self.qpos, self.qvel = self._view(_STATE.mjSTATE_QPOS), self._view(_STATE.mjSTATE_QVEL)
        self.ctrl, self._forces = self._view(_STATE.mjSTATE_CTRL), self._view(_STATE.mjSTATE_XFRC_APPLIED, 6)
        self.mocap_pos = self._view(_STATE.mjSTATE_MOCAP_POS, 3)
        self.mocap_quat = self._view(_STATE.mjSTATE_MOCAP_QUAT, 4)
        self.sensordata = np.zeros(scene.model.nsensordata)
        self.step_state_size = int(mujoco.mj_stateSize(scene.model, _STEP_STATE))

    def select_model(self, hand_collides: bool) -> "mujoco.MjModel":
        """Return the variant of the scene's model for the current `released`, with or without human-hand collisions."""
        key = self.released, hand_collides
        if key not in self._variants:
            self._variants[key] = select_variant(self.scene, *key)
        return self._variants[key]

    def release_object(self, gravity: float) -> None:
        """Release the target object: `gravity` (world z, m/s^2) pulls it, and it collides with table and objects."""
        self.released = True
        body = self.scene.objects[0]
        self._forces[body, 2] = gravity * float(self.scene.model.body_mass[body])

    def simulate(self, hand_collides: bool, controls: Array, sensordata: Array, step_states: Array) -> None:
        """Simulate k physics steps from this state and write the results to arrays; only `set_step` changes the state.

        Args:
            hand_collides: Whether the human hand can collide in these steps.
            controls: Controls (k, c): actuator targets, mocap positions, mocap quaternions wxyz.
            sensordata: Array (k, s) to write the sensor data of each step to.
            step_states: Array (k, p) to write the changed part of the state after each step to.
        """
        batch, model = self.batch, self.select_model(hand_collides)
        if batch.models is not model:
            batch.set_models(model)
        batch.state[0], batch.warning[0] = self._state, 0
        records = {"sensordata": sensordata[None], _STEP_STATE: step_states[None]}
        batch.rollout(len(controls), controls[None], _CONTROLS, tuple(records), out=records)
        check_warnings(batch)

    def set_step(self, controls: Array, sensordata: Array, step_state: Array) -> None:
        """Set the state to that after a step of `simulate`, given the values that `simulate` wrote for this step.

        Args:
            controls: Controls (c,) of the step.
            sensordata: Sensor data (s,) of the step.
            step_state: Changed part (p,) of the state after the step.
        """
        self._state[: len(step_state)], self.sensordata[:] = step_state, sensordata
        self.ctrl[:], self.mocap_pos[:], self.mocap_quat[:] = self.split_controls(controls)

    def split_controls(self, controls: Array) -> tuple[Array, Array, Array]:
        """Split controls (..., c) into views of actuator targets (..., u), mocap positions and quaternions.

        Returns:
            Targets (..., u), positions (..., m, 3) (m), quaternions wxyz (..., m, 4).
        """
        u, m, shape = len(self.ctrl), len(self.mocap_pos), controls.shape[:-1]
        positions, quaternions = controls[..., u : u + 3 * m], controls[..., u + 3 * m :]
        return controls[..., :u], positions.reshape(*shape, m, 3), quaternions.reshape(*shape, m, 4)

    def _view(self, component: "mujoco.mjtState", columns: int | None = None) -> Array:
        """Return a view of one component of the state, e.g. positions; as rows (n, columns) if `columns` is given."""
        model, bit = self.scene.model, int(component)
        # Components are stored in the order of their bits.
        first = mujoco.mj_stateSize(model, bit - 1)
        part: Array = self._state[first : first + mujoco.mj_stateSize(model, bit)]
        return part if columns is None else part.reshape(-1, columns)


class HandKinematics:
    """Forward kinematics of a human hand by MuJoCo, much faster than array operations.

    Args:
        urdf: Model of the hand.
        links: Numbers (k,) of the links whose poses are computed.
    """

    def __init__(self, urdf: Path, links: npt.ArrayLike) -> None:
        self._model = _compile_tree(urdf)
        self._data = mujoco.MjData(self._model)
        self._joints, self._positions, self._quaternions = self._data.qpos, self._data.xpos, self._data.xquat
        # Body 0 is the world, body 1 the base.
        self._bodies = np.asarray(links) + 2

    def compute_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute base-frame positions (n, k, 3) in m and quaternions wxyz (n, k, 4) of k links at joints (n, d)."""
        # Hands are often at rest: compute only the poses that differ from the step before.
        differs = np.ones(len(joints), dtype=bool)
        differs[1:] = (joints[1:] != joints[:-1]).any(axis=1)
        chosen, places = joints[differs], np.cumsum(differs) - 1
        positions = np.empty((len(chosen), *self._positions.shape))
        quaternions = np.empty((len(chosen), *self._quaternions.shape))
        for number, own in enumerate(chosen):
            self._joints[:] = own
            mujoco.mj_kinematics(self._model, self._data)
            positions[number], quaternions[number] = self._positions, self._quaternions
        positions, quaternions = positions[:, self._bodies], quaternions[:, self._bodies]
        return positions[places], quaternions[places]


@cached_by_file(maxsize=64)
def _compile_tree(urdf: Path) -> "mujoco.MjModel":
    """Compile the joints of a URDF file as a MuJoCo model without shapes."""
    tree, spec = read_tree(urdf), mujoco.MjSpec()
    bodies = {-1: spec.worldbody.add_body()}
    # Links are numbered depth first, like MuJoCo's bodies.
    for number, joint in enumerate(tree.joints):
        rotation = wxyz_from_xyzw(quaternions_from_matrices(joint.rotation))
        body = bodies[number] = bodies[joint.parent].add_body(pos=joint.offset, quat=rotation)
        # MuJoCo refuses moving bodies without mass.
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        if joint.kind != "fixed":
            slides = joint.kind == "prismatic"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=joint.axis)
    return spec.compile()


class MujocoRollout(NamedTuple):
    """Results of the simulation of n worlds for k physics steps.

    Attributes:
        controls: Controls (n, k, c) of all steps.
        sensordata: Sensor data (n, k, s) of all steps.
        step_states: Time, positions, velocities and warm start (n, k, p) after each step.
    """

    controls: Array
    sensordata: Array
    step_states: Array


class SimulationCache:
    """Cache of MuJoCo's batches and of robot-only simulations, which all worlds of a thread may share."""

    def __init__(self) -> None:
        configure_engine()
        self._batches: OrderedDict[tuple[int, ...], Batch] = OrderedDict()
        self._robots: dict[RobotOnlyModel, RobotOnlySimulation] = {}

    def load_scene(self, scene: SceneModel) -> WorldData:
        """Create the data of a world that simulates a scene, in the initial state of the scene's model."""
        layout = _get_layout(scene.model)
        batch = self._batches.pop(layout, None)
        if batch is None or not _accepts(batch, scene.model):
            # One thread: further cores have simulations of their own.
            batch = Batch(scene.model, 1, nthread=1)
        self._batches[layout] = batch
        if len(self._batches) > _MAX_BATCHES:
            self._batches.popitem(last=False)
        return WorldData(scene, batch)

    def get_robot_simulation(self, model: RobotOnlyModel) -> RobotOnlySimulation:
        """Return the simulation of a model of robot and table, made at the first call; all worlds share it."""
        if model not in self._robots:
            self._robots[model] = RobotOnlySimulation(model)
        return self._robots[model]


def _get_layout(model: "mujoco.MjModel") -> tuple[int, ...]:
    """Return eight array sizes of a model, which models that share a batch must have in common; see also `_accepts`."""
    return model.nq, model.nv, model.nu, model.nbody, model.ngeom, model.nbvh, model.nmocap, model.nsensordata


def _accepts(batch: Batch, model: "mujoco.MjModel") -> bool:
    """Set the model of a batch and return True; return False if the batch is for other array sizes."""
    try:
        batch.set_models(model)
    except (ValueError, mujoco.FatalError):
        return False
    return True
