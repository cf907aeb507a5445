"""What an arm cannot reach whatever its joints do, so that nobody need search for it."""

import numpy as np
import numpy.typing as npt

from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.models.poses import compose_point, inverse_transform_points

Array = npt.NDArray[np.float64]


class ArmRange:
    """Two necessary conditions on the pose of a hand link; joint limits are not looked at.

    The hand must not be farther from the shoulder than the arm is long. With an orientation given, the wrist (the
    origin of the last joint but one) can only be on a circle around the last joint's axis, and some of that circle
    must be as near to the shoulder as the arm without the hand is long.

    Args:
        tree: The arm.
        hand: Number of the hand's link, carried by turning joints only.
        world_from_base: (7,) where the arm stands.
    """

    def __init__(self, tree: KinematicTree, hand: int, world_from_base: Array) -> None:
        center, self._range = tree.range_of(hand)
        self._shoulder = compose_point(world_from_base, center)
        last, before = tree.turning_joints(hand)[:-3:-1]
        origins, rotations = (value[0] for value in tree.frames(np.zeros((1, tree.n_dof))))
        hand_from_base = rotations[hand].T
        self._axis = hand_from_base @ rotations[last] @ tree.joints[last].axis
        wrist = hand_from_base @ (origins[before] - origins[hand])
        pivot = hand_from_base @ (origins[last] - origins[hand])
        self._circle_center = pivot + self._axis * np.dot(wrist - pivot, self._axis)
        self._circle_radius = float(np.linalg.norm(wrist - self._circle_center))
        self._wrist_distance = float(np.linalg.norm(wrist))
        self._wrist_range = tree.range_of(before)[1]

    def excludes(
        self, position: npt.ArrayLike, orientation: npt.ArrayLike | None, distance: float, angle: float
    ) -> bool:
        """Whether the hand surely cannot come near a pose.

        Args:
            position: (3,) world position of the hand (m).
            orientation: World orientation, quaternion xyzw; None if any will do.
            distance: How far from the position would still count (m).
            angle: How far from the orientation would still count (rad).
        """
        target = np.asarray(position, dtype=np.float64)
        if np.linalg.norm(target - self._shoulder) > self._range + distance:
            return True
        if orientation is None:
            return False
        pose = np.concatenate([target, np.asarray(orientation, dtype=np.float64)])
        shoulder = inverse_transform_points(pose, self._shoulder) - self._circle_center
        height = float(np.dot(shoulder, self._axis))
        aside = float(np.linalg.norm(shoulder - height * self._axis))
        nearest = np.hypot(height, aside - self._circle_radius)
        return bool(nearest > self._wrist_range + distance + angle * self._wrist_distance)
