"""Poses of the object on the table and at the handover, and the human grasp between them.

All poses are in the table's frame: x to the giver's left, -y towards the robot, z up from the table's surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from handover_marl.assets.hand_model import HandGeometry, matrices_from_euler
from handover_marl.assets.human_grasps import LEVELS, HumanGrasps
from handover_marl.assets.shipped import find_object_urdf
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.synthetic.random_stream import (
    ELEVATION_ROLL,
    START_HANDOVER_X,
    START_HANDOVER_Y,
    RandomStream,
)
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.panda import (
    GRIPPER_FROM_HAND,
    MAX_RANKED_GRASPS,
    PREFERRED_HAND_POSE,
    RANKING_ROTATION_WEIGHT,
    RANKING_STANDOFF,
)
from handover_marl.geometry.poses import (
    compose,
    compute_cross_products,
    compute_pose_distances,
    poses_from_matrices,
    poses_from_rotations,
    transform_points,
)

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
#: Smallest distance (m) between points of the gripper and of the hand, which are each about 1 cm inside of the surface.
CLEARANCE = 0.02


@cache
def compute_hull_corners(object_name: str) -> npt.NDArray[np.float64]:
    """Return the corners (n, 3) (m) of the hull of an object's collision mesh, in its frame."""
    corners, _ = read_collision_mesh(find_object_urdf(object_name))
    return np.asarray(corners[np.sort(ConvexHull(corners).vertices)])


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
        corners: (n, 3) corners of the object's hull (m).
        up_axes: Weights of the axes that point up on the table: +x, -x, +y, -y, +z, -z.
        wrist_distances: Quantiles (m) of the wrist's distance from the object, at the levels
            `handover_marl.assets.human_grasps.LEVELS`.
        grasps: Grasps of the subject.
        object_from_hand: (g, 3, 3) rotations of the hand's base in the g human grasps.
        keypoints: (g, 21, 3) wrist, finger joints and fingertips of the closed hand in these grasps (m).
        robot_grasps: (n, 7) poses of the gripper's hand link, or None for a class without grasps.
        gripper_points: (n, p, 3) points of the gripper at these grasps (m), or None.
    """

    corners: Array
    up_axes: Sequence[float]
    wrist_distances: Sequence[float]
    grasps: HumanGrasps
    object_from_hand: Array
    keypoints: Array
    robot_grasps: Array | None
    gripper_points: Array | None


def make_held_object(
    corners: Array,
    up_axes: Sequence[float],
    wrist_distances: Sequence[float],
    model: HandGeometry,
    grasps: HumanGrasps,
    robot_grasps: Array | None,
) -> HeldObject:
    """Return an object with the grasps of one subject; the arguments are fields of `HeldObject`."""
    dof = grasps.compute_hand_dof()
    return HeldObject(
        corners=corners,
        up_axes=up_axes,
        wrist_distances=wrist_distances,
        grasps=grasps,
        object_from_hand=matrices_from_euler(dof[:, 3:6]),
        keypoints=model.compute_keypoints(dof),
        robot_grasps=robot_grasps,
        gripper_points=None if robot_grasps is None else place_gripper_points(robot_grasps),
    )


@dataclass(frozen=True, eq=False)
class HandoverPositions:
    """Positions of the object in a scene.

    Attributes:
        start: (2,) position x, y on the table (m).
        handover: (3,) position at the handover (m).
    """

    start: Array
    handover: Array


def draw_calibrated_positions(random: RandomStream) -> HandoverPositions:
    """Draw positions of the object from the distributions of DexYCB."""
    start_x, handover_x = random.draw_correlated_quantiles("start_x", "handover_x", START_HANDOVER_X)
    start_y, handover_y = random.draw_correlated_quantiles("start_y", "handover_y", START_HANDOVER_Y)
    handover_z = random.draw_quantile("handover_z")
    return HandoverPositions(np.array([start_x, start_y]), np.array([handover_x, handover_y, handover_z]))


def draw_placement(
    random: RandomStream,
    held: HeldObject,
    draw_positions: Callable[[RandomStream], HandoverPositions] = draw_calibrated_positions,
) -> ObjectPlacement:
    """Draw the start pose, the grasp and the handover pose of a scene at drawn positions of the object."""
    positions = draw_positions(random)
    distance = float(np.interp(random.uniform(), LEVELS, held.wrist_distances))
    tilt = np.radians(random.draw_quantile("tilt"))
    free_grasp_share = random.draw_quantile("free_grasp_share")
    placements: list[ObjectPlacement] = []
    costs: list[Array] = []
    for rotation, grasp in _sample_resting_grasps(random, held, distance):
        start_z = OBJECT_CLEARANCE - float((held.corners @ rotation.T)[:, 2].min())
        start = (np.array([*positions.start, start_z]), rotation)
        handovers = _sample_handover_poses(random, held, grasp, positions.handover)
        placements += [ObjectPlacement(start, handover, grasp) for handover in handovers]
        costs.append(_compute_costs(held, placements[-len(handovers) :], tilt, free_grasp_share))
    return placements[int(np.argmin(np.concatenate(costs)))]


def _sample_resting_grasps(random: RandomStream, held: HeldObject, distance: float) -> list[tuple[Array, int]]:
    """Return resting rotations (3, 3) and grasp indices with about the given wrist distance (m)."""
    axes = random.weighted_order(held.up_axes)
    first_yaw = random.uniform(0.0, 2.0 * np.pi)
    tie = random.uniform()
    for limit in _REACH_COSINE_LIMITS:
        for axis in axes:
            rotations = resting_rotation(axis, first_yaw + 2.0 * np.pi * np.arange(_N_YAWS) / _N_YAWS)
            allowed = _find_reachable_grasps(held, rotations, limit)
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


def resting_rotation(axis: int, yaw: npt.ArrayLike) -> Array:
    """Return rotations (..., 3, 3) with an axis (in the list +x, -x, +y, -y, +z, -z) up, at yaw angles (...) in rad."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    turns = np.zeros((*np.shape(cos), 3, 3))
    turns[..., 0, 0], turns[..., 0, 1], turns[..., 1, 0], turns[..., 1, 1] = cos, -sin, sin, cos
    turns[..., 2, 2] = 1.0
    return np.asarray(turns @ _make_upright_rotation(axis))


