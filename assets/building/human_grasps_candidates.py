"""Candidates of human grasps: open hands with thumb and fingers on opposite sides of the object.

All hands are right hands; grasps of left hands are found on the mirrored object and mirrored back.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.build_hands import make_reference_hand
from handover_marl.assets.building.human_grasps_closing import (
    SKIN_YIELD,
    compute_body_clearance,
    compute_clearances,
)
from handover_marl.assets.hand_model import FloatArray, HandGeometry, IntArray
from handover_marl.assets.hand_openings import (
    OpeningDraws,
    Openings,
    compute_shortest_rotations,
    make_reference_openings,
    normalize,
)
from handover_marl.assets.hand_postures import Palms, Posture
from handover_marl.assets.hand_spheres import HandSpheres
from handover_marl.geometry.distance_field import DistanceField, distance_field_from_mesh

_GRID_SPACING = 0.003
_GRID_MARGIN = 0.05
_N_POSTURES = 1500
_MAX_OPENING = 0.105
_MIN_PALM_GRASP_OPENING = 0.055


@dataclass(frozen=True, eq=False)
class GraspTarget:
    """Object to be grasped.

    Attributes:
        mesh: Surface in the object's frame (m).
        field: Signed distance field of the surface.
    """

    mesh: trimesh.Trimesh
    field: DistanceField

    def mirror(self) -> "GraspTarget":
        """Return the object mirrored in x."""
        faces = np.asarray(self.mesh.faces)[:, ::-1]
        mesh = trimesh.Trimesh(self.mesh.vertices * [-1.0, 1.0, 1.0], faces, process=False)
        return GraspTarget(mesh, self.field.mirror())


def make_grasp_target(mesh: trimesh.Trimesh) -> GraspTarget:
    """Return a grasp target for a mesh, which may have open or overlapping surfaces."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    return GraspTarget(mesh, distance_field_from_mesh(vertices, faces, _GRID_MARGIN, _GRID_SPACING))


@lru_cache(maxsize=1)
def sample_reference_openings() -> Openings:
    """Sample open postures of the reference hand with the thumb opposite the fingers' pads."""
    rng, n = np.random.default_rng(11), 20 * _N_POSTURES
    draws = OpeningDraws(
        root=rng.uniform(size=n),
        middle=rng.uniform(size=n),
        fingers=rng.normal(size=(n, 4, 1)),
        thumb_middle=rng.uniform(size=n),
        thumb_end=rng.uniform(size=n),
        spread=rng.uniform(size=(n, 1)),
        thumb_direction=rng.dirichlet([0.7, 0.7, 1.0], n),
        thumb_target=rng.normal(size=(n, 3)),
    )
    openings = make_reference_openings(draws)
    # Random postures are seldom wide: balance the widths.
    slot = (openings.width / 0.006).astype(int)
    weight = 1.0 / np.bincount(slot)[slot]
    return openings[rng.choice(len(openings), _N_POSTURES, replace=False, p=weight / weight.sum())]


