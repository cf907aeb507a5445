"""Grasps that the original leaves out for some objects, because they slip."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


def usable(object_name: str, grasps: Array) -> npt.NDArray[np.bool_]:
    """(n,) which of an object's grasps (n, 7), hand link in the object's frame, to use."""
    rule = _RULES.get(object_name)
    return np.ones(len(grasps), dtype=bool) if rule is None else rule(grasps[:, :3], _tilt(grasps))


def _tilt(grasps: Array) -> Array:
    """(n,) middle angle (rad) of the rotation about the object's fixed x, y and z axes, without sign."""
    angles: Array = np.abs(Rotation.from_quat(grasps[:, 3:]).as_euler("xyz")[:, 1])
    return angles


def _scissors(place: Array, tilt: Array) -> npt.NDArray[np.bool_]:
    x, y, z = np.abs(place).T
    kept: npt.NDArray[np.bool_] = (z > 0.09) & (y > 0.02) & (x < 0.05) & (tilt > 0.06)
    return kept


_RULES: dict[str, Callable[[Array, Array], npt.NDArray[np.bool_]]] = {
    "037_scissors": _scissors,
    "024_bowl": lambda place, tilt: tilt > np.radians(30.0),
    "025_mug": lambda place, tilt: tilt > np.radians(15.0),
}
