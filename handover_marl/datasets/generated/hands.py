"""People that hand over procedural objects, and open postures of hands of their sizes.

The paths of the phalanges while the fingers close freely are computed once for each hand, so that
closing on an object needs few evaluations of the forward kinematics.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.anthropometry import MEN, SKIN_COLORS, WOMEN, HandSize
from handover_marl.assets.hand_model import HandGeometry, scale_hand
from handover_marl.assets.hand_postures import (
    THUMB,
    ArrayBatch,
    HandSpheres,
    OpeningDraws,
    Openings,
    Posture,
    make_reference_openings,
    measure_openings,
)
from handover_marl.datasets.generated.config import GeneratedConfig, make_seed
from handover_marl.datasets.synthetic.random_stream import RandomStream, open_stream
from handover_marl.geometry.poses import compute_cross_products

Array = npt.NDArray[np.float64]

#: Number of steps of the free closing, and flexion in each step of the root, middle and end joint (rad).
N_STEPS: Final = 20
STEP_ANGLES: Final = np.radians(5.0) * np.array([[1.0, 1.0, 0.55]] * 4 + [[0.6, 0.7, 0.9]])
#: Limits of the joints (rad), as `STEP_ANGLES` for the five digits.
LIMITS: Final = np.radians([[85.0, 100.0, 65.0]] * 4 + [[45.0, 55.0, 70.0]])

_SEED, _N_DRAWS, _N_TEMPLATES = 1010, 3000, 48
# Correlation of length and breadth of a hand, and largest standard score.
_CORRELATION, _MAX_SCORE = 0.6, 2.0


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
    """Draw the person of a number: a woman or a man with normally distributed hand length and breadth."""
    random = open_stream(make_seed(config, "person", number), "person")
    lengths, breadths = WOMEN if random.uniform() < 0.5 else MEN
    first, other = random.normal(), random.normal()
    second = _CORRELATION * first + np.sqrt(1.0 - _CORRELATION**2) * other
    one, two = np.clip([first, second], -_MAX_SCORE, _MAX_SCORE).tolist()
    size = HandSize(round(lengths[0] + one * lengths[1], 4), round(breadths[0] + two * breadths[1], 4))
    return Person(f"generated-person-{number:05d}", size, SKIN_COLORS[random.integer(len(SKIN_COLORS))])


@dataclass(frozen=True, eq=False)
class DigitPaths(ArrayBatch):
    """Paths of the digits' spheres under flexion, in the palm's frame, for n open postures.

    All joints of a digit turn about one axis, so that a point is `fixed + cos(a) cosine + sin(a) sine` for the sum
    a of the flexions up to its phalanx. The fourth point of a phalanx is the next joint.

    Attributes:
        root: (n, 5, 3) positions of the root joints (m).
        fixed: (n, 5, 3, 4, 3) parts of the points along the axis (m), relative to the phalanx' joint.
        cosine: (n, 5, 3, 4, 3) parts across the axis at angle zero (m).
        sine: (n, 5, 3, 4, 3) parts across the axis at a right angle (m).
    """

    root: Array
    fixed: Array
    cosine: Array
    sine: Array

    def place(self, bends: Array) -> Array:
        """Return the centers (n, s, 5, 9, 3) (m) of the spheres for s flexions (n, s, 5, 3) (rad) of each posture."""
        angles = np.cumsum(bends, axis=-1)[..., None, None]
        points = self.fixed[:, None] + np.cos(angles) * self.cosine[:, None] + np.sin(angles) * self.sine[:, None]
        joints = np.cumsum(points[..., :2, 3, :], axis=-2)
        points[..., 1:, :3, :] += joints[..., None, :]
        centers = points[..., :3, :] + self.root[:, None, :, None, None]
        return np.asarray(centers.reshape(*bends.shape[:2], 5, 9, 3))


def make_digit_paths(spheres: HandSpheres, posture: Posture) -> DigitPaths:
    """Return the paths of the spheres of a hand for n open postures."""
    n, model = len(posture), spheres.model
    axes, roots = np.zeros((n, 5, 3)), np.zeros((n, 5, 3, 3))
    sin, cos = np.sin(posture.spread), np.cos(posture.spread)
    axes[:, :THUMB, 0], axes[:, :THUMB, 2], axes[:, THUMB] = sin, cos, posture.thumb_axis
    roots[:, :THUMB, 0, 0], roots[:, :THUMB, 0, 2] = cos, sin
    roots[:, :THUMB, 2, 0], roots[:, :THUMB, 2, 2] = -sin, cos
    roots[:, :THUMB, 1, 1], roots[:, THUMB] = 1.0, posture.thumb_root
    origins = model.joint_origins.reshape(5, 3, 3)
    points = np.zeros((5, 3, 4, 3))
    points[:, :, :3], points[:, :2, 3] = spheres.along.reshape(5, 3, 3, 3), origins[:, 1:]
    straight = np.einsum("ndij,dpvj->ndpvi", roots, points)
    axes = axes[:, :, None, None]
    fixed = (straight * axes).sum(axis=-1, keepdims=True) * axes
    return DigitPaths(
        root=np.broadcast_to(origins[:, 0], (n, 5, 3)),
        fixed=fixed,
        cosine=straight - fixed,
        sine=compute_cross_products(np.broadcast_to(axes, straight.shape), straight),
    )


@dataclass(frozen=True, eq=False)
class HandTemplates:
    """Open postures of a right hand, sorted by the width of their gap.

    Attributes:
        model: Geometry of the hand.
        spheres: Spheres that approximate the hand.
        openings: K open postures with their gaps.
        bends: (K, S, 5, 3) flexion of the digits' joints in S steps of closing without an object (rad).
        digits: Paths of the K postures' digits under flexion.
        path: (K, S, 5, 9, 3) centers of the phalanges' spheres in these steps, in the palm's frame (m).
        radii: (5, 9) radii of these spheres (m).
    """

    model: HandGeometry
    spheres: HandSpheres
    openings: Openings
    bends: Array
    digits: DigitPaths
    path: npt.NDArray[np.float32]
    radii: Array

    def get_path(self, rows: npt.NDArray[np.int64]) -> Array:
        """Return the spheres' centers (n, S, 5, 9, 3) while n postures close, in the palm's frame (m)."""
        return self.path[rows].astype(np.float64)

    def get_open_hands(self, rows: npt.NDArray[np.int64]) -> Array:
        """Return the spheres' centers (n, 5, 9, 3) of some open postures, in the palm's frame (m)."""
        return np.asarray(self.path[rows, 0], dtype=np.float64)

    def get_open_spheres(
        self, rows: npt.NDArray[np.int64], digits: npt.NDArray[np.int64], spheres: npt.NDArray[np.int64]
    ) -> Array:
        """Return the centers (n, k, 3) of k spheres, given by digit and number, of n open postures (m)."""
        return np.asarray(self.path[rows[:, None], 0, digits, spheres], dtype=np.float64)


@lru_cache(maxsize=2)
def _sample_openings(count: int) -> Openings:
    """Sample up to `count` open postures of the reference hand whose gaps have evenly spread widths."""
    random, n = RandomStream(_SEED), _N_DRAWS
    weights = -np.log(random.uniforms(n, 3))
    openings = make_reference_openings(
        OpeningDraws(
            root=random.uniforms(n),
            middle=random.uniforms(n),
            fingers=random.normals(n, 4, 1),
            thumb_middle=random.uniforms(n),
            thumb_end=random.uniforms(n),
            spread=random.uniforms(n, 1),
            thumb_direction=weights / weights.sum(axis=1, keepdims=True),
            thumb_target=random.normals(n, 3),
        )
    )
    goals = np.linspace(openings.width.min(), np.quantile(openings.width, 0.999), count)
    nearest = np.abs(openings.width[:, None] - goals).argmin(axis=0)
    return openings[np.unique(nearest)]


@lru_cache(maxsize=64)
def make_hand_templates(size: HandSize, count: int = _N_TEMPLATES) -> HandTemplates:
    """Return up to `count` open postures of a right hand of some size and their closing; cached."""
    model = scale_hand(size, "right")
    spheres = HandSpheres(model)
    openings = measure_openings(model, _sample_openings(count).posture)
    openings = openings[np.argsort(openings.width, kind="stable")]
    steps = np.arange(N_STEPS)[:, None, None] * STEP_ANGLES
    bends = np.maximum(np.minimum(openings.posture.bends[:, None] + steps, LIMITS), openings.posture.bends[:, None])
    digits = make_digit_paths(spheres, openings.posture)
    path = digits.place(bends).astype(np.float32)
    return HandTemplates(model, spheres, openings, bends, digits, path, spheres.radii.reshape(5, 9))
