"""Observations as short vectors for small networks.

Positions are in decimetres relative to what matters to the agent, so that numbers are near one and a policy need
not learn the world frame by heart.
"""

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP, ProtocolConfig
from handover_marl.episode.observations import Observation, giver_observation_space, observation_space
from handover_marl.models.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

_SCALE = 10.0
_HIGHEST_CLASS = max(CLASS_NAMES)


def offer_frame(observation: Observation) -> tuple[Array, Array]:
    """Where the recording is about to hold the object, seen towards the gripper.

    Returns:
        (3,) the object's recorded place 0.5 s ahead (m), and the (3, 3) world axes (columns) of the frame there: x
        horizontally towards the gripper, z up.
    """
    origin = observation["replay_object_poses"][-1, :3].astype(np.float64)
    way = observation["gripper_pose"][:2] - origin[:2]
    length = float(np.linalg.norm(way))
    x, y = way / length if length > 1e-6 else (1.0, 0.0)
    return origin, np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def giver_features(observation: Observation, protocol: ProtocolConfig) -> npt.NDArray[np.float32]:
    """(39,) what a giver needs to choose where to hold the object, in the frame of `offer_frame`.

    Distance and height of the gripper, the object's place in the world, wrist and mean finger place and turn of
    the object as they are about to be, whether the object was let go, and its class.
    """
    origin, axes = offer_frame(observation)
    wrist = observation["replay_wrist_poses"][-1]
    item = Rotation.from_quat(observation["replay_object_poses"][-1, 3:])
    # Fingers keep their place on the wrist, which turns on the way.
    keypoints = observation["hand_keypoints"].astype(np.float64)
    now = observation["object_poses"][0]
    fingers = Rotation.from_quat(now[3:]).inv().apply(keypoints[1:].mean(axis=0) - now[:3])
    gripper = observation["gripper_pose"][:3] - origin
    parts = [
        _SCALE * np.array([np.linalg.norm(gripper[:2]), gripper[2]]) - 5.0,
        _SCALE * (origin - np.array(protocol.goal_center)),
        _SCALE * (wrist[:3] - origin) @ axes,
        _SCALE * item.apply(fingers) @ axes,
        (axes.T @ item.as_matrix())[:, :2].ravel(),
        observation["released"],
        _one_hot(observation),
    ]
    return np.concatenate(parts).astype(np.float32)


def receiver_features(observation: Observation, protocol: ProtocolConfig) -> npt.NDArray[np.float32]:
    """(56,) what a receiver needs to take an object and bring it to the goal, in the gripper's frame.

    Object, wrist, mean finger place and goal, turn of the object, which way is up, fingers and their speed, arm
    joints, whether the object was let go, time, whether there is a hand, and the object's class.
    """
    gripper, item = observation["gripper_pose"].astype(np.float64), observation["object_poses"][0]
    turn = Rotation.from_quat(gripper[3:]).as_matrix()
    keypoints = observation["hand_keypoints"].astype(np.float64)
    present = bool(observation["hand_present"][0])
    hand = np.stack([keypoints[0], keypoints[1:].mean(axis=0)]) if present else np.tile(gripper[:3], (2, 1))
    places = np.stack([item[:3], *hand, np.array(protocol.goal_center)]) - gripper[:3]
    parts = [
        (0.5 * _SCALE * places @ turn).ravel(),
        (turn.T @ Rotation.from_quat(item[3:]).as_matrix())[:, :2].ravel(),
        turn[2],
        50.0 * observation["robot_joint_position"][7:] - 1.0,
        10.0 * observation["robot_joint_velocity"][7:],
        observation["robot_joint_position"][:7],
        observation["released"],
        observation["time"] / (protocol.horizon_steps * TIME_STEP),
        observation["hand_present"],
        _one_hot(observation),
    ]
    return np.concatenate(parts).astype(np.float32)


def flat_giver_features(observation: Observation, protocol: ProtocolConfig) -> npt.NDArray[np.float32]:
    """All that the giver observes as one vector, in the order of its space; Stable-Baselines3's order too."""
    return _flattened(_GIVER_SPACE, observation)


def flat_receiver_features(observation: Observation, protocol: ProtocolConfig) -> npt.NDArray[np.float32]:
    """All that the receiver observes as one vector, likewise."""
    return _flattened(_RECEIVER_SPACE, observation)


def _one_hot(observation: Observation) -> npt.NDArray[np.float32]:
    hot = np.zeros(_HIGHEST_CLASS, dtype=np.float32)
    hot[int(observation["object_classes"][0]) - 1] = 1.0
    return hot


def _flattened(space: spaces.Dict, observation: Observation) -> npt.NDArray[np.float32]:
    return np.asarray(spaces.flatten(space, observation), dtype=np.float32)


_GIVER_SPACE, _RECEIVER_SPACE = giver_observation_space(), observation_space()
