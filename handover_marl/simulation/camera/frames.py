"""Optics of the wrist camera and its images: projection, deprojection, segmentation labels.

The camera is HandoverSim's: a pinhole at (0.036, 0, 0.036) m in the Panda's hand link that looks along the link's z
axis; image right is the link's y axis, image down its negative x axis. Images have 224 x 224 pixels, 90 degrees field
of view, and a depth range of 0.035 to 2 m.

HandoverSim's renderer samples the pixel (column u, row v) at the image position (u, v + 1), but its deprojection
assumes (u, v), so its points are shifted by depth / 112 towards image up. `HANDOVERSIM_MODEL` repeats that shift with
the same float32 operations; `PINHOLE_MODEL` is exact.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.errors import check_name

Array = npt.NDArray[np.float32]

#: Pixels per side, field of view (degrees, horizontal and vertical), and depth range (m).
IMAGE_SIZE: Final = 224
FIELD_OF_VIEW: Final = 90.0
NEAR: Final = 0.035
FAR: Final = 2.0
#: Depth (m) of background pixels: HandoverSim's conversion of an empty depth buffer.
EMPTY_DEPTH: Final = np.float32(1.9999951)
#: Position of the pinhole in the hand link's frame (m).
CAMERA_POSITION_IN_HAND: Final = (0.036, 0.0, 0.036)

#: Names of the deprojection models.
HANDOVERSIM_MODEL, PINHOLE_MODEL = "handoversim", "pinhole"
CAMERA_MODELS = (HANDOVERSIM_MODEL, PINHOLE_MODEL)

#: Half the image size, which equals the focal length in pixels at 90 degrees.
HALF_SIZE_PX: Final = IMAGE_SIZE / 2
#: Offset (right, down) from a pixel's number to the image position at which it is sampled.
SAMPLE_OFFSET_PX: Final = (0.0, 1.0)

# HandoverSim computes tan(45 degrees) in float32, which makes the focal length the largest number below 112.
_FOCAL = np.nextafter(np.float32(HALF_SIZE_PX), np.float32(0.0))
_SCALE, _SHIFT = np.float32(1.0) / _FOCAL, -np.float32(HALF_SIZE_PX) / _FOCAL


class SegmentationLabel(IntEnum):
    """Labels of the pixels in a segmentation mask of the wrist camera."""

    BACKGROUND = 0  # ground, or beyond the depth range
    ROBOT = 1
    TABLE = 2
    TARGET = 3  # the object that is handed over
    OTHER_OBJECT = 4
    HAND = 5


@dataclass(frozen=True, eq=False)
class CameraImage:
    """Depth image, segmentation mask and colours of the wrist camera.

    Attributes:
        depth: (224, 224) float32 depth along the viewing axis (m); `EMPTY_DEPTH`, just under 2 m, for background.
        segmentation: (224, 224) uint8 values of `SegmentationLabel`.
        rgb: (224, 224, 3) uint8 colours, or None.
    """

    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8] | None = None

    def compute_mask(self, label: SegmentationLabel) -> npt.NDArray[np.bool_]:
        """Return a boolean mask (224, 224) of the pixels with a segmentation label."""
        mask: npt.NDArray[np.bool_] = self.segmentation == label
        return mask


def deproject(depth: Array, mask: npt.NDArray[np.bool_], camera_model: str = HANDOVERSIM_MODEL) -> Array:
    """Compute the 3D points of the masked pixels of a wrist-camera depth image.

    Args:
        depth: (224, 224) float32 depth along the viewing axis (m).
        mask: (224, 224) True for pixels to deproject.
        camera_model: Name of the deprojection model, one of `CAMERA_MODELS`.

    Returns:
        (n, 3) float32 points in the hand link's frame (m), in image order.

    Raises:
        UnknownNameError: There is no camera model of that name.
    """
    check_name("camera_model", camera_model, CAMERA_MODELS)
    pixels = np.flatnonzero(mask)
    down, right = (number.astype(np.float32) for number in np.divmod(pixels, IMAGE_SIZE))
    if camera_model == PINHOLE_MODEL:
        right, down = right + np.float32(SAMPLE_OFFSET_PX[0]), down + np.float32(SAMPLE_OFFSET_PX[1])
    z = depth.ravel()[pixels]
    x = np.float32(CAMERA_POSITION_IN_HAND[0]) - z * (_SCALE * down + _SHIFT)
    y = z * (_SCALE * right + _SHIFT)
    points: Array = np.stack([x, y, z + np.float32(CAMERA_POSITION_IN_HAND[2])], axis=1)
    return points


def depth_from_buffer(buffer: Array) -> Array:
    """Convert an OpenGL depth buffer to depth along the viewing axis (m).

    The float32 operations are HandoverSim's.
    """
    depth: Array = np.float32(FAR * NEAR) / (np.float32(FAR) - np.float32(FAR - NEAR) * buffer)
    # HandoverSim marks empty pixels so; its software renderer has no buffer value of 1 and gives `EMPTY_DEPTH`.
    depth[buffer == 1.0] = 0.0
    return depth
