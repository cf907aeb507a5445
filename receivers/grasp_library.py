"""Known grasps of objects, and selection of the grasp that is nearest to the gripper.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

import functools
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, to_numpy
from handover_marl.geometry.panda import GRIPPER_FROM_HAND, HALF_TURN
from handover_marl.geometry.poses import (
    compose,
    inverse_transform_points,
    invert_pose,
    poses_from_matrices,
    rotate_points,
)
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.policies.policy import PolicyContext

Array = npt.NDArray[np.float64]

#: Clearance beyond which more clearance makes no difference (m).
MAX_CLEARANCE = 0.2

#: Extent of the gripper along the hand link's z axis, from behind its palm to the fingertips (m).
BACK_Z, TIP_Z = -0.05, 0.11
# Entries of the observation on which the selection depends.
_INPUTS = ("gripper_pose", "object_poses", "object_classes", "hand_present", "hand_keypoints")
# Number of cached selections: environments that run side by side query in turns.
_CACHE_SIZE = 256


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
        self._load, self._index, self._factory = load, dict[int, int](), arrays
        self.arrays: list[AnyArray] = []
        self.is_grasp = arrays.zeros((0, 0), "bool")

    def find(self, classes: AnyArray) -> AnyArray:
        """Return the index (r,) of each class number in the arrays, -1 for a class without grasps."""
        numbers = to_numpy(classes).astype(int).tolist()
        for number in sorted(set(numbers) - self._index.keys()):
            known = self._load(number)
            self._index[number] = -1 if known is None else len(self.is_grasp)
            if known is not None:
                self._append(known)
        return self._factory.asarray([self._index[number] for number in numbers])

    def _append(self, known: tuple[Array, ...]) -> None:
        width = max(self.is_grasp.shape[1], len(known[0]))
        old = self.arrays or [np.zeros((0, 0, *array.shape[1:])) for array in known]
        self.arrays = [self._append_padded(before, array, width) for before, array in zip(old, known, strict=True)]
        self.is_grasp = self._append_padded(self.is_grasp, np.ones(len(known[0]), dtype=bool), width)

    def _append_padded(self, arrays: AnyArray, array: npt.NDArray[Any], width: int) -> AnyArray:
        """Append an array (g, ...) to arrays (c, w, ...), all padded with zeros to a width."""
        parts = (
            np.pad(part, [(0, 0), (0, width - part.shape[1]), *[(0, 0)] * (part.ndim - 2)])
            for part in (to_numpy(arrays), array[None])
        )
        return self._factory.asarray(np.concatenate(list(parts)))


class NearestGraspSelector:
    """Selector of the grasp that is nearest to the gripper and clear of the person's hand.

    The cost of a grasp is the gripper's translation plus weighted rotation plus missing clearance.
    Grasps rotated by half a turn about the approach axis are candidates too. A selection depends
    on the observation alone and is cached, since features and action schemes of a policy query the
    same selection.

    Args:
        context: Context of a policy, with the objects and their grasps.

    Attributes:
        rotation_weight: Weight of the gripper's rotation in the cost (m/rad).
        desired_clearance: Desired distance of the hand's joints from the gripper's axis (m).
        clearance_weight: Weight of the amount by which the clearance is below the desired one.
    """

    rotation_weight = 0.25
    desired_clearance, clearance_weight = 0.09, 4.0

    def __init__(self, context: PolicyContext) -> None:
        self._library, self._object_names = GraspLibrary(context.grasps), context.object_names
        # Hand link poses (n, 7) and z axes (n, 3) of the grasps of each object class, in its frame.
        self._known: dict[int, tuple[Array, Array] | None] = {}
        self._cache: OrderedDict[bytes, tuple[Array, float] | None] = OrderedDict()

    def select(self, observation: Observation) -> tuple[Array, float] | None:
        """Select a grasp of the object to hand over, or return None if it has no grasps.

        Returns:
            World pose (7,) of the hand link at the grasp, which is read-only, and the distance (m)
            of the person's hand from the gripper there.
        """
        key = b"".join(np.asarray(observation[name]).tobytes() for name in _INPUTS)
        if key not in self._cache:
            self._cache[key] = self._compute(observation)
            if len(self._cache) > _CACHE_SIZE:
                self._cache.popitem(last=False)
        return self._cache[key]

    def _compute(self, observation: Observation) -> tuple[Array, float] | None:
        known = self.load_known(int(observation["object_classes"][0]))
        if known is None:
            return None
        grasps, axes = known
        # In the object's frame, so that only gripper and hand have to be transformed.
        item, gripper = (observation[name].astype(np.float64) for name in ("object_poses", "gripper_pose"))
        gripper = compose(invert_pose(item[0]), gripper)
        angles = 2.0 * np.arccos(np.minimum(np.abs(grasps[:, 3:] @ gripper[3:]), 1.0))
        clearances = self._clearances(grasps, axes, item[0], observation)
        missing = np.maximum(0.0, self.desired_clearance - clearances)
        distances = np.linalg.norm(grasps[:, :3] - gripper[:3], axis=1)
        best = int(np.argmin(distances + self.rotation_weight * angles + self.clearance_weight * missing))
        selected = compose(item[0], grasps[best])
        selected.flags.writeable = False
        return selected, float(clearances[best])

    def load_known(self, object_class: int) -> tuple[Array, Array] | None:
        """Return the known grasps of an object class with their half turns, and their z axes.

        Args:
            object_class: YCB class number.

        Returns:
            Hand link poses (n, 7) and z axes (n, 3) in the object's frame, or None without grasps.
        """
        if object_class not in self._known:
            self._known[object_class] = self._load(self._object_names[object_class])
        return self._known[object_class]

    def _load(self, object_name: str) -> tuple[Array, Array] | None:
        poses = self._library.get_hand_poses_in_object(object_name)
        if poses is None:
            return None
        poses = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
        return poses, rotate_points(poses[:, 3:], np.array([0.0, 0.0, 1.0]))

    def _clearances(self, grasps: Array, axes: Array, item: Array, observation: Observation) -> Array:
        """Return the smallest distances (n,) in m of the hand's joints to the gripper's axis."""
        if not observation["hand_present"][0]:
            return np.full(len(grasps), MAX_CLEARANCE)
        joints = inverse_transform_points(item, observation["hand_keypoints"])
        offsets = joints - grasps[:, None, :3]
        along = np.clip(np.einsum("gki,gi->gk", offsets, axes), BACK_Z, TIP_Z)
        across = offsets - along[..., None] * axes[:, None]
        distances = np.sqrt(np.einsum("gki,gki->gk", across, across).min(axis=1))
        clearances: Array = np.minimum(distances, MAX_CLEARANCE)
        return clearances


@functools.lru_cache(maxsize=16)
def get_nearest_grasp_selector(context: PolicyContext) -> NearestGraspSelector:
    """Return the grasp selector of a policy context; all callers share one selector."""
    return NearestGraspSelector(context)
