"""Tracking of object, person's hand and grasp candidates from the point clouds of the wrist camera."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import HALF_TURN, PAD_DISTANCE
from handover_marl.geometry.poses import compose, transform_points
from handover_marl.grasps.validation import compute_grasp_distances, make_offset_pose
from handover_marl.planning.robot_clearance import Spheres
from handover_marl.receivers.vision.grasp_predictor import GraspPrediction, GraspPredictor

Array = npt.NDArray[np.float64]


class FilterGains(NamedTuple):
    """Filter gains with which a new camera view corrects the object's motion and the selected grasp.

    Attributes:
        position: Share of the error of the predicted object position that is added to the position.
        velocity: Share of this error, divided by the time step, that is added to the velocity.
        grasp: Weight of newly predicted grasps in the update of the selected grasp, 0 to 1.
    """

    position: float
    velocity: float
    grasp: float


# Registration: number of matched points, number of points in a keyframe, number of iterations, share of the closest
# matches that is used, and number of matches below which the registration fails.
_N_MATCHED, _N_KEPT, _N_ITERATIONS, _TRIM_RATIO, _MIN_MATCHES = 200, 500, 4, 0.8, 20
# Number of neighbors of a point that define its surface normal.
_N_NEIGHBORS = 8
# Relative regularization of the registration, which leaves unconstrained directions uncorrected.
_REGULARIZATION = 0.01
# Smallest number of object points in a view, below which the object counts as not visible; time without a view after
# which the tracker is reset at the next view (s).
_MIN_POINTS, LOST_TIMEOUT = 20, 0.12
# Candidates: maximum number, minimum predicted quality q, and factor on their cost -log(q) (s).
_MAX_GRASPS, _MIN_QUALITY, COST_SCALE = 48, 0.02, 3.0
# Copies that are added if no candidate is suitable: rotations about the line between the pads (rad), and cost (s).
_TILTS, _TILT_COST = (-0.35, 0.35, -0.7, 0.7), 1.5
# Distance below which two grasps count as the same (m), weight of rotations in this distance (m/rad), cost added to the
# selected grasp by each view in which it is not predicted (s), and cost of a grasp that has failed (s).
_SAME_DISTANCE, _ROTATION_WEIGHT, _UNSEEN_COST, _FAILED_COST = 0.03, 0.06, 0.1, 10.0
# Filter gains while the object is far from the gripper, closer than _NEAR_DISTANCE (m), or the selected grasp is closer
# than _FINAL_DISTANCE (m). Near objects hide the person's hand, so the maps keep old points while the object is near.
_FAR_GAINS, _NEAR_GAINS = FilterGains(0.5, 0.1, 0.4), FilterGains(0.9, 0.1, 0.1)
_FINAL_GAINS = FilterGains(0.9, 0.1, 0.02)
_NEAR_DISTANCE, _FINAL_DISTANCE = 0.3, 0.07
# Registration: maximum distance of matched points (m), share of matched points below which it has failed, share below
# which a new keyframe is taken, and distance from the predicted center beyond which it has found another body (m).
_MAX_MATCH_DISTANCE, _MIN_MATCHED_SHARE, _KEYFRAME_SHARE, _MAX_CENTER_ERROR = 0.03, 0.3, 0.6, 0.05
# Speed below which the object counts as at rest (m/s), and share of its velocity lost in each view without the object.
_REST_SPEED, _VELOCITY_DECAY = 0.04, 0.4
# Radius of the spheres at points (m), edge length of the voxels that keep one point each (m), and times after which
# points of hand and object are removed (s); the second is shorter, since the object rotates while it is lifted.
_SPHERE_RADIUS, _VOXEL_SIZE, _HAND_MEMORY, _OBJECT_MEMORY = 0.01, 0.012, 1.5, 0.4
# Absolute sum of votes below which a voxel is forgotten.
_MIN_VOTES = 0.01
# Open fingers in the hand link's frame (m), which close along y and approach along z: sides, half width along x, tip.
_INNER_Y, _OUTER_Y, _HALF_WIDTH, _TIP_Z = 0.039, 0.056, 0.01, 0.112
# Finger collisions: number of checked points; tried shifts, the smallest first (m); costs of shift and of remaining
# penetration depth (s/m); depth without a cost (m).
_N_FINGER_POINTS, _LATERAL_SHIFTS = 400, (0.0, -0.006, 0.006, -0.012, 0.012, -0.018, 0.018)
SHIFT_COST, COLLISION_COST, _FREE_DEPTH = 20.0, 60.0, 0.003


class VoxelMap:
    """Voxel map of points on the object, or on the person's hand that holds it.

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
        """Add points (k, 3) (m) relative to the object's center at a time (s); if k > 0, `forget` drops old points."""
        if forget and len(points):
            kept = self._times > time - self._memory
            self.points, self._times = self.points[kept], self._times[kept]
        merged = np.concatenate([points, self.points])
        _, first = np.unique(np.floor(merged / self._voxel_size).astype(np.int64), axis=0, return_index=True)
        self.points, self._times = merged[first], np.concatenate([np.full(len(points), time), self._times])[first]


