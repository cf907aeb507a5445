"""Inverse kinematics that stands in for PyBullet's."""

import numpy as np
import pytest

from handover_marl.config import OFFICIAL
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.models.panda import WAITING_JOINTS
from handover_marl.models.poses import IDENTITY, compose, rotation_angle
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.hand_solver import HandSolver
from handover_marl.sim.bullet.engine_kinematics import EngineKinematics
from handover_marl.sim.bullet.kinematics import PandaKinematics

URDF, PANDA = SyntheticDataset().panda_urdf, OFFICIAL.physics.panda
ARM = ArmInWorld.of_panda(URDF, PANDA)
START = np.array(WAITING_JOINTS)
FORWARD = np.array([-0.5, 0.5, 0.5, 0.5])


@pytest.fixture(scope="module")
def own() -> HandSolver:
    return HandSolver(URDF, PANDA)


def asked(seed: int, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joints to start from, and poses of the hand that other joints near them have."""
    rng = np.random.default_rng(seed)
    starts = START[:7] + rng.uniform(-0.3, 0.3, (count, 7))
    return list(zip(starts, ARM.hands(starts + rng.uniform(-0.5, 0.5, (count, 7))), strict=True))


def test_the_hand_ends_where_it_is_to_be(own: HandSolver) -> None:
    for start, pose in asked(0, 30):
        arm = own.solve([*start, 0.04, 0.04], pose[:3], pose[3:])
        assert arm is not None
        hand = ARM.hand(arm)
        assert np.linalg.norm(hand[:3] - pose[:3]) < 1e-3
        assert rotation_angle(hand[3:], pose[3:]) < 0.1


def test_answers_are_near_to_pybullets(own: HandSolver) -> None:
    bullet = PandaKinematics(URDF, PANDA)
    apart = []
    for start, pose in asked(1, 30):
        for orientation in (pose[3:], None):
            answers = [solver.solve([*start, 0.04, 0.04], pose[:3], orientation) for solver in (own, bullet)]
            assert answers[0] is not None
            assert answers[1] is not None
            apart.append(np.abs(answers[0] - answers[1]).max())
    assert np.median(apart) < 0.02
    assert np.percentile(apart, 90) < 0.1


def test_so_are_answers_from_far_away(own: HandSolver) -> None:
    """The joints that a long way ends in depend on the steps that are taken: Newton's own end elsewhere."""
    bullet, rng = PandaKinematics(URDF, PANDA), np.random.default_rng(1)
    apart = []
    for pose in ARM.hands(START[:7] + rng.uniform(-1.0, 1.0, (30, 7))):
        answers = [solver.solve(START, pose[:3], pose[3:]) for solver in (own, bullet)]
        assert answers[0] is not None
        assert answers[1] is not None
        apart.append(np.abs(answers[0] - answers[1]).max())
    assert np.percentile(apart, 75) < 0.1


def test_no_solution_out_of_reach(own: HandSolver) -> None:
    assert own.solve(START, (3.0, 0.0, 1.0)) is None
    # In reach of the arm, but not of the wrist that is turned so.
    shoulder = np.array([0.61, -0.5, 0.875 + 0.333])
    far = shoulder + np.array([0.0, 0.8, 0.0])
    assert own.solve(START, far) is not None
    assert (
        own.solve(START, far, compose(np.array([*np.zeros(3), *FORWARD]), np.array([0, 0, 0, 1.0, 0, 0, 0]))[3:])
        is None
    )


def test_any_rotation_will_do(own: HandSolver) -> None:
    goal = np.array([0.55, 0.05, 1.25])
    arm = own.solve(START, goal)
    assert arm is not None
    assert np.linalg.norm(ARM.hand(arm)[:3] - goal) < 1e-3
    assert rotation_angle(ARM.hand(arm)[3:], FORWARD) > 0.1


def test_answers_do_not_depend_on_earlier_questions(own: HandSolver) -> None:
    fresh = HandSolver(URDF, PANDA)
    own.solve(START, (0.4, 0.1, 1.4))
    np.testing.assert_array_equal(own.solve(START, (0.5, 0.1, 1.2)), fresh.solve(START, (0.5, 0.1, 1.2)))


def test_one_question_brings_the_hand_to_what_is_near(own: HandSolver) -> None:
    bullet = EngineKinematics(URDF, PANDA)
    here = ARM.hand(START[:7])
    near = compose(here, np.array([0.02, -0.03, 0.04, 0.0, 0.05, 0.0, np.sqrt(1 - 0.05**2)]))
    found = own.step_towards(START, near[:3], near[3:])
    assert found.shape == bullet.step_towards(START, near[:3], near[3:]).shape
    hand = ARM.hand(found[:7])
    assert np.linalg.norm(hand[:3] - near[:3]) < 2e-3
    assert rotation_angle(hand[3:], near[3:]) < 0.02
    # What is out of reach it comes nearer to, as the engine does.
    far = here[:3] + np.array([0.0, 2.0, 0.0])
    left = [np.linalg.norm(ARM.hand(solver.step_towards(START, far)[:7])[:3] - far) for solver in (own, bullet)]
    assert left[0] == pytest.approx(left[1], abs=0.1)


def test_poses_go_to_the_base_and_back_as_with_pybullet(own: HandSolver) -> None:
    bullet, pose = EngineKinematics(URDF, PANDA), ARM.hand(START[:7]).astype(np.float32)
    for found, expected in (
        (own.in_base(pose), bullet.in_base(pose)),
        (own.in_world(own.in_base(pose)), pose),
    ):
        np.testing.assert_allclose(found, expected, atol=3e-7)
        np.testing.assert_array_equal(found, found.astype(np.float32))
    assert not np.allclose(own.in_base(pose), IDENTITY)
