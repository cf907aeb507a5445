"""Text of the URDF files of human hands."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from handover_marl.assets.hand_model import DIGIT_ORDER, HandGeometry
from handover_marl.assets.object_models import TEMPLATES_PACKAGE
from handover_marl.geometry.model_files.urdf import render_urdf

#: Names of the links with meshes: palm, then phalanges.
MESH_NAMES: Final = ("palm", *(f"{digit}{joint}" for digit in DIGIT_ORDER for joint in (1, 2, 3)))

_PALM_MASS, _PHALANX_MASS = 0.2, 0.02
_FINGER_LIMITS = (np.pi, np.pi / 2, np.pi)


def format_hand_urdf(model: HandGeometry, name: str, color: tuple[float, float, float], folder: str) -> str:
    """Return the URDF of a hand with HandoverSim's 53 links.

    Args:
        model: Geometry of the hand.
        name: Name of the model.
        color: Red, green and blue of the skin, 0 to 1.
        folder: Folder of the meshes of the hand's side, absolute or relative to the file.
    """
    return render_urdf(
        TEMPLATES_PACKAGE,
        "hand.urdf",
        name=name,
        color=format_numbers((*color, 1.0)),
        scale=format_numbers(model.scale),
        folder=folder,
        meshes=MESH_NAMES,
        positions=[format_numbers(position) for position in (model.palm_offset, *model.joint_origins)],
        masses=(_PALM_MASS, _PHALANX_MASS),
        limits=_FINGER_LIMITS,
    )


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers with up to 6 decimals, separated by spaces."""
    return " ".join(_format_number(value) for value in values)


def _format_number(value: float) -> str:
    text = f"{round(float(value), 6) + 0.0:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
