"""Feature vectors for small networks, computed from observations.

Positions are scaled to decimetres and expressed in the frame of the planned handover or of the
gripper, so that the components are of order one and independent of the world frame.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP, ProtocolConfig
from handover_marl.episode.observations import Observation, giver_observation_space, state_space
from handover_marl.errors import check_name
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS
from handover_marl.learning.encodings.choices import is_reference
from handover_marl.learning.encodings.custom_features import (
    KIND,
    AgentFeatures,
    FeatureFunction,
    FeaturesLike,
    Vector,
    make_custom_features,
)
from handover_marl.learning.grasp_selector import get_lowest_cost_grasp_selector
from handover_marl.policies.policy import PolicyContext
from handover_marl.policies.registry import import_reference

Array = npt.NDArray[np.float64]

#: Scale of positions, and of the translation to a grasp (1/m).
SCALE, GRASP_SCALE = 10.0, 5.0
_N_RECEIVER, _N_GRASP, _N_PROXIMITY = 35 + LARGEST_YCB_CLASS, 8, 12
#: Number of decisions in stacked features.
N_STACKED = 4
_GIVER_SPACE, _RECEIVER_SPACE = giver_observation_space(), state_space()


def compute_handover_frame(observation: Observation) -> tuple[Array, Array]:
    """Return the frame at the object's recorded position 0.5 s later, with x towards the gripper.

    Returns:
        (3,) origin in the world (m) and (3, 3) axes as columns in the world: x points horizontally
        towards the gripper, z up.
    """
    origin = observation["replay_object_poses"][-1, :3].astype(np.float64)
    to_gripper = observation["gripper_pose"][:2] - origin[:2]
    length = float(np.linalg.norm(to_gripper))
    x, y = to_gripper / length if length > 1e-6 else (1.0, 0.0)
    return origin, np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def compute_giver_features(observation: Observation, protocol: ProtocolConfig) -> Vector:
    """Return the (39,) features from which a giver can choose a handover pose.

    In the frame of `compute_handover_frame`: horizontal distance and height of the gripper; origin of the
    frame relative to the goal (in the world frame); wrist position, mean finger position and object
    orientation 0.5 s later in the recording; whether the object was released; and the YCB class
    of the object (one-hot; zeros for another class).
    """
    origin, axes = compute_handover_frame(observation)
    wrist = observation["replay_wrist_poses"][-1]
    object_rotation = Rotation.from_quat(observation["replay_object_poses"][-1, 3:])
    # The fingers keep their position relative to the object until then.
    keypoints = observation["hand_keypoints"].astype(np.float64)
    now = observation["object_poses"][0]
    fingers = Rotation.from_quat(now[3:]).inv().apply(keypoints[1:].mean(axis=0) - now[:3])
    gripper = observation["gripper_pose"][:3] - origin
    parts = [
        SCALE * np.array([np.linalg.norm(gripper[:2]), gripper[2]]) - 5.0,
        SCALE * (origin - np.array(protocol.goal_center)),
        SCALE * (wrist[:3] - origin) @ axes,
        SCALE * object_rotation.apply(fingers) @ axes,
        (axes.T @ object_rotation.as_matrix())[:, :2].ravel(),
        observation["released"],
        _one_hot_class(observation),
    ]
    return np.concatenate(parts).astype(np.float32)


def compute_receiver_features(observation: Observation, protocol: ProtocolConfig) -> Vector:
    """Return the (56,) features from which a receiver can take an object to the goal.

    In the gripper frame: positions of the object, the person's wrist, the mean of the person's
    fingers and the goal, the object's orientation, and the world's vertical. Then follow the robot's
    finger joints and their velocities, its arm joints, whether the object was released, the elapsed
    share of the episode, whether a hand is present, and the YCB class of the object (one-hot;
    zeros for another class).
    """
    gripper, object_pose = observation["gripper_pose"].astype(np.float64), observation["object_poses"][0]
    rotation = Rotation.from_quat(gripper[3:]).as_matrix()
    keypoints = observation["hand_keypoints"].astype(np.float64)
    if observation["hand_present"][0]:
        hand = np.stack([keypoints[0], keypoints[1:].mean(axis=0)])
    else:
        hand = np.tile(gripper[:3], (2, 1))
    positions = np.stack([object_pose[:3], *hand, np.array(protocol.goal_center)]) - gripper[:3]
    parts = [
        (0.5 * SCALE * positions @ rotation).ravel(),
        (rotation.T @ Rotation.from_quat(object_pose[3:]).as_matrix())[:, :2].ravel(),
        rotation[2],
        50.0 * observation["robot_joint_position"][7:] - 1.0,
        10.0 * observation["robot_joint_velocity"][7:],
        observation["robot_joint_position"][:7],
        observation["released"],
        observation["time"] / (protocol.horizon_steps * TIME_STEP),
        observation["hand_present"],
        _one_hot_class(observation),
    ]
    return np.concatenate(parts).astype(np.float32)


class GraspFeatures:
    """Function that appends features (8,) of the known grasp of lowest cost to `compute_receiver_features`.

    In the gripper frame: translation to the grasp (3, scaled), rotation vector to it (3), clearance
    of the gripper to the person's hand at the grasp (1, scaled), and whether grasps of the object are known (1).

    Args:
        context: Robot, task and known grasps of the objects.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._grasp_selector = get_lowest_cost_grasp_selector(context)
        self._protocol = context.protocol

    def __call__(self, observation: Observation) -> Vector:
        """Return the features (64,) of an observation, those of the grasp last."""
        return np.concatenate([compute_receiver_features(observation, self._protocol), self.compute_grasp(observation)])

    def compute_grasp(self, observation: Observation) -> Vector:
        """Return features (8,) of the known grasp of lowest cost; zeros if no grasp of the object is known."""
        chosen = self._grasp_selector.select(observation)
        if chosen is None:
            return np.zeros(_N_GRASP, dtype=np.float32)
        grasp, clearance = chosen
        gripper = observation["gripper_pose"].astype(np.float64)
        gripper_from_world = Rotation.from_quat(gripper[3:]).inv()
        rotation = (gripper_from_world * Rotation.from_quat(grasp[3:])).as_rotvec()
        translation = GRASP_SCALE * gripper_from_world.apply(grasp[:3] - gripper[:3])
        return np.array([*translation, *rotation, 10.0 * clearance, 1.0], dtype=np.float32)


