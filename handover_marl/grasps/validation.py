"""Known grasps of an object, their tilted and offset copies, and their validation in simulation.

Known grasps and their tilted copies are validated in a simulation of gripper and object, in three steps. First, the
gripper closes at the grasp and shakes the object. Then the grasp is moved along its approach axis towards the object,
by the first of a list of distances without a collision of the open gripper. There, the gripper closes on an object that
a person holds and then releases. The library ships with records of these validations, made in PyBullet, for DexYCB's
objects and its own. Records of other objects are made in MuJoCo and stored in the user's cache folder. A hash of the
object's files, its known grasps, the configuration and the robot's model identifies a record. Offset copies, which are
tilted and shifted, are not validated. Poses are those of the Panda's hand link: position (m) and quaternion xyzw.
"""

import contextlib
import itertools
import logging
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped import ValidationRecord, load_validation_record
from handover_marl.config import CheckedConfig
from handover_marl.execution.files import wait_for_lock
from handover_marl.execution.reading import read_plain_file
from handover_marl.geometry.array_cache import get_cache_path, load_cached_arrays, save_cached_arrays
from handover_marl.geometry.model_files.urdf_xml import MAX_URDF_BYTES
from handover_marl.geometry.panda import GRIPPER_FROM_HAND, PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.planning.robot_clearance import (
    Spheres,
    compute_grasp_clearances,
    compute_open_gripper_clearances,
    count_points_between_pads,
)
from handover_marl.simulation.grasp_validation_config import GraspValidationConfig

if TYPE_CHECKING:
    from handover_marl.simulation.mujoco.grasp_validation import GraspValidator

Array = npt.NDArray[np.float64]

