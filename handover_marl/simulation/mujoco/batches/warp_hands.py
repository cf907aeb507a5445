"""Human hands of many worlds on the device: joints that track a reference, and poses of the links."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, HandConfig
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, RowBank
from handover_marl.geometry.kinematic_tree import KinematicTree, TreeConstants, compute_tree_frames, read_tree
from handover_marl.geometry.poses import quaternion_from_matrix
from handover_marl.simulation.kinematic_paths import list_hand_motors, select_keypoint_links


class HandPath(NamedTuple):
    """Motion of n hands in k physics steps.

    Attributes:
        joints: Joint positions (n, k, 51) after each step (m, rad).
        present: Whether the hand is in the scene after each step, (n, k).
    """

    joints: AnyArray
    present: AnyArray


class HandBatch:
    """Hands of n worlds without contact; see `kinematic_paths.HandTrajectory` for one hand.

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
        self._hands = arrays.zeros(count, "int64")
        self._numbers: dict[tuple[Path, int], int] = {}
        self._structure: list[npt.NDArray[np.int_]] = []
        self._constants: list[RowBank] = []

    def reset(self, row: int, urdf: Path, joints: npt.NDArray[np.float32] | None) -> None:
        """Place a hand.

        Args:
            row: Index of the world.
            urdf: Model of the hand.
            joints: Joint positions (51,) (m, rad); None without a hand at the start.

        Raises:
            OptionError: The hand has other joints than the hands before.
        """
        key = urdf, urdf.stat().st_mtime_ns
        if key not in self._numbers:
            self._numbers[key] = self._add(urdf)
        self._hands[row], self.present[row] = self._numbers[key], joints is not None
        if joints is not None:
            self.joints[row] = self._arrays.asarray(joints, "float64")

    def track(self, rows: AnyArray, targets: AnyArray, present: AnyArray) -> HandPath:
        """Compute the motion of hands whose joints track targets, without changing the hands.

        Args:
            rows: Indices (r,) of the worlds.
            targets: Joint targets (r, k, 51) (m, rad).
            present: Whether the hand is in the scene in each step, (r, k).
        """
        xp = self._arrays.xp
        wanted = xp.astype(targets, xp.float64)
        before, was_present, path = self.joints[rows], self.present[rows], []
        for step in range(wanted.shape[1]):
            # A hand appears at its target.
            appears = (present[:, step] & ~was_present)[:, None]
            before = xp.where(appears, wanted[:, step], before + self._gains * (wanted[:, step] - before))
            was_present = present[:, step]
            path.append(before)
        return HandPath(xp.stack(path, axis=1), present)

    def store(self, rows: AnyArray, path: HandPath, steps: AnyArray) -> None:
        """Set hands to their state after some steps of a path.

        Args:
            rows: Indices (r,) of the worlds.
            path: Motion of the hands.
            steps: Number (r,) of steps; with 0 steps, a hand stays as it is.
        """
        xp, places = self._arrays.xp, self._arrays.arange(len(rows))
        moved, last = steps > 0, xp.clip(steps - 1, 0)
        self.joints[rows] = xp.where(moved[:, None], path.joints[places, last], self.joints[rows])
        self.present[rows] = xp.where(moved, path.present[places, last], self.present[rows])

    def compute_link_poses(self, rows: AnyArray, joints: AnyArray, links: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Compute positions (r, k, l, 3) (m) and quaternions xyzw (r, k, l, 4) of some links.

        Args:
            rows: Indices (r,) of the worlds.
            joints: Joint positions (r, k, 51) (m, rad).
            links: Numbers (l,) of the links.
        """
        origins, rotations = self._compute_frames(rows, joints)
        return origins[..., links, :], quaternion_from_matrix(rotations[..., links, :, :])

    def compute_keypoints(self, rows: AnyArray) -> AnyArray:
        """Compute the positions (r, 16, 3) of wrists and finger-joint origins (m)."""
        origins, _ = self._compute_frames(rows, self.joints[rows][:, None])
        return origins[:, 0, self._keypoint_links]

    def _compute_frames(self, rows: AnyArray, joints: AnyArray) -> tuple[AnyArray, AnyArray]:
        xp, hands = self._arrays.xp, self._hands[rows]
        constants = TreeConstants(*(bank.rows[hands][:, None] for bank in self._constants))
        values = xp.concat([joints, xp.zeros_like(joints[..., :1])], axis=-1)[..., self._columns]
        return compute_tree_frames(constants, self._levels, values)

    def _add(self, urdf: Path) -> int:
        """Copy the constants of a hand to the device, and return its number."""
        tree = read_tree(urdf)
        structure = [tree.columns, *(part for level in tree.levels for part in level)]
        if not self._constants:
            self._set_structure(tree, structure)
        same = len(structure) == len(self._structure)
        if not same or not all(map(np.array_equal, structure, self._structure)):
            raise OptionError(
                f"{urdf}: all hands must have the same joints with backend='warp', this one has others; use "
                "backend='threads'"
            )
        (number,) = {bank.extend(part) for bank, part in zip(self._constants, tree.constants, strict=True)}
        return number

    def _set_structure(self, tree: KinematicTree, structure: list[npt.NDArray[np.int_]]) -> None:
        arrays, self._structure = self._arrays, structure
        self._constants = [RowBank(arrays, part.shape, "float64") for part in tree.constants]
        self._columns = arrays.asarray(tree.columns)
        self._levels = [(arrays.asarray(links), arrays.asarray(parents)) for links, parents in tree.levels]
        moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
        self._keypoint_links = arrays.asarray(select_keypoint_links(moving))
