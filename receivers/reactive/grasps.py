"""Known grasps of an object: validated poses, tilted copies, and offset copies.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

import itertools
import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped import ValidationRecord
from handover_marl.config import CheckedConfig
from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.planning.clearance import (
    Spheres,
    compute_grasp_clearances,
    compute_open_gripper_clearances,
    count_points_between_pads,
)
from handover_marl.simulation.grasp_validation import GraspValidationConfig

Array = npt.NDArray[np.float64]

# Offsets of additional copies: rotations about the line between the pads (rad), translations across it and back (m).
_TILTS, _LATERAL_OFFSETS, _BACKWARD_OFFSETS = (
    (0.0, -0.35, 0.35, -0.7, 0.7),
    (0.0, -0.012, 0.012, -0.024, 0.024),
    (0.0, 0.01),
)
#: Minimum clearance of an offset copy to the person's hand (m).
OFFSET_HAND_CLEARANCE = 0.003
# Minimum clearance of the open gripper at an offset copy to points of the object (m), number of these from the end of
# the list, minimum number of them between the pads, and maximum number of copies, taken evenly from all.
_OFFSET_OBJECT_CLEARANCE, _N_CHECKED_POINTS, _MIN_POINTS_BETWEEN_PADS, _MAX_OFFSET_GRASPS = 0.001, 1200, 2, 1500


@dataclass(frozen=True)
class GraspPreparationConfig(CheckedConfig):
    """Configuration of tilted copies of known grasps and of their validation in simulation.

    Attributes:
        tilts: Rotations of the copies about the line between the finger pads (rad).
        max_copies: Maximum number of stable copies, of all grasps together.
        lateral_offsets: Offsets in the hand link's frame (fingers close along y) at which the shaking
            of a stable grasp is repeated (m).
        advances: Distances by which a grasp may be moved along its approach axis towards the object
            (m), the preferred one first: an object that is held by the fingertips slips away on release, before the
            fingers press as hard as in a validation.
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


#: Validation with few simulations, one for shaking and one for the release, which takes a few seconds for each object.
QUICK_PREPARATION = GraspPreparationConfig(tilts=(-0.5, 0.5), max_copies=30, lateral_offsets=(), release_offsets=())


@dataclass(frozen=True, eq=False)
class ValidatedGrasps:
    """Grasps of an object with the outcome of their validation in simulation.

    Attributes:
        poses: (n, 7) poses of the hand link in the object's frame.
        success_rates: (n,) share of validations that each grasp has passed, 0 to 1.
    """

    poses: Array
    success_rates: Array

    def select(self, chosen: npt.NDArray[np.generic]) -> "ValidatedGrasps":
        """Return only the grasps with the indices or flags (n,) `chosen`."""
        return ValidatedGrasps(self.poses[chosen], self.success_rates[chosen])


def grasps_from_record(record: ValidationRecord, known: Array, config: GraspPreparationConfig) -> ValidatedGrasps:
    """Return the n grasps, with success rates, that a validation record (n, 4) of known grasps (k, 7) describes."""
    copy, stable, advance, kept = np.asarray(record, dtype=np.int64).T
    n_shakes, n_releases = 1 + len(config.lateral_offsets), 1 + len(config.release_offsets)
    poses = np.concatenate([known, tilt_grasps(known, config)[copy[len(known) :]]])
    distances = np.array([0.0, *config.advances])
    moved = [advance_grasp(pose, distances[step]) if step else pose for pose, step in zip(poses, advance, strict=True)]
    return ValidatedGrasps(np.array(moved).reshape(-1, 7), (stable / n_shakes) * (kept / n_releases))


def advance_grasp(pose: Array, distance: float) -> Array:
    """Return a grasp pose (7,) moved along its own z axis by a distance (m)."""
    return np.asarray(compose(pose, np.array([0.0, 0.0, distance, 0.0, 0.0, 0.0, 1.0])))


def tilt_grasps(known: Array, config: GraspPreparationConfig) -> Array:
    """Return copies (m, 7) of grasps (n, 7): each is tilted by each of `tilts` about the line between the pads."""
    offsets = (make_offset_pose(tilt) for tilt in config.tilts)
    return np.concatenate([np.zeros((0, 7)), *(compose(known, offset) for offset in offsets)])


def compute_grasp_distances(pose: Array, poses: Array, rotation_weight: float, depth: float = 0.0) -> Array:
    """Return the distances (n,) in m of grasp poses (n, 7) to one grasp pose (7,) in the same frame.

    A distance is that of the points at `depth` (m) on the hand link's z axis, such as `PAD_DISTANCE` for the middle
    between the pads, plus `rotation_weight` (m/rad) times the rotation angle.
    """
    point = np.array([0.0, 0.0, depth, 0.0, 0.0, 0.0, 1.0])
    translations = np.linalg.norm(compose(poses, point)[:, :3] - compose(pose, point)[:3], axis=1)
    cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
    return np.asarray(translations + 2.0 * rotation_weight * np.arccos(cosines))


def perturb_grasps(grasps: ValidatedGrasps, points: Array, hand: Spheres, sweep: float) -> ValidatedGrasps:
    """Return offset copies of stable grasps that keep clear of a person's hand and of the object.

    Points (k, 3) of the object's surface and the hand are in the object's frame; `sweep` is the length (m) of the
    straight approach, on which the gripper must keep clear of the hand. The copies are not validated in simulation.
    They are likely to hold, since the object is between the fingers, which close along the line of a validated grasp.
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
    """Return the pose (7,) of a copy of a grasp in the frame of the grasp, tilted (rad) about the line of the pads.

    The copy is also moved by `lateral` (m) along x, across that line, and by `backward` (m) against the approach.
    """
    middle = np.array([0.0, 0.0, PAD_DISTANCE, 0.0, 0.0, 0.0, 1.0])
    moved = np.array([lateral, 0.0, -backward, *Rotation.from_euler("y", tilt).as_quat()])
    return np.asarray(compose(compose(middle, moved), invert_pose(middle)))
