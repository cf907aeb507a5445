"""Hands of people in generated scenes: open postures around an object, and the paths of closing fingers.

All hands are right hands, approximated by spheres: three per phalanx, others in palm and forearm. The paths of the
phalanges while the fingers close freely are computed once for each hand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.hand_model import MEN, REFERENCE_SIZE, SKIN_COLORS, WOMEN, HandGeometry, HandSize, scale_hand
from handover_marl.datasets.generated.config import GeneratedConfig, make_seed
from handover_marl.datasets.generated.random_stream import RandomStream, open_stream
from handover_marl.datasets.generated.shapes import normalize
from handover_marl.geometry.rotations import euler_from_matrices

if TYPE_CHECKING:
    from typing import Self

Array = npt.NDArray[np.float64]
#: Tapered capsule (m): start (3,), end (3,), radius at the start, radius at the end.
Capsule = tuple[Array, Array, float, float]
#: Centers (k, 3) and radii (k,) of spheres (m).
Spheres = tuple[Array, Array]

#: Index of the thumb among the digits.
THUMB: Final = 4
#: Number of steps in which an empty hand closes, and flexion (5, 3) in each step: root, middle and end joint (rad).
N_STEPS: Final = 20
STEP_ANGLES: Final = np.radians(5.0) * np.array([[1.0, 1.0, 0.55]] * 4 + [[0.6, 0.7, 0.9]])
#: Largest flexion (5, 3) of the same joints of the five digits (rad).
LIMITS: Final = np.radians([[85.0, 100.0, 65.0]] * 4 + [[45.0, 55.0, 70.0]])

# Positions of the spheres of a phalanx between its joint and its end.
_SHARES: Final = np.array([1.0, 2.0, 3.0]) / 3.0
_SEED, _N_DRAWS, _N_TEMPLATES = 1010, 3000, 48
# Correlation of length and breadth of a hand, and largest standard score.
_CORRELATION, _MAX_SCORE = 0.6, 2.0
# Smallest cosine between the pads' direction and the thumb, and smallest width (m) of a gap.
_MIN_FACING: Final = 0.2
_MIN_WIDTH: Final = 0.012
# Extreme directions of the thumb's first bone in the palm's frame: forward beside the index finger,
# abducted in the plane of the palm, and in front of the palm opposite the fingers.
_THUMB_DIRECTIONS = np.array([[-0.80, -0.40, 0.44], [-0.58, -0.24, 0.78], [-0.42, -0.87, 0.25]])
# Capsules that approximate the end of the reference hand's forearm, in the palm's frame.
_FOREARM = [(np.array([0.075, 0.0, z]), np.array([0.0, 0.0, z * 8.0 / 9.0]), 0.024, 0.0165) for z in (0.009, -0.009)]
# Point (m) that the reference hand's thumb flexes towards, below the middle finger's first bone.
_THUMB_TARGET = np.array([-0.100, -0.030, 0.002])


@dataclass(frozen=True)
class Person:
    """Person of a generated scene.

    Attributes:
        name: Name of the person in results.
        size: Size of the hand.
        color: Red, green and blue of the skin, 0 to 1.
    """

    name: str
    size: HandSize
    color: tuple[float, float, float]


@lru_cache(maxsize=1024)
def draw_person(config: GeneratedConfig, number: int) -> Person:
    """Draw person `number` of a configuration: a woman or a man with normally distributed hand length and breadth."""
    random = open_stream(make_seed(config, "person", number), "person")
    lengths, breadths = WOMEN if random.uniform() < 0.5 else MEN
    first, other = random.normal(), random.normal()
    second = _CORRELATION * first + np.sqrt(1.0 - _CORRELATION**2) * other
    one, two = np.clip([first, second], -_MAX_SCORE, _MAX_SCORE).tolist()
    size = HandSize(round(lengths[0] + one * lengths[1], 4), round(breadths[0] + two * breadths[1], 4))
    return Person(f"generated-person-{number:05d}", size, SKIN_COLORS[random.integer(len(SKIN_COLORS))])


class ArrayBatch:
    """Base class of dataclasses of n items: n is the length of all fields, and indexing by an array selects items."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: npt.NDArray[np.integer | np.bool_]) -> "Self":
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Palms(ArrayBatch):
    """Poses of n palms in the object's frame.

    Attributes:
        position: (n, 3) positions (m).
        rotation: (n, 3, 3) rotation matrices.
    """

    position: Array
    rotation: Array

    def transform(self, points: npt.NDArray[np.floating]) -> Array:
        """Transform points (n, ..., 3) in m, given in the frame of each of the n palms, to the object's frame."""
        count = math.prod(points.shape[1:-1])  # -1 is not allowed where there are no palms
        flat = points.reshape(len(points), count, 3) @ self.rotation.swapaxes(1, 2) + self.position[:, None]
        return np.asarray(flat.reshape(points.shape))


