"""Valid ranges of the values in a folder of custom scenes, checked when something is added and when it is read."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG, TABLE_HEIGHT
from handover_marl.errors import DataFormatError
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import compute_rotation_angles, quaternions_from_euler, transform_points

Array = npt.NDArray[np.float64]

#: Masses (kg) and lateral friction of objects.
MASS, FRICTION = (1e-3, 20.0), (0.0, 10.0)
#: Largest extent of an object, and distance of its centre from the origin of its frame (m).
EXTENT, MAX_OFFSET = (0.005, 0.7), 0.7
#: Duration of a motion (s).
DURATION = (0.5, 60.0)
#: Distance of bodies from the origin of the world, on the floor below the table (m).
MAX_DISTANCE = 3.0
#: Speeds of bodies (m/s, rad/s).
MAX_SPEED, MAX_TURN_SPEED = 12.0, 90.0
#: Finger joint angles (rad).
MAX_FINGER_ANGLE: Final = 2.0 * np.pi
_MAX_ANGLE = 1000.0  # rad; angles are unwrapped
_MAX_REACH = 1.2  # m from the robot's base, where the handed-over object ends; the Panda reaches 0.855 m
_MAX_SINK = 0.03  # m below the table's surface
_MAX_HAND_DISTANCE = 1.0  # m, the smallest in a scene, between the hand's base and the handed-over object
_MAX_GRASP_DISTANCE = 0.05  # m between the fingertips and the box around the object
_MAX_ROTATION_ERROR = 1e-3
_UNIT_ADVICE = "remove lost tracks, or pass the units (length='mm', time='ms') or the frame"
_FRAME_ADVICE = "check frame: 'world' has its origin 0.92 m below the table's surface, 'table' on it; z points up"


def check_vertices(vertices: Array) -> None:
    """Check the size and the place of an object by the vertices (v, 3) in its frame (m).

    Raises:
        DataFormatError: The object is too large, too small, or too far from the origin of its frame.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent, offset = float((high - low).max()), float(np.linalg.norm(low + high)) / 2.0
    # Convex parts may stand out a little.
    if not 0.9 * EXTENT[0] <= extent <= 1.1 * EXTENT[1]:
        raise DataFormatError(f"the largest extent must be {EXTENT[0]} to {EXTENT[1]} m, got {extent:.3g} m")
    if offset > 1.1 * MAX_OFFSET:
        raise DataFormatError(f"the body must be within {MAX_OFFSET} m of its frame's origin, got {offset:.3g} m")


def check_grasps(grasps: Array, vertices: Array) -> None:
    """Check robot grasps of an object.

    Args:
        grasps: (n, 4, 4) gripper poses in the object's frame (m).
        vertices: (v, 3) vertices of the object in its frame (m).

    Raises:
        DataFormatError: A grasp is no pose, or its fingertips are not at the object.
    """
    if grasps.ndim != 3 or grasps.shape[1:] != (4, 4) or not np.isfinite(grasps).all():
        raise DataFormatError(f"grasps must be finite numbers of shape (n, 4, 4), got shape {grasps.shape}")
    rotations = grasps[:, :3, :3]
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_pose = (errors < _MAX_ROTATION_ERROR) & (np.linalg.det(rotations) > 0.0)
    is_pose &= np.abs(grasps[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < _MAX_ROTATION_ERROR
    if not is_pose.all():
        raise DataFormatError(f"grasps must be poses, got a matrix without a rotation in grasp {np.argmin(is_pose)}")
    tips = grasps[:, :3, 3] + rotations @ FINGERTIPS
    outside = np.maximum(vertices.min(axis=0) - tips, tips - vertices.max(axis=0))
    distances = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    if len(grasps) and distances.max() > _MAX_GRASP_DISTANCE:
        raise DataFormatError(
            f"fingertips must be within {_MAX_GRASP_DISTANCE} m of the object, got {distances.max():.3g} m in grasp "
            f"{np.argmax(distances)}"
        )


def check_objects(objects: npt.NDArray[np.floating], bodies: Mapping[str, Array]) -> None:
    """Check the motion of the objects of a scene.

    Args:
        objects: (T, n, 6) positions (m) and intrinsic XYZ Euler angles (rad) at 1 kHz in the world frame.
        bodies: Vertices (v, 3) of the n objects in their frames (m) by name, the handed-over one first.

    Raises:
        DataFormatError: An object is below the table, out of reach, far away, or jumps; or the motion is too long or
            too short.
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


def check_hand(hand: npt.NDArray[np.floating], objects: npt.NDArray[np.floating]) -> None:
    """Check the motion of a hand in the frames with the hand.

    Args:
        hand: (t, 51) base position (m) and Euler angles, then finger joint angles (rad), in the world frame.
        objects: (t, n, 6) motion of the objects in these frames, the handed-over one first.

    Raises:
        DataFormatError: The hand is far away, jumps, is never near the object, or a finger angle is out of range.
    """
    base = _check_body("the hand", hand[:, :6])
    fingers = float(np.abs(hand[:, 6:]).max())
    if fingers > MAX_FINGER_ANGLE:
        raise DataFormatError(f"finger angles must be at most {MAX_FINGER_ANGLE:.3f} rad, got {fingers:.4g}")
    nearest = float(np.linalg.norm(base[:, :3] - objects[:, 0, :3], axis=1).min())
    if nearest > _MAX_HAND_DISTANCE:
        raise DataFormatError(
            f"the hand must come within {_MAX_HAND_DISTANCE:g} m of the object, got {nearest:.3g} m; check its frame"
        )


def _check_body(name: str, dof: npt.NDArray[np.floating]) -> Array:
    """Return the poses (T, 7) of a body, checked to be near and not to jump."""
    values = dof.astype(np.float64)
    poses: Array = np.concatenate([values[:, :3], quaternions_from_euler(values[:, 3:])], axis=1)
    distance = float(np.linalg.norm(poses[:, :3], axis=1).max())
    if distance > MAX_DISTANCE:
        raise DataFormatError(
            f"{name} must be within {MAX_DISTANCE:g} m of the world's origin, got {distance:.4g} m; {_UNIT_ADVICE}"
        )
    if np.abs(values[:, 3:]).max() > _MAX_ANGLE:
        raise DataFormatError(f"angles of {name} must be in rad, got {np.abs(values[:, 3:]).max():.4g}")
    speeds = 1000.0 * np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    turns = 1000.0 * compute_rotation_angles(poses[1:, 3:], poses[:-1, 3:])
    for found, limit, unit in ((speeds, MAX_SPEED, "m/s"), (turns, MAX_TURN_SPEED, "rad/s")):
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
