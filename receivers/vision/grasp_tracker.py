"""Tracking of object, hand and grasp candidates from the point clouds of the wrist camera."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, transform_points
from handover_marl.planning.clearance import Spheres
from handover_marl.receivers.reactive.grasps import make_offset_pose
from handover_marl.receivers.vision.config import GraspTrackerConfig
from handover_marl.receivers.vision.finger_clearance import shift_to_avoid_collisions
from handover_marl.receivers.vision.grasp_predictor import GraspPrediction, GraspPredictor
from handover_marl.receivers.vision.object_tracking import FilterGains, Keyframe, PointMap, PositionFilter

Array = npt.NDArray[np.float64]


class GraspTracker:
    """Tracker of the object, the person's hand and grasp candidates during one episode.

    Args:
        predict: Function that predicts grasps from a point cloud.
        config: Configuration of the tracker.
        seed: Seed of the points that are sampled for the prediction.

    Attributes:
        position: Filter that estimates the object's center in the world.
        grasps: (n, 7) candidate poses of the hand link relative to the object's center; the
            first is the selected one, if any.
        costs: (n,) costs of the candidates (s).
        surface: Spheres at the visible part of the object, relative to its center.
        human_hand: Spheres at the visible part of the person's hand in the world, or None if no part is visible.
        selected: (7,) grasp that is tracked, relative to the object's center, or None.
        use_all: Whether the candidates are all predicted grasps and tilted copies of them.
        lost_timeout: Time without a view of the object after which the tracker is reset at the next view (s).
    """

    def __init__(self, predict: GraspPredictor, config: GraspTrackerConfig, seed: int | None) -> None:
        self._predict, self._config = predict, config
        self._rng = np.random.default_rng(0 if seed is None else seed)
        self.grasps, self.costs = np.zeros((0, 7)), np.zeros(0)
        self.surface = Spheres(np.zeros((1, 3)), np.zeros(1))
        self.human_hand: Spheres | None = None
        self.use_all = False
        self.lost_timeout = config.lost_timeout
        self._seen_at = -np.inf
        self.selected: Array | None = None
        self._selected_cost = 0.0
        self._failed: list[tuple[Array, float]] = []
        self._restart()

    def _restart(self) -> None:
        """Forget the object's motion, the points and the selected grasp."""
        config = self._config
        self.position = PositionFilter(config.velocity_decay)
        self._object_map = PointMap(config.voxel_size, config.object_memory)
        self._hand_map = PointMap(config.voxel_size, config.hand_memory)
        self.selected = None
        self._keyframe: Keyframe | None = None

    @property
    def is_initialized(self) -> bool:
        """Whether the object's position is known."""
        return self.position.position is not None

    @property
    def object_pose(self) -> Array:
        """(7,) world pose of the object's center, with the identity rotation."""
        position = np.zeros(3) if self.position.position is None else self.position.position
        return np.array([*position, 0.0, 0.0, 0.0, 1.0])

    @property
    def velocity(self) -> Array:
        """(3,) velocity of the object and of the person's hand in the world (m/s)."""
        is_moving = float(np.linalg.norm(self.position.velocity)) > self._config.rest_speed
        return self.position.velocity if is_moving else np.zeros(3)

    def compute_unseen_time(self, time: float) -> float:
        """Return the time (s) at a time (s) since the last view of the object, infinite before the first view."""
        return time - self._seen_at

    def add_failed(self, grasp: Array, until: float) -> None:
        """Increase the cost of a failed grasp (7,) relative to the center, and of its half turn, until a time (s)."""
        self._failed += [(grasp, until), (compose(grasp, np.array(HALF_TURN)), until)]

    def update(self, time: float, gripper_pose: Array, object_points: Array, hand_points: Array) -> None:
        """Update object, hand and grasp candidates from a view of the wrist camera at a time (s).

        Points (n, 3) of the object and of the person's hand are in the hand link's frame (m), given by its
        world pose (7,).
        """
        config = self._config
        if len(object_points) < config.min_points:
            self.position.coast(time)
            self._update_maps(time, gripper_pose, object_points, hand_points)
            self._set_candidates(np.zeros((0, 7)), np.zeros(0), time, config.far_gains)
            return
        if self.compute_unseen_time(time) > self.lost_timeout:
            self._restart()
        self._seen_at = time
        velocity = Rotation.from_quat(gripper_pose[3:]).inv().apply(self.position.velocity)
        prediction = self._predict(object_points, hand_points, velocity, self._rng)
        gains = self._select_gains(gripper_pose)
        self._update_position(time, gripper_pose, object_points, prediction, gains)
        self._update_maps(time, gripper_pose, object_points, hand_points)
        checked = object_points[:: max(1, len(object_points) // config.n_finger_points)]
        grasps, costs = self._compute_candidates(prediction, checked, gripper_pose)
        if self.selected is not None and gains is not config.final_gains:
            points = transform_points(gripper_pose, checked) - self.object_pose[:3]
            shifted, extra = shift_to_avoid_collisions(self.selected[None], points, config.fingers)
            self.selected, self._selected_cost = shifted[0], self._selected_cost + config.unseen_cost * float(extra[0])
        self._set_candidates(grasps, costs, time, gains)

    def _compute_candidates(
        self, prediction: GraspPrediction, points: Array, gripper_pose: Array
    ) -> tuple[Array, Array]:
        """Return candidates (n, 7) relative to the center and their costs (n,) from a prediction.

        Points (k, 3) of the object, for finger collisions, are in the hand link's frame (m).
        """
        config, quality = self._config, prediction.quality
        order = np.argsort(-quality, kind="stable")
        if not self.use_all:
            order = order[: config.max_grasps]
            order = order[quality[order] > config.min_quality]
        shifted, extra = shift_to_avoid_collisions(prediction.grasps[order], points, config.fingers)
        grasps = compose(gripper_pose, shifted)
        grasps[:, :3] -= self.object_pose[:3]
        costs = extra - config.cost_scale * np.log(quality[order])
        if self.use_all and len(grasps):
            tilts = [make_offset_pose(tilt, 0.0, 0.0, config.pad_distance) for tilt in config.tilts]
            grasps = np.concatenate([grasps, *(compose(grasps, tilt) for tilt in tilts)])
            costs = np.concatenate([costs, np.tile(costs + config.tilt_cost, len(tilts))])
        return grasps, costs

    def _is_near(self, gripper_pose: Array) -> bool:
        """Return whether the object is near the hand link at a pose (7,)."""
        distance = float(np.linalg.norm(self.object_pose[:3] - gripper_pose[:3]))
        return self.is_initialized and distance < self._config.near_distance

    def _select_gains(self, gripper_pose: Array) -> FilterGains:
        """Return the filter gains for a view from the hand link at a pose (7,)."""
        config = self._config
        if self.is_initialized and self.selected is not None:
            grasp = self.object_pose[:3] + self.selected[:3]
            if float(np.linalg.norm(grasp - gripper_pose[:3])) < config.final_distance:
                return config.final_gains
        return config.near_gains if self._is_near(gripper_pose) else config.far_gains

    def _update_position(
        self, time: float, gripper_pose: Array, object_points: Array, prediction: GraspPrediction, gains: FilterGains
    ) -> None:
        """Update the object's position.

        Near the object the camera sees a part of it, whose center the network can only guess. From
        there the motion of its surface is registered instead.
        """
        config, cloud = self._config, transform_points(gripper_pose, object_points)
        center = transform_points(gripper_pose, prediction.center)
        share = 0.0
        if gains is config.far_gains:
            self._keyframe = None
        elif self._keyframe is not None:
            predicted = self.position.predict(time)
            translation, share = self._keyframe.register(cloud - predicted, config.max_match_distance)
            error = float(np.linalg.norm(predicted + translation - center))
            has_strayed = error > config.max_center_error and gains is not config.final_gains
            if share < config.min_matched_share or has_strayed:
                # Another body is being tracked.
                self._restart()
                share = 0.0
            else:
                center = predicted + translation
        self.position.update(time, center, gains if share else config.far_gains)
        if gains is not config.far_gains and share < config.keyframe_share:
            self._keyframe = Keyframe(cloud - self.object_pose[:3])

    def _update_maps(self, time: float, gripper_pose: Array, object_points: Array, hand_points: Array) -> None:
        """Add points in the hand link's frame to the maps of object and hand."""
        if not self.is_initialized:
            return
        config, center = self._config, self.object_pose[:3]
        forget = not self._is_near(gripper_pose)
        for point_map, points in ((self._object_map, object_points), (self._hand_map, hand_points)):
            point_map.update(time, transform_points(gripper_pose, points) - center, forget)
        self.surface = Spheres(self._object_map.points, np.full(len(self._object_map.points), config.sphere_radius))
        centers = center + self._hand_map.points
        self.human_hand = Spheres(centers, np.full(len(centers), config.sphere_radius)) if len(centers) else None

    def _set_candidates(self, grasps: Array, costs: Array, time: float, gains: FilterGains) -> None:
        """Set the candidates to the grasps of a view and their half turns, the selected first."""
        candidates = np.concatenate([grasps, compose(grasps, np.array(HALF_TURN))]) if len(grasps) else grasps
        all_costs = np.concatenate([costs, costs])
        if self.selected is not None:
            selected = self._correct_selected(self.selected, candidates, all_costs, gains.grasp)
            self.selected = selected
            candidates = np.concatenate([selected[None], candidates])
            all_costs = np.append(self._selected_cost, all_costs)
        self._failed = [(pose, until) for pose, until in self._failed if until > time]
        for pose, _ in self._failed:
            is_same = self._compute_distances(pose, candidates) < self._config.same_distance
            all_costs[is_same] += self._config.failed_cost
        self.grasps, self.costs = candidates, all_costs

    def _correct_selected(self, selected: Array, grasps: Array, costs: Array, gain: float) -> Array:
        """Return the selected grasp (7,), moved towards the same predicted grasps by a gain."""
        config = self._config
        distances = self._compute_distances(selected, grasps)
        same = np.flatnonzero(distances < config.same_distance)
        if not len(same):
            self._selected_cost += config.unseen_cost
            return selected
        weights = np.exp(-costs[same] / config.cost_scale - (2.0 * distances[same] / config.same_distance) ** 2)
        weights /= weights.sum()
        signs = np.sign(grasps[same, 3:] @ selected[3:])
        mean = np.concatenate([weights @ grasps[same, :3], weights @ (signs[:, None] * grasps[same, 3:])])
        mean[3:] *= np.sign(mean[3:] @ selected[3:])
        corrected: Array = (1.0 - gain) * selected + gain * mean
        corrected[3:] /= np.linalg.norm(corrected[3:])
        self._selected_cost = (1.0 - gain) * self._selected_cost + gain * float(weights @ costs[same])
        return corrected

    def _compute_distances(self, pose: Array, poses: Array) -> Array:
        """Return the distances (n,) in m of grasps at the pads, with weighted rotations."""
        pads = np.array([0.0, 0.0, self._config.pad_distance, 0.0, 0.0, 0.0, 1.0])
        offsets = compose(poses, pads)[:, :3] - compose(pose, pads)[:3] if len(poses) else np.zeros((0, 3))
        cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
        weight = 2.0 * self._config.rotation_weight
        return np.asarray(np.linalg.norm(offsets, axis=1) + weight * np.arccos(cosines))
