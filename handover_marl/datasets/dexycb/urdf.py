"""URDF texts of HandoverSim's hands and objects, equal to the official files byte by byte.

Three prismatic and three continuous joints move a body in the world. No link frame is rotated. The
texts are in `templates/`.
"""

import math

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.dexycb.mano import PARENTS
from handover_marl.geometry.model_files.urdf import render_urdf

_PALM_MASS, _FINGER_MASS = 0.2, 0.02  # kg
_MAX_ANGLES = (math.pi, math.pi / 2, math.pi)


def build_hand_urdf(joints: npt.NDArray[np.float64]) -> str:
    """Return the text of a hand's `mano.urdf`: 53 links, 16 of them with meshes.

    Args:
        joints: (16, 3) positions of MANO's joints of the hand at rest (m).
    """
    positions = [joints[0], *(joints[joint] - joints[PARENTS[joint]] for joint in range(1, len(joints)))]
    return render_urdf(
        __package__,
        "hand.urdf",
        positions=[format_numbers(*position) for position in positions],
        parents=PARENTS,
        palm_mass=format_numbers(_PALM_MASS),
        finger_mass=format_numbers(_FINGER_MASS),
        limits=[(format_numbers(-angle), format_numbers(angle)) for angle in _MAX_ANGLES],
    )


def build_object_urdf() -> str:
    """Return the text of `model_normalized.urdf`, which is the same for all YCB classes."""
    return render_urdf(__package__, "object.urdf")


def format_numbers(*numbers: float) -> str:
    """Return numbers as the text of a URDF attribute.

    They are written as integers if all of them are integers, otherwise with 64 decimals each.
    """
    pattern = "%.0f" if all(float(number).is_integer() for number in numbers) else "%.64f"
    return " ".join(pattern % float(number) for number in numbers)
