"""Other objects on the table, clear of the hand and the handed-over object."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import HandGeometry
from handover_marl.datasets.synthetic.handover_motion import KeyframeMotion
from handover_marl.datasets.synthetic.object_placement import OBJECT_CLEARANCE, compute_hull_corners, resting_rotation
from handover_marl.datasets.synthetic.random_stream import UP_AXES, RandomStream
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

#: Smallest distance (m) to the joints of the hand, which is about 2 cm thick, and to the corners of
#: the handed-over object.
CLUTTER_CLEARANCE = 0.025

# Range (m) of the objects' centers in the table's frame.
_X_RANGE, _Y_RANGE = (0.15, 0.95), (0.02, 0.55)
_MAX_TRIES = 200


@dataclass(frozen=True, eq=False)
class ClutterItem:
    """Object that can be placed on the table.

    Attributes:
        class_id: Class number.
        corners: (n, 3) corners of the hull in the object's frame (m).
        up_axes: Weights of the axes that point up: +x, -x, +y, -y, +z, -z.
    """

    class_id: int
    corners: Array
    up_axes: Sequence[float]


def make_ycb_clutter_item(class_id: int) -> ClutterItem:
    """Return an object of a YCB class to be placed on the table."""
    return ClutterItem(class_id, compute_hull_corners(CLASS_NAMES[class_id]), UP_AXES[class_id])


@dataclass(frozen=True, eq=False)
class ClutterObject:
    """Object that stays on the table during the handover.

    Attributes:
        class_id: Class number.
        position: (3,) position in the table's frame (m).
        rotation: (3, 3) rotation matrix in the table's frame.
    """

    class_id: int
    position: Array
    rotation: Array


@dataclass(frozen=True)
class _Cylinder:
    """Upright bounding cylinder of an object: center (x, y), radius and height (m)."""

    x: float
    y: float
    radius: float
    height: float


def draw_clutter(
    random: RandomStream,
    counts: range,
    draw_item: Callable[[RandomStream], ClutterItem],
    corners: Array,
    motion: KeyframeMotion,
    model: HandGeometry,
) -> tuple[ClutterObject, ...]:
    """Draw the objects on the table that are not handed over in a scene, all of different classes.

    All of the given numbers of objects are equally likely; there can be fewer where there is no space. They keep
    clear of the handed-over object, with corners (n, 3) of its hull in its frame (m), and of the hand.
    """
    count = counts[random.integer(len(counts))]
    points = _compute_swept_points(corners, motion, model)
    placed: list[ClutterObject] = []
    cylinders: list[_Cylinder] = []
    for _ in range(_MAX_TRIES):
        if len(placed) == count:
            break
        item = draw_item(random)
        candidate, cylinder = _draw_object(random, item)
        is_repeated = item.class_id in [other.class_id for other in placed]
        if is_repeated or not _is_free(cylinder, points, cylinders):
            continue
        placed.append(candidate)
        cylinders.append(cylinder)
    return tuple(placed)


def _draw_object(random: RandomStream, item: ClutterItem) -> tuple[ClutterObject, _Cylinder]:
    axis = random.weighted_index(item.up_axes)
    rotation = resting_rotation(axis, random.uniform(0.0, 2.0 * np.pi))
    corners = item.corners @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = 0.5 * (low + high)
    x, y = random.uniform(*_X_RANGE), random.uniform(*_Y_RANGE)
    across = corners[:, :2] - middle[:2]
    radius = float(np.sqrt((across * across).sum(axis=1).max()))
    position = np.array([x - middle[0], y - middle[1], OBJECT_CLEARANCE - low[2]])
    return ClutterObject(item.class_id, position, rotation), _Cylinder(x, y, radius, float(high[2] - low[2]))


def _compute_swept_points(corners: Array, motion: KeyframeMotion, model: HandGeometry) -> Array:
    """Return the coordinates (3, n) of the hand's joints and the handed-over object's corners in all keyframes."""
    positions, rotations = motion.object_position, motion.object_rotation.as_matrix()
    moves = np.concatenate([[True], (positions[1:] != positions[:-1]).any(axis=1)])
    shown = slice(motion.hand_first, None)
    # Keypoints of each finger posture with the base at the origin.
    fingers = motion.fingers[shown]
    changes = np.concatenate([[True], (fingers[1:] != fingers[:-1]).any(axis=1)])
    dof = np.concatenate([np.zeros((np.count_nonzero(changes), 6)), fingers[changes]], axis=1)
    keypoints = model.compute_keypoints(dof)[np.cumsum(changes) - 1]
    hand = keypoints @ motion.base_rotation.as_matrix()[shown].swapaxes(1, 2) + motion.base_position[shown, None]
    return np.stack(
        [
            np.concatenate(
                [(corners @ rotations[moves, axis].T + positions[moves, axis]).ravel(), hand[..., axis].ravel()]
            )
            for axis in range(3)
        ]
    )


def _is_free(cylinder: _Cylinder, points: Array, others: list[_Cylinder]) -> bool:
    if any(
        math.hypot(other.x - cylinder.x, other.y - cylinder.y) <= other.radius + cylinder.radius for other in others
    ):
        return False
    x, y, z = points
    near = (x - cylinder.x) ** 2 + (y - cylinder.y) ** 2 <= (cylinder.radius + CLUTTER_CLEARANCE) ** 2
    return not (near & (z < cylinder.height + CLUTTER_CLEARANCE)).any()
