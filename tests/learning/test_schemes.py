"""Tests of action schemes, which decode network outputs, and of custom schemes and features: forms and errors."""

import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import handover_marl
from handover_marl.config import GiverConfig, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs.wrappers.control_agent import control_agent
from handover_marl.episode.observations import add_episode_axis
from handover_marl.episode.spaces import check_giver_action, giver_action_space, receiver_action_space
from handover_marl.errors import HandoverError, OptionError
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.custom import declare_size
from handover_marl.learning.encodings.features import compute_handover_frames
from handover_marl.learning.encodings.registry import count_outputs, list_schemes, make_action_scheme
from handover_marl.learning.encodings.schemes import HandoverPoseScheme
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.receivers import WAITING_JOINTS, make_policy_context
from tests.givers.test_givers import START, seen
from tests.learning.array_encodings import SingleFeatures, select_grasp
from tests.learning.custom import FirstJoint, OffsetAndCount, move_first_joint, offset_to_object

CONTEXT = make_policy_context(SyntheticDataset())
outputs = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


@pytest.mark.parametrize("agent", ["giver", "receiver"])
def test_any_outputs_give_a_valid_action(agent: str) -> None:
    space = giver_action_space() if agent == "giver" else receiver_action_space()
    rng = np.random.default_rng(0)
    for name in set(list_schemes(agent)) - {agent}:
        scheme = make_action_scheme(agent, name, CONTEXT)
        for _ in range(20):
            if scheme.needs_outputs(seen()):
                scheme.set_outputs(rng.uniform(-3, 3, count_outputs(agent, name)))
            action = scheme.compute_action(seen())
            action = check_giver_action(action, giver_action_space()) if agent == "giver" else action
            assert space.contains(action), name


def handover_action(values: np.ndarray, **changes: object) -> np.ndarray:
    scheme = make_action_scheme("giver", "offer", CONTEXT)
    scheme.set_outputs(values)
    return scheme.compute_action(seen(**changes))


@given(outputs)
def test_handover_pose_moves_and_rotates_the_object_about_its_center(values: np.ndarray) -> None:
    observation = seen()
    action = handover_action(values).astype(np.float64)
    (item,), (axes,) = compute_handover_frames({key: values[None] for key, values in observation.items()})
    wrist = observation["replay_wrist_poses"][-1, :3]
    place = wrist + action[1:4] + Rotation.from_rotvec(action[4:7]).apply(item - wrist)
    np.testing.assert_allclose(
        axes.T @ (place - item), values[:3] * HandoverPoseScheme.max_output_translation, atol=1e-5
    )
    np.testing.assert_allclose(axes.T @ action[4:7], values[3:6] * HandoverPoseScheme.max_output_rotation, atol=1e-6)


def test_outputs_are_needed_once_when_the_recording_arrives() -> None:
    scheme = make_action_scheme("giver", "offer", CONTEXT)
    moving = np.linspace([0.6, 0.6, 1.2, 0, 0, 0, 1], [0.6, 0.4, 1.2, 0, 0, 0, 1], 5).astype(np.float32)
    assert not scheme.needs_outputs(seen(holding=np.float32([0])))
    assert not scheme.needs_outputs(seen(hand_present=np.float32([0])))
    assert not scheme.needs_outputs(seen(replay_wrist_poses=moving))
    assert scheme.needs_outputs(seen(replay_wrist_poses=moving, time=np.float32([2.5])))
    assert scheme.needs_outputs(seen())
    scheme.set_outputs(np.zeros(7))
    assert not scheme.needs_outputs(seen())


