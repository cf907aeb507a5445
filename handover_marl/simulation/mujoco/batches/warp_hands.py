"""Human hands of many worlds on the device: joints that track a reference, and poses of the links."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, HandConfig
from handover_marl.geometry.arrays import AnyArray, ArrayFactory
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import quaternion_from_matrix
from handover_marl.geometry.tree_bank import TreeBank
from handover_marl.simulation.reference_tracking import list_hand_motors, select_keypoint_links


class HandTrajectoryBatch(NamedTuple):
    """Motion of n hands in k physics steps.

    Attributes:
        joints: Joint positions (n, k, 51) after each step (m, rad).
        present: Whether the hand is in the scene after each step, (n, k).
    """

    joints: AnyArray
    present: AnyArray


class HandBatch:
    """Hands of n worlds without contact; see `reference_tracking.HandTrajectory` for one hand.

    The hands may have different sizes, but have the same joints. The argument `rows` (r,) of methods has the indices of
    the worlds to which a method applies.

    Args:
        count: Number n of worlds.
        config: Motors of the hands' joints.
        arrays: Creator of tensors on the device.

    Attributes:
        joints: Joint positions (n, 51) (m, rad), undefined without a hand.
        present: Whether there is a hand, (n,).
    """

    def __init__(self, count: int, config: HandConfig, arrays: ArrayFactory) -> None:
        self._arrays = arrays
        self._gains = arrays.asarray([motor.position_gain for motor in list_hand_motors(config)], "float64")
        self.joints, self.present = arrays.zeros((count, HAND_DOF)), arrays.zeros(count, "bool")
        self._hands, self._trees = arrays.zeros(count, "int64"), TreeBank("hands", arrays)
        self._keypoint_links: AnyArray = None

    def reset(self, row: int, urdf: Path, joints: npt.NDArray[np.float32] | None) -> None:
        """Place a hand.

        Args:
            row: Index of the world.
            urdf: Model of the hand.
            joints: Joint positions (51,) (m, rad); None without a hand at the start.

        Raises:
            OptionError: The hand has other joints than the hands before.
        """
        self._hands[row], self.present[row] = self._trees.add(urdf), joints is not None
        if self._keypoint_links is None:
            self._keypoint_links = self._arrays.asarray(select_keypoint_links(read_tree(urdf).moving_links))
        if joints is not None:
            self.joints[row] = self._arrays.asarray(joints, "float64")

    def track(self, rows: AnyArray, targets: AnyArray, present: AnyArray) -> HandTrajectoryBatch:
        """Compute the motion of hands whose joints track targets, without changing the hands.

        Args:
            rows: Indices (r,) of the worlds.
            targets: Joint targets (r, k, 51) (m, rad).
            present: Whether the hand is in the scene in each step, (r, k).
        """
        xp = self._arrays.xp
        wanted = xp.astype(targets, xp.float64)
        before, was_present, joints = self.joints[rows], self.present[rows], []
        for step in range(wanted.shape[1]):
            # A hand appears at its target.
            appears = (present[:, step] & ~was_present)[:, None]
            before = xp.where(appears, wanted[:, step], before + self._gains * (wanted[:, step] - before))
            was_present = present[:, step]
            joints.append(before)
        return HandTrajectoryBatch(xp.stack(joints, axis=1), present)

    def store(self, rows: AnyArray, trajectory: HandTrajectoryBatch, steps: AnyArray) -> None:
        """Set hands to their state after some steps of a trajectory.

        Args:
            rows: Indices (r,) of the worlds.
            trajectory: Motion of the hands.
            steps: Number (r,) of steps; with 0 steps, a hand stays as it is.
        """
        xp, places = self._arrays.xp, self._arrays.arange(len(rows))
        moved, last = steps > 0, xp.clip(steps - 1, 0)
        self.joints[rows] = xp.where(moved[:, None], trajectory.joints[places, last], self.joints[rows])
        self.present[rows] = xp.where(moved, trajectory.present[places, last], self.present[rows])

    def compute_link_poses(self, rows: AnyArray, joints: AnyArray, links: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Compute positions (r, k, l, 3) (m) and quaternions xyzw (r, k, l, 4) of some links.

        Args:
            rows: Indices (r,) of the worlds.
            joints: Joint positions (r, k, 51) (m, rad).
            links: Numbers (l,) of the links.
        """
        origins, rotations = self._trees.compute_link_frames(self._hands[rows], joints)
        return origins[..., links, :], quaternion_from_matrix(rotations[..., links, :, :])

    def compute_keypoints(self, rows: AnyArray) -> AnyArray:
        """Compute the positions (r, 16, 3) of wrists and finger-joint origins (m)."""
        origins, _ = self._trees.compute_link_frames(self._hands[rows], self.joints[rows][:, None])
        return origins[:, 0, self._keypoint_links]
