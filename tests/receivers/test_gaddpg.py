"""Tests of GA-DDPG's protocol, on synthetic observations."""

import json

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.assets.shipped import GADDPG_WEIGHTS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import PolicyScheduler
from handover_marl.episode.observations import Observation
from handover_marl.errors import PolicyError, ResetNeededError
from handover_marl.geometry.poses import compose
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.gaddpg import GaddpgReceiver

Array = npt.NDArray[np.float64]

DATA = SyntheticDataset(robot="panda_camera")
CONTEXT = make_policy_context(DATA)
START = np.array(CONTEXT.panda.start_joints)
STEP = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.15])
FAR = np.tile(np.float32([0.1, 0.0, 0.4]), (200, 1))
CAGED = np.tile(np.float32([0.0, 0.0, 0.085]), (200, 1))


class ConstantNetwork:
    """Network with a constant output that records its inputs."""

    def __init__(self, output: Array = STEP) -> None:
        self.output = output
        self.calls: list[tuple[Array, int]] = []

    def __call__(self, points: Array, remaining: int) -> Array:
        self.calls.append((points, remaining))
        return self.output


def scaled_step(points: Array, remaining: int) -> Array:
    return STEP * (1.0 if points[2, 6:].mean() > 0.2 else 0.3)


@pytest.fixture(scope="module")
def gripper() -> npt.NDArray[np.float32]:
    """Return the hand's pose at the start."""
    episode = Episode("fast")
    episode.reset(DATA.load_scene(9))
    pose: npt.NDArray[np.float32] = episode.observe()["gripper_pose"]
    episode.close()
    return pose


@pytest.fixture
def network() -> ConstantNetwork:
    return ConstantNetwork()


@pytest.fixture
def receiver(network: ConstantNetwork) -> GaddpgReceiver:
    made = GaddpgReceiver(CONTEXT, network=network, wait=0.0)
    made.reset()
    return made


def make_observation(
    milliseconds: int,
    gripper: npt.NDArray[np.float32],
    points: npt.NDArray[np.float32] = FAR,
    joints: Array = START,
) -> Observation:
    """Return an observation with the keys of the receiver's observation mode."""
    filled = np.zeros((224 * 224, 3), dtype=np.float32)
    # The rows after those of the cloud must not be read.
    filled[:] = 7.0
    filled[: len(points)] = points
    return {
        "time": np.array([milliseconds / 1000.0], dtype=np.float32),
        "gripper_pose": gripper,
        "robot_joint_position": joints.astype(np.float32),
        "robot_joint_velocity": np.zeros(9, dtype=np.float32),
        "wrist_object_cloud": filled,
        "wrist_hand_cloud": filled,
        "wrist_point_counts": np.array([len(points), 0], dtype=np.float32),
        "robot_joint_position_exact": joints,
    }


def compute_hand_pose(joints: npt.NDArray[np.floating]) -> Array:
    """Return the world pose of the hand link."""
    episode = Episode("exact")
    episode.reset(DATA.load_scene(9))
    panda = episode.world._loaded_workcell.panda  # type: ignore[attr-defined]
    panda.reset_joints(np.asarray(joints, dtype=np.float64).tolist())
    pose = episode.observe()["gripper_pose"].astype(np.float64)
    episode.close()
    return pose


def test_decision_is_commanded_for_150_ms(
    receiver: GaddpgReceiver, network: ConstantNetwork, gripper: npt.NDArray[np.float32]
) -> None:
    first = receiver.act(make_observation(0, gripper))
    assert receiver.hold_time == 0.149
    other = gripper + np.float32(0.01)
    np.testing.assert_array_equal(receiver.act(make_observation(77, other)), first)
    np.testing.assert_array_equal(receiver.act(make_observation(149, other)), first)
    assert receiver.hold_time == 0.001
    assert (receiver.act(make_observation(150, other)) != first).any()
    assert [remaining for _, remaining in network.calls] == [20, 19]


def find_closing_time(receiver: GaddpgReceiver, times: list[int], gripper: npt.NDArray[np.float32]) -> int:
    for time in times:
        if receiver.act(make_observation(time, gripper))[7] == 0.0:
            return time
    return -1


def test_closes_after_twenty_decisions(
    receiver: GaddpgReceiver, network: ConstantNetwork, gripper: npt.NDArray[np.float32]
) -> None:
    times = sorted({150 * number for number in range(30)} | {150 * number + 149 for number in range(30)})
    assert find_closing_time(receiver, times, gripper) == 3000
    assert [remaining for _, remaining in network.calls] == list(range(20, 0, -1))


