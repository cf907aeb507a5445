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
from handover_marl.config import CheckedConfig, bounded
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


@dataclass(frozen=True)
class GraspPreparationConfig(CheckedConfig):
    """Configuration of tilted copies of known grasps and of their validation in simulation.

    Attributes:
        tilts: Rotations of the copies about the line between the finger pads (rad).
        pad_distance: Distance of the line between the pads from the origin of the hand link (m).
        min_distance: Minimum distance of a copy from another grasp (m); closer ones are discarded.
        rotation_weight: Weight of rotations in the distance of two grasps (m/rad).
        max_copies: Maximum number of stable copies of all grasps.
        lateral_offsets: Offsets in the hand link's frame (fingers close along y) at which the shaking
            of a stable grasp is repeated (m).
        advances: Distances by which a grasp may be moved along its approach axis towards the object
            (m), the preferred one first.
        min_advance_clearance: Further distance along the approach axis in which the open gripper must not collide with
            the object (m). A grasp is advanced since an object that is held by the fingertips slips away on release,
            before the fingers press as hard as in a validation.
        held_time: Time for which the object is held in place while the fingers close (s).
        free_time: Time for which the object is then simulated without support (s).
        max_slip: Maximum slip of the object within `free_time` (m).
        release_offsets: Offsets in the hand link's frame at which the simulated release is repeated (m).
        validation: Configuration of closing the gripper and shaking it.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)
    any_length: ClassVar[frozenset[str]] = frozenset({"tilts", "lateral_offsets", "advances", "release_offsets"})

    tilts: tuple[float, ...] = (-0.4, 0.4, -0.8, 0.8)
    pad_distance: float = PAD_DISTANCE
    min_distance: float = 0.035
    rotation_weight: float = 0.1
    max_copies: int = 150
    lateral_offsets: tuple[tuple[float, float, float], ...] = ((0.005, 0.0, -0.004), (-0.005, 0.0, -0.004))
    advances: tuple[float, ...] = (0.01, 0.0075, 0.005, 0.0025)
    min_advance_clearance: float = 0.004
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


def make_quick_preparation_config() -> GraspPreparationConfig:
    """Return the configuration of a validation with few simulations: one for shaking and one for the release.

    It takes a few seconds for each object, and does not vary the place of the gripper.
    """
    return GraspPreparationConfig(tilts=(-0.5, 0.5), max_copies=30, lateral_offsets=(), release_offsets=())


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
        """Return only the grasps with the given indices or flags."""
        return ValidatedGrasps(self.poses[chosen], self.success_rates[chosen])


@dataclass(frozen=True)
class GraspOffsets(CheckedConfig):
    """Offsets of additional grasps from validated ones, with the middle of the finger pads as center of rotations.

    The offsets are in the hand link's frame (fingers close along y). The copies are not validated in
    simulation. They are likely to hold, since the object is between the fingers and these close along
    the same line as in a validated grasp.

    Attributes:
        tilts: Rotations about the line between the pads (rad).
        lateral: Translations across the line between the pads and the approach direction (m).
        backward: Translations back along the approach direction (m).
        pad_distance: Distance of the pads' middle from the origin of the hand link (m).
        min_clearance: Minimum clearance of the gripper to the person's hand (m).
        min_object_clearance: Minimum clearance of the open gripper to the object's points (m).
        n_points: Number of the object's points that are checked, from the end of the list.
        min_points_between_pads: Minimum number of the checked points between the pads.
        max_grasps: Maximum number of copies, taken evenly from all.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)
    any_length: ClassVar[frozenset[str]] = frozenset({"tilts", "lateral", "backward"})

    tilts: tuple[float, ...] = (0.0, -0.35, 0.35, -0.7, 0.7)
    lateral: tuple[float, ...] = (0.0, -0.012, 0.012, -0.024, 0.024)
    backward: tuple[float, ...] = (0.0, 0.01)
    pad_distance: float = PAD_DISTANCE
    min_clearance: float = 0.003
    min_object_clearance: float = 0.001
    n_points: int = bounded(1200, 1)
    min_points_between_pads: int = 2
    max_grasps: int = bounded(1500, 1)


