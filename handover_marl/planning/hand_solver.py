"""Inverse kinematics of the library's own, for receivers that otherwise ask PyBullet: planning's without limits."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS, PANDA_DOF, PandaConfig
from handover_marl.models.arm import Arm
from handover_marl.models.arm_range import ArmRange
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import HAND_LINK
from handover_marl.models.poses import IDENTITY, compose, inverse
from handover_marl.planning.inverse_kinematics import solve

Array = npt.NDArray[np.float64]

_UNLIMITED = np.full(ARM_JOINTS, -np.inf), np.full(ARM_JOINTS, np.inf)
# How near the hand ends to where it is to be (m, rad), as with PyBullet.
_TOLERANCE = (1e-3, 0.1)
# From far away PyBullet's damped steps end in other joints than Newton's own. With this damping all but one of 640
# questions of `yang2021` (40 scenes of s0 train) are answered where PyBullet answers, 95 % within 0.03 rad of it.
_DAMPING = 0.1
# As PyBullet's: no joint turns farther in a step (rad).
_STRIDE = np.pi / 4.0
_STEPS, _STALL = 500, 3e-4
# A single question: steps, and where they stop.
_FEW_STEPS, _CLOSE = 20, (1e-4, 1e-3)
# What a search may still come to that ends at the tolerance.
_DISTANCE, _ANGLE = 2e-3, 0.11


class HandSolver:
    """Answers what `PandaKinematics` and `EngineKinematics` do, which call PyBullet; the answers differ a little.

    Joint limits are not respected, as there. Answers do not depend on earlier questions.

    Args:
        urdf: The Panda's model file.
        config: Where the Panda stands.

    Raises:
        SimulationError: The model cannot be read, or is no Panda's.
    """

    def __init__(self, urdf: Path, config: PandaConfig) -> None:
        tree = read_tree(urdf)
        self._arm = Arm(tree)
        self._base = np.array([*config.base_position, *config.base_orientation])
        self._base_from_world = inverse(self._base)
        hand = [joint.link for joint in tree.joints].index(HAND_LINK)
        self._range = ArmRange(tree, hand, self._base)

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Arm joints that bring the hand link to a pose, or None if the search does not converge.

        Args:
            start: Nine joint positions to start from (rad, m); fingers are ignored.
            position: World position of the hand link (m).
            orientation: World orientation, quaternion xyzw; None leaves it free.

        Returns:
            (7,) arm joint positions (rad).
        """
        if self._range.excludes(position, orientation, _DISTANCE, _ANGLE):
            return None
        found, solved = self._search(start, position, orientation, _TOLERANCE, _STEPS, _STALL)
        return found if solved else None

    def step_towards(
        self, joints: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array:
        """Arm joints from which the hand link is at a pose, or nearer to it.

        Args:
            joints: Nine joint positions to start from (rad, m).
            position: World position of the hand link (m).
            orientation: World orientation, quaternion xyzw; None leaves it free.

        Returns:
            (9,) joint positions (rad, m); those of the fingers mean nothing.
        """
        found, _ = self._search(joints, position, orientation, _CLOSE, _FEW_STEPS, 0.0)
        return np.concatenate([found, np.zeros(PANDA_DOF - ARM_JOINTS)])

    def in_base(self, world_from_hand: npt.NDArray[np.floating]) -> Array:
        """A world pose (7,) in the robot's base frame, m and quaternion xyzw, in single precision."""
        return compose(self._base_from_world, world_from_hand).astype(np.float32).astype(np.float64)

    def in_world(self, base_from_hand: Array) -> Array:
        """A pose (7,) in the robot's base frame as a world pose, likewise."""
        return compose(self._base, base_from_hand).astype(np.float32).astype(np.float64)

    def _search(
        self,
        start: npt.ArrayLike,
        position: npt.ArrayLike,
        orientation: npt.ArrayLike | None,
        tolerance: tuple[float, float],
        steps: int,
        stall: float,
    ) -> tuple[Array, bool]:
        """(7,) joints where a search ends, and whether it got there."""
        pose = np.concatenate([np.asarray(position, np.float64), IDENTITY[3:] if orientation is None else orientation])
        local = compose(self._base_from_world, pose)
        turn = None if orientation is None else Rotation.from_quat(local[3:]).as_matrix()[None]
        seed = np.asarray(start, dtype=np.float64)[None, :ARM_JOINTS]
        found, solved = solve(
            *(self._arm, local[None, :3], turn, seed, _UNLIMITED, tolerance, steps),
            damping=_DAMPING,
            stall=stall,
            stride=_STRIDE,
        )
        return found[0], bool(solved[0])
