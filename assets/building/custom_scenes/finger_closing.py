"""Fingers of a shipped hand that close on an object, for recordings of the wrist alone."""

import functools
import hashlib
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.custom_scenes.motion_tables import OBJECT, MotionTable
from handover_marl.assets.building.human_grasps_candidates import (
    GraspTarget,
    make_grasp_target,
    sample_reference_openings,
)
from handover_marl.assets.building.human_grasps_closing import (
    SKIN_YIELD,
    close_fingers,
    compute_body_clearance,
    compute_clearances,
)
from handover_marl.assets.hand_model import Side, make_hand_geometry
from handover_marl.assets.hand_postures import Palms, Posture
from handover_marl.assets.hand_spheres import HandSpheres
from handover_marl.datasets.synthetic.handover_motion import minimum_jerk
from handover_marl.errors import DataFormatError
from handover_marl.geometry.array_cache import get_cache_folder, load_cached_arrays, save_cached_arrays
from handover_marl.geometry.distance_field import DistanceField
from handover_marl.geometry.poses import compose, invert_pose

Array = npt.NDArray[np.float64]

_PICK_UP_DISTANCE = 0.005  # m, as in the giver's motion
_CLOSING_TIME = 0.4  # s
_MIN_TOUCHING = 2  # digits
_MAX_CLOSED = 200  # postures whose fingers are closed
#: Largest distance (m) by which a recorded wrist is moved.
MAX_SHIFT = 0.021
_MAX_PALM_OVERLAP = 0.004  # m
_CACHE_KIND, _DESCRIPTION = "hand-grasps", "data of hand grasps"
# Increased whenever other postures are sampled.
_OPENINGS_VERSION = 1
_MIRROR = np.array([-1.0, 1.0, 1.0])
_MIRRORED_ANGLES = np.tile([1.0, -1.0, -1.0], 15)


def _list_shifts() -> list[Array]:
    """Return translations of the wrist along the fingers and along the palm's normal, the smallest first."""
    steps = np.arange(-4, 5) * 0.005
    shifts = [np.array([along, across, 0.0]) for along in steps for across in steps]
    return sorted((shift for shift in shifts if np.linalg.norm(shift) < MAX_SHIFT), key=np.linalg.norm)


_SHIFTS = _list_shifts()


def find_pick_up_row(table: MotionTable) -> int:
    """Return the first row in which the object has left its start; the last row if it never does."""
    positions = table.bodies[OBJECT][:, :3]
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > _PICK_UP_DISTANCE)
    return int(moved[0]) if len(moved) else len(positions) - 1


@dataclass(frozen=True, eq=False)
class HandGrasp:
    """Grasp of a shipped hand on an object.

    Attributes:
        opened: (45,) finger joint angles of the open hand (rad).
        closed: (45,) finger joint angles of the hand closed on the object (rad).
        shift: (3,) translation of the wrist in its own frame that puts the open hand outside of the object (m).
    """

    opened: Array
    closed: Array
    shift: Array


def close_hand(table: MotionTable, mesh: trimesh.Trimesh, hand: int, side: Side) -> tuple[MotionTable, Array]:
    """Make finger joint angles of a hand that is open at first and closed when the object is picked up.

    Args:
        table: Recorded poses with a wrist.
        mesh: Surface of the object in its frame (m).
        hand: Number of the shipped hand.
        side: Hand of the giver.

    Returns:
        The recording, with the wrist moved by up to `MAX_SHIFT` where the hand would be inside of the object; and
        finger joint angles (n, 45) in the rows with the wrist (rad).

    Raises:
        DataFormatError: The wrist is not beside the object when it is picked up, or inside of it.
    """
    if table.wrist is None:
        raise DataFormatError("fingers need a wrist; add its poses or pass hand=None")
    first, end = table.wrist_rows
    row = min(max(find_pick_up_row(table), first), end - 1)
    object_from_wrist = compose(invert_pose(table.bodies[OBJECT][row]), table.wrist[row - first])
    grasp = find_hand_grasp(mesh, object_from_wrist, hand, side, f"row {row + 1}")
    if grasp.shift.any():
        wrist = compose(table.wrist, np.array([*grasp.shift, 0.0, 0.0, 0.0, 1.0]))
        distance = 1000.0 * float(np.linalg.norm(grasp.shift))
        note = f"wrist moved by {distance:.0f} mm, so that the hand grasps the object and is not inside of it"
        table = replace(table, wrist=wrist, repairs=(*table.repairs, note))
    start = table.time[row] - _CLOSING_TIME
    progress = minimum_jerk((table.time[first:end] - start) / _CLOSING_TIME)[:, None]
    return table, np.asarray((1.0 - progress) * grasp.opened + progress * grasp.closed)


