"""Checks of the motion of a custom scene: bodies that jump, are far away, or are below the table."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG, TABLE_HEIGHT
from handover_marl.errors import DataFormatError
from handover_marl.geometry.poses import transform_points
from handover_marl.geometry.rotations import compute_rotation_angles, quaternions_from_euler

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Smallest and largest duration of a motion (s).
DURATION = (0.5, 60.0)
#: Largest finger joint angle (rad).
MAX_FINGER_ANGLE: Final = 2.0 * np.pi
# Largest distance of bodies from the origin of the world, on the floor below the table (m).
_MAX_DISTANCE = 3.0
# Largest speeds of bodies (m/s, rad/s).
_MAX_SPEED, _MAX_TURN_SPEED = 12.0, 90.0
_MAX_REACH = 1.2  # m from the robot's base, where the handed-over object ends; the Panda reaches 0.855 m
_MAX_SINK = 0.03  # m below the table's surface
_MAX_START = 0.05  # m above what the handed-over object stands on
_MAX_GRIP = 0.2  # m between the base of a hand and the nearest vertex of an object that it holds
_MAX_HAND_DISTANCE = 1.0  # m, the smallest in a scene, between the hand's base and the handed-over object
_UNIT_ADVICE = (
    "remove lost tracks, or pass the units (length='mm', time='ms'; in a file of Motive, correct its first line) or "
    "the frame"
)
_FRAME_ADVICE = "check frame: 'world' has its origin 0.92 m below the table's surface, 'table' on it; z points up"


def check_objects(objects: Float32, bodies: Mapping[str, Array]) -> None:
    """Raise `DataFormatError` if an object's motion has a wrong duration, jumps, is far away or starts below the table.

    `objects` (T, n, 6) has positions (m) and intrinsic XYZ Euler angles (rad) in the world frame at 1 kHz. `bodies` has
    the vertices (v, 3) of the objects by name, in the same order and in the object's frame (m). The first object is
    handed over; at the end it must be above the table and in the robot's reach.
    """
    low, high = DURATION
    if not low <= (len(objects) - 1) / 1000.0 <= high + 1e-3:
        raise DataFormatError(f"a motion must last {low} to {high:g} s, got {len(objects) - 1} ms")
    for number, (name, vertices) in enumerate(bodies.items()):
        poses = _check_body(name, objects[:, number])
        _check_above_table(f"{name} must start", poses[0], vertices)
        if number == 0:
            base = np.array(OFFICIAL_CONFIG.physics.panda.base_position)
            distance = float(np.linalg.norm(poses[-1, :3] - base))
            if distance > _MAX_REACH:
                raise DataFormatError(
                    f"{name} must end within {_MAX_REACH} m of the robot's base, got {distance:.2f} m; {_FRAME_ADVICE}"
                )
            _check_above_table(f"{name} must end", poses[-1], vertices)


def check_motion(
    objects: Float32, hand: Float32, first: int | None, last: int | None, bodies: Mapping[str, Array]
) -> None:
    """Raise `DataFormatError` if the motion of the objects (see `check_objects`) or of the hand is faulty.

    The handed-over object must start on the table, on another object or in the hand. `hand` (T, 51) is as in
    `Scene.hand_dof`. From frame `first` to frame `last` (None without a hand), the hand must come within 1 m of the
    object, must not jump, and no finger angle may exceed `MAX_FINGER_ANGLE`.
    """
    check_objects(objects, bodies)
    vertices, *others = (
        transform_points(_read_poses(dof)[0], body)
        for dof, body in zip(objects[:1].swapaxes(0, 1), bodies.values(), strict=True)
    )
    lowest = float(vertices[:, 2].min())
    gaps = [lowest - TABLE_HEIGHT, *(abs(lowest - float(other[:, 2].max())) for other in others)]
    is_held = first == 0 and float(np.linalg.norm(vertices - hand[0, :3], axis=1).min()) <= _MAX_GRIP
    if min(gaps) > _MAX_START and not is_held:
        raise DataFormatError(
            f"the handed-over object must start on the table, on another object or in the hand, got its lowest point "
            f"{100 * gaps[0]:.0f} cm above the table; {_FRAME_ADVICE}"
        )
    if first is None or last is None:
        return
    shown = slice(first, last + 1)
    base = _check_body("the hand", hand[shown, :6])
    fingers = float(np.abs(hand[shown, 6:]).max())
    if fingers > MAX_FINGER_ANGLE:
        raise DataFormatError(f"finger angles must be at most {MAX_FINGER_ANGLE:.3f} rad, got {fingers:.4g}")
    nearest = float(np.linalg.norm(base[:, :3] - objects[shown, 0, :3], axis=1).min())
    if nearest > _MAX_HAND_DISTANCE:
        raise DataFormatError(
            f"the hand must come within {_MAX_HAND_DISTANCE:g} m of the object, got {nearest:.3g} m; check its frame"
        )


def _read_poses(dof: Float32) -> Array:
    """Return poses (T, 7), xyz (m) and xyzw, for positions (m) and intrinsic XYZ Euler angles (rad), (T, 6)."""
    values = dof.astype(np.float64)
    return np.concatenate([values[:, :3], quaternions_from_euler(values[:, 3:])], axis=1)


def _check_body(name: str, dof: Float32) -> Array:
    """Return the poses (T, 7) of a body with motion (T, 6); raise `DataFormatError` if it is far away or jumps."""
    poses = _read_poses(dof)
    distance = float(np.linalg.norm(poses[:, :3], axis=1).max())
    if distance > _MAX_DISTANCE:
        raise DataFormatError(
            f"{name} must be within {_MAX_DISTANCE:g} m of the world's origin, got {distance:.4g} m; {_UNIT_ADVICE}"
        )
    speeds = 1000.0 * np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    turns = 1000.0 * compute_rotation_angles(poses[1:, 3:], poses[:-1, 3:])
    for found, limit, unit in ((speeds, _MAX_SPEED, "m/s"), (turns, _MAX_TURN_SPEED, "rad/s")):
        if len(found) and found.max() > limit:
            raise DataFormatError(
                f"{name} must not jump, got {found.max():.3g} {unit} in frame {np.argmax(found) + 1}; {_UNIT_ADVICE}"
            )
    return poses


def _check_above_table(what: str, pose: Array, vertices: Array) -> None:
    lowest = float(transform_points(pose, vertices)[:, 2].min()) - TABLE_HEIGHT
    if lowest < -_MAX_SINK:
        raise DataFormatError(
            f"{what} above the table, got its lowest point {-100 * lowest:.0f} cm below the surface; {_FRAME_ADVICE}"
        )