class LabelVotes:
    """Votes of recent views on whether a voxel shows the object or the person's hand.

    Args:
        voxel_size: Edge length of the voxels (m).
        memory: Time in which the weight of a vote falls to 37 % (s).
    """

    def __init__(self, voxel_size: float, memory: float) -> None:
        self._voxel_size, self._memory = voxel_size, memory
        self._voxels, self._votes, self._time = np.zeros((0, 3), dtype=np.int64), np.zeros(0), 0.0

    def update(self, time: float, points: Array, is_hand: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Add the votes of a view at a time (s); return a mask (n,) of its points that show the hand by all votes.

        Points (n, 3) of object and hand are relative to the object's center (m); `is_hand` (n,) is the view's own label
        of each point. A view's vote on a voxel is the mean of the labels of its points there.
        """
        own, places = np.unique(np.floor(points / self._voxel_size).astype(np.int64), axis=0, return_inverse=True)
        places = places.reshape(-1)  # NumPy 2.0 returns (n, 1)
        votes = np.bincount(places, np.where(is_hand, 1.0, -1.0)) / np.bincount(places)
        old = self._votes * np.exp((self._time - time) / self._memory)
        kept = np.abs(old) > _MIN_VOTES
        self._voxels, rows = np.unique(np.concatenate([own, self._voxels[kept]]), axis=0, return_inverse=True)
        rows = rows.reshape(-1)
        self._votes = np.asarray(np.bincount(rows, np.concatenate([votes, old[kept]])), dtype=np.float64)
        self._time = time
        found: npt.NDArray[np.bool_] = self._votes[rows[: len(own)][places]] > 0.0
        return found


class PositionFilter:
    """Filter of an object's position and velocity in the world (g-h filter).

    Attributes:
        is_known: Whether a position has been measured.
        position: (3,) estimated position (m).
        velocity: (3,) estimated velocity (m/s).
    """

    def __init__(self) -> None:
        self.is_known, self.position, self.velocity = False, np.zeros(3), np.zeros(3)
        self._time = 0.0

    def update(self, time: float, position: Array, gains: FilterGains) -> None:
        """Correct the estimate with a position (3,) (m) that was measured at a time (s), by filter gains."""
        if not self.is_known:
            self.is_known, self.position = True, position.copy()
        elif time > self._time:
            step = time - self._time
            error = position - self.position - step * self.velocity
            self.position = self.position + step * self.velocity + gains.position * error
            self.velocity = self.velocity + gains.velocity * error / step
        self._time = time

    def predict(self, time: float) -> Array:
        """Return the position (3,) in m predicted for a time (s)."""
        return self.position + (time - self._time) * self.velocity

    def coast(self, time: float) -> None:
        """Advance the estimate to a time (s) without a measurement; the velocity decays."""
        if self.is_known and time > self._time:
            self.velocity = (1.0 - _VELOCITY_DECAY) * self.velocity
            self.position = self.position + (time - self._time) * self.velocity
            self._time = time


class Keyframe:
    """Point cloud to which later ones are registered, so that tracking errors do not accumulate.

    Args:
        points: (k, 3) points relative to the object's center (m).
    """

    def __init__(self, points: Array) -> None:
        self._points = points[:: max(1, len(points) // _N_KEPT)]
        self._tree = cKDTree(self._points)
        _, neighbors = self._tree.query(self._points, k=min(_N_NEIGHBORS, len(self._points)))
        offsets = self._points[neighbors] - self._points[neighbors].mean(axis=1, keepdims=True)
        self._normals: Array = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]

    def register(self, points: Array) -> tuple[Array, float]:
        """Return the translation (3,) in m from the keyframe to points (k, 3), and the share of points that match it.

        This is point-to-plane registration (Chen and Medioni, 1992) without rotation. The translation is zero in
        directions that the surface does not constrain, such as along a plane. The share is 0 if too few points match.
        """
        translation, share = np.zeros(3), 0.0
        sampled = points[:: max(1, len(points) // _N_MATCHED)]
        for _ in range(_N_ITERATIONS):
            distances, nearest = self._tree.query(sampled - translation, distance_upper_bound=_MAX_MATCH_DISTANCE)
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


class GraspTracker:
    """Tracker of the object, the person's hand and grasp candidates during one episode.

    Args:
        predict: Function that predicts grasps from a point cloud.
        seed: Seed of the random selection of points for the predictions.

    Attributes:
        position: Filter that estimates the object's center in the world.
        grasps: (n, 7) candidate poses (quaternion xyzw) of the hand link relative to the object's center, in world
            orientation; the first is the selected one, if any.
        costs: (n,) costs of the candidates (s).
        surface: Spheres at the visible part of the object, relative to its center.
        human_hand: Spheres at remembered points of the person's hand in the world, or None without such points.
        selected: (7,) selected grasp relative to the object's center, which is tracked; None without a selection.
        use_all: Whether all predicted grasps and tilted copies of them are candidates, not only the best ones.
        lost_timeout: Time without a view of the object after which the tracker is reset at the next view (s).
    """

    def __init__(self, predict: GraspPredictor, seed: int | None) -> None:
        self._predict = predict
        self._rng = np.random.default_rng(0 if seed is None else seed)
        self.grasps, self.costs = np.zeros((0, 7)), np.zeros(0)
        self.surface = Spheres(np.zeros((1, 3)), np.zeros(1))
        self.human_hand: Spheres | None = None
        self.use_all = False
        self.lost_timeout = LOST_TIMEOUT
        self._seen_at = -np.inf
        self.selected: Array | None = None
        self._selected_cost = 0.0
        self._failed: list[tuple[Array, float]] = []
        self._restart()

    def _restart(self) -> None:
        """Reset the object's motion, the maps of points and the selected grasp."""
        self.position = PositionFilter()
        self._object_map = VoxelMap(_VOXEL_SIZE, _OBJECT_MEMORY)
        self._hand_map = VoxelMap(_VOXEL_SIZE, _HAND_MEMORY)
        self.selected = None
        self._keyframe: Keyframe | None = None

    @property
    def object_pose(self) -> Array:
        """(7,) world pose (quaternion xyzw) of the object's center, with the identity rotation."""
        return np.array([*self.position.position, 0.0, 0.0, 0.0, 1.0])

    @property
    def velocity(self) -> Array:
        """(3,) velocity of the object and of the person's hand in the world (m/s); zero below 0.04 m/s."""
        is_moving = float(np.linalg.norm(self.position.velocity)) > _REST_SPEED
        return self.position.velocity if is_moving else np.zeros(3)

    def compute_unseen_time(self, time: float) -> float:
        """Return the time since the object was last visible, at `time` (s); infinite if it never was."""
        return time - self._seen_at

    def add_failed(self, grasp: Array, until: float) -> None:
        """Increase the cost of a grasp (7,) relative to the object's center, and of its half turn, until a time (s)."""
        self._failed += [(grasp, until), (compose(grasp, np.array(HALF_TURN)), until)]

    def update(self, time: float, gripper_pose: Array, object_points: Array, hand_points: Array) -> None:
        """Update object, hand and grasp candidates from a view of the wrist camera at a time (s).

        Points (n, 3) of object and person's hand are in the hand link's frame (m); `gripper_pose` (7,) is the hand
        link's world pose (quaternion xyzw). With fewer than 20 object points, the object's motion is extrapolated,
        and only the selected grasp, if any, remains a candidate.
        """
        if len(object_points) < _MIN_POINTS:
            self.position.coast(time)
            self._update_maps(time, gripper_pose, object_points, hand_points)
            self._set_candidates(np.zeros((0, 7)), np.zeros(0), time, _FAR_GAINS)
            return
        if self.compute_unseen_time(time) > self.lost_timeout:
            self._restart()
        self._seen_at = time
        velocity = Rotation.from_quat(gripper_pose[3:]).inv().apply(self.position.velocity)
        prediction = self._predict(object_points, hand_points, velocity, self._rng)
        gains = self._select_gains(gripper_pose)
        self._update_position(time, gripper_pose, object_points, prediction, gains)
        self._update_maps(time, gripper_pose, object_points, hand_points)
        checked = object_points[:: max(1, len(object_points) // _N_FINGER_POINTS)]
        grasps, costs = self._compute_candidates(prediction, checked, gripper_pose)
        if self.selected is not None and gains is not _FINAL_GAINS:
            points = transform_points(gripper_pose, checked) - self.object_pose[:3]
            shifted, extra = shift_to_avoid_collisions(self.selected[None], points)
            self.selected, self._selected_cost = shifted[0], self._selected_cost + _UNSEEN_COST * float(extra[0])
        self._set_candidates(grasps, costs, time, gains)

    def _compute_candidates(
        self, prediction: GraspPrediction, points: Array, gripper_pose: Array
    ) -> tuple[Array, Array]:
        """Return candidates (n, 7), relative to the object's center, and their costs (n,) in s from a prediction.

        Points (k, 3) of the object, for finger collisions, are in the hand link's frame (m).
        """
        quality = prediction.quality
        order = np.argsort(-quality, kind="stable")
        if not self.use_all:
            order = order[:_MAX_GRASPS]
            order = order[quality[order] > _MIN_QUALITY]
        shifted, extra = shift_to_avoid_collisions(prediction.grasps[order], points)
        grasps = compose(gripper_pose, shifted)
        grasps[:, :3] -= self.object_pose[:3]
        costs = extra - COST_SCALE * np.log(quality[order])
        if self.use_all and len(grasps):
            tilts = [make_offset_pose(tilt) for tilt in _TILTS]
            grasps = np.concatenate([grasps, *(compose(grasps, tilt) for tilt in tilts)])
            costs = np.concatenate([costs, np.tile(costs + _TILT_COST, len(tilts))])
        return grasps, costs

    def _is_near(self, gripper_pose: Array) -> bool:
        """Return whether the object is near the hand link at a pose (7,)."""
        distance = float(np.linalg.norm(self.object_pose[:3] - gripper_pose[:3]))
        return self.position.is_known and distance < _NEAR_DISTANCE

    def _select_gains(self, gripper_pose: Array) -> FilterGains:
        """Return the filter gains for a view from the hand link at a pose (7,)."""
        if self.position.is_known and self.selected is not None:
            grasp = self.object_pose[:3] + self.selected[:3]
            if float(np.linalg.norm(grasp - gripper_pose[:3])) < _FINAL_DISTANCE:
                return _FINAL_GAINS
        return _NEAR_GAINS if self._is_near(gripper_pose) else _FAR_GAINS

    def _update_position(
        self, time: float, gripper_pose: Array, object_points: Array, prediction: GraspPrediction, gains: FilterGains
    ) -> None:
        """Update the object's position from a view; arguments as in `update`.

        Near the object, the camera sees only a part of it, so the network does not predict the center well. There, the
        visible surface is registered to a keyframe instead.
        """
        cloud = transform_points(gripper_pose, object_points)
        center = transform_points(gripper_pose, prediction.center)
        share = 0.0
        if gains is _FAR_GAINS:
            self._keyframe = None
        elif self._keyframe is not None:
            predicted = self.position.predict(time)
            translation, share = self._keyframe.register(cloud - predicted)
            error = float(np.linalg.norm(predicted + translation - center))
            has_strayed = error > _MAX_CENTER_ERROR and gains is not _FINAL_GAINS
            if share < _MIN_MATCHED_SHARE or has_strayed:
                # Another body is being tracked.
                self._restart()
                share = 0.0
            else:
                center = predicted + translation
        self.position.update(time, center, gains if share else _FAR_GAINS)
        if gains is not _FAR_GAINS and share < _KEYFRAME_SHARE:
            self._keyframe = Keyframe(cloud - self.object_pose[:3])

    def _update_maps(self, time: float, gripper_pose: Array, object_points: Array, hand_points: Array) -> None:
        """Add points (n, 3) in the hand link's frame (m) to the maps of object and person's hand."""
        if not self.position.is_known:
            return
        center = self.object_pose[:3]
        forget = not self._is_near(gripper_pose)
        for point_map, points in ((self._object_map, object_points), (self._hand_map, hand_points)):
            point_map.update(time, transform_points(gripper_pose, points) - center, forget)
        self.surface = Spheres(self._object_map.points, np.full(len(self._object_map.points), _SPHERE_RADIUS))
        centers = center + self._hand_map.points
        self.human_hand = Spheres(centers, np.full(len(centers), _SPHERE_RADIUS)) if len(centers) else None

    def _set_candidates(self, grasps: Array, costs: Array, time: float, gains: FilterGains) -> None:
        """Set the candidates: the selected grasp, if any, then the grasps (n, 7) of a view and their half turns."""
        candidates = np.concatenate([grasps, compose(grasps, np.array(HALF_TURN))]) if len(grasps) else grasps
        all_costs = np.concatenate([costs, costs])
        if self.selected is not None:
            selected = self._correct_selected(self.selected, candidates, all_costs, gains.grasp)
            self.selected = selected
            candidates = np.concatenate([selected[None], candidates])
            all_costs = np.append(self._selected_cost, all_costs)
        self._failed = [(pose, until) for pose, until in self._failed if until > time]
        for pose, _ in self._failed:
            distances = compute_grasp_distances(pose, candidates, _ROTATION_WEIGHT, PAD_DISTANCE)
            all_costs[distances < _SAME_DISTANCE] += _FAILED_COST
        self.grasps, self.costs = candidates, all_costs

    def _correct_selected(self, selected: Array, grasps: Array, costs: Array, gain: float) -> Array:
        """Return the selected grasp (7,), moved by `gain` (0 to 1) to the mean of predicted grasps near it, if any."""
        distances = compute_grasp_distances(selected, grasps, _ROTATION_WEIGHT, PAD_DISTANCE)
        same = np.flatnonzero(distances < _SAME_DISTANCE)
        if not len(same):
            self._selected_cost += _UNSEEN_COST
            return selected
        weights = np.exp(-costs[same] / COST_SCALE - (2.0 * distances[same] / _SAME_DISTANCE) ** 2)
        weights /= weights.sum()
        signs = np.sign(grasps[same, 3:] @ selected[3:])
        mean = np.concatenate([weights @ grasps[same, :3], weights @ (signs[:, None] * grasps[same, 3:])])
        mean[3:] *= np.sign(mean[3:] @ selected[3:])
        corrected: Array = (1.0 - gain) * selected + gain * mean
        corrected[3:] /= np.linalg.norm(corrected[3:])
        self._selected_cost = (1.0 - gain) * self._selected_cost + gain * float(weights @ costs[same])
        return corrected


def shift_to_avoid_collisions(grasps: Array, points: Array) -> tuple[Array, Array]:
    """Shift grasps (n, 7) sideways by the smallest of seven shifts that minimizes the depth of finger collisions.

    Return the shifted grasps, and the costs (n,) in s of shifts and remaining collisions. The object's points (k, 3)
    (m) and the grasps (quaternion xyzw) are in the same frame.
    """
    rotations = Rotation.from_quat(grasps[:, 3:]).as_matrix() if len(grasps) else np.zeros((0, 3, 3))
    local = np.einsum("nkj,nji->nki", points[None] - grasps[:, None, :3], rotations)
    is_between, depth = np.abs(local[..., 0]) < _HALF_WIDTH, _TIP_Z - local[..., 2]
    depths = []
    for shift in _LATERAL_SHIFTS:
        lateral = np.abs(local[..., 1] - shift)
        is_hit = is_between & (lateral > _INNER_Y) & (lateral < _OUTER_Y)
        depths.append(np.where(is_hit, depth, 0.0).max(axis=1, initial=0.0))
    best = np.argmin(np.round(np.stack(depths), 3), axis=0)
    shifts = np.array(_LATERAL_SHIFTS)[best]
    offsets = np.zeros((len(grasps), 7))
    offsets[:, 1], offsets[:, 6] = shifts, 1.0
    remaining = np.maximum(np.stack(depths)[best, np.arange(len(grasps))] - _FREE_DEPTH, 0.0)
    return compose(grasps, offsets), SHIFT_COST * np.abs(shifts) + COLLISION_COST * remaining
