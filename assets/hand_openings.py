"""Open hands with the thumb opposite the fingers, as starts of human grasps."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.assets.anthropometry import REFERENCE_SIZE
from handover_marl.assets.hand_model import FloatArray, HandGeometry, scale_hand
from handover_marl.assets.hand_postures import ArrayBatch, Posture
from handover_marl.assets.hand_spheres import HandSpheres

# Smallest cosine between the pads' direction and the thumb, and smallest width (m) of a gap.
_MIN_FACING: Final = 0.2
_MIN_WIDTH: Final = 0.012
# Extreme directions of the thumb's first bone in the palm's frame: forward beside the index finger,
# abducted in the plane of the palm, and in front of the palm opposite the fingers.
_THUMB_DIRECTIONS = np.array([[-0.80, -0.40, 0.44], [-0.58, -0.24, 0.78], [-0.42, -0.87, 0.25]])
# Point (m) that the reference hand's thumb flexes towards, below the middle finger's first bone.
_THUMB_TARGET = np.array([-0.100, -0.030, 0.002])


@dataclass(frozen=True, eq=False)
class Openings(ArrayBatch):
    """Open hand postures and their gaps between thumb and fingers, in the palm's frame.

    Attributes:
        posture: n open postures of a hand.
        center: (n, 3) centers of the gaps (m).
        axis: (n, 3) unit vectors from the thumb's pad to the fingers' pads.
        width: (n,) widths of the gaps (m).
    """

    posture: Posture
    center: FloatArray
    axis: FloatArray
    width: FloatArray


def measure_openings(model: HandGeometry, posture: Posture) -> Openings:
    """Return the gaps between thumb and fingers in n postures of a hand."""
    spheres = HandSpheres(model)
    centers, _ = spheres.place_phalanges(posture.compute_joint_angles())
    thumb, fingers = centers[:, 14, -1], (centers[:, 2, -1] + centers[:, 5, -1]) / 2
    between = fingers - thumb
    distance = np.linalg.norm(between, axis=1)
    width = distance - spheres.radii[14, -1] - spheres.radii[2, -1]
    return Openings(posture, (thumb + fingers) / 2, between / distance[:, None], width)


@dataclass(frozen=True, eq=False)
class OpeningDraws:
    """Random numbers from which open postures are made.

    Attributes:
        root: (n,) uniform numbers (0 to 1) for the flexion of the fingers' root joints.
        middle: (n,) uniform numbers for the flexion of their middle joints.
        fingers: (n, 4, 1) normal numbers for the differences between fingers.
        thumb_middle: (n,) uniform numbers for the flexion of the thumb's middle joint.
        thumb_end: (n,) uniform numbers for the flexion of the thumb's end joint.
        spread: (n, 1) uniform numbers for the spread of the fingers.
        thumb_direction: (n, 3) weights, of sum 1, of three extreme directions of the thumb.
        thumb_target: (n, 3) normal numbers for the point that the thumb flexes towards.
    """

    root: FloatArray
    middle: FloatArray
    fingers: FloatArray
    thumb_middle: FloatArray
    thumb_end: FloatArray
    spread: FloatArray
    thumb_direction: FloatArray
    thumb_target: FloatArray


def make_reference_openings(draws: OpeningDraws) -> Openings:
    """Return the open postures of the reference hand whose fingers' pads face the thumb."""
    hand, n = scale_hand(REFERENCE_SIZE, "right"), len(draws.root)
    root, middle = 0.05 + (1.15 - 0.05) * draws.root, 0.08 + (1.0 - 0.08) * draws.middle
    one_finger = np.stack([root, middle, 0.5 * middle], axis=1)
    fingers = one_finger[:, None] + 0.04 * draws.fingers * [1.0, 1.0, 0.5]
    thumb = np.column_stack([np.zeros(n), 0.4 * draws.thumb_middle, 0.5 * draws.thumb_end])
    bends = np.maximum(np.concatenate([fingers, thumb[:, None]], axis=1), 0.0)
    spread = (-0.05 + (0.12 + 0.05) * draws.spread) * np.array([1.0, 0.1, -2.0, -0.9])
    direction = normalize(draws.thumb_direction @ _THUMB_DIRECTIONS)
    aim = _THUMB_TARGET - hand.joint_origins[12] + 0.015 * draws.thumb_target
    roots = compute_shortest_rotations(normalize(hand.tips[12]), direction)
    openings = measure_openings(hand, Posture(bends, spread, roots, normalize(np.cross(direction, aim))))
    _, rotations = HandSpheres(hand).place_phalanges(openings.posture.compute_joint_angles())
    pads = -(rotations[:, 2, :, 1] + rotations[:, 5, :, 1]) / 2
    facing = np.einsum("ni,ni->n", pads, -openings.axis)
    return openings[np.flatnonzero((facing > _MIN_FACING) & (openings.width > _MIN_WIDTH))]


def compute_shortest_rotations(source: FloatArray, goal: FloatArray) -> FloatArray:
    """Return the smallest rotations (n, 3, 3) from unit vectors `source` to `goal`."""
    source = np.broadcast_to(source, goal.shape)
    axis = np.cross(source, goal)
    sine, cosine = np.linalg.norm(axis, axis=1), np.einsum("ni,ni->n", source, goal)
    # Exactly opposite vectors, whose axis is undefined, do not occur in random samples.
    scaled = axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    return np.asarray(Rotation.from_rotvec(scaled).as_matrix())


def normalize(vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 3) scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
