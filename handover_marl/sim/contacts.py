"""Reading contacts from Bullet: only those that the rules ask about."""

from typing import Any

import numpy as np

from handover_marl.geometry import inverse_transform_points
from handover_marl.protocol.contacts import NO_POINTS, Contacts, Points
from handover_marl.sim.client import BulletClient
from handover_marl.sim.hand import Hand
from handover_marl.sim.objects import Object
from handover_marl.sim.panda import Panda

# Fields of a PyBullet contact point.
_BODY_B, _LINK_A, _POSITION_ON_A, _NORMAL_FORCE = 2, 3, 5, 9


class ContactReader:
    """Looks at the contacts of the Panda, the hand and the objects after a physics step."""

    def __init__(self, client: BulletClient, table_id: int, panda: Panda, objects: list[Object]) -> None:
        self._contacts = client.getContactPoints
        self._panda = panda
        self._target = objects[0]
        self._table_id = table_id
        self._supports = {table_id, *(other.id for other in objects[1:])}

    def read(self, hand: Hand | None, released: bool) -> Contacts:
        """Contacts with a normal force above zero.

        Args:
            hand: The hand, if there is one.
            released: Whether the object is free, so that support matters.
        """
        robot_hand = hand is not None and self._touch(self._panda.id, hand.id)
        points = self._contacts(self._panda.id, self._target.id)
        points = [point for point in points if point[_NORMAL_FORCE] > 0.0]
        if not points and not released:
            return Contacts(robot_hand=robot_hand)
        object_pose = self._target.link_poses([self._target.link_id])[0]
        gripper_pose = self._panda.link_poses([self._panda.hand_link])[0]
        left, right = self._panda.finger_links
        return Contacts(
            robot_hand=robot_hand,
            robot_object=bool(points),
            finger_points=(self._finger_points(points, left), self._finger_points(points, right)),
            object_supported=released and self._object_supported(),
            object_height=float(object_pose[2]),
            gripper_position=(float(gripper_pose[0]), float(gripper_pose[1]), float(gripper_pose[2])),
        )

    def _touch(self, body_a: int, body_b: int) -> bool:
        return any(point[_NORMAL_FORCE] > 0.0 for point in self._contacts(body_a, body_b))

    def _object_supported(self) -> bool:
        points = self._contacts(self._target.id)
        return any(point[_NORMAL_FORCE] > 0.0 and point[_BODY_B] in self._supports for point in points)

    def _finger_points(self, points: list[tuple[Any, ...]], link: int) -> Points:
        on_finger = [point[_POSITION_ON_A] for point in points if point[_LINK_A] == link]
        if not on_finger:
            return NO_POINTS
        pose = self._panda.link_poses([link])[0]
        in_world = np.array(on_finger, dtype=np.float32)
        return inverse_transform_points(pose, in_world).astype(np.float32)