def test_hand_withdraws_after_the_release() -> None:
    scheme = make_action_scheme("giver", "offer", CONTEXT)
    scheme.set_outputs(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    np.testing.assert_allclose(scheme.compute_action(seen())[1:4], np.zeros(3), atol=1e-7)
    away = scheme.compute_action(seen(released=np.float32([1])))
    np.testing.assert_allclose(away[1:4], [0.0, HandoverPoseScheme.max_withdrawal, 0.0], atol=1e-6)


def test_cartesian_delta_moves_the_gripper_in_its_own_frame() -> None:
    robot = ArmInWorld.for_panda(CONTEXT.panda_urdf, PandaConfig())
    scheme = make_action_scheme("receiver", "cartesian_delta", CONTEXT)

    def gripper(joints: np.ndarray) -> tuple[np.ndarray, Rotation]:
        pose = robot.compute_hand_pose(joints[:7])
        return pose[:3], Rotation.from_quat(pose[3:])

    place, turn = gripper(START.astype(np.float64))
    for axis in range(6):
        values = np.zeros(7)
        values[axis] = 0.5
        scheme.set_outputs(values)
        target = scheme.compute_action(seen())
        moved, turned = gripper(target.astype(np.float64))
        way = np.array([*turn.inv().apply(moved - place) / 0.08, *(turn.inv() * turned).as_rotvec() / 0.3])
        np.testing.assert_allclose(way, values[:6], atol=0.1)
        np.testing.assert_allclose(target[7:], [0.04, 0.04], rtol=1e-6)


@pytest.mark.parametrize("name", ["joint_delta", "cartesian_delta"])
def test_outputs_follow_from_the_action_of_a_receiver(name: str) -> None:
    scheme = make_action_scheme("receiver", name, CONTEXT)
    observation: Any = add_episode_axis(seen())
    values = np.random.default_rng(0).uniform(-0.8, 0.8, scheme.scheme.size)
    values[-1] = 1.0
    scheme.set_outputs(values)
    action = scheme.compute_action(seen())
    # The damping of the least squares shortens motions a little.
    (found,) = scheme.scheme.outputs_from_actions(action[None], observation)
    np.testing.assert_allclose(found, values, atol=0.05)
    far = action.copy()
    far[:7] = START[:7] + 5 * (action[:7] - START[:7])
    (found,) = scheme.scheme.outputs_from_actions(far[None], observation)
    assert abs(found).max() <= 1.0
    np.testing.assert_allclose(found[:3] / values[:3], np.full(3, found[0] / values[0]), rtol=0.1)


def test_grasp_servo_waits_then_approaches_a_grasp() -> None:
    scheme = make_action_scheme("receiver", "grasp_servo", CONTEXT)
    early, late = seen(time=np.float32([1.9])), seen(time=np.float32([2.0]))
    assert not scheme.needs_outputs(early)
    np.testing.assert_array_equal(scheme.compute_action(early), np.array(WAITING_JOINTS, dtype=np.float32))
    assert scheme.needs_outputs(late)
    scheme.set_outputs(np.zeros(7))
    assert np.abs(scheme.compute_action(late)[:7] - START[:7]).max() > 0.02
    chosen = select_grasp(CONTEXT, late)
    assert chosen is not None
    there = scheme.compute_action(late | {"gripper_pose": chosen[0].astype(np.float32)})
    np.testing.assert_allclose(there[:7], START[:7], atol=1e-5)
    goal = np.array([*CONTEXT.protocol.goal_center, 0, 0, 0, 1], dtype=np.float32)
    brought = scheme.compute_action(late | {"gripper_pose": goal, "released": np.float32([1])})
    np.testing.assert_allclose(brought[:7], START[:7], atol=1e-5)


def test_grasp_servo_stays_closed() -> None:
    scheme = make_action_scheme("receiver", "grasp_servo", CONTEXT)
    fingers = []
    for value in (0.3, -1.0, 0.6, 0.0, -1.0, 0.4):
        scheme.set_outputs(np.array([0, 0, 0, 0, 0, 0, value]))
        fingers.append(scheme.compute_action(seen(time=np.float32([3.0])))[7])
    np.testing.assert_allclose(fingers, [0.04, 0.04, 0.0, 0.0, 0.0, 0.0], rtol=1e-6)
    scheme.reset()
    scheme.set_outputs(np.zeros(7))
    assert scheme.compute_action(seen(time=np.float32([3.0])))[7] == np.float32(0.04)


@pytest.mark.slow
def test_chosen_grasp_is_kept_while_observations_are_equal() -> None:
    selector, observation = LowestCostGraspSelector(CONTEXT, 1), seen()
    pose = observation["object_poses"].copy()
    pose[0, :3] += 0.1
    others = [
        {"gripper_pose": observation["gripper_pose"] + np.float32(0.01)},
        {"object_poses": pose},
        {"object_classes": observation["object_classes"] + 1},
        {"hand_keypoints": np.full((16, 3), 5.0, np.float32)},
        {"hand_present": np.zeros_like(observation["hand_present"])},
    ]
    for other in others:
        for now in (observation | other, observation, observation):
            grasps, clearances, exists = selector.select(
                np.array([0]), {key: value[None] for key, value in now.items()}
            )
            fresh = select_grasp(CONTEXT, now)
            assert exists[0] == (fresh is not None)
            if fresh is not None:
                np.testing.assert_array_equal(grasps[0], fresh[0])
                assert clearances[0] == fresh[1]


def test_schemes_and_features_follow_the_configuration() -> None:
    """Schemes and features use the configured bounds of the giver and the configured position of the goal."""
    narrow, moved = GiverConfig(displacement=0.1), ProtocolConfig(goal_center=(0.5, -0.3, 1.1))
    context = make_policy_context(SyntheticDataset(), WorldConfig(protocol=moved, giver=narrow))
    scheme = make_action_scheme("giver", "deviation", context)
    scheme.set_outputs(np.ones(8))
    np.testing.assert_array_equal(scheme.compute_action(seen()), giver_action_space(narrow).high)
    servo = make_action_scheme("receiver", "grasp_servo", context)
    goal = np.array([*moved.goal_center, 0, 0, 0, 1], dtype=np.float32)
    brought = servo.compute_action(seen(time=np.float32([3.0]), gripper_pose=goal, released=np.float32([1])))
    np.testing.assert_allclose(brought[:7], START[:7], atol=1e-5)
    way = np.array(moved.goal_center) - CONTEXT.protocol.goal_center
    for agent, part, scale in (("giver", slice(2, 5), -10.0), ("receiver", slice(9, 12), 5.0)):
        usual, other = (SingleFeatures(agent, agent, each)(seen()) for each in (CONTEXT, context))
        np.testing.assert_allclose((other - usual)[part], scale * way, atol=1e-5)
        np.testing.assert_array_equal(np.delete(other, np.r_[part]), np.delete(usual, np.r_[part]))


MODULE = "tests.learning.custom"
SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}


