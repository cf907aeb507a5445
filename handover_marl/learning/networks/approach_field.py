"""Approach field: the next step of the robot's hand as a function of its pose relative to a grasp.

The field gives the labels for imitation. Labels must depend only on what a network observes. The
field satisfies this, because it leads from any pose to the grasp, whatever motion led to that pose.

The hand first rotates and moves to a standoff, at a pace that matches the remaining decisions, since
a hand that arrives early would meet a person who is still lifting the object. It then moves in by a
single step: GA-DDPG closes the fingers as soon as 50 of 1,024 points are between them at the end of
a decision, so that after several small steps the fingertips would hold the object.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.geometry.poses import compose, invert_pose

Array = npt.NDArray[np.float64]

# Attribute names in weight files of version 0.7.0.
_NAMES_0_7 = {
    "over": "standoff_band",
    "pads": "pad_distance",
    "aligned": "min_error",
    "astray": "max_error",
    "arm": "rotation_weight",
    "cone": "cone_slope",
    "farthest": "max_standoff",
    "shift": "max_translation",
    "turn": "max_rotation",
    "spare": "spare_steps",
    "slowest": "min_translation",
    "close": "near_distance",
}


@dataclass(frozen=True)
class ApproachFieldConfig:
    """Configuration of the approach field, which leads the robot's hand to a grasp.

    The hand is the Panda's hand link. The approach axis is its z axis at the grasp. The error of a hand pose is the
    distance of the middle between its pads from this axis plus the weighted angle to the hand's orientation at
    the grasp. The hand "moves in" when it leaves the standoff and moves straight to the grasp.

    Attributes:
        standoff: Distance of the standoff from the grasp, back along the approach axis (m).
        standoff_band: Range of distances beyond the standoff in which the hand may start to move in (m).
        pad_distance: Distance from the hand's origin to the middle between its pads (m).
        min_error: Largest error with which the hand moves in to the grasp (m).
        max_error: Error from which the hand moves to the standoff instead; with errors between
            `min_error` and `max_error` the target changes linearly (m).
        rotation_weight: Weight of the angle in the error (m/rad).
        cone_slope: Additional distance of the standoff per metre of error beyond `max_error`.
        max_standoff: Largest distance of the standoff from the grasp (m).
        max_translation: Largest translation of a step along each axis (m).
        max_rotation: Largest rotation of a step about each axis (rad).
        gain: Factor on the commanded motion before the hand moves in; more than 1 compensates for the lag of the arm.
        spare_steps: Number of decisions that should be left when the hand reaches its target.
        min_translation: Smallest value to which the remaining decisions reduce the largest translation of a step (m).
        near_distance: Distance from the target below which steps may be as long as `max_translation` (m).
    """

    standoff: float = 0.055
    standoff_band: float = 0.02
    pad_distance: float = PAD_DISTANCE
    min_error: float = 0.008
    max_error: float = 0.018
    rotation_weight: float = 0.05
    cone_slope: float = 0.5
    max_standoff: float = 0.12
    max_translation: float = 0.06
    max_rotation: float = np.pi / 6.0
    gain: float = 1.0
    spare_steps: int = 20
    min_translation: float = 0.02
    near_distance: float = 0.1

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> "ApproachFieldConfig":
        """Create the configuration from settings in a weight file of this version or of 0.7.0."""
        return cls(**{_NAMES_0_7.get(name, name): value for name, value in settings.items()})


def compute_approach_steps(hands: Array, goals: Array, remaining: Array, config: ApproachFieldConfig) -> Array:
    """Return the next motion of each of n robot hands towards a grasp of its own.

    Args:
        hands: (n, 7) present poses of the hand link, xyz (m) and quaternion xyzw.
        goals: (n, 7) poses of the hand link at the grasps, in the same frame, quaternions xyzw.
        remaining: (n,) numbers of remaining decisions, including this one.
        config: Configuration of the field.

    Returns:
        (n, 6) translations (m) and extrinsic xyz Euler angles (rad) in the frames of the present poses.
    """
    relative = compose(invert_pose(goals), hands)
    rotations = Rotation.from_quat(relative[:, 3:])
    standoffs, outside = _compute_standoffs(relative, rotations, config)
    targets = goals.copy()
    targets[:, :3] -= standoffs[:, None] * Rotation.from_quat(goals[:, 3:]).as_matrix()[..., 2]
    motions = compose(invert_pose(hands), targets)
    length = np.linalg.norm(motions[:, :3], axis=1)
    pace = length / (np.maximum(remaining - config.spare_steps, 1.0))
    limited_pace = np.clip(pace, config.min_translation, config.max_translation)
    max_translation = np.where(length < config.near_distance, config.max_translation, limited_pace)
    gain = 1.0 + (config.gain - 1.0) * outside
    rotation_vectors = Rotation.from_quat(motions[:, 3:]).as_rotvec()
    return _limit_steps(gain[:, None] * motions[:, :3], gain[:, None] * rotation_vectors, max_translation, config)


def _compute_standoffs(relative: Array, rotations: Rotation, config: ApproachFieldConfig) -> tuple[Array, Array]:
    """Return distances (n,) in m from the grasps that the hands should have, and their shares (n,): 0 to move in.

    Args:
        relative: (n, 7) poses of the hand in the frame of the grasp, quaternions xyzw.
        rotations: Rotations of these poses.
        config: Configuration of the field.
    """
    pads = relative[:, :3] + config.pad_distance * rotations.as_matrix()[..., 2]
    error = np.linalg.norm(pads[:, :2], axis=1) + config.rotation_weight * rotations.magnitude()
    misalignment = (error - config.min_error) / (config.max_error - config.min_error)
    # Linear within half of the band either way, since labels that jump cannot be learned.
    distance = (-relative[:, 2] - config.standoff - 0.5 * config.standoff_band) / config.standoff_band
    share = np.clip(np.maximum(misalignment, distance), 0.0, 1.0)
    cone = config.cone_slope * np.maximum(0.0, error - config.max_error)
    return share * np.minimum(config.standoff + cone, config.max_standoff), share


def _limit_steps(
    translations: Array, rotation_vectors: Array, max_translation: Array, config: ApproachFieldConfig
) -> Array:
    """Return steps (n, 6), translation (m) and xyz Euler angles (rad), scaled down to the largest translations (n,)."""
    by_translation = np.abs(translations).max(axis=1) / max_translation
    by_rotation = np.abs(rotation_vectors).max(axis=1) / config.max_rotation
    # Scaled together: a hand that rotates before it moves loses sight of the object.
    share = 1.0 / np.maximum(1.0, np.maximum(by_translation, by_rotation))
    euler = Rotation.from_rotvec(share[:, None] * rotation_vectors).as_euler("xyz")
    clipped = np.clip(euler, -config.max_rotation, config.max_rotation)
    return np.concatenate([share[:, None] * translations, clipped], axis=1)
