"""Closing of the fingers of many right hands on an object.

Digits bend joint by joint. A joint stops when further bending would press a link beyond it into the
object by more than the skin yields.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh

from handover_marl.assets.building.build_hands import make_collision_mesh
from handover_marl.assets.hand_model import FloatArray, HandGeometry
from handover_marl.assets.hand_postures import Palms, Posture
from handover_marl.assets.hand_spheres import N_SPHERES, HandSpheres
from handover_marl.geometry.distance_field import DistanceField

#: Largest penetration (m) of the object into the skin.
SKIN_YIELD = 0.002

_STEP_ANGLE = np.deg2rad(3.0)
_N_STEPS = 34
_N_RELAXED_STEPS = 7
#: Flexion per step of root, middle and end joint, and joint limits (rad).
_FINGER_CURL = (_STEP_ANGLE * np.array([1.0, 1.0, 0.55]), np.deg2rad([85.0, 100.0, 65.0]))
_THUMB_CURL = (_STEP_ANGLE * np.array([0.6, 0.7, 0.9]), np.deg2rad([45.0, 55.0, 70.0]))


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
            beyond = gaps.reshape(len(bends), 5, 3, N_SPHERES)[:, :, joint:].min(axis=(2, 3))
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


def sample_palm_surface(model: HandGeometry) -> tuple[FloatArray, FloatArray]:
    """Return points (k, 3) on the palm's collision mesh in the palm's frame (m), and radii (k,) of 0.

    The mesh is a hull, so it also fills the gaps between the palm's spheres.
    """
    skin = _sample_hull_points() * model.scale
    return skin, np.zeros(len(skin))


@cache
def _sample_hull_points() -> FloatArray:
    points, _ = trimesh.sample.sample_surface_even(make_collision_mesh(0), 200, seed=0)
    return np.asarray(points)
