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
from handover_marl.models.urdf_shapes import named_meshes
from handover_marl.models.visual_meshes import read_visual_meshes
from handover_marl.sim.camera.photo import Seen
from handover_marl.sim.rays.ray_mesh import RayMesh

Array = npt.NDArray[np.float64]
Joints = npt.NDArray[np.float32]

_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Parts:
    """The links of a body that show something, at their places.

    Attributes:
        body: The body.
        turns: (n, 3, 3) the links' axes in the world.
        shifts: (n, 3) their origins in the world (m).
    """

    body: "RayBody"
    turns: Array
    shifts: Array


class RayBody:
    """A model whose links are rigid meshes.

    Args:
        urdf: Model file.
        seen: What it is seen as.
        base: (7,) world pose of its base, xyz (m) and quaternion xyzw.
        without: Names of links to leave out.

    Attributes:
        seen: What it is seen as.
        names: Names of its links, as they are numbered.
        meshes: What each link shows that shows something.
        colors: (f, 3) red, green and blue of the faces of each of these, 0 to 1.
        lowest: (n, 3) lower corners of boxes around these, in the links' frames (m).
        highest: (n, 3) the upper ones.

    Raises:
        SimulationError, DataFormatError: The model or one of its meshes cannot be read.
    """

    def __init__(self, urdf: Path, seen: Seen, base: npt.ArrayLike = _ORIGIN, without: Collection[str] = ()) -> None:
        self._tree = read_tree(urdf)
        self.seen = seen
        self.names = [joint.link for joint in self._tree.joints]
        pose = np.asarray(base, dtype=np.float64)
        self._turn, self._shift = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
        shown = read_visual_meshes(urdf, self._tree, without)
        self._links = [part.link for part in shown]
        self.meshes = [RayMesh(part.vertices, part.faces) for part in shown]
        self.colors = [part.colors for part in shown]
        self.lowest = np.array([mesh.vertices.min(axis=0) for mesh in self.meshes]).reshape(-1, 3)
        self.highest = np.array([mesh.vertices.max(axis=0) for mesh in self.meshes]).reshape(-1, 3)
        self._faces: dict[tuple[int, ...], npt.NDArray[np.int32]] = {}
        self._known: tuple[Joints, Array, Array] | None = None

    def parts(self, joints: Joints) -> Parts:
        """What it shows, for the positions of its joints (m, rad)."""
        turns, shifts = self._frames(joints)
        return Parts(self, turns[self._links], shifts[self._links])

    def faces(self, links: tuple[int, ...]) -> npt.NDArray[np.int32]:
        """(f, 3) faces of some of what is shown, as of one mesh."""
        if links not in self._faces:
            meshes = [self.meshes[link] for link in links]
            firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
            parts = [mesh.faces + first for mesh, first in zip(meshes, firsts, strict=False)]
            # Mostly it is all of them; other choices are not worth keeping.
            self._faces = {links: np.concatenate(parts)}
        return self._faces[links]

    def frame(self, link: int, joints: Joints) -> tuple[Array, Array]:
        """Axes (3, 3) and origin (3,) of a link in the world, -1 being the base."""
        turns, shifts = self._frames(joints)
        return turns[link], shifts[link]

    def _frames(self, joints: Joints) -> tuple[Array, Array]:
        """Axes (L + 1, 3, 3) and origins (L + 1, 3) of all links in the world, the base's last."""
        # Much stands still between two pictures: the table always, the hand once it is there.
        if self._known is None or not np.array_equal(joints, self._known[0]):
            origins, turns = self._tree.frames(joints[None])
            turns = np.concatenate([self._turn @ turns[0], self._turn[None]])
            shifts = np.concatenate([origins[0] @ self._turn.T + self._shift, self._shift[None]])
            self._known = joints.copy(), turns, shifts
        return self._known[1:]


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
        changed = urdf.stat().st_mtime_ns
        meshes = tuple(mesh.stat().st_mtime_ns if mesh.exists() else 0 for mesh in _meshes(urdf, changed))
        return _kept(urdf, (changed, *meshes), seen, base)
    except OSError as error:
        raise SimulationError(f"{urdf}: cannot read this model ({error.strerror or error})") from error


@functools.lru_cache(maxsize=64)
def _meshes(urdf: Path, changed: int) -> tuple[Path, ...]:
    return tuple(mesh for _, mesh in named_meshes(urdf))


@functools.lru_cache(maxsize=64)
def _kept(urdf: Path, changed: tuple[int, ...], seen: Seen, base: tuple[float, ...]) -> RayBody:
    # The camera does not see itself: all of its housing is nearer than the near plane.
    return RayBody(urdf, seen, base, (CAMERA_LINK,) if seen is Seen.ROBOT else ())
