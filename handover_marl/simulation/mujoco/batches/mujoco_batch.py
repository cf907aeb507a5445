"""Batch of worlds that MuJoCo simulates in one thread. The states of a world do not depend on other worlds."""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.engine import check_warnings
from handover_marl.simulation.mujoco.scene_model import SceneModel

Array = npt.NDArray[np.float64]

# Controls of a step in MuJoCo's order: actuator targets, then mocap poses.
_CONTROLS = (mujoco.mjtState.mjSTATE_CTRL, mujoco.mjtState.mjSTATE_MOCAP_POS, mujoco.mjtState.mjSTATE_MOCAP_QUAT)
_CONTROL_SPEC = sum(int(part) for part in _CONTROLS)
_RECORDED = ("sensordata", "qpos")


class MujocoBatch:
    """Worlds that are simulated as one MuJoCo batch; their models have the same layout.

    Args:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        buffers: Memory of rollouts by name, shared with batches that are simulated by the same thread.

    Attributes:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        free_rows: Heap of the numbers of the rows without a world.
        scratch: MuJoCo data for computations that do not change a world.
        batch: MuJoCo batch; each row is a world.
        models: MuJoCo model of each row.
        qpos: Writable view of the joint positions (n, q) of all rows, like the following arrays.
        qvel: Joint velocities (n, v).
        forces: External forces (n, b, 6) on the bodies.
        ctrl: Actuator targets (n, u).
        mocap_pos: Positions (n, m, 3) of the mocap bodies (m).
        mocap_quat: Quaternions wxyz (n, m, 4) of the mocap bodies.
        time: Simulation times (n,) (s).
        recorded: Sensor data (n, s) and joint positions (n, q).
    """

    def __init__(self, scene: SceneModel, capacity: int, buffers: dict[str, Array]) -> None:
        self.scene, self.capacity = scene, capacity
        self.free_rows = list(range(capacity))
        self.scratch = mujoco.MjData(scene.model)
        # One thread: further cores simulate batches of their own.
        self.batch = Batch(scene.model, capacity, nthread=1)
        self.models = [scene.model] * capacity
        self.batch.set_models(self.models)
        bind = self.batch.bind
        self.qpos, self.qvel, self.forces = bind("qpos"), bind("qvel"), bind("xfrc_applied")
        self.ctrl, self.mocap_pos, self.mocap_quat = bind("ctrl"), bind("mocap_pos"), bind("mocap_quat")
        self.time = bind("time")
        self.recorded = [bind(name) for name in _RECORDED]
        self._buffers = buffers

    @property
    def is_empty(self) -> bool:
        """Whether the batch has no world."""
        return len(self.free_rows) == self.capacity

    def try_scene(self, scene: SceneModel, row: int) -> bool:
        """Set the scene of a row if its model has the layout of the batch, and return whether it has."""
        before = self.models[row]
        self.models[row] = scene.model
        try:
            self.batch.set_models(self.models)
        except (ValueError, mujoco.FatalError):
            self.models[row] = before
            return False
        return True

    def reset_row(self, row: int) -> None:
        """Set a row to the initial state of its model."""
        self.batch.reset(ids=np.array([row], dtype=np.int32), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self.batch.warning[row] = 0

    def free_row(self, row: int) -> None:
        """Mark a row as free for another world, and release its model."""
        self.models[row] = self.scene.model
        self.batch.set_models(self.models)
        heapq.heappush(self.free_rows, row)

    def select_models(self, slots: Sequence["BatchSlot"], hands: Sequence[bool]) -> None:
        """Choose the model variants of worlds for the coming steps.

        Args:
            slots: Slots of worlds in this batch.
            hands: Whether the hand can collide in these steps, for each slot.
        """
        changed = False
        for slot, hand in zip(slots, hands, strict=True):
            model = slot.select_model(hand)
            if self.models[slot.row] is not model:
                self.models[slot.row], changed = model, True
        if changed:
            self.batch.set_models(self.models)

    def step(self, row: int) -> None:
        """Simulate one physics step of a row with its current controls.

        Raises:
            SimulationError: The engine failed; the state is invalid.
        """
        rows = np.array([row], dtype=np.int32)
        self.batch.step(ids=rows)
        check_warnings(self.batch, rows)

    def simulate(self, slots: Sequence["BatchSlot"], controls: Sequence[Array]) -> "MujocoRollout":
        """Simulate k physics steps of some worlds.

        Args:
            slots: Slots in the order of their rows.
            controls: Controls (k, c) of each slot: actuator targets, mocap positions, mocap
                quaternions wxyz.

        Raises:
            SimulationError: The engine failed; the states of these worlds are invalid.
        """
        rows = np.array([slot.row for slot in slots], dtype=np.int32)
        stacked = np.stack(controls, out=self._get_buffer("controls", (len(controls), *controls[0].shape)))
        before = self.batch.state[rows]
        found = self.batch.rollout(
            stacked.shape[1], stacked, _CONTROL_SPEC, _RECORDED, rows, self._get_record_buffers(*stacked.shape[:2])
        )
        check_warnings(self.batch, rows)
        arrays = (found[name].swapaxes(0, 1) for name in _RECORDED)
        return MujocoRollout(self, rows, SensorReadings(self.scene.contact_sensors, *arrays), stacked, before)

    def _get_record_buffers(self, worlds: int, steps: int) -> dict[str, Array]:
        """Return uninitialized arrays for the sensor data and joint positions of a rollout, by name."""
        names = zip(_RECORDED, self.recorded, strict=True)
        return {name: self._get_buffer(name, (worlds, steps, *one.shape[1:])) for name, one in names}

    def _get_buffer(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return an uninitialized array of a shape, in memory that is reused for this name."""
        size = math.prod(shape)
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size)
        return self._buffers[name][:size].reshape(shape)


@dataclass(frozen=True, eq=False)
class MujocoRollout:
    """Rollout of k physics steps of n worlds in one batch, valid until the next rollout of the thread.

    Attributes:
        batch: Batch of the worlds.
        rows: Rows (n,) of the worlds.
        readings: Contact-sensor readings of k steps of n worlds.
        controls: Controls (n, k, c) of all worlds and steps.
        before: MuJoCo states (n, s) of the worlds before the rollout.
    """

    batch: MujocoBatch
    rows: npt.NDArray[np.int32]
    readings: SensorReadings
    controls: Array
    before: Array

    def truncate(self, number: int, steps: int) -> None:
        """Set a world back to its state after some steps of the rollout.

        Args:
            number: Index of the world in the rollout.
            steps: Number of steps to keep.
        """
        batch, rows = self.batch.batch, self.rows[number : number + 1]
        batch.state[rows[0]] = self.before[number]
        batch.rollout(steps, self.controls[number, None, :steps], _CONTROL_SPEC, (), rows)


class BatchSlot:
    """Row of a batch in which a world is simulated during one episode.

    Args:
        world_batch: Batch of the row.
        row: Index of the row in the batch.
        scene: Model of the scene.

    Attributes:
        world_batch: Batch of the row.
        row: Index of the row in the batch.
        scene: Model of the scene.
        released: Whether the human has released the target object.
    """

    def __init__(self, world_batch: MujocoBatch, row: int, scene: SceneModel) -> None:
        self.world_batch, self.row, self.scene = world_batch, row, scene
        self.released = False
        # Variants that were used in this episode are held, since they are likely to be used again.
        self._variants: dict[tuple[bool, bool], mujoco.MjModel] = {}

    def select_model(self, hand: bool) -> "mujoco.MjModel":
        """Return the variant of the scene model for the coming steps.

        Args:
            hand: Whether the hand can collide in these steps.
        """
        key = self.released, hand
        if key not in self._variants:
            self._variants[key] = self.scene.variants.select(*key)
        return self._variants[key]

    def release_object(self, gravity: float) -> None:
        """Release the target object: it falls, and collides with table, ground and other objects.

        Args:
            gravity: Gravity along world z (m/s^2).
        """
        self.released = True
        body = self.scene.objects[0]
        self.world_batch.forces[self.row, body, 2] = gravity * float(self.scene.model.body_mass[body])

    @property
    def qpos(self) -> Array:
        """Writable view of the world's joint positions (q,)."""
        found: Array = self.world_batch.qpos[self.row]
        return found

    @property
    def qvel(self) -> Array:
        """Writable view of the world's joint velocities (v,)."""
        found: Array = self.world_batch.qvel[self.row]
        return found

    def get_controls(self) -> tuple[Array, Array, Array]:
        """Return writable views of the world's current controls.

        Returns:
            Actuator targets (u,), mocap positions (m, 3), mocap quaternions wxyz (m, 4).
        """
        world_batch, row = self.world_batch, self.row
        return world_batch.ctrl[row], world_batch.mocap_pos[row], world_batch.mocap_quat[row]

    def set_time(self, seconds: float) -> None:
        """Set the simulation time of the world (s)."""
        self.world_batch.time[self.row] = seconds

    def step(self) -> None:
        """Simulate one physics step of the world with its current controls.

        Raises:
            SimulationError: The engine failed; the state is invalid.
        """
        self.world_batch.step(self.row)

    def read_sensors(self) -> SensorReadings:
        """Return the contact-sensor readings of the last physics step."""
        return SensorReadings(self.scene.contact_sensors, *(array[self.row] for array in self.world_batch.recorded))

    def compute_body_poses(self) -> tuple[Array, Array]:
        """Compute the world positions (b, 3) and quaternions wxyz (b, 4) of all bodies."""
        scratch = self.world_batch.scratch
        scratch.qpos[:] = self.qpos
        mujoco.mj_kinematics(self.scene.model, scratch)
        return scratch.xpos, scratch.xquat
