"""Candidates for human grasps: hands placed so that thumb and fingers face each other across the object.

Everything is done with a right hand; a left hand's grasps are found on the mirrored object and mirrored back.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.hand_meshes import reference_hand
from handover_marl.assets.building.human_grasps_closing import (
    YIELD,
    HandBalls,
    Posture,
    body_clearance,
    clearances,
)
from handover_marl.assets.hand_model import FloatArray, HandModel, IntArray
from handover_marl.models.distance_field import DistanceField, mesh_field

#: A person's palm pose in the object's frame: positions (n, 3) (m) and rotations (n, 3, 3).
Palms = tuple[FloatArray, FloatArray]

_GRID_SPACING = 0.003
_GRID_MARGIN = 0.05
_N_POSTURES = 1500
_WIDEST = 0.105
_WIDE_OPEN = 0.055
# Directions of the thumb's first bone in the palm's frame that its postures lie between: forward beside the index
# finger, spread away from it in the plane of the palm, and in front of the palm opposite the fingers.
_THUMB_DIRECTIONS = np.array([[-0.80, -0.40, 0.44], [-0.58, -0.24, 0.78], [-0.42, -0.87, 0.25]])
# What the thumb bends towards: below the middle finger's first bone (m, reference hand).
_THUMB_AIM = np.array([-0.100, -0.030, 0.002])


@dataclass(frozen=True, eq=False)
class GraspTarget:
    """An object to be held.

    Attributes:
        mesh: Its surface in its own frame (m).
        field: Signed distance to it.
    """

    mesh: trimesh.Trimesh
    field: DistanceField

    def mirrored(self) -> "GraspTarget":
        """The object mirrored in x."""
        faces = np.asarray(self.mesh.faces)[:, ::-1]
        mesh = trimesh.Trimesh(self.mesh.vertices * [-1.0, 1.0, 1.0], faces, process=False)
        return GraspTarget(mesh, self.field.mirrored())


def grasp_target(mesh: trimesh.Trimesh) -> GraspTarget:
    """Sample the signed distance to a mesh, robust against open or overlapping shells."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    return GraspTarget(mesh, mesh_field(vertices, faces, _GRID_MARGIN, _GRID_SPACING))


@dataclass(frozen=True, eq=False)
class Openings:
    """Open hand postures and the gap between thumb and fingers, in the palm's frame of one hand.

    Attributes:
        posture: The postures (n).
        centre: (n, 3) middle of the gap (m).
        axis: (n, 3) unit vector from the thumb's pad to the fingers' pads.
        width: (n) free width of the gap (m).
    """

    posture: Posture
    centre: FloatArray
    axis: FloatArray
    width: FloatArray


def measure_openings(model: HandModel, posture: Posture) -> Openings:
    """Where the gaps of some postures lie in a hand of some size."""
    balls = HandBalls(model)
    centres, _ = balls.phalanges(posture.angles())
    thumb, fingers = centres[:, 14, -1], (centres[:, 2, -1] + centres[:, 5, -1]) / 2
    between = fingers - thumb
    distance = np.linalg.norm(between, axis=1)
    width = distance - balls.radii[14, -1] - balls.radii[2, -1]
    return Openings(posture, (thumb + fingers) / 2, between / distance[:, None], width)


@lru_cache(maxsize=1)
def reference_openings() -> Openings:
    """Random open postures of the reference hand whose thumb stands opposite the fingers' pads."""
    rng, n = np.random.default_rng(11), 20 * _N_POSTURES
    root, middle = rng.uniform(0.05, 1.15, n), rng.uniform(0.08, 1.0, n)
    one_finger = np.stack([root, middle, 0.5 * middle], axis=1)
    fingers = one_finger[:, None] + rng.normal(0.0, 0.04, (n, 4, 1)) * [1.0, 1.0, 0.5]
    thumb = np.column_stack([np.zeros(n), rng.uniform(0.0, 0.4, n), rng.uniform(0.0, 0.5, n)])
    bends = np.maximum(np.concatenate([fingers, thumb[:, None]], axis=1), 0.0)
    spread = rng.uniform(-0.05, 0.12, (n, 1)) * np.array([1.0, 0.1, -2.0, -0.9])
    rest = reference_hand().tips[12] / np.linalg.norm(reference_hand().tips[12])
    direction = _unit(rng.dirichlet([0.7, 0.7, 1.0], n) @ _THUMB_DIRECTIONS)
    aim = _THUMB_AIM - reference_hand().joint_origins[12] + rng.normal(0.0, 0.015, (n, 3))
    roots = _shortest_rotations(rest, direction)
    openings = measure_openings(reference_hand(), Posture(bends, spread, roots, _unit(np.cross(direction, aim))))
    _, rotations = HandBalls(reference_hand()).phalanges(openings.posture.angles())
    pads = -(rotations[:, 2, :, 1] + rotations[:, 5, :, 1]) / 2
    facing = np.einsum("ni,ni->n", pads, -openings.axis)
    good = np.flatnonzero((facing > 0.2) & (openings.width > 0.012))
    # As many wide as narrow ones: random postures are seldom wide.
    slot = (openings.width[good] / 0.006).astype(int)
    weight = 1.0 / np.bincount(slot)[slot]
    good = rng.choice(good, _N_POSTURES, replace=False, p=weight / weight.sum())
    return _rows(openings, good)


