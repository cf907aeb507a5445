"""Collision shapes for MuJoCo: convex parts of URDF links, link inertia as in Bullet, and collision groups."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import cached_by_file, read_mtime, read_plain_file
from handover_marl.geometry.kinematic_tree import BoundingSphere, KinematicTree
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.model_files.urdf import UrdfLink, UrdfShape, read_urdf_shapes
from handover_marl.geometry.poses import IDENTITY, transform_points
from handover_marl.simulation.mujoco.engine import wxyz_from_xyzw

Array = npt.NDArray[np.float64]

# Bullet computes a link's inertia from a box. On each side, the box is larger than the link's hulls by their margin and
# twice the margin of the compound shape (m). A hull with a pose of its own is in one more compound shape, which adds
# another margin (m).
_HULL_PADDING, _POSED_HULL_PADDING = 0.003, 0.001


@dataclass(frozen=True, eq=False)
class ConvexPart:
    """Convex part of the collision shape of a URDF link.

    Attributes:
        kind: Type of the part: "hull", "box" or "sphere".
        vertices: Vertices (v, 3) of a hull in the part's frame (m); (0, 3) for a box or sphere.
        size: Side lengths of a box (m), radius of a sphere (m), empty for a hull.
        link_from_part: Pose (7,) (quaternion xyzw) of the part in the link's frame.
    """

    kind: str
    vertices: Array
    size: tuple[float, ...]
    link_from_part: Array

    def list_extreme_points(self) -> Array:
        """Return points (n, 3) in the part's frame (m) that have the same bounding box as the part."""
        if self.kind == "hull":
            return self.vertices
        half = np.array(self.size) / 2.0 if self.kind == "box" else np.full(3, self.size[0])
        return np.array([-half, half])


def load_convex_parts(shapes: Sequence[UrdfShape]) -> list[ConvexPart]:
    """Load the convex parts of collision shapes as Bullet does: each object of a mesh file is one convex hull."""
    return [part for shape in shapes for part in _load_shape(shape)]


def load_link_parts(urdf: Path, tree: KinematicTree) -> dict[int, list[ConvexPart]]:
    """Load the convex parts of all links with collision shapes, by ascending link number; -1 is the base."""
    shapes = read_urdf_shapes(urdf, tree, "collision")
    links = sorted({shape.link for shape in shapes})
    return {link: load_convex_parts([shape for shape in shapes if shape.link == link]) for link in links}


def _read_mesh_mtime(shape: UrdfShape) -> int:
    return 0 if shape.mesh is None else read_mtime(shape.mesh)


# Many scenes share the shapes of a URDF file, and so their parts.
@cached_by_file(2048, _read_mesh_mtime)
def _load_shape(shape: UrdfShape) -> tuple[ConvexPart, ...]:
    if shape.mesh is None:
        return (ConvexPart(shape.kind, np.zeros((0, 3)), shape.size, shape.link_from_shape),)
    meshes = _load_mesh_objects(shape.mesh)
    return tuple(ConvexPart("hull", vertices * shape.size, (), shape.link_from_shape) for vertices in meshes)


@cached_by_file(maxsize=512)
def _load_mesh_objects(mesh: Path) -> tuple[Array, ...]:
    """Return the distinct vertices (v, 3) of each object in a mesh file."""
    if mesh.suffix.lower() == ".obj":
        content = read_obj(mesh)
        return tuple(np.unique(content.vertices[np.unique(faces)], axis=0) for faces in content.groups)
    return (np.unique(_read_stl_vertices(mesh), axis=0),)


