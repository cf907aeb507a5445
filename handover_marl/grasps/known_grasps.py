"""Known grasps of objects, as poses (m, quaternion xyzw) of the gripper or of the Panda's hand link."""

import functools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, to_numpy
from handover_marl.geometry.panda import GRIPPER_FROM_HAND
from handover_marl.geometry.poses import compose, poses_from_matrices

Array = npt.NDArray[np.float64]


@functools.lru_cache(maxsize=1024)
def load_gripper_poses(grasps: Callable[[str], Array | None], object_name: str) -> Array | None:
    """Return the gripper poses (n, 7) at the known grasps of an object class, in the object's frame; cached.

    The gripper frame of grasp files is the hand link's frame rotated by 90 degrees about z, the approach axis. The
    function `grasps` is `PolicyContext.load_grasps`. For a class without grasps, None is returned.
    """
    matrices = grasps(object_name)
    return None if matrices is None or not len(matrices) else poses_from_matrices(matrices)


def load_hand_poses(grasps: Callable[[str], Array | None], object_name: str) -> Array | None:
    """Return the hand link's poses (n, 7) at the known grasps of an object class, in the object's frame, or None."""
    grippers = load_gripper_poses(grasps, object_name)
    return None if grippers is None else compose(grippers, np.array(GRIPPER_FROM_HAND))


class GraspTable:
    """Grasps of c object classes in arrays (c, g, ...), padded with zeros to the largest number g of grasps of a class.

    `find` calls the function `load` once for each class, with the class number. `load` returns a tuple of NumPy arrays
    with a row for each grasp, or None for a class without grasps. The attribute `arrays` has a padded array for each
    array of this tuple, made by the argument `arrays`; `is_grasp` (c, g) is False at padding.
    """

    def __init__(self, load: Callable[[int], tuple[Array, ...] | None], arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._load, self._factory = load, arrays
        # Arrays of each class with grasps, and by class number, its index in this list, -1 without grasps.
        self._known: list[tuple[Array, ...]] = []
        self._index: dict[int, int] = {}
        self.arrays: list[AnyArray] = []
        self.is_grasp = arrays.zeros((0, 0), "bool")

    def find(self, classes: AnyArray) -> AnyArray:
        """Return the indices (r,) in `arrays` of class numbers (r,), -1 without grasps; load classes that are new."""
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
