"""What there is to keep clear of, and what nearness costs (Ratliff et al., 2009)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.distance_field import DistanceField

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A thing where it is.

    Attributes:
        field: Its distances.
        base_from_field: (7,) pose of the field's frame in the robot's base frame.
        padding: It costs something up to this distance (m).
        weight: Of its cost.
        in_tail: Whether it counts on the last straight way to a grasp too, where objects do not.
    """

    field: DistanceField
    base_from_field: npt.NDArray[np.float64]
    padding: float
    weight: float = 1.0
    in_tail: bool = False

    def distances(self, points: Floats) -> Floats:
        """(n,) distances (m) of points (3, n) in the base frame."""
        return self.field.distances(self._local(points))

    def distances_and_slopes(self, points: Floats) -> tuple[Floats, Floats]:
        """The same, and (3, n) gradients in the base frame."""
        distances, slopes = self.field.distances_and_slopes(self._local(points))
        return distances, self._rotation() @ slopes

    def _rotation(self) -> Floats:
        matrix: Floats = Rotation.from_quat(self.base_from_field[3:]).as_matrix().astype(np.float32)
        return matrix

    def _local(self, points: Floats) -> Floats:
        away = points - self.base_from_field[:3, None].astype(np.float32)
        local: Floats = self._rotation().T @ away
        return local


def nearness(distances: Floats, padding: float) -> Floats:
    """Cost of distances (m): rises as a parabola from `padding` on, and evenly inside a thing."""
    near = (distances - padding) ** 2 / (2.0 * padding)
    price: Floats = np.where(distances <= 0.0, padding / 2.0 - distances, np.where(distances <= padding, near, 0.0))
    return price


def steepness(distances: Floats, padding: float) -> Floats:
    """Derivative of `nearness`."""
    near = (distances - padding) / padding
    slope: Floats = np.where(distances <= 0.0, -1.0, np.where(distances <= padding, near, 0.0))
    return slope
