"""Triangles of a model's shapes. Needs trimesh (extra `planning`) for all but OBJ files."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.obj_files import read_obj
from handover_marl.models.poses import compose_point
from handover_marl.models.urdf_shapes import UrdfShape, read_urdf_shapes

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]


def mesh_files(urdf: Path, purpose: str) -> list[Path]:
    """The mesh files of a model's shapes, for "collision" or "visual"."""
    return [shape.mesh for shape in read_urdf_shapes(urdf, read_tree(urdf), purpose) if shape.mesh is not None]


def link_vertices(urdf: Path, purpose: str, names: list[str]) -> list[Array]:
    """(m, 3) vertices (m) of the shapes of some links, in the links' frames.

    Raises:
        DataFormatError: A link has no shape, or a file cannot be read.
    """
    tree = read_tree(urdf)
    numbers = [joint.link for joint in tree.joints]
    shapes = read_urdf_shapes(urdf, tree, purpose)
    found = []
    for name in names:
        own = [shape_triangles(shape, urdf)[0] for shape in shapes if shape.link == numbers.index(name)]
        if not own:
            raise DataFormatError(f"{urdf}: link {name!r} has no {purpose} shape to plan with; check the file")
        found.append(np.concatenate(own))
    return found


def model_triangles(urdf: Path) -> tuple[Array, Faces]:
    """Vertices (m, 3) in m and faces (f, 3) of all that a model collides with, in the last link's frame.

    Raises:
        DataFormatError: There is nothing, or a file cannot be read.
    """
    shapes = read_urdf_shapes(urdf, read_tree(urdf), "collision")
    if not shapes:
        raise DataFormatError(f"{urdf}: the model has no collision shape to keep away from; check the file")
    parts = [shape_triangles(shape, urdf) for shape in shapes]
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + first for (_, faces), first in zip(parts, firsts, strict=False)]),
    )


def shape_triangles(shape: UrdfShape, urdf: Path) -> tuple[Array, Faces]:
    """Vertices (v, 3) in m in the link's frame, and faces (f, 3), of one shape of a model.

    Raises:
        DataFormatError: Its file cannot be read.
    """
    vertices, faces = _in_shape(shape, urdf)
    scale = shape.size if shape.kind == "mesh" else 1.0
    return compose_point(shape.link_from_shape, vertices * scale), faces


def _in_shape(shape: UrdfShape, urdf: Path) -> tuple[Array, Faces]:
    if shape.mesh is not None and shape.mesh.suffix.lower() == ".obj":
        content = read_obj(shape.mesh)
        return content.vertices, content.faces
    # Other formats, boxes and balls are left to a library, which only planning needs.
    import trimesh

    try:
        if shape.kind == "box":
            mesh = trimesh.creation.box(shape.size)
        elif shape.kind == "sphere":
            mesh = trimesh.creation.icosphere(radius=shape.size[0])
        else:
            mesh = trimesh.load(shape.mesh, force="mesh", process=False, skip_materials=True)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # what trimesh raises on damaged files has no end
        raise DataFormatError(f"{urdf}: cannot read its {shape.kind} {shape.mesh} ({error}); check the file") from error
    if len(vertices) == 0 or not np.isfinite(vertices).all():
        raise DataFormatError(f"{urdf}: its mesh {shape.mesh} is empty or not finite; check the file")
    return vertices, faces
