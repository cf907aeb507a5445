"""Observation modes, action spaces of both agents, and checks of actions."""

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import OFFICIAL_CONFIG, PANDA_DOF, GiverConfig
from handover_marl.errors import ActionError, UnknownNameError
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS

#: Parts of an observation mode, joined by "+": "state" is the full state of the simulation, the others are camera data.
#: "pointcloud" has 1024 points each of target object and hand, "scene_pointcloud" also of the other objects;
#: "full_pointcloud" has all points of target object and hand, "point_map" a point for each pixel.
#: Without "state", an observation has of the state only the keys `observations.PROPRIOCEPTION` (joint positions and
#: velocities, pose of the hand link, time), so that a policy cannot use the true poses by accident.
STATE, POINTCLOUD, SCENE_POINTCLOUD, FULL_POINTCLOUD = "state", "pointcloud", "scene_pointcloud", "full_pointcloud"
DEPTH, SEGMENTATION, RGB, RGBD, POINT_MAP = "depth", "segmentation", "rgb", "rgbd", "point_map"
OBS_PARTS = (STATE, POINTCLOUD, SCENE_POINTCLOUD, FULL_POINTCLOUD, DEPTH, SEGMENTATION, RGB, RGBD, POINT_MAP)
#: Parts that are images; "rgbd" stands for "rgb+depth", as in ManiSkill.
IMAGES = frozenset((DEPTH, SEGMENTATION, RGB))
_JOIN_PARTS = "join parts with '+', e.g. 'rgb+depth'"

#: Size of the giver's action: playback rate (1), wrist displacement (3), wrist rotation (3), release (1).
GIVER_ACTION_SIZE = 8


def parse_obs_mode(obs_mode: str) -> frozenset[str]:
    """Return a mode's parts, e.g. "state", "rgb", "depth" of "state+rgbd"; raise UnknownNameError for unknown parts."""
    if not isinstance(obs_mode, str):
        raise UnknownNameError("part of obs_mode", obs_mode, OBS_PARTS, _JOIN_PARTS)
    parts = frozenset(obs_mode.split("+"))
    unknown = sorted(parts - set(OBS_PARTS))
    if unknown:
        hint = "" if unknown[0].isidentifier() else _JOIN_PARTS
        raise UnknownNameError("part of obs_mode", unknown[0], OBS_PARTS, hint)
    return parts - {RGBD} | ({RGB, DEPTH} if RGBD in parts else set())


def has_state(obs_mode: str) -> bool:
    """Return whether an observation mode includes the true poses of objects and human hand."""
    return STATE in parse_obs_mode(obs_mode)


def has_camera(obs_mode: str) -> bool:
    """Return whether an observation mode includes data of cameras."""
    return bool(parse_obs_mode(obs_mode) - {STATE})


def receiver_action_space() -> spaces.Box:
    """Return the receiver's action space: 7 arm joints (rad) and 2 fingers (m), within the Panda's limits.

    Actions beyond the bounds are not clipped; motors and joint limits bound the motion, as in HandoverSim.
    """
    return spaces.Box(np.array(LOWER_LIMITS, dtype=np.float32), np.array(UPPER_LIMITS, dtype=np.float32))


def giver_action_space(config: GiverConfig = OFFICIAL_CONFIG.giver) -> spaces.Box:
    """Return the giver's action space (8,), deviations from a recording; actions beyond the bounds are clipped.

    Components: playback rate minus 1; set points of the wrist's displacement (3; m) and rotation vector (3; rad), which
    are approached at limited speed once the object is picked up; release if over 0.5. Zeros replay the recording.
    """
    high = np.array([1.0, *[config.displacement] * 3, *[config.rotation] * 3, 1.0], dtype=np.float32)
    low = -high
    low[-1] = 0.0
    return spaces.Box(low, high)


def check_receiver_action(action: object) -> npt.NDArray[np.float32]:
    """Return a receiver's action as float32 (9,); raise `ActionError` if it does not have nine finite numbers."""
    return check_vector(
        "action of the receiver", action, PANDA_DOF, "target joint positions: 7 arm (rad), 2 fingers (m)"
    )


def check_giver_action(action: object, space: spaces.Box) -> npt.NDArray[np.float32]:
    """Return a giver's action as float32 (8,), clipped to `space`; raise `ActionError` unless 8 finite numbers."""
    values = check_vector("action of the giver", action, GIVER_ACTION_SIZE, "the deviation from the recording")
    return np.clip(values, space.low, space.high)


def check_vector(name: str, values: object, size: int, meaning: str) -> npt.NDArray[np.float32]:
    """Return numbers as a float32 vector (size,); raise `ActionError` if they are not `size` finite numbers.

    Args:
        name: Name of the values, for error messages.
        values: Array or sequence of real numbers.
        size: Number of values.
        meaning: Description of the values, for error messages.
    """
    vector = _as_float32(values)
    if vector is not None and vector.shape == (size,) and np.isfinite(vector).all():
        return vector
    if vector is None:
        problem = "got None; pass numbers for each agent" if values is None else f"got {type(values).__name__}"
        if hasattr(values, "detach"):
            problem += " with a gradient or on a GPU; pass tensor.detach().cpu()"
    elif vector.shape != (size,):
        problem = f"got shape {vector.shape}, expected ({size},)"
    else:
        bad = int(np.flatnonzero(~np.isfinite(vector))[0])
        problem = f"but component {bad} is {vector[bad]}, which is not finite"
    raise ActionError(f"{name} must be {size} numbers, {meaning}, {problem}")


def _as_float32(action: object) -> npt.NDArray[np.float32] | None:
    """Return a copy of an action as a float32 array of the same shape; None if it does not consist of real numbers."""
    try:
        values = np.asarray(action)
    except (TypeError, ValueError, RuntimeError):  # ragged lists; tensors on a GPU or with a gradient
        return None
    if values.dtype.kind not in "biuf":
        return None
    if values.dtype == np.float32:
        # Cannot overflow; np.errstate takes longer than the copy.
        copied: npt.NDArray[np.float32] = values.copy()
        return copied
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
