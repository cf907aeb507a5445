"""Tests of the inverse kinematics solver that the policies of a thread share."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.planning import ik_solvers
from handover_marl.planning.ik_solvers import PandaIkSolver, make_ik_solver
from handover_marl.simulation.bullet.kinematics import BulletIKSolver

URDF = SyntheticDataset().panda_urdf
PANDA = PandaConfig()


def draw_queries(seed: int, count: int = 12) -> list[tuple[Any, ...]]:
    """Draw starts and poses, some of them out of reach."""
    rng = np.random.default_rng(seed)
    queries = []
    for _ in range(count):
        start = np.array(WAITING_JOINTS) + rng.normal(0.0, 0.1, 9)
        orientation = rng.normal(size=4)
        position = np.array([0.61, 0.1, 1.25]) + rng.normal(0.0, 0.25, 3)
        queries.append((start, position, orientation / np.linalg.norm(orientation)))
    return queries


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[PandaConfig]:
    """Record the robot configuration of each solver that is made in a test."""
    configs: list[PandaConfig] = []

    def make(urdf: Path, config: PandaConfig) -> BulletIKSolver:
        configs.append(config)
        return BulletIKSolver(urdf, config)

    monkeypatch.setattr(ik_solvers, "_make_solver", make)
    monkeypatch.setattr(ik_solvers, "_thread_solvers", ik_solvers._ThreadSolvers())
    return configs


def test_threads_do_not_share_a_solver(made: list[PandaConfig]) -> None:
    solver, queries = make_ik_solver(URDF, PANDA), draw_queries(1, 6)
    expected = [solver.solve(*query) for query in queries]

    def solve_all(_: int) -> list[Any]:
        return [solver.solve(*query) for query in queries]

    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(solve_all, range(6)):
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, other)
    assert 2 <= len(made) <= 4


@pytest.mark.parametrize("solver_class", [PandaIkSolver, BulletIKSolver])
@pytest.mark.parametrize("is_turned", [True, False])
def test_many_queries_have_the_solutions_of_single_ones(solver_class: Any, is_turned: bool) -> None:
    solver, queries = solver_class(URDF, PANDA), draw_queries(2, 14)
    starts, positions, turns = (np.array(part) for part in zip(*queries, strict=True))
    found = solver.solve_many(starts, positions, turns if is_turned else None)
    for row, (start, position, turn) in enumerate(queries):
        one = solver.solve(start, position, turn if is_turned else None)
        np.testing.assert_array_equal(found[row], np.full(7, np.nan) if one is None else one)
    assert 4 < np.isfinite(found[:, 0]).sum() < 14 + (not is_turned)
    # The queries are also solved in parts, because a solution must not depend on the other queries.
    for rows in ([3], [5, 2], range(4, 14)):
        part = solver.solve_many(starts[rows], positions[rows], turns[rows] if is_turned else None)
        np.testing.assert_array_equal(part, found[rows])
