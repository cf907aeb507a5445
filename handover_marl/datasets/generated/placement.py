"""Poses of the objects on the table and at the handover, and the human grasp of the handed-over object.

All poses are in the table's frame: x to the giver's left, -y towards the robot, z up from the table's surface.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from handover_marl.assets.hand_model import LEVELS, HandGeometry, HumanGrasps
from handover_marl.assets.shipped import find_object_urdf
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.generated.random_stream import (
    ELEVATION_ROLL,
    START_HANDOVER_X,
    START_HANDOVER_Y,
    UP_AXES,
    RandomStream,
)
from handover_marl.geometry.model_files.meshes import compute_convex_hull, read_collision_mesh
from handover_marl.geometry.panda import (
    GRIPPER_FROM_HAND,
    MAX_RANKED_GRASPS,
    PREFERRED_HAND_POSE,
    RANKING_ROTATION_WEIGHT,
    RANKING_STANDOFF,
)
from handover_marl.geometry.poses import (
    compose,
    compute_squared_pose_distances,
    poses_from_matrices,
    poses_from_rotations,
    transform_points,
)
from handover_marl.geometry.rotations import matrices_from_euler
from handover_marl.geometry.vectors import compute_cross_products
from handover_marl.geometry.ycb import CLASS_NAMES

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
# Smallest distance (m) between points of the gripper and of the hand, which are each about 1 cm inside of the surface.
_GRIPPER_CLEARANCE = 0.02
# Smallest distance (m) of the other objects from the corners of the handed-over object and from the joints of the hand,
# which is about 2 cm thick; ranges (m) of the other objects' centers in the table's frame.
_CLUTTER_CLEARANCE = 0.025
_CLUTTER_X, _CLUTTER_Y = (0.15, 0.95), (0.02, 0.55)
_MAX_CLUTTER_TRIES = 200

#: Function that draws the object's position x, y on the table (2,) and at the handover (3,) (m).
DrawPositions = Callable[[RandomStream], tuple[Array, Array]]
#: Object for the table: class number, corners (n, 3) of its hull (m), weights of its axes up, see `SimulatedGiver`.
ClutterItem = tuple[int, Array, Sequence[float]]
#: Object on the table: class number, position (3,) (m) and rotation matrix (3, 3) in the table's frame.
ClutterObject = tuple[int, Array, Array]
# Upright bounding cylinder of an object: center (x, y), radius and height (m).
_Cylinder = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class ObjectPlacement:
    """Start pose, handover pose and grasp of the object.

    Attributes:
        start: Position (3,) in m and rotation matrix (3, 3) of the object on the table.
        handover: Position (3,) in m and rotation matrix (3, 3) of the object at the handover.
        grasp: Index of the person's grasp in `SimulatedGiver.grasps`.
    """

    start: tuple[Array, Array]
    handover: tuple[Array, Array]
    grasp: int


@dataclass(frozen=True, eq=False)
class SimulatedGiver:
    """Person who hands over an object; poses and points are in the object's frame.

    Attributes:
        class_id: Class number of the object.
        subject: Name of the person.
        hand: Geometry of the person's hand.
        hand_urdf: URDF file of the person's hand.
        corners: (n, 3) corners of the object's hull (m).
        up_axes: Weights by which the object's axis that points up on the table is drawn: +x, -x, +y, -y, +z, -z.
        wrist_distances: Quantiles (m) of the wrist's distance from the object, at the levels
            `handover_marl.assets.hand_model.LEVELS`.
        grasps: The person's g grasps of the object.
        robot_grasps: (n, 7) poses (quaternion xyzw) of the Panda's hand link at robot grasps, or None for no grasps.
    """

    class_id: int
    subject: str
    hand: HandGeometry
    hand_urdf: Path
    corners: Array
    up_axes: Sequence[float]
    wrist_distances: Sequence[float]
    grasps: HumanGrasps
    robot_grasps: Array | None

    @cached_property
    def object_from_hand(self) -> Array:
        """Rotations (g, 3, 3) of the base of the person's hand in the object's frame, one for each human grasp."""
        return matrices_from_euler(self.grasps.compute_hand_dof()[:, 3:6])

    @cached_property
    def keypoints(self) -> Array:
        """Wrist, finger joints and fingertips (g, 21, 3) of the hand in g human grasps, in the object's frame (m)."""
        return self.hand.compute_keypoints(self.grasps.compute_hand_dof())

    @cached_property
    def gripper_points(self) -> Array | None:
        """Gripper points (n, p, 3) at and shortly before n robot grasps, object's frame (m); None without grasps."""
        if self.robot_grasps is None:
            return None
        return np.asarray(transform_points(self.robot_grasps[:, None], _make_gripper_points()))


