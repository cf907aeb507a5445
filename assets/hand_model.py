"""Procedural model of the human hand (dimensions, kinematics, model files) and human grasps of 20 YCB objects.

The hand has HandoverSim's structure: a base on three prismatic and three continuous joints (x, y, z), a palm that is
fixed to the base at an offset, and 15 finger joints with three revolute axes (x, y, z) each. At zero angles all link
frames are parallel to the base: fingers along -x, back of the hand along +y, thumb towards +z. A left hand is a right
hand mirrored in x. Joint angles are intrinsic XYZ Euler angles (rad).

`data/hand_dimensions.json` has the dimensions with their sources.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import DATA_ROOT, TEMPLATES_PACKAGE, load_shipped_arrays
from handover_marl.execution.files import render_template
from handover_marl.geometry.rotations import euler_from_matrices, matrices_from_euler, rotate_points
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

Side = Literal["left", "right"]
FloatArray = npt.NDArray[np.float64]

_DIMENSIONS = json.loads((DATA_ROOT / "hand_dimensions.json").read_text())
_DIGITS = _DIMENSIONS["digits"]


@dataclass(frozen=True)
class HandSize:
    """Outer dimensions (m) of a hand.

    Attributes:
        length: Distance from the wrist crease to the middle fingertip.
        breadth: Breadth over the four knuckles.
    """

    length: float
    breadth: float


_MIDDLE = _DIGITS["middle"]
#: Size of the reference hand: mean bone lengths, mean breadth of women and men. Other hands are scaled copies of it.
REFERENCE_SIZE: Final = HandSize(
    length=_MIDDLE["carpus"] + _MIDDLE["metacarpal"] + sum(_MIDDLE["phalanges"]) + _MIDDLE["tip"],
    breadth=_DIMENSIONS["breadth"],
)

#: Mean and standard deviation (m) of hand length and of hand breadth.
WOMEN: Final[list[list[float]]] = _DIMENSIONS["women"]
MEN: Final[list[list[float]]] = _DIMENSIONS["men"]
#: Hand sizes of the ten subjects: in turn a woman and a man at the 5th, 25th, 50th, 75th and 95th
#: percentile of hand length.
SUBJECT_SIZES: Final = tuple(
    HandSize(round(length[0] + scores[0] * length[1], 4), round(breadth[0] + scores[1] * breadth[1], 4))
    for scores in _DIMENSIONS["scores"]
    for length, breadth in (WOMEN, MEN)
)
#: Skin colors (red, green, blue, 0 to 1) of the ten subjects.
SKIN_COLORS: Final = [tuple(color) for color in _DIMENSIONS["skin_colors"]]

SIDES: Final[tuple[Side, Side]] = ("left", "right")
SUBJECTS: Final = range(1, len(SUBJECT_SIZES) + 1)

#: Order of the digits in the joint vector and among the links, as in MANO. Each digit has three joints.
DIGIT_ORDER: Final = ("index", "middle", "little", "ring", "thumb")

#: Folder of the shipped hand models: a folder with a URDF for each hand, and the meshes of all hands.
HANDS_FOLDER: Final = Path(__file__).parent / "data" / "hands"


@dataclass(frozen=True, eq=False)
class HandGeometry:
    """Dimensions (m) of one human hand in the link frames of its zero pose.

    Attributes:
        side: "left" or "right".
        size: Length and breadth of the hand.
        scale: (3,) scale factors of the reference hand along x, y and z.
        palm_offset: (3,) position of the palm in the base's frame.
        joint_origins: (15, 3) positions of the finger joints in their parent's frame (the palm or the previous joint).
        tips: (15, 3) ends of the phalanges' axes in their own frame; the end of a last phalanx is
            the center of the fingertip's sphere.
        radii: (15, 2) capsule radii of the phalanges at the joint and at the end.
    """

    side: Side
    size: HandSize
    scale: FloatArray
    palm_offset: FloatArray
    joint_origins: FloatArray
    tips: FloatArray
    radii: FloatArray

    def compute_link_poses(self, dof: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Compute the forward kinematics: positions (..., 16, 3) and rotations (..., 16, 3, 3) of palm and phalanges.

        `dof` (..., 51) has the position (m) and the angles of the hand's base, then 45 finger angles (rad). The results
        (m) are in the frame in which the base's position and angles are given.
        """
        joints = np.asarray(dof, dtype=np.float64)
        rotations = matrices_from_euler(joints[..., 3:].reshape(*joints.shape[:-1], 16, 3))
        positions = np.empty((*joints.shape[:-1], 16, 3))
        positions[..., 0, :] = joints[..., :3] + rotations[..., 0, :, :] @ self.palm_offset
        for joint in range(15):
            parent = 0 if joint % 3 == 0 else joint
            at, link = rotations[..., parent, :, :], joint + 1
            positions[..., link, :] = positions[..., parent, :] + at @ self.joint_origins[joint]
            rotations[..., link, :, :] = at @ rotations[..., link, :, :]
        return positions, rotations

    def compute_keypoints(self, dof: npt.ArrayLike) -> FloatArray:
        """Compute 21 keypoints of the hand (..., 21, 3) in m; `dof` and the frame are as in `compute_link_poses`.

        The keypoints are the wrist, then three joints and the fingertip of each digit: index, middle, little and ring
        finger, thumb.
        """
        positions, rotations = self.compute_link_poses(dof)
        directions = self.tips / np.linalg.norm(self.tips, axis=1, keepdims=True)
        tips = self.tips + directions * self.radii[:, 1:]
        ends = np.einsum("...ij,...j->...i", rotations[..., 1:, :, :], tips)
        points = [positions[..., :1, :]]
        for digit in range(5):
            first = 1 + 3 * digit
            last = positions[..., first + 2, :] + ends[..., first + 1, :]
            points += [positions[..., first : first + 3, :], last[..., None, :]]
        return np.concatenate(points, axis=-2)