# Offsets of additional copies: rotations about the line between the pads (rad), translations across it and back (m).
_TILTS, _LATERAL_OFFSETS, _BACKWARD_OFFSETS = (
    (0.0, -0.35, 0.35, -0.7, 0.7),
    (0.0, -0.012, 0.012, -0.024, 0.024),
    (0.0, 0.01),
)
#: Minimum clearance of an offset copy to the person's hand (m).
OFFSET_HAND_CLEARANCE = 0.003
# Minimum clearance of the open gripper at an offset copy to the object (m), number of checked points of the object (the
# last ones), minimum number of checked points between the pads, and maximum number of copies, taken evenly from all.
_OFFSET_OBJECT_CLEARANCE, _N_CHECKED_POINTS, _MIN_POINTS_BETWEEN_PADS, _MAX_OFFSET_GRASPS = 0.001, 1200, 2, 1500
# Increased whenever the same files lead to other grasps.
_VERSION = 3
_DESCRIPTION = "record of validated grasps"
# Minimum distance of a tilted copy from all other grasps (m), and weight of rotations in this distance (m/rad).
_MIN_DISTANCE, _ROTATION_WEIGHT = 0.035, 0.1
# Distance beyond an advance (m): the open gripper must not collide with the object there either.
_MIN_ADVANCE_CLEARANCE = 0.004
_HAND_FROM_GRIPPER = invert_pose(np.array(GRIPPER_FROM_HAND))

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GraspPreparationConfig(CheckedConfig):
    """Configuration of tilted copies of known grasps and of their validation in simulation.

    Attributes:
        tilts: Rotations of the copies about the line between the finger pads (rad).
        max_copies: Maximum number of copies that hold the shaken object, of all grasps together.
        lateral_offsets: Offsets of a stable grasp at which the shaking is repeated, in the hand link's frame (m).
        advances: Distances (m) by which a grasp may be moved along its approach axis towards the object. The
            first one with 4 mm to spare before a collision is used. Objects slip less in deeper grasps at the release.
        held_time: Time for which the object is held in place while the fingers close (s).
        free_time: Time for which the object is then simulated without support (s).
        max_slip: Maximum slip of the object within `free_time` (m).
        release_offsets: Offsets in the hand link's frame at which the simulated release is repeated (m).
        validation: Configuration of closing the gripper and shaking it.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)
    any_length: ClassVar[frozenset[str]] = frozenset({"tilts", "lateral_offsets", "advances", "release_offsets"})

    tilts: tuple[float, ...] = (-0.4, 0.4, -0.8, 0.8)
    max_copies: int = 150
    lateral_offsets: tuple[tuple[float, float, float], ...] = ((0.005, 0.0, -0.004), (-0.005, 0.0, -0.004))
    advances: tuple[float, ...] = (0.01, 0.0075, 0.005, 0.0025)
    held_time: float = 0.22
    free_time: float = 0.06
    max_slip: float = 0.003
    release_offsets: tuple[tuple[float, float, float], ...] = (
        (0.003, 0.0, -0.002),
        (-0.003, 0.0, -0.002),
        (0.0, 0.003, 0.0),
    )
    validation: GraspValidationConfig = field(
        default_factory=lambda: GraspValidationConfig(close_time=0.25, shake_time=0.06)
    )


#: Validation with one simulated shaking and one simulated release per grasp. It takes a few seconds for each object.
QUICK_PREPARATION = GraspPreparationConfig(tilts=(-0.5, 0.5), max_copies=30, lateral_offsets=(), release_offsets=())


@dataclass(frozen=True, eq=False)
class ValidatedGrasps:
    """Grasps of an object with the outcome of their validation in simulation.

    Attributes:
        poses: (n, 7) poses (quaternion xyzw) of the hand link in the object's frame.
        success_rates: (n,) share of shakings times share of releases in which the object did not slip, 0 to 1.
    """

    poses: Array
    success_rates: Array

    def select(self, chosen: npt.NDArray[np.generic]) -> "ValidatedGrasps":
        """Return the grasps that the indices or flags `chosen` (n,) select."""
        return ValidatedGrasps(self.poses[chosen], self.success_rates[chosen])


def grasps_from_record(record: ValidationRecord, known: Array, config: GraspPreparationConfig) -> ValidatedGrasps:
    """Return the n grasps and success rates of a validation record (n, 4) that was made from known grasps (k, 7)."""
    copy, stable, advance, kept = np.asarray(record, dtype=np.int64).T
    n_shakes, n_releases = 1 + len(config.lateral_offsets), 1 + len(config.release_offsets)
    poses = np.concatenate([known, tilt_grasps(known, config)[copy[len(known) :]]])
    distances = np.array([0.0, *config.advances])
    moved = [advance_grasp(pose, distances[step]) if step else pose for pose, step in zip(poses, advance, strict=True)]
    return ValidatedGrasps(np.array(moved).reshape(-1, 7), (stable / n_shakes) * (kept / n_releases))


def advance_grasp(pose: Array, distance: float) -> Array:
    """Return a grasp pose (7,) (quaternion xyzw) moved along its own z axis by a distance (m)."""
    return np.asarray(compose(pose, np.array([0.0, 0.0, distance, 0.0, 0.0, 0.0, 1.0])))


def tilt_grasps(known: Array, config: GraspPreparationConfig) -> Array:
    """Return copies (m, 7) of grasps (n, 7), rotated about the line between the pads by each angle in `tilts`."""
    offsets = (make_offset_pose(tilt) for tilt in config.tilts)
    return np.concatenate([np.zeros((0, 7)), *(compose(known, offset) for offset in offsets)])


def compute_grasp_distances(pose: Array, poses: Array, rotation_weight: float, depth: float = 0.0) -> Array:
    """Return the distances (n,) in m of grasp poses (n, 7) (quaternion xyzw) to one grasp pose (7,) in the same frame.

    A grasp's point is at `depth` (m) on the hand link's z axis, in the middle between the pads for `PAD_DISTANCE`. The
    distance of two grasps is the distance of their points plus `rotation_weight` (m/rad) times the rotation angle.
    """
    point = np.array([0.0, 0.0, depth, 0.0, 0.0, 0.0, 1.0])
    translations = np.linalg.norm(compose(poses, point)[:, :3] - compose(pose, point)[:3], axis=1)
    cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
    return np.asarray(translations + 2.0 * rotation_weight * np.arccos(cosines))


def perturb_grasps(grasps: ValidatedGrasps, points: Array, hand: Spheres, sweep: float) -> ValidatedGrasps:
    """Return offset copies (tilted, shifted) of stable grasps, at most 1500, clear of a person's hand and the object.

    Surface points (k, 3) of the object and the spheres `hand` are in the object's frame. The gripper must keep clear of
    the hand on a straight approach of length `sweep` (m), too. Copies are not validated in simulation, but they have
    the object between the fingers. Each copy has the success rate, above 0, of the grasp of which it is a copy.
    """
    is_stable = grasps.success_rates > 0.0
    poses, rates = grasps.poses[is_stable], grasps.success_rates[is_stable]
    # The first combination is the grasp itself.
    combinations = list(itertools.product(_TILTS, _LATERAL_OFFSETS, _BACKWARD_OFFSETS))[1:]
    moved = (compose(poses, make_offset_pose(*values)) for values in combinations)
    copies = np.concatenate([np.zeros((0, 7)), *moved])
    rates = np.tile(rates, len(combinations))
    keep = np.flatnonzero(compute_grasp_clearances(copies, hand, sweep) > OFFSET_HAND_CLEARANCE)
    keep = keep[:: max(1, -(-len(keep) // _MAX_OFFSET_GRASPS))]
    checked = points[-_N_CHECKED_POINTS:]
    surface = Spheres(checked, np.zeros(len(checked)))
    keep = keep[compute_open_gripper_clearances(copies[keep], surface) > _OFFSET_OBJECT_CLEARANCE]
    keep = keep[count_points_between_pads(copies[keep], checked) >= _MIN_POINTS_BETWEEN_PADS]
    return ValidatedGrasps(copies[keep], rates[keep])


def make_offset_pose(tilt: float, lateral: float = 0.0, backward: float = 0.0) -> Array:
    """Return the pose (7,) of a copy of a grasp, in the grasp's frame: a tilt about the line between the pads (rad).

    The copy is also moved by `lateral` (m) along x, across that line, and by `backward` (m) along -z.
    """
    middle = np.array([0.0, 0.0, PAD_DISTANCE, 0.0, 0.0, 0.0, 1.0])
    moved = np.array([lateral, 0.0, -backward, *Rotation.from_euler("y", tilt).as_quat()])
    return np.asarray(compose(compose(middle, moved), invert_pose(middle)))


def validate_grasps(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> ValidatedGrasps:
    """Return an object's known grasps, and tilted copies that hold a shaken object, with their success rates.

    There are at most `config.max_copies` copies. A grasp that fails the shaking or the release has the rate 0. Each
    grasp is moved along its approach axis (z of the hand link) by the first distance in `config.advances` at which the
    open gripper, 4 mm deeper, does not touch the object, if there is one.

    Args:
        object_urdf: URDF of the object.
        panda_urdf: URDF of the Panda that is advanced and releases the object; shaking uses the Panda without camera.
        known: (n, 7) poses of the hand link in the object's frame, xyz (m) and quaternion xyzw.
        config: Tilts, offsets and conditions of the simulated trials.
    """
    return grasps_from_record(get_validation_record(object_urdf, panda_urdf, known, config), known, config)


def get_validation_record(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> ValidationRecord:
    """Return the validation record (n, 4) of an object's known grasps and stable copies; see `ValidationRecord`.

    Without a stored record, the grasps are validated in simulation, which takes 20 to 90 s, and the record is stored in
    the user's cache folder. Arguments are the same as for `validate_grasps`.
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
        _log.warning("validating the grasps of %s, once; this takes 20 to 90 s", name)
        record = _simulate_grasps(object_urdf, panda_urdf, known, config)
        save_cached_arrays(path, {"record": record}, _DESCRIPTION)
        return record


