"""Conversion of demonstrations to the formats of Minari and LeRobot, which are optional dependencies.

LeRobot must be installed in a separate virtual environment.
"""

import importlib
import json
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import state_space
from handover_marl.errors import OptionError
from handover_marl.evaluation.demonstrations.demonstration import Demonstration, Demonstrations
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import require_modules

_VIDEO, _STATE, _ENVIRONMENT_STATE = "observation.images.wrist", "observation.state", "observation.environment_state"
# Columns with the names that LeRobot's policies expect, or with short ones; others are "observation." and the key.
_RENAMED = {
    "robot_joint_position": _STATE,
    "robot_joint_velocity": "observation.joint_velocity",
    "gripper_pose": "observation.gripper_pose",
    "wrist_rgb": _VIDEO,
}
_OMITTED = "time"  # LeRobot's `timestamp`
# Keys of the true state, which one vector holds, as LeRobot's policies expect.
ENVIRONMENT_KEYS = tuple(key for key in state_space() if key not in (*_RENAMED, _OMITTED))
_JOINTS = (*(f"panda_joint{number}" for number in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2")
# Names of the components of a column.
_COMPONENTS = {
    _STATE: _JOINTS,
    "observation.joint_velocity": _JOINTS,
    "observation.gripper_pose": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    _ENVIRONMENT_STATE: tuple(
        f"{key}.{index}" for key in ENVIRONMENT_KEYS for index in range(int(np.prod(state_space()[key].shape or ())))
    ),
    _VIDEO: ("height", "width", "channels"),
    "action": _JOINTS,
    "giver.action": ("rate", "x", "y", "z", "rx", "ry", "rz", "release"),
}


def convert_to_minari(folder: str | os.PathLike[str], name: str) -> Path:
    """Write demonstrations as a data set for `minari.load_dataset(name)`; return the folder of the data set.

    The folder is created in the one that the environment variable MINARI_DATASETS_PATH names. A step of the data set is
    a row of the demonstrations. `infos` has the physics steps and the giver's actions in effect, and the metadata of an
    episode has the keys of `Demonstration.metadata`.

    Args:
        folder: Output folder of `demonstrate`.
        name: Name of the data set, such as "handover/reactive-v0".

    Raises:
        OptionError: Minari is not installed, or refuses the name, for instance because it exists.
        DataNotFoundError, DataFormatError: The folder has no demonstrations, or they are damaged.
    """
    demonstrations = Demonstrations(folder)
    require_modules("a data set of Minari", "minari", "h5py", "minari")
    minari = importlib.import_module("minari")
    source = demonstrations.evaluation
    try:
        with warnings.catch_warnings():
            # Minari asks for an author, an environment and a link to code.
            warnings.simplefilter("ignore", UserWarning)
            dataset = minari.create_dataset_from_buffers(
                name,
                [],
                observation_space=demonstrations.observation_space,
                action_space=demonstrations.action_space,
                algorithm_name=source.receiver,
                description=str(demonstrations),
                jpeg_encoding=False,
            )
    except (OSError, ValueError) as error:
        raise OptionError(f"name must be a new data set of Minari, got {name!r} ({shorten_text(error)})") from error
    # Episode by episode, since all of them may not fit into memory.
    for number, demonstration in enumerate(demonstrations):
        buffer = minari.data_collector.EpisodeBuffer(
            options={"scene_id": demonstration.metadata["scene_id"]},
            observations=demonstration.observations,
            actions=demonstration.actions,
            rewards=demonstration.rewards,
            terminations=demonstration.terminations,
            truncations=demonstration.truncations,
            infos={"steps": demonstration.steps, "giver_actions": demonstration.hold_giver_actions()},
        )
        dataset.update_dataset_from_buffer([buffer])
        dataset.storage.update_episode_metadata([demonstration.metadata], [number])
    return Path(dataset.storage.data_path)


def convert_to_lerobot(folder: str | os.PathLike[str], name: str) -> Path:
    """Write demonstrations as a data set for `LeRobotDataset(name)`; return the folder of the data set.

    The folder is created in the one that the environment variable HF_LEROBOT_HOME names. The observation at the end of
    an episode, which has no action, is left out. `meta/handover_marl.json` has the metadata of every episode.

    Args:
        folder: Output folder of `demonstrate`, recorded with a frame rate (`fps`).
        name: Name of the data set, such as "me/handovers".

    Raises:
        OptionError: LeRobot is not installed or refuses the name, for instance because it exists; or the
            demonstrations are empty or have no frame rate.
        DataNotFoundError, DataFormatError: The folder has no demonstrations, or they are damaged.
    """
    demonstrations = Demonstrations(folder)
    if demonstrations.fps is None or not len(demonstrations):
        raise OptionError(
            f"folder must have episodes at a constant frame rate, got {len(demonstrations)} episodes with fps "
            f"{demonstrations.fps}; record them with fps=20 (--fps 20)"
        )
    require_modules("a data set of LeRobot", "lerobot", "lerobot")
    lerobot: Any = importlib.import_module("lerobot.datasets.lerobot_dataset")
    features = describe_features(make_columns(demonstrations[0]))
    robot = demonstrations.evaluation.robot
    try:
        dataset = lerobot.LeRobotDataset.create(name, demonstrations.fps, features, robot_type=robot)
    except (OSError, ValueError) as error:
        raise OptionError(f"name must be a new data set of LeRobot, got {name!r} ({shorten_text(error)})") from error
    for demonstration in demonstrations:
        columns = make_columns(demonstration)
        task = describe_task(demonstration.metadata["object_name"])
        for row in range(len(demonstration)):
            dataset.add_frame({"task": task, **{name: values[row] for name, values in columns.items()}})
        dataset.save_episode()
    dataset.finalize()
    root = Path(dataset.root)
    metadata = demonstrations.read_metadata()
    (root / "meta" / "handover_marl.json").write_text(json.dumps(metadata, indent=1) + "\n")
    return root


def describe_task(object_name: str) -> str:
    """Return the task in words, e.g. "Take the cracker box from the person's hand." for "003_cracker_box"."""
    name = re.sub(r"^[0-9]+_", "", object_name).replace("_", " ")
    return f"Take the {name} from the person's hand."


def make_columns(demonstration: Demonstration) -> dict[str, npt.NDArray[Any]]:
    """Return the columns (T, ...) of LeRobot's data set, by name, for an episode of T frames; scalars are (T, 1)."""
    observations = {key: values[:-1] for key, values in demonstration.observations.items()}
    columns = {
        _RENAMED.get(key, f"observation.{key}"): values
        for key, values in observations.items()
        if key not in (*ENVIRONMENT_KEYS, _OMITTED)
    }
    if ENVIRONMENT_KEYS[0] in observations:
        parts = [observations[key].reshape(len(demonstration), -1) for key in ENVIRONMENT_KEYS]
        columns[_ENVIRONMENT_STATE] = np.concatenate(parts, axis=1)
    is_last = np.arange(len(demonstration))[:, None] == len(demonstration) - 1
    return columns | {
        "action": demonstration.actions,
        "giver.action": demonstration.hold_giver_actions()[:-1],
        "next.reward": demonstration.rewards[:, None].astype(np.float32),
        "next.done": is_last,
        "next.success": is_last & (demonstration.metadata["outcome"] == "success"),
    }


def describe_features(columns: dict[str, npt.NDArray[Any]]) -> dict[str, dict[str, Any]]:
    """Return type, shape and component names of each column, by the column's name, as LeRobot declares features."""
    return {
        name: {
            "dtype": "video" if name == _VIDEO else str(values.dtype),
            "shape": values.shape[1:],
            "names": _COMPONENTS.get(name),
        }
        for name, values in columns.items()
    }
