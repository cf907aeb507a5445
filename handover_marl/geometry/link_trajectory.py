"""Trajectories of the links of a URDF model, computed from joint positions over time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import IDENTITY, rotate_points, transform_points

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinkFrameTrajectory:
    """Trajectory of the link frames of a URDF model in the world, at n times.

    Attributes:
        names: Names of the L links, in their numbering.
        origins: (n, L, 3) world positions of the links' origins (m).
        rotations: (n, L, 3, 3) rotation matrices from link to world frame.
    """

    names: tuple[str, ...]
    origins: Array
    rotations: Array

    def get_positions(self, link: int | str) -> Array:
        """Return the world positions (n, 3) of a link's origin (m) at all times."""
        number = self.names.index(link) if isinstance(link, str) else link
        return np.asarray(self.origins[:, number])

    def select(self, times: npt.NDArray[np.bool_]) -> "LinkFrameTrajectory":
        """Return the part of the trajectory where a mask (n,) over the times is True."""
        return LinkFrameTrajectory(self.names, self.origins[times], self.rotations[times])


def compute_link_trajectory(
    urdf: Path, dof: npt.ArrayLike, world_from_base: npt.ArrayLike = IDENTITY
) -> LinkFrameTrajectory:
    """Compute the link frames of a URDF model for joint positions (n, d) over time and a base pose (7,).

    Raises:
        SimulationError: The URDF file cannot be read.
    """
    tree = read_tree(urdf)
    origins, rotations = tree.compute_link_frames(dof)
    base = np.asarray(world_from_base, dtype=np.float64)
    axes = rotate_points(base[3:], np.eye(3)).T
    names = tuple(joint.link for joint in tree.joints)
    return LinkFrameTrajectory(names, transform_points(base, origins), axes @ rotations)
