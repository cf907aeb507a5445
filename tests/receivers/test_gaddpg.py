"""Tests of GA-DDPG's protocol on synthetic observations; `tests/integration` compares it with recordings."""

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.assets.shipped import GADDPG_WEIGHTS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.loop import call_policy, start_policy
from handover_marl.episode.observations import Observation
from handover_marl.errors import PolicyError, ResetNeededError
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.gaddpg import GaddpgReceiver

Array = npt.NDArray[np.float64]

CONTEXT = make_policy_context(SyntheticDataset(robot="panda_camera"))
START = np.array(CONTEXT.panda.start_joints)
STEP = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.15])
FAR = np.tile(np.float32([0.1, 0.0, 0.4]), (200, 1))
CAGED = np.tile(np.float32([0.0, 0.0, 0.085]), (200, 1))
#: Pose of the hand near that at the start.
HAND = np.float32([0.61, -0.2, 1.25, 0.924, 0.383, 0.0, 0.0])


def scaled_step(points: Array, remaining: int) -> Array:
    return STEP * (1.0 if points[2, 6:].mean() > 0.2 else 0.3)


def make_receiver(wait: float = 0.0) -> GaddpgReceiver:
    receiver = GaddpgReceiver(CONTEXT, network=scaled_step, wait=wait)
    receiver.reset()
    return receiver


def observe(milliseconds: int, points: npt.NDArray[np.float32] = FAR, joints: Array = START) -> Observation:
    """Return an observation with the keys of the receiver's observation mode, of a hand that moves with time."""
    # The rows after those of the cloud must not be read.
    filled = np.full((224 * 224, 3), 7.0, dtype=np.float32)
    filled[: len(points)] = points
    return {
        "time": np.array([milliseconds / 1000.0], dtype=np.float32),
        "gripper_pose": HAND + np.float32([1e-4 * milliseconds, 0, 0, 0, 0, 0, 0]),
        "wrist_object_cloud": filled,
        "wrist_point_counts": np.array([len(points), 0], dtype=np.float32),
        "robot_joint_position_exact": joints,
    }


def test_commands_do_not_depend_on_the_call_period() -> None:
    commands, calls = [], []
    # Periods of 10 ms miss the last millisecond of a decision.
    for period in (None, 1, 10):
        receiver, actions, due = make_receiver(0.3), [], 0
        start_policy(receiver, None)
        calls.append(0)
        for now in range(900):
            if now >= due if period is None else now % period == 0:
                action, due = call_policy(receiver, observe(now), now)
                calls[-1] += 1
            actions.append(action)
        commands.append(np.array(actions))
    np.testing.assert_array_equal(commands[1], commands[0])
    np.testing.assert_array_equal(commands[2], commands[0])
    assert calls[0] == 1 + 2 * 4


def test_closes_after_twenty_decisions() -> None:
    receiver = make_receiver()
    times = sorted({150 * number for number in range(30)} | {150 * number + 149 for number in range(30)})
    assert next(time for time in times if receiver.act(observe(time))[7] == 0.0) == 3000


def test_closes_on_a_caged_object_and_carries_it_to_the_goal() -> None:
    receiver = make_receiver()
    receiver.act(observe(0, CAGED))
    assert receiver.hold_time == 0.149
    opened = receiver.act(observe(149, CAGED))
    closed = receiver.act(observe(150, CAGED, START + 0.2))
    np.testing.assert_array_equal(closed, np.float32([*opened[:7], 0.0, 0.0]))
    assert receiver.hold_time == 0.5
    np.testing.assert_array_equal(receiver.act(observe(649, CAGED)), closed)
    count = int(
        np.ceil(np.linalg.norm(np.array(CONTEXT.protocol.goal_center) - observe(650)["gripper_pose"][:3]) / 0.03)
    )
    # IK queries start from the joints at the start of the retreat, not from the present ones.
    actions = [receiver.act(observe(650 + 150 * number, CAGED, START + 0.3 * (number > 0))) for number in range(count)]
    assert receiver.hold_time == float("inf")
    assert len({tuple(action) for action in actions}) == count
    np.testing.assert_array_equal(receiver.act(observe(12_000)), actions[-1])


def test_weights_may_be_a_path() -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    assert GaddpgReceiver(CONTEXT, weights=GADDPG_WEIGHTS).label == GaddpgReceiver(CONTEXT).label


def test_invalid_network_output() -> None:
    receiver = GaddpgReceiver(CONTEXT, network=lambda points, remaining: np.zeros(7), wait=0.0)
    with pytest.raises(ResetNeededError):
        receiver.act(observe(0))
    receiver.reset()
    with pytest.raises(PolicyError, match=r"must return six numbers, got an array of \(7,\)"):
        receiver.act(observe(0))
