"""Contacts of robot, hand and objects after physics steps, for the rules of the handover task."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.arrays import AnyArray, AnyIndices, get_namespace, make_constant

Points = npt.NDArray[np.float32]
NO_POINTS: Points = np.zeros((0, 3), dtype=np.float32)


class Contacts(NamedTuple):
    """Contacts of robot, hand and objects after one physics step.

    A contact counts if its normal force is above zero.

    Attributes:
        robot_touches_hand: Whether the Panda touches the human hand.
        robot_touches_object: Whether the Panda touches the target object.
        finger_points: Contact points (n, 3) of the left and of the right finger with the target
            object, in the link frame of that finger (m), float32.
        object_supported: Whether the target object touches the table or another object. Valid after
            the release only.
        object_height: World z of the target object's origin (m). Valid after the release, and while
            the robot touches the object.
        gripper_position: World position of the Panda's hand link (m). Valid after the release, and
            while the robot touches the object.
        robot_object_force: Sum of the normal forces between Panda and target object (N). The rules
            of the task do not use it.
        robot_hand_force: Sum of the normal forces between Panda and human hand (N). The rules of the
            task do not use it.
        robot_touches_others: Whether the Panda touches an object besides the target. The rules of
            the task do not use it.
    """

    robot_touches_hand: bool = False
    robot_touches_object: bool = False
    finger_points: tuple[Points, Points] = (NO_POINTS, NO_POINTS)
    object_supported: bool = False
    object_height: float = float("inf")
    gripper_position: tuple[float, float, float] = (float("inf"),) * 3
    robot_object_force: float = 0.0
    robot_hand_force: float = 0.0
    robot_touches_others: bool = False

    @property
    def both_fingers_touch(self) -> bool:
        """Whether both fingers of the Panda touch the target object."""
        left, right = self.finger_points
        return len(left) > 0 and len(right) > 0


class ContactBatch(NamedTuple):
    """Contacts of robot, hand and objects in k physics steps of n worlds, as arrays or tensors.

    Attributes:
        robot_touches_hand: Whether the Panda touches the human hand, (k, n).
        robot_touches_object: Whether the Panda touches the target object, (k, n).
        fingers_touch: Whether the left and the right finger touch the target object, (k, n, 2).
        in_grasp_region: Whether the left and the right finger touch the target object inside their
            grasp regions, (k, n, 2).
        object_supported: Whether the target object touches the table or another object, (k, n).
        object_height: World z of the target object's origin (m), (k, n).
        gripper_position: World position of the Panda's hand link (m), (k, n, 3).
    """

    robot_touches_hand: AnyArray
    robot_touches_object: AnyArray
    fingers_touch: AnyArray
    in_grasp_region: AnyArray
    object_supported: AnyArray
    object_height: AnyArray
    gripper_position: AnyArray

    @classmethod
    def without_contacts(cls, steps: int, worlds: int) -> "ContactBatch":
        """Return the contact batch of k steps of n worlds without any contact."""
        shape, default = (steps, worlds), Contacts()
        flags, fingers = np.zeros(shape, dtype=bool), np.zeros((*shape, 2), dtype=bool)
        height, position = np.full(shape, default.object_height), np.full((*shape, 3), default.gripper_position)
        return cls(flags, flags, fingers, fingers, flags, height, position)


class RolloutEnd(NamedTuple):
    """Part of a rollout of n worlds that counts, by the rules of the task.

    Attributes:
        steps: Number (n,) of steps up to the first release or end of each world; 0 for worlds that had ended before.
        released: Whether the object is released in the last of these steps, (n,).
        ended: Whether each world has ended, (n,).
    """

    steps: AnyArray
    released: AnyArray
    ended: AnyArray


#: Function that applies the rules to the contacts (k, n) of k steps of the worlds with n indices in a rollout.
JudgeFunction = Callable[[AnyIndices, ContactBatch], RolloutEnd]


def find_points_in_grasp_region(points: AnyArray, config: ProtocolConfig) -> AnyArray:
    """Return whether points (..., 3) in a finger's frame (m) are in its grasp region."""
    lower, upper = (make_constant(bound, points) for bound in (config.region_lower, config.region_upper))
    return get_namespace(points).all((points > lower) & (points < upper), axis=-1)
