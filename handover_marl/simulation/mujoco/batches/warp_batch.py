"""Batches of worlds that MuJoCo Warp steps together on a GPU, or on Warp's CPU device in tests.

MuJoCo Warp computes in single precision. The state of all worlds is in arrays of this process; a rollout copies it to
the device and back, with the sensor data of all its steps.
"""

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco_warp
import numpy as np
import numpy.typing as npt
import warp

from handover_marl.config import TIME_STEP, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import SimulationError
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation
from handover_marl.simulation.mujoco.batches.slots import BatchSlot, WorldBatch
from handover_marl.simulation.mujoco.batches.warp_model import WarpModel, compute_layout, load_padded_model
from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.scene_model import SceneModel

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int_]

# Memory for contacts and constraints of each world. Contacts are shared by all worlds of a batch.
_MAX_CONTACTS, _MAX_CONSTRAINTS = 128, 256
# State that is copied to the device before a rollout, and back after each of its steps with the sensor data.
_STATE = ("qpos", "qvel", "qacc_warmstart")
_RECORDED = (*_STATE, "sensordata")
_CONTROLS = ("ctrl", "mocap_pos", "mocap_quat")
_OVERFLOWS = mujoco_warp.OverflowType
_FATAL_OVERFLOWS = {
    _OVERFLOWS.NEFC: "constraints",
    _OVERFLOWS.BROADPHASE: "pairs of near bodies",
    _OVERFLOWS.NARROWPHASE: "contacts",
    _OVERFLOWS.CCD: "convex collisions",
    _OVERFLOWS.CONTACT_MATCH: "contacts of a sensor",
}


