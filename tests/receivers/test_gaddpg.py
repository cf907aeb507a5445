"""GA-DDPG's protocol step by step, on made-up observations."""

import json
import sys

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped_weights import GADDPG_WEIGHTS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.clock import PolicyClock
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, PolicyError, ResetNeededError
from handover_marl.models.poses import compose, compose_point, inverse
from handover_marl.policies.context import context_of
from handover_marl.receivers import make
from handover_marl.receivers.gaddpg import GaddpgReceiver
from handover_marl.receivers.gaddpg_memory import MemoryConfig
from handover_marl.testing import check_receiver

Array = npt.NDArray[np.float64]

DATA = SyntheticDataset(robot="panda_camera")
CONTEXT = context_of(DATA)
START = np.array(CONTEXT.panda.start_joints)
BASE = np.array([*CONTEXT.panda.base_position, *CONTEXT.panda.base_orientation])
STEP = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.15])
FAR = np.tile(np.float32([0.1, 0.0, 0.4]), (200, 1))
BETWEEN = np.tile(np.float32([0.0, 0.0, 0.085]), (200, 1))


class Scripted:
    """Answers always the same and keeps what it was asked."""

    def __init__(self, answer: Array = STEP) -> None:
        self.answer = answer
        self.asked: list[tuple[Array, int]] = []

    def __call__(self, points: Array, remaining: int) -> Array:
        self.asked.append((points, remaining))
        return self.answer


def constant(points: Array, remaining: int) -> Array:
    return STEP * (1.0 if points[2, 6:].mean() > 0.2 else 0.3)


@pytest.fixture(scope="module")
def gripper() -> npt.NDArray[np.float32]:
    """The hand's pose at the start."""
    episode = Episode("fast")
    episode.reset(DATA.scene(9))
    pose: npt.NDArray[np.float32] = episode.observe()["gripper_pose"]
    episode.close()
    return pose


@pytest.fixture
def network() -> Scripted:
    return Scripted()


@pytest.fixture
def receiver(network: Scripted) -> GaddpgReceiver:
    made = GaddpgReceiver(CONTEXT, network=network, wait=0.0)
    made.reset()
    return made


def seen(
    milliseconds: int,
    gripper: npt.NDArray[np.float32],
    points: npt.NDArray[np.float32] = FAR,
    joints: Array = START,
) -> Observation:
    """An observation with nothing in it that the receiver is not shown."""
    filled = np.zeros((224 * 224, 3), dtype=np.float32)
    # Behind the cloud lies what must not be read.
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


def hand_at(joints: npt.NDArray[np.floating]) -> Array:
    """World pose of the hand link."""
    episode = Episode("exact")
    episode.reset(DATA.scene(9))
    episode.world._panda.place(np.asarray(joints, dtype=np.float64).tolist())  # type: ignore[attr-defined]
    pose = episode.observe()["gripper_pose"].astype(np.float64)
    episode.close()
    return pose


def test_it_wants_clouds_and_no_true_poses(receiver: GaddpgReceiver) -> None:
    assert (receiver.sight, receiver.observes) == ("clouds", "sight")


def test_it_waits_at_the_start_pose(gripper: npt.NDArray[np.float32], network: Scripted) -> None:
    receiver = GaddpgReceiver(CONTEXT, network=network)
    receiver.reset()
    assert receiver.wait == 3.0
    np.testing.assert_array_equal(receiver.act(seen(0, gripper)), np.float32(START))
    assert receiver.hold_time == 3.0
    receiver.act(seen(2999, gripper))
    assert receiver.hold_time == 0.001
    assert network.asked == []
    receiver.act(seen(3000, gripper))
    assert len(network.asked) == 1


