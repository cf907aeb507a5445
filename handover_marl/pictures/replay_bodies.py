"""What stands on the stage of a replay: every body's links as small meshes, and where they are at each moment."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from handover_marl.config import HAND_DOF
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.motion_frames import motion_frames
from handover_marl.models.poses import IDENTITY, compose_point, poses_from_rotations
from handover_marl.models.visual_meshes import read_visual_meshes
from handover_marl.pictures.replay_recorder import EpisodeLog
from handover_marl.sim.camera.photo import Seen
from handover_marl.sim.world import Snapshot

Array = npt.NDArray[np.float64]

# Triangles of a link that a replay shows; more are not seen from where one looks, and make the file large.
_MOST_FACES = 900


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """What a link shows.

    Attributes:
        link: Its number, -1 for the base.
        vertices: (v, 3) float32 in the link's frame (m).
        faces: (f, 3) int32.
    """

    link: int
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class MovingLink:
    """A link over time.

    Attributes:
        name: Unique in the scene, such as "robot/3".
        seen: What it belongs to.
        mesh: What it shows.
        poses: (m, 7) world pose at each moment, xyz (m) and quaternion xyzw; one row if it never moves.
        there: (m,) whether it is there at each moment.
    """

    name: str
    seen: Seen
    mesh: LinkMesh
    poses: Array
    there: npt.NDArray[np.bool_]


def moving_links(log: EpisodeLog) -> Iterator[MovingLink]:
    """All links of an episode that show something.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    assets, config = log.scene.assets, log.config.physics
    joints = [moment.joints for moment in log.moments]
    always = np.ones(len(joints), dtype=bool)
    table = np.array([*config.table_position, 0.0, 0.0, 0.0, 1.0])
    yield from _links("table", Seen.TABLE, assets.table, np.zeros((1, 0)), always[:1], table)
    yield from _links("robot", Seen.ROBOT, assets.panda, _robot(joints), always, robot_base(log))
    for number, urdf in enumerate(assets.objects):
        seen = Seen.OTHER_OBJECT if number else Seen.TARGET
        places = np.array([now.objects[number] for now in joints])
        yield from _links(f"object{number}", seen, urdf, places, always)
    there = np.array([now.hand is not None for now in joints])
    hand = np.array([np.zeros(HAND_DOF) if now.hand is None else now.hand for now in joints])
    if there.any():
        yield from _links("hand", Seen.HAND, assets.hand, hand, there)


def nearest_place(links: Sequence[MovingLink], one: Seen, other: Seen, number: int) -> Array | None:
    """(3,) the corner of one body nearest to the other at a moment (m), or None if one is not there."""
    corners = {seen: _corners(links, seen, number) for seen in (one, other)}
    if not all(map(len, corners.values())):
        return None
    distances, _ = cKDTree(corners[other]).query(corners[one])
    place: Array = corners[one][int(np.argmin(distances))]
    return place


def _corners(links: Sequence[MovingLink], seen: Seen, number: int) -> Array:
    """(n, 3) of all that a body shows at a moment."""
    found = [np.zeros((0, 3))]
    for link in links:
        row = min(number, len(link.poses) - 1)
        if link.seen is seen and link.there[row]:
            found.append(compose_point(link.poses[row], link.mesh.vertices.astype(np.float64)))
    return np.concatenate(found)


def robot_base(log: EpisodeLog) -> Array:
    """(7,) world pose of the robot's base."""
    panda = log.config.physics.panda
    return np.array([*panda.base_position, *panda.base_orientation])


def robot_links(log: EpisodeLog, joints: Sequence[Snapshot], names: Sequence[str]) -> Array:
    """(m, k, 7) world poses of some links of the robot at some moments."""
    frames = motion_frames(log.scene.assets.panda, _robot(joints), robot_base(log))
    chosen = [frames.names.index(name) for name in names]
    return poses_from_rotations(frames.origins[:, chosen], frames.rotations[:, chosen])


def _robot(joints: Sequence[Snapshot]) -> Array:
    return np.array([now.robot for now in joints], dtype=np.float64)


def _links(
    name: str,
    seen: Seen,
    urdf: Path,
    dof: npt.NDArray[np.floating],
    there: npt.NDArray[np.bool_],
    base: Array = IDENTITY,
) -> Iterator[MovingLink]:
    frames = motion_frames(urdf, dof, base)
    for mesh in small_meshes(urdf, urdf.stat().st_mtime_ns):
        if mesh.link < 0:
            poses, present = base[None], there[:1]
        else:
            poses, present = poses_from_rotations(frames.origins[:, mesh.link], frames.rotations[:, mesh.link]), there
        yield MovingLink(f"{name}/{mesh.link + 1}", seen, mesh, poses, present)


@functools.lru_cache(maxsize=64)
def small_meshes(urdf: Path, changed: int) -> tuple[LinkMesh, ...]:
    """What the links of a model show, with few triangles.

    Args:
        urdf: The model.
        changed: When it was, so that another one is read anew.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """
    return tuple(_small(part.link, part.vertices, part.faces) for part in read_visual_meshes(urdf, read_tree(urdf)))


def _small(link: int, vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.int32]) -> LinkMesh:
    # Only now, since they need an extra.
    import fast_simplification
    import trimesh

    # Corners that several triangles name apart would tear when some of them go.
    whole = trimesh.Trimesh(vertices, faces, process=False)
    whole.merge_vertices(merge_norm=True, merge_tex=True)
    points, corners = whole.vertices.astype(np.float32), whole.faces.astype(np.int32)
    if len(corners) > _MOST_FACES:
        points, corners = fast_simplification.simplify(points, corners, target_count=_MOST_FACES)
    return LinkMesh(link, np.asarray(points, dtype=np.float32), np.asarray(corners, dtype=np.int32))
