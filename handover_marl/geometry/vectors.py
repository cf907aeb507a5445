"""Vector products and lengths, equal to NumPy's to the bit and often faster, and distances of points to boxes."""

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.arrays import AnyArray, as_arrays, get_namespace, is_tensor, stack_last


def compute_dot_products(first: AnyArray, second: AnyArray) -> AnyArray:
    """Compute the dot products (...) of vectors (..., k); for NumPy arrays, each equals `np.dot` to the bit."""
    xp, first, second = as_arrays(first, second)
    if is_tensor(first):
        return xp.sum(first * second, axis=-1)
    return np.asarray(np.vecdot(first, second))


def compute_lengths(vectors: AnyArray) -> AnyArray:
    """Compute the lengths (...) of vectors (..., k); for NumPy arrays, each equals `np.linalg.norm` to the bit."""
    return get_namespace(vectors).sqrt(compute_dot_products(vectors, vectors))


def limit_lengths(vectors: AnyArray, length: float) -> AnyArray:
    """Return vectors (..., k), of which those longer than `length` are shortened to it."""
    return vectors * (length / compute_lengths(vectors).clip(length))[..., None]


def compute_cross_products(left: npt.ArrayLike, right: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Compute the cross products (..., 3) of vectors (..., 3), each equal to `np.cross` to the bit."""
    a, b = np.asarray(left), np.asarray(right)
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.asarray(stack_last([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]))


def compute_box_distances(points: AnyArray, half_size: AnyArray) -> AnyArray:
    """Compute signed distances (...) of points (..., 3) to boxes with half sizes (..., 3) around the origin."""
    xp = get_namespace(points)
    # One coordinate at a time, because NumPy reduces short axes slowly.
    x, y, z = (xp.abs(points[..., axis]) - half_size[..., axis] for axis in range(3))
    inside = xp.maximum(xp.maximum(x, y), z).clip(None, 0.0)
    x, y, z = (value.clip(0.0) for value in (x, y, z))
    return xp.sqrt(x * x + y * y + z * z) + inside
