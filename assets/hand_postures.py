"""Palm poses and finger postures of right hands, hands as spheres, and open hands as starts of human grasps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.assets.anthropometry import REFERENCE_SIZE
from handover_marl.assets.hand_model import (
    BoolArray,
    FloatArray,
    HandGeometry,
    IntArray,
    euler_from_matrices,
    scale_hand,
)

if TYPE_CHECKING:
    from typing_extensions import Self

#: Index of the thumb in `DIGIT_ORDER`.
THUMB: Final = 4
#: Number of spheres of a phalanx.
N_SPHERES: Final = 3
#: Tapered capsule (m): start (3,), end (3,), radius at the start, radius at the end.
Capsule = tuple[FloatArray, FloatArray, float, float]
# Smallest cosine between the pads' direction and the thumb, and smallest width (m) of a gap.
_MIN_FACING: Final = 0.2
_MIN_WIDTH: Final = 0.012
# Extreme directions of the thumb's first bone in the palm's frame: forward beside the index finger,
# abducted in the plane of the palm, and in front of the palm opposite the fingers.
_THUMB_DIRECTIONS = np.array([[-0.80, -0.40, 0.44], [-0.58, -0.24, 0.78], [-0.42, -0.87, 0.25]])
# Point (m) that the reference hand's thumb flexes towards, below the middle finger's first bone.
_THUMB_TARGET = np.array([-0.100, -0.030, 0.002])


class ArrayBatch:
    """Base class of dataclasses of n items; n is the first dimension of all fields."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: IntArray | BoolArray) -> "Self":
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))  # type: ignore[arg-type]

    @classmethod
    def concatenate(cls, parts: "Sequence[Self]") -> "Self":
        """Return all items of several batches as one batch."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))  # type: ignore[arg-type]
        return cls(
            *(
                type(column[0]).concatenate(column) if isinstance(column[0], ArrayBatch) else np.concatenate(column)
                for column in columns
            )
        )


@dataclass(frozen=True, eq=False)
class Palms(ArrayBatch):
    """Poses of n palms in the object's frame.

    Attributes:
        position: (n, 3) positions (m).
        rotation: (n, 3, 3) rotation matrices.
    """

    position: FloatArray
    rotation: FloatArray

    def transform(self, points: FloatArray) -> FloatArray:
        """Transform points (n, ..., 3) from the palm's frame to the object's frame."""
        count = math.prod(points.shape[1:-1])  # -1 is not allowed where there are no palms
        flat = points.reshape(len(points), count, 3) @ self.rotation.swapaxes(1, 2) + self.position[:, None]
        return np.asarray(flat.reshape(points.shape))


@dataclass(frozen=True, eq=False)
class Posture(ArrayBatch):
    """Finger postures of n right hands.

    Attributes:
        bends: (n, 5, 3) flexion (rad) of the digits' joints, in `DIGIT_ORDER`.
        spread: (n, 4) abduction (rad) of the fingers at the knuckles, towards the thumb.
        thumb_root: (n, 3, 3) rotation of the thumb's root before flexion.
        thumb_axis: (n, 3) unit axis of the thumb's flexion in the palm's frame.
    """

    bends: FloatArray
    spread: FloatArray
    thumb_root: FloatArray
    thumb_axis: FloatArray

    def compute_joint_angles(self) -> FloatArray:
        """Return the finger joint angles (n, 45), intrinsic XYZ Euler angles (rad)."""
        angles = np.zeros((len(self), 5, 3, 3))
        angles[..., 2] = self.bends
        angles[:, :THUMB, 0, 1] = self.spread
        bends = self.bends[:, THUMB]
        local = np.einsum("nji,nj->ni", self.thumb_root, self.thumb_axis)
        angles[:, THUMB, 0] = euler_from_matrices(
            make_rotations_about_axes(self.thumb_axis, bends[:, 0]) @ self.thumb_root
        )
        for joint in (1, 2):
            angles[:, THUMB, joint] = euler_from_matrices(make_rotations_about_axes(local, bends[:, joint]))
        return angles.reshape(-1, 45)


def make_rotations_about_axes(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Return rotation matrices (n, 3, 3) about unit axes (n, 3) by angles (n,) (rad)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sin, cos = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * cross @ cross)


def make_palm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of a palm: metacarpals and balls of thumb and little finger."""
    index, middle, little, ring, thumb = _unscale_points(hand, hand.joint_origins[::3])
    drop, wrist = np.array([0.0, -0.004, 0.0]), 0.0155
    capsules = [
        (np.array([-0.012, -0.002, 0.013]), index + drop, wrist, 0.0128),
        (np.array([-0.012, -0.002, 0.005]), middle + drop, wrist, 0.0130),
        (np.array([-0.012, -0.002, -0.005]), ring + drop, wrist, 0.0125),
        (np.array([-0.012, -0.003, -0.012]), little + drop / 2, wrist, 0.0118),
        (thumb + np.array([0.004, 0.0, -0.006]), thumb + np.array([-0.024, -0.006, 0.004]), 0.0150, 0.0125),
        (np.array([-0.022, -0.008, -0.019]), little + np.array([0.022, -0.006, 0.002]), 0.0135, 0.0115),
    ]
    return _scale_capsules(hand, capsules)