@cache
def compute_hull_corners(object_name: str) -> Array:
    """Return the corners (n, 3) in m of the convex hull of a shipped object's collision mesh, in the object's frame."""
    return compute_convex_hull(read_collision_mesh(find_object_urdf(object_name))[0])[0]


def draw_calibrated_positions(random: RandomStream) -> tuple[Array, Array]:
    """Draw an object's start x, y (2,) and handover position (3,), table's frame (m), from DexYCB's statistics."""
    start_x, handover_x = random.draw_correlated_quantiles("start_x", "handover_x", START_HANDOVER_X)
    start_y, handover_y = random.draw_correlated_quantiles("start_y", "handover_y", START_HANDOVER_Y)
    handover_z = random.draw_quantile("handover_z")
    return np.array([start_x, start_y]), np.array([handover_x, handover_y, handover_z])


def draw_placement(random: RandomStream, giver: SimulatedGiver, draw_positions: DrawPositions) -> ObjectPlacement:
    """Draw an object's start pose, human grasp and handover pose, at positions that `draw_positions` draws."""
    start_position, handover_position = draw_positions(random)
    distance = float(np.interp(random.uniform(), LEVELS, giver.wrist_distances))
    tilt = np.radians(random.draw_quantile("tilt"))
    free_grasp_share = random.draw_quantile("free_grasp_share")
    placements: list[ObjectPlacement] = []
    costs: list[Array] = []
    for rotation, grasp in _sample_resting_grasps(random, giver, distance):
        start_z = OBJECT_CLEARANCE - float((giver.corners @ rotation.T)[:, 2].min())
        start = (np.array([*start_position, start_z]), rotation)
        handovers = _sample_handover_poses(random, giver, grasp, handover_position)
        placements += [ObjectPlacement(start, handover, grasp) for handover in handovers]
        costs.append(_compute_costs(giver, placements[-len(handovers) :], tilt, free_grasp_share))
    return placements[int(np.argmin(np.concatenate(costs)))]


def _sample_resting_grasps(random: RandomStream, giver: SimulatedGiver, distance: float) -> list[tuple[Array, int]]:
    """Draw up to 3 resting rotations (3, 3) of the object, each with the index of a grasp near a wrist distance (m).

    If the hand would touch the table in every grasp, return only the grasp with the highest hand.
    """
    axes = random.weighted_order(giver.up_axes)
    first_yaw = random.uniform(0.0, 2.0 * np.pi)
    tie = random.uniform()
    for limit in _REACH_COSINE_LIMITS:
        for axis in axes:
            rotations = _make_resting_rotation(axis, first_yaw + 2.0 * np.pi * np.arange(_N_YAWS) / _N_YAWS)
            allowed = _find_reachable_grasps(giver, rotations, limit)
            if allowed.any():
                off = np.where(allowed.any(axis=0), np.abs(giver.grasps.wrist_distance - distance), np.inf)
                nearest = [int(row) for row in np.argsort(off, kind="stable")[:_N_GRASPS_COMPARED]]
                near = [row for row in nearest if off[row] < off[nearest[0]] + _DISTANCE_SLACK]
                turns = {row: np.flatnonzero(allowed[:, row]) for row in near}
                return [(rotations[turns[row][int(tie * len(turns[row]))]], row) for row in near]
    # The hand touches the table in every grasp: take the one with the highest hand.
    rotation = _make_resting_rotation(axes[0], first_yaw)
    lowest = (giver.keypoints @ rotation.T)[..., 2].min(axis=1)
    return [(rotation, int(np.argmax(lowest)))]


