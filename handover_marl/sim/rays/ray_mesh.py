"""Casting rays at one rigid mesh. Needs the extra `vision`."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

Array = npt.NDArray[np.float32]

# How far behind a face that is seen from its back a ray goes on (m).
_BEHIND = np.float32(1e-5)
# A ray that meets more back faces than this is lost in a mesh that is all inside out.
_DEEPEST = 32


@dataclass(frozen=True, eq=False)
class Hits:
    """What n rays met of a mesh first: `ray` (n,), which ray, `depth` (n,) float32 (m), and `face` (n,)."""

    ray: npt.NDArray[np.int64]
    depth: Array
    face: npt.NDArray[np.int32]


class RayMesh:
    """A rigid mesh, seen from outside only.

    Args:
        vertices: (v, 3) float32 (m).
        faces: (f, 3) int32, counterclockwise seen from outside.
    """

    def __init__(self, vertices: Array, faces: npt.NDArray[np.int32]) -> None:
        self.vertices, self.faces = vertices, faces
        corners = vertices[faces]
        #: (f, 3) outward normals, as long as twice the triangle's area.
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)

    def cast(self, start: Array, ways: Array, begin: float, ends: Array) -> Hits:
        """What rays meet first, back faces passed through; rays that meet nothing are left out.

        Args:
            start: (3,) where all rays start, in the mesh's frame (m).
            ways: (n, 3) their directions in that frame; what is met so many times farther is so deep.
            begin: The depth before which nothing counts (m).
            ends: (n,) the depths behind which nothing does (m).
        """
        first = np.float32(begin)
        found = self._scene.run(start + first * ways, ways, dists=ends - first, output=1)
        ray = np.flatnonzero(found["primID"] >= 0)
        depth, face = first + found["tfar"][ray], found["primID"][ray]
        inside = self._backs(face, ways[ray])
        if not inside.any():
            return Hits(ray, depth, face)
        kept = [(ray[~inside], depth[~inside], face[~inside])]
        ray, depth = ray[inside], depth[inside]
        for _ in range(_DEEPEST):
            if not len(ray):
                break
            # Faces that turn their back are passed: the ray goes on behind them.
            way, begun = ways[ray], depth + _BEHIND
            found = self._scene.run(start + begun[:, None] * way, way, dists=ends[ray] - begun, output=1)
            met = np.flatnonzero(found["primID"] >= 0)
            ray, depth, face = ray[met], begun[met] + found["tfar"][met], found["primID"][met]
            inside = self._backs(face, ways[ray])
            kept.append((ray[~inside], depth[~inside], face[~inside]))
            ray, depth = ray[inside], depth[inside]
        rays, depths, faces = zip(*kept, strict=True)
        return Hits(np.concatenate(rays), np.concatenate(depths), np.concatenate(faces))

    def _backs(self, face: npt.NDArray[np.int32], way: Array) -> npt.NDArray[np.bool_]:
        """Which faces turn their back to the rays that met them."""
        backs: npt.NDArray[np.bool_] = np.einsum("ij,ij->i", self.normals[face], way) >= 0.0
        return backs
