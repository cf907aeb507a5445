"""The URDF of a hand: HandoverSim's 53 links, of which sixteen have a body."""

import math

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.importing.mano_model import PARENTS
from handover_marl.datasets.importing.urdf_text import (
    AXES,
    ZERO,
    Element,
    inertial,
    joint,
    link,
    number_text,
    robot_text,
    shape,
)

_PALM = 7  # number of the palm's link, at the end of three sliding and three turning joints
_PALM_MASS, _FINGER_MASS = 0.2, 0.02  # kg
_TRAVEL = 1000.0  # m; far beyond any trajectory
_LARGEST_ANGLES = (math.pi, math.pi / 2, math.pi)
# A lower limit above the upper one is none.
_UNLIMITED = (number_text(1.0), number_text(-1.0))


def hand_urdf(joints: npt.NDArray[np.float64]) -> str:
    """The text of `mano.urdf`.

    Args:
        joints: (16, 3) joints of the shaped hand at rest, m.
    """
    parts = [_bare(0)]
    for number in range(1, _PALM):
        parts += [_bare(number), _free_joint(number)]
    parts.append(_body(_PALM, 1, _PALM_MASS))
    parts.append(joint(_PALM, "fixed", axis=ZERO, limits=_UNLIMITED, at=number_text(*joints[0])))
    for finger_joint in range(1, len(joints)):
        parts += _finger_joint(finger_joint, joints)
    return robot_text('<?xml version="1.0" ?>', "mano", parts)


def _last_link(finger_joint: int) -> int:
    """The link with the body of a joint of the model; every one but the wrist has three links."""
    return _PALM + 3 * finger_joint


def _finger_joint(which: int, joints: npt.NDArray[np.float64]) -> list[Element]:
    """A joint that turns about three axes: three links, the last of which has the body."""
    parent = PARENTS[which]
    first = _last_link(which) - 2
    parts = []
    for turn, (axis, largest) in enumerate(zip(AXES, _LARGEST_ANGLES, strict=True)):
        number = first + turn
        parts.append(_body(number, which + 1, _FINGER_MASS) if turn == 2 else _bare(number))
        limits = number_text(-largest), number_text(largest)
        if turn == 0:
            at = number_text(*(joints[which] - joints[parent]))
            parts.append(joint(number, "revolute", axis=axis, limits=limits, parent=_last_link(parent), at=at))
        else:
            parts.append(joint(number, "revolute", axis=axis, limits=limits))
    return parts


def _free_joint(number: int) -> Element:
    axis = AXES[(number - 1) % 3]
    if number <= 3:
        return joint(number, "prismatic", axis=axis, limits=(number_text(-_TRAVEL), number_text(_TRAVEL)))
    return joint(number, "continuous", axis=axis, limits=_UNLIMITED)


def _bare(number: int) -> Element:
    return link(number, inertial(number_text(0.0)))


def _body(number: int, mesh: int, mass: float) -> Element:
    shapes = [shape(kind, {"filename": f"meshes/{kind}/mesh{mesh}.obj"}) for kind in ("visual", "collision")]
    return link(number, inertial(number_text(mass)), *shapes)
