"""Batch of worlds that MuJoCo simulates in one thread. The states of a world do not depend on other worlds."""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.simulation.mujoco.batches.slots import BatchSlot, WorldBatch
from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.engine import check_warnings
from handover_marl.simulation.mujoco.scene_model import SceneModel

Array = npt.NDArray[np.float64]

# Controls of a step in MuJoCo's order: actuator targets, then mocap poses.
_CONTROLS = (mujoco.mjtState.mjSTATE_CTRL, mujoco.mjtState.mjSTATE_MOCAP_POS, mujoco.mjtState.mjSTATE_MOCAP_QUAT)
_CONTROL_SPEC = sum(int(part) for part in _CONTROLS)
_RECORDED = ("sensordata", "qpos")


class MujocoBatch(WorldBatch):
    """Worlds that are simulated as one MuJoCo batch; see `WorldBatch`.

    Args:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        buffers: Memory of rollouts by name, shared with batches that are simulated by the same thread.

    Attributes:
        batch: MuJoCo batch; each row is a world.
        models: MuJoCo model of each row.
    """

    def __init__(self, scene: SceneModel, capacity: int, buffers: dict[str, Array]) -> None:
        super().__init__(scene, capacity)
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

    def select_models(self, slots: Sequence[BatchSlot], hands: Sequence[bool]) -> None:
        """Choose the model variants of worlds for the coming steps; see `WorldBatch.select_models`."""
        changed = False
        for slot, hand in zip(slots, hands, strict=True):
            model = slot.select_model(hand)
            if self.models[slot.row] is not model:
                self.models[slot.row], changed = model, True
        if changed:
            self.batch.set_models(self.models)

    def step(self, slot: BatchSlot) -> None:
        """Simulate one physics step of a world with its current controls; see `WorldBatch.step`."""
        rows = np.array([slot.row], dtype=np.int32)
        self.batch.step(ids=rows)
        check_warnings(self.batch, rows)

    def simulate(self, slots: Sequence[BatchSlot], controls: Sequence[Array]) -> "MujocoRollout":
        """Simulate k physics steps of some worlds; see `WorldBatch.simulate`."""
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
    """Rollout of k physics steps of n worlds in a MuJoCo batch; see `BatchRollout`.

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
        """Set a world back to its state after some steps of the rollout; see `BatchRollout.truncate`."""
        batch, rows = self.batch.batch, self.rows[number : number + 1]
        batch.state[rows[0]] = self.before[number]
        batch.rollout(steps, self.controls[number, None, :steps], _CONTROL_SPEC, (), rows)
