"""The other objects on the table: two to four that neither the hand nor the given object passes through."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import HandModel
from handover_marl.datasets.synthetic import calibration
from handover_marl.datasets.synthetic.draws import Draws
from handover_marl.datasets.synthetic.handing_over import KeyMotion
from handover_marl.datasets.synthetic.outlines import hull_corners
from handover_marl.datasets.synthetic.staging import OBJECT_CLEARANCE, laid
from handover_marl.models.ycb import CLASS_NAMES, SCENE_CLASSES

Array = npt.NDArray[np.float64]

#: Distance (m) kept from the moving points; they are joints of a hand about 2 cm thick and corners of an object.
GAP = 0.025

# Where things stand on the table: the part of it that people use.
_X, _Y = (0.15, 0.95), (0.02, 0.55)
_TRIES = 200


@dataclass(frozen=True, eq=False)
class StandingObject:
    """An object that stays where it is: class number, position (3) (m) and rotation matrix (3, 3)."""

    class_id: int
    position: Array
    rotation: Array


@dataclass(frozen=True)
class _Cylinder:
    """Upright cylinder around an object: centre (x, y), radius, height (m)."""

    x: float
    y: float
    radius: float
    height: float


def draw_clutter(scene_id: int, class_id: int, motion: KeyMotion, model: HandModel) -> tuple[StandingObject, ...]:
    """Draw and place the other objects of a scene."""
    draws = Draws(scene_id, "clutter")
    wanted = 2 + draws.integer(3)
    points = _swept_points(class_id, motion, model)
    placed: list[StandingObject] = []
    taken: list[_Cylinder] = []
    others = [number for number in SCENE_CLASSES if number != class_id]
    for _ in range(_TRIES):
        if len(placed) == wanted:
            break
        number = others[draws.integer(len(others))]
        thing, around = _drawn(draws, number)
        if number in {one.class_id for one in placed} or not _free(around, points, taken):
            continue
        placed.append(thing)
        taken.append(around)
    return tuple(placed)


def _drawn(draws: Draws, class_id: int) -> tuple[StandingObject, _Cylinder]:
    axis = draws.weighted(calibration.UP_AXES[class_id])
    rotation = laid(axis, draws.uniform(0.0, 2.0 * np.pi))
    corners = hull_corners(CLASS_NAMES[class_id]) @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = 0.5 * (low + high)
    x, y = draws.uniform(*_X), draws.uniform(*_Y)
    radius = float(np.linalg.norm(corners[:, :2] - middle[:2], axis=1).max())
    position = np.array([x - middle[0], y - middle[1], OBJECT_CLEARANCE - low[2]])
    return StandingObject(class_id, position, rotation), _Cylinder(x, y, radius, float(high[2] - low[2]))


def _swept_points(class_id: int, motion: KeyMotion, model: HandModel) -> Array:
    """(n, 3) where the hand's joints and the given object's corners are in all frames."""
    corners = hull_corners(CLASS_NAMES[class_id])
    rotation = motion.object_rotation.as_matrix()
    given = np.einsum("tij,pj->tpi", rotation, corners) + motion.object_position[:, None]
    shown = slice(motion.hand_first, None)
    dof = np.concatenate([motion.base_position, motion.base_rotation.as_euler("XYZ"), motion.fingers], axis=1)[shown]
    return np.concatenate([given.reshape(-1, 3), model.keypoints(dof).reshape(-1, 3)])


def _free(around: _Cylinder, points: Array, taken: list[_Cylinder]) -> bool:
    low = points[points[:, 2] < around.height + GAP]
    away = np.hypot(low[:, 0] - around.x, low[:, 1] - around.y) > around.radius + GAP
    apart = all(np.hypot(one.x - around.x, one.y - around.y) > one.radius + around.radius for one in taken)
    return bool(away.all()) and apart
