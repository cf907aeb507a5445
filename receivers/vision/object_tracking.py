"""Tracking of an object between camera views: filter of its position, and registration of its surface."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

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
        """Add points (k, 3) relative to the object's center (m), and remove old ones if wanted."""
        if forget and len(points):
            kept = self._times > time - self._memory
            self.points, self._times = self.points[kept], self._times[kept]
        merged = np.concatenate([points, self.points])
        _, first = np.unique(np.floor(merged / self._voxel_size).astype(np.int64), axis=0, return_index=True)
        self.points, self._times = merged[first], np.concatenate([np.full(len(points), time), self._times])[first]


# Numbers of points that are matched and that a keyframe keeps, iterations of the registration,
# share of the closest matches that are used, and number of matches below which it fails.
_N_MATCHED, _N_KEPT, _N_ITERATIONS, _TRIM_RATIO, _MIN_MATCHES = 200, 500, 4, 0.8, 20
# Neighbours of a point that define its surface normal.
_N_NEIGHBORS = 8
# Relative regularization: directions that the surface does not constrain are not corrected.
_REGULARIZATION = 0.01


class FilterGains(NamedTuple):
    """Filter gains with which a new camera view corrects the estimated object and grasp.

    Attributes:
        position: Share of the error of the predicted object position that is added to the position.
        velocity: Share of the position error per time step that is added to the velocity.
        grasp: Weight of newly predicted grasps in the update of the selected grasp, 0 to 1.
    """

    position: float
    velocity: float
    grasp: float


class PositionFilter:
    """Filter of an object's position and velocity in the world (g-h filter).

    Args:
        velocity_decay: Share of the velocity that is lost at each update without a measurement.

    Attributes:
        position: (3,) estimated position (m), None before the first measurement.
        velocity: (3,) estimated velocity (m/s).
    """

    def __init__(self, velocity_decay: float) -> None:
        self._velocity_decay = velocity_decay
        self.position: Array | None = None
        self.velocity = np.zeros(3)
        self._time = 0.0

    def update(self, time: float, position: Array, gains: FilterGains) -> None:
        """Update position and velocity by a measured position (3,) in m at a time (s)."""
        if self.position is None:
            self.position = position.copy()
        elif time > self._time:
            step = time - self._time
            error = position - self.position - step * self.velocity
            self.position = self.position + step * self.velocity + gains.position * error
            self.velocity = self.velocity + gains.velocity * error / step
        self._time = time

    def predict(self, time: float) -> Array:
        """Return the position (3,) in m predicted for a time (s).

        Raises:
            ValueError: No position has been measured yet.
        """
        if self.position is None:
            raise ValueError("no position yet; call update() first")
        return self.position + (time - self._time) * self.velocity

    def coast(self, time: float) -> None:
        """Advance the estimate to a time (s) without a measurement; the velocity decays."""
        if self.position is not None and time > self._time:
            self.velocity = (1.0 - self._velocity_decay) * self.velocity
            self.position = self.position + (time - self._time) * self.velocity
            self._time = time


class Keyframe:
    """Point cloud to which later clouds are registered, so that errors do not accumulate.

    Args:
        points: (k, 3) points relative to the object's center (m).
    """

    def __init__(self, points: Array) -> None:
        self._points = points[:: max(1, len(points) // _N_KEPT)]
        self._tree = cKDTree(self._points)
        _, neighbors = self._tree.query(self._points, k=min(_N_NEIGHBORS, len(self._points)))
        offsets = self._points[neighbors] - self._points[neighbors].mean(axis=1, keepdims=True)
        self._normals: Array = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]

    def register(self, points: Array, max_distance: float) -> tuple[Array, float]:
        """Return the translation (3,) in m from the keyframe to points (k, 3), and the share of matches.

        Point-to-plane registration (Chen and Medioni, 1992) without rotation. Directions that the surface does
        not constrain, such as along a plane, are zero. Matches are at most `max_distance` apart (m).
        """
        translation, share = np.zeros(3), 0.0
        sampled = points[:: max(1, len(points) // _N_MATCHED)]
        for _ in range(_N_ITERATIONS):
            distances, nearest = self._tree.query(sampled - translation, distance_upper_bound=max_distance)
            is_matched = np.isfinite(distances)
            share = float(is_matched.mean())
            if is_matched.sum() < _MIN_MATCHES:
                return translation, 0.0
            used = distances <= np.quantile(distances[is_matched], _TRIM_RATIO)
            normals = self._normals[nearest[used]]
            errors = np.einsum("nk,nk->n", normals, sampled[used] - translation - self._points[nearest[used]])
            stiffness = normals.T @ normals + _REGULARIZATION * len(normals) * np.eye(3)
            translation = translation + np.linalg.solve(stiffness, normals.T @ errors)
        return translation, share
