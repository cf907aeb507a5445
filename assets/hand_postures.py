"""Batches of palm poses and finger postures of right hands."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

import numpy as np

from handover_marl.assets.hand_model import BoolArray, FloatArray, IntArray, euler_from_matrices

if TYPE_CHECKING:
    from typing_extensions import Self

#: Index of the thumb in `DIGIT_ORDER`.
THUMB: Final = 4


class ArrayBatch:
    """Base class of dataclasses of n items; n is the first dimension of all fields."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: IntArray | BoolArray) -> "Self":
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))  # type: ignore[arg-type]

    @classmethod
    def concatenate(cls, parts: "Sequence[Self]") -> "Self":
        """Return all items of several batches as one batch."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))  # type: ignore[arg-type]
        return cls(
            *(
                type(column[0]).concatenate(column) if isinstance(column[0], ArrayBatch) else np.concatenate(column)
                for column in columns
            )
        )


@dataclass(frozen=True, eq=False)
class Palms(ArrayBatch):
    """Poses of n palms in the object's frame.

    Attributes:
        position: (n, 3) positions (m).
        rotation: (n, 3, 3) rotation matrices.
    """

    position: FloatArray
    rotation: FloatArray

    def transform(self, points: FloatArray) -> FloatArray:
        """Transform points (n, ..., 3) from the palm's frame to the object's frame."""
        count = math.prod(points.shape[1:-1])  # -1 is not allowed where there are no palms
        flat = points.reshape(len(points), count, 3) @ self.rotation.swapaxes(1, 2) + self.position[:, None]
        return np.asarray(flat.reshape(points.shape))


@dataclass(frozen=True, eq=False)
class Posture(ArrayBatch):
    """Finger postures of n right hands.

    Attributes:
        bends: (n, 5, 3) flexion (rad) of the digits' joints, in `DIGIT_ORDER`.
        spread: (n, 4) abduction (rad) of the fingers at the knuckles, towards the thumb.
        thumb_root: (n, 3, 3) rotation of the thumb's root before flexion.
        thumb_axis: (n, 3) unit axis of the thumb's flexion in the palm's frame.
    """

    bends: FloatArray
    spread: FloatArray
    thumb_root: FloatArray
    thumb_axis: FloatArray

    def compute_joint_angles(self) -> FloatArray:
        """Return the finger joint angles (n, 45), intrinsic XYZ Euler angles (rad)."""
        angles = np.zeros((len(self), 5, 3, 3))
        angles[..., 2] = self.bends
        angles[:, :THUMB, 0, 1] = self.spread
        bends = self.bends[:, THUMB]
        local = np.einsum("nji,nj->ni", self.thumb_root, self.thumb_axis)
        angles[:, THUMB, 0] = euler_from_matrices(
            make_rotations_about_axes(self.thumb_axis, bends[:, 0]) @ self.thumb_root
        )
        for joint in (1, 2):
            angles[:, THUMB, joint] = euler_from_matrices(make_rotations_about_axes(local, bends[:, joint]))
        return angles.reshape(-1, 45)


def make_rotations_about_axes(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Return rotation matrices (n, 3, 3) about unit axes (n, 3) by angles (n,) (rad)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sin, cos = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * cross @ cross)
