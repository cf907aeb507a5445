"""Observations of giver and receiver: named arrays of fixed shape.

World frame; m, rad, s; quaternions xyzw. Arrays are float32, except for RGB and segmentation images (uint8) and
`robot_joint_position_exact` (float64).
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import (
    HAND_DOF,
    MAX_OBJECTS,
    N_KEYPOINTS,
    OFFICIAL_CONFIG,
    PANDA_DOF,
    CameraConfig,
    GiverConfig,
)
from handover_marl.episode.camera_observations import WRIST_ONLY, camera_observation_space
from handover_marl.episode.giver_motion import GiverMotion
from handover_marl.episode.spaces import STATE, has_state
from handover_marl.geometry.arrays import AnyIndices, get_namespace
from handover_marl.geometry.ycb import LARGEST_YCB_CLASS
from handover_marl.simulation.world import WorldState

Observation = dict[str, npt.NDArray[Any]]

#: Keys of the state that are in the receiver's observation in every observation mode.
PROPRIOCEPTION = ("robot_joint_position", "robot_joint_velocity", "gripper_pose", "time")

_POSE = 7


def state_space(largest_class: int = LARGEST_YCB_CLASS) -> spaces.Dict:
    """Return the space of the full state of the simulation; docs/reference/environment.md lists the keys.

    `largest_class` is the largest class number of objects, 21 for YCB classes.
    """
    return spaces.Dict(
        {
            "robot_joint_position": _unbounded((PANDA_DOF,)),
            "robot_joint_velocity": _unbounded((PANDA_DOF,)),
            "gripper_pose": _unbounded((_POSE,)),
            "object_poses": _unbounded((MAX_OBJECTS, _POSE)),
            "object_mask": _flags((MAX_OBJECTS,)),
            "object_classes": spaces.Box(0.0, float(largest_class), (MAX_OBJECTS,), np.float32),
            "hand_dof_position": _unbounded((HAND_DOF,)),
            "hand_keypoints": _unbounded((N_KEYPOINTS, 3)),
            "hand_present": _flags((1,)),
            "released": _flags((1,)),
            "time": spaces.Box(0.0, np.inf, (1,), np.float32),
        }
    )


def receiver_observation_space(
    obs_mode: str = STATE, largest_class: int = LARGEST_YCB_CLASS, cameras: Iterable[str | CameraConfig] = WRIST_ONLY
) -> spaces.Dict:
    """Return the receiver's observation space.

    Args:
        obs_mode: Observation mode: parts joined by "+", see `handover_marl.episode.spaces.OBS_PARTS`.
        largest_class: Largest class number of objects, 21 for YCB classes.
        cameras: Names or configurations of the cameras.
    """
    camera = camera_observation_space(obs_mode, cameras)
    state = state_space(largest_class).spaces
    own = state if has_state(obs_mode) else {key: state[key] for key in PROPRIOCEPTION}
    return spaces.Dict({**own, **camera})


def giver_observation_space(
    config: GiverConfig = OFFICIAL_CONFIG.giver, largest_class: int = LARGEST_YCB_CLASS
) -> spaces.Dict:
    """Return the giver's observation space: the full state, recorded poses ahead, current deviation and `holding`.

    docs/reference/environment.md lists the keys.

    Args:
        config: Configuration of the giver, with the preview times of recorded poses.
        largest_class: Largest class number of objects, 21 for YCB classes.
    """
    ahead = len(config.preview)
    return spaces.Dict(
        {
            **state_space(largest_class).spaces,
            "replay_wrist_poses": _unbounded((ahead, _POSE)),
            "replay_object_poses": _unbounded((ahead, _POSE)),
            "deviation": _unbounded((7,)),
            "holding": _flags((1,)),
        }
    )


def observe(state: WorldState, object_ids: tuple[int, ...], released: bool, time: float) -> Observation:
    """Return the full state of a simulated world as an observation: arrays by the keys of `state_space`.

    Args:
        state: State of the simulated world.
        object_ids: Class numbers of the objects, in the order of the state.
        released: Whether the person has released the object.
        time: Time since the start of the episode (s).
    """
    classes = np.zeros(MAX_OBJECTS, dtype=np.float32)
    classes[: len(object_ids)] = object_ids
    return {
        **state._asdict(),
        "object_mask": (classes > 0).astype(np.float32),
        "object_classes": classes,
        "released": np.array([released], dtype=np.float32),
        "time": np.array([time], dtype=np.float32),
    }


def select_receiver_observation(state: Observation, camera: Observation, obs_mode: str) -> Observation:
    """Select the receiver's observation in an observation mode from state and camera data.

    Args:
        state: The full state as `observe` returns it.
        camera: The camera data of this mode as `Episode.observe_camera` returns it.
        obs_mode: Observation mode. Without "state", only the keys `PROPRIOCEPTION` of the state are kept:
            joint positions and velocities of the robot, pose of its hand link, and time.
    """
    own = state if has_state(obs_mode) else {key: state[key] for key in PROPRIOCEPTION}
    return {**own, **camera}


def observe_giver_motion(motion: GiverMotion, rows: AnyIndices) -> Observation:
    """Return the part of the observation that only givers have, as arrays (r, ...) of the givers `rows` (r,) by key."""
    wrist_poses, object_poses = motion.read_previews(rows)
    holding = motion.holding[rows, None]
    return {
        "replay_wrist_poses": wrist_poses,
        "replay_object_poses": object_poses,
        "deviation": motion.deviation[rows],
        "holding": get_namespace(holding).astype(holding, wrist_poses.dtype),
    }


def add_episode_axis(observation: Observation) -> Observation:
    """Return the observation of one episode as arrays (1, ...), for code that takes observations of many episodes."""
    return {key: values[None] for key, values in observation.items()}


def _unbounded(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _flags(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(0.0, 1.0, shape, np.float32)