def _read_stl_vertices(mesh: Path) -> Array:
    """Return the corners (n, 3) of the triangles of a binary STL file."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
    try:
        content = read_plain_file(mesh)
        count = int(np.frombuffer(content, "<u4", 1, 80)[0])
        triangles = np.frombuffer(content, record, count, 84)
    except (OSError, ValueError) as error:
        raise DataFormatError(f"{mesh}: neither an OBJ nor a binary STL file ({error}); check the file") from error
    return np.asarray(triangles["corners"].reshape(-1, 3), dtype=np.float64)


def compute_box_inertia(link: UrdfLink, parts: Sequence[ConvexPart]) -> Array:
    """Compute the moments of inertia (3,) in kg m^2 of a link as those of a solid box around its collision shapes."""
    lower, upper = _compute_bounds(parts, any(link.center))
    x, y, z = (upper - lower) ** 2
    return np.array([y + z, x + z, x + y]) * link.mass / 12.0


def compute_bounding_spheres(urdf: Path, tree: KinematicTree) -> dict[int, BoundingSphere]:
    """Compute the bounding spheres of all links with collision shapes, by link number; -1 is the base."""
    spheres = {}
    for link, parts in load_link_parts(urdf, tree).items():
        lower, upper = _compute_bounds(parts, False)
        spheres[link] = BoundingSphere((lower + upper) / 2.0, float(np.linalg.norm(upper - lower)) / 2.0)
    return spheres


def _compute_bounds(parts: Sequence[ConvexPart], has_offset: bool) -> tuple[Array, Array]:
    """Return lower and upper corner, (3,) each, of the box around the parts of a link in the link's frame (m).

    `has_offset` says whether the link's center of mass differs from its frame.
    """
    lowers, uppers = zip(*(_compute_part_bounds(part, has_offset) for part in parts), strict=True)
    return np.min(lowers, axis=0), np.max(uppers, axis=0)


@functools.lru_cache(maxsize=4096)
def _compute_part_bounds(part: ConvexPart, has_offset: bool) -> tuple[Array, Array]:
    """Return lower and upper corner, (3,) each, of Bullet's bounding box of a part in the link's frame (m).

    `has_offset` says whether the link's center of mass differs from its frame.
    """
    points = part.list_extreme_points()
    padding = 0.0
    if part.kind == "hull":
        is_posed = has_offset or not np.array_equal(part.link_from_part, IDENTITY)
        padding = _HULL_PADDING + (_POSED_HULL_PADDING if is_posed else 0.0)
    lower, upper = points.min(axis=0), points.max(axis=0)
    rotation = np.abs(Rotation.from_quat(part.link_from_part[3:]).as_matrix())
    center = transform_points(part.link_from_part, (lower + upper) / 2.0)
    half = rotation @ ((upper - lower) / 2.0) + padding
    return center - half, center + half


def add_collision_geom(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", part: ConvexPart) -> "mujoco.MjsGeom":
    """Add a convex part to a MuJoCo body as a geom without mass, and return the geom.

    `set_inertia` sets the mass of the body.
    """
    geom = body.add_geom(pos=part.link_from_part[:3], quat=wxyz_from_xyzw(part.link_from_part[3:]))
    geom.mass = 0.0
    if part.kind == "hull":
        mesh = spec.add_mesh(name=f"hull{len(spec.meshes)}", uservert=part.vertices.ravel())
        # Flat hulls have no volume, which MuJoCo refuses otherwise.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
    elif part.kind == "box":
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, np.array(part.size) / 2.0
    else:
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [part.size[0], 0.0, 0.0]
    return geom


def set_inertia(body: "mujoco.MjsBody", link: UrdfLink, parts: list[ConvexPart]) -> None:
    """Set a MuJoCo body's mass, center of mass and (if it has parts) inertia to the values that Bullet uses."""
    body.explicitinertial = True
    body.mass, body.ipos = link.mass, link.center
    if parts:
        body.inertia = compute_box_inertia(link, parts)


class CollisionGroup(IntFlag):
    """Collision groups as bits of MuJoCo's `contype` and `conaffinity`; the Panda collides with all groups."""

    ROBOT = 1
    OBJECT = 2
    SUPPORT = 4
    HAND = 8
    GROUND = 16


#: Groups that a released object collides with, apart from the robot.
RELEASED_COLLISIONS = CollisionGroup.OBJECT | CollisionGroup.SUPPORT | CollisionGroup.GROUND
