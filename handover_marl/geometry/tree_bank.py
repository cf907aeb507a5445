"""Kinematic trees of many models with the same joints on a device: forward kinematics of all of them at once."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, RowBank
from handover_marl.geometry.kinematic_tree import KinematicTree, TreeConstants, compute_tree_frames, read_tree


class TreeBank:
    """Kinematic trees of models that have the same joints; links may have different sizes.

    Args:
        noun: Plural of the models' kind, for errors, e.g. "hands".
        arrays: Creator of arrays on the device.
    """

    def __init__(self, noun: str, arrays: ArrayFactory) -> None:
        self._noun, self._arrays = noun, arrays
        self._numbers: dict[tuple[Path, int], int] = {}
        self._structure: list[npt.NDArray[np.int_]] = []
        self._constants: list[RowBank] = []
        self._levels: Sequence[tuple[AnyArray, AnyArray]] = ()

    def add(self, urdf: Path) -> int:
        """Copy the constants of a model to the device, unless they are there, and return its number.

        Raises:
            OptionError: The model has other joints than the models before.
            SimulationError: The file is not a URDF.
        """
        key = urdf, urdf.stat().st_mtime_ns
        if key not in self._numbers:
            self._numbers[key] = self._add(urdf)
        return self._numbers[key]

    def compute_link_frames(self, numbers: AnyArray, joints: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Compute origins (r, k, L, 3) in m and rotations (r, k, L, 3, 3) of the links of r models.

        `joints` (r, k, d) are positions in k configurations of each model (rad, m), float64.
        """
        xp = self._arrays.xp
        constants = TreeConstants(*(bank.rows[numbers][:, None] for bank in self._constants))
        # Fixed joints read the zero that is appended.
        values = xp.concat([joints, xp.zeros_like(joints[..., :1])], axis=-1)[..., self._columns]
        return compute_tree_frames(constants, self._levels, values)

    def _add(self, urdf: Path) -> int:
        tree = read_tree(urdf)
        structure = [tree.columns, *(part for level in tree.levels for part in level)]
        if not self._constants:
            self._set_structure(tree, structure)
        same = len(structure) == len(self._structure)
        if not same or not all(map(np.array_equal, structure, self._structure)):
            raise OptionError(
                f"{urdf}: all {self._noun} must have the same joints with backend='warp', this one has others; use "
                "backend='threads'"
            )
        (number,) = {bank.extend(part) for bank, part in zip(self._constants, tree.constants, strict=True)}
        return number

    def _set_structure(self, tree: KinematicTree, structure: list[npt.NDArray[np.int_]]) -> None:
        arrays, self._structure = self._arrays, structure
        self._constants = [RowBank(arrays, part.shape, "float64") for part in tree.constants]
        self._columns = arrays.asarray(tree.columns)
        self._levels = [(arrays.asarray(links), arrays.asarray(parents)) for links, parents in tree.levels]
