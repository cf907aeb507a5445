"""What a network's outputs mean."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.config import GiverConfig, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.spaces import check_giver_action, giver_action_space, receiver_action_space
from handover_marl.errors import UnknownNameError
from handover_marl.learning.features import offer_frame
from handover_marl.learning.giver_schemes import Deviation, Offer
from handover_marl.learning.observing import make_features
from handover_marl.learning.receiver_schemes import GraspServo
from handover_marl.learning.schemes import make_scheme, scheme_size, schemes
from handover_marl.receivers import WAITING_JOINTS, context_of
from handover_marl.receivers import grasp_choice as grasp_choice_module
from handover_marl.receivers.grasp_choice import MOST_ROOM, GraspChoice, grasp_choice
from handover_marl.sim.bullet.kinematics import PandaKinematics
from tests.givers.test_givers import START, seen

CONTEXT = context_of(SyntheticDataset())
outputs = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


@pytest.mark.parametrize("agent", ["giver", "receiver"])
def test_every_output_is_an_action(agent: str) -> None:
    space = giver_action_space() if agent == "giver" else receiver_action_space()
    rng = np.random.default_rng(0)
    for name in set(schemes(agent)) - {agent}:
        scheme = make_scheme(agent, name, CONTEXT)
        for _ in range(20):
            if scheme.asks(seen()):
                scheme.decide(rng.uniform(-3, 3, scheme_size(agent, name)))
            action = scheme.action(seen())
            action = check_giver_action(action, giver_action_space()) if agent == "giver" else action
            assert space.contains(action), name


def test_no_deviation_is_the_replay() -> None:
    for name in ("deviation", "offer"):
        scheme = make_scheme("giver", name, CONTEXT)
        scheme.decide(np.zeros(scheme.size))
        np.testing.assert_allclose(scheme.action(seen()), np.zeros(8), atol=1e-7)


def offered(values: np.ndarray, **changes: object) -> np.ndarray:
    scheme = make_scheme("giver", "offer", CONTEXT)
    scheme.decide(values)
    return scheme.action(seen(**changes))


@given(outputs)
def test_offers_move_the_object_and_turn_it_about_its_middle(values: np.ndarray) -> None:
    observation = seen()
    action = offered(values).astype(np.float64)
    item, axes = offer_frame(observation)
    wrist = observation["replay_wrist_poses"][-1, :3]
    place = wrist + action[1:4] + Rotation.from_rotvec(action[4:7]).apply(item - wrist)
    np.testing.assert_allclose(axes.T @ (place - item), values[:3] * Offer.reach, atol=1e-5)
    np.testing.assert_allclose(axes.T @ action[4:7], values[3:6] * Offer.turn, atol=1e-6)


@given(outputs)
def test_offers_can_be_told_from_their_actions(values: np.ndarray) -> None:
    scheme = make_scheme("giver", "offer", CONTEXT)
    assert isinstance(scheme, Offer)
    np.testing.assert_allclose(scheme.outputs(offered(values), seen())[:6], values[:6], atol=1e-5)


def test_deviations_can_be_told_from_their_actions() -> None:
    scheme, action = Deviation(CONTEXT), giver_action_space().high / 2
    scheme.reset()
    scheme.decide(scheme.outputs(action, seen()))
    np.testing.assert_allclose(scheme.action(seen()), action)


def test_offers_are_asked_once_when_the_recording_arrives() -> None:
    scheme = make_scheme("giver", "offer", CONTEXT)
    moving = np.linspace([0.6, 0.6, 1.2, 0, 0, 0, 1], [0.6, 0.4, 1.2, 0, 0, 0, 1], 5).astype(np.float32)
    assert not scheme.asks(seen(holding=np.float32([0])))
    assert not scheme.asks(seen(hand_present=np.float32([0])))
    assert not scheme.asks(seen(replay_wrist_poses=moving))
    assert scheme.asks(seen(replay_wrist_poses=moving, time=np.float32([2.5])))
    assert scheme.asks(seen())
    scheme.decide(np.zeros(7))
    assert not scheme.asks(seen())


def test_offers_draw_back_once_the_object_was_let_go() -> None:
    scheme = make_scheme("giver", "offer", CONTEXT)
    scheme.decide(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    np.testing.assert_allclose(scheme.action(seen())[1:4], np.zeros(3), atol=1e-7)
    away = scheme.action(seen(released=np.float32([1])))
    np.testing.assert_allclose(away[1:4], [0.0, Offer.withdraw, 0.0], atol=1e-6)


def test_cartesian_steps_move_the_gripper_in_its_own_frame() -> None:
    kinematics = PandaKinematics(CONTEXT.panda_urdf, PandaConfig())
    scheme = make_scheme("receiver", "cartesian_delta", CONTEXT)

    def gripper(joints: np.ndarray) -> tuple[np.ndarray, Rotation]:
        kinematics._place(joints.tolist())
        pose = kinematics._hand_pose()
        return pose[:3], Rotation.from_quat(pose[3:])

    place, turn = gripper(START.astype(np.float64))
    for axis in range(6):
        values = np.zeros(7)
        values[axis] = 0.5
        scheme.decide(values)
        target = scheme.action(seen())
        moved, turned = gripper(target.astype(np.float64))
        way = np.array([*turn.inv().apply(moved - place) / 0.08, *(turn.inv() * turned).as_rotvec() / 0.3])
        np.testing.assert_allclose(way, values[:6], atol=0.1)
        np.testing.assert_allclose(target[7:], [0.04, 0.04], rtol=1e-6)


def test_the_servo_waits_and_then_goes_for_a_grasp() -> None:
    scheme = make_scheme("receiver", "grasp_servo", CONTEXT)
    early, late = seen(time=np.float32([1.9])), seen(time=np.float32([2.0]))
    assert not scheme.asks(early)
    np.testing.assert_array_equal(scheme.action(early), np.array(WAITING_JOINTS, dtype=np.float32))
    assert scheme.asks(late)
    scheme.decide(np.zeros(7))
    assert np.abs(scheme.action(late)[:7] - START[:7]).max() > 0.02
    chosen = GraspChoice(CONTEXT).choose(late)
    assert chosen is not None
    there = scheme.action(late | {"gripper_pose": chosen[0].astype(np.float32)})
    np.testing.assert_allclose(there[:7], START[:7], atol=1e-5)
    goal = np.array([*CONTEXT.protocol.goal_center, 0, 0, 0, 1], dtype=np.float32)
    brought = scheme.action(late | {"gripper_pose": goal, "released": np.float32([1])})
    np.testing.assert_allclose(brought[:7], START[:7], atol=1e-5)


def test_the_servo_closes_for_good() -> None:
    scheme = make_scheme("receiver", "grasp_servo", CONTEXT)
    fingers = []
    for value in (0.3, -1.0, 0.6, 0.0, -1.0, 0.4):
        scheme.decide(np.array([0, 0, 0, 0, 0, 0, value]))
        fingers.append(scheme.action(seen(time=np.float32([3.0])))[7])
    np.testing.assert_allclose(fingers, [0.04, 0.04, 0.0, 0.0, 0.0, 0.0], rtol=1e-6)
    scheme.reset()
    scheme.decide(np.zeros(7))
    assert scheme.action(seen(time=np.float32([3.0])))[7] == np.float32(0.04)


def test_the_servo_comes_along_the_axis_of_the_grasp() -> None:
    """On the axis it goes for the grasp itself; beside it for a place behind the grasp, on the axis."""
    scheme, observation, choice = make_scheme("receiver", "grasp_servo", CONTEXT), seen(), GraspChoice(CONTEXT)
    first = choice.choose(observation)
    assert first is not None
    backs = []
    for away in ([0.0, 0.0, 0.0], [0.0, 0.0, -0.01], [0.1, 0.0, -0.2], [0.0, -0.3, 0.0]):
        gripper = first[0].copy()
        gripper[:3] += Rotation.from_quat(gripper[3:]).apply(away)
        now = observation | {"gripper_pose": gripper.astype(np.float32)}
        chosen = choice.choose(now)
        assert chosen is not None
        place, turned = scheme._target(now, gripper, Rotation.from_quat(gripper[3:]))
        x, y, z = turned.inv().apply(place - chosen[0][:3])
        np.testing.assert_allclose([x, y], 0.0, atol=1e-9)
        backs.append(-z)
    np.testing.assert_allclose(backs[:2], 0.0, atol=1e-9)
    assert min(backs[2:]) > 0.0
    assert max(backs) <= GraspServo.farthest_back


def test_the_chosen_grasp_leaves_room_for_the_hand() -> None:
    """With a hand where the first choice is, another one is chosen; half a turn makes no difference."""
    choice, observation = GraspChoice(CONTEXT), seen()
    away = observation | {"hand_keypoints": np.full((16, 3), 5.0, np.float32)}
    first = choice.choose(away)
    assert first is not None
    assert first[1] == MOST_ROOM
    there = np.tile(first[0][:3] + 0.01, (16, 1)).astype(np.float32)
    second = choice.choose(observation | {"hand_keypoints": there})
    assert second is not None
    assert second[1] > 0.02
    flipped = observation["gripper_pose"].copy()
    flipped[3:] = (Rotation.from_quat(flipped[3:]) * Rotation.from_rotvec([0, 0, np.pi])).as_quat()
    other = choice.choose(away | {"gripper_pose": flipped})
    assert other is not None
    np.testing.assert_allclose(other[0][:3], first[0][:3], atol=1e-6)


def test_a_choice_is_remembered_as_long_as_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grasp_choice_module, "_REMEMBERED", 2)
    assert grasp_choice(CONTEXT) is grasp_choice(CONTEXT)
    observation, shared = seen(), GraspChoice(CONTEXT)
    pose = observation["object_poses"].copy()
    pose[0, :3] += 0.1
    others = [
        {"gripper_pose": observation["gripper_pose"] + np.float32(0.01)},
        {"object_poses": pose},
        {"object_classes": observation["object_classes"] + 1},
        {"hand_keypoints": np.full((16, 3), 5.0, np.float32)},
        {"hand_present": np.zeros_like(observation["hand_present"])},
    ]
    first = shared.choose(observation)
    assert first is not None
    assert shared.choose({key: value.copy() for key, value in observation.items()}) is first
    for other in others:
        for now in (observation | other, observation):
            found, fresh = shared.choose(now), GraspChoice(CONTEXT).choose(now)
            assert (found is None) == (fresh is None)
            if found is not None and fresh is not None:
                np.testing.assert_array_equal(found[0], fresh[0])
                assert found[1] == fresh[1]
    assert len(shared._chosen) == 2
    with pytest.raises(ValueError, match="read-only"):
        first[0][0] = 0.0


def test_the_gripper_closes_above_zero() -> None:
    for name in ("joint_delta", "cartesian_delta"):
        scheme = make_scheme("receiver", name, CONTEXT)
        values = np.zeros(scheme.size)
        values[-1] = 0.1
        scheme.decide(values)
        np.testing.assert_array_equal(scheme.action(seen())[7:], [0.0, 0.0])


def test_unknown_schemes() -> None:
    with pytest.raises(UnknownNameError, match="action scheme of the giver 'joints'; valid: giver, deviation, offer"):
        make_scheme("giver", "joints", CONTEXT)
    with pytest.raises(UnknownNameError, match="action scheme of the receiver 'offer'; valid: receiver, joints"):
        scheme_size("receiver", "offer")


def test_schemes_and_features_are_of_the_world_they_are_made_for() -> None:
    """What people may do and where the goal is can be chosen."""
    narrow, moved = GiverConfig(displacement=0.1), ProtocolConfig(goal_center=(0.5, -0.3, 1.1))
    context = context_of(SyntheticDataset(), WorldConfig(protocol=moved, giver=narrow))
    scheme = make_scheme("giver", "deviation", context)
    scheme.decide(np.ones(8))
    np.testing.assert_array_equal(scheme.action(seen()), giver_action_space(narrow).high)
    servo = make_scheme("receiver", "grasp_servo", context)
    goal = np.array([*moved.goal_center, 0, 0, 0, 1], dtype=np.float32)
    brought = servo.action(seen(time=np.float32([3.0]), gripper_pose=goal, released=np.float32([1])))
    np.testing.assert_allclose(brought[:7], START[:7], atol=1e-5)
    way = np.array(moved.goal_center) - CONTEXT.protocol.goal_center
    for agent, part, scale in (("giver", slice(2, 5), -10.0), ("receiver", slice(9, 12), 5.0)):
        usual, other = (make_features(agent, agent, each)(seen()) for each in (CONTEXT, context))
        np.testing.assert_allclose((other - usual)[part], scale * way, atol=1e-5)
        np.testing.assert_array_equal(np.delete(other, np.r_[part]), np.delete(usual, np.r_[part]))
