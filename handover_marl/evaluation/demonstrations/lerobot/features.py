"""Features of a data set in LeRobot's format: names, types and shapes of columns, and their values."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation, receiver_observation_space, state_space
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.evaluation.demonstrations.observation_meanings import (
    GIVER_ACTION_MEANING,
    OBSERVATION_MEANINGS,
    RECEIVER_ACTION_MEANING,
)

#: Key of the wrist camera's video.
VIDEO_KEY = "observation.images.wrist"
ENVIRONMENT_STATE = "observation.environment_state"
ACTION, GIVER_ACTION = "action", "giver.action"
VIDEO = "video"

_OBSERVATION = "observation."
# Columns whose names LeRobot's policies expect, and shorter ones.
_RENAMED = {
    "robot_joint_position": "observation.state",
    "robot_joint_velocity": "observation.joint_velocity",
    "gripper_pose": "observation.gripper_pose",
    "wrist_rgb": VIDEO_KEY,
}
_JOINTS = (*(f"panda_joint{number}" for number in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2")
_COMPONENTS = {
    "observation.state": _JOINTS,
    "observation.joint_velocity": _JOINTS,
    "observation.gripper_pose": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    VIDEO_KEY: ("height", "width", "channels"),
}
# The time is LeRobot's `timestamp`.
_OMITTED = "time"
# Keys of the true state, which one vector holds, as LeRobot's policies expect.
_ENVIRONMENT_KEYS = tuple(key for key in state_space() if key not in (*_RENAMED, _OMITTED))
_GIVER_COMPONENTS = ("rate", "x", "y", "z", "rx", "ry", "rz", "release")


@dataclass(frozen=True)
class Feature:
    """Feature of a data set in LeRobot's format.

    Attributes:
        name: Name of the column, or of the folder of videos.
        dtype: NumPy type, or "video".
        shape: Shape of one frame's value; (1,) for a number.
        names: Names of the components, if they have any.
        meaning: Meaning, unit and frame.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    meaning: str


#: Features that follow from the position of a frame in the data set.
INDEX_FEATURES = (
    Feature("timestamp", "float32", (1,), None, "time since the start of the episode, frame_index / fps (s)"),
    Feature("frame_index", "int64", (1,), None, "number of the frame in its episode"),
    Feature("episode_index", "int64", (1,), None, "number of the episode in the data set"),
    Feature("index", "int64", (1,), None, "number of the frame in the data set"),
    Feature("task_index", "int64", (1,), None, "row of meta/tasks.parquet with the task's text"),
)
_OUTCOME_FEATURES = (
    Feature("next.reward", "float32", (1,), None, "1 in the last frame of a success, else 0"),
    Feature("next.done", "bool", (1,), None, "whether this is the last frame of the episode"),
    Feature("next.success", "bool", (1,), None, "whether this is the last frame of a success"),
)


def list_features(obs_mode: str) -> tuple[Feature, ...]:
    """Return the features of a data set, without `INDEX_FEATURES`.

    Args:
        obs_mode: Observation mode of the recorded observations.
    """
    space = receiver_observation_space(obs_mode)
    features = []
    for key, part in space.items():
        if key in _ENVIRONMENT_KEYS or key == _OMITTED:
            continue
        name = _RENAMED.get(key, _OBSERVATION + key)
        dtype = VIDEO if name == VIDEO_KEY else str(part.dtype)
        shape = tuple(part.shape or (1,))
        features.append(Feature(name, dtype, shape, _COMPONENTS.get(name), OBSERVATION_MEANINGS[key]))
    if _ENVIRONMENT_KEYS[0] in space.spaces:
        features.append(_describe_environment_state(space))
    action = Feature(ACTION, "float32", (len(_JOINTS),), _JOINTS, RECEIVER_ACTION_MEANING)
    giver = Feature(GIVER_ACTION, "float32", (GIVER_ACTION_SIZE,), _GIVER_COMPONENTS, GIVER_ACTION_MEANING)
    return (*features, action, giver, *_OUTCOME_FEATURES)


def make_columns(
    observations: Mapping[str, npt.NDArray[Any]],
    actions: npt.NDArray[np.float32],
    giver_actions: npt.NDArray[np.float32],
    success: bool,
) -> Observation:
    """Return the values of all features for the T frames of an episode, by name.

    Args:
        observations: Arrays (T, ...) by key of `receiver_observation_space`.
        actions: (T, 9) actions of the receiver.
        giver_actions: (T, 8) actions of the giver.
        success: Whether the episode ends in success.
    """
    columns = {
        _RENAMED.get(key, _OBSERVATION + key): array
        for key, array in observations.items()
        if key not in _ENVIRONMENT_KEYS and key != _OMITTED
    }
    is_last = np.arange(len(actions)) == len(actions) - 1
    if _ENVIRONMENT_KEYS[0] in observations:
        parts = [observations[key].reshape(len(actions), -1) for key in _ENVIRONMENT_KEYS]
        columns[ENVIRONMENT_STATE] = np.concatenate(parts, axis=1)
    columns |= {ACTION: actions, GIVER_ACTION: giver_actions}
    is_success = is_last & success
    return columns | {"next.reward": is_success.astype(np.float32), "next.done": is_last, "next.success": is_success}


def format_task(object_name: str) -> str:
    """Return the text of an episode's task.

    Args:
        object_name: Class name of the object, e.g. "003_cracker_box"; a number in front is left out.
    """
    return f"Take the {re.sub(r'^[0-9]+_', '', object_name).replace('_', ' ')} from the person's hand."


def _describe_environment_state(space: spaces.Dict) -> Feature:
    names: list[str] = []
    meanings = []
    for key in _ENVIRONMENT_KEYS:
        first = len(names)
        names += [f"{key}.{index}" for index in range(spaces.flatdim(space[key]))]
        meanings.append(f"{first} to {len(names) - 1}: {key} {space[key].shape}, {OBSERVATION_MEANINGS[key]}")
    return Feature(ENVIRONMENT_STATE, "float32", (len(names),), tuple(names), "; ".join(meanings))
