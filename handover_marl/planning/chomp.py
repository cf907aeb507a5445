"""Goal-set CHOMP: covariant gradient steps that keep the end of a trajectory on a goal's tail.

Zucker et al., 2013; the constraint as in Wang et al., 2020, section III-B.
"""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from handover_marl.planning.planner_config import CostConfig, OptimiserConfig
from handover_marl.planning.trajectory_cost import BodyCost

Array = npt.NDArray[np.float64]
Limits = tuple[Array, Array]


def first_trajectory(start: Array, goal: Array, waypoints: int) -> Array:
    """(w, d) points of the cubic from `start` to `goal`, (d,), that rests at both ends; neither is among them."""
    spline = CubicSpline([0.0, 1.0], np.stack([start, goal]), bc_type="clamped")
    points: Array = spline(np.linspace(0.0, 1.0, waypoints + 2)[1:-1])
    return points


class Chomp:
    """Steps of the optimisation.

    Args:
        body: Obstacle costs.
        start: (7,) where trajectories start.
        limits: Lowest and highest joints, padding included.
        config: How.
        costs: Weights of the costs.
    """

    def __init__(
        self, body: BodyCost, start: Array, limits: Limits, config: OptimiserConfig, costs: CostConfig
    ) -> None:
        self._body, self._start, self._limits = body, start, limits
        self._config, self._costs = config, costs
        count = config.waypoints
        difference = (np.eye(count) - np.eye(count, k=-1)) / costs.time_step
        self._metric = difference.T @ difference
        self._smoother = np.linalg.inv(self._metric)
        # Smoothness is half the squared norm of the differences; the start enters the first one.
        self._pull = difference.T @ np.concatenate([[-1.0 / costs.time_step], np.zeros(count - 1)])
        ends = self._smoother[:, -body.tail :]
        self._spread = ends @ np.linalg.inv(ends[-body.tail :])

    def effort(self, trajectory: Array) -> float:
        """Smoothness cost of a trajectory (w, 7): half its squared joint velocities, added up."""
        steps = np.diff(trajectory, axis=0, prepend=self._start[None]) / self._costs.time_step
        return float(0.5 * (steps**2).sum())

    def step(self, trajectory: Array, tail: Array, number: int) -> Array:
        """The trajectory (w, 7) after a step, counted from 1, its end on a tail (t, 7), joints within limits."""
        smooth = self._metric @ trajectory + self._pull[:, None] * self._start
        near = self._costs.obstacle_weight * self._body.gradient(trajectory, self._start, tail[-1])
        near = np.clip(near, -self._costs.largest_gradient, self._costs.largest_gradient)
        weight = self._costs.smoothness_weight * self._costs.smoothness_growth**number
        downhill = self._config.step_size * (self._smoother @ (near + weight * smooth))
        off = trajectory[-len(tail) :] - tail
        moved = trajectory - downhill + self._spread @ (downhill[-len(tail) :] - off)
        return self._within_limits(moved)

    def violation(self, trajectory: Array) -> Array:
        """(w, 7) what brings each joint back within its limits (rad)."""
        low, high = self._limits
        return np.maximum(low - trajectory, 0.0) + np.minimum(high - trajectory, 0.0)

    def done(self, trajectory: Array, goal: Array, clearance: float) -> bool:
        """Whether a trajectory (w, 7) is good enough as it is."""
        config = self._config
        return (
            float(np.linalg.norm(trajectory[-1] - goal)) < config.goal_distance
            and self.effort(trajectory) < config.most_effort
            and float(np.abs(self.violation(trajectory)).max()) <= config.most_violation
            and self._body.colliding(trajectory, clearance) <= config.allowed_points
        )

    def _within_limits(self, trajectory: Array) -> Array:
        """Smoothly pushed back until the limits hold nearly; the tail is mended by the next step."""
        for _ in range(self._config.limit_steps):
            violation = self.violation(trajectory)
            if np.linalg.norm(violation) <= self._config.limit_tolerance:
                break
            smooth = self._smoother @ violation
            worst = np.unravel_index(np.abs(violation).argmax(), violation.shape)
            scale = abs(violation[worst]) / max(abs(smooth[worst]), np.finfo(np.float64).tiny)
            trajectory = trajectory + scale * smooth
        return trajectory
