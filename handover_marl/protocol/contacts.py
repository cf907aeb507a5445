"""What the rules need to know of one physics step."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]
NO_POINTS: Points = np.zeros((0, 3), dtype=np.float32)


class Contacts(NamedTuple):
    """Contacts with a normal force above zero after a physics step, and the two positions that rules ask for.

    Attributes:
        robot_hand: The Panda touches the human hand.
        robot_object: The Panda touches the target object.
        finger_points: Contact points of the left and the right finger with the target object, each (n, 3)
            in that finger's link frame (m).
        object_supported: The target object touches the table or another object. Only looked at after release.
        object_height: World z of the target object's origin (m). Only looked at when the robot touches the
            object and after release; so is
        gripper_position: World position of the Panda's hand link (m).
        robot_object_force: Sum of the normal forces between Panda and target object (N); no rule asks for it.
    """

    robot_hand: bool = False
    robot_object: bool = False
    finger_points: tuple[Points, Points] = (NO_POINTS, NO_POINTS)
    object_supported: bool = False
    object_height: float = float("inf")
    gripper_position: tuple[float, float, float] = (float("inf"),) * 3
    robot_object_force: float = 0.0

    @property
    def both_fingers(self) -> bool:
        """Whether both fingers touch the target object."""
        left, right = self.finger_points
        return len(left) > 0 and len(right) > 0
