"""Distances of a Panda's and a hand's collision shapes, measured by PyBullet."""

from pathlib import Path

from handover_marl.config import HandConfig, PandaConfig
from handover_marl.models.kinematic_tree import Sphere
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.client import connect
from handover_marl.sim.bullet.hand_body import Hand
from handover_marl.sim.bullet.panda_body import Panda
from handover_marl.sim.gap import Ruler

_DISTANCE = 8  # field of a PyBullet closest point


class BulletRuler(Ruler):
    """Measures in a physics server of its own.

    Args:
        panda_urdf: The robot's model.
        config: Where it stands.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._panda = Panda(self._client, panda_urdf, config)
        self._hands: dict[Path, Hand] = {}

    def balls(self, urdf: Path) -> dict[int, Sphere]:
        """As `Ruler.balls`."""
        return link_spheres(urdf)

    def distance(self, hand_urdf: Path, robot: list[float], hand: list[float], farthest: float) -> float:
        """As `Ruler.distance`."""
        self._panda.put(robot)
        if hand_urdf not in self._hands:
            self._hands[hand_urdf] = Hand(self._client, hand_urdf, hand, HandConfig())
        body = self._hands[hand_urdf]
        body.put(hand)
        points = self._client.getClosestPoints(self._panda.id, body.id, farthest)
        return min((float(point[_DISTANCE]) for point in points), default=farthest)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._client.close()