@dataclass(frozen=True, eq=False)
class Posture(ArrayBatch):
    """Finger postures of n right hands.

    Attributes:
        bends: (n, 5, 3) flexion (rad) of the digits' joints, in the order of `hand_model.DIGIT_ORDER`.
        spread: (n, 4) abduction (rad) of the fingers at the knuckles, towards the thumb.
        thumb_root: (n, 3, 3) rotation of the thumb's root before flexion.
        thumb_axis: (n, 3) unit axis of the thumb's flexion in the palm's frame.
    """

    bends: Array
    spread: Array
    thumb_root: Array
    thumb_axis: Array

    def compute_joint_angles(self) -> Array:
        """Return the finger joint angles (n, 45) of the postures: intrinsic XYZ Euler angles (rad) of 15 joints."""
        angles = np.zeros((len(self), 5, 3, 3))
        angles[..., 2] = self.bends
        angles[:, :THUMB, 0, 1] = self.spread
        bends = self.bends[:, THUMB]
        local = np.einsum("nji,nj->ni", self.thumb_root, self.thumb_axis)
        root = Rotation.from_rotvec(self.thumb_axis * bends[:, :1]).as_matrix() @ self.thumb_root
        angles[:, THUMB, 0] = euler_from_matrices(root)
        for joint in (1, 2):
            turns = Rotation.from_rotvec(local * bends[:, joint : joint + 1])
            angles[:, THUMB, joint] = euler_from_matrices(turns.as_matrix())
        return angles.reshape(-1, 45)


def _place_spheres(hand: HandGeometry, capsules: Sequence[Capsule], count: int) -> Spheres:
    """Return spheres in tapered capsules of the reference hand, `count` in each, scaled to the right hand `hand`."""
    t, across = np.linspace(0.0, 1.0, count)[:, None], float(hand.scale[1])
    scaled = [(a * hand.scale, b * hand.scale, r0 * across, r1 * across) for a, b, r0, r1 in capsules]
    centers = [start + t * (end - start) for start, end, _, _ in scaled]
    radii = [first + t[:, 0] * (last - first) for _, _, first, last in scaled]
    return np.vstack(centers), np.concatenate(radii)


def _list_palm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return capsules that approximate the reference hand's palm, in the palm's frame, given any right hand."""
    index, middle, little, ring, thumb = hand.joint_origins[::3] / hand.scale
    drop, wrist = np.array([0.0, -0.004, 0.0]), 0.0155
    return [
        (np.array([-0.012, -0.002, 0.013]), index + drop, wrist, 0.0128),
        (np.array([-0.012, -0.002, 0.005]), middle + drop, wrist, 0.0130),
        (np.array([-0.012, -0.002, -0.005]), ring + drop, wrist, 0.0125),
        (np.array([-0.012, -0.003, -0.012]), little + drop / 2, wrist, 0.0118),
        (thumb + np.array([0.004, 0.0, -0.006]), thumb + np.array([-0.024, -0.006, 0.004]), 0.0150, 0.0125),
        (np.array([-0.022, -0.008, -0.019]), little + np.array([0.022, -0.006, 0.002]), 0.0135, 0.0115),
    ]


def place_digits(model: HandGeometry, posture: Posture, bends: Array) -> Array:
    """Return the centers (n, s, 5, 9, 3) of the digits' spheres in the palm's frame (m), three per phalanx.

    The hands have the n postures, but s flexions each: `bends` (n, s, 5, 3) in rad replace `posture.bends`.
    """
    n, count = bends.shape[:2]
    bent = replace(posture[np.repeat(np.arange(n), count)], bends=bends.reshape(-1, 5, 3))
    positions, rotations = _compute_link_poses(model, bent)
    ends = np.einsum("nlij,lj->nli", rotations[:, 1:], model.tips)
    centers = positions[:, 1:, None] + _SHARES[:, None] * ends[:, :, None]
    return np.asarray(centers.reshape(n, count, 5, 9, 3))


def _compute_link_poses(model: HandGeometry, posture: Posture) -> tuple[Array, Array]:
    """Return positions (n, 16, 3) in m and rotations (n, 16, 3, 3) of palm and phalanges in the palm's frame."""
    dof = np.concatenate([np.zeros((len(posture), 6)), posture.compute_joint_angles()], axis=1)
    dof[:, :3] = -model.palm_offset
    return model.compute_link_poses(dof)


@dataclass(frozen=True, eq=False)
class Openings(ArrayBatch):
    """Open hand postures and their gaps, from the thumb to the middle of index and middle finger, in the palm's frame.

    Attributes:
        posture: n open postures of a hand.
        center: (n, 3) centers of the gaps (m).
        axis: (n, 3) unit vectors from the thumb's pad to the fingers' pads.
        width: (n,) widths of the gaps (m).
        facing: (n,) mean cosines between the normals of the index and middle fingers' pads and the thumb's direction.
    """

    posture: Posture
    center: Array
    axis: Array
    width: Array
    facing: Array


