"""Closing a right hand's fingers onto an object, many grasps at a time.

Every digit bends along its natural curl, joint by joint; a joint stops as soon as bending it further would press
anything beyond it into the object by more than the skin yields.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import trimesh

from handover_marl.assets.building.hand_meshes import collision_mesh
from handover_marl.assets.building.hand_palm import capsule_balls, forearm_capsules, palm_capsules
from handover_marl.assets.hand_model import BoolArray, FloatArray, HandModel, IntArray, euler_angles
from handover_marl.models.distance_field import DistanceField

#: How far skin may be pressed in while closing (m).
YIELD = 0.002

_STEP = np.deg2rad(3.0)
_STEPS = 34
_RELAXED_STEPS = 7
_BALLS = 3
#: Bending of root, middle and end joint relative to each other, and their limits (rad).
_FINGER_CURL = (_STEP * np.array([1.0, 1.0, 0.55]), np.deg2rad([85.0, 100.0, 65.0]))
_THUMB_CURL = (_STEP * np.array([0.6, 0.7, 0.9]), np.deg2rad([45.0, 55.0, 70.0]))
_THUMB = 4


@dataclass(frozen=True, eq=False)
class Posture:
    """Finger postures of n right hands.

    Attributes:
        bends: (n, 5, 3) bending (rad) of the digits' joints, in `DIGIT_ORDER`.
        spread: (n, 4) sideways turn (rad) of the fingers at the knuckles, towards the thumb.
        thumb_root: (n, 3, 3) rotation of the thumb's root before it bends.
        thumb_axis: (n, 3) unit axis, in the palm's frame, that the thumb bends about.
    """

    bends: FloatArray
    spread: FloatArray
    thumb_root: FloatArray
    thumb_axis: FloatArray

    def __len__(self) -> int:
        return len(self.bends)

    def __getitem__(self, rows: IntArray | BoolArray) -> "Posture":
        return Posture(self.bends[rows], self.spread[rows], self.thumb_root[rows], self.thumb_axis[rows])

    def angles(self) -> FloatArray:
        """(n, 45) joint angles, intrinsic x-y-z Euler."""
        angles = np.zeros((len(self), 5, 3, 3))
        angles[..., 2] = self.bends
        angles[:, :_THUMB, 0, 1] = self.spread
        bends = self.bends[:, _THUMB]
        local = np.einsum("nji,nj->ni", self.thumb_root, self.thumb_axis)
        angles[:, _THUMB, 0] = euler_angles(axis_rotations(self.thumb_axis, bends[:, 0]) @ self.thumb_root)
        for joint in (1, 2):
            angles[:, _THUMB, joint] = euler_angles(axis_rotations(local, bends[:, joint]))
        return angles.reshape(-1, 45)


def axis_rotations(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3) about unit axes (n, 3) by angles (n)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sin, cos = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * cross @ cross)


class HandBalls:
    """A right hand as balls: three along every phalanx, and the palm and forearm."""

    def __init__(self, model: HandModel) -> None:
        self.model = model
        t = (np.arange(_BALLS) + 1.0) / _BALLS
        self._along = model.tips[:, None, :] * t[:, None]
        self.radii = model.radii[:, :1] + (model.radii[:, 1:] - model.radii[:, :1]) * t
        self.palm = capsule_balls(palm_capsules(model), 6)
        # The collision hull also fills what lies between the palm's parts; its skin is points without radius.
        skin = _hull_points() * model.scale
        self.hull = (skin, np.zeros(len(skin)))
        self.forearm = capsule_balls(forearm_capsules(model), 4)

    def phalanges(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ball centres (n, 15, 3, 3) in the palm's frame and the phalanges' rotations (n, 15, 3, 3)."""
        dof = np.concatenate([np.zeros((len(angles), 6)), angles], axis=1)
        dof[:, :3] = -self.model.palm_offset
        positions, rotations = self.model.forward(dof)
        centres = positions[:, 1:, None, :] + np.einsum("nlij,lbj->nlbi", rotations[:, 1:], self._along)
        return centres, rotations[:, 1:]


def clearances(
    field: DistanceField, balls: HandBalls, palms: tuple[FloatArray, FloatArray], angles: FloatArray
) -> FloatArray:
    """Distance (n, 15, 3) (m) from every phalanx ball's skin to the object; negative where it overlaps.

    Args:
        field: The object.
        balls: The hand.
        palms: Positions (n, 3) and rotations (n, 3, 3) of the palm in the object's frame.
        angles: (n, 45) joint angles.
    """
    centres, _ = balls.phalanges(angles)
    return field.clamped(to_object(palms, centres)) - balls.radii


def body_clearance(
    field: DistanceField, palms: tuple[FloatArray, FloatArray], body: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Smallest distance (n) (m) from the palm's or the forearm's balls to the object."""
    centres, radii = body
    points = to_object(palms, np.broadcast_to(centres, (len(palms[0]), *centres.shape)))
    return np.asarray((field.clamped(points) - radii).min(axis=1))


def to_object(palms: tuple[FloatArray, FloatArray], points: FloatArray) -> FloatArray:
    """Points (n, ..., 3) of the palm's frame in the object's frame."""
    position, rotation = palms
    flat = points.reshape(len(points), -1, 3) @ rotation.swapaxes(1, 2) + position[:, None]
    return np.asarray(flat.reshape(points.shape))


def close(field: DistanceField, balls: HandBalls, palms: tuple[FloatArray, FloatArray], posture: Posture) -> Posture:
    """Close every digit from its posture until it touches; a digit that meets nothing stays half open."""
    bends, relaxed = posture.bends.copy(), posture.bends.copy()
    free = np.ones_like(bends, dtype=bool)
    rates = np.stack([_FINGER_CURL[0]] * 4 + [_THUMB_CURL[0]])
    limits = np.stack([_FINGER_CURL[1]] * 4 + [_THUMB_CURL[1]])
    for step in range(_STEPS):
        for joint in range(3):
            trial = bends.copy()
            trial[..., joint] += np.where(free[..., joint], rates[:, joint], 0.0)
            gaps = clearances(field, balls, palms, replace(posture, bends=trial).angles())
            beyond = gaps.reshape(len(bends), 5, 3, _BALLS)[:, :, joint:].min(axis=(2, 3))
            fits = (beyond > -YIELD) & (trial[..., joint] <= limits[:, joint])
            free[..., joint] &= fits
            bends[..., joint] = np.where(free[..., joint], trial[..., joint], bends[..., joint])
        if step == _RELAXED_STEPS:
            relaxed = bends.copy()
        if not free.any():
            break
    gaps = clearances(field, balls, palms, replace(posture, bends=bends).angles())
    touching = gaps.reshape(len(bends), 5, -1).min(axis=2) < 2 * YIELD
    return replace(posture, bends=np.where(touching[..., None], bends, relaxed))


@cache
def _hull_points() -> FloatArray:
    points, _ = trimesh.sample.sample_surface_even(collision_mesh(0), 200, seed=0)
    return np.asarray(points)
