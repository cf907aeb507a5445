"""When the human lets go of the object (HandoverSim, Sec. IV-B)."""

from enum import Enum

import numpy as np

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import Contacts, Points


class Release(Enum):
    """Why the human let go.

    ACTIVE: both fingers held the object in their grasp region long enough.
    PASSIVE: the robot pushed the object long enough without a finger on it as in a grasp.
    GIVEN: the giver chose to, which HandoverSim does not know.
    """

    ACTIVE = "active"
    PASSIVE = "passive"
    GIVEN = "given"


class ReleaseRule:
    """Counts the steps in a row for which either release condition holds.

    Attributes:
        active_steps: Those for which that of `Release.ACTIVE` does.
        passive_steps: Those for which that of `Release.PASSIVE` does.
    """

    def __init__(self, config: ProtocolConfig) -> None:
        self._needed = config.release_steps
        self._lower = np.array(config.region_lower)
        self._upper = np.array(config.region_upper)
        self.active_steps = 0
        self.passive_steps = 0

    def update(self, contacts: Contacts) -> Release | None:
        """Look at one more step and say whether the human lets go now."""
        if not contacts.robot_object:
            self.active_steps = self.passive_steps = 0
            return None
        left, right = (self._in_region(points) for points in contacts.finger_points)
        self.active_steps = self.active_steps + 1 if left and right else 0
        self.passive_steps = self.passive_steps + 1 if not (left or right) else 0
        if self.active_steps >= self._needed:
            return Release.ACTIVE
        return Release.PASSIVE if self.passive_steps >= self._needed else None

    def _in_region(self, points: Points) -> bool:
        return bool(((points > self._lower) & (points < self._upper)).all(axis=1).any())
