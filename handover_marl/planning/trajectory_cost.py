"""Obstacle costs of trajectories and their gradients (CHOMP; Zucker et al., 2013)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.arm import ArmKinematics, LinkFrames, transform_body_points
from handover_marl.geometry.distance_field import DistanceField
from handover_marl.geometry.model_files.meshes import find_farthest_points, read_link_vertices

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

# Number of links in the gradient: arm and hand. The fingers follow the hand.
_N_GRADIENT_LINKS = 8
_EPSILON = 1e-8
#: Time between waypoints (s), which only scales velocities and accelerations (the authors' value).
WAYPOINT_PERIOD = 0.1


@cached_by_file(maxsize=None)
def sample_body_points(urdf: Path, link_names: tuple[str, ...], count: int) -> tuple[Array, ...]:
    """Return `count` vertices (count, 3) in m of the visual mesh of each named link, in the frame of that link.

    Farthest point sampling spreads them evenly; random sampling would take most from finely meshed details.
    """
    sampled = []
    for vertices in read_link_vertices(urdf, "visual", list(link_names)):
        center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        first = int(np.argmax(np.linalg.norm(vertices - center, axis=1)))
        sampled.append(vertices[find_farthest_points(vertices, count, first)])
    return tuple(sampled)


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Obstacle with a cost near its surface, given by a signed distance field at a pose.

    Attributes:
        field: Signed distance field of the obstacle.
        base_from_field: (7,) pose (quaternion xyzw) of the field's frame in the robot's base frame.
        padding: Distance from the surface up to which the obstacle has a cost (m).
        active_in_approach: Whether the obstacle also has a cost in the final approach to a grasp; false for objects.
    """

    field: DistanceField
    base_from_field: Array
    padding: float
    active_in_approach: bool = False

    def compute_distances(self, points: Floats) -> Floats:
        """Return the signed distances (n,) in m, negative inside, at points (3, n) in the robot's base frame."""
        return self.field.compute_distances(self._to_field_frame(points))

    def compute_distances_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """Return signed distances (n,) in m, negative inside, and gradients (3, n) at base-frame points (3, n)."""
        distances, gradients = self.field.compute_distances_and_gradients(self._to_field_frame(points))
        return distances, self._rotation() @ gradients

    def _rotation(self) -> Floats:
        matrix: Floats = Rotation.from_quat(self.base_from_field[3:]).as_matrix().astype(np.float32)
        return matrix

    def _to_field_frame(self, points: Floats) -> Floats:
        offsets = points - self.base_from_field[:3, None].astype(np.float32)
        local: Floats = self._rotation().T @ offsets
        return local


def compute_proximity_cost(distances: Floats, padding: float) -> Floats:
    """Return the CHOMP costs (...) of points at signed distances (...) in m from an obstacle.

    The cost is 0 beyond `padding`, quadratic between `padding` and the surface, and linear inside the obstacle.
    """
    quadratic = (distances - padding) ** 2 / (2.0 * padding)
    outside = np.where(distances <= padding, quadratic, 0.0)
    cost: Floats = np.where(distances <= 0.0, padding / 2.0 - distances, outside)
    return cost


def compute_proximity_gradient(distances: Floats, padding: float) -> Floats:
    """Return the derivatives (...) of `compute_proximity_cost` with respect to the distances (...)."""
    linear = (distances - padding) / padding
    outside = np.where(distances <= padding, linear, 0.0)
    gradient: Floats = np.where(distances <= 0.0, -1.0, outside)
    return gradient


