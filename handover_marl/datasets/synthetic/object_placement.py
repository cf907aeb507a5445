"""Poses of the object on the table and at the handover, and the human grasp between them.

All poses are in the table's frame: x to the giver's left, -y towards the robot, z up from the
table's surface.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from handover_marl.assets.hand_model import HandGeometry, matrices_from_euler
from handover_marl.assets.human_grasps import HumanGrasps, interpolate_wrist_distance
from handover_marl.assets.object_models import find_object_urdf
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.synthetic import calibration
from handover_marl.datasets.synthetic.grasp_clearance import compute_free_grasp_share
from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.geometry.meshes import read_collision_mesh
from handover_marl.geometry.poses import quaternion_from_matrix

Array = npt.NDArray[np.float64]

#: Smallest height (m) of a finger joint's center and of an object's corner above the table.
JOINT_CLEARANCE = 0.014
OBJECT_CLEARANCE = 0.0005

_N_YAWS = 24
_MAX_HANDOVER_SAMPLES = 40
# The best of a few candidates is selected by tilt and free grasp share. With more candidates these
# two would dominate the distribution of the hand's rotations.
_N_GRASPS_COMPARED = 3
_DISTANCE_SLACK = 0.006  # m
_N_HANDOVERS_COMPARED = 8
_TILT_WEIGHT = 0.2
# The giver reaches from +y and above. The angle to that direction is at most 75 degrees if
# possible, else 100, else unlimited.
_REACH_DIRECTION = np.array([0.0, -0.94, -0.34])
_REACH_COSINE_LIMITS = (np.cos(np.radians(75.0)), np.cos(np.radians(100.0)), -1.0)


@cache
def compute_hull_corners(object_name: str) -> npt.NDArray[np.float64]:
    """Return the corners (n, 3) (m) of the hull of an object's collision mesh, in its frame."""
    corners, _ = read_collision_mesh(find_object_urdf(object_name))
    hull: npt.NDArray[np.float64] = corners[np.sort(ConvexHull(corners).vertices)]
    return hull


@dataclass(frozen=True, eq=False)
class ObjectPlacement:
    """Start pose, handover pose and grasp of the object.

    Attributes:
        start: Position (3,) in m and rotation matrix (3, 3) of the object on the table.
        handover: Position (3,) in m and rotation matrix (3, 3) of the object at the handover.
        grasp: Index of the grasp among the subject's grasps of the object.
    """

    start: tuple[Array, Array]
    handover: tuple[Array, Array]
    grasp: int


@dataclass(frozen=True, eq=False)
class HeldObject:
    """Object with its robot grasps and the human grasps of one subject, in the object's frame.

    Attributes:
        class_id: YCB class number.
        corners: (n, 3) corners of the object's hull (m).
        grasps: Grasps of the subject.
        object_from_hand: (g, 3, 3) rotations of the hand's base in the g human grasps.
        keypoints: (g, 21, 3) wrist, finger joints and fingertips of the closed hand in these grasps (m).
        robot_grasps: (n, 7) poses of the gripper's hand link, or None for a class without grasps.
    """

    class_id: int
    corners: Array
    grasps: HumanGrasps
    object_from_hand: Array
    keypoints: Array
    robot_grasps: Array | None


def make_held_object(
    class_id: int, name: str, model: HandGeometry, grasps: HumanGrasps, robot_grasps: Array | None
) -> HeldObject:
    """Return an object with the grasps of one subject.

    Args:
        class_id: YCB class number.
        name: YCB class name.
        model: Hand of the subject.
        grasps: Grasps of the subject.
        robot_grasps: (n, 7) poses of the gripper's hand link in the object's frame, or None.
    """
    dof = np.stack([grasps.compute_hand_dof(row) for row in range(len(grasps))])
    return HeldObject(
        class_id=class_id,
        corners=compute_hull_corners(name),
        grasps=grasps,
        object_from_hand=matrices_from_euler(dof[:, 3:6]),
        keypoints=model.compute_keypoints(dof),
        robot_grasps=robot_grasps,
    )


def draw_placement(scene_id: int, held: HeldObject, name: str) -> ObjectPlacement:
    """Draw the start pose, the grasp and the handover pose of a scene.

    Args:
        scene_id: Scene number, the seed of all draws.
        held: Object and the subject's grasps of it.
        name: YCB class name.
    """
    random = RandomStream(scene_id, "placement")
    start_x, handover_x = random.draw_correlated_quantiles("start_x", "handover_x", calibration.START_HANDOVER_X)
    start_y, handover_y = random.draw_correlated_quantiles("start_y", "handover_y", calibration.START_HANDOVER_Y)
    handover_z = random.draw_quantile("handover_z")
    distance = float(interpolate_wrist_distance(name, random.uniform()))
    tilt = np.radians(random.draw_quantile("tilt"))
    free_grasp_share = random.draw_quantile("free_grasp_share")
    placements = []
    for rotation, grasp in _sample_resting_grasps(random, held, distance):
        start_z = OBJECT_CLEARANCE - float((held.corners @ rotation.T)[:, 2].min())
        start = (np.array([start_x, start_y, start_z]), rotation)
        handovers = _sample_handover_poses(random, held, grasp, np.array([handover_x, handover_y, handover_z]))
        placements += [ObjectPlacement(start, handover, grasp) for handover in handovers]
    return min(placements, key=lambda placement: _compute_placement_cost(held, placement, tilt, free_grasp_share))


