"""Closing of a shipped hand's fingers on an object, for recordings of the wrist without finger angles."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.custom_scenes.motion_tables import OBJECT, MotionTable
from handover_marl.assets.hand_model import SUBJECT_SIZES, Side
from handover_marl.datasets.generated.grasps import SKIN_YIELD, close_fingers, compute_palm_distances
from handover_marl.datasets.generated.hands import Palms, make_hand_templates
from handover_marl.datasets.generated.motion import minimum_jerk
from handover_marl.datasets.generated.shapes import Solid
from handover_marl.errors import DataFormatError
from handover_marl.geometry.poses import compose, invert_pose

Array = npt.NDArray[np.float64]

_PICK_UP_DISTANCE, _CLOSING_TIME = 0.005, 0.4  # m, as in the giver's motion; s
# Smallest number of digits that touch the object; numbers of open postures, and of those whose fingers are closed.
_MIN_TOUCHING, _N_OPENINGS, _MAX_CLOSED = 2, 1500, 200
#: Largest distance by which a recorded wrist is moved (m).
MAX_SHIFT = 0.021
_MAX_PALM_OVERLAP = 0.004  # m
_MIRROR = np.array([-1.0, 1.0, 1.0])
_MIRRORED_ANGLES = np.tile([1.0, -1.0, -1.0], 15)
# Translations of the wrist along the fingers and along the palm's normal, the smallest first.
_STEPS = 0.005 * np.arange(-4, 5)
_SHIFTS = sorted(
    (np.array([along, across, 0.0]) for along in _STEPS for across in _STEPS if np.hypot(along, across) < MAX_SHIFT),
    key=np.linalg.norm,
)


def close_hand(table: MotionTable, solid: Solid, hand: int, side: Side) -> tuple[MotionTable, Array]:
    """Return a recording, and angles (n, 45) in rad of fingers that close on the object until it is picked up.

    `hand` is the number of a shipped hand, n the number of rows with the wrist. In the returned recording the wrist is
    moved by up to `MAX_SHIFT` if the hand would be inside of the object. Without a grasp, `DataFormatError` is raised.
    """
    if table.wrist is None:
        raise DataFormatError("the motion has no wrist; add its poses, or pass hand=None")
    first, end = table.wrist_rows
    positions = table.bodies[OBJECT][:, :3]
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > _PICK_UP_DISTANCE)
    row = min(max(int(moved[0]) if len(moved) else end, first), end - 1)
    object_from_wrist = compose(invert_pose(table.bodies[OBJECT][row]), table.wrist[row - first])
    opened, closed, shift = find_hand_grasp(solid, object_from_wrist, hand, side, f"row {row + 1}")
    if shift.any():
        wrist = compose(table.wrist, np.array([*shift, 0.0, 0.0, 0.0, 1.0]))
        distance = 1000.0 * float(np.linalg.norm(shift))
        note = f"wrist moved by {distance:.0f} mm, so that the hand grasps the object and is not inside of it"
        table = replace(table, wrist=wrist, repairs=(*table.repairs, note))
    start = table.time[row] - _CLOSING_TIME
    progress = minimum_jerk((table.time[first:end] - start) / _CLOSING_TIME)[:, None]
    return table, np.asarray((1.0 - progress) * opened + progress * closed)


def find_hand_grasp(
    solid: Solid, object_from_wrist: Array, hand: int, side: Side, place: str
) -> tuple[Array, Array, Array]:
    """Find the finger joint angles of the open hand and of the hand closed on the object at a pose (7,) of the wrist.

    Of many open postures that do not touch the object, the posture is selected whose fingers touch the object most
    when they close. If there is no such posture, the wrist is moved by as little as needed. `hand` is the number of a
    shipped hand; `place` names the row, for the `DataFormatError` if the wrist is not beside the object.

    Returns:
        Angles (45,) of the open and of the closed hand (rad), and translation (3,) of the wrist in its own frame (m).
    """
    position, rotation = object_from_wrist[:3], Rotation.from_quat(object_from_wrist[3:]).as_matrix()
    is_left = side == "left"
    if is_left:
        # A left hand grasps as a right hand grasps the mirrored object.
        solid, position, rotation = solid.mirror(), position * _MIRROR, rotation * np.outer(_MIRROR, _MIRROR)
    templates = make_hand_templates(SUBJECT_SIZES[hand - 1], _N_OPENINGS)
    fault = f"a hand inside of it wherever the wrist is moved by at most {1000.0 * MAX_SHIFT:.0f} mm"
    for shift in _SHIFTS:
        palm = Palms((position + rotation @ shift)[None], rotation[None])
        if compute_palm_distances(solid, palm, *templates.palm)[0] < -_MAX_PALM_OVERLAP:
            continue
        rows = np.arange(len(templates.openings))
        gaps = solid.compute_distances(palm[0 * rows].transform(templates.path[:, 0])) - templates.radii
        nearest = gaps.min(axis=(1, 2))
        free = np.flatnonzero(nearest > -SKIN_YIELD)
        if not len(free):
            continue
        free = free[np.argsort(nearest[free], kind="stable")[:_MAX_CLOSED]]
        closed = close_fingers(solid, templates, palm[0 * free], free)
        touching = closed.gaps.min(axis=2) < 2.0 * SKIN_YIELD
        # The thumb counts twice: without it nothing is opposite the fingers. Of equal postures the tightest is taken,
        # whose links are nearest to the object on average (m).
        looseness = np.maximum(closed.gaps, 0.0).mean(axis=(1, 2))
        best = int(np.argmax(touching.sum(axis=1) + touching[:, 4] - np.minimum(looseness, 0.9)))
        if touching[best].sum() < _MIN_TOUCHING:
            # The hand is not inside of the object but too far from it; other shifts are not tried, as each takes long.
            fault = f"only {touching[best].sum()} digits that reach it"
            break
        signs = _MIRRORED_ANGLES if is_left else np.ones(45)
        opened = templates.openings.posture[free[[best]]].compute_joint_angles()[0]
        angles = closed.posture.compute_joint_angles()[best]
        return opened * signs, angles * signs, shift * _MIRROR if is_left else shift
    is_inside = compute_palm_distances(solid, Palms(position[None], rotation[None]), *templates.palm)[0] < 0.0
    where = "inside of it" if is_inside else f"{1000.0 * np.linalg.norm(position):.0f} mm from the origin of its frame"
    raise DataFormatError(
        f"wrist must be where the fingers reach around the object when it is picked up ({place}), got {fault}, and a "
        f"recorded palm {where}; check the wrist's frame (origin in the wrist, fingers of a right hand along -x, back "
        "along +y, thumb towards +z; a left hand is mirrored in x) or pass hand=None"
    )
