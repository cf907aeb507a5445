"""Where the links of a model are over time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.poses import IDENTITY, compose_point, rotate

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MotionFrames:
    """Link frames in the world at n times.

    Attributes:
        names: Names of the links, as numbered.
        origins: (n, L, 3) in m.
        rotations: (n, L, 3, 3).
    """

    names: tuple[str, ...]
    origins: Array
    rotations: Array

    def path(self, link: int | str) -> Array:
        """(n, 3) places of a link's origin (m)."""
        number = self.names.index(link) if isinstance(link, str) else link
        return np.asarray(self.origins[:, number])

    def at(self, times: npt.NDArray[np.bool_]) -> "MotionFrames":
        """The same at some of the times."""
        return MotionFrames(self.names, self.origins[times], self.rotations[times])


def motion_frames(urdf: Path, dof: npt.ArrayLike, world_from_base: npt.ArrayLike = IDENTITY) -> MotionFrames:
    """Link frames for joint positions over time.

    Args:
        urdf: The model.
        dof: (n, d) joint positions (m, rad).
        world_from_base: (7,) where its base stands, xyz (m) and quaternion xyzw.

    Raises:
        SimulationError: The model cannot be read.
    """
    tree = read_tree(urdf)
    origins, rotations = tree.frames(dof)
    base = np.asarray(world_from_base, dtype=np.float64)
    axes = rotate(base[3:], np.eye(3)).T
    names = tuple(joint.link for joint in tree.joints)
    return MotionFrames(names, compose_point(base, origins), axes @ rotations)
