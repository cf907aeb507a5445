"""How near the robot comes to the person: distance of their surfaces, measured in a physics server of its own."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig, PandaConfig
from handover_marl.models.motion_frames import MotionFrames
from handover_marl.models.poses import IDENTITY, compose_point
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.client import connect
from handover_marl.sim.bullet.hand_body import Hand
from handover_marl.sim.bullet.panda_body import Panda

Array = npt.NDArray[np.float64]

_FARTHEST = 3.0  # m
_DISTANCE = 8  # field of a PyBullet closest point


class GapMeter:
    """Finds the smallest distance between the collision shapes of a Panda and of a hand that move.

    Few times are measured: balls around the links tell which cannot be the nearest, and how far links move between
    two times bounds how much nearer they can be at the other. It has a server of its own, so that measuring shows
    neither in the world's bits nor in which physics was used; models stay loaded in it.

    Args:
        panda_urdf: The robot's model.
        config: Where it stands.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._panda = Panda(self._client, panda_urdf, config)
        self._panda_urdf = panda_urdf
        self._panda_base = np.array([*config.base_position, *config.base_orientation])
        self._hands: dict[Path, Hand] = {}

    def smallest(
        self, hand_urdf: Path, robot: Array, hand: Array, robot_frames: MotionFrames, hand_frames: MotionFrames
    ) -> float:
        """Smallest distance (m) over n times at which there is a hand; 0 where they overlap, at most 3.

        Args:
            hand_urdf: The hand's model.
            robot: (n, 9) joints of the Panda (rad, m).
            hand: (n, 51) joints of the hand (m, rad).
            robot_frames: Link frames at these joints.
            hand_frames: Likewise.
        """
        balls = [
            _Balls(self._panda_urdf, robot_frames, self._panda_base),
            _Balls(hand_urdf, hand_frames, IDENTITY),
        ]
        bounds = _gaps(*balls)
        nearest, left = _FARTHEST, np.arange(len(bounds))
        while len(left):
            time = int(left[bounds[left].argmin()])
            # No less than this at that time, if nothing nearer was found.
            found = self._measure(hand_urdf, robot[time].tolist(), hand[time].tolist(), nearest)
            nearest = min(nearest, found)
            left = left[(bounds[left] < nearest) & (left != time)]
            bounds[left] = np.maximum(bounds[left], found - balls[0].moved(time, left) - balls[1].moved(time, left))
            left = left[bounds[left] < nearest]
        return nearest

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._client.close()

    def _measure(self, hand_urdf: Path, robot: list[float], dof: list[float], farthest: float) -> float:
        self._panda.put(robot)
        if hand_urdf not in self._hands:
            self._hands[hand_urdf] = Hand(self._client, hand_urdf, dof, HandConfig())
        body = self._hands[hand_urdf]
        body.put(dof)
        points = self._client.getClosestPoints(self._panda.id, body.id, farthest)
        return max(0.0, min((point[_DISTANCE] for point in points), default=farthest))


class _Balls:
    """Balls around the shapes of a model's links over time."""

    def __init__(self, urdf: Path, frames: MotionFrames, world_from_base: Array) -> None:
        spheres = link_spheres(urdf)
        links = [link for link in spheres if link >= 0]
        rotations = frames.rotations[:, links]
        places = np.array([spheres[link].center for link in links])
        self.radii = np.array([spheres[link].radius for link in links])
        self.centers = frames.origins[:, links] + (rotations @ places[..., None])[..., 0]
        self._turns = rotations.reshape(*rotations.shape[:2], 9)
        if -1 in spheres:
            # The base stands still, but somebody may reach for it.
            count = len(self.centers)
            center = compose_point(world_from_base, spheres[-1].center)
            self.radii = np.append(self.radii, spheres[-1].radius)
            self.centers = np.concatenate([self.centers, np.broadcast_to(center, (count, 1, 3))], axis=1)
            self._turns = np.concatenate([self._turns, np.zeros((count, 1, 9))], axis=1)

    def moved(self, time: int, others: npt.NDArray[np.int_]) -> Array:
        """(k,) how far (m) no point is farther at other times than from where it is at one time."""
        shifts = np.linalg.norm(self.centers[others] - self.centers[time], axis=-1)
        # A turn by an angle moves a point at distance r by 2 r sin(angle / 2).
        swings = np.linalg.norm(self._turns[others] - self._turns[time], axis=-1) / np.sqrt(2.0)
        way: Array = (shifts + self.radii * swings).max(axis=1, initial=0.0)
        return way


def _gaps(first: _Balls, second: _Balls) -> Array:
    """(n,) distance (m) that two sets of balls have at least."""
    between = np.linalg.norm(first.centers[:, :, None] - second.centers[:, None], axis=-1)
    gaps: Array = (between - first.radii[:, None] - second.radii).min(axis=(1, 2))
    return np.maximum(gaps, 0.0)
