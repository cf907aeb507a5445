"""Goal selection and the trajectory's optimisation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.models.distance_field import field_of
from handover_marl.planning.body_samples import body_samples
from handover_marl.planning.chomp import Chomp, first_trajectory
from handover_marl.planning.goal_selection import GoalSelector, mirror_step
from handover_marl.planning.obstacles import Obstacle
from handover_marl.planning.planner_config import CostConfig, OptimiserConfig, SelectionConfig
from handover_marl.planning.trajectory_cost import BodyCost
from tests.planning.robots import ARM, LIMITS, START, random_joints

BODY = body_samples(SyntheticDataset().panda_urdf, tuple(ARM.link_names), 15)
GOAL = np.array([0.4, 0.2, -0.3, -1.8, 0.3, 2.2, 0.6])
TAIL = 5


def body(obstacles: tuple[Obstacle, ...] = ()) -> BodyCost:
    return BodyCost(ARM, BODY, obstacles, TAIL, CostConfig())


def ball(center: np.ndarray, radius: float = 0.1, in_tail: bool = False) -> Obstacle:
    corner = np.full(3, radius + 0.25)
    field = field_of(lambda points: np.linalg.norm(points, axis=1) - radius, -corner, corner, 0.01)
    return Obstacle(field, np.array([*center, 0.0, 0.0, 0.0, 1.0]), 0.2, in_tail=in_tail)


def chomp(cost: BodyCost) -> Chomp:
    return Chomp(cost, START, LIMITS, OptimiserConfig(), CostConfig())


@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=8), st.integers(0, 1000))
def test_mirror_step_is_the_projection(values: list[float], seed: int) -> None:
    weights = np.array(values) / sum(values)
    losses = np.random.default_rng(seed).uniform(0.0, 3.0, len(values))
    found = mirror_step(weights, losses)
    assert found.sum() == pytest.approx(1.0)
    assert (found >= 0.0).all()
    shift = 1.0 / (4 * len(values) + 1)
    # Every positive weight is (w + d) exp(l - loss) - d with one and the same l, too small for the others.
    levels = np.log((found + shift) / (weights + shift)) + losses
    level = levels[found > 0.0]
    assert np.ptp(level) < 1e-9
    assert (levels[found == 0.0] >= level.max() - 1e-9).all()


def test_mirror_step_is_least_of_all() -> None:
    weights, losses = np.array([0.5, 0.3, 0.2]), np.array([1.0, 0.2, 2.0])
    shift = 1.0 / 13

    def divergence(p: np.ndarray) -> float:
        shifted = p + shift
        return float(losses @ p + (shifted * np.log(shifted / (weights + shift)) - p).sum())

    bounds = [(0.0, 1.0)] * 3
    best = minimize(divergence, weights, bounds=bounds, constraints={"type": "eq", "fun": lambda p: p.sum() - 1})
    np.testing.assert_allclose(mirror_step(weights, losses), best.x, atol=1e-4)


def test_the_cheap_goal_is_chosen_and_kept() -> None:
    goals = np.stack([START + 0.1, START + 0.2, START + 0.15])
    selector = GoalSelector(body(), goals, np.array([5.0, 1.0, 3.0]), 30, SelectionConfig(), False)
    path = first_trajectory(START, goals[0], 30)
    assert selector.first(path) == 1
    assert [selector.next(path, number) for number in range(1, 10)] == [1] * 9


def test_goals_behind_an_obstacle_are_dear() -> None:
    goals = START + np.array([[0.8], [-0.8]]) * np.eye(7)[0]
    way = ARM.chain((START + 0.5 * np.eye(7)[0])[None])
    cost = body((ball(way.origins[-1][:, 0], 0.05),))
    free = np.zeros((2, 30), dtype=bool)
    blocked, clear = cost.of_lines(START, goals, 30, free)
    assert blocked > 1.3 * clear


def test_tails_are_free_of_charge_but_for_the_person() -> None:
    end = ARM.chain(GOAL[None]).origins[-1][:, 0]
    goals, free = GOAL[None], np.zeros((1, 30), dtype=bool)
    charged = body((ball(end),)).of_lines(START, goals, 30, free)
    free[:, -TAIL:] = True
    assert body((ball(end),)).of_lines(START, goals, 30, free) < charged
    assert body((ball(end, in_tail=True),)).of_lines(START, goals, 30, free) == pytest.approx(charged)


def test_first_trajectory_rests_at_both_ends() -> None:
    path = first_trajectory(START, GOAL, 30)
    whole = np.concatenate([START[None], path, GOAL[None]])
    steps = np.linalg.norm(np.diff(whole, axis=0), axis=1)
    assert steps[0] < 0.2 * steps.max()
    assert steps[-1] == pytest.approx(steps[0])


def test_smooth_gradient_is_the_derivative_of_the_effort() -> None:
    optimiser = chomp(body())
    path = random_joints(0, 30)
    gradient = optimiser._metric @ path + optimiser._pull[:, None] * START
    small = 1e-5
    for place in ((0, 0), (0, 6), (14, 3), (29, 5)):
        step = np.zeros_like(path)
        step[place] = small
        slope = (optimiser.effort(path + step) - optimiser.effort(path - step)) / (2 * small)
        assert gradient[place] == pytest.approx(slope, rel=1e-5)


def test_a_step_puts_the_end_on_the_tail() -> None:
    start = START + 0.2  # within the padded limits, so that nothing is pushed back
    optimiser = Chomp(body(), start, LIMITS, OptimiserConfig(), CostConfig())
    tail = GOAL + np.linspace(-0.1, 0.0, TAIL)[:, None]
    path = optimiser.step(first_trajectory(start, GOAL + 0.3, 30), tail, 1)
    np.testing.assert_allclose(path[-TAIL:], tail, atol=1e-9)
    assert optimiser.done(path, tail[-1], 0.01)
    assert not optimiser.done(path, tail[-1] + 0.01, 0.01)


def test_steps_go_back_within_the_limits() -> None:
    # The start is itself 0.05 rad below joint 2's padded limit.
    optimiser, tail = chomp(body()), np.repeat(GOAL[None], TAIL, axis=0)
    path = first_trajectory(START, GOAL, 30)
    before = np.linalg.norm(optimiser.violation(path))
    after = np.linalg.norm(optimiser.violation(optimiser.step(path, tail, 1)))
    assert before > 0.05
    assert after <= OptimiserConfig().limit_tolerance


def test_steps_move_away_from_an_obstacle() -> None:
    path = first_trajectory(START, GOAL, 30)
    place = ARM.chain(path[12:13]).origins[-1][:, 0] + [0.0, 0.0, -0.15]
    optimiser = chomp(body((ball(place),)))
    tail = np.repeat(GOAL[None], TAIL, axis=0)
    before = np.linalg.norm(ARM.chain(path).origins[-1] - place[:, None], axis=0).min()
    for number in range(1, 15):
        path = optimiser.step(path, tail, number)
    after = np.linalg.norm(ARM.chain(path).origins[-1] - place[:, None], axis=0).min()
    assert after > before + 0.02


def test_obstacle_gradient_is_a_torque() -> None:
    """It pushes across the motion: what moves every point along its path gains nothing."""
    place = ARM.chain(START[None]).origins[-1][:, 0] + [0.0, 0.1, -0.05]
    cost = body((ball(place, 0.03),))
    step = 0.01 * np.eye(7)[0]
    path = START + np.arange(1, 31)[:, None] * step
    gradient = cost.gradient(path, START, path[-1] + step)
    assert np.isfinite(gradient).all()
    assert not gradient[-TAIL:].any()
    assert np.abs(gradient[0]).max() > 0.0
    # Turning about joint 1 alone moves every point along its path: nothing is gained or lost by that.
    assert abs(gradient[0, 0]) < 0.2 * np.abs(gradient[0]).max()


def test_colliding_counts_pairs() -> None:
    hand = ARM.chain(GOAL[None]).origins[-1][:, 0]
    path = np.repeat(GOAL[None], 30, axis=0)
    seen = body((ball(hand, 0.05),)).colliding(path, 0.01)
    assert seen > 0
    assert seen % (30 - TAIL) == 0
    everywhere = body((ball(hand, 0.05, in_tail=True),)).colliding(path, 0.01)
    assert everywhere == seen * 30 // (30 - TAIL)
    assert body((ball(hand + 5.0),)).colliding(path, 0.01) == 0
