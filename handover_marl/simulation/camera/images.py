"""Images of a camera, their segmentation labels, and the joint positions of the bodies that they show."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class SegmentationLabel(IntEnum):
    """Labels of the pixels in a segmentation mask of a camera."""

    BACKGROUND = 0  # ground, or beyond the depth range
    ROBOT = 1
    TABLE = 2
    TARGET = 3  # the object that is handed over
    OTHER_OBJECT = 4
    HAND = 5


@dataclass(frozen=True, eq=False)
class CameraImage:
    """Depth image, segmentation mask and colors of a camera of h x w pixels.

    Attributes:
        depth: (h, w) float32 depth along the viewing axis (m); `Pinhole.empty_depth` for background.
        segmentation: (h, w) uint8 values of `SegmentationLabel`.
        rgb: (h, w, 3) uint8 colors, or None.
    """

    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8] | None = None

    def compute_mask(self, label: SegmentationLabel) -> npt.NDArray[np.bool_]:
        """Return a boolean mask (h, w) of the pixels with a segmentation label."""
        mask: npt.NDArray[np.bool_] = self.segmentation == label
        return mask


class JointSnapshot(NamedTuple):
    """Joint positions of robot, human hand and objects at one time, float32 (m, rad).

    Attributes:
        robot: Positions (9,) of the Panda's joints.
        hand: Positions (51,) of the human hand's joints, or None if there is no hand.
        objects: Positions (n, 6) of the objects' joint chains: xyz and intrinsic XYZ Euler angles.
    """

    robot: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32] | None
    objects: npt.NDArray[np.float32]


#: Colors of the labels in figures, "#rrggbb".
LABEL_COLORS = {
    SegmentationLabel.BACKGROUND: "#e8e8e8",
    SegmentationLabel.ROBOT: "#555555",
    SegmentationLabel.TABLE: "#b08d57",
    SegmentationLabel.TARGET: "#e4572e",
    SegmentationLabel.OTHER_OBJECT: "#76b041",
    SegmentationLabel.HAND: "#2e86ab",
}
