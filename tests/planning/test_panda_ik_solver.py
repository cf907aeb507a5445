"""Tests of the library's own IK solver against PyBullet's."""

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import compose, compute_rotation_angle
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.ik_solvers import PandaIkSolver
from handover_marl.simulation.bullet.kinematics import BulletIKSolver, BulletIKStep

URDF, PANDA = SyntheticDataset().panda_urdf, OFFICIAL_CONFIG.physics.panda
ARM = ArmInWorld.for_panda(URDF, PANDA)
START = np.array(WAITING_JOINTS)
FORWARD = np.array([-0.5, 0.5, 0.5, 0.5])


@pytest.fixture(scope="module")
def own() -> PandaIkSolver:
    return PandaIkSolver(URDF, PANDA)


def test_distant_solutions_are_close_to_pybullet(own: PandaIkSolver) -> None:
    """Solutions far from the start are close to PyBullet's, because the steps are damped as PyBullet's are."""
    bullet, rng = BulletIKSolver(URDF, PANDA), np.random.default_rng(1)
    differences = []
    for pose in ARM.compute_hand_poses(START[:7] + rng.uniform(-1.0, 1.0, (30, 7))):
        solutions = [solver.solve(START, pose[:3], pose[3:]) for solver in (own, bullet)]
        assert solutions[0] is not None
        assert solutions[1] is not None
        differences.append(np.abs(solutions[0] - solutions[1]).max())
    assert np.percentile(differences, 75) < 0.1


def test_no_solution_out_of_reach(own: PandaIkSolver) -> None:
    assert own.solve(START, (3.0, 0.0, 1.0)) is None
    # Within reach of the arm, but not with this orientation.
    shoulder = np.array([0.61, -0.5, 0.875 + 0.333])
    far = shoulder + np.array([0.0, 0.8, 0.0])
    assert own.solve(START, far) is not None
    assert (
        own.solve(START, far, compose(np.array([*np.zeros(3), *FORWARD]), np.array([0, 0, 0, 1.0, 0, 0, 0]))[3:])
        is None
    )


def test_single_step_reaches_a_near_pose(own: PandaIkSolver) -> None:
    bullet = BulletIKStep(URDF, PANDA)
    here = ARM.compute_hand_pose(START[:7])
    near = compose(here, np.array([0.02, -0.03, 0.04, 0.0, 0.05, 0.0, np.sqrt(1 - 0.05**2)]))
    found = own.solve_step(START, near[:3], near[3:])
    assert found.shape == bullet.solve_step(START, near[:3], near[3:]).shape
    hand = ARM.compute_hand_pose(found[:7])
    assert np.linalg.norm(hand[:3] - near[:3]) < 2e-3
    assert compute_rotation_angle(hand[3:], near[3:]) < 0.02
    # It moves closer to a pose out of reach, as PyBullet does.
    far = here[:3] + np.array([0.0, 2.0, 0.0])
    distances = [
        np.linalg.norm(ARM.compute_hand_pose(solver.solve_step(START, far)[:7])[:3] - far) for solver in (own, bullet)
    ]
    assert distances[0] == pytest.approx(distances[1], abs=0.1)
