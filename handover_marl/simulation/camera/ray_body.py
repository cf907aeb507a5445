"""Visual meshes of URDF models for ray casting; needs embreex (extra `vision`)."""

import functools
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import read_visual_meshes
from handover_marl.geometry.model_files.surfaces import Surface, read_surfaces
from handover_marl.geometry.model_files.urdf import read_model_mtimes
from handover_marl.geometry.poses import IDENTITY
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import BACK_FACE_OFFSET, INVISIBLE_LINKS, MAX_BACK_FACES

Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

_ORIGIN = tuple(IDENTITY.tolist())
# Whether each of a box's eight corners is on its higher side, by axis.
_IS_HIGH = np.array(list(itertools.product((False, True), repeat=3)))


class RayHits(NamedTuple):
    """Hits of rays on a mesh: the first front face that each ray hits. Only the n rays with a hit are listed.

    Attributes:
        ray: (n,) indices of the rays.
        depth: (n,) float32 depths of the hits along the viewing axis (m).
        face: (n,) numbers of the mesh faces.
        weights: (n, 2) barycentric coordinates of the hits: weights of the faces' second and third vertex.
    """

    ray: npt.NDArray[np.int64]
    depth: Array
    face: npt.NDArray[np.int32]
    weights: Array


class RayMesh:
    """Rigid triangle mesh for ray casting, visible from outside only.

    Args:
        vertices: (v, 3) float32 vertices (m).
        faces: (f, 3) int32 vertex numbers, counterclockwise seen from outside.

    Attributes:
        normals: (f, 3) outward normals, each with twice the triangle's area as its length.
    """

    def __init__(self, vertices: Array, faces: npt.NDArray[np.int32]) -> None:
        self.vertices, self.faces = vertices, faces
        corners = vertices[faces]
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)

    def cast_rays(self, start: Array, directions: Array, near: float, far: Array) -> RayHits:
        """Return the first front face of the mesh that each ray hits; rays without a hit are left out.

        Args:
            start: (3,) common origin of all rays in the mesh's frame (m).
            directions: (n, 3) directions in the mesh's frame; depth is in units of their length.
            near: Depth before which hits are ignored (m).
            far: (n,) depths behind which hits are ignored (m).
        """
        # All rays begin at one depth, and continue behind the back faces that they hit.
        ray, begin, hits = None, np.full(1, near, dtype=np.float32), list[RayHits]()
        for _ in range(MAX_BACK_FACES + 1):
            # Loops over columns, and `take`, are several times as fast as operations on rows.
            starts = directions * (begin[0] if len(begin) == 1 else begin[:, None])
            for axis in range(3):
                starts[:, axis] += start[axis]
            found = self._scene.run(starts, directions, dists=far - begin, output=1)
            (hit,) = np.nonzero(found["primID"] >= 0)
            face, weights = found["primID"][hit], np.empty((len(hit), 2), np.float32)
            towards, normals = directions.take(hit, axis=0), self.normals.take(face, axis=0)
            weights[:, 0], weights[:, 1] = found["u"][hit], found["v"][hit]
            depth = (begin if len(begin) == 1 else begin[hit]) + found["tfar"][hit]
            is_back = sum(towards[:, axis] * normals[:, axis] for axis in range(3)) >= 0.0
            latest = RayHits(hit if ray is None else ray[hit], depth, face, weights)
            if not is_back.any():
                hits.append(latest)
                break
            hits.append(RayHits(*(part[~is_back] for part in latest)))
            # Back faces are invisible: the ray continues behind them.
            ray, directions, far = latest.ray[is_back], towards[is_back], far[hit][is_back]
            begin = depth[is_back] + np.float32(BACK_FACE_OFFSET)
        if len(hits) == 1:
            return hits[0]
        return RayHits(*(np.concatenate(parts) for parts in zip(*hits, strict=True)))


class RayBody:
    """Visual meshes of a URDF model for ray casting, one rigid mesh per link.

    Args:
        urdf: Model file.
        label: Segmentation label of the body's pixels.
        base: (7,) world pose of the base link, xyz (m) and quaternion xyzw.

    Attributes:
        meshes: Meshes of the n links that have visual shapes.
        corners: (n, 8, 3) corners of the meshes' bounding boxes, in the links' frames (m).
    """

    def __init__(self, urdf: Path, label: SegmentationLabel, base: npt.ArrayLike) -> None:
        self._urdf, self._tree, self.label = urdf, read_tree(urdf), label
        self._without = INVISIBLE_LINKS if label is SegmentationLabel.ROBOT else ()
        pose = np.asarray(base, dtype=np.float64)
        self._base_rotation, self._base_origin = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
        visual_meshes = read_visual_meshes(urdf, self._tree, self._without)
        self._links = [mesh.link for mesh in visual_meshes]
        self.meshes = [RayMesh(mesh.vertices, mesh.faces) for mesh in visual_meshes]
        lowest = np.array([mesh.vertices.min(axis=0) for mesh in self.meshes]).reshape(-1, 1, 3)
        highest = np.array([mesh.vertices.max(axis=0) for mesh in self.meshes]).reshape(-1, 1, 3)
        self.corners = np.where(_IS_HIGH, highest, lowest)
        self._last_frames: tuple[Array, Float64Array, Float64Array] | None = None

    @functools.cached_property
    def surfaces(self) -> list[Surface]:
        """Colors of `meshes`, in the same order; read when an image with colors is rendered for the first time."""
        return read_surfaces(self._urdf, self._tree, self._without)

    def compute_mesh_frames(self, joints: Array) -> tuple[Float64Array, Float64Array]:
        """Return world origins (n, 3) in m and rotations (n, 3, 3) of the links with meshes at joint positions (d,)."""
        origins, rotations = self.compute_link_frames(joints)
        return origins[self._links], rotations[self._links]

    def compute_link_frames(self, joints: Array) -> tuple[Float64Array, Float64Array]:
        """Return world origins (L + 1, 3) in m and rotations (L + 1, 3, 3) of L links, then base, at joints (d,)."""
        # Table, resting objects and hand often have the same joints in two successive images.
        # Another thread may use the same body, so the frames are stored and read in one piece.
        frames = self._last_frames
        if frames is None or not np.array_equal(joints, frames[0]):
            origins, rotations = self._tree.compute_link_frames(joints[None])
            self._last_frames = frames = (
                joints.copy(),
                np.concatenate([origins[0] @ self._base_rotation.T + self._base_origin, self._base_origin[None]]),
                np.concatenate([self._base_rotation @ rotations[0], self._base_rotation[None]]),
            )
        return frames[1:]


@cached_by_file(64, read_model_mtimes)
def load_ray_body(urdf: Path, label: SegmentationLabel, base: tuple[float, ...] = _ORIGIN) -> RayBody:
    """Load a URDF file's visual meshes for ray casting, with `label` for their pixels; unchanged files are read once.

    `base` (7,) is the world pose of the base link: xyz (m), quaternion xyzw.
    """
    return RayBody(urdf, label, base)
