"""How near the robot comes to the person: distance of their surfaces, measured in a simulation of its own."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig
from handover_marl.models.kinematic_tree import Sphere
from handover_marl.models.motion_frames import MotionFrames
from handover_marl.models.poses import IDENTITY, compose_point
from handover_marl.options import pybullet_installed

Array = npt.NDArray[np.float64]

_FARTHEST = 3.0  # m


class Ruler(ABC):
    """Measures between the collision shapes of a Panda and of hands; what an engine has to do for a gap meter."""

    @abstractmethod
    def balls(self, urdf: Path) -> dict[int, Sphere]:
        """A ball around the collision shapes of every link that has some; -1 is the base."""

    @abstractmethod
    def distance(self, hand_urdf: Path, robot: list[float], hand: list[float], farthest: float) -> float:
        """Distance (m) of their surfaces, not above 0 where they overlap, or `farthest` if it is larger.

        Args:
            hand_urdf: The hand's model.
            robot: Nine joints of the Panda (rad, m).
            hand: 51 joints of the hand (m, rad).
            farthest: What is beyond need not be measured (m).
        """

    @abstractmethod
    def close(self) -> None:
        """Free what it measures in."""


def make_ruler(panda_urdf: Path, config: PandaConfig) -> Ruler:
    """PyBullet's where that is installed, else MuJoCo's; they agree to half a millimetre.

    Args:
        panda_urdf: The robot's model.
        config: Where it stands.

    Raises:
        SimulationError, DataFormatError: The model cannot be read.
    """
    if pybullet_installed():
        from handover_marl.sim.bullet.bullet_ruler import BulletRuler

        return BulletRuler(panda_urdf, config)
    from handover_marl.sim.mujoco.mujoco_ruler import MujocoRuler

    return MujocoRuler(panda_urdf, config)


class GapMeter:
    """Finds the smallest distance between the collision shapes of a Panda and of a hand that move.

    Few times are measured: balls around the links tell which cannot be the nearest, and how far links move between
    two times bounds how much nearer they can be at the other. It has a simulation of its own, so that measuring shows
    neither in the world's bits nor in which physics was used; models stay loaded in it.

    Args:
        panda_urdf: The robot's model.
        config: Where it stands.
        ruler: What measures; default: that of the engine that is installed.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig, ruler: Ruler | None = None) -> None:
        self._ruler = ruler or make_ruler(panda_urdf, config)
        self._panda_urdf = panda_urdf
        self._panda_base = np.array([*config.base_position, *config.base_orientation])

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
            _Balls(self._ruler.balls(self._panda_urdf), robot_frames, self._panda_base),
            _Balls(self._ruler.balls(hand_urdf), hand_frames, IDENTITY),
        ]
        bounds = _gaps(*balls)
        nearest, left = _FARTHEST, np.arange(len(bounds))
        while len(left):
            time = int(left[bounds[left].argmin()])
            # No less than this at that time, if nothing nearer was found.
            found = max(0.0, self._ruler.distance(hand_urdf, robot[time].tolist(), hand[time].tolist(), nearest))
            nearest = min(nearest, found)
            left = left[(bounds[left] < nearest) & (left != time)]
            bounds[left] = np.maximum(bounds[left], found - balls[0].moved(time, left) - balls[1].moved(time, left))
            left = left[bounds[left] < nearest]
        return nearest

    def close(self) -> None:
        """Free what it measures in."""
        self._ruler.close()


class _Balls:
    """Balls around the shapes of a model's links over time."""

    def __init__(self, spheres: dict[int, Sphere], frames: MotionFrames, world_from_base: Array) -> None:
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
