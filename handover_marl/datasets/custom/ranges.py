"""Valid ranges of the values in a folder of custom scenes, checked when something is added."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG, TABLE_HEIGHT
from handover_marl.geometry.poses import quaternions_from_euler, transform_points

Array = npt.NDArray[np.float64]

#: Masses (kg) and lateral friction of objects.
MASS, FRICTION = (1e-3, 20.0), (0.0, 10.0)
#: Largest extent of an object, and distance of its centre from the origin of its frame (m).
EXTENT, MAX_OFFSET = (0.005, 0.7), 0.7
#: Duration of a motion (s).
DURATION = (0.5, 60.0)
#: Distance of bodies from the origin of the world, on the floor below the table (m).
MAX_DISTANCE = 3.0
#: Speeds of recorded poses (m/s, rad/s).
MAX_SPEED, MAX_TURN_SPEED = 8.0, 60.0
#: Finger joint angles (rad).
MAX_FINGER_ANGLE: Final = 2.0 * np.pi
#: Deviation of the norm of quaternions from 1.
MAX_NORM_ERROR = 0.02
_MAX_REACH = 1.2  # m from the robot's base, where the handed-over object ends; the Panda reaches 0.855 m
_MAX_SINK = 0.03  # m below the table's surface
_MAX_HAND_DISTANCE = 1.0  # m, the smallest in a scene, between the hand's base and the handed-over object
_FRAME_ADVICE = "check frame: 'world' has its origin 0.92 m below the table's surface, 'table' on it; z points up"


def check_objects(objects: npt.NDArray[np.floating], bodies: Mapping[str, Array]) -> None:
    """Check the motion (T, n, 6) of the objects of a scene at 1 kHz in the world frame (m, rad).

    `bodies` are the vertices (v, 3) of the objects in their frames (m) by name, the handed-over one first.

    Raises:
        ValueError: An object is below the table or out of reach.
    """
    for number, (name, vertices) in enumerate(bodies.items()):
        ends = objects[[0, -1], number].astype(np.float64)
        poses = np.concatenate([ends[:, :3], quaternions_from_euler(ends[:, 3:])], axis=1)
        _check_above_table(f"{name} must start", poses[0], vertices)
        if number == 0:
            base = np.array(OFFICIAL_CONFIG.physics.panda.base_position)
            distance = float(np.linalg.norm(poses[-1, :3] - base))
            if distance > _MAX_REACH:
                raise ValueError(
                    f"{name} must end within {_MAX_REACH} m of the robot's base, got {distance:.2f} m; {_FRAME_ADVICE}"
                )
            _check_above_table(f"{name} must end", poses[-1], vertices)


def check_hand(hand: npt.NDArray[np.floating], objects: npt.NDArray[np.floating]) -> None:
    """Check the motion (t, 51) of a hand near objects (t, n, 6), the handed-over one first, in the world frame.

    Raises:
        ValueError: The hand is never near the object.
    """
    nearest = float(np.linalg.norm(hand[:, :3] - objects[:, 0, :3], axis=1).min())
    if nearest > _MAX_HAND_DISTANCE:
        raise ValueError(
            f"the hand must come within {_MAX_HAND_DISTANCE:g} m of the object, got {nearest:.3g} m; check its frame"
        )


def _check_above_table(what: str, pose: Array, vertices: Array) -> None:
    lowest = float(transform_points(pose, vertices)[:, 2].min()) - TABLE_HEIGHT
    if lowest < -_MAX_SINK:
        raise ValueError(
            f"{what} above the table, got its lowest point {-100 * lowest:.0f} cm below the surface; {_FRAME_ADVICE}"
        )
