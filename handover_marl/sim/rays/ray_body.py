"""Models as meshes to cast rays at, each link where the joints put it."""

import functools
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import CAMERA_LINK
from handover_marl.models.visual_meshes import read_visual_meshes
from handover_marl.sim.camera.photo import Seen
from handover_marl.sim.rays.ray_mesh import RayMesh

Array = npt.NDArray[np.float64]
Joints = npt.NDArray[np.float32]

_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Placed:
    """A mesh at its place.

    Attributes:
        mesh: The mesh.
        turn: (3, 3) its axes in the world.
        shift: (3,) its origin in the world (m).
        colors: (f, 3) of its faces.
        seen: What it is seen as.
    """

    mesh: RayMesh
    turn: Array
    shift: Array
    colors: npt.NDArray[np.float32]
    seen: Seen


class RayBody:
    """A model whose links are rigid meshes.

    Args:
        urdf: Model file.
        seen: What it is seen as.
        base: (7,) world pose of its base, xyz (m) and quaternion xyzw.
        without: Names of links to leave out.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """

    def __init__(self, urdf: Path, seen: Seen, base: npt.ArrayLike = _ORIGIN, without: Collection[str] = ()) -> None:
        self.tree = read_tree(urdf)
        pose = np.asarray(base, dtype=np.float64)
        self._turn, self._shift = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
        self.shown = read_visual_meshes(urdf, self.tree, without)
        self.seen = seen
        self._meshes: list[RayMesh] = []

    def placed(self, joints: Joints) -> list[Placed]:
        """Its meshes, for the positions of its joints (m, rad)."""
        if not self._meshes:
            self._meshes = [RayMesh(shown.vertices, shown.faces) for shown in self.shown]
        frames = self.frames(joints)
        return [
            Placed(mesh, *frames[shown.link], shown.colors, self.seen)
            for mesh, shown in zip(self._meshes, self.shown, strict=True)
        ]

    def frames(self, joints: Joints) -> dict[int, tuple[Array, Array]]:
        """Axes (3, 3) and origin (3,) in the world of every link, -1 being the base."""
        origins, turns = self.tree.frames(joints[None])
        turned = self._turn @ turns[0]
        moved = origins[0] @ self._turn.T + self._shift
        return {-1: (self._turn, self._shift), **dict(enumerate(zip(turned, moved, strict=True)))}


class SuppleBody(RayBody):
    """A model of many small links, such as a hand, as one mesh that is made anew when its joints have moved.

    One mesh of a few thousand triangles is built in less time than rays are sent to sixteen.
    """

    _joints: Joints | None = None
    _placed: Placed | None = None

    def placed(self, joints: Joints) -> list[Placed]:
        """Its one mesh, in the world's frame."""
        if self._placed is None or self._joints is None or not np.array_equal(joints, self._joints):
            frames = self.frames(joints)
            parts = [shown.vertices @ frames[shown.link][0].T + frames[shown.link][1] for shown in self.shown]
            firsts = np.cumsum([0, *map(len, parts)])
            faces = [shown.faces + first for shown, first in zip(self.shown, firsts, strict=False)]
            mesh = RayMesh(np.concatenate(parts).astype(np.float32), np.concatenate(faces).astype(np.int32))
            colors = np.concatenate([shown.colors for shown in self.shown])
            self._placed, self._joints = Placed(mesh, np.eye(3), np.zeros(3), colors, self.seen), joints.copy()
        return [self._placed]


def ray_body(urdf: Path, seen: Seen, base: tuple[float, ...] = _ORIGIN) -> RayBody:
    """A body of a scene; models that have not changed are read once, whatever scene they are in.

    Args:
        urdf: Model file.
        seen: What it is seen as.
        base: (7,) world pose of its base.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """
    try:
        return _kept(urdf, urdf.stat().st_mtime_ns, seen, base)
    except OSError as error:
        raise SimulationError(f"{urdf}: cannot read this model ({error.strerror or error})") from error


@functools.lru_cache(maxsize=64)
def _kept(urdf: Path, changed: int, seen: Seen, base: tuple[float, ...]) -> RayBody:
    if seen is Seen.HAND:
        return SuppleBody(urdf, seen, base)
    # The camera does not see itself: all of its housing is nearer than the near plane.
    return RayBody(urdf, seen, base, (CAMERA_LINK,) if seen is Seen.ROBOT else ())