def find_candidates(
    target: GraspTarget, count: int, distances: tuple[float, float], rng: np.random.Generator
) -> tuple[Palms, Posture]:
    """Sample open right hands of reference size around an object, without contact with it.

    Args:
        target: Object.
        count: Number of surface points to try with a pinch grasp; a quarter of this number is tried
            with a palm grasp.
        distances: Smallest and largest distance (m) of the wrist from the object's origin.
        rng: Random generator.
    """
    found = [_sample_pinch_grasps(target, count, rng), _sample_palm_grasps(target, count // 4, rng)]
    palms = Palms.concatenate([palms for palms, _ in found])
    openings = sample_reference_openings().posture[np.concatenate([rows for _, rows in found])]
    wrist = np.linalg.norm(palms.position, axis=1)
    keep = (wrist > distances[0]) & (wrist < distances[1])
    return keep_collision_free(target.field, make_reference_hand(), palms[keep], openings[keep])


def _sample_pinch_grasps(target: GraspTarget, count: int, rng: np.random.Generator) -> tuple[Palms, IntArray]:
    """Sample palm poses whose gaps span opposite surface points, and indices of their openings."""
    openings = sample_reference_openings()
    finger_side, thumb_side = _sample_opposite_points(target.mesh, count, rng)
    across = finger_side - thumb_side
    width = np.linalg.norm(across, axis=1)
    order = np.argsort(openings.width)
    first = np.searchsorted(openings.width[order], width + 0.003)
    last = np.searchsorted(openings.width[order], width + 0.045)
    fits = last > first
    row = order[(first + rng.random(len(width)) * (last - first)).astype(int)[fits]]
    middle, across = ((finger_side + thumb_side) / 2)[fits], (across / width[:, None])[fits]
    rotation = _sample_aligned_rotations(openings.axis[row], across, rng)
    # Fingertip grasps and grasps deep in the hand.
    depth = rng.uniform(0.0, 0.065, len(row)) * (rng.random(len(row)) < 0.75)
    grip = openings.center[row] + np.column_stack([depth, 0.35 * depth, np.zeros_like(depth)])
    middle = middle + rng.normal(0.0, 0.004, middle.shape)
    return Palms(middle - np.einsum("nij,nj->ni", rotation, grip), rotation), row


def _sample_palm_grasps(target: GraspTarget, count: int, rng: np.random.Generator) -> tuple[Palms, IntArray]:
    """Sample palm poses on the surface with open fingers, and indices of their openings."""
    wide = np.flatnonzero(sample_reference_openings().width > _MIN_PALM_GRASP_OPENING)
    points, faces = trimesh.sample.sample_surface(target.mesh, count, seed=int(rng.integers(2**31)))
    normals = np.asarray(target.mesh.face_normals[faces])
    back = np.broadcast_to([0.0, 1.0, 0.0], normals.shape)
    rotation = _sample_aligned_rotations(back, normalize(normals + rng.normal(0.0, 0.2, normals.shape)), rng)
    gap = rng.uniform(0.0, 0.015, count)
    touch = np.column_stack([rng.uniform(-0.09, -0.05, count), -0.019 - gap, rng.uniform(-0.02, 0.02, count)])
    return Palms(points - np.einsum("nij,nj->ni", rotation, touch), rotation), rng.choice(wide, count)


def keep_collision_free(
    field: DistanceField, model: HandGeometry, palms: Palms, posture: Posture
) -> tuple[Palms, Posture]:
    """Return palm poses and postures of the open hands that are entirely outside of the object."""
    spheres = HandSpheres(model)
    for body, least in ((spheres.palm, -SKIN_YIELD), (spheres.forearm, 0.002)):
        keep = compute_body_clearance(field, palms, body) > least
        palms, posture = palms[keep], posture[keep]
    gaps = compute_clearances(field, spheres, palms, posture.compute_joint_angles())
    keep = gaps.min(axis=(1, 2)) > -SKIN_YIELD / 2
    return palms[keep], posture[keep]


def _sample_opposite_points(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Sample pairs of opposite surface points (m, 3), no further apart than a hand opens."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    normals = mesh.face_normals[faces]
    inward = normalize(-normals + rng.normal(0.0, 0.18, normals.shape))
    hits, rays, triangles = mesh.ray.intersects_location(points + 1e-5 * inward, inward, multiple_hits=True)
    leaving = np.einsum("ni,ni->n", mesh.face_normals[triangles], inward[rays])
    distance = np.linalg.norm(hits - points[rays], axis=1)
    good = np.flatnonzero((leaving > 0.6) & (distance < _MAX_OPENING) & (distance > 0.002))
    # A ray through a cup leaves it twice, at its wall and at its far side; take one at random.
    pick = rng.permutation(good)
    _, unique = np.unique(rays[pick], return_index=True)
    pick = pick[unique]
    return points[rays[pick]], hits[pick]


def _sample_aligned_rotations(source: FloatArray, goal: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Sample rotations (n, 3, 3) from unit vectors `source` to the vicinity of `goal`."""
    tilted = normalize(goal + rng.normal(0.0, 0.12, goal.shape))
    turn = Rotation.from_rotvec(tilted * rng.uniform(-np.pi, np.pi, (len(goal), 1)))
    return np.asarray(turn.as_matrix() @ compute_shortest_rotations(source, tilted))