@declare_size(1)
def broken(observation: Any) -> Any:
    return observation["nothing"]


class Unmakable(OffsetAndCount):
    def __init__(self, context: Any) -> None:
        raise RuntimeError("no weights")


LOCKED = OffsetAndCount(CONTEXT)
LOCKED.lock = threading.Lock()  # type: ignore[attr-defined]


def features_that(result: Any, **attributes: Any) -> Any:
    @declare_size(2)
    def mine(observation: Any) -> Any:
        return result

    vars(mine).update(attributes)
    return mine


@pytest.mark.parametrize(
    ("choice", "name", "size"),
    [
        (offset_to_object, "offset_to_object", 3),
        (OffsetAndCount, "OffsetAndCount", 4),
        (f"{MODULE}:offset_to_object", f"{MODULE}:offset_to_object", 3),
        (f"{MODULE}:OffsetAndCount", f"{MODULE}:OffsetAndCount", 4),
    ],
)
def test_forms_of_own_features(choice: Any, name: str, size: int) -> None:
    made = SingleFeatures("receiver", choice, CONTEXT)
    assert (made.features.name, made.features.size) == (name, size)
    np.testing.assert_array_equal(made(seen())[:3], offset_to_object(seen()))


@pytest.mark.parametrize("choice", [FirstJoint, move_first_joint, f"{MODULE}:FirstJoint", f"{MODULE}:move_first_joint"])
def test_forms_of_own_schemes(choice: Any) -> None:
    scheme = make_action_scheme("receiver", choice, CONTEXT)
    assert scheme.scheme.size == 1
    assert scheme.needs_outputs(seen())
    np.testing.assert_array_equal(scheme.compute_action(seen()), START)
    scheme.set_outputs(np.array([3.0]))
    assert scheme.compute_action(seen())[0] == pytest.approx(START[0] + 0.1)
    scheme.reset()
    np.testing.assert_array_equal(scheme.compute_action(seen()), START)


