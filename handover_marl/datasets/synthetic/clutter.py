"""Other objects on the table, clear of the hand and the handed-over object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import HandGeometry
from handover_marl.datasets.synthetic import calibration
from handover_marl.datasets.synthetic.handover_motion import KeyframeMotion
from handover_marl.datasets.synthetic.object_placement import OBJECT_CLEARANCE, compute_hull_corners, resting_rotation
from handover_marl.datasets.synthetic.random_stream import RandomStream
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
    return ClutterItem(class_id, compute_hull_corners(CLASS_NAMES[class_id]), calibration.UP_AXES[class_id])


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

    Args:
        random: Random stream of the scene's other objects.
        counts: Numbers of objects, all equally likely; there can be fewer where there is no space.
        draw_item: Function that draws an object.
        corners: (n, 3) corners of the handed-over object's hull in its frame (m).
        motion: Keyframes of the handed-over object and of the hand.
        model: Geometry of the subject's hand.
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
        is_repeated = item.class_id in {other.class_id for other in placed}
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
    radius = float(np.linalg.norm(corners[:, :2] - middle[:2], axis=1).max())
    position = np.array([x - middle[0], y - middle[1], OBJECT_CLEARANCE - low[2]])
    return ClutterObject(item.class_id, position, rotation), _Cylinder(x, y, radius, float(high[2] - low[2]))


def _compute_swept_points(corners: Array, motion: KeyframeMotion, model: HandGeometry) -> Array:
    """Return the hand's joints and the handed-over object's corners (n, 3) of all keyframes."""
    moves = np.concatenate([[True], (np.diff(motion.object_position, axis=0) != 0.0).any(axis=1)])
    rotation = motion.object_rotation.as_matrix()[moves]
    object_points = corners @ rotation.swapaxes(1, 2) + motion.object_position[moves, None]
    angles = motion.base_rotation.as_euler("XYZ")
    dof = np.concatenate([motion.base_position, angles, motion.fingers], axis=1)[motion.hand_first :]
    return np.concatenate([object_points.reshape(-1, 3), model.compute_keypoints(dof).reshape(-1, 3)])


def _is_free(cylinder: _Cylinder, points: Array, others: list[_Cylinder]) -> bool:
    low = points[points[:, 2] < cylinder.height + CLUTTER_CLEARANCE]
    clear = np.hypot(low[:, 0] - cylinder.x, low[:, 1] - cylinder.y) > cylinder.radius + CLUTTER_CLEARANCE
    apart = all(
        np.hypot(other.x - cylinder.x, other.y - cylinder.y) > other.radius + cylinder.radius for other in others
    )
    return bool(clear.all()) and apart
