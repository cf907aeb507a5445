"""Candidates for grasps: pairs of opposite points on an object's surface, in an order that spreads out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.building.object_meshes import merge

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SamplingConfig:
    """How candidates are drawn.

    Attributes:
        max_width: Widest grip (m); the Panda opens 0.08, less some room.
        cone: Largest angle (rad) between closing direction and surface normal at either finger.
        depths: Range of the distance (m) from the hand's frame to the point between the finger pads. The pads end
            at 0.112, the palm at 0.066.
        bridged: Gaps (m) inside a solid made of several parts that count as filled.
    """

    max_width: float = 0.076
    cone: float = 0.26
    depths: tuple[float, float] = (0.084, 0.106)
    bridged: float = 0.0005


class ConvexSolid:
    """A solid given as convex parts that may overlap."""

    def __init__(self, parts: Sequence[trimesh.Trimesh]) -> None:
        self._surface = merge(parts)
        self._planes = [(part.face_normals.copy(), part.triangles[:, 0].copy()) for part in parts]

    def sample_surface(self, n: int, seed: int) -> tuple[Array, Array]:
        """Up to `n` points on the outside and their normals, both (k, 3)."""
        points, faces = trimesh.sample.sample_surface(self._surface, n, seed=seed)
        normals = self._surface.face_normals[faces]
        outside = self.is_outside(points + 2e-4 * normals)
        return np.asarray(points)[outside], np.asarray(normals)[outside]

    def is_outside(self, points: Array) -> npt.NDArray[np.bool_]:
        """Which of the points (k, 3) lie in no part."""
        outside = np.ones(len(points), dtype=bool)
        for normals, corners in self._planes:
            heights = points @ normals.T - np.einsum("fi,fi->f", normals, corners)
            outside &= (heights > 0).any(axis=1)
        return outside

    def exits(self, points: Array, directions: Array, bridged: float) -> tuple[Array, Array]:
        """Lengths of rays (k, 3) entering the solid at `points`, and the normals (k, 3) where they leave it.

        Rays that never enter have length 0.
        """
        entry, leave, leave_normal = self._crossings(points, directions)
        length = np.zeros(len(points))
        normals = np.zeros((len(points), 3))
        rays = np.arange(len(points))
        for _ in range(len(self._planes)):
            reached = np.where(entry <= length + bridged, leave, -np.inf)
            best = reached.argmax(axis=0)
            further = reached[best, rays] > length + 1e-9
            if not further.any():
                break
            length = np.where(further, reached[best, rays], length)
            normals[further] = leave_normal[best, rays][further]
        return length, normals

    def _crossings(self, points: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Where rays enter and leave each part, (parts, k) each (inf and -inf if they miss), and normals there."""
        entries, leaves, normals = [], [], []
        for plane_normals, plane_points in self._planes:
            slope = directions @ plane_normals.T
            gap = np.einsum("fi,fi->f", plane_normals, plane_points) - points @ plane_normals.T
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = gap / slope
            level = np.abs(slope) < 1e-9
            entry = np.where(~level & (slope < 0), crossing, -np.inf).max(axis=1)
            leave = np.where(~level & (slope > 0), crossing, np.inf)
            face = leave.argmin(axis=1)
            leave = leave.min(axis=1)
            misses = (entry > leave) | (level & (gap < -1e-9)).any(axis=1)
            entries.append(np.where(misses, np.inf, entry))
            leaves.append(np.where(misses, -np.inf, leave))
            normals.append(plane_normals[face])
        return np.stack(entries), np.stack(leaves), np.stack(normals)


def sample_candidates(solid: ConvexSolid, n: int, seed: int, config: SamplingConfig | None = None) -> Array:
    """Grasps `object_from_gripper` (k, 4, 4), k below `n`, that pinch the solid between opposite surface points.

    They are not yet checked for collisions.
    """
    config = config or SamplingConfig()
    rng = np.random.default_rng(seed)
    points, normals = solid.sample_surface(n, seed)
    closing = _tilted(-normals, config.cone * np.sqrt(rng.uniform(size=len(points))), rng)
    width, exit_normals = solid.exits(points, closing, config.bridged)
    opposite = np.einsum("ki,ki->k", closing, exit_normals) > np.cos(config.cone)
    good = opposite & (width > 1e-3) & (width < config.max_width)
    points, closing, width = points[good], closing[good], width[good]
    middle = points + 0.5 * width[:, None] * closing
    # Either finger may be the first one.
    closing *= rng.choice([-1.0, 1.0], size=len(points))[:, None]
    approach = _tilted(closing, np.full(len(points), np.pi / 2), rng)
    depth = rng.uniform(*config.depths, size=len(points))
    grasps = np.tile(np.eye(4), (len(points), 1, 1))
    grasps[:, :3, 0] = closing
    grasps[:, :3, 1] = np.cross(approach, closing)
    grasps[:, :3, 2] = approach
    grasps[:, :3, 3] = middle - depth[:, None] * approach
    return grasps


def spread_order(grasps: Array, tip_depth: float = 0.1, length_per_turn: float = 0.05) -> npt.NDArray[np.intp]:
    """Indices that sort grasps (k, 4, 4) so that each is the farthest from all before it.

    Two grasps are near if the points between the fingertips are (m), the approach directions are and the closing
    axes, whichever finger comes first, are; `length_per_turn` (m) weighs directions against positions.
    """
    if not len(grasps):
        return np.zeros(0, dtype=np.intp)
    tips = grasps[:, :3, 3] + tip_depth * grasps[:, :3, 2]
    axes = np.einsum("ki,kj->kij", grasps[:, :3, 0], grasps[:, :3, 0]).reshape(-1, 9)
    features = np.concatenate([tips, length_per_turn * grasps[:, :3, 2], length_per_turn * axes], axis=1)
    order = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    for _ in range(len(grasps) - 1):
        order.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[order[-1]], axis=1))
        distance[order[-1]] = -1.0
    return np.array(order)


def _tilted(directions: Array, angles: Array, rng: np.random.Generator) -> Array:
    """Unit vectors (k, 3) at given angles to `directions` (k, 3), to a random side."""
    sideways = np.cross(directions, rng.normal(size=directions.shape))
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    return np.cos(angles)[:, None] * directions + np.sin(angles)[:, None] * sideways