def _measure_openings(model: HandGeometry, posture: Posture) -> Openings:
    """Return the gaps between thumb and fingers in n postures of a hand."""
    positions, rotations = _compute_link_poses(model, posture)
    # The last phalanges of index finger, middle finger and thumb; links begin with the palm.
    last = np.array([2, 5, 14])
    ends = positions[:, last + 1] + np.einsum("nlij,lj->nli", rotations[:, last + 1], model.tips[last])
    thumb, fingers = ends[:, 2], (ends[:, 0] + ends[:, 1]) / 2
    distance = np.linalg.norm(fingers - thumb, axis=1)
    axis = (fingers - thumb) / distance[:, None]
    width = distance - model.radii[14, 1] - model.radii[2, 1]
    facing = np.einsum("ni,ni->n", (rotations[:, 3, :, 1] + rotations[:, 6, :, 1]) / 2, axis)
    return Openings(posture, (thumb + fingers) / 2, axis, width, facing)


@lru_cache(maxsize=2)
def _sample_openings(count: int) -> Openings:
    """Sample up to `count` open postures of the reference hand whose gaps have evenly spread widths."""
    random, n, hand = RandomStream(_SEED), _N_DRAWS, scale_hand(REFERENCE_SIZE, "right")
    weights = -np.log(random.uniforms(n, 3))
    root, middle = 0.05 + (1.15 - 0.05) * random.uniforms(n), 0.08 + (1.0 - 0.08) * random.uniforms(n)
    one_finger = np.stack([root, middle, 0.5 * middle], axis=1)
    fingers = one_finger[:, None] + 0.04 * random.normals(n, 4, 1) * [1.0, 1.0, 0.5]
    thumb = np.column_stack([np.zeros(n), 0.4 * random.uniforms(n), 0.5 * random.uniforms(n)])
    bends = np.maximum(np.concatenate([fingers, thumb[:, None]], axis=1), 0.0)
    spread = (-0.05 + (0.12 + 0.05) * random.uniforms(n, 1)) * np.array([1.0, 0.1, -2.0, -0.9])
    direction = normalize(weights @ _THUMB_DIRECTIONS)
    aim = _THUMB_TARGET - hand.joint_origins[12] + 0.015 * random.normals(n, 3)
    roots = compute_shortest_rotations(normalize(hand.tips[12]), direction)
    openings = _measure_openings(hand, Posture(bends, spread, roots, normalize(np.cross(direction, aim))))
    openings = openings[(openings.facing > _MIN_FACING) & (openings.width > _MIN_WIDTH)]
    goals = np.linspace(openings.width.min(), np.quantile(openings.width, 0.999), count)
    nearest = np.abs(openings.width[:, None] - goals).argmin(axis=0)
    return openings[np.unique(nearest)]


def compute_shortest_rotations(source: Array, goal: Array) -> Array:
    """Return the smallest rotations (n, 3, 3) that turn unit vectors `source`, (3,) or (n, 3), to `goal` (n, 3)."""
    source = np.broadcast_to(source, goal.shape)
    axis = np.cross(source, goal)
    sine, cosine = np.linalg.norm(axis, axis=1), np.einsum("ni,ni->n", source, goal)
    # Exactly opposite vectors, whose axis is undefined, do not occur in random samples.
    scaled = axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    return np.asarray(Rotation.from_rotvec(scaled).as_matrix())


@dataclass(frozen=True, eq=False)
class HandTemplates:
    """Open postures of a right hand, sorted by the width of their gap.

    Attributes:
        model: Geometry of the hand.
        palm: Spheres of the palm, in the palm's frame.
        forearm: Spheres of the end of the forearm near the wrist, in the palm's frame.
        openings: K open postures with their gaps.
        bends: (K, S, 5, 3) flexion of the digits' joints in S steps of closing without an object (rad).
        path: (K, S, 5, 9, 3) float32 centers of the phalanges' spheres in these steps, in the palm's frame (m).
        radii: (5, 9) radii of these spheres (m).
    """

    model: HandGeometry
    palm: Spheres
    forearm: Spheres
    openings: Openings
    bends: Array
    path: npt.NDArray[np.float32]
    radii: Array


@lru_cache(maxsize=64)
def make_hand_templates(size: HandSize, count: int = _N_TEMPLATES) -> HandTemplates:
    """Return up to `count` open postures of a right hand of this size, and the paths of its closing fingers; cached."""
    model = scale_hand(size, "right")
    openings = _measure_openings(model, _sample_openings(count).posture)
    openings = openings[np.argsort(openings.width, kind="stable")]
    start = openings.posture.bends[:, None]
    bends = np.maximum(np.minimum(start + np.arange(N_STEPS)[:, None, None] * STEP_ANGLES, LIMITS), start)
    first, last = model.radii[:, :1], model.radii[:, 1:]
    return HandTemplates(
        model=model,
        palm=_place_spheres(model, _list_palm_capsules(model), 6),
        forearm=_place_spheres(model, _FOREARM, 4),
        openings=openings,
        bends=bends,
        path=place_digits(model, openings.posture, bends).astype(np.float32),
        radii=(first + (last - first) * _SHARES).reshape(5, 9),
    )