@cache
def _make_upright_rotation(axis: int) -> Array:
    """Return a rotation (3, 3) that turns an axis of the object up, see `resting_rotation`."""
    up = np.zeros(3)
    up[axis // 2] = 1.0 if axis % 2 == 0 else -1.0
    side = np.roll(np.abs(up), 1)
    return np.stack([side, np.cross(up, side), up])


def _find_reachable_grasps(held: HeldObject, rotations: Array, limit: float) -> npt.NDArray[np.bool_]:
    """Return a mask (n, g) of an object's g grasps that are clear of the table and come from the giver's side.

    The rotations (n, 3, 3) have the same axis up; `limit` is the least cosine between fingers and reach direction.
    """
    up = rotations[0, 2]  # Equal for all yaws.
    clear = (held.keypoints @ up).min(axis=1) - (held.corners @ up).min() > JOINT_CLEARANCE
    from_giver = held.grasps.finger_direction @ rotations.swapaxes(1, 2) @ _REACH_DIRECTION > limit
    return np.asarray(clear & from_giver)


def _sample_handover_poses(
    random: RandomStream, held: HeldObject, grasp: int, position: Array
) -> list[tuple[Array, Array]]:
    """Draw handover poses at a position with the hand rotations of DexYCB's givers."""
    hand_from_object = held.object_from_hand[grasp].T
    fitting: list[tuple[Array, Array]] = []
    highest = (-np.inf, np.eye(3))
    for _ in range(_MAX_HANDOVER_SAMPLES):
        rotation = _sample_hand_rotation(random, held.grasps.side) @ hand_from_object
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


def _compute_costs(
    held: HeldObject, placements: Sequence[ObjectPlacement], tilt: float, free_grasp_share: float
) -> Array:
    """Return deviations (n,) of placements with one grasp from a tilt (rad) and a free grasp share."""
    rotations = np.stack([placement.handover[1] for placement in placements])
    cosines = np.array([placement.start[1][2] @ placement.handover[1][2] for placement in placements])
    costs: Array = _TILT_WEIGHT * np.abs(np.arccos(np.clip(cosines, -1.0, 1.0)) - tilt)
    if held.robot_grasps is not None and held.gripper_points is not None:
        clear = find_clear_grasps(held.gripper_points, held.keypoints[placements[0].grasp])
        positions = np.stack([placement.handover[0] for placement in placements])
        positions[:, 2] += float(TABLE_HEIGHT)
        shares = compute_free_grasp_shares(poses_from_rotations(positions, rotations), clear, held.robot_grasps)
        costs += np.abs(shares - free_grasp_share)
    return costs


def _sample_hand_rotation(random: RandomStream, side: str) -> Array:
    """Draw the rotation (3, 3) of the hand's base at the handover."""
    azimuth = random.draw_quantile("pointing_azimuth")
    correlation = ELEVATION_ROLL
    elevation, roll = random.draw_correlated_quantiles("pointing_elevation", "roll", correlation)
    angles = np.radians([azimuth, elevation, roll])
    (sin, sin_elevation, sin_roll), (cos, cos_elevation, cos_roll) = np.sin(angles), np.cos(angles)
    fingers = np.array([sin * cos_elevation, -cos * cos_elevation, sin_elevation])
    up = -fingers[2] * fingers
    up[2] += 1.0
    up /= np.sqrt(up @ up)
    back = cos_roll * up + sin_roll * compute_cross_products(fingers, up)
    along = -fingers
    if side == "left":
        mirror = np.array([-1.0, 1.0, 1.0])
        along, back = fingers * mirror, back * mirror
    return np.asarray(np.array([along, back, compute_cross_products(along, back)]).T)


# Givers hold objects so that they can be taken. The measure considers the grasps that a waiting robot would prefer,
# and counts those whose grasp and final approach are clear of the hand.


@cache
def _make_gripper_points() -> Array:
    """Return points (n, 3) (m) of the gripper at a grasp and its approach, in the grasp's frame."""
    fingers = [(0.0, side * 0.045, z) for side in (-1, 1) for z in (0.065, 0.085, 0.105)]
    palm = [(0.0, side * y, z) for side in (-1, 1) for y in (0.03, 0.06, 0.09) for z in (0.02, 0.05)]
    points = np.array([*fingers, *palm, (0.0, 0.0, 0.06)])
    return np.concatenate([points - [0.0, 0.0, standoff] for standoff in (0.0, 0.03, 0.06, 0.10)])


def hand_poses_from_grasps(transforms: Array) -> Array:
    """Return poses (n, 7) of the Panda's hand link from grasp matrices (n, 4, 4)."""
    return np.asarray(compose(poses_from_matrices(transforms), np.array(GRIPPER_FROM_HAND)))


def place_gripper_points(grasps: Array) -> Array:
    """Return the gripper's points (n, p, 3) in m at grasps (n, 7) and their approaches, in the object's frame."""
    return np.asarray(transform_points(grasps[:, None], _make_gripper_points()))


def find_clear_grasps(gripper_points: Array, hand_points: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the grasps, with gripper points (n, p, 3), that are clear of hand keypoints (21, 3)."""
    wrist, digits = hand_points[:1], hand_points[1:].reshape(5, 4, 3)
    palm = 0.5 * (digits[:, 0] + wrist)
    hand = np.concatenate([hand_points, palm])
    points = gripper_points.reshape(-1, 3)
    nearest = cdist(hand, points, "sqeuclidean").min(axis=0).reshape(len(gripper_points), -1).min(axis=1)
    return np.asarray(nearest > CLEARANCE**2)


def compute_free_grasp_shares(world_from_object: Array, clear: npt.NDArray[np.bool_], grasps: Array) -> Array:
    """Return the shares (m,) of preferred robot grasps (n, 7) that are clear of the giver's hand, at poses (m, 7).

    Preferred grasps are those whose standoff poses are nearest to the pose of the waiting gripper. The mask `clear`
    (n,) is from `find_clear_grasps`.
    """
    standoffs = compose(compose(world_from_object[:, None], grasps), np.array(RANKING_STANDOFF))
    costs = compute_pose_distances(PREFERRED_HAND_POSE, standoffs.reshape(-1, 7), RANKING_ROTATION_WEIGHT)
    order = np.argsort(costs.reshape(len(standoffs), -1), axis=1, kind="stable")
    return np.asarray(clear[order[:, :MAX_RANKED_GRASPS]].mean(axis=1))
