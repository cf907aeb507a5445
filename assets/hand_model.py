"""The procedural human hand: its measures, its kinematics and where its model files lie.

The hand has HandoverSim's structure: a base on three sliding and three turning joints (x, y, z), a palm fixed
to it at an offset, and 15 finger joints of three turning axes (x, y, z) each. With all angles at zero every
link frame is parallel to the base: fingers along -x, back of the hand along +y, thumb towards +z. A left hand
is a right hand mirrored in x.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.assets.anthropometry import CARPUS, DIGITS, REFERENCE_SIZE, SUBJECT_SIZES, HandSize
from handover_marl.errors import DataNotFoundError, UnknownNameError

Side = Literal["left", "right"]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer[Any]]
BoolArray = npt.NDArray[np.bool_]

SIDES: Final[tuple[Side, Side]] = ("left", "right")
SUBJECTS: Final = range(1, len(SUBJECT_SIZES) + 1)

#: Order of the digits in the joint vector and among the links (MANO's), three joints each.
DIGIT_ORDER: Final = ("index", "middle", "little", "ring", "thumb")

#: Folder of the shipped models.
HANDS_FOLDER: Final = Path(__file__).parent / "data" / "hands"

# Sideways (z) and vertical (y) place of the knuckles and of the thumb's root (m), reference hand, and the angle
# (rad) by which straight fingers spread. Breadth over the skin is the knuckles' spread plus a finger's thickness.
_KNUCKLE_Z: Final = MappingProxyType({"index": 0.0235, "middle": 0.0015, "ring": -0.0190, "little": -0.0375})
_KNUCKLE_Y: Final = MappingProxyType({"index": -0.002, "middle": 0.0, "ring": -0.002, "little": -0.006})
_SPLAY: Final = MappingProxyType({"index": 0.06, "middle": 0.0, "ring": -0.05, "little": -0.13})
_THUMB_ROOT: Final = (-0.0170, -0.0090, 0.0200)
_THUMB_DIRECTION: Final = (-0.72, -0.42, 0.55)
_PALM_OFFSET: Final = (0.0950, 0.0063, 0.0060)

# Radii (m) at root, middle joint, end joint and tip. At the fingers' middle and end joints and the thumb's end
# joint they lie 2 to 6 per cent below those of circles of the mean circumferences of men's joints (Greiner 1991),
# scaled to the reference hand's breadth; the others continue the taper.
_RADII: Final = MappingProxyType(
    {
        "index": (0.0112, 0.0096, 0.0083, 0.0069),
        "middle": (0.0114, 0.0098, 0.0084, 0.0070),
        "little": (0.0097, 0.0082, 0.0071, 0.0060),
        "ring": (0.0109, 0.0093, 0.0079, 0.0066),
        "thumb": (0.0145, 0.0120, 0.0105, 0.0082),
    }
)


@dataclass(frozen=True, eq=False)
class HandModel:
    """Measures of one hand, all in metres and in the frame of its zero pose.

    Attributes:
        side: Left or right.
        size: Length and breadth.
        scale: (3) factors on the reference hand along x, y and z.
        palm_offset: (3) palm in the base's frame.
        joint_origins: (15, 3) finger joints, each in its parent's frame (palm or the joint before).
        tips: (15, 3) far end of every phalanx's axis in its own frame; of an end joint the centre of the
            fingertip's ball.
        radii: (15, 2) capsule radii at the joint and at the far end.
    """

    side: Side
    size: HandSize
    scale: FloatArray
    palm_offset: FloatArray
    joint_origins: FloatArray
    tips: FloatArray
    radii: FloatArray

    @property
    def bone_lengths(self) -> FloatArray:
        """(15) distance (m) from each finger joint to the next, or to the centre of the fingertip."""
        return np.asarray(np.linalg.norm(self.tips, axis=1))

    def forward(self, dof: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Poses of the palm and the 15 phalanges.

        Args:
            dof: (..., 51) base xyz (m), base angles and 45 finger angles (rad), intrinsic x-y-z Euler angles.

        Returns:
            Positions (..., 16, 3) (m) and rotation matrices (..., 16, 3, 3) in the frame `dof` is given in.
        """
        joints = np.asarray(dof, dtype=np.float64)
        rotations = euler_matrices(joints[..., 3:].reshape(*joints.shape[:-1], 16, 3))
        positions = np.empty((*joints.shape[:-1], 16, 3))
        positions[..., 0, :] = joints[..., :3] + rotations[..., 0, :, :] @ self.palm_offset
        for joint in range(15):
            parent = 0 if joint % 3 == 0 else joint
            at, link = rotations[..., parent, :, :], joint + 1
            positions[..., link, :] = positions[..., parent, :] + at @ self.joint_origins[joint]
            rotations[..., link, :, :] = at @ rotations[..., link, :, :]
        return positions, rotations

    def keypoints(self, dof: npt.ArrayLike) -> FloatArray:
        """(..., 21, 3) positions (m): wrist, then per digit (index, middle, little, ring, thumb) three joints and
        the fingertip.
        """  # noqa: D205
        positions, rotations = self.forward(dof)
        ends = np.einsum("...ij,...j->...i", rotations[..., 1:, :, :], self.tips + self._tip_reach())
        points = [positions[..., :1, :]]
        for digit in range(5):
            first = 1 + 3 * digit
            last = positions[..., first + 2, :] + ends[..., first + 1, :]
            points += [positions[..., first : first + 3, :], last[..., None, :]]
        return np.concatenate(points, axis=-2)

    def _tip_reach(self) -> FloatArray:
        directions = self.tips / np.linalg.norm(self.tips, axis=1, keepdims=True)
        return np.asarray(directions * self.radii[:, 1:])


