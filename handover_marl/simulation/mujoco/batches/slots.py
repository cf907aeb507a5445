"""Interface of a batch of worlds with one model layout, and the slot of a world in it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.simulation.mujoco.contacts import SensorReadings
from handover_marl.simulation.mujoco.scene_model import SceneModel

Array = npt.NDArray[np.float64]


class BatchRollout(Protocol):
    """Rollout of k physics steps of n worlds in one batch, valid until the next rollout of the thread."""

    @property
    def readings(self) -> SensorReadings:
        """Contact-sensor readings of k steps of n worlds."""

    def truncate(self, number: int, steps: int) -> None:
        """Set a world back to its state after some steps of the rollout.

        Args:
            number: Index of the world in the rollout.
            steps: Number of steps to keep.
        """


class WorldBatch(ABC):
    """Worlds that are simulated as one batch; their models have the same layout.

    Subclasses set the arrays, which are writable views of the state of all rows.

    Args:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.

    Attributes:
        scene: Scene model with the layout of the batch.
        capacity: Largest number of worlds.
        free_rows: Heap of the numbers of the rows without a world.
        scratch: MuJoCo data for computations that do not change a world.
        qpos: Joint positions (n, q) of all rows.
        qvel: Joint velocities (n, v) of all rows.
        forces: External forces (n, b, 6) on the bodies of all rows.
        ctrl: Actuator targets (n, u) of all rows.
        mocap_pos: Positions (n, m, 3) of the mocap bodies of all rows (m).
        mocap_quat: Quaternions wxyz (n, m, 4) of the mocap bodies of all rows.
        time: Simulation times (n,) of all rows (s).
        recorded: Sensor data (n, s) and joint positions (n, q) of all rows.
    """

    qpos: Array
    qvel: Array
    forces: Array
    ctrl: Array
    mocap_pos: Array
    mocap_quat: Array
    time: Array
    recorded: list[Array]

    def __init__(self, scene: SceneModel, capacity: int) -> None:
        self.scene, self.capacity = scene, capacity
        self.free_rows = list(range(capacity))
        self.scratch = mujoco.MjData(scene.model)

    @property
    def is_empty(self) -> bool:
        """Whether the batch has no world."""
        return len(self.free_rows) == self.capacity

    @abstractmethod
    def try_scene(self, scene: SceneModel, row: int) -> bool:
        """Set the scene of a row if its model has the layout of the batch, and return whether it has."""

    @abstractmethod
    def reset_row(self, row: int) -> None:
        """Set a row to the initial state of its model."""

    @abstractmethod
    def free_row(self, row: int) -> None:
        """Mark a row as free for another world, and release its model."""

    @abstractmethod
    def select_models(self, slots: Sequence["BatchSlot"], hands: Sequence[bool]) -> None:
        """Choose the models of worlds for the coming steps.

        Args:
            slots: Slots of worlds in this batch.
            hands: Whether the hand can collide in these steps, for each slot.
        """

    @abstractmethod
    def step(self, slot: "BatchSlot") -> None:
        """Simulate one physics step of a world with its current controls.

        Raises:
            SimulationError: The engine failed; the state is invalid.
        """

    @abstractmethod
    def simulate(self, slots: Sequence["BatchSlot"], controls: Sequence[Array]) -> BatchRollout:
        """Simulate k physics steps of some worlds.

        Args:
            slots: Slots in the order of their rows.
            controls: Controls (k, c) of each slot: actuator targets, mocap positions, mocap
                quaternions wxyz.

        Raises:
            SimulationError: The engine failed; the states of these worlds are invalid.
        """


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
        self.world_batch.time[self.row] = seconds

    def step(self) -> None:
        """Simulate one physics step of the world with its current controls.

        Raises:
            SimulationError: The engine failed; the state is invalid.
        """
        self.world_batch.step(self)

    def read_sensors(self) -> SensorReadings:
        """Return the contact-sensor readings of the last physics step."""
        return SensorReadings(self.scene.contact_sensors, *(array[self.row] for array in self.world_batch.recorded))

    def compute_body_poses(self) -> tuple[Array, Array]:
        """Compute the world positions (b, 3) and quaternions wxyz (b, 4) of all bodies."""
        scratch = self.world_batch.scratch
        scratch.qpos[:] = self.qpos
        mujoco.mj_kinematics(self.scene.model, scratch)
        return scratch.xpos, scratch.xquat
