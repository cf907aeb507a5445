"""Validation of known grasps and their tilted copies in a simulation of the gripper alone.

A validation has three steps. The gripper closes at the grasp and shakes the object. The grasp is moved along its
approach axis towards the object, as far as the open gripper does not collide. The gripper closes there on an object
that a person holds, and the person releases the object. Validation records of DexYCB's objects and of the library's
objects ship with the library; they were made in PyBullet. MuJoCo makes the records of other objects, which are stored
in the user's cache folder. A hash of the object's files, its known grasps and the robot's model identifies a record.
Poses are position (m) and quaternion xyzw.
"""

import contextlib
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped import ValidationRecord, load_validation_record
from handover_marl.execution.files import wait_for_lock
from handover_marl.execution.reading import read_plain_file
from handover_marl.geometry.array_cache import get_cache_path, load_cached_arrays, save_cached_arrays
from handover_marl.geometry.model_files.urdf_xml import MAX_URDF_BYTES
from handover_marl.geometry.panda import GRIPPER_FROM_HAND, PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.receivers.reactive.grasps import (
    GraspPreparationConfig,
    ValidatedGrasps,
    advance_grasp,
    compute_grasp_distances,
    grasps_from_record,
    tilt_grasps,
)
from handover_marl.simulation.engines import make_grasp_validator

if TYPE_CHECKING:
    from handover_marl.simulation.mujoco.grasp_validation import GraspValidator

Array = npt.NDArray[np.float64]

# Increased whenever the same files lead to other grasps.
_VERSION = 3
_DESCRIPTION = "record of validated grasps"
# Minimum distance of a tilted copy from another grasp (m), with the weight of rotations (m/rad).
_MIN_DISTANCE, _ROTATION_WEIGHT = 0.035, 0.1
# Distance beyond an advance in which the open gripper must not collide with the object (m).
_MIN_ADVANCE_CLEARANCE = 0.004
_HAND_FROM_GRIPPER = invert_pose(np.array(GRIPPER_FROM_HAND))

_log = logging.getLogger(__name__)