def euler_matrices(angles: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of intrinsic x-y-z Euler angles (..., 3) (rad)."""
    values = np.asarray(angles, dtype=np.float64)
    (sx, sy, sz), (cx, cy, cz) = np.moveaxis(np.sin(values), -1, 0), np.moveaxis(np.cos(values), -1, 0)
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_angles(matrices: npt.ArrayLike) -> FloatArray:
    """Intrinsic x-y-z Euler angles (..., 3) (rad) of rotation matrices (..., 3, 3), y within +-pi/2."""
    m = np.asarray(matrices, dtype=np.float64)
    x = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    y = np.arcsin(np.clip(m[..., 0, 2], -1.0, 1.0))
    return np.stack([x, y, np.arctan2(-m[..., 0, 1], m[..., 0, 0])], axis=-1)


def _reference_bones() -> Mapping[str, tuple[FloatArray, FloatArray]]:
    """Per digit: the joints' origins (3, 3) and the far ends of the bones (3, 3) of the right reference hand."""
    bones = {}
    for name in DIGIT_ORDER:
        digit, thumb = DIGITS[name], name == "thumb"
        if thumb:
            direction = np.array(_THUMB_DIRECTION) / np.linalg.norm(_THUMB_DIRECTION)
            root, lengths = np.array(_THUMB_ROOT), [digit.metacarpal, *digit.phalanges]
        else:
            direction = np.array([-np.cos(_SPLAY[name]), 0.0, np.sin(_SPLAY[name])])
            reach, y, z = CARPUS[name] + digit.metacarpal, _KNUCKLE_Y[name], _KNUCKLE_Z[name]
            root, lengths = np.array([-np.sqrt(reach**2 - y**2 - z**2), y, z]), list(digit.phalanges)
        lengths[-1] += digit.tip - _RADII[name][-1]
        ends = np.outer(lengths, direction)
        bones[name] = np.vstack([root, ends[:2]]), ends
    return bones


def sized_hand(size: HandSize, side: Side) -> HandModel:
    """The hand of a given size: the reference hand stretched along its length and across it."""
    if side not in SIDES:
        raise UnknownNameError("side", side, SIDES)
    across = size.breadth / REFERENCE_SIZE.breadth
    scale = np.array([size.length / REFERENCE_SIZE.length, across, across])
    stretch = scale * np.array([-1.0 if side == "left" else 1.0, 1.0, 1.0])
    bones = _reference_bones()
    radii = np.array([_RADII[name][joint : joint + 2] for name in DIGIT_ORDER for joint in range(3)])
    return HandModel(
        side=side,
        size=size,
        scale=scale,
        palm_offset=_rounded(np.array(_PALM_OFFSET) * stretch),
        joint_origins=_rounded(np.vstack([bones[name][0] for name in DIGIT_ORDER]) * stretch),
        tips=_rounded(np.vstack([bones[name][1] for name in DIGIT_ORDER]) * stretch),
        radii=_rounded(radii * across),
    )


@cache
def hand_model(subject: int, side: Side) -> HandModel:
    """The hand of one of the ten synthetic people, numbered from 1.

    Raises:
        UnknownNameError: There is no such subject or side.
    """
    if subject not in SUBJECTS:
        raise UnknownNameError("subject", subject, map(str, SUBJECTS))
    return sized_hand(SUBJECT_SIZES[subject - 1], side)


def hand_name(subject: int, side: Side) -> str:
    """Folder name of a hand, `synthetic-subject-NN_<side>`."""
    return f"synthetic-subject-{subject:02d}_{side}"


def hand_urdf(subject: int, side: Side) -> Path:
    """Path of a shipped hand's URDF.

    Raises:
        UnknownNameError: There is no such subject or side.
        DataNotFoundError: The models are not where they belong.
    """
    hand_model(subject, side)
    path = HANDS_FOLDER / hand_name(subject, side) / "mano.urdf"
    if not path.is_file():
        raise DataNotFoundError(
            f"{path} is missing; build it with: python -m handover_marl.assets.building.build_hands"
        )
    return path


def _rounded(values: FloatArray) -> FloatArray:
    # Micrometres, as written to the model files; adding zero turns -0.0 into 0.0.
    return np.round(values, 6) + 0.0
