"""Distances between the Panda and a human hand, measured by PyBullet."""

from pathlib import Path

from handover_marl.config import HandConfig, PandaConfig
from handover_marl.geometry.kinematic_tree import BoundingSphere
from handover_marl.simulation.bullet.bodies import HandBody, PandaBody
from handover_marl.simulation.bullet.client import connect
from handover_marl.simulation.bullet.shapes import read_bounding_spheres
from handover_marl.simulation.clearance import DistanceQuery

# Field of a PyBullet closest point.
_DISTANCE = 8


class BulletDistanceQuery(DistanceQuery):
    """Distances between the collision shapes of a Panda and of a human hand, by PyBullet.

    The models are loaded into a separate physics client.

    Args:
        panda_urdf: Model of the robot.
        config: Base pose of the robot.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._panda = PandaBody(self._client, panda_urdf, config)
        self._hands: dict[Path, HandBody] = {}

    def read_bounding_spheres(self, urdf: Path) -> dict[int, BoundingSphere]:
        """Return a sphere around the collision shapes of each link by link number.

        The number of the base link is -1.

        Links without collision shapes are left out.
        """
        return read_bounding_spheres(urdf)

    def measure(self, hand_urdf: Path, robot: list[float], hand: list[float], max_distance: float) -> float:
        """Measure the smallest distance of robot and human hand (m); see `DistanceQuery`."""
        self._panda.reset_joints_at_rest(robot)
        if hand_urdf not in self._hands:
            self._hands[hand_urdf] = HandBody(self._client, hand_urdf, hand, HandConfig())
        body = self._hands[hand_urdf]
        body.reset_joints_at_rest(hand)
        points = self._client.getClosestPoints(self._panda.id, body.id, max_distance)
        return min((float(point[_DISTANCE]) for point in points), default=max_distance)

    def close(self) -> None:
        """Disconnect from the PyBullet physics server."""
        self._client.close()