def has_shipped_record(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig) -> bool:
    """Return whether the library ships with the validation record for these arguments, as for `validate_grasps`."""
    path = get_validation_record_path(object_urdf, panda_urdf, known, config)
    return load_validation_record(path.stem) is not None


def get_validation_record_path(
    object_urdf: Path, panda_urdf: Path, known: Array, config: GraspPreparationConfig
) -> Path:
    """Return the path of a validation record in the user's cache; the stem of the path is the name of the record."""
    # Another robot may have other masses and friction of the fingers; the folder of its meshes has no influence.
    robot = re.sub(rb'filename="[^"]*/', b'filename="', read_plain_file(panda_urdf, MAX_URDF_BYTES))
    key = f"{_VERSION} {_make_preparation_key(config)}".encode()
    rounded = np.round(known, 6).astype(np.float32).tobytes()
    return get_cache_path("grasp_validations", object_urdf, key, rounded, robot)


def _make_preparation_key(config: GraspPreparationConfig) -> str:
    """Return a configuration as text for the hash of a record; names of shipped records depend on this exact text."""
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
    from handover_marl.simulation.mujoco.grasp_validation import GraspValidator

    validator = GraspValidator(object_urdf, config.validation)
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
    validator = GraspValidator(object_urdf, config.validation, panda_urdf)
    for row, pose in zip(rows, poses, strict=True):
        row[2] = _find_advance(validator, pose, config)
        if row[1]:
            deepest = advance_grasp(pose, config.advances[row[2] - 1]) if row[2] else pose
            row[3] = _count_kept(validator, deepest, config)
    record: ValidationRecord = np.array(rows, dtype=np.int16)
    return record


def _count_stable(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Count the poses (a grasp and its `lateral_offsets`) that hold a shaken object; 0 if the grasp itself does not."""
    if not validator.is_stable(_gripper_matrix(pose)):
        return 0
    moved = [compose(pose, np.array([*offset, 0.0, 0.0, 0.0, 1.0])) for offset in config.lateral_offsets]
    return 1 + sum(validator.is_stable(_gripper_matrix(other)) for other in moved)


def _find_advance(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Return the number, from 1, of the first advance (m) after which a grasp (7,) has 4 mm to a collision; or 0."""
    for number, distance in enumerate(config.advances, start=1):
        deeper = advance_grasp(pose, distance + _MIN_ADVANCE_CLEARANCE)
        if validator.is_collision_free(_gripper_matrix(deeper)):
            return number
    return 0


def _count_kept(validator: "GraspValidator", pose: Array, config: GraspPreparationConfig) -> int:
    """Count the poses (a grasp and its `release_offsets`) that keep a released object; 0 if the grasp does not."""
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
    """Return the pose (4, 4) of the gripper frame of grasp files, at a pose (7,) of the hand link."""
    gripper = compose(hand, _HAND_FROM_GRIPPER)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(gripper[3:]).as_matrix(), gripper[:3]
    return matrix
