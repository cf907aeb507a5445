"""Human grasps of the 20 YCB objects by the hands of the ten synthetic subjects."""

import json
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import SIDES, Side
from handover_marl.assets.shipped import load_shipped_arrays
from handover_marl.geometry.rotations import euler_from_matrices, rotate_points
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

#: Path of the grasps, made by `building/grasps.py`.
GRASPS_FILE: Final = Path(__file__).parent / "data" / "human_grasps.npz"

#: YCB class names in the order of the file.
GRASPED_OBJECTS: Final = tuple(CLASS_NAMES[number] for number in SCENE_CLASSES)

#: Unit (rad) of the angles in the file, which are 16-bit integers.
ANGLE_STEP: Final = 1e-4

_STATISTICS = json.loads((Path(__file__).parent / "data" / "human_grasp_statistics.json").read_text())

#: Levels of `WRIST_DISTANCE_QUANTILES`.
LEVELS: Final[tuple[float, ...]] = tuple(_STATISTICS["levels"])

#: Quantiles of the distance (m) from the wrist to the object's origin in DexYCB, by YCB class name.
WRIST_DISTANCE_QUANTILES: Final[MappingProxyType[str, tuple[float, ...]]] = MappingProxyType(
    {name: tuple(values["wrist_distance_m"]) for name, values in _STATISTICS["classes"].items()}
)


@dataclass(frozen=True, eq=False)
class HumanGrasps:
    """Grasps of one object by one subject's hand, in the object's frame; all n are sorted by wrist distance.

    Attributes:
        object_from_base: (n, 7) poses of the hand's base, xyz (m) and quaternion xyzw.
        finger_angles: (n, 45) finger joint angles (rad) of the closed hand.
        open_angles: (n, 45) finger joint angles (rad) before closing, clear of the object.
        wrist_distance: (n,) distances (m) from the palm link's origin to the object's origin.
        touching: (n, 5) masks of the digits in contact: index, middle, little, ring finger, thumb.
        overlap: (n,) largest penetrations (m) of hand and object.
        side: Side of the hand.
    """

    object_from_base: npt.NDArray[np.float64]
    finger_angles: npt.NDArray[np.float64]
    open_angles: npt.NDArray[np.float64]
    wrist_distance: npt.NDArray[np.float64]
    touching: npt.NDArray[np.bool_]
    overlap: npt.NDArray[np.float64]
    side: Side

    def __len__(self) -> int:
        return len(self.wrist_distance)

    @property
    def finger_direction(self) -> npt.NDArray[np.float64]:
        """Unit vectors (n, 3) along straight fingers of each grasp, from palm to fingertips, in the object's frame."""
        along = [1.0 if self.side == "left" else -1.0, 0.0, 0.0]
        return np.asarray(rotate_points(self.object_from_base[:, 3:], np.tile(along, (len(self), 1))))

    def compute_hand_dof(self) -> npt.NDArray[np.float64]:
        """Return the hand's joint positions (n, 51) in the grasps, in the object's frame.

        These are the base's position (m), its intrinsic XYZ Euler angles and the finger joint angles (rad).
        """
        poses = self.object_from_base
        matrices = rotate_points(poses[:, None, 3:], np.eye(3)).swapaxes(-1, -2)
        return np.concatenate([poses[:, :3], euler_from_matrices(matrices), self.finger_angles], axis=-1)


def load_human_grasps(object_name: str, subject: int, side: Side) -> HumanGrasps:
    """Load the grasps of a YCB class, e.g. "025_mug", by the "left" or "right" hand of a synthetic subject, 1 to 10."""
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
