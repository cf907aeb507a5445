"""Intrinsic XYZ Euler angles, in which chains of three turning joints tell how a body is turned."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def continued(angles: Array, previous: Array) -> Array:
    """XYZ Euler angles (n, 3) of the same rotations, each row as near as can be to the one before.

    Args:
        angles: (n, 3) in rad.
        previous: (3,) the row before the first.
    """
    rows = np.empty(angles.shape)
    for number, (a, b, c) in enumerate(angles):
        twins = np.array([[a, b, c], [a + np.pi, np.pi - b, c + np.pi]])
        twins += 2.0 * np.pi * np.round((previous - twins) / (2.0 * np.pi))
        nearer = np.argmin(np.abs(twins - previous).sum(axis=1))
        previous = rows[number] = twins[nearer]
    return rows