def grasps_from_record(record: ValidationRecord, known: Array, config: GraspPreparationConfig) -> ValidatedGrasps:
    """Return the grasps that a validation record (n, 4) describes.

    Raises:
        ValueError: The record belongs to other grasps than `known` (k, 7), or to another configuration.
    """
    n, copies = len(known), tilt_grasps(known, config)
    copy, stable, advance, kept = np.asarray(record, dtype=np.int64).reshape(-1, 4).T
    if len(copy) < n or (copy[:n] != -1).any() or (copy[n:] < 0).any() or (copy >= len(copies)).any():
        raise ValueError("the record belongs to other grasps")
    n_shakes, n_releases = 1 + len(config.lateral_offsets), 1 + len(config.release_offsets)
    largest = np.array([n_shakes, len(config.advances), n_releases])
    if ((record[:, 1:] < 0) | (record[:, 1:] > largest)).any():
        raise ValueError("the record belongs to another validation")
    poses = np.concatenate([known, copies[copy[n:]]])
    distances = np.array([0.0, *config.advances])
    moved = [advance_grasp(pose, distances[step]) if step else pose for pose, step in zip(poses, advance, strict=True)]
    return ValidatedGrasps(np.array(moved).reshape(-1, 7), (stable / n_shakes) * (kept / n_releases))


def advance_grasp(pose: Array, distance: float) -> Array:
    """Return a grasp pose (7,) moved along its own z axis by a distance (m)."""
    return np.asarray(compose(pose, np.array([0.0, 0.0, distance, 0.0, 0.0, 0.0, 1.0])))


def tilt_grasps(known: Array, config: GraspPreparationConfig) -> Array:
    """Return (m, 7) copies of grasps (n, 7), tilted about the line between the pads."""
    offsets = (make_offset_pose(tilt, 0.0, 0.0, config.pad_distance) for tilt in config.tilts)
    return np.concatenate([np.zeros((0, 7)), *(compose(known, offset) for offset in offsets)])


def compute_grasp_distances(pose: Array, poses: Array, rotation_weight: float) -> Array:
    """Return the distances (n,) in m of grasp poses (n, 7) to one grasp pose (7,).

    A distance is the translation (m) plus the rotation angle (rad) times `rotation_weight` (m/rad).
    """
    translations = np.linalg.norm(poses[:, :3] - pose[:3], axis=1)
    cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
    return np.asarray(translations + 2.0 * rotation_weight * np.arccos(cosines))


def perturb_grasps(
    grasps: ValidatedGrasps, points: Array, hand: Spheres, sweep: float, offsets: GraspOffsets
) -> ValidatedGrasps:
    """Return offset copies of stable grasps that keep clear of a person's hand and of the object.

    All is in the object's frame: points (k, 3) of its surface, and the hand. `sweep` is the length of the straight
    approach (m).
    """
    is_stable = grasps.success_rates > 0.0
    poses, rates = grasps.poses[is_stable], grasps.success_rates[is_stable]
    # The first combination is the grasp itself.
    combinations = list(itertools.product(offsets.tilts, offsets.lateral, offsets.backward))[1:]
    moved = (compose(poses, make_offset_pose(*values, offsets.pad_distance)) for values in combinations)
    copies = np.concatenate([np.zeros((0, 7)), *moved])
    rates = np.tile(rates, len(combinations))
    keep = np.flatnonzero(compute_grasp_clearances(copies, hand, sweep) > offsets.min_clearance)
    keep = keep[:: max(1, -(-len(keep) // offsets.max_grasps))]
    checked = points[-offsets.n_points :]
    surface = Spheres(checked, np.zeros(len(checked)))
    keep = keep[compute_open_gripper_clearances(copies[keep], surface) > offsets.min_object_clearance]
    keep = keep[count_points_between_pads(copies[keep], checked) >= offsets.min_points_between_pads]
    return ValidatedGrasps(copies[keep], rates[keep])


def make_offset_pose(tilt: float, lateral: float, backward: float, pad_distance: float) -> Array:
    """Return the pose (7,) of a grasp copy, tilted about the line between the pads and moved."""
    middle = np.array([0.0, 0.0, pad_distance, 0.0, 0.0, 0.0, 1.0])
    moved = np.array([lateral, 0.0, -backward, *Rotation.from_euler("y", tilt).as_quat()])
    return np.asarray(compose(compose(middle, moved), invert_pose(middle)))