def test_memory_of_own_scheme_functions_is_cleared() -> None:
    resets: list[int] = []
    parts = {"size": 1, "reset": lambda self: resets.append(1), "__call__": lambda self, outputs, observation: START}
    scheme = make_action_scheme("receiver", type("Mine", (), parts)(), CONTEXT)
    resets.clear()
    scheme.reset()
    assert resets == [1]


@pytest.mark.parametrize(
    ("make", "agent", "choice", "message"),
    [
        *(
            (SingleFeatures, "receiver", features_that(result), f"features '.*mine' must be {fault}")
            for result, fault in (
                (np.zeros(2), r"a float32 array of shape \(2,\), got float64 \(2,\); convert with"),
                (np.array([0.0, np.nan], np.float32), "finite, got nan in component 1"),
            )
        ),
        (SingleFeatures, "receiver", broken, r"features 'broken' failed: KeyError: 'nothing' .test_schemes.py, line"),
        (SingleFeatures, "receiver", Unmakable, r"'Unmakable' cannot be made \(RuntimeError: no weights\)"),
        (SingleFeatures, "receiver", LOCKED, r"'OffsetAndCount' cannot be made \(TypeError: cannot pickle"),
        (SingleFeatures, "receiver", features_that(None, reset=print), "mine' with a reset must be a class, got"),
        (SingleFeatures, "receiver", len, "features 'len' must declare the number of features"),
        (SingleFeatures, "giver", OffsetAndCount, "'OffsetAndCount' must be for the giver, got some for the receiver"),
        (SingleFeatures, "receiver", "nothing", "features of the receiver 'nothing'; valid: receiver"),
        (SingleFeatures, "receiver", "no_such_module:x", "it cannot be imported"),
        (make_action_scheme, "receiver", OffsetAndCount, "must be a name, a subclass of .*ActionScheme or a function"),
    ],
)
def test_invalid_choices(make: Any, agent: str, choice: Any, message: str) -> None:
    with pytest.raises(HandoverError, match=message):
        make(agent, choice, CONTEXT)(seen())


def test_environments_take_own_features_and_schemes() -> None:
    env = handover_marl.encode(handover_marl.parallel_env(**SYNTHETIC), {"receiver": OffsetAndCount}, {})
    assert env.observation_space("receiver").shape == (4,)
    names = {agent: env.action_space(agent).encoding["features"] for agent in env.possible_agents}
    assert names == {"giver": "giver", "receiver": "OffsetAndCount"}
    alone = control_agent(handover_marl.parallel_env(**SYNTHETIC), "receiver", "replay")
    own = handover_marl.encode(alone, OffsetAndCount, move_first_joint, api="gymnasium")
    assert (own.observation_space.shape, own.action_space.shape) == ((4,), (1,))
    for _ in range(2):
        first, _ = own.reset(seed=0)
        second, *_ = own.step(np.ones(1, np.float32))
        assert (first[3], second[3]) == (1.0, 2.0), "memory was cleared at the reset"
        assert own.observation_space.contains(second)
    own.close()


def test_camera_data_alone_suffices_for_own_features() -> None:
    alone = control_agent(handover_marl.parallel_env(obs_mode="pointcloud", **SYNTHETIC), "receiver", "replay")
    assert handover_marl.encode(alone, features_that(None)).observation_space("receiver").shape == (2,)
    with pytest.raises(OptionError, match="obs_mode must include the state"):
        handover_marl.encode(alone, features_that(None), "grasp_servo")


@pytest.mark.slow
def test_environments_of_a_batch_do_not_share_memory() -> None:
    options: dict[str, Any] = {"action_scheme": FirstJoint, "dataset": "synthetic", "threads": 1}
    envs = handover_marl.vector_env(2, "receiver", "replay", features=OffsetAndCount(CONTEXT), **options)
    assert envs.reset(seed=0)[0][:, 3].tolist() == [1.0, 1.0]
    assert envs.step(np.zeros((2, 1), np.float32))[0][:, 3].tolist() == [2.0, 2.0]
    envs.close()
