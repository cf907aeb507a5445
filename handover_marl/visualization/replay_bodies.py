"""Simplified link meshes of all bodies in a replay, and their poses over time."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from handover_marl.config import HAND_DOF
from handover_marl.geometry.kinematic_tree import compute_link_trajectory, read_tree
from handover_marl.geometry.model_files.meshes import read_visual_meshes
from handover_marl.geometry.poses import IDENTITY, poses_from_rotations, transform_points
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.visualization.replay_recorder import EpisodeLog

Array = npt.NDArray[np.float64]

# Largest number of triangles of a link of the robot and of other bodies; more make the page large without a visible
# difference.
_MAX_ROBOT_FACES, _MAX_FACES = 3000, 900


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """Visual mesh of a link of a body.

    Attributes:
        link: Index of the link, -1 for the base.
        vertices: (v, 3) vertices, float32, in the link's frame (m).
        faces: (f, 3) vertex indices of the triangles, int32.
    """

    link: int
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class LinkTrajectory:
    """Poses of a link over the frames of a replay.

    Attributes:
        name: Unique name, such as "robot/3".
        label: Label of the body to which the link belongs.
        mesh: Visual mesh of the link.
        poses: (m, 7) world pose at each frame, xyz (m) and quaternion xyzw; (1, 7) if it is fixed.
        is_present: (m,) whether the link exists at each frame; (1,) if it is fixed.
    """

    name: str
    label: SegmentationLabel
    mesh: LinkMesh
    poses: Array
    is_present: npt.NDArray[np.bool_]


def compute_link_trajectories(log: EpisodeLog) -> Iterator[LinkTrajectory]:
    """Yield the trajectories of all links with a visual mesh in a recorded episode.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    assets, config = log.scene.assets, log.config.physics
    snapshots = [frame.snapshot for frame in log.frames]
    always = np.ones(len(snapshots), dtype=bool)
    table = np.array([*config.table_position, 0.0, 0.0, 0.0, 1.0])
    label = SegmentationLabel.TABLE
    yield from _compute_body("table", label, assets.table, np.zeros((1, 0)), always[:1], table)
    label, base, joints = SegmentationLabel.ROBOT, get_robot_base_pose(log), _stack_robot(snapshots)
    yield from _compute_body("robot", label, assets.panda, joints, always, base)
    for number, urdf in enumerate(assets.objects):
        label = SegmentationLabel.OTHER_OBJECT if number else SegmentationLabel.TARGET
        joints = np.array([snapshot.objects[number] for snapshot in snapshots])
        yield from _compute_body(f"object{number}", label, urdf, joints, always)
    is_present = np.array([snapshot.hand is not None for snapshot in snapshots])
    if is_present.any():
        absent = np.zeros(HAND_DOF)
        joints = np.array([absent if snapshot.hand is None else snapshot.hand for snapshot in snapshots])
        yield from _compute_body("hand", SegmentationLabel.HAND, assets.hand, joints, is_present)


def find_nearest_point(
    links: Sequence[LinkTrajectory], label: SegmentationLabel, other: SegmentationLabel, frame: int
) -> Array | None:
    """Return the vertex of a body that is nearest to another body.

    Args:
        links: All links of the replay.
        label: Label of the body on which the vertex is searched.
        other: Label of the other body.
        frame: Index of the frame.

    Returns:
        (3,) world position (m), or None if one of the bodies does not exist.
    """
    vertices, others = (_collect_vertices(links, each, frame) for each in (label, other))
    if not len(vertices) or not len(others):
        return None
    distances, _ = cKDTree(others).query(vertices)
    point: Array = vertices[int(np.argmin(distances))]
    return point


def _collect_vertices(links: Sequence[LinkTrajectory], label: SegmentationLabel, frame: int) -> Array:
    """Return the world positions (n, 3) of all vertices of a body at a frame (m)."""
    found = [np.zeros((0, 3))]
    for link in links:
        row = min(frame, len(link.poses) - 1)
        if link.label is label and link.is_present[row]:
            found.append(transform_points(link.poses[row], link.mesh.vertices.astype(np.float64)))
    return np.concatenate(found)


def get_robot_base_pose(log: EpisodeLog) -> Array:
    """Return the world pose (7,) of the robot base in an episode, xyz (m) and quaternion xyzw."""
    panda = log.config.physics.panda
    return np.array([*panda.base_position, *panda.base_orientation])


def compute_robot_link_poses(log: EpisodeLog, snapshots: Sequence[JointSnapshot], names: Sequence[str]) -> Array:
    """Return the world poses (m, k, 7) of k links of the robot in m snapshots.

    Args:
        log: Recorded episode, with the models and the robot's base pose.
        snapshots: Joint positions at m times.
        names: Names of the k links.

    Returns:
        Positions xyz (m) and quaternions xyzw.
    """
    trajectory = compute_link_trajectory(log.scene.assets.panda, _stack_robot(snapshots), get_robot_base_pose(log))
    chosen = [trajectory.names.index(name) for name in names]
    return poses_from_rotations(trajectory.origins[:, chosen], trajectory.rotations[:, chosen])


def _stack_robot(snapshots: Sequence[JointSnapshot]) -> Array:
    return np.array([snapshot.robot for snapshot in snapshots], dtype=np.float64)


def _compute_body(
    name: str,
    label: SegmentationLabel,
    urdf: Path,
    joints: npt.NDArray[np.floating],
    is_present: npt.NDArray[np.bool_],
    base: Array = IDENTITY,
) -> Iterator[LinkTrajectory]:
    trajectory = compute_link_trajectory(urdf, joints, base)
    max_faces = _MAX_ROBOT_FACES if label is SegmentationLabel.ROBOT else _MAX_FACES
    for mesh in load_simplified_meshes(urdf, urdf.stat().st_mtime_ns, max_faces):
        poses, present = base[None], is_present[:1]
        if mesh.link >= 0:
            origins, rotations = trajectory.origins[:, mesh.link], trajectory.rotations[:, mesh.link]
            poses, present = poses_from_rotations(origins, rotations), is_present
        yield LinkTrajectory(f"{name}/{mesh.link + 1}", label, mesh, poses, present)


@functools.lru_cache(maxsize=64)
def load_simplified_meshes(urdf: Path, modified_ns: int, max_faces: int = _MAX_FACES) -> tuple[LinkMesh, ...]:
    """Return the visual meshes of a model's links with a reduced number of triangles.

    Args:
        urdf: URDF file of the model.
        modified_ns: Modification time of the file (ns); a file with another time is read again.
        max_faces: Largest number of triangles of a link.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """
    return tuple(
        _simplify_mesh(part.link, part.vertices, part.faces, max_faces)
        for part in read_visual_meshes(urdf, read_tree(urdf))
    )


def _simplify_mesh(
    link: int, vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.int32], max_faces: int
) -> LinkMesh:
    # Imported only here, because they are optional dependencies.
    import fast_simplification
    import trimesh

    # Vertices that triangles do not share would open gaps in the simplified mesh.
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    points, triangles = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    if len(triangles) > max_faces:
        points, triangles = fast_simplification.simplify(points, triangles, target_count=max_faces)
    return LinkMesh(link, np.asarray(points, dtype=np.float32), np.asarray(triangles, dtype=np.int32))
