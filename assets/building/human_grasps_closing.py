"""Closing of the fingers of many right hands on an object.

Digits bend joint by joint. A joint stops when further bending would press a link beyond it into the
object by more than the skin yields.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import trimesh
from typing_extensions import Self

from handover_marl.assets.building.build_hands import (
    make_collision_mesh,
    make_forearm_capsules,
    make_palm_capsules,
    spheres_from_capsules,
)
from handover_marl.assets.hand_model import BoolArray, FloatArray, HandGeometry, IntArray, euler_from_matrices
from handover_marl.geometry.distance_field import DistanceField

#: Largest penetration (m) of the object into the skin.
SKIN_YIELD = 0.002

_STEP_ANGLE = np.deg2rad(3.0)
_N_STEPS = 34
_N_RELAXED_STEPS = 7
_N_SPHERES = 3
#: Flexion per step of root, middle and end joint, and joint limits (rad).
_FINGER_CURL = (_STEP_ANGLE * np.array([1.0, 1.0, 0.55]), np.deg2rad([85.0, 100.0, 65.0]))
_THUMB_CURL = (_STEP_ANGLE * np.array([0.6, 0.7, 0.9]), np.deg2rad([45.0, 55.0, 70.0]))
_THUMB = 4


class ArrayBatch:
    """Base class of dataclasses of n items; n is the first dimension of all fields."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))  # type: ignore[arg-type]

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return all items of several batches as one batch."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))  # type: ignore[arg-type]
        return cls(
            *(
                type(column[0]).concatenate(column) if isinstance(column[0], ArrayBatch) else np.concatenate(column)
                for column in columns
            )
        )


@dataclass(frozen=True, eq=False)
class Palms(ArrayBatch):
    """Poses of n palms in the object's frame.

    Attributes:
        position: (n, 3) positions (m).
        rotation: (n, 3, 3) rotation matrices.
    """

    position: FloatArray
    rotation: FloatArray

    def transform(self, points: FloatArray) -> FloatArray:
        """Transform points (n, ..., 3) from the palm's frame to the object's frame."""
        flat = points.reshape(len(points), -1, 3) @ self.rotation.swapaxes(1, 2) + self.position[:, None]
        return np.asarray(flat.reshape(points.shape))


@dataclass(frozen=True, eq=False)
class Posture(ArrayBatch):
    """Finger postures of n right hands.

    Attributes:
        bends: (n, 5, 3) flexion (rad) of the digits' joints, in `DIGIT_ORDER`.
        spread: (n, 4) abduction (rad) of the fingers at the knuckles, towards the thumb.
        thumb_root: (n, 3, 3) rotation of the thumb's root before flexion.
        thumb_axis: (n, 3) unit axis of the thumb's flexion in the palm's frame.
    """

    bends: FloatArray
    spread: FloatArray
    thumb_root: FloatArray
    thumb_axis: FloatArray

    def compute_joint_angles(self) -> FloatArray:
        """Return the finger joint angles (n, 45), intrinsic XYZ Euler angles (rad)."""
        angles = np.zeros((len(self), 5, 3, 3))
        angles[..., 2] = self.bends
        angles[:, :_THUMB, 0, 1] = self.spread
        bends = self.bends[:, _THUMB]
        local = np.einsum("nji,nj->ni", self.thumb_root, self.thumb_axis)
        angles[:, _THUMB, 0] = euler_from_matrices(
            make_rotations_about_axes(self.thumb_axis, bends[:, 0]) @ self.thumb_root
        )
        for joint in (1, 2):
            angles[:, _THUMB, joint] = euler_from_matrices(make_rotations_about_axes(local, bends[:, joint]))
        return angles.reshape(-1, 45)


def make_rotations_about_axes(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Return rotation matrices (n, 3, 3) about unit axes (n, 3) by angles (n,) (rad)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sin, cos = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * cross @ cross)


