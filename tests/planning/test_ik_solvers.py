"""Tests of inverse kinematics: the library's own solver against PyBullet's, and the solver that threads share."""

from typing import Any

import numpy as np
import pytest

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import compose
from handover_marl.geometry.rotations import compute_rotation_angles
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.ik_solvers import PandaIkSolver
from handover_marl.simulation.bullet.kinematics import BulletIKSolver, BulletIKStep

URDF, PANDA = SyntheticDataset().panda_urdf, PandaConfig()
ARM = ArmInWorld.for_panda(URDF, PANDA)
START = np.array(WAITING_JOINTS)


def draw_queries(seed: int, count: int) -> list[tuple[Any, ...]]:
    """Draw starts and poses, some of them out of reach."""
    rng = np.random.default_rng(seed)
    queries = []
    for _ in range(count):
        orientation = rng.normal(size=4)
        position = np.array([0.61, 0.1, 1.25]) + rng.normal(0.0, 0.25, 3)
        queries.append((START + rng.normal(0.0, 0.1, 9), position, orientation / np.linalg.norm(orientation)))
    return queries


def test_distant_solutions_are_close_to_pybullet() -> None:
    """Solutions far from the start are close to PyBullet's, because the steps are damped as PyBullet's are."""
    solvers, rng, differences = (PandaIkSolver(URDF, PANDA), BulletIKSolver(URDF, PANDA)), np.random.default_rng(1), []
    for pose in ARM.compute_hand_poses(START[:7] + rng.uniform(-1.0, 1.0, (30, 7))):
        own, bullet = (solver.solve(START, pose[:3], pose[3:]) for solver in solvers)
        assert own is not None
        assert bullet is not None
        differences.append(np.abs(own - bullet).max())
    assert np.percentile(differences, 75) < 0.1


def test_single_step_reaches_a_near_pose() -> None:
    solvers, here = (PandaIkSolver(URDF, PANDA), BulletIKStep(URDF, PANDA)), ARM.compute_hand_pose(START[:7])
    near = compose(here, np.array([0.02, -0.03, 0.04, 0.0, 0.05, 0.0, np.sqrt(1 - 0.05**2)]))
    found = solvers[0].solve_step(START, near[:3], near[3:])
    assert found.shape == solvers[1].solve_step(START, near[:3], near[3:]).shape
    hand = ARM.compute_hand_pose(found[:7])
    assert np.linalg.norm(hand[:3] - near[:3]) < 2e-3
    assert compute_rotation_angles(hand[3:], near[3:]) < 0.02
    # It moves closer to a pose out of reach, as PyBullet does.
    far = here[:3] + np.array([0.0, 2.0, 0.0])
    ends = [ARM.compute_hand_pose(solver.solve_step(START, far)[:7])[:3] for solver in solvers]
    distances = np.linalg.norm(np.array(ends) - far, axis=1)
    assert distances[0] == pytest.approx(distances[1], abs=0.1)


@pytest.mark.parametrize("solver_class", [PandaIkSolver, BulletIKSolver])
def test_many_queries_have_the_solutions_of_single_ones(solver_class: Any) -> None:
    solver, queries = solver_class(URDF, PANDA), draw_queries(2, 14)
    starts, positions, turns = (np.array(part) for part in zip(*queries, strict=True))
    found = solver.solve_many(starts, positions, turns)
    for row, query in enumerate(queries):
        one = solver.solve(*query)
        np.testing.assert_array_equal(found[row], np.full(7, np.nan) if one is None else one)
    assert 4 < np.isfinite(found[:, 0]).sum() < 14
    # The queries are also solved in parts, because a solution must not depend on the other queries.
    for rows in ([3], [5, 2], range(4, 14)):
        np.testing.assert_array_equal(solver.solve_many(starts[rows], positions[rows], turns[rows]), found[rows])
    free = solver.solve_many(starts, positions)
    assert np.isfinite(free[:, 0]).sum() > np.isfinite(found[:, 0]).sum(), "without orientation, more is in reach"
    assert solver.solve(START, (3.0, 0.0, 1.0)) is None
