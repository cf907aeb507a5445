"""Rotations, frames and resampling with the rounding of HandoverSim's conversion of DexYCB.

The float32 result of a matrix product depends on whether the BLAS library uses fused multiply-add instructions on the
processor. HandoverSim's files were made with them in some products and without them in others, so both kinds are
written out here. Some results also depend on the version of SciPy; the formulas of the version that made the official
files are written out too. Quaternions are xyzw; Euler angles are intrinsic XYZ, R = Rx(x) Ry(y) Rz(z), in rad.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import splev, splrep
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.geometry.rotations import unnormalized_quaternions_from_matrices

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Frames of 1 ms between two keyframes.
STRIDE = 40
#: Smallest number of keyframes for a cubic spline.
MIN_KEYFRAMES = 4
_KEYFRAME_PERIOD_S, _FRAME_PERIOD_S = 0.04, 0.001
_GIMBAL_LOCK_TOLERANCE = 1e-7  # rad from y = +-pi / 2
_MIN_COSINE = 4.0 * sys.float_info.epsilon


def fused_multiply_add(a: Float32, b: Float32, c: Float32) -> Float32:
    """Return `a * b + c` of float32 with a single rounding, like the processor's fused multiply-add instruction.

    The product of two float32 is exact in float64. Rounding the float64 sum to float32 would be wrong if the sum
    had been rounded to a value half-way between two float32. Therefore an inexact sum is rounded to odd: its last
    bit is set, which keeps it off the half-way points.
    """
    product = a.astype(np.float64) * b.astype(np.float64)
    addend = c.astype(np.float64)
    total = np.asarray(product + addend)
    # Exact rounding error of the sum (Knuth, TAOCP 2, 4.2.2).
    part = total - product
    rounding_error = (product - (total - part)) + (addend - part)
    even = (total.view(np.int64) & 1) == 0
    odd = np.where((rounding_error != 0.0) & even, np.nextafter(total, np.copysign(np.inf, rounding_error)), total)
    return odd.astype(np.float32)


def rotate_fused(matrix: Float32, columns: Float32) -> Float32:
    """Return the products (n, 3, k) of `matrix` (3, 3) and `columns` (n, 3, k), summed by fused multiply-add."""
    rows = [matrix[:, k, None] for k in range(3)]
    parts = [columns[:, None, k, :] for k in range(3)]
    return fused_multiply_add(rows[2], parts[2], fused_multiply_add(rows[1], parts[1], rows[0] * parts[0]))


def rotate_unfused(matrix: Float32, vector: Float32) -> Float32:
    """Return the product (3,) of `matrix` (3, 3) and `vector` (3,), rounded after every multiplication and addition."""
    products = matrix * vector
    total: Float32 = (products[:, 0] + products[:, 1]) + products[:, 2]
    return total


def compute_norms(vectors: Float32) -> Float32:
    """Return the float32 lengths (n,) of vectors (n, 3), rounded as by BLAS: float32 squares are summed in float64."""
    squares = (vectors * vectors).astype(np.float64)
    total = (squares[:, 0] + squares[:, 1]) + squares[:, 2]
    return np.asarray(np.sqrt(total.astype(np.float32)))


def matrices_from_rotation_vectors(vectors: Float32) -> Float64:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3) (rad) by Rodrigues' formula.

    As in HandoverSim, angle and axis are rounded differently. The angle is the float32 length from `compute_norms`. The
    axis is divided, in float64, by the float64 root of the float32 sum of squares.
    """
    angles = compute_norms(vectors).astype(np.float64)
    cosine, sine = _map_libm(math.cos, angles), _map_libm(math.sin, angles)
    x, y, z = vectors.T
    norm = np.sqrt(((x * x + y * y) + z * z).astype(np.float64))
    norm[norm == 0.0] = 1.0  # sine and 1 - cosine are zero
    x, y, z = (component.astype(np.float64) / norm for component in (x, y, z))
    rest = 1.0 - cosine
    xs, ys, zs = x * sine, y * sine, z * sine
    xc, yc, zc = x * rest, y * rest, z * rest
    xyc, yzc, zxc = x * yc, y * zc, z * xc
    entries = [
        *(x * xc + cosine, xyc - zs, zxc + ys),
        *(xyc + zs, y * yc + cosine, yzc - xs),
        *(zxc - ys, yzc + xs, z * zc + cosine),
    ]
    return np.stack(entries, axis=-1).reshape(-1, 3, 3)


def scipy_euler_from_rotations(rotations: Rotation) -> Float64:
    """Return intrinsic XYZ Euler angles (n, 3) in rad of n rotations as SciPy computed them up to version 1.10.

    x and z are in [-pi, pi], y in [-pi/2, pi/2]. At y = +-pi/2, which may be exceeded by 5e-8, z is zero. Later
    versions choose other signs where x or z is +-pi, which would shift a whole column of unwrapped angles by 2 pi.
    """
    m = rotations.as_matrix() + 0.0  # atan2 distinguishes -0.0 from 0.0
    tilt = _map_libm(math.acos, np.clip(m[:, 0, 2], -1.0, 1.0))  # y = pi / 2 - tilt
    up, down = np.abs(tilt) < _GIMBAL_LOCK_TOLERANCE, np.abs(tilt - np.pi) < _GIMBAL_LOCK_TOLERANCE
    safe = ~(up | down)
    x = _map_libm(math.atan2, m[:, 1, 2], -m[:, 2, 2])
    z = _map_libm(math.atan2, m[:, 0, 1], -m[:, 0, 0])
    x[up] = _map_libm(math.atan2, (m[:, 2, 1] + m[:, 1, 0])[up], (m[:, 1, 1] - m[:, 2, 0])[up])
    x[down] = _map_libm(math.atan2, (m[:, 2, 1] - m[:, 1, 0])[down], (m[:, 1, 1] + m[:, 2, 0])[down])
    z[~safe] = 0.0
    y = tilt + np.pi / 2
    # (x + pi, pi - y, z - pi) is the same rotation as (x, y, z).
    other = safe & (np.abs(y) > np.pi / 2)
    x[other] += np.pi
    y[other] = np.pi - y[other]
    z[other] -= np.pi
    angles = np.stack([x, y, z], axis=1)
    angles[angles < -np.pi] += 2.0 * np.pi
    angles[angles > np.pi] -= 2.0 * np.pi
    return angles