class GraspProximityFeatures:
    """Function from an observation to 12 features that suffice to decide when to close the gripper.

    In the gripper frame: translation (3) and rotation vector (3) to the known grasp of lowest cost. Then
    follow the proximity of position and orientation to the grasp, which decay exponentially (2), the
    finger joints (2), whether the object was released (1), and whether grasps of the object are known (1). With so
    few features a policy learns to close the gripper from few episodes.

    Attributes:
        position_scale: Distance from the grasp at which the proximity of the position is 1/e (m).
        angle_scale: Angle to the grasp at which the proximity of the orientation is 1/e (rad).

    Args:
        context: Robot, task and known grasps of the objects.
    """

    position_scale, angle_scale = 0.03, 0.2

    def __init__(self, context: PolicyContext) -> None:
        self._grasp = GraspFeatures(context)

    def __call__(self, observation: Observation) -> Vector:
        """Return the features (12,) of the grasp and the gripper in an observation."""
        translation, rotation, (_, exists) = np.split(self._grasp.compute_grasp(observation), [3, 6])
        distance = float(np.linalg.norm(translation)) / GRASP_SCALE
        angle = float(np.linalg.norm(rotation))
        proximity = np.exp([-distance / self.position_scale, -angle / self.angle_scale]) * exists
        fingers = 50.0 * observation["robot_joint_position"][7:] - 1.0
        parts = [translation, rotation, proximity, fingers, observation["released"], [exists]]
        return np.concatenate(parts).astype(np.float32)


