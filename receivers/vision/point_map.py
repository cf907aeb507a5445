"""Voxel map of points on an object, or on a hand, from several camera views."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class PointMap:
    """Voxel map of points on the object, or on the hand that holds the object.

    Args:
        voxel_size: Edge length of the voxels, each of which keeps one point (m).
        memory: Time after which points are removed (s).

    Attributes:
        points: (n, 3) points in the map, relative to the object's center (m).
    """

    def __init__(self, voxel_size: float, memory: float) -> None:
        self._voxel_size, self._memory = voxel_size, memory
        self.points = np.zeros((0, 3))
        self._times = np.zeros(0)

    def update(self, time: float, points: Array, forget: bool) -> None:
        """Add points to the map, and remove old ones.

        Args:
            time: Present time (s).
            points: (k, 3) points relative to the object's center (m).
            forget: Whether old points are removed, provided that there are new ones.
        """
        if forget and len(points):
            kept = self._times > time - self._memory
            self.points, self._times = self.points[kept], self._times[kept]
        merged = np.concatenate([points, self.points])
        _, first = np.unique(np.floor(merged / self._voxel_size).astype(np.int64), axis=0, return_index=True)
        self.points, self._times = merged[first], np.concatenate([np.full(len(points), time), self._times])[first]