def test_closes_on_a_caged_object(
    receiver: GaddpgReceiver, network: ConstantNetwork, gripper: npt.NDArray[np.float32]
) -> None:
    receiver.act(make_observation(0, gripper, CAGED))
    # Caging is checked only in the last millisecond of a decision, with the hand's pose at that time.
    retracted = compose(gripper.astype(np.float64), np.array([0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0])).astype(np.float32)
    assert receiver.act(make_observation(100, gripper, CAGED))[7] > 0.0
    receiver.act(make_observation(149, retracted, CAGED))
    second = receiver.act(make_observation(150, gripper, CAGED))
    assert second[7] > 0.0
    assert len(network.calls) == 2
    receiver.act(make_observation(299, gripper, CAGED))
    assert receiver.hold_time == 0.001
    closed = receiver.act(make_observation(300, gripper, CAGED, START + 0.2))
    np.testing.assert_array_equal(closed, np.float32([*second[:7], 0.0, 0.0]))
    assert receiver.hold_time == 0.5
    np.testing.assert_array_equal(receiver.act(make_observation(799, gripper, CAGED)), closed)
    assert len(network.calls) == 2


def run_retreat(receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
    """Return the actions of the path to the goal; the hand closes at 150 ms."""
    receiver.act(make_observation(0, gripper, CAGED))
    receiver.act(make_observation(149, gripper, CAGED))
    receiver.act(make_observation(150, gripper, CAGED))
    assert receiver.act(make_observation(649, gripper, CAGED))[7] == 0.0
    actions = [receiver.act(make_observation(650, gripper, CAGED))]
    now = 650
    while np.isfinite(receiver.hold_time):
        assert receiver.hold_time == 0.15
        now += 150
        # IK queries start from the joints at the start of the retreat, not from the present ones.
        actions.append(receiver.act(make_observation(now, gripper + np.float32(0.1), CAGED, START + 0.3)))
    np.testing.assert_array_equal(receiver.act(make_observation(12_000, gripper)), actions[-1])
    return actions


def test_retreat_is_straight_and_may_overshoot(receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]) -> None:
    actions = run_retreat(receiver, gripper)
    goal = np.array(CONTEXT.protocol.goal_center)
    path = goal - gripper[:3]
    length = float(np.linalg.norm(path))
    count = int(np.ceil(length / 0.03))
    assert len(actions) == count
    assert all(action[7:].tolist() == [0.0, 0.0] for action in actions)
    for number in (0, 4, count - 1):
        expected = gripper[:3] + path / length * 0.03 * (number + 1)
        # A single query from the same joints is less accurate for distant points.
        assert np.linalg.norm(compute_hand_pose(actions[number])[:3] - expected) < 0.002 + 0.1 * 0.03 * number
    assert 0.03 * count > length


def test_commands_do_not_depend_on_the_call_period(gripper: npt.NDArray[np.float32]) -> None:
    commands, calls = [], []
    # Periods of 10 ms miss the last millisecond of a decision.
    for period in (None, 1, 10):
        receiver = GaddpgReceiver(CONTEXT, network=scaled_step, wait=0.3)
        scheduler, actions = PolicyScheduler(receiver), []
        scheduler.reset(None)
        calls.append(0)
        for now in range(900):
            # The hand moves with time.
            if now >= scheduler.due if period is None else now % period == 0:
                observation = make_observation(now, gripper + np.float32([1e-4 * now, 0, 0, 0, 0, 0, 0]))
                action = scheduler.decide(observation, now)
                calls[-1] += 1
            actions.append(action)
        commands.append(np.array(actions))
    np.testing.assert_array_equal(commands[1], commands[0])
    np.testing.assert_array_equal(commands[2], commands[0])
    assert calls[0] == 1 + 2 * 4


def test_shipped_weights_describe_their_training() -> None:
    about = json.loads(str(np.load(GADDPG_WEIGHTS)["about"]))
    made_by = about["made_by"]["made by"]
    assert "setups=('s0', 's1', 's2', 's3')" in made_by, "trained without test scenes of any setup"
    assert "dataset='dexycb'" in made_by
    assert "/" not in made_by.removeprefix("experiments/train_gaddpg.py"), "no paths"
    assert about["settings"]["max_steps"] == 30


def test_invalid_network_output(
    receiver: GaddpgReceiver, network: ConstantNetwork, gripper: npt.NDArray[np.float32]
) -> None:
    network.output = np.zeros(7)
    with pytest.raises(PolicyError, match=r"must return six numbers, got an array of \(7,\)"):
        receiver.act(make_observation(0, gripper))
    with pytest.raises(ResetNeededError):
        GaddpgReceiver(CONTEXT, network=network, wait=0.0).act(make_observation(0, gripper))
