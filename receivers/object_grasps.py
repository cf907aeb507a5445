"""Grasps of the object that is handed over, as poses in the world."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import compose, poses_from_matrices
from handover_marl.models.ycb import CLASS_NAMES

Poses = npt.NDArray[np.float64]


class ObjectGrasps:
    """The grasps of every class, read when they are asked for.

    Args:
        grasps: Gives the (n, 4, 4) gripper poses in the object's frame (m) for a class name, or None.
    """

    def __init__(self, grasps: Callable[[str], npt.NDArray[np.float64] | None]) -> None:
        self._grasps = grasps
        self._known: dict[str, Poses | None] = {}

    def in_world(self, observation: Observation) -> Poses | None:
        """(n, 7) world poses of the hand link at the target object's grasps, or None if it has none."""
        grippers = self._of(CLASS_NAMES[int(observation["object_classes"][0])])
        if grippers is None:
            return None
        # In this order and not by `in_object`: the reference's last bits depend on it.
        return compose(compose(observation["object_poses"][0], grippers), np.array(GRIPPER_FROM_HAND))

    def in_object(self, object_name: str) -> Poses | None:
        """(n, 7) poses of the hand link in the frame of an object class, or None if it has no grasps."""
        grippers = self._of(object_name)
        return None if grippers is None else compose(grippers, np.array(GRIPPER_FROM_HAND))

    def _of(self, object_name: str) -> Poses | None:
        if object_name not in self._known:
            transforms = self._grasps(object_name)
            if transforms is None or len(transforms) == 0:
                self._known[object_name] = None
            else:
                self._known[object_name] = poses_from_matrices(transforms)
        return self._known[object_name]