def find_candidates(
    target: GraspTarget, count: int, distances: tuple[float, float], rng: np.random.Generator
) -> tuple[Palms, Posture]:
    """Open right hands of reference size around an object and clear of it.

    Args:
        target: The object.
        count: How many places on its surface to try, each with a grip across and a grip by the palm.
        distances: Nearest and furthest wrist from the object's origin (m).
        rng: Source of randomness.
    """
    found = [_across(target, count, rng), _by_palm(target, count // 4, rng)]
    position, rotation = (np.concatenate([palms[part] for palms, _ in found]) for part in (0, 1))
    openings = reference_openings().posture[np.concatenate([rows for _, rows in found])]
    wrist = np.linalg.norm(position, axis=1)
    keep = (wrist > distances[0]) & (wrist < distances[1])
    return clear_ones(target.field, reference_hand(), (position[keep], rotation[keep]), openings[keep])


def _across(target: GraspTarget, count: int, rng: np.random.Generator) -> tuple[Palms, IntArray]:
    """Palms whose gap between thumb and fingers spans two opposite points, and the openings' numbers."""
    openings = reference_openings()
    finger_side, thumb_side = _opposite_points(target.mesh, count, rng)
    across = finger_side - thumb_side
    width = np.linalg.norm(across, axis=1)
    order = np.argsort(openings.width)
    first = np.searchsorted(openings.width[order], width + 0.003)
    last = np.searchsorted(openings.width[order], width + 0.045)
    fits = last > first
    row = order[(first + rng.random(len(width)) * (last - first)).astype(int)[fits]]
    middle, across = ((finger_side + thumb_side) / 2)[fits], (across / width[:, None])[fits]
    rotation = _aligned_rotations(openings.axis[row], across, rng)
    # Some objects are held at the fingertips, others deep in the hand.
    depth = rng.uniform(0.0, 0.065, len(row)) * (rng.random(len(row)) < 0.75)
    grip = openings.centre[row] + np.column_stack([depth, 0.35 * depth, np.zeros_like(depth)])
    middle = middle + rng.normal(0.0, 0.004, middle.shape)
    return (middle - np.einsum("nij,nj->ni", rotation, grip), rotation), row


def _by_palm(target: GraspTarget, count: int, rng: np.random.Generator) -> tuple[Palms, IntArray]:
    """Palms laid onto the surface with the fingers open, and the openings' numbers."""
    wide = np.flatnonzero(reference_openings().width > _WIDE_OPEN)
    points, faces = trimesh.sample.sample_surface(target.mesh, count, seed=int(rng.integers(2**31)))
    normals = np.asarray(target.mesh.face_normals[faces])
    back = np.broadcast_to([0.0, 1.0, 0.0], normals.shape)
    rotation = _aligned_rotations(back, _unit(normals + rng.normal(0.0, 0.2, normals.shape)), rng)
    gap = rng.uniform(0.0, 0.015, count)
    touch = np.column_stack([rng.uniform(-0.09, -0.05, count), -0.019 - gap, rng.uniform(-0.02, 0.02, count)])
    return (points - np.einsum("nij,nj->ni", rotation, touch), rotation), rng.choice(wide, count)


def clear_ones(field: DistanceField, model: HandModel, palms: Palms, posture: Posture) -> tuple[Palms, Posture]:
    """Those open hands that stay outside the object with palm, forearm and fingers."""
    balls = HandBalls(model)
    for body, least in ((balls.palm, -YIELD), (balls.forearm, 0.002)):
        keep = body_clearance(field, palms, body) > least
        palms, posture = (palms[0][keep], palms[1][keep]), posture[keep]
    gaps = clearances(field, balls, palms, posture.angles())
    keep = gaps.min(axis=(1, 2)) > -YIELD / 2
    return (palms[0][keep], palms[1][keep]), posture[keep]


def _opposite_points(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Pairs of surface points (m, 3) facing away from each other, no further apart than a hand opens."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    normals = mesh.face_normals[faces]
    inward = _unit(-normals + rng.normal(0.0, 0.18, normals.shape))
    hits, rays, triangles = mesh.ray.intersects_location(points + 1e-5 * inward, inward, multiple_hits=True)
    leaving = np.einsum("ni,ni->n", mesh.face_normals[triangles], inward[rays])
    distance = np.linalg.norm(hits - points[rays], axis=1)
    good = np.flatnonzero((leaving > 0.6) & (distance < _WIDEST) & (distance > 0.002))
    # A ray through a cup leaves it twice: by its wall, and on its far side. Either may be held.
    pick = rng.permutation(good)
    _, unique = np.unique(rays[pick], return_index=True)
    pick = pick[unique]
    return points[rays[pick]], hits[pick]


def _aligned_rotations(source: FloatArray, goal: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Rotations (n, 3, 3) taking unit vectors `source` near unit vectors `goal`, free about them."""
    tilted = _unit(goal + rng.normal(0.0, 0.12, goal.shape))
    turn = Rotation.from_rotvec(tilted * rng.uniform(-np.pi, np.pi, (len(goal), 1)))
    return np.asarray(turn.as_matrix() @ _shortest_rotations(source, tilted))


def _shortest_rotations(source: FloatArray, goal: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) taking unit vectors to unit vectors the shortest way."""
    source = np.broadcast_to(source, goal.shape)
    axis = np.cross(source, goal)
    sine, cosine = np.linalg.norm(axis, axis=1), np.einsum("ni,ni->n", source, goal)
    # For opposite vectors any axis across them will do; such exact cases do not occur in random samples.
    scaled = axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    return np.asarray(Rotation.from_rotvec(scaled).as_matrix())


def _rows(openings: Openings, rows: IntArray) -> Openings:
    return Openings(openings.posture[rows], openings.centre[rows], openings.axis[rows], openings.width[rows])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
