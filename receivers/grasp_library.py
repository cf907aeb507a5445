"""Known grasps of objects.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, to_numpy
from handover_marl.geometry.panda import GRIPPER_FROM_HAND
from handover_marl.geometry.poses import compose, poses_from_matrices
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]


class GraspLibrary:
    """Collection of the known grasps of all object classes, each read on first use.

    Args:
        grasps: Function from a class name to gripper poses (n, 4, 4) in the object's frame (m), or
            None for a class without grasps.
        object_names: Class name of each class number in observations.
    """

    def __init__(
        self,
        grasps: Callable[[str], npt.NDArray[np.float64] | None],
        object_names: Mapping[int, str] = CLASS_NAMES,
    ) -> None:
        self._grasps, self._object_names = grasps, object_names
        self._grippers: dict[str, Array | None] = {}

    def load_grippers(self, object_class: int) -> tuple[Array] | None:
        """Return the gripper poses (n, 7) in the frame of the object class with a number, for a `GraspTable`."""
        grippers = self.get_gripper_poses(self._object_names[object_class])
        return None if grippers is None else (grippers,)

    def get_hand_poses_in_object(self, object_name: str) -> Array | None:
        """Return poses (n, 7) of the hand link at an object class's grasps, or None without any."""
        grippers = self.get_gripper_poses(object_name)
        return None if grippers is None else compose(grippers, np.array(GRIPPER_FROM_HAND))

    def get_gripper_poses(self, object_name: str) -> Array | None:
        """Return the gripper poses (n, 7) in the frame of an object class, or None."""
        if object_name not in self._grippers:
            matrices = self._grasps(object_name)
            self._grippers[object_name] = None
            if matrices is not None and len(matrices) > 0:
                self._grippers[object_name] = poses_from_matrices(matrices)
        return self._grippers[object_name]


class GraspTable:
    """Grasps of object classes in arrays, which are padded to the largest number of grasps of a class.

    Args:
        load: Function from a class number to NumPy arrays (g, ...) of the class's g grasps, or None without any; called
            when a class is needed first.
        arrays: Creator of the arrays.

    Attributes:
        arrays: Array (c, g, ...) for each array of `load`, padded with zeros.
        is_grasp: Whether there is a grasp at each place of the arrays, (c, g).
    """

    def __init__(self, load: Callable[[int], tuple[Array, ...] | None], arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._load, self._factory = load, arrays
        # Arrays of each class with grasps, and their places by class number.
        self._known: list[tuple[Array, ...]] = []
        self._index: dict[int, int] = {}
        self.arrays: list[AnyArray] = []
        self.is_grasp = arrays.zeros((0, 0), "bool")

    def find(self, classes: AnyArray) -> AnyArray:
        """Return the index (r,) of each class number in the arrays, -1 for a class without grasps."""
        numbers, n_before = to_numpy(classes).astype(int).tolist(), len(self._known)
        for number in sorted(set(numbers) - self._index.keys()):
            known = self._load(number)
            self._index[number] = -1 if known is None else len(self._known)
            self._known += [] if known is None else [known]
        if len(self._known) > n_before:
            counts = np.array([len(first) for first, *_ in self._known])
            self.is_grasp = self._factory.asarray(np.arange(counts.max()) < counts[:, None])
            self.arrays = []
            for column in zip(*self._known, strict=True):
                padded = np.zeros((*self.is_grasp.shape, *column[0].shape[1:]))
                for own, array in zip(padded, column, strict=True):
                    own[: len(array)] = array
                self.arrays.append(self._factory.asarray(padded))
        return self._factory.asarray([self._index[number] for number in numbers])