def transforms3d_euler_from_matrices(matrices: Float64) -> Float64:
    """Return intrinsic XYZ Euler angles (n, 3) in rad of rotation matrices (n, 3, 3) as transforms3d computes them.

    y is in [-pi/2, pi/2]; x is zero where y is +-pi/2.
    """
    m = matrices
    cosine = np.sqrt(m[:, 2, 2] * m[:, 2, 2] + m[:, 1, 2] * m[:, 1, 2])
    safe = cosine > _MIN_COSINE
    x = np.where(safe, -_map_libm(math.atan2, m[:, 1, 2], m[:, 2, 2]), 0.0)
    y = -_map_libm(math.atan2, -m[:, 0, 2], cosine)
    z = -_map_libm(math.atan2, np.where(safe, m[:, 0, 1], -m[:, 1, 0]), np.where(safe, m[:, 0, 0], m[:, 1, 1]))
    return np.stack([x, y, z], axis=1)


def _map_libm(function: Callable[..., float], *columns: Float64) -> Float64:
    # The C library's functions: NumPy's array functions differ in the last bit on some processors.
    return np.array(list(map(function, *(column.tolist() for column in columns))), dtype=np.float64)


class TagFrame:
    """Transform from DexYCB's world frame to the frame of the table's AprilTag, given the tag's [R | t] (3, 4) (m)."""

    def __init__(self, world_from_tag: npt.ArrayLike) -> None:
        pose = np.asarray(world_from_tag, dtype=np.float32)
        self._rotation = np.ascontiguousarray(pose[:, :3].T)
        # The only sum that was not fused: the vector was too short for the fused kernels.
        self._translation = rotate_unfused(self._rotation, -pose[:, 3])

    def transform_points(self, points: Float32) -> Float32:
        """Transform points (n, 3) in m from DexYCB's world frame to the tag's frame, float32."""
        rotated: Float32 = rotate_fused(self._rotation, points[:, :, None])[:, :, 0] + self._translation
        return rotated

    def transform_rotations(self, rotations: Rotation) -> Float32:
        """Transform n rotations from DexYCB's world frame to the tag's frame; return float32 quaternions xyzw (n, 4).

        As in HandoverSim, matrices are rounded to float32 before and after the product and not made orthogonal again.
        """
        matrices = rotate_fused(self._rotation, rotations.as_matrix().astype(np.float32))
        return quaternions_from_matrices(matrices).astype(np.float32)


def quaternions_from_matrices(matrices: npt.ArrayLike) -> Float64:
    """Return unit quaternions xyzw (n, 4) of nearly orthogonal matrices (n, 3, 3), as SciPy up to 1.11 computed them.

    The squared norm is summed from left to right, unlike in `geometry.rotations`, whose order of sums
    depends on the machine.
    """
    q = unnormalized_quaternions_from_matrices(matrices)
    x, y, z, w = (q[..., i] for i in range(4))
    norm = np.sqrt(((x * x + y * y) + z * z) + w * w)
    return np.asarray(q / norm[..., None])


def count_frames(n_keyframes: int) -> int:
    """Return the number of frames of 1 ms of a recording of `n_keyframes` keyframes."""
    return STRIDE * (n_keyframes - 1) + 1


@dataclass(frozen=True)
class KeyframeSpan:
    """Range of consecutive keyframes (25 Hz) of a recording.

    Attributes:
        first: Index of the first keyframe.
        last: Index of the last keyframe, included.
    """

    first: int
    last: int

    @property
    def frames(self) -> slice:
        """Slice of the 1 kHz frames from the first to the last keyframe of the range."""
        return slice(STRIDE * self.first, STRIDE * self.last + 1)

    def interpolate_positions(self, keyframes: Float32) -> Float32:
        """Return positions (T, 3) at 1 kHz over the range, by cubic splines through its n keyframe positions (n, 3)."""
        axes = [splev(self._times(), splrep(self._key_times(), column)) for column in keyframes.T]
        return np.stack(axes, axis=1).astype(np.float32)

    def interpolate_rotations(self, keyframes: Float32) -> Rotation:
        """Return T rotations at 1 kHz over the range, by slerp between its n keyframe quaternions xyzw (n, 4)."""
        rotations = Slerp(self._key_times(), Rotation.from_quat(keyframes))(self._times())
        return Rotation.from_quat(rotations.as_quat().astype(np.float32))

    # Times since the recording's start, not the span's: their differences round differently.
    def _key_times(self) -> Float64:
        return np.arange(self.first, self.last + 1, dtype=np.float64) * _KEYFRAME_PERIOD_S

    def _times(self) -> Float64:
        return np.arange(self.frames.start, self.frames.stop, dtype=np.float64) * _FRAME_PERIOD_S
