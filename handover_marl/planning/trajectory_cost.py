"""What trajectories cost: how near the moving body comes to obstacles (CHOMP; Zucker et al., 2013)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.models.arm import Arm, Frames, body_points
from handover_marl.planning.obstacles import Floats, Obstacle, nearness, steepness
from handover_marl.planning.planner_config import CostConfig

Array = npt.NDArray[np.float64]

# Links that the gradient looks at: arm and hand. The fingers go where the hand goes.
_LINKS = 8
_TINY = 1e-8


@dataclass(frozen=True, eq=False)
class BodyCost:
    """Obstacle costs of a body on its way.

    Attributes:
        arm: The arm.
        body: (m, 3) points on each of its links.
        obstacles: What to keep clear of.
        tail: Waypoints at the end in which objects cost nothing, since a grasp touches one.
        config: Scales.
    """

    arm: Arm
    body: Sequence[Array]
    obstacles: Sequence[Obstacle]
    tail: int
    config: CostConfig

    def of_lines(self, start: Array, goals: Array, count: int, tails: npt.NDArray[np.bool_]) -> Array:
        """(g,) costs of straight joint lines, cost times workspace speed added up.

        Args:
            start: (7,) where they start.
            goals: (g, 7) where they end.
            count: Points between both.
            tails: (g, count) where objects cost nothing.
        """
        shares = np.arange(count + 1) / (count + 1)
        line = start + shares[:, None, None] * (goals - start)
        points = self._points(line.reshape(-1, 7)).reshape(3, -1, count + 1, len(goals))
        speed = np.linalg.norm(np.diff(points, axis=2), axis=0) / self.config.time_step
        costs = self._costs(points[:, :, 1:], tails.T)
        total: Array = (costs * speed).sum(axis=(0, 1), dtype=np.float64)
        return total

    def colliding(self, trajectory: Array, clearance: float) -> int:
        """Pairs of body point and obstacle nearer than `clearance` (m), objects in the tail not counted."""
        points = self._points(trajectory)
        pairs = 0
        for obstacle in self.obstacles:
            seen = points if obstacle.in_tail else points[..., : -self.tail]
            pairs += int((obstacle.distances(seen.reshape(3, -1)) < clearance).sum())
        return pairs

    def gradient(self, trajectory: Array, start: Array, end: Array) -> Array:
        """(w, 7) gradient of the obstacle cost of a trajectory (w, 7) from `start` that is to end at `end`, (7,).

        At every waypoint each link counts with its costliest point.
        """
        frames = self.arm.frames(np.concatenate([start[None], trajectory, end[None]]))
        moving = body_points(frames, self.body)[:, : _LINKS * len(self.body[0])]
        costs, slopes = self._costs_and_slopes(moving[..., 1:-1].astype(np.float32))
        chosen = costs.reshape(_LINKS, -1, len(trajectory)).argmax(axis=1)
        at = chosen + np.arange(_LINKS)[:, None] * len(self.body[0])
        when = np.arange(len(trajectory)) + 1
        before, here, after = (moving[:, at, when + step] for step in (-1, 0, 1))
        force = self._force(
            (here - before) / self.config.time_step,
            (before - 2.0 * here + after) / self.config.time_step**2,
            costs[at, when - 1],
            slopes[:, at, when - 1],
        )
        return self._in_joints(frames, here, force)

    def _force(self, velocity: Array, acceleration: Array, costs: Floats, slopes: Floats) -> Array:
        """(3, l, w) workspace gradients of points that move."""
        squared = (velocity**2).sum(axis=0) + _TINY

        def across(vector: npt.NDArray[np.floating]) -> Array:
            sideways: Array = vector - velocity * ((velocity * vector).sum(axis=0) / squared)
            return sideways

        curvature = across(acceleration) / squared
        force: Array = np.sqrt(squared) * (across(slopes) - costs * curvature)
        return force

    def _in_joints(self, frames: Frames, points: Array, force: Array) -> Array:
        """(w, 7) torques of forces at points on links, both (3, l, w)."""
        joints = self.arm.n_joints
        axes, origins = frames.rotations[:joints, :, 2, 1:-1], frames.origins[:joints, :, 1:-1]
        levers = points[None] - origins[:, :, None]
        torques = (axes[:, :, None] * np.cross(levers, force[None], axis=1)).sum(axis=1)
        carries = np.arange(joints)[:, None] <= np.arange(points.shape[1])
        total: Array = (torques * carries[..., None]).sum(axis=1).T
        return total

    def _points(self, joints: Array) -> Floats:
        """(3, p, n) body points of configurations (n, 7)."""
        return body_points(self.arm.frames(joints), self.body).astype(np.float32)

    def _costs(self, points: Floats, tails: npt.NDArray[np.bool_]) -> Floats:
        """Costs of points (3, p, ...), objects free of charge where `tails` (...) says so."""
        total = np.zeros(points.shape[1:], dtype=np.float32)
        flat = points.reshape(3, -1)
        for obstacle in self.obstacles:
            price = nearness(obstacle.distances(flat), obstacle.padding).reshape(total.shape)
            total += np.float32(obstacle.weight) * (price if obstacle.in_tail else price * ~tails)
        return total

    def _costs_and_slopes(self, points: Floats) -> tuple[Floats, Floats]:
        """The same and its gradient for points (3, p, w) of one trajectory."""
        total, slopes = np.zeros(points.shape[1:], dtype=np.float32), np.zeros(points.shape, dtype=np.float32)
        counts = np.ones(points.shape[2], dtype=np.float32)
        counts[-self.tail :] = 0.0
        for obstacle in self.obstacles:
            distances, outward = obstacle.distances_and_slopes(points.reshape(3, -1))
            weight = np.float32(obstacle.weight) * (np.float32(1.0) if obstacle.in_tail else counts)
            total += weight * nearness(distances, obstacle.padding).reshape(total.shape)
            slopes += weight * (steepness(distances, obstacle.padding) * outward).reshape(slopes.shape)
        return total, slopes
