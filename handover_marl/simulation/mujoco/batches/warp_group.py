"""Worlds with one model layout that MuJoCo Warp steps together, on a GPU, or on the CPU in tests.

MuJoCo Warp computes in single precision. The state of all worlds is in tensors on the device.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import mujoco_warp
import numpy as np
import numpy.typing as npt
import warp

from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, to_numpy
from handover_marl.simulation.mujoco.batches.warp_model import WarpModel
from handover_marl.simulation.mujoco.engine import wxyz_from_euler
from handover_marl.simulation.mujoco.models.scene_model import SceneModel
from handover_marl.simulation.warp_device import WarpDevice
from handover_marl.simulation.world import Contacts, RolloutContacts

# Memory for contacts and constraints of each world. Contacts are shared by all worlds of a group.
_MAX_CONTACTS, _MAX_CONSTRAINTS = 128, 256
# State that determines the motion of a world, and what is read after its last step.
_STATE = ("qpos", "qvel", "qacc_warmstart")
_STORED = (*_STATE, "sensordata")
_CONTROLS = ("ctrl", "mocap_pos", "mocap_quat")
_FORCES = "xfrc_applied"
_OVERFLOWS = mujoco_warp.OverflowType
_FATAL_OVERFLOWS = {
    _OVERFLOWS.NEFC: "constraints",
    _OVERFLOWS.BROADPHASE: "pairs of near bodies",
    _OVERFLOWS.NARROWPHASE: "contacts",
    _OVERFLOWS.CCD: "convex collisions",
    _OVERFLOWS.CONTACT_MATCH: "contacts of a sensor",
}


class StepControls(NamedTuple):
    """Controls of r worlds in one physics step; arrays for c steps have the shape (r, c, ...).

    Attributes:
        targets: Actuator targets (r, u).
        positions: Positions (r, m, 3) of the mocap bodies (m).
        quaternions: Quaternions wxyz (r, m, 4) of the mocap bodies.
    """

    targets: AnyArray
    positions: AnyArray
    quaternions: AnyArray


@dataclass(frozen=True, eq=False)
class WarpRollout:
    """Rollout of r worlds that are advanced together, step by step; it is updated in place.

    Attributes:
        rows: Indices (r,) of the worlds.
        row_indices: Index (d,) in `rows` of the world in each of the d rows of MuJoCo Warp's arrays that are in use.
        scenes: Numbers (d,) of the scenes in these d rows, as returned by `WarpModel.add_scene`.
        released: Whether the target objects in these d rows are released, (d,).
        states: States (r, ...) of the worlds by MuJoCo's names, e.g. "qpos", as `WarpGroup.store_states` stored them.
        overflow: Bits (r,) of MuJoCo Warp's `OverflowType`: the buffers that were too small for each world.
    """

    rows: AnyArray
    row_indices: AnyArray
    scenes: AnyArray
    released: AnyArray
    states: dict[str, AnyArray]
    overflow: AnyArray


class WarpGroup:
    """Worlds that MuJoCo Warp steps together: their models have the same layout, that is, array shapes and constants.

    The batch has n worlds in several groups. Tensors of a group have n rows; only the rows of its worlds are used.

    Args:
        scene: Scene with the group's layout, padded with absent objects and hulls (`load_padded_model`).
        count: Number n of worlds in all groups of the batch.
        config: Constants of the worlds.
        arrays: Creator of tensors on the device.

    Attributes:
        state: Joint positions, velocities, warm starts and sensor data (n, ...) by MuJoCo's names.
        released: Whether the target object of each world is released, (n,).
    """

    def __init__(self, scene: SceneModel, count: int, config: PhysicsConfig, arrays: ArrayFactory) -> None:
        self.scene, self._count, self._config, self._arrays = scene, count, config, arrays
        self._device = WarpDevice(arrays)
        with self._device.use():
            self._model = WarpModel(scene, count, arrays)
            self._data = mujoco_warp.make_data(self._model.source, count, _MAX_CONTACTS, njmax=_MAX_CONSTRAINTS)
            # Tensors that share the memory of the engine's arrays.
            names = (*_STORED, *_CONTROLS, _FORCES, "xpos", "xquat", "overflow")
            self._views = {name: warp.to_torch(getattr(self._data, name)) for name in names}
        self._graphs: dict[int, warp.Graph] = {}
        self._sensors = scene.contact_sensors.move_to(arrays)
        self.state = {name: arrays.xp.zeros_like(self._views[name]) for name in _STORED}
        # Mocap poses at the start of episodes; all but the positions of rotation references change in each step.
        self._mocap = {name: arrays.xp.zeros_like(self._views[name]) for name in ("mocap_pos", "mocap_quat")}
        self.released, self._scenes = arrays.zeros(count, "bool"), arrays.zeros(count, "int64")
        self._target_mass = arrays.zeros(count, "float32")

    def reset(
        self, row: int, scene: SceneModel, robot_joints: npt.ArrayLike, object_joints: npt.NDArray[np.float32]
    ) -> None:
        """Set a world to the start of a scene, at rest.

        Args:
            row: Index of the world.
            scene: Padded model of the scene.
            robot_joints: Nine joint positions of the robot (rad, m).
            object_joints: Joint positions (m, 6) of the objects: xyz (m), XYZ Euler angles (rad).
        """
        # Arrays of the model may be replaced; no running step may still read them.
        self._device.synchronize()
        with self._device.use():
            number, is_replaced = self._model.add_scene(scene)
        if is_replaced:
            self._graphs.clear()
        model, qpos = scene.model, scene.model.qpos0.copy()
        qpos[scene.robot_qpos] = robot_joints
        poses = np.concatenate([object_joints[:, :3], wxyz_from_euler(object_joints[:, 3:])], axis=1)
        qpos[scene.object_qpos] = poses.ravel()
        bodies = np.flatnonzero(model.body_mocapid >= 0)
        starts = {"qpos": qpos, "mocap_pos": model.body_pos[bodies], "mocap_quat": model.body_quat[bodies]}
        for name, array in {**self.state, **self._mocap}.items():
            array[row] = self._arrays.asarray(starts[name], "float32") if name in starts else 0.0
        self._scenes[row], self.released[row] = number, False
        self._target_mass[row] = float(model.body_mass[scene.objects[0]])

    def compute_body_poses(self, rows: AnyArray, bodies: list[int]) -> tuple[AnyArray, AnyArray]:
        """Compute world positions (r, b, 3) in m and quaternions wxyz (r, b, 4) of b robot bodies in r worlds."""
        count = len(rows)
        with self._device.use():
            self._data.nworld = count
            self._views["qpos"][:count] = self.state["qpos"][rows]
            self._model.select_scenes(self._scenes[rows], self.released[rows])
            mujoco_warp.kinematics(self._model.model, self._data)
            return self._views["xpos"][:count][:, bodies], self._views["xquat"][:count][:, bodies]

    def start_rollout(self, rows: AnyArray) -> WarpRollout:
        """Copy worlds to MuJoCo Warp's arrays and return a rollout of them.

        On a GPU, the number of simulated worlds is rounded up to a power of two, but not above n, since a CUDA graph is
        captured for each number. The additional worlds are copies, whose results are discarded.

        Args:
            rows: Indices (r,) of worlds in this group.
        """
        count = n_rows = len(rows)
        if self._device.stream is not None:
            n_rows = int(min(self._count, 2 ** math.ceil(math.log2(count))))
        row_indices = self._arrays.arange(n_rows) % count
        source, kept = rows[row_indices], {name: array[rows] for name, array in self.state.items()}
        overflow = self._arrays.zeros(count, "int32")
        rollout = WarpRollout(rows, row_indices, self._scenes[source], self.released[source], kept, overflow)
        with self._device.use():
            self._data.nworld = n_rows
            for name in _STATE:
                self._views[name][:n_rows] = self.state[name][source]
            self._views["overflow"].zero_()
            self._model.select_scenes(rollout.scenes, rollout.released)
            self._views[_FORCES][:n_rows] = 0.0
            self._set_weights(rollout)
        return rollout

    def step(self, rollout: WarpRollout, controls: StepControls, rules: ProtocolConfig) -> RolloutContacts:
        """Simulate one physics step of the worlds of a rollout, and return its contacts (1, r).

        Args:
            rollout: Rollout that was started last in this group.
            controls: Controls of the r worlds in this step.
            rules: Rules of the protocol, of which only the grasp region of the fingers is used.
        """
        count, row_indices = len(rollout.rows), rollout.row_indices
        with self._device.use():
            for name, array in zip(_CONTROLS, controls, strict=True):
                self._views[name][: len(row_indices)] = array[row_indices]
            self._step()
            data, qpos = (self._views[name][None, :count] for name in ("sensordata", "qpos"))
            return self._sensors.compute_rollout_contacts(data, qpos, rules)

    def store_states(self, rollout: WarpRollout, running: AnyArray) -> None:
        """Copy the current states of the worlds where `running` (r,) is True to `rollout.states`; keep the others."""
        xp, count = self._arrays.xp, len(rollout.rows)
        for name, kept in rollout.states.items():
            rollout.states[name] = xp.where(running[:, None], self._views[name][:count], kept)
        rollout.overflow[:] |= xp.where(running, self._views["overflow"][:count], 0)

    def release_targets(self, rollout: WarpRollout, released: AnyArray) -> None:
        """Release the target objects of a rollout's worlds where `released` (r,) is True, from the next step on."""
        rollout.released[:] = rollout.released | released[rollout.row_indices]
        with self._device.use():
            self._model.select_released(rollout.scenes, rollout.released)
            self._set_weights(rollout)

    def finish(self, rollout: WarpRollout) -> str | None:
        """Set the worlds of a rollout to the states that `store_states` has stored last.

        Returns:
            Reason, as a sentence, that the states are invalid: memory of the device was too small, or a state is not
            finite; None if they are valid.
        """
        count, xp = len(rollout.rows), self._arrays.xp
        for name, kept in rollout.states.items():
            self.state[name][rollout.rows] = kept
        self.released[rollout.rows] = rollout.released[:count]
        overflows = int(np.bitwise_or.reduce(to_numpy(rollout.overflow)))
        full = [name for bit, name in _FATAL_OVERFLOWS.items() if overflows & bit]
        if full:
            return f"too many {' and '.join(full)}."
        is_finite = all(bool(xp.all(xp.isfinite(rollout.states[name]))) for name in _STATE)
        return None if is_finite else "Nan, Inf or huge value in the state."

    def get_mocap_poses(self, rows: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return positions (r, m, 3) in m and quaternions wxyz (r, m, 4) of mocap bodies at the start of episodes."""
        return self._mocap["mocap_pos"][rows], self._mocap["mocap_quat"][rows]

    def are_grasped(self, rows: AnyArray) -> AnyArray:
        """Return a mask (r,) of the worlds `rows` whose fingers both touched the target object in the last step."""
        return self._arrays.xp.all(self._sensors.find_touching_fingers(self.state["sensordata"][rows]), axis=-1)

    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of world `row` in its last step; `released` is as in `World.read_contacts`."""
        data, qpos = (to_numpy(self.state[name][row]).astype(np.float64) for name in ("sensordata", "qpos"))
        return self.scene.contact_sensors.compute_contacts(data, qpos, released)

    def _set_weights(self, rollout: WarpRollout) -> None:
        """Set the external force (N) on each target object to its weight if it is released, else to zero."""
        weights = self._config.gravity * self._target_mass[rollout.rows][rollout.row_indices]
        body = int(self.scene.objects[0])
        self._views[_FORCES][: len(rollout.row_indices), body, 2] = weights * rollout.released

    def _step(self) -> None:
        """Simulate one step of the worlds in MuJoCo Warp's arrays; on a GPU, by a CUDA graph for their number."""
        model, data = self._model.model, self._data
        if data.nworld in self._graphs:
            warp.capture_launch(self._graphs[data.nworld])
            return
        mujoco_warp.step(model, data)
        if self._device.stream is not None:
            # All kernels are compiled now, which is not possible while a graph is captured.
            with warp.ScopedCapture() as capture:
                mujoco_warp.step(model, data)
            self._graphs[data.nworld] = capture.graph
