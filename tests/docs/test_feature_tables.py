"""Tests of the page of features and action schemes: every column has the described value."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium import spaces
from scipy.spatial.transform import Rotation

from handover_marl import make_action_scheme
from handover_marl.episode.observations import giver_observation_space, state_space
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.learning.encodings.registry import count_features, count_outputs, list_features, list_schemes
from handover_marl.learning.encodings.schemes import HandoverPoseScheme
from tests.docs.pages import REPOSITORY, checked_table, marks
from tests.learning.array_encodings import CONTEXT, SingleFeatures, select_grasp

AGENTS = ("giver", "receiver")
PAGE = REPOSITORY / "docs" / "reference" / "features.md"
_RNG = np.random.default_rng(1)


class Column(NamedTuple):
    """Row of a table of the page: consecutive numbers of a vector."""

    place: slice
    name: str
    value: str


def read_columns(kind: str, agent: str, name: str) -> list[Column]:
    """Return the table of features, or of an action scheme ("scheme"), on the page."""
    columns = []
    for numbers, quantity, value, *_ in checked_table(PAGE, f"{kind} {agent}/{name}"):
        if value.startswith("as in "):
            columns += read_columns(kind, agent, value.removeprefix("as in ").strip("`"))
            continue
        first, _, last = numbers.partition(" to ")
        columns.append(Column(slice(int(first), int(last or first) + 1), quantity, value))
    return columns


def _pose(*position: float) -> np.ndarray:
    return np.array([*position, *Rotation.random(random_state=_RNG).as_quat()], dtype=np.float32)


def sample() -> dict[str, Any]:
    space: spaces.Dict = giver_observation_space()
    observation = {key: part.sample() for key, part in space.items()}
    observation |= {
        "gripper_pose": _pose(0.5, -0.3, 1.3),
        "object_poses": np.stack([_pose(0.6, 0.2, 1.2) for _ in range(5)]),
        "replay_object_poses": np.stack([_pose(0.55, 0.15, 1.25) for _ in range(5)]),
        "replay_wrist_poses": np.stack([_pose(0.6, 0.3, 1.3) for _ in range(5)]),
        "hand_keypoints": _RNG.normal([0.6, 0.3, 1.2], 0.05, (16, 3)).astype(np.float32),
        "hand_present": np.float32([1.0]),
        "object_classes": np.float32([5, 0, 0, 0, 0]),
        "released": np.float32([1.0]),
        "time": np.float32([2.6]),
        "robot_joint_position": _RNG.uniform(LOWER_LIMITS, UPPER_LIMITS).astype(np.float32),
    }
    return observation


#: Sample from the observation space with valid rotations, joints and flags.
OBSERVATION = sample()


def in_gripper(point: Any) -> np.ndarray:
    gripper = OBSERVATION["gripper_pose"]
    return Rotation.from_quat(gripper[3:]).inv().apply(np.asarray(point) - gripper[:3])


def in_handover_frame(vector: Any) -> np.ndarray:
    """Turn a vector to the frame whose x axis points horizontally from the object in 0.5 s to the gripper."""
    x, y, _ = GRIPPER[:3] - FUTURE[:3]
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, np.hypot(x, y)]]) / np.hypot(x, y) @ vector


def grasp() -> np.ndarray:
    found = select_grasp(CONTEXT, OBSERVATION)
    assert found is not None
    return found[0]


def orientation(matrix: Any) -> np.ndarray:
    return np.asarray(matrix)[:, :2].ravel()


def rotation_of(pose: Any) -> Rotation:
    return Rotation.from_quat(pose[3:])


def fingers_in_future() -> np.ndarray:
    now, future = OBSERVATION["object_poses"][0], OBSERVATION["replay_object_poses"][-1]
    local = rotation_of(now).inv().apply(OBSERVATION["hand_keypoints"][1:].mean(axis=0) - now[:3])
    return rotation_of(future).apply(local)


def move_back() -> dict[str, Any]:
    """Return the observation 0.1 s before `OBSERVATION`, with other positions of object and wrist."""
    before = {key: values.copy() for key, values in OBSERVATION.items()}
    before["time"] -= np.float32(0.1)
    before["object_poses"][0, :3] -= np.float32([0.03, 0.0, -0.02])
    before["hand_keypoints"][0] -= np.float32([0.0, 0.04, 0.0])
    return before


BEFORE = move_back()
GRIPPER, FUTURE = OBSERVATION["gripper_pose"], OBSERVATION["replay_object_poses"][-1]
GOAL = np.array(CONTEXT.protocol.goal_center)
#: Functions that compute the quantity of a column from the observation independently, by the column's name.
QUANTITIES: dict[str, Callable[[], Any]] = {
    "object, from the gripper": lambda: in_gripper(OBSERVATION["object_poses"][0, :3]),
    "person's wrist, from the gripper; zeros without a hand": lambda: in_gripper(OBSERVATION["hand_keypoints"][0]),
    "mean of the person's finger joints, from the gripper": lambda: in_gripper(
        OBSERVATION["hand_keypoints"][1:].mean(axis=0)
    ),
    "goal, from the gripper": lambda: in_gripper(GOAL),
    "orientation of the object": lambda: orientation(
        (rotation_of(GRIPPER).inv() * rotation_of(OBSERVATION["object_poses"][0])).as_matrix()
    ),
    "vertical of the world": lambda: rotation_of(GRIPPER).inv().apply([0.0, 0.0, 1.0]),
    "finger joints of the robot": lambda: OBSERVATION["robot_joint_position"][7:],
    "velocities of the finger joints": lambda: OBSERVATION["robot_joint_velocity"][7:],
    "arm joints of the robot": lambda: OBSERVATION["robot_joint_position"][:7],
    "released": lambda: [1.0],
    "time": lambda: [2.6 / 13.0],
    "hand present": lambda: [1.0],
    "YCB class of the object": lambda: np.eye(21)[4],
    "grasp, from the gripper; zeros without a grasp": lambda: in_gripper(grasp()[:3]),
    "rotation vector to the grasp; zeros without a grasp": lambda: (
        rotation_of(GRIPPER).inv() * rotation_of(grasp())
    ).as_rotvec(),
    "clearance of the person's hand on the way to the grasp, at most 0.2 m": lambda: [
        select_grasp(CONTEXT, OBSERVATION)[1]  # type: ignore[index]
    ],
    "grasp exists": lambda: [1.0],
    "velocity of the object": lambda: rotation_of(GRIPPER).inv().apply([0.3, 0.0, -0.2]),
    "velocity of the person's wrist": lambda: rotation_of(GRIPPER).inv().apply([0.0, 0.4, 0.0]),
    "distance to the grasp": lambda: [np.linalg.norm(grasp()[:3] - GRIPPER[:3])],
    "angle to the grasp": lambda: [(rotation_of(GRIPPER).inv() * rotation_of(grasp())).magnitude()],
    "horizontal distance of the gripper from the object in 0.5 s": lambda: [np.linalg.norm((GRIPPER - FUTURE)[:2])],
    "height of the gripper above the object in 0.5 s": lambda: [GRIPPER[2] - FUTURE[2]],
    "object in 0.5 s, from the goal": lambda: FUTURE[:3] - GOAL,
    "person's wrist in 0.5 s, from the object": lambda: in_handover_frame(
        OBSERVATION["replay_wrist_poses"][-1, :3] - FUTURE[:3]
    ),
    "mean of the finger joints in 0.5 s, from the object": lambda: in_handover_frame(fingers_in_future()),
    "orientation of the object in 0.5 s": lambda: orientation(in_handover_frame(rotation_of(FUTURE).as_matrix())),
}


def described_value(text: str, quantity: Any) -> np.ndarray:
    """Evaluate the value of a column, such as "10 q - 5", for a quantity q."""
    formula = text.partition(",")[0] if "within" in text else text.partition(";")[0]
    if "q" not in formula.replace("row by row", ""):
        return np.asarray(quantity)  # the column is a flag, which is described in words
    for factor in ("5", "10", "50"):
        formula = formula.replace(f"{factor} q", f"{factor} * q")
    values: np.ndarray = eval(formula, {"q": np.asarray(quantity, dtype=float), "exp": np.exp})
    return values


@pytest.mark.parametrize("agent", AGENTS)
def test_every_column_is_described(agent: str) -> None:
    text = PAGE.read_text()
    for kind, unit, names, count in (
        ("features", "features", list_features(agent), count_features),
        ("scheme", "outputs", list_schemes(agent), count_outputs),
    ):
        for name in names:
            size = count(agent, name)
            assert f"`{name}` of the {agent} ({size} {unit})" in text
            columns = read_columns(kind, agent, name) if f"{kind} {agent}/{name}" in marks(PAGE) else []
            ends = [0, *(each.place.stop for each in columns)]
            assert [each.place.start for each in columns] == ends[:-1]
            assert not columns or ends[-1] == size


@pytest.mark.parametrize(
    ("agent", "name"),
    [("giver", "giver"), *(("receiver", n) for n in ("receiver", "grasp", "grasp_velocity", "close"))],
)
def test_features_have_the_described_values(agent: str, name: str) -> None:
    extractor = SingleFeatures(agent, name, CONTEXT)
    extractor(BEFORE)
    features = extractor(OBSERVATION)
    for column in read_columns("features", agent, name):
        expected = described_value(column.value, QUANTITIES[column.name]())
        np.testing.assert_allclose(features[column.place], expected, atol=1e-4, err_msg=column.name)


@pytest.mark.slow
def test_stacked_features_begin_with_those_of_the_present_decision() -> None:
    single, stacked = SingleFeatures("receiver", "close", CONTEXT), SingleFeatures("receiver", "close_stack", CONTEXT)
    times = [0.0, 0.2, 0.2, 0.4, 0.6, 0.8]
    observations = [{**sample(), "time": np.float32([time])} for time in times]
    expected = [single(observation) for observation in observations]
    for episode in range(2):
        stacked.features.reset(0)
        for number, observation in enumerate(observations):
            found = stacked(observation).reshape(4, -1)
            # The later one of two observations at the same time replaces the earlier one.
            decisions = [own for own in range(number + 1) if times[own] not in times[own + 1 : number + 1]]
            for place, own in enumerate(reversed(decisions[-4:])):
                np.testing.assert_array_equal(found[place], expected[own], err_msg=f"{episode}, {number}")
            assert not found[len(decisions) :].any()


def test_flat_features_are_the_named_entries() -> None:
    for agent, keys in (("giver", OBSERVATION), ("receiver", state_space())):
        expected = np.concatenate([OBSERVATION[key].ravel() for key in sorted(keys)])
        np.testing.assert_array_equal(SingleFeatures(agent, f"flat_{agent}", CONTEXT)(OBSERVATION), expected)


def described_scale(text: str) -> list[float]:
    """Return the numbers before "at 1" in the value of a column, such as "0.01, 0.01 and 0.03 at 1"."""
    return [float(number) for number in text.partition(" at 1")[0].replace(" and", ",").split(",")]


def test_schemes_of_givers_have_the_described_scales() -> None:
    deviation = make_action_scheme("giver", "deviation", CONTEXT)
    deviation.set_outputs(np.ones(8))
    action = deviation.compute_action(OBSERVATION)
    for column in read_columns("scheme", "giver", "deviation")[:3]:
        np.testing.assert_allclose(action[column.place], described_scale(column.value)[0], rtol=1e-6)
    offer = HandoverPoseScheme
    scales = [described_scale(column.value)[0] for column in read_columns("scheme", "giver", "offer")]
    assert scales == [offer.max_output_translation, offer.max_output_rotation, offer.max_withdrawal]


def test_schemes_of_receivers_have_the_described_scales() -> None:
    names = ("joint_delta", "cartesian_delta", "grasp_servo")
    columns = {name: read_columns("scheme", "receiver", name) for name in names}
    delta: Any = make_action_scheme("receiver", "joint_delta", CONTEXT)
    centered = {**OBSERVATION, "robot_joint_position": np.float32((np.array(LOWER_LIMITS) + UPPER_LIMITS) / 2)}
    delta.set_outputs(np.ones(8))
    moved = delta.compute_action(centered)
    np.testing.assert_allclose(
        moved[:7] - centered["robot_joint_position"][:7], described_scale(columns["joint_delta"][0].value)[0], rtol=1e-5
    )
    np.testing.assert_array_equal(moved[7:], 0.0)
    cartesian: Any = make_action_scheme("receiver", "cartesian_delta", CONTEXT).scheme
    servo: Any = make_action_scheme("receiver", "grasp_servo", CONTEXT).scheme
    assert [described_scale(column.value) for column in columns["cartesian_delta"][:2]] == [
        [cartesian.max_output_translation],
        [cartesian.max_output_rotation],
    ]
    assert [described_scale(column.value) for column in columns["grasp_servo"][:2]] == [
        list(servo.max_output_translation),
        [servo.max_output_rotation],
    ]
    assert f"above {servo.close_threshold:g}" in columns["grasp_servo"][2].value
    joints = make_action_scheme("receiver", "joints", CONTEXT)
    for value, limits in ((-1.0, LOWER_LIMITS), (1.0, UPPER_LIMITS)):
        joints.set_outputs(np.full(9, value))
        np.testing.assert_allclose(joints.compute_action(OBSERVATION), limits, rtol=1e-6)


def test_features_without_a_grasp_are_zeros() -> None:
    without = replace(CONTEXT, load_grasps=lambda name: None)
    np.testing.assert_array_equal(SingleFeatures("receiver", "close", without)(OBSERVATION)[[*range(8), 11]], 0.0)
    np.testing.assert_array_equal(SingleFeatures("receiver", "grasp", without)(OBSERVATION)[-8:], 0.0)