class WarpBatch(WorldBatch):
    """Worlds that MuJoCo Warp simulates together; see `WorldBatch`.

    Args:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        device: Warp's name of the device, e.g. "cuda".
    """

    def __init__(self, scene: SceneModel, capacity: int, device: str) -> None:
        super().__init__(scene, capacity)
        model = scene.model
        self.qpos, self.qvel = np.tile(model.qpos0, (capacity, 1)), np.zeros((capacity, model.nv))
        self.forces, self.ctrl = np.zeros((capacity, model.nbody, 6)), np.zeros((capacity, model.nu))
        self.mocap_pos, self.mocap_quat = (np.zeros((capacity, model.nmocap, size)) for size in (3, 4))
        self.time = np.zeros(capacity)
        self.recorded = [np.zeros((capacity, model.nsensordata)), self.qpos]
        self._warm_start = np.zeros((capacity, model.nv))
        self._scenes = [scene] * capacity
        self._device = device
        # Number of each device row's world; -1 before the first.
        self._assigned = np.full(capacity, -1)
        with warp.ScopedDevice(device):
            self._model = WarpModel(scene, capacity)
            self._data = mujoco_warp.make_data(self._model.source, capacity, _MAX_CONTACTS, njmax=_MAX_CONSTRAINTS)
        self._graphs: dict[int, warp.Graph] = {}

    def try_scene(self, scene: SceneModel, row: int) -> bool:
        """Set the scene of a row if its model has the layout of the batch, and return whether it has."""
        if compute_layout(scene) != compute_layout(self.scene):
            return False
        self._scenes[row] = scene
        return True

    def reset_row(self, row: int) -> None:
        """Set a row to the initial state of its model."""
        model = self._scenes[row].model
        bodies = np.flatnonzero(model.body_mocapid >= 0)
        self.qpos[row] = model.qpos0
        self.mocap_pos[row], self.mocap_quat[row] = model.body_pos[bodies], model.body_quat[bodies]
        for array in (self.qvel, self.forces, self.ctrl, self.time, self._warm_start, self.recorded[0]):
            array[row] = 0.0

    def free_row(self, row: int) -> None:
        """Mark a row as free for another world, and release its model."""
        self._scenes[row] = self.scene
        heapq.heappush(self.free_rows, row)

    def select_models(self, slots: Sequence[BatchSlot], hands: Sequence[bool]) -> None:
        """Do nothing: a released object changes the model in the next rollout, and a hand out of reach is far away."""

    def step(self, slot: BatchSlot) -> None:
        """Simulate one physics step of a world with its current controls; see `WorldBatch.step`."""
        self.simulate([slot], [np.concatenate([array.ravel() for array in slot.get_controls()])[None]])

    def simulate(self, slots: Sequence[BatchSlot], controls: Sequence[Array]) -> "WarpRollout":
        """Simulate k physics steps of some worlds; see `WorldBatch.simulate`."""
        with warp.ScopedDevice(self._device):
            places = self._assign(slots)
            stacked = np.stack(controls, axis=1)
            records = self._simulate(slots, places, stacked)
            self._check(slots, places, records)
        rows = np.array([slot.row for slot in slots])
        readings = SensorReadings(self.scene.contact_sensors, records["sensordata"], records["qpos"])
        rollout = WarpRollout(self, rows, readings, stacked, records, self.time[rows])
        rollout.store(np.arange(len(slots)), len(stacked))
        return rollout

    def store(self, rows: Rows, records: Mapping[str, Array], controls: Array, seconds: Array) -> None:
        """Set the states of worlds.

        Args:
            rows: Rows (n,) of the worlds.
            records: States and sensor data (n, ...) by name.
            controls: Last controls (n, c).
            seconds: Simulation times (n,) (s).
        """
        self.qpos[rows], self.qvel[rows], self._warm_start[rows] = (records[name] for name in _STATE)
        self.recorded[0][rows], self.time[rows] = records["sensordata"], seconds
        self.ctrl[rows], self.mocap_pos[rows], self.mocap_quat[rows] = self._split_controls(controls)

    def _split_controls(self, controls: Array) -> list[Array]:
        """Split controls (..., c) into actuator targets, mocap positions and mocap quaternions."""
        shapes = [array.shape[1:] for array in (self.ctrl, self.mocap_pos, self.mocap_quat)]
        parts = np.split(controls, np.cumsum([math.prod(shape) for shape in shapes])[:-1], axis=-1)
        return [part.reshape(*controls.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]

    def _assign(self, slots: Sequence[BatchSlot]) -> Rows:
        """Assign each world to one of the first n rows of the device, and return these rows (n,).

        Worlds keep their rows if possible, since the models of others must be copied to the device.
        """
        worlds = np.array([slot.row for slot in slots])
        used, others = self._assigned[: len(slots)], self._assigned[len(slots) :]
        others[np.isin(others, worlds)] = -1
        kept = np.isin(used, worlds)
        used[~kept] = np.setdiff1d(worlds, used[kept])
        order = np.argsort(used)
        return np.asarray(order[np.searchsorted(used[order], worlds)])

    def _simulate(self, slots: Sequence[BatchSlot], places: Rows, controls: Array) -> dict[str, Array]:
        """Simulate worlds on the device, and return states and sensor data (k, n, ...) of k steps by name.

        Args:
            slots: Slots of the n worlds.
            places: Rows (n,) of the device.
            controls: Controls (k, n, c) of the worlds.
        """
        data = self._data
        data.nworld = self._count_device_rows(len(slots))
        # Further rows of the device repeat the first world.
        source = np.zeros(data.nworld, dtype=np.int_)
        source[places] = np.arange(len(slots))
        if self._model.set_rows([(slots[number].scene, slots[number].released) for number in source]):
            self._graphs.clear()
        rows = np.array([slot.row for slot in slots])[source]
        start = (self.qpos, self.qvel, self._warm_start, self.forces)
        for name, array in zip((*_STATE, "xfrc_applied"), start, strict=True):
            _copy_to(getattr(data, name), _put(array[rows], getattr(data, name)))
        parts = zip(_CONTROLS, self._split_controls(controls[:, source]), strict=True)
        given = [(getattr(data, name), _put(part, getattr(data, name))) for name, part in parts]
        shape = (len(controls), data.nworld)
        records = {name: warp.empty((*shape, getattr(data, name).shape[1]), dtype=float) for name in _RECORDED}
        data.overflow.zero_()
        for step in range(len(controls)):
            for target, array in given:
                _copy_to(target, array[step])
            self._step()
            for name, array in records.items():
                warp.copy(array[step], getattr(data, name), count=array[step].size)
        return {name: array.numpy()[:, places] for name, array in records.items()}

    def _count_device_rows(self, worlds: int) -> int:
        """Return the number of rows to simulate; on a GPU a power of two, since each number needs a graph."""
        if not warp.get_device().is_cuda:
            return worlds
        return int(min(self.capacity, 2 ** math.ceil(math.log2(worlds))))

    def _step(self) -> None:
        """Simulate one step of the first `nworld` rows of the device."""
        model, data = self._model.model, self._data
        if data.nworld in self._graphs:
            warp.capture_launch(self._graphs[data.nworld])
            return
        mujoco_warp.step(model, data)
        if warp.get_device().is_cuda:
            # All kernels are compiled now, which is not possible while a graph is captured.
            with warp.ScopedCapture() as capture:
                mujoco_warp.step(model, data)
            self._graphs[data.nworld] = capture.graph

    def _check(self, slots: Sequence[BatchSlot], places: Rows, records: Mapping[str, Array]) -> None:
        """Raise an error if memory of the device was too small or a state is not finite.

        Raises:
            SimulationError: The states of the worlds are invalid.
        """
        overflows = int(np.bitwise_or.reduce(self._data.overflow.numpy()[places]))
        full = [name for bit, name in _FATAL_OVERFLOWS.items() if overflows & bit]
        reason = f"too many {' and '.join(full)}." if full else "Nan, Inf or huge value in the state."
        if full or not all(np.isfinite(records[name]).all() for name in _STATE):
            seconds = max(float(self.time[slot.row]) for slot in slots)
            raise SimulationError(
                f"MuJoCo Warp's simulation failed after {seconds:.3f} s: {reason} To go on, use "
                "backend='threads', and report this."
            )


@dataclass(frozen=True, eq=False)
class WarpRollout:
    """Rollout of k physics steps of n worlds by MuJoCo Warp; see `BatchRollout`.

    Attributes:
        batch: Batch of the worlds.
        rows: Rows (n,) of the worlds.
        readings: Contact-sensor readings of k steps of n worlds.
        controls: Controls (k, n, c) of all steps and worlds.
        records: States and sensor data (k, n, ...) after each step by name.
        started: Simulation times (n,) before the rollout (s).
    """

    batch: WarpBatch
    rows: Rows
    readings: SensorReadings
    controls: Array
    records: Mapping[str, Array]
    started: Array

    def store(self, numbers: Rows, steps: int) -> None:
        """Set worlds with some indices to their states after some steps of the rollout."""
        records = {name: array[steps - 1, numbers] for name, array in self.records.items()}
        seconds = self.started[numbers] + TIME_STEP * steps
        self.batch.store(self.rows[numbers], records, self.controls[steps - 1, numbers], seconds)

    def truncate(self, number: int, steps: int) -> None:
        """Set a world back to its state after some steps of the rollout; see `BatchRollout.truncate`."""
        self.store(np.array([number]), steps)


class WarpSimulation(BatchSimulation):
    """Simulation of up to `count` worlds by MuJoCo Warp; see `BatchSimulation`.

    Args:
        count: Largest number of worlds.
        device: Warp's name of the device, e.g. "cuda".
    """

    can_sleep = False

    def __init__(self, count: int, device: str) -> None:
        super().__init__(count)
        self.max_rollout_worlds = self._capacity = count
        self._device = device

    def load_model(self, assets: SceneAssets, config: PhysicsConfig) -> SceneModel:
        """Compile the padded model of a scene, or return it from the cache; see `load_padded_model`."""
        return load_padded_model(assets, config)

    def _get_layout(self, scene: SceneModel) -> tuple[object, ...]:
        return compute_layout(scene)

    def _make_batch(self, scene: SceneModel) -> WorldBatch:
        return WarpBatch(scene, self._capacity, self._device)


def _put(values: Array, like: "warp.array") -> "warp.array":
    """Return an array on the current device with the number type of another one."""
    return warp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=like.dtype)


def _copy_to(target: "warp.array", source: "warp.array") -> None:
    """Copy an array to the first rows of another one."""
    warp.copy(target, source, count=source.size)
