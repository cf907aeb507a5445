"""Tests of the OMG receiver."""

import logging

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.loop import call_policy, start_policy
from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import transform_points
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers import WAITING_JOINTS
from handover_marl.receivers.omg import OmgReceiver
from tests.helpers.playing import observe_handover
from tests.receivers.quick import short_planning  # noqa: F401

SCENE = 5
DATA = SyntheticDataset()


def make_omg() -> OmgReceiver:
    receiver = OmgReceiver(make_policy_context(DATA))
    receiver.reset()
    return receiver


@pytest.fixture(scope="module")
def handover_observation() -> Observation:
    """Return the observation at the time of planning."""
    return observe_handover(DATA.load_scene(SCENE), 3000)


def observe_at(observation: Observation, milliseconds: int) -> Observation:
    return {**observation, "time": np.array([milliseconds / 1000.0], dtype=np.float32)}


@pytest.mark.slow
def test_timing_of_commands(handover_observation: Observation) -> None:
    receiver = make_omg()
    np.testing.assert_array_equal(receiver.act(observe_at(handover_observation, 0)), np.float32(WAITING_JOINTS))
    assert receiver.hold_time == 3.0
    assert receiver.plan is None
    first = receiver.act(observe_at(handover_observation, 3000))
    plan = receiver.plan
    assert plan is not None
    assert receiver.hold_time == 0.13
    np.testing.assert_array_equal(first, np.float32([*plan.trajectory[0], 0.04, 0.04]))
    np.testing.assert_array_equal(receiver.act(observe_at(handover_observation, 3129)), first)
    for number in (1, 17, 29):
        action = receiver.act(observe_at(handover_observation, 3000 + 130 * number))
        np.testing.assert_array_equal(action, np.float32([*plan.trajectory[number], 0.04, 0.04]))
    closed = receiver.act(observe_at(handover_observation, 6900))
    np.testing.assert_array_equal(closed, np.float32([*plan.trajectory[29], 0.0, 0.0]))
    assert receiver.hold_time == 0.5
    receiver.act(observe_at(handover_observation, 7400))
    assert receiver.hold_time == 0.13
    last = receiver.act(observe_at(handover_observation, 12_000))
    assert receiver.hold_time == float("inf")
    assert last[7:].tolist() == [0.0, 0.0]


def test_retreat_is_straight(handover_observation: Observation) -> None:
    receiver = make_omg()
    receiver.act(observe_at(handover_observation, 3000))
    actions = [receiver.act(observe_at(handover_observation, 7400 + 130 * number)) for number in range(40)]
    path = np.array([action[:7] for action in actions], dtype=np.float64)
    points = transform_points(receiver.world_from_base, receiver.arm.compute_chain_frames(path).origins[-1].T)
    # The observation does not change, so the line starts at the hand's position at 3 s.
    start = handover_observation["gripper_pose"][:3].astype(np.float64)
    goal = np.array(receiver.context.protocol.goal_center)
    length = float(np.linalg.norm(goal - start))
    along = (points - start) @ (goal - start) / length
    lateral = np.linalg.norm(points - start - along[:, None] * (goal - start) / length, axis=1)
    assert lateral.max() < 2e-3
    count = int(np.ceil(length / 0.03))
    np.testing.assert_allclose(along[:count], length * np.arange(1, count + 1) / count, atol=2e-3)
    np.testing.assert_allclose(points[count:], np.tile(goal, (40 - count, 1)), atol=2e-3)


@pytest.mark.slow
def test_commands_do_not_depend_on_the_call_period(handover_observation: Observation) -> None:
    receiver, commands = make_omg(), []
    for period in (None, 10):
        actions, due = [], 0
        start_policy(receiver, None)
        for now in range(0, 12_000, 10):
            if period is not None or now >= due:
                action, due = call_policy(receiver, observe_at(handover_observation, now), now)
            actions.append(action)
        commands.append(np.array(actions))
    np.testing.assert_array_equal(*commands)


@pytest.mark.parametrize(("shift", "class_number", "text"), [(3.0, None, "reached"), (0.0, 1, "002_master_chef_can")])
def test_failures_to_plan_are_logged(
    handover_observation: Observation,
    caplog: pytest.LogCaptureFixture,
    shift: float,
    class_number: int | None,
    text: str,
) -> None:
    """The receiver stays at the start pose if no grasp can be reached, and if no grasps are known."""
    observation = {key: value.copy() for key, value in observe_at(handover_observation, 3000).items()}
    observation["object_poses"][0, 1] += shift
    if class_number is not None:
        observation["object_classes"][0] = class_number
    receiver = make_omg()
    with caplog.at_level(logging.WARNING):
        for now in (3000, 9000):
            action = receiver.act(observe_at(observation, now))
            np.testing.assert_array_equal(action, np.float32(WAITING_JOINTS))
            assert receiver.hold_time == float("inf")
    assert text in caplog.text
