"""Batched simulation of worlds in MuJoCo, with one batch for each model layout.

A single world is a batch of one. The states of a world do not depend on other worlds.
"""

import heapq
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.simulation.mujoco.batches.mujoco_batch import BatchSlot, MujocoBatch
from handover_marl.simulation.mujoco.engine import HandKinematics, configure_engine
from handover_marl.simulation.mujoco.scene_model import RobotOnlyModel, SceneModel
from handover_marl.simulation.mujoco.sleep import RobotOnlyRollouts

Array = npt.NDArray[np.float64]

# Largest number of worlds of a batch, whose memory is reserved even if few of them have its layout.
_MAX_BATCH_SIZE = 64
# Number of batches without worlds that are kept. A batch takes 5 MB, and 2 ms to make.
_MAX_EMPTY_BATCHES = 8


class BatchSimulation:
    """Simulation of up to `count` worlds in MuJoCo batches, in one thread.

    Args:
        count: Largest number of worlds.
    """

    def __init__(self, count: int) -> None:
        configure_engine()
        self._capacity = min(count, _MAX_BATCH_SIZE)
        self._buffers: dict[str, Array] = {}
        self._batches: dict[tuple[int, ...], list[MujocoBatch]] = {}
        self._robot_rollouts: dict[RobotOnlyModel, RobotOnlyRollouts] = {}
        self._hand_kinematics: dict[tuple[Path, int, tuple[int, ...]], HandKinematics] = {}
        # Groups that were empty when last checked, in the order in which they became so.
        self._empty_batches: list[MujocoBatch] = []

    def load_scene(self, scene: SceneModel, previous: BatchSlot | None = None) -> BatchSlot:
        """Load a scene, and return its batch slot in the initial state of the model.

        Args:
            scene: Model of the scene.
            previous: Slot of the world's previous episode, which becomes invalid.
        """
        if previous is not None and previous.world_batch.try_scene(scene, previous.row):
            slot = BatchSlot(previous.world_batch, previous.row, scene)
        else:
            if previous is not None:
                self.free(previous)
            world_batch = self._find_batch(scene)
            slot = BatchSlot(world_batch, heapq.heappop(world_batch.free_rows), scene)
        slot.world_batch.reset_row(slot.row)
        return slot

    def free(self, slot: BatchSlot) -> None:
        """Free the batch row of a slot; the slot becomes invalid."""
        world_batch = slot.world_batch
        world_batch.free_row(slot.row)
        if world_batch.is_empty:
            kept = [*(one for one in self._empty_batches if one.is_empty and one is not world_batch), world_batch]
            self._empty_batches, dropped = kept[-_MAX_EMPTY_BATCHES:], kept[:-_MAX_EMPTY_BATCHES]
            for one in dropped:
                self._batches[_get_layout(one.scene)].remove(one)

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

    def _find_batch(self, scene: SceneModel) -> MujocoBatch:
        """Return a batch with a free row that accepts the scene's model."""
        batches = self._batches.setdefault(_get_layout(scene), [])
        for batch in batches:
            if batch.free_rows and batch.try_scene(scene, batch.free_rows[0]):
                return batch
        batches.append(MujocoBatch(scene, self._capacity, self._buffers))
        return batches[-1]


def _get_layout(scene: SceneModel) -> tuple[int, ...]:
    """Return the array sizes of a scene's model, which are equal in all models of one layout."""
    model = scene.model
    return model.nq, model.nv, model.nu, model.nbody, model.ngeom, model.nbvh, model.nmocap, model.nsensordata
