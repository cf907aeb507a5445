"""Recordings of the scenes that givers play, read for many givers at once."""

import functools
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import AnyArray, AnyIndices, ArrayFactory, Indices, RowBank
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.simulation.reference_tracking import WRIST_LINK, ReferenceBatch

#: Pick-up frame of objects that are never picked up.
NEVER = np.iinfo(np.int64).max
_BASE_LINK = 5


class RecordedFrames(Protocol):
    """Interface of the recorded frames of n givers."""

    def set_scene(self, row: int, scene: Scene) -> None:
        """Choose the scene that a giver plays."""

    def read(self, rows: AnyIndices, frames: AnyArray) -> ReferenceBatch:
        """Return copies of the recorded frames (r, k) of r givers."""


class HostFrames:
    """Recorded frames as NumPy arrays, which are read from the scenes.

    Args:
        count: Number n of givers.
    """

    def __init__(self, count: int) -> None:
        self._scenes: list[Scene | None] = [None] * count
        self._hand_present: list[npt.NDArray[np.bool_]] = [np.zeros(0, dtype=bool)] * count

    def set_scene(self, row: int, scene: Scene) -> None:
        """Choose the scene that a giver plays."""
        self._scenes[row], self._hand_present[row] = scene, scene.is_hand_present(np.arange(scene.n_frames))

    def read(self, rows: Indices, frames: Indices) -> ReferenceBatch:
        """Return copies of the recorded frames (r, k) of r givers."""
        shape = frames.shape
        hand, present = np.empty((*shape, HAND_DOF), dtype=np.float32), np.empty(shape, dtype=bool)
        objects = np.zeros((*shape, MAX_OBJECTS, OBJECT_DOF), dtype=np.float32)
        for index, row in enumerate(rows.tolist()):
            scene, own = self._scenes[row], frames[index]
            if scene is None:
                raise ValueError(f"giver {row} has no scene; call reset() first")
            hand[index], present[index] = scene.hand_dof[own], self._hand_present[row][own]
            objects[index, :, : scene.object_dof.shape[1]] = scene.object_dof[own]
        return ReferenceBatch(hand, present, objects)


class DeviceFrames:
    """Recorded frames as tensors, which stay on the device. A recording of DexYCB takes 0.9 MB.

    Args:
        count: Number n of givers.
        arrays: Creator of tensors on the device.
    """

    def __init__(self, count: int, arrays: ArrayFactory) -> None:
        self._firsts = arrays.zeros(count, "int64")
        self._first_by_scene: dict[int, int] = {}
        self._hand, self._present = RowBank(arrays, (HAND_DOF,), "float32"), RowBank(arrays, (), "bool")
        self._objects = RowBank(arrays, (MAX_OBJECTS, OBJECT_DOF), "float32")

    def set_scene(self, row: int, scene: Scene) -> None:
        """Choose the scene that a giver plays, and copy it to the device unless it is there."""
        key = scene.info.scene_id
        if key not in self._first_by_scene:
            objects = np.zeros((scene.n_frames, MAX_OBJECTS, OBJECT_DOF), dtype=np.float32)
            objects[:, : scene.object_dof.shape[1]] = scene.object_dof
            self._objects.extend(objects)
            self._present.extend(scene.is_hand_present(np.arange(scene.n_frames)))
            self._first_by_scene[key] = self._hand.extend(scene.hand_dof)
        self._firsts[row] = self._first_by_scene[key]

    def read(self, rows: AnyArray, frames: AnyArray) -> ReferenceBatch:
        """Return copies of the recorded frames (r, k) of r givers."""
        places = self._firsts[rows][:, None] + frames
        return ReferenceBatch(self._hand.rows[places], self._present.rows[places], self._objects.rows[places])


def find_wrist_in_base(scene: Scene) -> npt.NDArray[np.float64]:
    """Return the (3,) position of the human wrist in the frame of the hand's base (m)."""
    wrist_in_base: npt.NDArray[np.float64] = _compute_wrist_in_base(read_tree(scene.assets.hand)).copy()
    return wrist_in_base


@functools.lru_cache(maxsize=64)
def _compute_wrist_in_base(tree: KinematicTree) -> npt.NDArray[np.float64]:
    origins, _ = tree.compute_link_frames(np.zeros((1, tree.n_dof)))
    wrist_in_base: npt.NDArray[np.float64] = origins[0, WRIST_LINK] - origins[0, _BASE_LINK]
    return wrist_in_base


def find_pick_up_frame(scene: Scene, distance: float = 0.005) -> int:
    """Return the first frame with the object farther than `distance` (m) from its start, or `NEVER`."""
    moved = np.linalg.norm(scene.object_dof[:, 0, :3] - scene.object_dof[0, 0, :3], axis=1) > distance
    return int(np.argmax(moved)) if moved.any() else NEVER