def validate_grasps(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> ValidatedGrasps:
    """Return an object's known grasps and those tilted copies that hold the object in simulation.

    The known grasps are poses (n, 7) of the hand link in the object's frame. Each grasp is moved along its approach
    axis towards the object as far as the open gripper does not collide. The fingers are those of `panda_urdf`.

    Raises:
        SimulationError: A model cannot be loaded.
    """
    return grasps_from_record(get_validation_record(object_urdf, panda_urdf, known, config), known, config)


def get_validation_record(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> ValidationRecord:
    """Return the validation record (n, 4) of an object's known grasps and stable copies; see `ValidationRecord`.

    Grasps without a stored record are validated in simulation, which takes a minute or two.
    Arguments and errors are the same as for `validate_grasps`.
    """
    path = get_validation_record_path(object_urdf, panda_urdf, known, config)
    shipped = load_validation_record(path.stem)
    if shipped is not None:
        return shipped
    name = object_urdf.parent.name
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    # Workers that start at once need the same record: one makes it, and the others read its file.
    with wait_for_lock(
        path.with_suffix(".lock"), lambda: _log.warning("waiting for the process that validates the grasps of %s", name)
    ):
        cached = load_cached_arrays(path, ("record",), _DESCRIPTION)
        if cached is not None:
            return cached["record"]
        _log.warning("validating the grasps of %s, once; this takes a minute or two", name)
        record = _simulate_grasps(object_urdf, panda_urdf, known, config)
        save_cached_arrays(path, {"record": record}, _DESCRIPTION)
        return record


def has_validation_record(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig) -> bool:
    """Return whether the validation record of an object's grasps ships or is cached; see `validate_grasps`."""
    path = get_validation_record_path(object_urdf, panda_urdf, known, config)
    return path.exists() or load_validation_record(path.stem) is not None


def get_validation_record_path(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> Path:
    """Return the path of the cache file of a validation; its stem is also the name of a shipped record."""
    # The fingers of another robot have another mass and friction; the folder of its meshes has no
    # influence on the outcome.
    robot = re.sub(rb'filename="[^"]*/', b'filename="', read_plain_file(panda_urdf, MAX_URDF_BYTES))
    key = f"{_VERSION} {_make_preparation_key(config)}".encode()
    rounded = np.round(known, 6).astype(np.float32).tobytes()
    return get_cache_path("grasp_validations", object_urdf, key, rounded, robot)


def _make_preparation_key(config: GraspPreparationConfig) -> str:
    """Return the text of a configuration in the hash that identifies a record; shipped records depend on its form."""
    conditions = config.validation
    return (
        f"GraspTrials(tilts={config.tilts}, pads={PAD_DISTANCE}, apart={_MIN_DISTANCE}, "
        f"arm={_ROTATION_WEIGHT}, most={config.max_copies}, aside={config.lateral_offsets}, "
        f"deeper={config.advances}, spare={_MIN_ADVANCE_CLEARANCE}, "
        f"held_time={config.held_time}, free_time={config.free_time}, slip={config.max_slip}, "
        f"around={config.release_offsets}, trial=TrialConfig(close_time={conditions.close_time}, "
        f"shake_time={conditions.shake_time}, acceleration={conditions.acceleration}, "
        f"max_shift={conditions.max_translation}, max_turn={conditions.max_rotation}, "
        f"backoffs={conditions.standoff_distances}))"
    )


def _simulate_grasps(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> ValidationRecord:
    """Simulate the known grasps (n, 7) and their tilted copies, and return the record of their validation."""
    validator = make_grasp_validator(object_urdf, config.validation)
    rows = [[-1, _count_stable(validator, pose, config), 0, 0] for pose in known]
    poses = known
    for number, pose in enumerate(tilt_grasps(known, config)):
        if len(poses) == len(known) + config.max_copies:
            break
        is_known = (compute_grasp_distances(pose, poses, _ROTATION_WEIGHT) < _MIN_DISTANCE).any()
        if is_known or not validator.is_collision_free(_gripper_matrix(pose)):
            continue
        n_stable = _count_stable(validator, pose, config)
        if n_stable:
            poses = np.concatenate([poses, pose[None]])
            rows.append([number, n_stable, 0, 0])
    validator = make_grasp_validator(object_urdf, config.validation, panda_urdf)
    for row, pose in zip(rows, poses, strict=True):
        row[2] = _find_advance(validator, pose, config)
        if row[1]:
            deepest = advance_grasp(pose, config.advances[row[2] - 1]) if row[2] else pose
            row[3] = _count_kept(validator, deepest, config)
    record: ValidationRecord = np.array(rows, dtype=np.int16)
    return record


def _count_stable(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Return at how many poses, a grasp and its `lateral_offsets`, a shaken object is held; 0 if not at the grasp."""
    if not validator.is_stable(_gripper_matrix(pose)):
        return 0
    moved = [compose(pose, np.array([*offset, 0.0, 0.0, 0.0, 1.0])) for offset in config.lateral_offsets]
    return 1 + sum(validator.is_stable(_gripper_matrix(other)) for other in moved)


def _find_advance(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Return the number, from 1, of the first of `advances` of a grasp (7,) without a collision; 0 if all collide."""
    for number, distance in enumerate(config.advances, start=1):
        deeper = advance_grasp(pose, distance + _MIN_ADVANCE_CLEARANCE)
        if validator.is_collision_free(_gripper_matrix(deeper)):
            return number
    return 0


def _count_kept(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Return at how many poses, a grasp and its `release_offsets`, a released object stays; 0 if not at the grasp."""
    offsets = np.array([(0.0, 0.0, 0.0), *config.release_offsets])
    moved = compose(pose, np.concatenate([offsets, np.tile([0.0, 0.0, 0.0, 1.0], (len(offsets), 1))], axis=1))
    kept = 0
    for number, place in enumerate(moved):
        slip = validator.measure_release_slip(_gripper_matrix(place), config.held_time, config.free_time)
        if number == 0 and slip > config.max_slip:
            return 0
        kept += slip <= config.max_slip
    return kept


def _gripper_matrix(hand: Array) -> Array:
    """Return the gripper's pose (4, 4), as grasp files define it, at a pose (7,) of the hand link."""
    gripper = compose(hand, _HAND_FROM_GRIPPER)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(gripper[3:]).as_matrix(), gripper[:3]
    return matrix
