"""Optics of cameras: projection, deprojection, light.

A camera's axes are OpenCV's: x is image right, y image down, z ahead. The pinhole projects a point (x, y, z) of the
camera's frame to the image position K (x / z, y / z, 1), in pixels from the center of the first pixel.

All renderers sample pixels as HandoverSim's does, which shifts the principal point by one row: it is column w / 2, row
h / 2 - 1 of an image of w x h pixels. HandoverSim's deprojection assumes row h / 2, so its points are shifted towards
image up, by depth / focal length. `HANDOVERSIM_MODEL` repeats that shift with the same float32 operations;
`PINHOLE_MODEL` is exact.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.config import CAMERAS, CameraConfig, Vector3
from handover_marl.errors import check_name
from handover_marl.geometry.arrays import AnyArray, get_namespace, stack_last
from handover_marl.geometry.panda import CAMERA_LINK

Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Depth of background pixels as a share of the far plane's distance, from HandoverSim's conversion of depth buffers.
_EMPTY_SHARE: Final = np.float32(1.9999951) / np.float32(2.0)
#: Links of the robot that no camera sees: the wrist camera's own housing is nearer than its near plane.
INVISIBLE_LINKS: Final = (CAMERA_LINK,)

#: Names of the deprojection models.
HANDOVERSIM_MODEL, PINHOLE_MODEL = "handoversim", "pinhole"
CAMERA_MODELS = (HANDOVERSIM_MODEL, PINHOLE_MODEL)

#: A pixel in column u and row v is sampled at (u, v) plus this offset: pixels to the right and downwards from the
#: image's upper left corner.
SAMPLE_OFFSET_PX: Final = (0.0, 1.0)

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


@dataclass(frozen=True)
class Pinhole:
    """Pinhole camera without distortion.

    Attributes:
        width: Width of the image (pixels).
        height: Height of the image (pixels).
        focal: Focal lengths along image right and down (pixels).
        principal: Principal point (column, row) in pixels from the center of the first pixel.
        near: Distance of the near plane (m).
        far: Distance of the far plane (m).
        link: Link of the robot in whose frame position and axes are; "" for the world frame.
        position: Position of the pinhole (m).
        axes: Axes of the camera (right, down, ahead) as the columns of a matrix (3, 3), which is stored row by row.
    """

    width: int
    height: int
    focal: tuple[float, float]
    principal: tuple[float, float]
    near: float
    far: float
    link: str
    position: Vector3
    axes: tuple[Vector3, Vector3, Vector3]

    @property
    def n_pixels(self) -> int:
        """Number of pixels of an image."""
        return self.width * self.height

    @property
    def empty_depth(self) -> np.float32:
        """Depth (m) of background pixels, just under that of the far plane."""
        depth: np.float32 = np.float32(self.far) * _EMPTY_SHARE
        return depth

    @functools.cached_property
    def pixels(self) -> npt.NDArray[np.int64]:
        """Numbers (h, w) of the pixels, counted row by row from 0."""
        return np.arange(self.n_pixels).reshape(self.height, self.width)

    @functools.cached_property
    def rays(self) -> Array:
        """Directions (n, 3) of the rays through all n pixels, row by row, in the camera's frame, scaled to z = 1."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        right, down = ((at - c) / f for at, c, f in zip((columns, rows), self.principal, self.focal, strict=True))
        return np.stack([right, down, np.ones(right.shape)], axis=-1).reshape(-1, 3).astype(np.float32)


def to_rows(axes: Float64Array) -> tuple[Vector3, Vector3, Vector3]:
    """Return a matrix (3, 3) as a tuple of its rows, as in `Pinhole.axes`."""
    first, second, third = ((float(a), float(b), float(c)) for a, b, c in axes)
    return first, second, third


@functools.lru_cache(maxsize=64)
def make_pinhole(config: CameraConfig) -> Pinhole:
    """Return the pinhole camera of a configuration."""
    # Rounded, since the tangent of 45 degrees is not exactly 1.
    focal = round(config.height / 2.0 / math.tan(math.radians(config.vertical_fov) / 2.0), 9)
    ahead = np.subtract(config.target, config.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, config.up)
    right /= np.linalg.norm(right)
    # Zeros without a sign.
    axes = to_rows(np.stack([right, np.cross(ahead, right), ahead], axis=1) + 0.0)
    return Pinhole(
        width=config.width,
        height=config.height,
        focal=(focal, focal),
        principal=(config.width / 2.0 - SAMPLE_OFFSET_PX[0], config.height / 2.0 - SAMPLE_OFFSET_PX[1]),
        near=config.near,
        far=config.far,
        link=config.link,
        position=config.position,
        axes=axes,
    )