def _compute_reference_bones() -> Mapping[str, tuple[FloatArray, FloatArray]]:
    """Return the reference hand's joint origins (3, 3) and tips (3, 3) by digit (m), in frames as in `HandGeometry`."""
    bones = {}
    for name in DIGIT_ORDER:
        digit = _DIGITS[name]
        if name == "thumb":
            direction = np.array(_DIMENSIONS["thumb_direction"]) / np.linalg.norm(_DIMENSIONS["thumb_direction"])
            root, lengths = np.array(_DIMENSIONS["thumb_root"]), [digit["metacarpal"], *digit["phalanges"]]
        else:
            direction = np.array([-np.cos(digit["splay"]), 0.0, np.sin(digit["splay"])])
            reach, (y, z) = digit["carpus"] + digit["metacarpal"], digit["knuckle"]
            root, lengths = np.array([-np.sqrt(reach**2 - y**2 - z**2), y, z]), [*digit["phalanges"]]
        lengths[-1] += digit["tip"] - digit["radii"][-1]
        ends = np.outer(lengths, direction)
        bones[name] = np.vstack([root, ends[:2]]), ends
    return bones


def scale_hand(size: HandSize, side: Side) -> HandGeometry:
    """Return a "left" or "right" hand: the reference hand, scaled to the length and the breadth in `size`."""
    across = size.breadth / REFERENCE_SIZE.breadth
    scale = np.array([size.length / REFERENCE_SIZE.length, across, across])
    stretch = scale * np.array([-1.0 if side == "left" else 1.0, 1.0, 1.0])
    bones = _compute_reference_bones()
    radii = np.array([_DIGITS[name]["radii"][joint : joint + 2] for name in DIGIT_ORDER for joint in range(3)])
    return HandGeometry(
        side=side,
        size=size,
        scale=scale,
        palm_offset=_round_to_micrometers(np.array(_DIMENSIONS["palm_offset"]) * stretch),
        joint_origins=_round_to_micrometers(np.vstack([bones[name][0] for name in DIGIT_ORDER]) * stretch),
        tips=_round_to_micrometers(np.vstack([bones[name][1] for name in DIGIT_ORDER]) * stretch),
        radii=_round_to_micrometers(radii * across),
    )


@cache
def make_hand_geometry(subject: int, side: Side) -> HandGeometry:
    """Return the "left" or "right" hand of one of the ten subjects, numbered from 1."""
    return scale_hand(SUBJECT_SIZES[subject - 1], side)


def find_hand_urdf(subject: int, side: Side) -> Path:
    """Return the path of the URDF of the "left" or "right" hand of a subject, numbered from 1 to 10."""
    return HANDS_FOLDER / f"synthetic-subject-{subject:02d}_{side}" / "mano.urdf"


def _round_to_micrometers(values: FloatArray) -> FloatArray:
    # As in the model files; adding zero turns -0.0 into 0.0.
    return np.round(values, 6) + 0.0