class HandSpheres:
    """Approximation of a right hand by spheres: three per phalanx, others in palm and forearm.

    Args:
        model: Geometry of a right hand.

    Attributes:
        model: Geometry of the hand.
        radii: (15, 3) radii (m) of the phalanges' spheres.
        palm: Centers (k, 3) and radii (k,) (m) of the palm's spheres, in the palm's frame.
        hull: Points (k, 3) on the palm's collision mesh in the palm's frame (m), and their radii
            (k,), all 0.
        forearm: Centers and radii of the forearm's spheres, in the palm's frame (m).
    """

    def __init__(self, model: HandGeometry) -> None:
        self.model = model
        t = (np.arange(_N_SPHERES) + 1.0) / _N_SPHERES
        self._along = model.tips[:, None, :] * t[:, None]
        self.radii = model.radii[:, :1] + (model.radii[:, 1:] - model.radii[:, :1]) * t
        self.palm = spheres_from_capsules(make_palm_capsules(model), 6)
        # The collision mesh is a hull, so it also fills the gaps between the palm's spheres.
        skin = _sample_hull_points() * model.scale
        self.hull = (skin, np.zeros(len(skin)))
        self.forearm = spheres_from_capsules(make_forearm_capsules(model), 4)

    def place_phalanges(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the centers of the phalanges' spheres and the phalanges' rotations.

        Args:
            angles: (n, 45) finger joint angles (rad).

        Returns:
            (n, 15, 3, 3) positions of three spheres for each phalanx (m), and (n, 15, 3, 3) rotation
            matrices, both in the palm's frame.
        """
        dof = np.concatenate([np.zeros((len(angles), 6)), angles], axis=1)
        dof[:, :3] = -self.model.palm_offset
        positions, rotations = self.model.compute_link_poses(dof)
        centers = positions[:, 1:, None, :] + np.einsum("nlij,lbj->nlbi", rotations[:, 1:], self._along)
        return centers, rotations[:, 1:]


def compute_clearances(field: DistanceField, spheres: HandSpheres, palms: Palms, angles: FloatArray) -> FloatArray:
    """Return the distances (n, 15, 3) in m between the phalanges' spheres and the object.

    Args:
        field: Signed distance field of the object.
        spheres: Spheres that approximate the hand.
        palms: Palm poses in the object's frame.
        angles: (n, 45) finger joint angles (rad).
    """
    centers, _ = spheres.place_phalanges(angles)
    return field.compute_clamped_distances(palms.transform(centers)) - spheres.radii


def compute_body_clearance(field: DistanceField, palms: Palms, body: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the smallest distance (n,) in m between a part of each hand and the object.

    Args:
        field: Signed distance field of the object.
        palms: Palm poses in the object's frame.
        body: Centers (k, 3) and radii (k,) of the part's spheres in the palm's frame (m).
    """
    centers, radii = body
    points = palms.transform(np.broadcast_to(centers, (len(palms), *centers.shape)))
    return np.asarray((field.compute_clamped_distances(points) - radii).min(axis=1))


def close_fingers(field: DistanceField, spheres: HandSpheres, palms: Palms, posture: Posture) -> Posture:
    """Return the postures in which the digits are closed until they touch the object.

    A digit that does not reach the object stays half open.

    Args:
        field: Signed distance field of the object.
        spheres: Spheres that approximate the hand.
        palms: Palm poses in the object's frame.
        posture: Open postures.
    """
    bends, relaxed = posture.bends.copy(), posture.bends.copy()
    free = np.ones_like(bends, dtype=bool)
    rates = np.stack([_FINGER_CURL[0]] * 4 + [_THUMB_CURL[0]])
    limits = np.stack([_FINGER_CURL[1]] * 4 + [_THUMB_CURL[1]])
    for step in range(_N_STEPS):
        for joint in range(3):
            trial = bends.copy()
            trial[..., joint] += np.where(free[..., joint], rates[:, joint], 0.0)
            gaps = compute_clearances(field, spheres, palms, replace(posture, bends=trial).compute_joint_angles())
            beyond = gaps.reshape(len(bends), 5, 3, _N_SPHERES)[:, :, joint:].min(axis=(2, 3))
            fits = (beyond > -SKIN_YIELD) & (trial[..., joint] <= limits[:, joint])
            free[..., joint] &= fits
            bends[..., joint] = np.where(free[..., joint], trial[..., joint], bends[..., joint])
        if step == _N_RELAXED_STEPS:
            relaxed = bends.copy()
        if not free.any():
            break
    gaps = compute_clearances(field, spheres, palms, replace(posture, bends=bends).compute_joint_angles())
    touching = gaps.reshape(len(bends), 5, -1).min(axis=2) < 2 * SKIN_YIELD
    return replace(posture, bends=np.where(touching[..., None], bends, relaxed))


@cache
def _sample_hull_points() -> FloatArray:
    points, _ = trimesh.sample.sample_surface_even(make_collision_mesh(0), 200, seed=0)
    return np.asarray(points)
