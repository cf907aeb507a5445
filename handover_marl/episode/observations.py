"""What an agent sees: named arrays of fixed shape, all float32 but for pictures."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import HAND_DOF, MAX_OBJECTS, N_KEYPOINTS, OFFICIAL, PANDA_DOF, GiverConfig
from handover_marl.episode.playback import Playback
from handover_marl.episode.preview import Preview
from handover_marl.episode.sight import check_sight, sight_space
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.sim.world import WorldState

Observation = dict[str, npt.NDArray[Any]]

#: What a policy may be shown beside the camera's view: everything, or only what the robot knows of itself.
ALL, SIGHT = "all", "sight"
OBSERVES = (ALL, SIGHT)
#: What the robot knows of itself.
PROPRIOCEPTION = ("robot_joint_position", "robot_joint_velocity", "gripper_pose", "time")

_POSE = 7


def observation_space() -> spaces.Dict:
    """The space of `observe`'s result: what the receiver sees, and the giver too.

    | key | shape | meaning (world frame; m, rad, s; quaternions xyzw) |
    |---|---|---|
    | robot_joint_position | (9,) | seven arm joints, two fingers |
    | robot_joint_velocity | (9,) | |
    | gripper_pose | (7,) | pose of the Panda's hand link |
    | object_poses | (5, 7) | poses of the objects, the one to be handed over first; zeros where there is none |
    | object_mask | (5,) | 1 where there is an object |
    | object_classes | (5,) | YCB class number 1-21, 0 where there is none |
    | hand_dof_position | (51,) | the human hand's base and finger joints; zeros without a hand |
    | hand_keypoints | (16, 3) | wrist and 15 finger-joint origins; zeros without a hand |
    | hand_present | (1,) | 1 when there is a hand |
    | released | (1,) | 1 once the human has let go |
    | time | (1,) | since the start of the episode |
    """
    return spaces.Dict(
        {
            "robot_joint_position": _unbounded((PANDA_DOF,)),
            "robot_joint_velocity": _unbounded((PANDA_DOF,)),
            "gripper_pose": _unbounded((_POSE,)),
            "object_poses": _unbounded((MAX_OBJECTS, _POSE)),
            "object_mask": _flags((MAX_OBJECTS,)),
            "object_classes": spaces.Box(0.0, float(max(CLASS_NAMES)), (MAX_OBJECTS,), np.float32),
            "hand_dof_position": _unbounded((HAND_DOF,)),
            "hand_keypoints": _unbounded((N_KEYPOINTS, 3)),
            "hand_present": _flags((1,)),
            "released": _flags((1,)),
            "time": spaces.Box(0.0, np.inf, (1,), np.float32),
        }
    )


def receiver_observation_space(sight: str | None = None, observes: str = ALL) -> spaces.Dict:
    """What the receiver sees.

    Args:
        sight: What it is shown of the wrist camera: "points", "clouds", "images" or None; see `sight_space`.
        observes: "all", or "sight": proprioception and sight alone, so that nobody learns from the true pose.

    Raises:
        UnknownNameError: There is no such sight or choice.
        OptionError: Sight alone is wanted, and there is none.
    """
    check_observes(observes, sight)
    known = observation_space().spaces
    own = known if observes == ALL else {key: known[key] for key in PROPRIOCEPTION}
    return spaces.Dict({**own, **sight_space(sight)})


def check_observes(observes: str, sight: str | None) -> None:
    """Check what is to be observed.

    Raises:
        UnknownNameError: There is no such sight or choice.
        OptionError: Sight alone is wanted, and there is none.
    """
    check_sight(sight)
    if observes not in OBSERVES:
        raise UnknownNameError("observe", observes, OBSERVES)
    if observes == SIGHT and sight is None:
        raise OptionError(
            f"observe={SIGHT!r} leaves only what is seen, but sight is None; set sight to 'points' or 'images'"
        )


def as_receiver(observation: Observation, sight: Observation, observes: str = ALL) -> Observation:
    """The receiver's observation.

    Args:
        observation: What `observe` says.
        sight: What the camera adds.
        observes: "all" or "sight".
    """
    own = observation if observes == ALL else {key: observation[key] for key in PROPRIOCEPTION}
    return {**own, **sight}


def giver_observation_space(config: GiverConfig = OFFICIAL.giver) -> spaces.Dict:
    """What the giver sees: all that the receiver sees, and its own intentions.

    | key | shape | meaning (world frame; m, rad; quaternions xyzw) |
    |---|---|---|
    | replay_wrist_poses | (5, 7) | the recording's wrist 0.1 to 0.5 s ahead; zeros without a hand |
    | replay_object_poses | (5, 7) | the recording's object to be given at these times |
    | deviation | (7,) | playback rate less the recorded one, wrist displacement, rotation vector, as they are |
    | holding | (1,) | 1 once the object has been picked up, so that displacements count |
    """
    ahead = len(config.preview)
    return spaces.Dict(
        {
            **observation_space().spaces,
            "replay_wrist_poses": _unbounded((ahead, _POSE)),
            "replay_object_poses": _unbounded((ahead, _POSE)),
            "deviation": _unbounded((7,)),
            "holding": _flags((1,)),
        }
    )


def observe_as_giver(observation: Observation, playback: Playback, preview: Preview) -> Observation:
    """The giver's observation.

    Args:
        observation: What the receiver sees.
        playback: Where the giver is in its recording and how it deviates.
        preview: The recording.
    """
    return {
        **observation,
        "replay_wrist_poses": preview.wrist_poses(playback.frame),
        "replay_object_poses": preview.object_poses(playback.frame),
        "deviation": playback.deviation,
        "holding": np.array([playback.holding], dtype=np.float32),
    }


def _unbounded(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _flags(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(0.0, 1.0, shape, np.float32)


def observe(state: WorldState, object_ids: tuple[int, ...], released: bool, time: float) -> Observation:
    """The observation of a world state.

    Args:
        state: What the world shows.
        object_ids: Class numbers of the objects in the state's order.
        released: Whether the human has let go.
        time: Simulated time since the reset (s).
    """
    n_objects = len(object_ids)
    poses = np.zeros((MAX_OBJECTS, _POSE), dtype=np.float32)
    mask = np.zeros(MAX_OBJECTS, dtype=np.float32)
    classes = np.zeros(MAX_OBJECTS, dtype=np.float32)
    poses[:n_objects], mask[:n_objects], classes[:n_objects] = state.object_poses, 1.0, object_ids
    hand, keypoints = state.hand_dof_position, state.hand_keypoints
    return {
        "robot_joint_position": state.robot_joint_position,
        "robot_joint_velocity": state.robot_joint_velocity,
        "gripper_pose": state.gripper_pose,
        "object_poses": poses,
        "object_mask": mask,
        "object_classes": classes,
        "hand_dof_position": np.zeros(HAND_DOF, dtype=np.float32) if hand is None else hand,
        "hand_keypoints": np.zeros((N_KEYPOINTS, 3), dtype=np.float32) if keypoints is None else keypoints,
        "hand_present": np.array([hand is not None], dtype=np.float32),
        "released": np.array([released], dtype=np.float32),
        "time": np.array([time], dtype=np.float32),
    }
