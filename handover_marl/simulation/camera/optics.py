"""Optics of the wrist camera: projection, deprojection, light.

The camera is HandoverSim's: a pinhole at (0.036, 0, 0.036) m in the Panda's hand link that looks along the link's z
axis; image right is the link's y axis, image down its negative x axis. Images have 224 x 224 pixels, 90 degrees field
of view, and a depth range of 0.035 to 2 m.

HandoverSim's renderer samples the pixel (column u, row v) at the image position (u, v + 1), but its deprojection
assumes (u, v), so its points are shifted by depth / 112 towards image up. `HANDOVERSIM_MODEL` repeats that shift with
the same float32 operations; `PINHOLE_MODEL` is exact.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.errors import check_name
from handover_marl.geometry.arrays import AnyArray, get_namespace, stack_last
from handover_marl.geometry.panda import CAMERA_LINK

Array = npt.NDArray[np.float32]

#: Pixels per side and of an image, field of view (degrees, horizontal and vertical), and depth range (m).
IMAGE_SIZE: Final = 224
N_PIXELS: Final = IMAGE_SIZE * IMAGE_SIZE
FIELD_OF_VIEW: Final = 90.0
NEAR: Final = 0.035
FAR: Final = 2.0
#: Depth (m) of background pixels: HandoverSim's conversion of an empty depth buffer.
EMPTY_DEPTH: Final = np.float32(1.9999951)
#: Position of the pinhole in the hand link's frame (m).
CAMERA_POSITION_IN_HAND: Final = (0.036, 0.0, 0.036)
#: Axes of the camera (right, down, ahead) in the hand link's frame, as columns.
HAND_FROM_CAMERA: Final = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
#: Links of the robot that the camera does not see: its own housing is nearer than the near plane.
INVISIBLE_LINKS: Final = (CAMERA_LINK,)

#: Names of the deprojection models.
HANDOVERSIM_MODEL, PINHOLE_MODEL = "handoversim", "pinhole"
CAMERA_MODELS = (HANDOVERSIM_MODEL, PINHOLE_MODEL)

#: Half the image size, which equals the focal length in pixels at 90 degrees.
HALF_SIZE_PX: Final = IMAGE_SIZE / 2
#: Offset (right, down) from a pixel's number to the image position at which it is sampled.
SAMPLE_OFFSET_PX: Final = (0.0, 1.0)

# HandoverSim computes tan(45 degrees) in float32, which makes the focal length the largest number below 112.
_FOCAL = np.nextafter(np.float32(HALF_SIZE_PX), np.float32(0.0))
_SCALE, _SHIFT = float(np.float32(1.0) / _FOCAL), float(-np.float32(HALF_SIZE_PX) / _FOCAL)

#: Distance behind a back face, which is invisible, at which a ray continues (m).
BACK_FACE_OFFSET: Final = 1e-5
#: A ray that meets more back faces than this is dropped.
MAX_BACK_FACES: Final = 32
#: Brightness of a face with unit normal n in the world, as in PyBullet's renderer without shadows:
#: ambient + diffuse * max(0, n . l) + specular * max(0, z)^2, where l is the direction towards the light, and z the
#: height of the reflected light 2 (n . l) n - l.
LIGHT: Final = (-0.43193421, 0.25916052, 0.86386843)
AMBIENT: Final = 0.6
DIFFUSE: Final = 0.35
SPECULAR: Final = 0.05
#: Red, green and blue, 0 to 255, of the sky, and of the ground's squares before shading. Squares have sides of 1 m; the
#: first color is that of squares whose lower corners x, y in the world have an even sum (m).
SKY: Final = (255, 255, 255)
GROUND: Final = ((255, 255, 255), (173, 199, 239))


def deproject(depth: Array, mask: npt.NDArray[np.bool_], camera_model: str = HANDOVERSIM_MODEL) -> Array:
    """Compute the 3D points (n, 3) of the pixels of a depth image (224, 224) where `mask` (224, 224) is True.

    The depth is float32 along the viewing axis (m). The points are float32 in the hand link's frame (m), in image
    order. `camera_model` is the deprojection model, one of `CAMERA_MODELS`; another name raises `UnknownNameError`.
    """
    pixels = np.flatnonzero(mask)
    points: Array = compute_points(pixels, depth.ravel()[pixels], camera_model)
    return points


def compute_points(pixels: AnyArray, depth: AnyArray, camera_model: str = HANDOVERSIM_MODEL) -> AnyArray:
    """Compute the 3D points (..., 3) of pixels from their numbers in image order and their depths, both (...).

    Depths are float32 along the viewing axis (m), points float32 in the hand link's frame (m), as arrays or tensors.
    `camera_model` is the deprojection model, one of `CAMERA_MODELS`; another name raises `UnknownNameError`.
    """
    check_name("camera_model", camera_model, CAMERA_MODELS)
    xp = get_namespace(pixels)
    down, right = (xp.astype(number, xp.float32) for number in (pixels // IMAGE_SIZE, pixels % IMAGE_SIZE))
    if camera_model == PINHOLE_MODEL:
        right, down = right + SAMPLE_OFFSET_PX[0], down + SAMPLE_OFFSET_PX[1]
    x = CAMERA_POSITION_IN_HAND[0] - depth * (_SCALE * down + _SHIFT)
    y = depth * (_SCALE * right + _SHIFT)
    return stack_last([x, y, depth + CAMERA_POSITION_IN_HAND[2]])


def depth_from_buffer(buffer: Array) -> Array:
    """Convert an OpenGL depth buffer to depth along the viewing axis (m), and buffer values of 1 to 0.

    The float32 operations are HandoverSim's.
    """
    depth: Array = np.float32(FAR * NEAR) / (np.float32(FAR) - np.float32(FAR - NEAR) * buffer)
    # HandoverSim marks empty pixels so; its software renderer has no buffer value of 1 and gives `EMPTY_DEPTH`.
    depth[buffer == 1.0] = 0.0
    return depth
