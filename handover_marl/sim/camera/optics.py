"""The wrist camera's optics: where it is, what it projects where, and back.

HandoverSim's camera: a pinhole at (0.036, 0, 0.036) m of the Panda's hand link that looks along the link's z axis,
image right being its y axis and image down its negative x axis; 224 x 224 pixels, 90 degrees, 0.035 to 2 m.

The software renderer that the reference draws with samples its pixel (column u, row v) at the image position
(u, v + 1), but the reference takes the point for one at (u, v), so that its clouds lie depth / 112 too far towards
image up. `REFERENCE` geometry does the same, in the same float32 operations; `TRUE` geometry puts points where
they are.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.errors import UnknownNameError

Array = npt.NDArray[np.float32]

#: Pixels a side, vertical and horizontal field of view (degrees), and the nearest and farthest depth seen (m).
SIDE: Final = 224
FIELD_OF_VIEW: Final = 90.0
NEAR: Final = 0.035
FAR: Final = 2.0
#: The depth of a pixel that shows nothing: what the reference makes of an empty depth buffer.
NOTHING: Final = np.float32(1.9999951)
#: The pinhole in the hand link's frame (m).
PINHOLE: Final = (0.036, 0.0, 0.036)

#: Kinds of deprojection.
REFERENCE, TRUE = "reference", "true"
GEOMETRIES = (REFERENCE, TRUE)

#: Half the picture in pixels, which at 90 degrees is the focal length too.
CENTER: Final = SIDE / 2
#: Where in a pixel it is sampled: image position less pixel number, right and down.
SAMPLED_AT: Final = (0.0, 1.0)

# The reference's single-precision tangent of 45 degrees makes the focal length the last number below 112.
_FOCAL = np.nextafter(np.float32(CENTER), np.float32(0.0))
_SCALE, _SHIFT = np.float32(1.0) / _FOCAL, -np.float32(CENTER) / _FOCAL


def check_geometry(geometry: str) -> None:
    """Check the name of a kind of deprojection.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if geometry not in GEOMETRIES:
        raise UnknownNameError("geometry", geometry, GEOMETRIES)


def deproject(depth: Array, seen: npt.NDArray[np.bool_], geometry: str = REFERENCE) -> Array:
    """The points that some pixels show.

    Args:
        depth: (224, 224) float32 along the viewing axis (m).
        seen: (224, 224) which pixels.
        geometry: One of `GEOMETRIES`.

    Returns:
        (n, 3) float32 in the hand link's frame (m), row by row of the picture.

    Raises:
        UnknownNameError: There is no such geometry.
    """
    check_geometry(geometry)
    pixels = np.flatnonzero(seen)
    down, right = (number.astype(np.float32) for number in np.divmod(pixels, SIDE))
    if geometry == TRUE:
        right, down = right + np.float32(SAMPLED_AT[0]), down + np.float32(SAMPLED_AT[1])
    z = depth.ravel()[pixels]
    x, y = np.float32(PINHOLE[0]) - z * (_SCALE * down + _SHIFT), z * (_SCALE * right + _SHIFT)
    points: Array = np.stack([x, y, z + np.float32(PINHOLE[2])], axis=1)
    return points


def metric_depth(buffer: Array) -> Array:
    """Depth along the viewing axis (m) of an OpenGL depth buffer, in the reference's float32 operations."""
    depth: Array = np.float32(FAR * NEAR) / (np.float32(FAR) - np.float32(FAR - NEAR) * buffer)
    # The reference's sign for nothing; its software renderer leaves `NOTHING` instead.
    depth[buffer == 1.0] = 0.0
    return depth
