"""The shipped objects as meshes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, VISUAL_NAME, object_urdf
from handover_marl.models.obj_files import read_obj


def load_visual(name: str, root: Path = OBJECTS_ROOT) -> trimesh.Trimesh:
    """The mesh (m, object frame) that is drawn, without its colours.

    Raises:
        UnknownNameError: There is no such class.
        DataNotFoundError: The files are missing under `root`.
    """
    (mesh,) = read_parts(object_urdf(name, root).with_name(VISUAL_NAME))
    return mesh


def load_collision_parts(name: str, root: Path = OBJECTS_ROOT) -> list[trimesh.Trimesh]:
    """The convex meshes (m, object frame) that collide.

    Raises:
        UnknownNameError: There is no such class.
        DataNotFoundError: The files are missing under `root`.
    """
    return read_parts(object_urdf(name, root).with_name(COLLISION_NAME))


def collision_mesh(name: str, root: Path = OBJECTS_ROOT) -> trimesh.Trimesh:
    """All convex parts (m, object frame) as one mesh; they may overlap.

    Raises:
        UnknownNameError: There is no such class.
        DataNotFoundError: The files are missing under `root`.
    """
    return merge(load_collision_parts(name, root))


def read_parts(path: Path) -> list[trimesh.Trimesh]:
    """The meshes (m) of an OBJ file, one for each of its objects.

    Raises:
        DataFormatError: It is no OBJ file of triangles.
    """
    content = read_obj(path)
    return [_submesh(content.vertices, faces) for faces in content.groups]


def merge(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of the vertices and faces of all."""
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + first for mesh, first in zip(meshes, firsts, strict=False)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def _submesh(points: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]) -> trimesh.Trimesh:
    used, compact = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(points[used], compact.reshape(-1, 3), process=False)