#: Wrist camera of HandoverSim.
WRIST_CAMERA = make_pinhole(CAMERAS["wrist"])


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Calibration of a camera, in OpenCV's axes: x is image right, y image down, z ahead.

    The point of a pixel in column u and row v with depth d is d K^-1 (u, v, 1) in the camera's frame.

    Attributes:
        width: Width of the image (pixels).
        height: Height of the image (pixels).
        K: Matrix (3, 3) of the intrinsics (pixels), float64.
        link: Link of the robot on which the camera is mounted; "" for a camera that is fixed in the world.
        extrinsics: Pose (4, 4) of the camera in the link's frame, or in the world frame (m), float64: the matrix from
            the camera's frame to the link's or the world frame.
    """

    width: int
    height: int
    K: Float64Array
    link: str
    extrinsics: Float64Array


def make_camera_info(config: CameraConfig) -> CameraInfo:
    """Return the calibration of the camera of a configuration."""
    camera, extrinsics = make_pinhole(config), np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = camera.axes, camera.position
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CameraInfo(config.width, config.height, matrix, config.link, extrinsics)


def describe_calibration(infos: Mapping[str, CameraInfo]) -> dict[str, Float64Array]:
    """Return the matrices of cameras, given by name, with the keys of environments' infos, e.g. "wrist_K"."""
    return {
        f"{name}_{key}": matrix
        for name, info in infos.items()
        for key, matrix in (("K", info.K), ("extrinsics", info.extrinsics))
    }


def deproject(
    depth: Array, mask: npt.NDArray[np.bool_], camera_model: str = HANDOVERSIM_MODEL, camera: Pinhole = WRIST_CAMERA
) -> Array:
    """Compute the 3D points (n, 3) of the pixels of a depth image (h, w) where `mask` (h, w) is True.

    The depth is float32 along the viewing axis (m). The points are float32 in the frame of the camera's link or in the
    world frame (m), ordered row by row. `camera_model` is the deprojection model, one of `CAMERA_MODELS`; another
    name raises `UnknownNameError`.
    """
    pixels = np.flatnonzero(mask)
    points: Array = deproject_pixels(pixels, depth.ravel()[pixels], camera_model, camera)
    return points


def deproject_pixels(
    pixels: AnyArray, depth: AnyArray, camera_model: str = HANDOVERSIM_MODEL, camera: Pinhole = WRIST_CAMERA
) -> AnyArray:
    """Compute the 3D points (..., 3) of pixels from their numbers, counted row by row, and their depths, both (...).

    Units, frame and other arguments are as for `deproject`; `pixels` and `depth` are arrays or tensors.
    """
    check_name("camera_model", camera_model, CAMERA_MODELS)
    xp = get_namespace(pixels)
    down, right = (xp.astype(number, xp.float32) for number in (pixels // camera.width, pixels % camera.width))
    if camera_model == PINHOLE_MODEL:
        right, down = right + SAMPLE_OFFSET_PX[0], down + SAMPLE_OFFSET_PX[1]
    # HandoverSim computes tan(45 degrees) in float32, which makes the focal length the largest number below 112.
    focal = np.nextafter(np.array(camera.focal, np.float32), np.float32(0.0))
    scale = (np.float32(1.0) / focal).tolist()
    shift = (np.array([camera.width, camera.height], np.float32) / np.float32(-2.0) / focal).tolist()
    own = depth * (scale[0] * right + shift[0]), depth * (scale[1] * down + shift[1]), depth
    sums = []
    for place, row in zip(camera.position, camera.axes, strict=True):
        # Without products by 0, which take time.
        parts = [coordinate * factor for factor, coordinate in zip(row, own, strict=True) if factor]
        sums.append(sum(parts, place))
    return stack_last(sums)


def depth_from_buffer(buffer: Array, camera: Pinhole = WRIST_CAMERA) -> Array:
    """Convert an OpenGL depth buffer (0 to 1) to depth along the viewing axis (m); a value of 1 becomes depth 0.

    The float32 operations are HandoverSim's.
    """
    near, far = camera.near, camera.far
    depth: Array = np.float32(far * near) / (np.float32(far) - np.float32(far - near) * buffer)
    # HandoverSim marks empty pixels by depth 0; its software renderer never has a buffer value of 1.
    depth[buffer == 1.0] = 0.0
    return depth