class StackedFeatures:
    """Function from an observation to the features of the last decisions of the episode.

    The features of the present decision come first; zeros stand for decisions before the first. From a
    stack, a policy without memory can estimate velocities and how its partner reacts.

    Args:
        features: Features of one observation.
        size: Number of these features.
    """

    def __init__(self, features: FeatureFunction, size: int) -> None:
        self._features = features
        self._stack = np.zeros((N_STACKED, size), dtype=np.float32)
        self._time = -1.0

    def reset(self) -> None:
        """Forget the decisions of the previous episode."""
        self._stack[:], self._time = 0.0, -1.0

    def __call__(self, observation: Observation) -> Vector:
        """Return the stacked features (N_STACKED * size,); a second call at the same time changes nothing."""
        time = float(observation["time"][0])
        if time != self._time:
            self._stack[1:], self._time = self._stack[:-1].copy(), time
        self._stack[0] = self._features(observation)
        stacked: Vector = self._stack.flatten()
        return stacked


def _one_hot_class(observation: Observation) -> Vector:
    """Return the YCB class of the handed-over object as one of 21 numbers; zeros for another class."""
    one_hot = np.zeros(LARGEST_YCB_CLASS, dtype=np.float32)
    number = int(observation["object_classes"][0])
    if 1 <= number <= LARGEST_YCB_CLASS:
        one_hot[number - 1] = 1.0
    return one_hot


def _flatten(observation: Observation, space: spaces.Dict) -> Vector:
    return np.asarray(spaces.flatten(space, observation), dtype=np.float32)


# By agent and name: factory and number of features. The flat ones are complete observations in the
# order in which Gymnasium and Stable-Baselines3 flatten them.
_FEATURES: dict[str, dict[str, tuple[Callable[[PolicyContext], FeatureFunction], int]]] = {
    "giver": {
        "giver": (
            lambda context: functools.partial(compute_giver_features, protocol=context.protocol),
            18 + LARGEST_YCB_CLASS,
        ),
        "flat_giver": (lambda _: functools.partial(_flatten, space=_GIVER_SPACE), spaces.flatdim(_GIVER_SPACE)),
    },
    "receiver": {
        "receiver": (
            lambda context: functools.partial(compute_receiver_features, protocol=context.protocol),
            _N_RECEIVER,
        ),
        "flat_receiver": (
            lambda _: functools.partial(_flatten, space=_RECEIVER_SPACE),
            spaces.flatdim(_RECEIVER_SPACE),
        ),
        "grasp": (GraspFeatures, _N_RECEIVER + _N_GRASP),
        "close": (GraspProximityFeatures, _N_PROXIMITY),
        "close_stack": (
            lambda context: StackedFeatures(GraspProximityFeatures(context), _N_PROXIMITY),
            N_STACKED * _N_PROXIMITY,
        ),
    },
}


def list_features(agent: str) -> tuple[str, ...]:
    """Return the names of an agent's built-in features.

    Raises:
        UnknownNameError: There is no such agent.
    """
    check_name("agent", agent, _FEATURES)
    return tuple(_FEATURES[agent])


def count_features(agent: str, name: str) -> int:
    """Return the length of an agent's feature vector; user-defined features have `make_features(...).size`.

    Raises:
        UnknownNameError: The agent is unknown or has no features of that name.
    """
    check_name(f"{KIND} of the {agent}", name, list_features(agent))
    return _FEATURES[agent][name][1]


def make_features(agent: str, choice: FeaturesLike, context: PolicyContext) -> AgentFeatures:
    """Make an agent's features, a function with a name, a size and a space.

    Args:
        agent: "giver" or "receiver".
        choice: Name of built-in features; subclass of `FeatureExtractor`; function with a declared size
            (`declare_size`); or text `module:name` of a class or function.
        context: Task and known grasps of the objects, which some features contain.

    Raises:
        UnknownNameError: The agent is unknown or has no features of that name.
        OptionError: User-defined features declare no size, or are for the other agent.
        EncodingError: The constructor of user-defined features fails.
    """
    list_features(agent)
    own: Any = choice
    if is_reference(choice):
        own = import_reference(KIND, str(choice))
    if not isinstance(own, str):
        return make_custom_features(agent, own, context, str(choice) if is_reference(choice) else "")
    space = spaces.Box(-np.inf, np.inf, (count_features(agent, own),), np.float32)
    return AgentFeatures(own, space, _FEATURES[agent][own][0](context))
