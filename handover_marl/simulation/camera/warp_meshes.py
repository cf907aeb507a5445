"""Visual meshes of URDF models on a device, for ray casting with Warp."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp
from scipy.spatial.transform import Rotation

from handover_marl.geometry.arrays import ArrayFactory, RowBank
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import VisualMesh, read_visual_meshes
from handover_marl.geometry.model_files.surfaces import read_surfaces
from handover_marl.geometry.model_files.urdf import read_model_mtimes
from handover_marl.geometry.poses import IDENTITY

#: Link number of meshes whose vertices are in the world frame.
WORLD = -1


class DeviceMesh(NamedTuple):
    """Mesh of one link of a model.

    Attributes:
        number: Number of the mesh in its `MeshBank`.
        link: Number of the link in whose frame the mesh is; `WORLD` for meshes that never move.
    """

    number: int
    link: int


class MeshBank:
    """Visual meshes on Warp's current device; a model whose files have not changed is copied once.

    Mesh 0 is none: its identifier is 0.

    Args:
        arrays: Creator of tensors on the device.

    Attributes:
        identifiers: Identifiers (m,) of Warp's meshes, int64.
        spheres: Centers and radii (m, 4) of bounding spheres in the meshes' frames (m).
        first_faces: Numbers (m,) of the meshes' first faces among the f faces of all meshes.
        corners: Texture coordinates (f, 3, 2) of the faces' corners; see `Surface`.
        textures: First texel, width and height (f, 3) of the faces' textures.
        texels: Red, green and blue (t, 3) of all textures, uint8.
    """

    def __init__(self, arrays: ArrayFactory) -> None:
        self.identifiers, self.first_faces = RowBank(arrays, (), "int64"), RowBank(arrays, (), "int64")
        self.spheres, self.corners = RowBank(arrays, (4,), "float32"), RowBank(arrays, (3, 2), "float32")
        self.textures, self.texels = RowBank(arrays, (3,), "int32"), RowBank(arrays, (3,), "uint8")
        # Identifiers are valid as long as the meshes live.
        self._meshes: list[warp.Mesh] = []
        self._models: dict[tuple[object, ...], list[DeviceMesh]] = {}
        self._n_faces = 0
        # Models whose colours have not been read, in the order of their meshes.
        self._uncolored: list[tuple[Path, tuple[str, ...]]] = []
        self._extend(0, np.zeros(4), 0)

    def add_model(
        self, urdf: Path, base: tuple[float, ...] = tuple(IDENTITY.tolist()), without: tuple[str, ...] = ()
    ) -> list[DeviceMesh]:
        """Copy the meshes of a model to the device, unless they are there, and return them.

        Args:
            urdf: Model file.
            base: (7,) world pose of the base link, xyz (m) and quaternion xyzw.
            without: Names of links to leave out.

        Raises:
            SimulationError, DataFormatError: The model or one of its meshes cannot be read.
        """
        key = (urdf, read_model_mtimes(urdf), base, without)
        if key not in self._models:
            self._models[key] = self._add_model(urdf, base, without)
        return self._models[key]

    def read_colors(self) -> None:
        """Copy the colours of all meshes to the device, unless they are there.

        Raises:
            SimulationError, DataFormatError: A model, mesh or texture cannot be read.
        """
        while self._uncolored:
            urdf, without = self._uncolored[0]
            for surface in read_surfaces(urdf, read_tree(urdf), without):
                self.corners.extend(surface.corners)
                first = self.texels.extend(surface.texels)
                self.textures.extend(surface.textures + np.array([first, 0, 0], dtype=np.int32))
            del self._uncolored[0]

    def _add_model(self, urdf: Path, base: tuple[float, ...], without: tuple[str, ...]) -> list[DeviceMesh]:
        tree, found = read_tree(urdf), []
        origins, rotations = (frames[0] for frames in tree.compute_link_frames(np.zeros((1, tree.n_dof))))
        world_from_base = Rotation.from_quat(base[3:])
        for mesh in read_visual_meshes(urdf, tree, without):
            vertices, link = mesh.vertices.astype(np.float64), mesh.link
            if tree.n_dof == 0 and link != WORLD:
                vertices, link = vertices @ rotations[link].T + origins[link], WORLD
            if link == WORLD:
                vertices = world_from_base.apply(vertices) + base[:3]
            found.append(DeviceMesh(self._add_mesh(vertices.astype(np.float32), mesh), link))
        self._uncolored.append((urdf, without))
        return found

    def _add_mesh(self, vertices: npt.NDArray[np.float32], mesh: VisualMesh) -> int:
        own = warp.Mesh(warp.array(vertices, dtype=warp.vec3), warp.array(mesh.faces.ravel(), dtype=warp.int32))
        self._meshes.append(own)
        center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        radius = np.linalg.norm(vertices - center, axis=1).max()
        # Larger than the rounding error of the test of a ray.
        return self._extend(own.id, np.array([*center, 1.001 * radius + 1e-5]), len(mesh.faces))

    def _extend(self, identifier: int, sphere: npt.NDArray[np.float64], n_faces: int) -> int:
        self.first_faces.extend(np.array([self._n_faces]))
        self._n_faces += n_faces
        self.spheres.extend(sphere)
        # Kernels take the bits of an unsigned number.
        return self.identifiers.extend(np.array([identifier], dtype=np.uint64).view(np.int64))
