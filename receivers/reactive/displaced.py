"""Displaced grasps: for a hand that leaves no room beside it for any of the tried ones.

They were not tried out. That they hold is likely only, since the fingers have the object between them and close along
the same line as in a grasp that holds.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose, inverse
from handover_marl.planning.gripper_room import Balls, between_pads, open_rooms, rooms
from handover_marl.receivers.reactive.grasps import TriedGrasps

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Displacements:
    """Which copies there are, in the gripper's frame about the middle between the pads.

    Attributes:
        tilts: Turns about the line between the pads (rad).
        aside: Ways across that line and the approach (m).
        back: Ways back along the approach (m).
        pads: Distance of the pads' middle from the hand's frame (m).
        room: Room beside the person's hand that a copy needs (m).
        spare: Room that the open gripper needs beside the object's points (m).
        points: The last so many of the object's points are looked at here.
        inside: So many of them at least are between the pads.
        most: So many copies at most, evenly from all.
    """

    tilts: tuple[float, ...] = (0.0, -0.35, 0.35, -0.7, 0.7)
    aside: tuple[float, ...] = (0.0, -0.012, 0.012, -0.024, 0.024)
    back: tuple[float, ...] = (0.0, 0.01)
    pads: float = 0.1
    room: float = 0.003
    spare: float = 0.001
    points: int = 1200
    inside: int = 2
    most: int = 1500


def displaced(tried: TriedGrasps, points: Array, hand: Balls, sweep: float, config: Displacements) -> TriedGrasps:
    """Copies of the tried grasps that hold, which have room beside a person's hand.

    Args:
        tried: Grasps in the object's frame.
        points: (k, 3) of the object's surface in its own frame (m).
        hand: The person's hand in the object's frame.
        sweep: Length of the straight way to a grasp (m).
        config: Which copies.
    """
    poses, holds = tried.poses[tried.holds > 0.0], tried.holds[tried.holds > 0.0]
    ways = list(itertools.product(config.tilts, config.aside, config.back))[1:]
    copies = np.concatenate([np.zeros((0, 7)), *(compose(poses, displacement(*way, config.pads)) for way in ways)])
    holds = np.tile(holds, len(ways))
    keep = np.flatnonzero(rooms(copies, hand, sweep) > config.room)
    keep = keep[:: max(1, -(-len(keep) // config.most))]
    few = points[-config.points :]
    surface = Balls(few, np.zeros(len(few)))
    keep = keep[open_rooms(copies[keep], surface) > config.spare]
    keep = keep[between_pads(copies[keep], few) >= config.inside]
    return TriedGrasps(copies[keep], holds[keep])


def displacement(tilt: float, aside: float, back: float, pads: float) -> Array:
    """(7,) from a grasp to a copy of it; see `Displacements`."""
    middle = np.array([0.0, 0.0, pads, 0.0, 0.0, 0.0, 1.0])
    turned = np.array([aside, 0.0, -back, *Rotation.from_euler("y", tilt).as_quat()])
    found: Array = compose(compose(middle, turned), inverse(middle))
    return found
