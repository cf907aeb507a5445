"""Inverse kinematics as the engine gives it for a robot in its world, and its products of poses."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig
from handover_marl.sim.bullet.client import connect
from handover_marl.sim.bullet.panda_body import Panda

Array = npt.NDArray[np.float64]


class EngineKinematics:
    """One call of Bullet's solver a question, on a Panda in a physics server of its own.

    The Panda is loaded as the world's is, so that its answers are to the bit those that the world's would give with
    the same joints: 20 damped steps that stop at 0.1 mm, no limits, no rest pose. They do not depend on earlier
    questions. `PandaKinematics` asks again until the hand is there; this does not, and may end short of the target.

    Args:
        urdf: The Panda's model file.
        config: Where the Panda stands.

    Raises:
        SimulationError: The model cannot be loaded.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        self._client = connect()
        self._panda = Panda(self._client, urdf, config)
        self._base = (config.base_position, config.base_orientation)
        self._base_from_world = self._client.invertTransform(*self._base)

    def step_towards(self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: Array | None = None) -> Array:
        """Arm joints from which the hand link is at a pose, or nearer to it.

        Args:
            joints: Nine joint positions to start from (rad, m), as exact as they are known.
            position: World position of the hand link (m).
            orientation: World orientation, quaternion xyzw; None leaves it free.

        Returns:
            (9,) joint positions (rad, m); those of the fingers mean nothing.
        """
        self._panda.place(np.asarray(joints, dtype=np.float64).tolist())
        target = [np.asarray(part, dtype=np.float64).tolist() for part in (position, orientation) if part is not None]
        return np.array(self._client.calculateInverseKinematics(self._panda.id, self._panda.hand_link, *target))

    def in_base(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """A world pose (7,) in the robot's base frame, m and quaternion xyzw, in the engine's single precision."""
        return self._product(self._base_from_world, (world_from_hand[:3].tolist(), world_from_hand[3:].tolist()))

    def in_world(self, base_from_hand: Array) -> Array:
        """A pose (7,) in the robot's base frame as a world pose, likewise."""
        return self._product(self._base, (base_from_hand[:3].tolist(), base_from_hand[3:].tolist()))

    def _product(self, first: tuple[object, object], second: tuple[object, object]) -> Array:
        position, orientation = self._client.multiplyTransforms(*first, *second)
        return np.array([*position, *orientation])
