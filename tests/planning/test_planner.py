"""Tests of goal selection and trajectory optimization."""

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.distance_field import sample_distance_field
from handover_marl.planning.planner import Chomp, make_initial_trajectory
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost, sample_body_points
from tests.planning.robots import ARM, LIMITS, START

BODY = sample_body_points(SyntheticDataset().panda_urdf, tuple(ARM.link_names), 15)
GOAL = np.array([0.4, 0.2, -0.3, -1.8, 0.3, 2.2, 0.6])
TAIL = 5


def make_cost(obstacles: tuple[Obstacle, ...] = ()) -> ObstacleCost:
    return ObstacleCost(ARM, BODY, obstacles, TAIL)


def make_sphere(center: np.ndarray, radius: float = 0.1, in_tail: bool = False) -> Obstacle:
    corner = np.full(3, radius + 0.25)
    field = sample_distance_field(lambda points: np.linalg.norm(points, axis=1) - radius, -corner, corner, 0.01)
    return Obstacle(field, np.array([*center, 0.0, 0.0, 0.0, 1.0]), 0.2, in_tail=in_tail)


def chomp(cost: ObstacleCost) -> Chomp:
    return Chomp(cost, START, LIMITS, 30)


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