def make_forearm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of the end of the forearm in the palm's frame."""
    return _scale_capsules(
        hand,
        [(np.array([0.075, 0.0, z]), np.array([0.0, 0.0, z * 8.0 / 9.0]), 0.024, 0.0165) for z in (0.009, -0.009)],
    )


def spheres_from_capsules(capsules: list[Capsule], count: int) -> tuple[FloatArray, FloatArray]:
    """Return centers (len(capsules) * count, 3) and radii of spheres spaced evenly in capsules."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    centers = [start + t * (end - start) for start, end, _, _ in capsules]
    radii = [first + t[:, 0] * (last - first) for _, _, first, last in capsules]
    return np.vstack(centers), np.concatenate(radii)


def _compute_scale(hand: HandGeometry) -> FloatArray:
    return np.asarray(hand.scale * np.array([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0]))


def _unscale_points(hand: HandGeometry, points: FloatArray) -> FloatArray:
    return np.asarray(points / _compute_scale(hand))


def _scale_capsules(hand: HandGeometry, capsules: list[Capsule]) -> list[Capsule]:
    stretch, across = _compute_scale(hand), float(hand.scale[1])
    return [(a * stretch, b * stretch, r0 * across, r1 * across) for a, b, r0, r1 in capsules]


class HandSpheres:
    """Approximation of a right hand by spheres: three per phalanx, others in palm and forearm.

    Args:
        model: Geometry of a right hand.

    Attributes:
        model: Geometry of the hand.
        along: (15, 3, 3) centers (m) of the phalanges' spheres, in the frames of the phalanges.
        radii: (15, 3) radii (m) of the phalanges' spheres.
        palm: Centers (k, 3) and radii (k,) (m) of the palm's spheres, in the palm's frame.
        forearm: Centers and radii of the forearm's spheres, in the palm's frame (m).
    """

    def __init__(self, model: HandGeometry) -> None:
        self.model = model
        t = (np.arange(N_SPHERES) + 1.0) / N_SPHERES
        self.along = model.tips[:, None, :] * t[:, None]
        self.radii = model.radii[:, :1] + (model.radii[:, 1:] - model.radii[:, :1]) * t
        self.palm = spheres_from_capsules(make_palm_capsules(model), 6)
        self.forearm = spheres_from_capsules(make_forearm_capsules(model), 4)

    def place_phalanges(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return centers (n, 15, 3, 3) in m of three spheres per phalanx, and the phalanges' rotations.

        Both are in the palm's frame, for finger joint angles (n, 45) in rad.
        """
        dof = np.concatenate([np.zeros((len(angles), 6)), angles], axis=1)
        dof[:, :3] = -self.model.palm_offset
        positions, rotations = self.model.compute_link_poses(dof)
        centers = positions[:, 1:, None, :] + np.einsum("nlij,lbj->nlbi", rotations[:, 1:], self.along)
        return centers, rotations[:, 1:]


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