def _sample_resting_grasps(random: RandomStream, held: HeldObject, distance: float) -> list[tuple[Array, int]]:
    """Return resting rotations (3, 3) and grasp indices with about the given wrist distance (m)."""
    axes = random.weighted_order(calibration.UP_AXES[held.class_id])
    first_yaw = random.uniform(0.0, 2.0 * np.pi)
    tie = random.uniform()
    for limit in _REACH_COSINE_LIMITS:
        for axis in axes:
            rotations = [resting_rotation(axis, first_yaw + 2.0 * np.pi * turn / _N_YAWS) for turn in range(_N_YAWS)]
            allowed = np.empty((_N_YAWS, len(held.grasps)), dtype=bool)
            for turn, rotation in enumerate(rotations):
                allowed[turn] = _find_reachable_grasps(held, rotation, limit)
            if allowed.any():
                off = np.where(allowed.any(axis=0), np.abs(held.grasps.wrist_distance - distance), np.inf)
                nearest = [int(row) for row in np.argsort(off, kind="stable")[:_N_GRASPS_COMPARED]]
                near = [row for row in nearest if off[row] < off[nearest[0]] + _DISTANCE_SLACK]
                turns = {row: np.flatnonzero(allowed[:, row]) for row in near}
                return [(rotations[turns[row][int(tie * len(turns[row]))]], row) for row in near]
    # The hand touches the table in every grasp: take the one with the highest hand.
    rotation = resting_rotation(axes[0], first_yaw)
    lowest = (held.keypoints @ rotation.T)[..., 2].min(axis=1)
    return [(rotation, int(np.argmax(lowest)))]


def resting_rotation(axis: int, yaw: float) -> Array:
    """Return the rotation (3, 3) of an object with one of its axes up.

    Args:
        axis: Index of the object's axis that points up, in the list +x, -x, +y, -y, +z, -z.
        yaw: Rotation about the vertical (rad).
    """
    up = np.zeros(3)
    up[axis // 2] = 1.0 if axis % 2 == 0 else -1.0
    side = np.roll(np.abs(up), 1)
    upright = np.stack([side, np.cross(up, side), up])
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation: Array = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ upright
    return rotation


def _find_reachable_grasps(held: HeldObject, rotation: Array, limit: float) -> npt.NDArray[np.bool_]:
    """Return a mask (g,) of the grasps that are clear of the table and come from the giver's side."""
    ground = (held.corners @ rotation.T)[:, 2].min()
    clear = (held.keypoints @ rotation[2]).min(axis=1) - ground > JOINT_CLEARANCE
    from_giver = held.grasps.finger_direction @ rotation.T @ _REACH_DIRECTION > limit
    return np.asarray(clear & from_giver)


def _sample_handover_poses(
    random: RandomStream, held: HeldObject, grasp: int, position: Array
) -> list[tuple[Array, Array]]:
    """Draw handover poses at a position with the hand rotations of DexYCB's givers."""
    fitting: list[tuple[Array, Array]] = []
    highest = (-np.inf, np.eye(3))
    for _ in range(_MAX_HANDOVER_SAMPLES):
        rotation = _sample_hand_rotation(random, held.grasps.side) @ held.object_from_hand[grasp].T
        lowest = min(
            float((held.corners @ rotation[2]).min()) - OBJECT_CLEARANCE,
            float((held.keypoints[grasp] @ rotation[2]).min()) - JOINT_CLEARANCE,
        )
        highest = max(highest, (lowest, rotation), key=lambda pair: pair[0])
        if position[2] + lowest > 0.0:
            fitting.append((position, rotation))
        if len(fitting) == _N_HANDOVERS_COMPARED:
            return fitting
    return fitting or [(np.array([position[0], position[1], -highest[0]]), highest[1])]


def _compute_placement_cost(
    held: HeldObject, placement: ObjectPlacement, tilt: float, free_grasp_share: float
) -> float:
    """Return the deviation of a placement from a tilt (rad) and a free grasp share."""
    (_, start), (position, handover) = placement.start, placement.handover
    actual_tilt = float(np.arccos(np.clip(start[2] @ handover[2], -1.0, 1.0)))
    cost = _TILT_WEIGHT * abs(actual_tilt - tilt)
    if held.robot_grasps is not None:
        pose = np.array([*position, *quaternion_from_matrix(handover)])
        pose[2] += float(TABLE_HEIGHT)
        points = held.keypoints[placement.grasp] @ handover.T + pose[:3]
        cost += abs(compute_free_grasp_share(pose, points, held.robot_grasps) - free_grasp_share)
    return cost


def _sample_hand_rotation(random: RandomStream, side: str) -> Array:
    """Draw the rotation (3, 3) of the hand's base at the handover."""
    azimuth = np.radians(random.draw_quantile("pointing_azimuth"))
    correlation = calibration.ELEVATION_ROLL
    elevation, roll = np.radians(random.draw_correlated_quantiles("pointing_elevation", "roll", correlation))
    fingers = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    up = np.array([0.0, 0.0, 1.0]) - fingers[2] * fingers
    up /= np.linalg.norm(up)
    back = np.cos(roll) * up + np.sin(roll) * np.cross(fingers, up)
    along = -fingers
    if side == "left":
        mirror = np.array([-1.0, 1.0, 1.0])
        along, back = fingers * mirror, back * mirror
    return np.stack([along, back, np.cross(along, back)], axis=1)