def test_a_decision_stands_for_150_ms(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    first = receiver.act(seen(0, gripper))
    assert receiver.hold_time == 0.149
    other = gripper + np.float32(0.01)
    np.testing.assert_array_equal(receiver.act(seen(77, other)), first)
    np.testing.assert_array_equal(receiver.act(seen(149, other)), first)
    assert receiver.hold_time == 0.001
    assert (receiver.act(seen(150, other)) != first).any()
    assert [remaining for _, remaining in network.asked] == [20, 19]


def test_the_step_is_made_in_the_hand_frame(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32], network: Scripted
) -> None:
    network.answer = 0.1 * STEP
    action = receiver.act(seen(0, gripper))
    turned = Rotation.from_euler("xyz", network.answer[3:]).as_quat()
    goal = compose(gripper.astype(np.float64), np.array([*network.answer[:3], *turned]))
    found = hand_at(action)
    # One call ends near a near target.
    assert np.linalg.norm(found[:3] - goal[:3]) < 0.2 * np.linalg.norm(network.answer[:3])
    assert (Rotation.from_quat(found[3:]).inv() * Rotation.from_quat(goal[3:])).magnitude() < 0.005
    assert action[7:].tolist() == np.float32([0.04, 0.04]).tolist()


def questions(receiver: GaddpgReceiver) -> list[tuple[Array, Array, Array | None]]:
    """Joints, position and orientation of every question to the solver from now on."""
    asked: list[tuple[Array, Array, Array | None]] = []
    solver = receiver._solver()
    solve = solver.step_towards

    def noted(joints: Array, position: Array, orientation: Array | None = None) -> Array:
        asked.append((np.array(joints), np.array(position), orientation))
        return solve(joints, position, orientation)

    solver.step_towards = noted  # type: ignore[assignment,method-assign]
    return asked


def test_turns_are_about_axes_at_rest(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32], network: Scripted
) -> None:
    network.answer = np.array([0.01, 0.02, -0.03, 0.4, 0.5, -0.45])
    asked = questions(receiver)
    receiver.act(seen(0, gripper))
    ((_, position, orientation),) = asked
    turned = Rotation.from_quat(gripper[3:]) * Rotation.from_euler("xyz", network.answer[3:])
    assert (turned.inv() * Rotation.from_quat(orientation)).magnitude() < 1e-6
    np.testing.assert_allclose(position, compose_point(gripper.astype(np.float64), network.answer[:3]), atol=1e-6)


def test_it_solves_once_from_the_exact_joints(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32], network: Scripted
) -> None:
    network.answer = np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0])
    asked, joints = questions(receiver), START + 1e-9
    action = receiver.act(seen(0, gripper, joints=joints))
    assert len(asked) == 1
    np.testing.assert_array_equal(asked[0][0], joints)
    # Far targets are not reached.
    goal = compose_point(gripper.astype(np.float64), network.answer[:3])
    assert np.linalg.norm(hand_at(action)[:3] - goal) > 0.05


def test_points_reach_the_network(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32], network: Scripted
) -> None:
    points = np.random.default_rng(0).uniform(0.1, 0.2, (3000, 3)).astype(np.float32)
    receiver.act(seen(0, gripper, points))
    inside = network.asked[0][0][:3, 6:]
    assert len(np.unique(inside[0])) > 1000
    apart = np.abs(inside.T[:, None] - points[None, :, :]).max(axis=2).min(axis=1)
    assert apart.max() < 1e-6
    # Seen again from where the hand then is, if nothing else is seen.
    elsewhere = compose(gripper.astype(np.float64), np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])).astype(np.float32)
    receiver.act(seen(150, elsewhere, points[:0]))
    moved = network.asked[1][0][:3, 6:]
    np.testing.assert_allclose(moved.mean(axis=1), inside.mean(axis=1) - [0.1, 0.0, 0.0], atol=5e-3)


def test_while_nothing_was_seen_it_starts_and_counts_nothing(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32], network: Scripted
) -> None:
    joints = START + 0.1
    for number in range(30):
        action = receiver.act(seen(150 * number, gripper, FAR[:0], joints))
        np.testing.assert_array_equal(action, np.float32(START))
        receiver.act(seen(150 * number + 149, gripper, FAR[:0], joints))
    assert network.asked == []
    receiver.act(seen(4500, gripper))
    receiver.act(seen(4650, gripper, FAR[:0]))
    assert [remaining for _, remaining in network.asked] == [20, 19]


def closes_at(receiver: GaddpgReceiver, moments: list[int], gripper: npt.NDArray[np.float32]) -> int:
    for moment in moments:
        if receiver.act(seen(moment, gripper))[7] == 0.0:
            return moment
    return -1