def _make_resting_rotation(axis: int, yaw: npt.ArrayLike) -> Array:
    """Return rotations (..., 3, 3) at yaw angles (...) (rad) with an axis up: 0 to 5 for +x, -x, +y, -y, +z, -z."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    turns = np.zeros((*np.shape(cos), 3, 3))
    turns[..., 0, 0], turns[..., 0, 1], turns[..., 1, 0], turns[..., 1, 1] = cos, -sin, sin, cos
    turns[..., 2, 2] = 1.0
    return np.asarray(turns @ _make_upright_rotation(axis))


@cache
def _make_upright_rotation(axis: int) -> Array:
    """Return a rotation (3, 3) that turns an axis of the object up: 0 to 5 for +x, -x, +y, -y, +z, -z."""
    up = np.zeros(3)
    up[axis // 2] = 1.0 if axis % 2 == 0 else -1.0
    side = np.roll(np.abs(up), 1)
    return np.stack([side, np.cross(up, side), up])


def _find_reachable_grasps(giver: SimulatedGiver, rotations: Array, limit: float) -> npt.NDArray[np.bool_]:
    """Return a mask (n, g) of the human grasps in which the hand is clear of the table and comes from the giver's side.

    The n rotations (n, 3, 3) of the object on the table have the same axis up. `limit` is the smallest cosine between
    the fingers' direction and the direction in which the giver reaches. g is the number of `giver.grasps`.
    """
    up = rotations[0, 2]  # Equal for all yaws.
    clear = (giver.keypoints @ up).min(axis=1) - (giver.corners @ up).min() > JOINT_CLEARANCE
    from_giver = giver.grasps.finger_direction @ rotations.swapaxes(1, 2) @ _REACH_DIRECTION > limit
    return np.asarray(clear & from_giver)


def _sample_handover_poses(
    random: RandomStream, giver: SimulatedGiver, grasp: int, position: Array
) -> list[tuple[Array, Array]]:
    """Draw up to 8 object poses (position, matrix) in a grasp at a position (m); if all touch the table, lift one."""
    hand_from_object = giver.object_from_hand[grasp].T
    fitting: list[tuple[Array, Array]] = []
    highest = (-np.inf, np.eye(3))
    for _ in range(_MAX_HANDOVER_SAMPLES):
        rotation = _sample_hand_rotation(random, giver.grasps.side) @ hand_from_object
        lowest = min(
            float((giver.corners @ rotation[2]).min()) - OBJECT_CLEARANCE,
            float((giver.keypoints[grasp] @ rotation[2]).min()) - JOINT_CLEARANCE,
        )
        highest = max(highest, (lowest, rotation), key=lambda pair: pair[0])
        if position[2] + lowest > 0.0:
            fitting.append((position, rotation))
        if len(fitting) == _N_HANDOVERS_COMPARED:
            return fitting
    return fitting or [(np.array([position[0], position[1], -highest[0]]), highest[1])]


def _compute_costs(
    giver: SimulatedGiver, placements: Sequence[ObjectPlacement], tilt: float, free_grasp_share: float
) -> Array:
    """Return costs (n,) of placements with the same grasp: weighted deviation from desired tilt and free grasp share.

    The tilt (rad) is the angle between the object's up directions at start and handover. The free grasp share is the
    share of preferred robot grasps that are clear of the giver's hand.
    """
    rotations = np.stack([placement.handover[1] for placement in placements])
    cosines = np.array([placement.start[1][2] @ placement.handover[1][2] for placement in placements])
    costs: Array = _TILT_WEIGHT * np.abs(np.arccos(np.clip(cosines, -1.0, 1.0)) - tilt)
    if giver.robot_grasps is not None and giver.gripper_points is not None:
        clear = _find_clear_grasps(giver.gripper_points, giver.keypoints[placements[0].grasp])
        positions = np.stack([placement.handover[0] for placement in placements])
        positions[:, 2] += float(TABLE_HEIGHT)
        shares = _compute_free_grasp_shares(poses_from_rotations(positions, rotations), clear, giver.robot_grasps)
        costs += np.abs(shares - free_grasp_share)
    return costs


def _sample_hand_rotation(random: RandomStream, side: str) -> Array:
    """Draw the rotation matrix (3, 3) of the base of the person's hand at the handover, in the table's frame."""
    azimuth = random.draw_quantile("pointing_azimuth")
    elevation, roll = random.draw_correlated_quantiles("pointing_elevation", "roll", ELEVATION_ROLL)
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
    """Return points (n, 3) of the gripper at a grasp and on the approach, in the hand link's frame at the grasp (m)."""
    fingers = [(0.0, side * 0.045, z) for side in (-1, 1) for z in (0.065, 0.085, 0.105)]
    palm = [(0.0, side * y, z) for side in (-1, 1) for y in (0.03, 0.06, 0.09) for z in (0.02, 0.05)]
    points = np.array([*fingers, *palm, (0.0, 0.0, 0.06)])
    return np.concatenate([points - [0.0, 0.0, standoff] for standoff in (0.0, 0.03, 0.06, 0.10)])


