"""How near the robot comes to the person: distance of their surfaces, measured in a physics server of its own."""

import math
from pathlib import Path

import numpy as np

from handover_marl.config import HandConfig, PandaConfig
from handover_marl.sim.client import connect
from handover_marl.sim.hand import Hand
from handover_marl.sim.panda import Panda
from handover_marl.sim.world import WorldState

# Taken as bounds, to spare measurements: no point of the Panda is farther than this from a joint's axis (m), and
# none of a hand moves more than so many times as far as the keypoint that moves most.
_LEVER, _SWING = 1.2, 4.0
_FARTHEST = 3.0
_DISTANCE = 8  # field of a PyBullet closest point


class GapMeter:
    """Keeps the smallest distance between the collision shapes of a Panda and of a hand.

    It has a server of its own, so that measuring shows neither in the world's bits nor in which physics was used.

    Args:
        panda_urdf: The robot's model.
        hand_urdf: The hand's.

    Attributes:
        smallest: Smallest distance so far (m), 0 when they touched; infinite before anything was measured.
    """

    def __init__(self, panda_urdf: Path, hand_urdf: Path) -> None:
        self.smallest = math.inf
        self._client = connect()
        self._panda = Panda(self._client, panda_urdf, PandaConfig())
        self._hand_urdf = hand_urdf
        self._hand: Hand | None = None
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._last_gap = math.inf

    def measure(self, state: WorldState) -> None:
        """Take note of a state; one without a hand has no distance."""
        if state.hand_dof_position is None or state.hand_keypoints is None:
            return
        if self._may_be_nearer(state.robot_joint_position, state.hand_keypoints):
            self._measure(state.robot_joint_position.tolist(), state.hand_dof_position.tolist())
            self._last = (state.robot_joint_position, state.hand_keypoints)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._client.close()

    def _may_be_nearer(self, joints: np.ndarray, keypoints: np.ndarray) -> bool:
        """Whether they have moved far enough since the last measurement to have come nearer than ever."""
        if self._last is None:
            return True
        moved = _LEVER * float(np.abs(joints - self._last[0]).sum())
        moved += _SWING * float(np.linalg.norm(keypoints - self._last[1], axis=1).max())
        return self._last_gap - moved < self.smallest

    def _measure(self, joints: list[float], dof: list[float]) -> None:
        self._panda.place(joints)
        if self._hand is None:
            self._hand = Hand(self._client, self._hand_urdf, dof, HandConfig())
        self._hand.place(dof)
        points = self._client.getClosestPoints(self._panda.id, self._hand.id, _FARTHEST)
        self._last_gap = max(0.0, min((point[_DISTANCE] for point in points), default=_FARTHEST))
        self.smallest = min(self.smallest, self._last_gap)
