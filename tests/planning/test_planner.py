"""Tests of goal selection and trajectory optimization."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.distance_field import sample_distance_field
from handover_marl.planning.goal_set import GoalSelector, update_weights
from handover_marl.planning.planner import Chomp, make_initial_trajectory
from handover_marl.planning.planner_config import ChompConfig, CostConfig, GoalSelectionConfig
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost, sample_body_points
from tests.planning.robots import ARM, LIMITS, START, random_joints

BODY = sample_body_points(SyntheticDataset().panda_urdf, tuple(ARM.link_names), 15)
GOAL = np.array([0.4, 0.2, -0.3, -1.8, 0.3, 2.2, 0.6])
TAIL = 5


def make_cost(obstacles: tuple[Obstacle, ...] = ()) -> ObstacleCost:
    return ObstacleCost(ARM, BODY, obstacles, TAIL, CostConfig())


def make_sphere(center: np.ndarray, radius: float = 0.1, in_tail: bool = False) -> Obstacle:
    corner = np.full(3, radius + 0.25)
    field = sample_distance_field(lambda points: np.linalg.norm(points, axis=1) - radius, -corner, corner, 0.01)
    return Obstacle(field, np.array([*center, 0.0, 0.0, 0.0, 1.0]), 0.2, in_tail=in_tail)


def chomp(cost: ObstacleCost) -> Chomp:
    return Chomp(cost, START, LIMITS, ChompConfig(), CostConfig())


@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=8), st.integers(0, 1000))
def test_mirror_step_is_a_projection(values: list[float], seed: int) -> None:
    weights = np.array(values) / sum(values)
    losses = np.random.default_rng(seed).uniform(0.0, 3.0, len(values))
    found = update_weights(weights, losses)
    assert found.sum() == pytest.approx(1.0)
    assert (found >= 0.0).all()
    shift = 1.0 / (4 * len(values) + 1)
    # Every positive weight is (w + d) exp(l - loss) - d with the same l; it would not be positive for the others.
    levels = np.log((found + shift) / (weights + shift)) + losses
    level = levels[found > 0.0]
    assert np.ptp(level) < 1e-9
    assert (levels[found == 0.0] >= level.max() - 1e-9).all()


def test_mirror_step_minimizes_the_divergence() -> None:
    weights, losses = np.array([0.5, 0.3, 0.2]), np.array([1.0, 0.2, 2.0])
    shift = 1.0 / 13

    def divergence(p: np.ndarray) -> float:
        shifted = p + shift
        return float(losses @ p + (shifted * np.log(shifted / (weights + shift)) - p).sum())

    bounds = [(0.0, 1.0)] * 3
    best = minimize(divergence, weights, bounds=bounds, constraints={"type": "eq", "fun": lambda p: p.sum() - 1})
    np.testing.assert_allclose(update_weights(weights, losses), best.x, atol=1e-4)


def test_cheapest_goal_is_selected() -> None:
    goals = np.stack([START + 0.1, START + 0.2, START + 0.15])
    selector = GoalSelector(make_cost(), goals, np.array([5.0, 1.0, 3.0]), 30, GoalSelectionConfig(), False)
    path = make_initial_trajectory(START, goals[0], 30)
    assert selector.select_first(path) == 1
    assert [selector.select_next(path, number) for number in range(1, 10)] == [1] * 9


def test_goals_behind_an_obstacle_are_expensive() -> None:
    goals = START + np.array([[0.8], [-0.8]]) * np.eye(7)[0]
    way = ARM.compute_chain_frames((START + 0.5 * np.eye(7)[0])[None])
    cost = make_cost((make_sphere(way.origins[-1][:, 0], 0.05),))
    free = np.zeros((2, 30), dtype=bool)
    blocked, clear = cost.evaluate_lines(START, goals, 30, free)
    assert blocked > 1.3 * clear


def test_tails_have_no_cost_except_for_the_hand() -> None:
    end = ARM.compute_chain_frames(GOAL[None]).origins[-1][:, 0]
    goals, free = GOAL[None], np.zeros((1, 30), dtype=bool)
    charged = make_cost((make_sphere(end),)).evaluate_lines(START, goals, 30, free)
    free[:, -TAIL:] = True
    assert make_cost((make_sphere(end),)).evaluate_lines(START, goals, 30, free) < charged
    assert make_cost((make_sphere(end, in_tail=True),)).evaluate_lines(START, goals, 30, free) == pytest.approx(charged)


def test_initial_trajectory_rests_at_both_ends() -> None:
    path = make_initial_trajectory(START, GOAL, 30)
    whole = np.concatenate([START[None], path, GOAL[None]])
    steps = np.linalg.norm(np.diff(whole, axis=0), axis=1)
    assert steps[0] < 0.2 * steps.max()
    assert steps[-1] == pytest.approx(steps[0])


def test_smoothness_gradient_equals_finite_differences() -> None:
    optimizer = chomp(make_cost())
    path = random_joints(0, 30)
    gradient = optimizer.compute_smoothness_gradient(path)
    small = 1e-5
    for place in ((0, 0), (0, 6), (14, 3), (29, 5)):
        step = np.zeros_like(path)
        step[place] = small
        slope = (optimizer.compute_smoothness_cost(path + step) - optimizer.compute_smoothness_cost(path - step)) / (
            2 * small
        )
        assert gradient[place] == pytest.approx(slope, rel=1e-5)


def test_step_moves_the_end_to_the_tail() -> None:
    start = START + 0.2  # within the padded limits, so that nothing is pushed back
    optimizer = Chomp(make_cost(), start, LIMITS, ChompConfig(), CostConfig())
    tail = GOAL + np.linspace(-0.1, 0.0, TAIL)[:, None]
    path = optimizer.step(make_initial_trajectory(start, GOAL + 0.3, 30), tail, 1)
    np.testing.assert_allclose(path[-TAIL:], tail, atol=1e-9)
    assert optimizer.is_finished(path, tail[-1], 0.01)
    assert not optimizer.is_finished(path, tail[-1] + 0.01, 0.01)


def test_step_projects_to_the_limits() -> None:
    # The start itself violates joint 2's padded limit by 0.05 rad.
    optimizer, tail = chomp(make_cost()), np.repeat(GOAL[None], TAIL, axis=0)
    path = make_initial_trajectory(START, GOAL, 30)
    before = np.linalg.norm(optimizer.compute_limit_violation(path))
    after = np.linalg.norm(optimizer.compute_limit_violation(optimizer.step(path, tail, 1)))
    assert before > 0.05
    assert after <= ChompConfig().limit_tolerance


def test_steps_avoid_an_obstacle() -> None:
    path = make_initial_trajectory(START, GOAL, 30)
    place = ARM.compute_chain_frames(path[12:13]).origins[-1][:, 0] + [0.0, 0.0, -0.15]
    optimizer = chomp(make_cost((make_sphere(place),)))
    tail = np.repeat(GOAL[None], TAIL, axis=0)
    before = np.linalg.norm(ARM.compute_chain_frames(path).origins[-1] - place[:, None], axis=0).min()
    for number in range(1, 15):
        path = optimizer.step(path, tail, number)
    after = np.linalg.norm(ARM.compute_chain_frames(path).origins[-1] - place[:, None], axis=0).min()
    assert after > before + 0.02


def test_obstacle_gradient_is_orthogonal_to_the_motion() -> None:
    """The gradient is orthogonal to the motion of each point along its path."""
    place = ARM.compute_chain_frames(START[None]).origins[-1][:, 0] + [0.0, 0.1, -0.05]
    cost = make_cost((make_sphere(place, 0.03),))
    step = 0.01 * np.eye(7)[0]
    path = START + np.arange(1, 31)[:, None] * step
    gradient = cost.compute_gradient(path, START, path[-1] + step)
    assert np.isfinite(gradient).all()
    assert not gradient[-TAIL:].any()
    assert np.abs(gradient[0]).max() > 0.0
    # Joint 1 moves every point along its path, so its gradient is small.
    assert abs(gradient[0, 0]) < 0.2 * np.abs(gradient[0]).max()


def test_collisions_are_counted_by_pair() -> None:
    hand = ARM.compute_chain_frames(GOAL[None]).origins[-1][:, 0]
    path = np.repeat(GOAL[None], 30, axis=0)
    pairs = make_cost((make_sphere(hand, 0.05),)).count_collisions(path, 0.01)
    assert pairs > 0
    assert pairs % (30 - TAIL) == 0
    all_pairs = make_cost((make_sphere(hand, 0.05, in_tail=True),)).count_collisions(path, 0.01)
    assert all_pairs == pairs * 30 // (30 - TAIL)
    assert make_cost((make_sphere(hand + 5.0),)).count_collisions(path, 0.01) == 0
