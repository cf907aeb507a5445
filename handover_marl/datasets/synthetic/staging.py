"""How the object lies at first, how it is held, and how it is offered.

All poses are in the table frame: x to the person's left, -y towards the robot, z up, the table's top at z = 0.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from handover_marl.assets.hand_model import HandModel, euler_matrices
from handover_marl.assets.human_grasps import HumanGrasps
from handover_marl.assets.human_grasps_statistics import wrist_distance_quantile
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.synthetic import calibration
from handover_marl.datasets.synthetic.draws import Draws, at_level
from handover_marl.datasets.synthetic.outlines import hull_corners
from handover_marl.datasets.synthetic.room import room
from handover_marl.models.poses import quaternion_from_matrix

Array = npt.NDArray[np.float64]

#: Heights (m) that a finger joint's centre and an object's corner keep above the table.
JOINT_CLEARANCE = 0.014
OBJECT_CLEARANCE = 0.0005

_YAWS = 24
_OFFER_TRIES = 40
# A few grasps of about the same wrist distance and a few offers of each are compared with what was drawn. Only a
# few, or tilt and room alone would decide how hands are turned.
_GRASPS_COMPARED = 3
_DISTANCE_SLACK = 0.006
_OFFERS_COMPARED = 8
_TILT_WEIGHT = 0.2
# The person reaches from +y and somewhat from above; a hand may come from up to 75 degrees beside that, or else
# up to 100 degrees.
_REACHING = np.array([0.0, -0.94, -0.34])
_REACHING_LIMITS = (np.cos(np.radians(75.0)), np.cos(np.radians(100.0)), -1.0)


@dataclass(frozen=True, eq=False)
class Stage:
    """The poses between which a scene is played.

    Attributes:
        start: World-parallel position (3) and rotation matrix (3, 3) of the object on the table.
        offer: The same where it is offered.
        grasp: Row of the grasp among the person's grasps of the object.
    """

    start: tuple[Array, Array]
    offer: tuple[Array, Array]
    grasp: int


@dataclass(frozen=True, eq=False)
class HeldObject:
    """An object and one person's ways of holding it.

    Attributes:
        class_id: Class number.
        corners: (n, 3) corners of the object (m), its frame.
        grasps: The person's grasps.
        object_from_hand: (g, 3, 3) rotations of the hand's base.
        keypoints: (g, 21, 3) wrist, finger joints and tips (m) in the object's frame, fingers closed.
        robot_grasps: (n, 7) poses of the gripper's hand link in the object's frame, or None where there are none.
    """

    class_id: int
    corners: Array
    grasps: HumanGrasps
    object_from_hand: Array
    keypoints: Array
    robot_grasps: Array | None


def hold(class_id: int, name: str, model: HandModel, grasps: HumanGrasps, robot_grasps: Array | None) -> HeldObject:
    """Gather what staging needs to know of an object in a person's hand."""
    dof = np.stack([grasps.hand_dof(row) for row in range(len(grasps))])
    return HeldObject(
        class_id=class_id,
        corners=hull_corners(name),
        grasps=grasps,
        object_from_hand=euler_matrices(dof[:, 3:6]),
        keypoints=model.keypoints(dof),
        robot_grasps=robot_grasps,
    )


def draw_stage(scene_id: int, held: HeldObject, name: str) -> Stage:
    """Draw start, grasp and offer of a scene."""
    draws = Draws(scene_id, "stage")
    start_x, offer_x = draws.correlated_quantiles(calibration.START_X, calibration.OFFER_X, calibration.START_OFFER_X)
    start_y, offer_y = draws.correlated_quantiles(calibration.START_Y, calibration.OFFER_Y, calibration.START_OFFER_Y)
    offer_z = draws.quantile(calibration.OFFER_Z)
    distance = float(wrist_distance_quantile(name, draws.uniform()))
    tilt, wanted_room = np.radians(draws.quantile(calibration.TILT)), draws.quantile(calibration.ROOM)
    stages = []
    for rotation, grasp in _lay_and_grasp(draws, held, distance):
        start_z = OBJECT_CLEARANCE - float((held.corners @ rotation.T)[:, 2].min())
        start = (np.array([start_x, start_y, start_z]), rotation)
        offers = _offers(draws, held, grasp, np.array([offer_x, offer_y, offer_z]))
        stages += [Stage(start, offer, grasp) for offer in offers]
    return min(stages, key=lambda stage: _misfit(held, stage, tilt, wanted_room))


