"""Batched simulation of worlds in MuJoCo, with one batch for each model layout.

A single world is a batch of one. The states of a world do not depend on other worlds.
"""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.engine import HandKinematics, check_warnings, configure_engine
from handover_marl.simulation.mujoco.scene_model import RobotOnlyModel, SceneModel
from handover_marl.simulation.mujoco.sleep import RobotOnlyRollouts

Array = npt.NDArray[np.float64]

# Controls of a step in MuJoCo's order: actuator targets, then mocap poses.
_CONTROLS = (mujoco.mjtState.mjSTATE_CTRL, mujoco.mjtState.mjSTATE_MOCAP_POS, mujoco.mjtState.mjSTATE_MOCAP_QUAT)
_CONTROL_SPEC = sum(int(part) for part in _CONTROLS)
_RECORDED = ("sensordata", "qpos")
# Largest number of worlds of a batch, whose memory is reserved even if few of them have its layout.
_MAX_BATCH_SIZE = 64
# Number of batches without worlds that are kept. A batch takes 5 MB, and 2 ms to make.
_MAX_EMPTY_BATCHES = 8


class WorldBatch:
    """Worlds that are simulated as one MuJoCo batch; their models have the same layout, as MuJoCo requires.

    Args:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        buffers: Memory of rollouts by name, shared with batches that are simulated by the same thread.

    Attributes:
        scene: Scene model with the layout of the batch.
        batch: MuJoCo batch; each row is a world.
        models: MuJoCo model of each row.
        free_rows: Heap of the numbers of the rows without a world.
        scratch: MuJoCo data for computations that do not change a world.
        qpos: Joint positions of all rows; this array and the following ones are views of the state
            of the batch.
        qvel: Joint velocities of all rows.
        forces: External forces on the bodies of all rows.
        ctrl: Actuator targets of all rows.
        mocap_pos: Positions of the mocap bodies of all rows (m).
        mocap_quat: Quaternions wxyz of the mocap bodies of all rows.
        recorded: Sensor data and joint positions of all rows.
    """

    def __init__(self, scene: SceneModel, capacity: int, buffers: dict[str, Array]) -> None:
        self.scene = scene
        # One thread: further cores simulate batches of their own.
        self.batch = Batch(scene.model, capacity, nthread=1)
        self.models = [scene.model] * capacity
        self.batch.set_models(self.models)
        self.free_rows = list(range(capacity))
        self.scratch = mujoco.MjData(scene.model)
        bind = self.batch.bind
        self.qpos, self.qvel, self.forces = bind("qpos"), bind("qvel"), bind("xfrc_applied")
        self.ctrl, self.mocap_pos, self.mocap_quat = bind("ctrl"), bind("mocap_pos"), bind("mocap_quat")
        self.recorded = [bind(name) for name in _RECORDED]
        self._buffers = buffers

    def get_record_buffers(self, worlds: int, steps: int) -> dict[str, Array]:
        """Return uninitialized arrays for the sensor data and joint positions of a rollout, by name.

        Their memory is reused by the next rollout.

        Args:
            worlds: Number of worlds in the rollout.
            steps: Number of physics steps.
        """
        names = zip(_RECORDED, self.recorded, strict=True)
        return {name: self.get_buffer(name, (worlds, steps, *one.shape[1:])) for name, one in names}

    def get_buffer(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return an uninitialized array of a shape, in memory that is reused for this name."""
        size = math.prod(shape)
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size)
        return self._buffers[name][:size].reshape(shape)

    def try_model(self, model: "mujoco.MjModel", row: int) -> bool:
        """Set the model of a row if it has the layout of the batch, and return whether it has."""
        before = self.models[row]
        self.models[row] = model
        try:
            self.batch.set_models(self.models)
        except (ValueError, mujoco.FatalError):
            self.models[row] = before
            return False
        return True

    def free_row(self, row: int) -> None:
        """Mark a row as free for another world, and release its model."""
        self.models[row] = self.scene.model
        self.batch.set_models(self.models)
        heapq.heappush(self.free_rows, row)

    @property
    def is_empty(self) -> bool:
        """Whether the batch has no world."""
        return len(self.free_rows) == len(self.models)


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

    def __init__(self, world_batch: WorldBatch, row: int, scene: SceneModel) -> None:
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
        self.world_batch.batch.bind("time")[self.row] = seconds

    def step(self) -> None:
        """Simulate one physics step of the world with its current controls.

        Raises:
            SimulationError: MuJoCo warned; the state is invalid.
        """
        world_batch, rows = self.world_batch, np.array([self.row], dtype=np.int32)
        world_batch.batch.step(ids=rows)
        check_warnings(world_batch.batch, rows)

    def read_sensors(self) -> SensorReadings:
        """Return the contact-sensor readings of the last physics step."""
        return SensorReadings(self.scene.contact_sensors, *(array[self.row] for array in self.world_batch.recorded))

    def compute_body_poses(self) -> tuple[Array, Array]:
        """Compute the world positions (b, 3) and quaternions wxyz (b, 4) of all bodies."""
        scratch = self.world_batch.scratch
        scratch.qpos[:] = self.qpos
        mujoco.mj_kinematics(self.scene.model, scratch)
        return scratch.xpos, scratch.xquat


class BatchSimulation:
    """Simulation of up to `count` worlds in MuJoCo batches, in one thread.

    Args:
        count: Largest number of worlds.
    """

    def __init__(self, count: int) -> None:
        configure_engine()
        self._capacity = min(count, _MAX_BATCH_SIZE)
        self._buffers: dict[str, Array] = {}
        self._batches: dict[tuple[int, ...], list[WorldBatch]] = {}
        self._robot_rollouts: dict[RobotOnlyModel, RobotOnlyRollouts] = {}
        self._hand_kinematics: dict[tuple[Path, int, tuple[int, ...]], HandKinematics] = {}
        # Groups that were empty when last checked, in the order in which they became so.
        self._empty_batches: list[WorldBatch] = []

    def load_scene(self, scene: SceneModel, previous: BatchSlot | None = None) -> BatchSlot:
        """Load a scene, and return its batch slot in the initial state of the model.

        Args:
            scene: Model of the scene.
            previous: Slot of the world's previous episode, which becomes invalid.
        """
        if previous is not None and previous.world_batch.try_model(scene.model, previous.row):
            slot = BatchSlot(previous.world_batch, previous.row, scene)
        else:
            if previous is not None:
                self.free(previous)
            world_batch = self._find_batch(scene)
            slot = BatchSlot(world_batch, heapq.heappop(world_batch.free_rows), scene)
        slot.world_batch.batch.reset(ids=np.array([slot.row], dtype=np.int32), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        slot.world_batch.batch.warning[slot.row] = 0
        return slot

    def free(self, slot: BatchSlot) -> None:
        """Free the batch row of a slot; the slot becomes invalid."""
        world_batch = slot.world_batch
        world_batch.free_row(slot.row)
        if world_batch.is_empty:
            kept = [*(one for one in self._empty_batches if one.is_empty and one is not world_batch), world_batch]
            self._empty_batches, dropped = kept[-_MAX_EMPTY_BATCHES:], kept[:-_MAX_EMPTY_BATCHES]
            for one in dropped:
                self._batches[_get_sizes(one.scene.model)].remove(one)

    def get_robot_rollouts(self, model: RobotOnlyModel) -> RobotOnlyRollouts:
        """Return the cache of rollouts without hand and objects, shared by all worlds."""
        if model not in self._robot_rollouts:
            self._robot_rollouts[model] = RobotOnlyRollouts(model)
        return self._robot_rollouts[model]

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

    def _find_batch(self, scene: SceneModel) -> WorldBatch:
        """Return a world batch with a free row that accepts the scene's model."""
        batches = self._batches.setdefault(_get_sizes(scene.model), [])
        for world_batch in batches:
            if world_batch.free_rows and world_batch.try_model(scene.model, world_batch.free_rows[0]):
                return world_batch
        batches.append(WorldBatch(scene, self._capacity, self._buffers))
        return batches[-1]


def _get_sizes(model: "mujoco.MjModel") -> tuple[int, ...]:
    """Return the array sizes of a MuJoCo model, which are equal in all models of one layout."""
    return model.nq, model.nv, model.nu, model.nbody, model.ngeom, model.nbvh, model.nmocap, model.nsensordata


@dataclass(frozen=True, eq=False)
class BatchRollout:
    """Rollout of k physics steps of n worlds in one world batch.

    The rollout is valid until the next rollout of the thread.

    Attributes:
        slots: Batch slots of the n worlds.
        readings: Contact-sensor readings of k steps of n worlds.
        controls: Controls (n, k, c) of all worlds and steps.
        before: MuJoCo states (n, s) of the worlds before the rollout.
    """

    slots: list[BatchSlot]
    readings: SensorReadings
    controls: Array
    before: Array

    def truncate(self, number: int, steps: int) -> None:
        """Set a world back to its state after some steps of the rollout.

        Args:
            number: Index of the world in `slots`.
            steps: Number of steps to keep.
        """
        slot = self.slots[number]
        batch, rows = slot.world_batch.batch, np.array([slot.row], dtype=np.int32)
        batch.state[slot.row] = self.before[number]
        batch.rollout(steps, self.controls[number, None, :steps], _CONTROL_SPEC, (), rows)


def simulate_slots(slots: Sequence[BatchSlot], controls: Sequence[Array]) -> BatchRollout:
    """Simulate k physics steps of the worlds in slots of one world batch.

    Args:
        slots: Slots in the order of their rows.
        controls: Controls (k, c) of each slot: actuator targets, mocap positions, mocap quaternions
            wxyz.

    Raises:
        SimulationError: MuJoCo warned; the states of these worlds are invalid.
    """
    world_batch, rows = slots[0].world_batch, np.array([slot.row for slot in slots], dtype=np.int32)
    stacked = np.stack(controls, out=world_batch.get_buffer("controls", (len(controls), *controls[0].shape)))
    before = world_batch.batch.state[rows]
    buffers = world_batch.get_record_buffers(*stacked.shape[:2])
    found = world_batch.batch.rollout(stacked.shape[1], stacked, _CONTROL_SPEC, _RECORDED, rows, buffers)
    check_warnings(world_batch.batch, rows)
    arrays = (found[name].swapaxes(0, 1) for name in _RECORDED)
    return BatchRollout(list(slots), SensorReadings(world_batch.scene.contact_sensors, *arrays), stacked, before)