def test_time_is_up_after_twenty_decisions(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    moments = sorted({150 * number for number in range(30)} | {150 * number + 149 for number in range(30)})
    assert closes_at(receiver, moments, gripper) == 3000
    assert [remaining for _, remaining in network.asked] == list(range(20, 0, -1))


def test_fewer_decisions_can_be_asked_for(network: Scripted, gripper: npt.NDArray[np.float32]) -> None:
    receiver = GaddpgReceiver(CONTEXT, network=network, wait=0.0, max_steps=3)
    receiver.reset()
    assert closes_at(receiver, list(range(0, 2000, 1)), gripper) == 450


def test_it_closes_when_enough_is_between_the_fingers(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    receiver.act(seen(0, gripper, BETWEEN))
    # Not before the decision's last millisecond, and where the hand is then.
    away = compose(gripper.astype(np.float64), np.array([0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0])).astype(np.float32)
    assert receiver.act(seen(100, gripper, BETWEEN))[7] > 0.0
    receiver.act(seen(149, away, BETWEEN))
    second = receiver.act(seen(150, gripper, BETWEEN))
    assert second[7] > 0.0
    assert len(network.asked) == 2
    receiver.act(seen(299, gripper, BETWEEN))
    assert receiver.hold_time == 0.001
    closed = receiver.act(seen(300, gripper, BETWEEN, START + 0.2))
    np.testing.assert_array_equal(closed, np.float32([*second[:7], 0.0, 0.0]))
    assert receiver.hold_time == 0.5
    np.testing.assert_array_equal(receiver.act(seen(799, gripper, BETWEEN)), closed)
    assert len(network.asked) == 2


def carried(receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
    """The actions of the way to the goal, as they change; the hand is closed at 150 ms."""
    receiver.act(seen(0, gripper, BETWEEN))
    receiver.act(seen(149, gripper, BETWEEN))
    receiver.act(seen(150, gripper, BETWEEN))
    assert receiver.act(seen(649, gripper, BETWEEN))[7] == 0.0
    actions = [receiver.act(seen(650, gripper, BETWEEN))]
    now = 650
    while np.isfinite(receiver.hold_time):
        assert receiver.hold_time == 0.15
        now += 150
        # From the joints at the beginning, wherever the arm is by now.
        actions.append(receiver.act(seen(now, gripper + np.float32(0.1), BETWEEN, START + 0.3)))
    np.testing.assert_array_equal(receiver.act(seen(12_000, gripper)), actions[-1])
    return actions


def test_the_way_to_the_goal_is_straight_and_may_overshoot(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]
) -> None:
    actions = carried(receiver, gripper)
    goal = np.array(CONTEXT.protocol.goal_center)
    way = goal - gripper[:3]
    length = float(np.linalg.norm(way))
    count = int(np.ceil(length / 0.03))
    assert len(actions) == count
    assert all(action[7:].tolist() == [0.0, 0.0] for action in actions)
    for number in (0, 4, count - 1):
        expected = gripper[:3] + way / length * 0.03 * (number + 1)
        # One call from the same joints: the farther, the less exact.
        assert np.linalg.norm(hand_at(actions[number])[:3] - expected) < 0.002 + 0.1 * 0.03 * number
    assert 0.03 * count > length


def test_points_on_the_way_are_float32_and_solved_from_the_first_joints(
    receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]
) -> None:
    asked = questions(receiver)
    carried(receiver, gripper)
    way = [question for question in asked if question[2] is None]
    assert len(way) > 10
    position = gripper[:3].copy()
    step = np.array(CONTEXT.protocol.goal_center) - position
    step *= 0.03 / np.linalg.norm(step)
    for joints, point, _ in way:
        np.testing.assert_array_equal(joints, START)
        assert point.dtype == np.float32
        position = (position + step).astype(np.float32)
        np.testing.assert_allclose(point, position, atol=1e-7)


def test_asked_more_often_it_commands_the_same(network: Scripted) -> None:
    commands, asked = [], []
    for period in (None, 1, 10):
        episode, receiver = Episode("fast"), GaddpgReceiver(CONTEXT, network=constant, wait=0.3)
        episode.reset(DATA.scene(9))
        clock = PolicyClock(receiver)
        clock.reset(None)
        actions = []
        asked.append(0)
        while episode.steps < 900:
            if period is None and episode.steps < clock.due:
                action = actions[-1]
            else:
                # Made-up points: what is drawn is tested elsewhere.
                known = episode.observe()
                own = seen(0, known["gripper_pose"], FAR, episode.world.exact_joints())
                action = clock.ask({**own, "time": known["time"]}, episode.steps)
                asked[-1] += 1
            steps = clock.due - episode.steps if period is None else period
            # Periods of 10 ms do not hit a decision's last.
            actions += [action] * min(steps, 900 - episode.steps)
            episode.advance(action, steps)
        commands.append(np.array(actions[:900]))
        episode.close()
    np.testing.assert_array_equal(commands[1], commands[0])
    np.testing.assert_array_equal(commands[2], commands[0])
    assert asked[0] == 1 + 2 * 4


def test_asked_late_it_judges_before_it_decides(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    receiver.act(seen(0, gripper, BETWEEN))
    assert receiver.act(seen(160, gripper, BETWEEN))[7] == 0.0
    assert receiver.hold_time == pytest.approx(0.49)
    assert len(network.asked) == 1


def test_a_reset_forgets_the_episode(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    played = []
    for _ in range(2):
        network.asked.clear()
        actions = [receiver.act(seen(moment, gripper, BETWEEN)) for moment in (0, 149, 150, 650, 800)]
        played.append((actions, list(network.asked)))
        receiver.reset(seed=len(played))
    (actions, asked), (again, asked_again) = played
    np.testing.assert_array_equal(actions, again)
    assert len(asked) == len(asked_again) == 1
    np.testing.assert_array_equal(asked[0][0], asked_again[0][0])


def test_the_weights_that_ship_say_how_they_were_made() -> None:
    about = json.loads(str(np.load(GADDPG_WEIGHTS)["about"]))
    made_by = about["made_by"]["made by"]
    assert "setups=('s0', 's1', 's2', 's3')" in made_by, "no test scene of any setup was learned from"
    assert "dataset='dexycb'" in made_by
    assert "/" not in made_by.removeprefix("experiments/train_gaddpg.py"), "no places"
    assert about["settings"]["max_steps"] == 30


def test_it_takes_as_many_decisions_as_its_weights_say() -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    own, fewer = make("gaddpg", DATA), make("gaddpg:max_steps=12", DATA)
    assert isinstance(own, GaddpgReceiver)
    assert isinstance(fewer, GaddpgReceiver)
    assert (own.memory.remaining, fewer.memory.remaining) == (30, 12)
    assert GaddpgReceiver(CONTEXT, memory=MemoryConfig(max_steps=9)).memory.remaining == 9
    assert GaddpgReceiver(CONTEXT, network=constant).memory.remaining == 20


def test_impossible_options() -> None:
    with pytest.raises(OptionError, match="a network or weights, not both"):
        GaddpgReceiver(CONTEXT, network=constant, weights="here")
    for wrong in (0, 2.5, True):
        with pytest.raises(OptionError, match="max_steps"):
            GaddpgReceiver(CONTEXT, network=constant, max_steps=wrong)  # type: ignore[arg-type]


def test_weights_need_pytorch_and_the_protocol_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"needs PyTorch: pip install 'handover-marl\[train\]'"):
        make("gaddpg:weights=here", DATA)
    GaddpgReceiver(CONTEXT, network=constant).reset()


def test_what_networks_get_wrong_is_told(
    receiver: GaddpgReceiver, network: Scripted, gripper: npt.NDArray[np.float32]
) -> None:
    network.answer = np.zeros(7)
    with pytest.raises(PolicyError, match=r"gave an array of shape \(7,\)"):
        receiver.act(seen(0, gripper))
    with pytest.raises(ResetNeededError):
        GaddpgReceiver(CONTEXT, network=network, wait=0.0).act(seen(0, gripper))


def test_it_conforms() -> None:
    check_receiver((GaddpgReceiver, {"network": constant, "wait": 0.2}), DATA, scenes=(9,), steps=600)


def test_base_and_world_fit_together(receiver: GaddpgReceiver, gripper: npt.NDArray[np.float32]) -> None:
    expected = compose(inverse(BASE), gripper.astype(np.float64))
    matrix = receiver._base_from_hand(seen(0, gripper))
    np.testing.assert_allclose(matrix[:3, 3], expected[:3], atol=1e-6)
    np.testing.assert_allclose(matrix[:3, :3], Rotation.from_quat(expected[3:]).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