def hand_poses_from_grasps(transforms: Array) -> Array:
    """Convert HandoverSim's gripper poses (n, 4, 4) (m) to poses (n, 7) of the Panda's hand link: xyz (m), xyzw."""
    return np.asarray(compose(poses_from_matrices(transforms), np.array(GRIPPER_FROM_HAND)))


def _find_clear_grasps(gripper_points: Array, hand_points: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of robot grasps whose gripper points (n, p, 3) are clear of hand keypoints (21, 3) (m)."""
    wrist, digits = hand_points[:1], hand_points[1:].reshape(5, 4, 3)
    palm = 0.5 * (digits[:, 0] + wrist)
    hand = np.concatenate([hand_points, palm])
    points = gripper_points.reshape(-1, 3)
    nearest = cdist(hand, points, "sqeuclidean").min(axis=0).reshape(len(gripper_points), -1).min(axis=1)
    return np.asarray(nearest > _GRIPPER_CLEARANCE**2)


def _compute_free_grasp_shares(world_from_object: Array, clear: npt.NDArray[np.bool_], grasps: Array) -> Array:
    """Return the shares (m,) of preferred robot grasps that are clear of the giver's hand, for m object poses (m, 7).

    The preferred ones of `grasps` (n, 7), in the object's frame, are the `MAX_RANKED_GRASPS` whose standoff poses are
    nearest to the pose of the waiting gripper. The mask `clear` (n,) is from `_find_clear_grasps`.
    """
    standoffs = compose(compose(world_from_object[:, None], grasps), np.array(RANKING_STANDOFF))
    costs = compute_squared_pose_distances(PREFERRED_HAND_POSE, standoffs.reshape(-1, 7), RANKING_ROTATION_WEIGHT)
    order = np.argsort(costs.reshape(len(standoffs), -1), axis=1, kind="stable")
    return np.asarray(clear[order[:, :MAX_RANKED_GRASPS]].mean(axis=1))


def make_ycb_clutter_item(class_id: int) -> ClutterItem:
    """Return the YCB object of a class number as an object for the table, beside the handed-over object."""
    return class_id, compute_hull_corners(CLASS_NAMES[class_id]), UP_AXES[class_id]


def draw_clutter(
    random: RandomStream, counts: range, draw_item: Callable[[RandomStream], ClutterItem], occupied: Array
) -> list[ClutterObject]:
    """Draw the objects on the table that are not handed over in a scene, all of different classes.

    All numbers of objects in `counts` are equally likely; fewer are placed if there is no space. `draw_item` draws a
    candidate. Objects keep clear of each other and of `occupied` (3, n): points of the hand and of the handed-over
    object in the table's frame (m).
    """
    count = counts[random.integer(len(counts))]
    placed: list[ClutterObject] = []
    cylinders: list[_Cylinder] = []
    for _ in range(_MAX_CLUTTER_TRIES):
        if len(placed) == count:
            break
        item = draw_item(random)
        candidate, cylinder = _place_clutter(random, item)
        is_repeated = item[0] in [other for other, _, _ in placed]
        if not is_repeated and _is_free(cylinder, occupied, cylinders):
            placed.append(candidate)
            cylinders.append(cylinder)
    return placed


def _place_clutter(random: RandomStream, item: ClutterItem) -> tuple[ClutterObject, _Cylinder]:
    class_id, hull, up_axes = item
    axis = random.weighted_index(up_axes)
    rotation = _make_resting_rotation(axis, random.uniform(0.0, 2.0 * np.pi))
    corners = hull @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = 0.5 * (low + high)
    x, y = random.uniform(*_CLUTTER_X), random.uniform(*_CLUTTER_Y)
    across = corners[:, :2] - middle[:2]
    radius = float(np.sqrt((across * across).sum(axis=1).max()))
    position = np.array([x - middle[0], y - middle[1], OBJECT_CLEARANCE - low[2]])
    return (class_id, position, rotation), (x, y, radius, float(high[2] - low[2]))


def _is_free(cylinder: _Cylinder, points: Array, others: list[_Cylinder]) -> bool:
    x, y, radius, height = cylinder
    if any(math.hypot(other[0] - x, other[1] - y) <= other[2] + radius for other in others):
        return False
    near = (points[0] - x) ** 2 + (points[1] - y) ** 2 <= (radius + _CLUTTER_CLEARANCE) ** 2
    return not (near & (points[2] < height + _CLUTTER_CLEARANCE)).any()
