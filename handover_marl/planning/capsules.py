"""A human hand as capsules around the bones that an observation shows."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation

Array = npt.NDArray[np.float64]

_WRIST = 0
#: Keypoints of index, middle, little and ring finger and thumb, from the knuckle outwards (MANO's order).
_FINGERS = ((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12), (13, 14, 15))
# The palm between neighbouring knuckles, and between the index finger's and the thumb's.
_WEB = ((1, 4), (4, 10), (10, 7), (1, 14))
# Length of a fingertip's bone with its pad against the bone before it (Buryanov and Kotiuk, 2010: 0.7 to 0.9).
_TIP = 0.9
_PALM_RADIUS, _THUMB_RADIUS, _FINGER_RADIUS = 0.013, 0.012, 0.0095  # m


@dataclass(frozen=True, eq=False)
class Capsules:
    """Round-ended rods: `starts` and `ends` (k, 3) of their axes, and `radii` (k,), in m."""

    starts: Array
    ends: Array
    radii: Array

    def distances(self, points: Array) -> Array:
        """(n,) distances (m) of points (n, 3) to the nearest surface, negative inside."""
        nearest = np.full(len(points), np.inf)
        for start, end, radius in zip(self.starts, self.ends, self.radii, strict=True):
            axis = end - start
            squared = float(axis @ axis)
            along = np.clip((points - start) @ axis / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(len(points))
            away = points - start - along[:, None] * axis
            nearest = np.minimum(nearest, np.sqrt(np.einsum("ij,ij->i", away, away)) - radius)
        return nearest


def hand_capsules(observation: Observation) -> Capsules | None:
    """The hand in the world, or None if there is none.

    The last bone of a finger goes on from the one before it, bent by the finger's last joint.
    """
    if not observation["hand_present"][0]:
        return None
    points = observation["hand_keypoints"].astype(np.float64)
    turns = _turns(observation["hand_dof_position"].astype(np.float64))
    rods = [(points[a], points[b], _PALM_RADIUS) for a, b in _WEB]
    for number, (root, middle, last) in enumerate(_FINGERS):
        radius = _THUMB_RADIUS if number == len(_FINGERS) - 1 else _FINGER_RADIUS
        before, bent = turns[last - 2], turns[last - 1]
        tip = points[last] + _TIP * (bent * before.inv()).apply(points[last] - points[middle])
        rods += [
            (points[_WRIST], points[root], _PALM_RADIUS),
            (points[root], points[middle], radius),
            (points[middle], points[last], radius),
            (points[last], tip, radius),
        ]
    starts, ends, radii = zip(*rods, strict=True)
    return Capsules(np.array(starts), np.array(ends), np.array(radii))


def _turns(dof: Array) -> list[Rotation]:
    """World orientations of the links behind the 15 finger joints."""
    base = Rotation.from_euler("XYZ", dof[3:6])
    turns: list[Rotation] = []
    for joint, angles in enumerate(dof[6:].reshape(15, 3)):
        before = base if joint % 3 == 0 else turns[-1]
        turns.append(before * Rotation.from_euler("XYZ", angles))
    return turns