@dataclass(frozen=True, eq=False)
class ObstacleCost:
    """Obstacle cost of arm trajectories (CHOMP; Zucker et al., 2013).

    Attributes:
        arm: Kinematics of the arm.
        body: (m, 3) points on each of the arm's ten links, in the link's frame (m).
        obstacles: Obstacles in the robot's base frame.
        n_approach: Number of waypoints at the end of a trajectory that are the final approach to the grasp.
    """

    arm: ArmKinematics
    body: Sequence[Array]
    obstacles: Sequence[Obstacle]
    n_approach: int

    def evaluate_lines(self, start: Array, goals: Array, count: int, is_approach: npt.NDArray[np.bool_]) -> Array:
        """Return the obstacle costs (g,) of straight joint paths from one start (7,) to goals (g, 7).

        The cost of a path is the sum of proximity cost times speed in space over all body points, at `count` evenly
        spaced waypoints between start and goal. Where `is_approach` (g, count) is true, only obstacles with
        `active_in_approach` have a cost.
        """
        shares = np.arange(count + 1) / (count + 1)
        line = start + shares[:, None, None] * (goals - start)
        points = self._points(line.reshape(-1, 7)).reshape(3, -1, count + 1, len(goals))
        speed = np.linalg.norm(np.diff(points, axis=2), axis=0) / WAYPOINT_PERIOD
        costs = self._costs(points[:, :, 1:], is_approach.T)
        return np.asarray((costs * speed).sum(axis=(0, 1), dtype=np.float64))

    def count_collisions(self, trajectory: Array, distance: float) -> int:
        """Return how often a body point is closer than `distance` (m) to an obstacle on a trajectory (w, 7) in rad.

        Each point counts for each waypoint and obstacle; in the approach, only for obstacles `active_in_approach`.
        """
        points = self._points(trajectory)
        pairs = 0
        for obstacle in self.obstacles:
            checked = points if obstacle.active_in_approach else points[..., : -self.n_approach]
            pairs += int((obstacle.compute_distances(checked.reshape(3, -1)) < distance).sum())
        return pairs

    def compute_gradient(self, trajectory: Array, start: Array, end: Array) -> Array:
        """Return the gradient (w, 7) of the obstacle cost of a trajectory (w, 7) between configurations start and end.

        At every waypoint, only the point of largest cost on each link, without the fingers, contributes.
        """
        frames = self.arm.compute_link_frames(np.concatenate([start[None], trajectory, end[None]]))
        n_points = len(self.body[0])
        moving = transform_body_points(frames, self.body)[:, : _N_GRADIENT_LINKS * n_points]
        costs, gradients = self._costs_and_gradients(moving[..., 1:-1].astype(np.float32))
        worst = costs.reshape(_N_GRADIENT_LINKS, -1, len(trajectory)).argmax(axis=1)
        index = worst + np.arange(_N_GRADIENT_LINKS)[:, None] * n_points
        waypoint = np.arange(len(trajectory)) + 1
        before, here, after = (moving[:, index, waypoint + step] for step in (-1, 0, 1))
        force = self._workspace_gradient(
            (here - before) / WAYPOINT_PERIOD,
            (before - 2.0 * here + after) / WAYPOINT_PERIOD**2,
            costs[index, waypoint - 1],
            gradients[:, index, waypoint - 1],
        )
        return self._joint_torques(frames, here, force)

    def _workspace_gradient(self, velocity: Array, acceleration: Array, costs: Floats, gradients: Floats) -> Array:
        """Return the workspace gradients (3, l, w) of the costs of one point on each of l links, at w waypoints."""
        squared = (velocity**2).sum(axis=0) + _EPSILON

        def project(vector: npt.NDArray[np.floating]) -> Array:
            return np.asarray(vector - velocity * ((velocity * vector).sum(axis=0) / squared))

        curvature = project(acceleration) / squared
        return np.asarray(np.sqrt(squared) * (project(gradients) - costs * curvature))

    def _joint_torques(self, frames: LinkFrames, points: Array, force: Array) -> Array:
        """Return the joint torques (w, 7) of forces (3, l, w) at points (3, l, w), one on each of l links."""
        joints = self.arm.n_joints
        axes, origins = frames.rotations[:joints, :, 2, 1:-1], frames.origins[:joints, :, 1:-1]
        levers = points[None] - origins[:, :, None]
        torques = (axes[:, :, None] * np.cross(levers, force[None], axis=1)).sum(axis=1)
        is_moved = np.arange(joints)[:, None] <= np.arange(points.shape[1])
        return np.asarray((torques * is_moved[..., None]).sum(axis=1).T)

    def _points(self, joints: Array) -> Floats:
        """Return all p body points (3, p, n) in m in the base frame at configurations (n, 7) in rad."""
        return transform_body_points(self.arm.compute_link_frames(joints), self.body).astype(np.float32)

    def _costs(self, points: Floats, is_approach: npt.NDArray[np.bool_]) -> Floats:
        """Return the costs (p, ...) of points (3, p, ...); see `evaluate_lines` for the mask `is_approach` (...)."""
        total = np.zeros(points.shape[1:], dtype=np.float32)
        flat = points.reshape(3, -1)
        for obstacle in self.obstacles:
            cost = compute_proximity_cost(obstacle.compute_distances(flat), obstacle.padding).reshape(total.shape)
            total += cost if obstacle.active_in_approach else cost * ~is_approach
        return total

    def _costs_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the costs (p, w), and their gradients (3, p, w), of points (3, p, w) along one trajectory."""
        total, gradients = np.zeros(points.shape[1:], dtype=np.float32), np.zeros(points.shape, dtype=np.float32)
        counts = np.ones(points.shape[2], dtype=np.float32)
        counts[-self.n_approach :] = 0.0
        for obstacle in self.obstacles:
            distances, outward = obstacle.compute_distances_and_gradients(points.reshape(3, -1))
            weight = np.float32(1.0) if obstacle.active_in_approach else counts
            total += weight * compute_proximity_cost(distances, obstacle.padding).reshape(total.shape)
            slope = compute_proximity_gradient(distances, obstacle.padding)
            gradients += weight * (slope * outward).reshape(gradients.shape)
        return total, gradients