def find_hand_grasp(mesh: trimesh.Trimesh, object_from_wrist: Array, hand: int, side: Side, place: str) -> HandGrasp:
    """Return the open hand and the hand closed on the object at a pose of the wrist.

    Of many open postures that do not touch the object, the posture is selected whose fingers touch the object most
    when they close. If there is no such posture, the wrist is moved by as little as needed.

    Args:
        mesh: Surface of the object in its frame (m).
        object_from_wrist: (7,) pose of the wrist in the object's frame.
        hand: Number of the shipped hand.
        side: Hand of the giver.
        place: Place in the recording, for errors.

    Raises:
        DataFormatError: The wrist is not beside the object, or inside of it.
    """
    target = _load_target(mesh)
    position, rotation = object_from_wrist[:3], Rotation.from_quat(object_from_wrist[3:]).as_matrix()
    if side == "left":
        # A left hand grasps as a right hand grasps the mirrored object.
        target, position = target.mirror(), position * _MIRROR
        rotation = rotation * np.outer(_MIRROR, _MIRROR)
    spheres = HandSpheres(make_hand_geometry(hand, "right"))
    for shift in _SHIFTS:
        free = _find_free_postures(target, spheres, position + rotation @ shift, rotation)
        if not len(free):
            continue
        angles = _close_best(target, spheres, position + rotation @ shift, rotation, free)
        if angles is None:
            # The hand is not inside of the object but too far from it: moving it would take longer than it is worth.
            break
        opened, closed = angles
        if side == "left":
            return HandGrasp(opened * _MIRRORED_ANGLES, closed * _MIRRORED_ANGLES, shift * _MIRROR)
        return HandGrasp(opened, closed, shift)
    palm = Palms(position[None], rotation[None])
    distance = 1000.0 * float(compute_body_clearance(target.field, palm, spheres.palm)[0])
    where = f"{distance:.0f} mm away from it" if distance > 0.0 else f"{-distance:.0f} mm inside of it"
    raise DataFormatError(
        f"wrist must be where the fingers reach around the object when it is picked up ({place}), got a palm {where}; "
        "check the wrist's frame (origin in the wrist, fingers of a right hand along -x, back along +y, thumb towards "
        "+z; a left hand is mirrored in x) or pass hand=None"
    )


def _find_free_postures(
    target: GraspTarget, spheres: HandSpheres, position: Array, rotation: Array
) -> npt.NDArray[np.intp]:
    """Return the open postures outside of the object, at most `_MAX_CLOSED`, those nearest to it first."""
    palm = Palms(position[None], rotation[None])
    if compute_body_clearance(target.field, palm, spheres.palm)[0] < -_MAX_PALM_OVERLAP:
        return np.zeros(0, dtype=np.intp)
    openings = _load_openings()
    gaps = compute_clearances(
        target.field, spheres, _repeat_palm(position, rotation, len(openings)), openings.compute_joint_angles()
    ).min(axis=(1, 2))
    free = np.flatnonzero(gaps > -SKIN_YIELD)
    return free[np.argsort(gaps[free], kind="stable")[:_MAX_CLOSED]]


def _close_best(
    target: GraspTarget, spheres: HandSpheres, position: Array, rotation: Array, free: npt.NDArray[np.intp]
) -> tuple[Array, Array] | None:
    """Return the angles (45,) of the best of some open postures and of the closed hand; None if no finger touches."""
    palms, openings = _repeat_palm(position, rotation, len(free)), _load_openings()[free]
    closed = close_fingers(target.field, spheres, palms, openings)
    clearances = compute_clearances(target.field, spheres, palms, closed.compute_joint_angles())
    touching = clearances.reshape(len(palms), 5, -1).min(axis=2) < 2 * SKIN_YIELD
    # The thumb counts twice: without it nothing is opposite the fingers. Of equal postures the tightest is taken, whose
    # links are nearest to the object on average (m).
    looseness = np.maximum(clearances, 0.0).mean(axis=(1, 2))
    best = int(np.argmax(touching.sum(axis=1) + touching[:, 4] - np.minimum(looseness, 0.9)))
    if touching[best].sum() < _MIN_TOUCHING:
        return None
    return openings.compute_joint_angles()[best], closed.compute_joint_angles()[best]


def _repeat_palm(position: Array, rotation: Array, count: int) -> Palms:
    return Palms(np.tile(position, (count, 1)), np.tile(rotation, (count, 1, 1)))


def _load_target(mesh: trimesh.Trimesh) -> GraspTarget:
    """Return an object with its distance field, from the user's cache if it has been computed before."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    digest = hashlib.sha256(np.ascontiguousarray(vertices).tobytes() + np.ascontiguousarray(faces).tobytes())
    path = get_cache_folder(_CACHE_KIND) / f"field-{digest.hexdigest()[:24]}.npz"
    arrays = load_cached_arrays(path, ("values", "lower", "cell"), _DESCRIPTION)
    if arrays is not None:
        return GraspTarget(mesh, DistanceField(arrays["values"], arrays["lower"], float(arrays["cell"])))
    target = make_grasp_target(mesh)
    field = target.field
    save_cached_arrays(path, {"values": field.values, "lower": field.lower, "cell": np.array(field.cell)}, _DESCRIPTION)
    return target


@functools.cache
def _load_openings() -> Posture:
    """Return the open postures of the reference hand, which take seconds to sample, from the user's cache."""
    names = [field.name for field in fields(Posture)]
    path = get_cache_folder(_CACHE_KIND) / f"openings-{_OPENINGS_VERSION}.npz"
    arrays = load_cached_arrays(path, names, _DESCRIPTION)
    if arrays is None:
        posture = sample_reference_openings().posture
        arrays = {name: getattr(posture, name) for name in names}
        save_cached_arrays(path, arrays, _DESCRIPTION)
    return Posture(**arrays)