def _lay_and_grasp(draws: Draws, held: HeldObject, distance: float) -> list[tuple[Array, int]]:
    """Ways of laying the object on one of its sides and holding it at about the wished wrist distance."""
    axes = draws.order(calibration.UP_AXES[held.class_id])
    first_yaw = draws.uniform(0.0, 2.0 * np.pi)
    tie = draws.uniform()
    for limit in _REACHING_LIMITS:
        for axis in axes:
            rotations = [laid(axis, first_yaw + 2.0 * np.pi * turn / _YAWS) for turn in range(_YAWS)]
            allowed = np.stack([_reachable(held, rotation, limit) for rotation in rotations])
            if allowed.any():
                off = np.where(allowed.any(axis=0), np.abs(held.grasps.wrist_distance - distance), np.inf)
                nearest = [int(row) for row in np.argsort(off, kind="stable")[:_GRASPS_COMPARED]]
                near = [row for row in nearest if off[row] < off[nearest[0]] + _DISTANCE_SLACK]
                turns = {row: np.flatnonzero(allowed[:, row]) for row in near}
                return [(rotations[turns[row][int(tie * len(turns[row]))]], row) for row in near]
    # Only the table is in the way of every grasp: hold it as far from the table as can be.
    rotation = laid(axes[0], first_yaw)
    lowest = (held.keypoints @ rotation.T)[..., 2].min(axis=1)
    return [(rotation, int(np.argmax(lowest)))]


def laid(axis: int, yaw: float) -> Array:
    """Rotation of an object with one of +x, -x, +y, -y, +z, -z up, turned about the vertical."""
    up = np.zeros(3)
    up[axis // 2] = 1.0 if axis % 2 == 0 else -1.0
    side = np.roll(np.abs(up), 1)
    upright = np.stack([side, np.cross(up, side), up])
    cos, sin = np.cos(yaw), np.sin(yaw)
    turned: Array = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ upright
    return turned


def _reachable(held: HeldObject, rotation: Array, limit: float) -> npt.NDArray[np.bool_]:
    """Which grasps keep the hand off the table and come from the person's side."""
    ground = (held.corners @ rotation.T)[:, 2].min()
    clear = (held.keypoints @ rotation[2]).min(axis=1) - ground > JOINT_CLEARANCE
    towards = held.grasps.pointing @ rotation.T @ _REACHING > limit
    return np.asarray(clear & towards)


def _offers(draws: Draws, held: HeldObject, grasp: int, position: Array) -> list[tuple[Array, Array]]:
    """Some ways of offering the object at the drawn position, the hand turned as people turn theirs."""
    fitting: list[tuple[Array, Array]] = []
    highest = (-np.inf, np.eye(3))
    for _ in range(_OFFER_TRIES):
        rotation = _offered_hand(draws, held.grasps.side) @ held.object_from_hand[grasp].T
        lowest = min(
            float((held.corners @ rotation[2]).min()) - OBJECT_CLEARANCE,
            float((held.keypoints[grasp] @ rotation[2]).min()) - JOINT_CLEARANCE,
        )
        highest = max(highest, (lowest, rotation), key=lambda pair: pair[0])
        if position[2] + lowest > 0.0:
            fitting.append((position, rotation))
        if len(fitting) == _OFFERS_COMPARED:
            return fitting
    return fitting or [(np.array([position[0], position[1], -highest[0]]), highest[1])]


def _misfit(held: HeldObject, stage: Stage, tilt: float, wanted_room: float) -> float:
    """How far a stage is from the drawn tilt and from the drawn room for a gripper."""
    (_, start), (position, offer) = stage.start, stage.offer
    found = float(np.arccos(np.clip(start[2] @ offer[2], -1.0, 1.0)))
    misfit = _TILT_WEIGHT * abs(found - tilt)
    if held.robot_grasps is not None:
        pose = np.array([*position, *quaternion_from_matrix(offer)])
        pose[2] += float(TABLE_HEIGHT)
        points = held.keypoints[stage.grasp] @ offer.T + pose[:3]
        misfit += abs(room(pose, points, held.robot_grasps) - wanted_room)
    return misfit


def _offered_hand(draws: Draws, side: str) -> Array:
    """Rotation of the hand's base at the offer."""
    azimuth = np.radians(draws.quantile(calibration.POINTING_AZIMUTH))
    one, other = draws.normal(), draws.normal()
    joint = calibration.ELEVATION_ROLL * one + np.sqrt(1.0 - calibration.ELEVATION_ROLL**2) * other
    elevation = np.radians(at_level(calibration.POINTING_ELEVATION, float(ndtr(one))))
    roll = np.radians(at_level(calibration.ROLL, float(ndtr(joint))))
    fingers = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    up = np.array([0.0, 0.0, 1.0]) - fingers[2] * fingers
    up /= np.linalg.norm(up)
    back = np.cos(roll) * up + np.sin(roll) * np.cross(fingers, up)
    along = -fingers
    if side == "left":
        mirror = np.array([-1.0, 1.0, 1.0])
        along, back = fingers * mirror, back * mirror
    return np.stack([along, back, np.cross(along, back)], axis=1)
