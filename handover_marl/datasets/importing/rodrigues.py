"""Rotation vectors (axis times angle, rad) to matrices by Rodrigues' formula."""

import math

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.importing.float32_sums import length

Float64 = npt.NDArray[np.float64]


def matrices_from_vectors(vectors: npt.NDArray[np.float32]) -> Float64:
    """Rotation matrices (n, 3, 3), float64, of float32 rotation vectors (n, 3); the zero vector turns nothing.

    The original takes the angle and the axis from two sums of squares that round differently: the angle from BLAS,
    in float32, the axis from a plain float32 sum whose root and quotient are float64. Both are kept. Sine and cosine
    come from the C library one by one, because NumPy's own for arrays have other last bits on some processors.
    """
    angles = length(vectors).astype(np.float64).tolist()
    cosine = np.array([math.cos(angle) for angle in angles])
    sine = np.array([math.sin(angle) for angle in angles])
    x, y, z = _axes(vectors)
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


def _axes(vectors: npt.NDArray[np.float32]) -> tuple[Float64, Float64, Float64]:
    x, y, z = vectors.T
    norm = np.sqrt(((x * x + y * y) + z * z).astype(np.float64))
    norm[norm == 0.0] = 1.0  # the axis of no rotation; sine and 1 - cosine are zero
    return x.astype(np.float64) / norm, y.astype(np.float64) / norm, z.astype(np.float64) / norm
