"""Meshes of the reference right hand: a rounded palm with thenar, and phalanges as tapered capsules.

Needs the generators' libraries (trimesh, manifold3d); nothing at run time imports this.
"""

from collections.abc import Callable

import manifold3d
import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.anthropometry import REFERENCE_SIZE
from handover_marl.assets.building.hand_palm import forearm_capsules, palm_capsules
from handover_marl.assets.hand_model import DIGIT_ORDER, FloatArray, HandModel, sized_hand
from handover_marl.models.hulls import extreme_points

#: Most vertices of a collision mesh: Bullet's convex shapes get slow beyond.
MAX_COLLISION_VERTICES = 60

#: Link names in the order of the meshes: palm, then the phalanges.
MESH_NAMES = ("palm", *(f"{digit}{joint}" for digit in DIGIT_ORDER for joint in (1, 2, 3)))

_EDGE_LENGTH = 0.0038
_BLEND = 0.007

# trimesh leaves its types open.
_align_vectors: Callable[[npt.ArrayLike, npt.ArrayLike], FloatArray] = trimesh.geometry.align_vectors


def reference_hand() -> HandModel:
    """The right hand that the meshes are made for; all others scale it."""
    return sized_hand(REFERENCE_SIZE, "right")


def visual_mesh(link: int) -> trimesh.Trimesh:
    """Fine mesh of a link (0 palm, 1 to 15 phalanges) in its own frame (m)."""
    if link == 0:
        return _palm_mesh(reference_hand())
    ring, profile, waist = 18, 6, 0.94
    return _capsule(link, ring, profile, waist)


def collision_mesh(link: int) -> trimesh.Trimesh:
    """Convex mesh of a link of at most `MAX_COLLISION_VERTICES` vertices, in its own frame (m)."""
    if link > 0:
        return _convex_hull(np.asarray(_capsule(link, 8, 3, 1.0).vertices))
    balls = [
        end + radius * _sphere_points(7, 1)
        for start, stop, first, last in palm_capsules(reference_hand())
        for end, radius in ((start, first), (stop, last))
    ]
    hull = _convex_hull(np.vstack(balls))
    return _convex_hull(extreme_points(np.asarray(hull.vertices), MAX_COLLISION_VERTICES))


def _convex_hull(points: FloatArray) -> trimesh.Trimesh:
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    return hull


def _capsule(link: int, ring: int, profile: int, waist: float) -> trimesh.Trimesh:
    """Tapered capsule along a phalanx's axis, its ends half balls, slimmed to `waist` halfway."""
    hand = reference_hand()
    tip, (first, last) = hand.tips[link - 1], hand.radii[link - 1]
    length = float(np.linalg.norm(tip))
    # Both balls touch the cone where its slope says so; otherwise a dent shows at the joint.
    slope = np.arcsin((first - last) / length)
    start = np.linspace(-np.pi / 2, slope, profile)
    end = np.linspace(slope, np.pi / 2, profile)
    line = [(first * np.cos(a), first * np.sin(a)) for a in start]
    if waist < 1.0 and link % 3:
        line.append((waist * (first + last) / 2, length / 2))
    line += [(last * np.cos(a), length + last * np.sin(a)) for a in end]
    line[0], line[-1] = (0.0, line[0][1]), (0.0, line[-1][1])
    mesh = trimesh.creation.revolve(np.array(line), sections=ring)
    mesh.apply_transform(_align_vectors([0.0, 0.0, 1.0], tip / length))
    return mesh


def _palm_mesh(hand: HandModel) -> trimesh.Trimesh:
    capsules = [(a, b - a, r0, r1) for a, b, r0, r1 in palm_capsules(hand) + forearm_capsules(hand)]

    def inside(x: float, y: float, z: float) -> float:
        # Smooth union: a soft maximum of the depths below each capsule's skin.
        point, depths = np.array([x, y, z]), []
        for start, axis, first, last in capsules:
            t = min(max(float((point - start) @ axis / (axis @ axis)), 0.0), 1.0)
            offset = point - start - t * axis
            depths.append(first + t * (last - first) - float(np.sqrt(offset @ offset)))
        values = np.array(depths) / _BLEND
        top = values.max()
        blended = top + np.log(np.exp(values - top).sum()) - 0.55
        # The forearm ends flat.
        return float(min(_BLEND * blended, 0.075 - x))

    solid = manifold3d.Manifold.level_set(inside, [-0.125, -0.05, -0.07, 0.08, 0.04, 0.065], _EDGE_LENGTH)
    solid = solid.simplify(0.00025)
    mesh = solid.to_mesh()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


def _sphere_points(around: int, rings: int) -> FloatArray:
    """Points on a unit ball: poles and `2 * rings + 1` parallels."""
    polar = np.linspace(0.0, np.pi, 2 * rings + 3)[1:-1]
    turn = np.arange(around) * 2.0 * np.pi / around
    points = [[np.sin(p) * np.cos(t), np.cos(p), np.sin(p) * np.sin(t)] for p in polar for t in turn]
    return np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], *points])
