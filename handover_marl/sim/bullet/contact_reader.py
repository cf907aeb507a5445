"""Reading contacts from Bullet: only those that the rules ask about."""

from collections.abc import Collection
from typing import Any

import numpy as np

from handover_marl.models.poses import inverse_transform_points
from handover_marl.protocol.contacts import NO_POINTS, Contacts, Points
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.object_body import Object
from handover_marl.sim.bullet.panda_body import Panda

# Fields of a PyBullet contact point.
_BODY_B, _LINK_A, _POSITION_ON_A, _NORMAL_FORCE = 2, 3, 5, 9


class ContactReader:
    """Looks at the contacts of the Panda, the hand and the objects after a physics step.

    Args:
        client: The physics server.
        panda: The robot.
    """

    def __init__(self, client: BulletClient, panda: Panda) -> None:
        self._contacts = client.getContactPoints
        self._panda = panda

    def read(self, hand_ids: Collection[int], target: Object | None, supports: Collection[int]) -> Contacts:
        """Contacts with a normal force above zero.

        Args:
            hand_ids: Bodies of the hand, if there is one.
            target: The object to be handed over, or None while it cannot be touched.
            supports: Once the object is free, the bodies that it can lie on, else none.
        """
        touching = [point for point in self._contacts(self._panda.id) if point[_NORMAL_FORCE] > 0.0]
        robot_hand = any(point[_BODY_B] in hand_ids for point in touching)
        points = [] if target is None else [point for point in touching if point[_BODY_B] == target.id]
        if target is None or not (points or supports):
            return Contacts(robot_hand=robot_hand)
        left, right = self._panda.finger_links
        gripper_pose, *finger_poses = self._panda.link_poses([self._panda.hand_link, left, right])
        x, y, z = gripper_pose[:3].tolist()
        return Contacts(
            robot_hand=robot_hand,
            robot_object=bool(points),
            finger_points=(
                _points_on(left, finger_poses[0], points),
                _points_on(right, finger_poses[1], points),
            ),
            object_supported=bool(supports) and self._supported(target, supports),
            object_height=float(target.pose()[2]),
            gripper_position=(x, y, z),
            robot_object_force=sum(point[_NORMAL_FORCE] for point in points),
        )

    def _supported(self, target: Object, supports: Collection[int]) -> bool:
        points = self._contacts(target.id)
        return any(point[_NORMAL_FORCE] > 0.0 and point[_BODY_B] in supports for point in points)


def _points_on(link: int, pose: Points, points: list[tuple[Any, ...]]) -> Points:
    """The points (n, 3) on one of the Panda's links, in that link's frame."""
    on_link = [point[_POSITION_ON_A] for point in points if point[_LINK_A] == link]
    if not on_link:
        return NO_POINTS
    return inverse_transform_points(pose, np.array(on_link, dtype=np.float32)).astype(np.float32)
