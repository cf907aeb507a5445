"""Triangle meshes of URDF shapes, and convex hulls with few vertices.

OBJ files are read without trimesh; boxes, spheres and other mesh formats need it (extra `planning`).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import cached_by_file, check_plain_file, report_damage
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.model_files.obj_files import check_mesh, read_obj
from handover_marl.geometry.model_files.urdf import UrdfShape, read_model_mtimes, read_urdf_links, read_urdf_shapes
from handover_marl.geometry.poses import transform_points

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

_MAX_CORNERS = 64  # of a convex part


@dataclass(frozen=True, eq=False)
class VisualMesh:
    """Triangle mesh of the visual shapes of one link.

    Attributes:
        link: Number of the link, -1 for the base.
        vertices: (v, 3) float32 vertices in the link's frame (m).
        faces: (f, 3) int32 indices in `vertices` of the triangles' corners, counterclockwise seen from outside.
    """

    link: int
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]


def select_extreme_points(points: Array, limit: int) -> Array:
    """Select at most `limit` of the points (n, 3): those that are outermost in evenly spread directions."""
    for count in range(4 * limit, limit - 1, -1):
        k = np.arange(count) + 0.5
        height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
        radius = np.sqrt(1.0 - height**2)
        directions = np.column_stack([radius * np.cos(turn), height, radius * np.sin(turn)])
        chosen = np.unique(np.argmax(points @ directions.T, axis=0))
        if len(chosen) <= limit:
            break
    return np.asarray(points[chosen])


def find_farthest_points(points: Array, count: int, first: int = 0) -> list[int]:
    """Return the indices of `count` points of (n, d) by farthest point sampling from the point with index `first`."""
    coordinates = np.ascontiguousarray(points.T)  # NumPy sums along a short last axis slowly.
    chosen, distances = [first], np.full(len(points), np.inf)
    while len(chosen) < count:
        distances = np.minimum(distances, np.linalg.norm(coordinates - coordinates[:, chosen[-1:]], axis=0))
        # Of repeated points, each is taken once.
        distances[chosen[-1]] = -1.0
        chosen.append(int(np.argmax(distances)))
    return chosen


def compute_convex_hull(points: Array) -> tuple[Array, Faces]:
    """Compute the convex hull of points (n, 3): its vertices (v, 3) and its triangles (f, 3), which face outwards."""
    hull = ConvexHull(points)
    numbers = np.sort(hull.vertices)
    faces = np.searchsorted(numbers, hull.simplices)
    vertices = points[numbers]
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    is_inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0.0
    faces[is_inward] = faces[is_inward][:, ::-1]
    return vertices, faces


def decompose_convex(vertices: Array, faces: Faces, concavity: float = 0.05) -> list[Array]:
    """Return the corners (n, 3) in m of each convex part of a mesh, by CoACD (Wei et al., SIGGRAPH 2022).

    Needs CoACD (extra `import`). Of a part with more than 64 corners, the limit in HandoverSim's files, the outermost
    are kept; CoACD's own reduction of corners cuts off millimeters. `concavity` is CoACD's threshold: the largest
    concavity of a part, 0.01 (many parts) to 1.
    """
    import coacd  # type: ignore[import-untyped]

    coacd.set_log_level("error")
    # Less search than by default, which takes longer for hardly better parts.
    options = {"mcts_iterations": 60, "mcts_max_depth": 2, "mcts_nodes": 15}
    parts = []
    for points, _ in coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=concavity, seed=0, **options):
        try:
            hull = compute_convex_hull(np.asarray(points, dtype=np.float64))[0]
            parts.append(compute_convex_hull(np.round(select_extreme_points(hull, _MAX_CORNERS), 6) + 0.0)[0])
        except QhullError:  # a part without volume
            continue
    return parts


@cached_by_file(256, read_model_mtimes)
def check_collision_meshes(urdf: Path) -> None:
    """Raise `DataFormatError` for a URDF model without collision shapes, or with an OBJ file that fails `check_mesh`.

    An unchanged model is checked once. OBJ files of collision shapes must be solid; other mesh files are not checked.
    """
    shapes = read_urdf_shapes(urdf, read_tree(urdf), "collision")
    if not shapes:
        raise DataFormatError(f"{urdf}: the model must have a collision shape; check the file")
    for mesh in {shape.mesh for shape in shapes if shape.mesh is not None}:
        check_mesh(mesh, solid=True)


def check_model(urdf: Path, n_joints: int) -> None:
    """Raise `SimulationError` or `DataFormatError` unless a URDF model is valid, with `n_joints` moving joints."""
    check_collision_meshes(urdf)
    tree = read_tree(urdf)
    read_urdf_links(urdf, tree)
    found = sum(joint.kind != "fixed" for joint in tree.joints)
    if found != n_joints:
        raise DataFormatError(f"{urdf}: the model must have {n_joints} moving joints, got {found}; check the file")
    for mesh in list_mesh_files(urdf, "visual"):
        check_mesh(mesh)


def list_mesh_files(urdf: Path, purpose: str) -> list[Path]:
    """List the mesh files of the "collision" or "visual" shapes of a URDF model."""
    return [shape.mesh for shape in read_urdf_shapes(urdf, read_tree(urdf), purpose) if shape.mesh is not None]


def read_link_vertices(urdf: Path, purpose: str, names: list[str]) -> list[Array]:
    """Read vertices (m, 3) of the "collision" or "visual" shapes of each named link, in the frame of that link (m)."""
    tree = read_tree(urdf)
    numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
    shapes = read_urdf_shapes(urdf, tree, purpose)
    vertices = []
    for name in names:
        own = [read_shape_mesh(shape, urdf)[0] for shape in shapes if shape.link == numbers.get(name)]
        if not own:
            raise DataFormatError(f"{urdf}: link {name!r} must have a {purpose} shape; check the file")
        vertices.append(np.concatenate(own))
    return vertices


def read_collision_mesh(urdf: Path) -> tuple[Array, Faces]:
    """Read a URDF model's collision shapes as one mesh: vertices (v, 3) in m, faces (f, 3) of vertex indices.

    Each shape's vertices are in the frame of its link, so the model should have shapes on one link only.
    """
    shapes = read_urdf_shapes(urdf, read_tree(urdf), "collision")
    if not shapes:
        raise DataFormatError(f"{urdf}: the model must have a collision shape; check the file")
    return concatenate_meshes([read_shape_mesh(shape, urdf) for shape in shapes])


def read_visual_meshes(urdf: Path, tree: KinematicTree, without: Collection[str] = ()) -> list[VisualMesh]:
    """Read the visual meshes of a URDF model: one for each link with visual shapes that is not named in `without`."""
    meshes = []
    for link, shapes in group_visual_shapes(urdf, tree, without).items():
        vertices, faces = concatenate_meshes([read_shape_mesh(shape, urdf) for shape in shapes])
        meshes.append(VisualMesh(link, vertices.astype(np.float32), faces.astype(np.int32)))
    return meshes


def group_visual_shapes(urdf: Path, tree: KinematicTree, without: Collection[str] = ()) -> dict[int, list[UrdfShape]]:
    """Return the visual shapes of a URDF model by link number, except for the links named in `without`."""
    excluded = {number for number, joint in enumerate(tree.joints) if joint.link in without}
    shapes: dict[int, list[UrdfShape]] = {}
    for shape in read_urdf_shapes(urdf, tree, "visual"):
        if shape.link not in excluded:
            shapes.setdefault(shape.link, []).append(shape)
    return shapes


def concatenate_meshes(parts: Sequence[tuple[Array, Faces]]) -> tuple[Array, Faces]:
    """Join several meshes into one; each mesh is a pair of vertices (v, 3) and faces (f, 3) of vertex indices."""
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + first for (_, faces), first in zip(parts, firsts, strict=False)]),
    )


def read_shape_mesh(shape: UrdfShape, urdf: Path) -> tuple[Array, Faces]:
    """Read a shape of a URDF file as a mesh: vertices (v, 3) in the link's frame (m) and faces (f, 3)."""
    if shape.mesh is not None and shape.mesh.suffix.lower() == ".obj":
        mesh = read_obj(shape.mesh)
        vertices, faces = mesh.vertices, mesh.faces
    else:
        vertices, faces = _load_with_trimesh(shape, urdf)
    scale = shape.size if shape.kind == "mesh" else 1.0
    return transform_points(shape.link_from_shape, vertices * scale), faces


def _load_with_trimesh(shape: UrdfShape, urdf: Path) -> tuple[Array, Faces]:
    # Imported here: most models have OBJ files only, and trimesh is an extra.
    import trimesh

    with report_damage(shape.mesh or urdf, "mesh", "check the file"):
        if shape.kind == "box":
            mesh = trimesh.creation.box(shape.size)
        elif shape.kind == "sphere":
            mesh = trimesh.creation.icosphere(radius=shape.size[0])
        else:
            check_plain_file(Path(str(shape.mesh)))
            mesh = trimesh.load(shape.mesh, force="mesh", process=False, skip_materials=True)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(vertices) == 0 or not np.isfinite(vertices).all():
        raise DataFormatError(f"{urdf}: its mesh {shape.mesh} is empty or not finite; check the file")
    return vertices, faces