def format_hand_urdf(model: HandGeometry, name: str, color: tuple[float, float, float], folder: str) -> str:
    """Return a hand's URDF, with HandoverSim's 53 links, as text; `color` is RGB (0 to 1), `folder` has the meshes."""
    return render_template(
        TEMPLATES_PACKAGE,
        "hand.urdf",
        name=name,
        color=format_numbers((*color, 1.0)),
        scale=format_numbers(model.scale),
        folder=folder,
        meshes=["palm", *(f"{digit}{joint}" for digit in DIGIT_ORDER for joint in (1, 2, 3))],
        positions=[format_numbers(position) for position in (model.palm_offset, *model.joint_origins)],
        masses=(0.2, 0.02),
        limits=(np.pi, np.pi / 2, np.pi),
    )


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers with up to 6 decimals, separated by spaces."""
    # Adding zero turns -0.0 into 0.0.
    texts = (f"{round(float(value), 6) + 0.0:.6f}" for value in values)
    return " ".join(text.rstrip("0").rstrip(".") for text in texts)


#: Path of the human grasps, made by `building/grasps.py`.
GRASPS_FILE: Final = DATA_ROOT / "human_grasps.npz"

#: YCB class names in the order of `GRASPS_FILE`.
GRASPED_OBJECTS: Final = tuple(CLASS_NAMES[number] for number in SCENE_CLASSES)

#: Unit (rad) of the 16-bit integer angles in `GRASPS_FILE`.
ANGLE_STEP: Final = 1e-4

_STATISTICS = json.loads((DATA_ROOT / "human_grasp_statistics.json").read_text())

#: Levels (0 to 1) of `WRIST_DISTANCE_QUANTILES`.
LEVELS: Final[tuple[float, ...]] = tuple(_STATISTICS["levels"])

#: Quantiles of the distance (m) from the wrist to the object's origin in DexYCB, by YCB class name.
WRIST_DISTANCE_QUANTILES: Final[MappingProxyType[str, tuple[float, ...]]] = MappingProxyType(
    {name: tuple(values["wrist_distance_m"]) for name, values in _STATISTICS["classes"].items()}
)


@dataclass(frozen=True, eq=False)
class HumanGrasps:
    """The n grasps of an object by one subject's hand, in the object's frame.

    Attributes:
        object_from_base: (n, 7) poses of the hand's base, xyz (m) and quaternion xyzw.
        finger_angles: (n, 45) finger joint angles (rad) of the closed hand.
        open_angles: (n, 45) finger joint angles (rad) before closing, clear of the object.
        wrist_distance: (n,) distances (m) from the palm link's origin to the object's origin.
        touching: (n, 5) masks of the digits in contact: index, middle, little, ring finger, thumb.
        overlap: (n,) largest penetrations (m) of hand and object.
        side: Side of the hand.
    """

    object_from_base: FloatArray
    finger_angles: FloatArray
    open_angles: FloatArray
    wrist_distance: FloatArray
    touching: npt.NDArray[np.bool_]
    overlap: FloatArray
    side: Side

    def __len__(self) -> int:
        return len(self.wrist_distance)

    @property
    def finger_direction(self) -> FloatArray:
        """Unit vectors (n, 3) from palm to fingertips if the fingers were straight, in the object's frame."""
        along = [1.0 if self.side == "left" else -1.0, 0.0, 0.0]
        return np.asarray(rotate_points(self.object_from_base[:, 3:], np.tile(along, (len(self), 1))))

    def compute_hand_dof(self) -> FloatArray:
        """Return the joint positions (n, 51) of the closed hand in n grasps, in the object's frame.

        A row has the base's position (m), its intrinsic XYZ Euler angles (rad) and 45 finger joint angles (rad).
        """
        poses = self.object_from_base
        matrices = rotate_points(poses[:, None, 3:], np.eye(3)).swapaxes(-1, -2)
        return np.concatenate([poses[:, :3], euler_from_matrices(matrices), self.finger_angles], axis=-1)


def load_human_grasps(object_name: str, subject: int, side: Side) -> HumanGrasps:
    """Load the 20 grasps of a YCB class, e.g. "025_mug", by a hand of subject 1 to 10, sorted by wrist distance."""
    data = load_shipped_arrays(GRASPS_FILE)
    at = GRASPED_OBJECTS.index(object_name), SIDES.index(side), subject - 1
    return HumanGrasps(
        object_from_base=data["object_from_base"][at].astype(np.float64),
        finger_angles=data["finger_angles"][at] * ANGLE_STEP,
        open_angles=data["open_angles"][at] * ANGLE_STEP,
        wrist_distance=data["wrist_distance"][at].astype(np.float64),
        touching=data["touching"][at].copy(),
        overlap=data["overlap"][at].astype(np.float64),
        side=side,
    )
