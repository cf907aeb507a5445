"""Human grasps of the 20 objects by the ten synthetic people's hands, as they ship with the library."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import SIDES, SUBJECTS, Side, euler_angles
from handover_marl.errors import DataNotFoundError, UnknownNameError
from handover_marl.models.poses import rotate
from handover_marl.models.ycb import CLASS_NAMES, SCENE_CLASSES

#: The shipped grasps.
GRASPS_FILE: Final = Path(__file__).parent / "data" / "human_grasps.npz"

#: Names of the objects, in the order of the file.
GRASPED_OBJECTS: Final = tuple(CLASS_NAMES[number] for number in SCENE_CLASSES)

#: Step (rad) of the angles in the file, which are stored as 16-bit integers.
ANGLE_STEP: Final = 1e-4


@dataclass(frozen=True, eq=False)
class HumanGrasps:
    """n ways in which one person holds one object, by rising wrist distance.

    Attributes:
        object_from_base: (n, 7) pose of the hand's base in the object's frame, xyz (m) and quaternion xyzw.
        finger_angles: (n, 45) finger joints (rad) closed onto the object.
        open_angles: (n, 45) finger joints (rad) before closing, clear of the object.
        wrist_distance: (n) distance (m) from the palm link's origin to the object's.
        free_share: (n) share of the object's surface that is more than 30 mm from the hand.
        touching: (n, 5) which digits touch: index, middle, little, ring finger, thumb.
        overlap: (n) deepest overlap (m) of hand and object.
        side: Whose hand.
    """

    object_from_base: npt.NDArray[np.float64]
    finger_angles: npt.NDArray[np.float64]
    open_angles: npt.NDArray[np.float64]
    wrist_distance: npt.NDArray[np.float64]
    free_share: npt.NDArray[np.float64]
    touching: npt.NDArray[np.bool_]
    overlap: npt.NDArray[np.float64]
    side: Side

    def __len__(self) -> int:
        return len(self.wrist_distance)

    @property
    def pointing(self) -> npt.NDArray[np.float64]:
        """(n, 3) unit vectors along the straight fingers, in the object's frame: where the hand comes from."""
        along = [1.0 if self.side == "left" else -1.0, 0.0, 0.0]
        return rotate(self.object_from_base[:, 3:], np.tile(along, (len(self), 1)))

    def hand_dof(self, row: int) -> npt.NDArray[np.float64]:
        """(51) the hand's joints with the object at the origin: base xyz (m), base angles and fingers (rad)."""
        pose = self.object_from_base[row]
        matrix = rotate(np.tile(pose[3:], (3, 1)), np.eye(3)).T
        return np.concatenate([pose[:3], euler_angles(matrix), self.finger_angles[row]])


def human_grasps(object_name: str, subject: int, side: Side) -> HumanGrasps:
    """How one of the ten synthetic people holds an object.

    Args:
        object_name: A class name such as `"025_mug"`.
        subject: 1 to 10.
        side: Which hand.

    Raises:
        UnknownNameError: There is no such object, subject or side.
        DataNotFoundError: The file of grasps is missing.
    """
    for kind, value, valid in (
        ("object", object_name, GRASPED_OBJECTS),
        ("subject", subject, SUBJECTS),
        ("side", side, SIDES),
    ):
        if value not in valid:
            raise UnknownNameError(kind, value, map(str, valid))
    data = _content()
    at = GRASPED_OBJECTS.index(object_name), SIDES.index(side), subject - 1
    return HumanGrasps(
        object_from_base=data["object_from_base"][at].astype(np.float64),
        finger_angles=data["finger_angles"][at] * ANGLE_STEP,
        open_angles=data["open_angles"][at] * ANGLE_STEP,
        wrist_distance=data["wrist_distance"][at].astype(np.float64),
        free_share=data["free_share"][at].astype(np.float64),
        touching=data["touching"][at].copy(),
        overlap=data["overlap"][at].astype(np.float64),
        side=side,
    )


@cache
def _content() -> dict[str, npt.NDArray[Any]]:
    if not GRASPS_FILE.is_file():
        raise DataNotFoundError(
            f"{GRASPS_FILE} is missing; build it with: python -m handover_marl.assets.building.build_human_grasps"
        )
    with np.load(GRASPS_FILE, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}
