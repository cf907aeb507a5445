"""Where an object goes by kinematics alone, while nothing touches it that pushes back."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, MotorConfig, ObjectConfig
from handover_marl.sim.follower import Follower, follow_together

Array = npt.NDArray[np.float64]


def object_motors(config: ObjectConfig) -> list[MotorConfig]:
    """The motors of a chain's six joints, xyz and intrinsic XYZ Euler angles."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3


class ObjectPath:
    """The joints of a chain that follows its targets as its motors do.

    Rows are those of the motion it is led by; -1 is before its first, -2 a step earlier.

    Args:
        config: How its joints are driven.
        start: (6,) where they are at first (m, rad).
    """

    def __init__(self, config: ObjectConfig, start: npt.NDArray[np.float32]) -> None:
        self._follower = Follower(object_motors(config), start)
        # Two rows more than the motion has. Before the first step it has stood at its start.
        self._trail = np.stack([self._follower.position] * 2)

    def lead(self, targets: npt.NDArray[np.float32]) -> None:
        """Work out where it will be in the coming steps, given (n, 6) targets."""
        lead_objects_together([self], [targets])

    def centers(self, row: int) -> Array:
        """(n - row, 3) where its origin will be after the steps from `row` on (m)."""
        return self._trail[row + 2 :, :3]

    def joints(self, row: int) -> Array:
        """(6,) after step `row` (m, rad)."""
        joints: Array = self._trail[row + 2]
        return joints

    def speeds(self, row: int) -> Array:
        """(6,) how fast step `row` has moved them (m/s, rad/s)."""
        speeds: Array = (self.joints(row) - self.joints(row - 1)) / TIME_STEP
        return speeds


def lead_objects_together(paths: Sequence[ObjectPath], targets: Sequence[npt.NDArray[np.float32]]) -> None:
    """As `ObjectPath.lead` for some objects, each by its own targets."""
    follow_together([path._follower for path in paths], targets)
    for path in paths:
        path._trail = np.concatenate([path._trail[-2:], path._follower.path])
