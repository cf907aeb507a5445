"""URDF texts of HandoverSim's hands and objects, equal to the official files byte by byte.

Three prismatic and three continuous joints move a body in the world. No link frame is rotated.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.dexycb.mano import PARENTS

_AXES = ("1 0 0", "0 1 0", "0 0 1")
_ZERO = "0 0 0"
_N_BASE_JOINTS = 6
_PALM_LINK, _OBJECT_LINK = 7, 6
_PALM_MASS, _FINGER_MASS, _OBJECT_MASS = 0.2, 0.02, "0.5"  # kg
_OBJECT_FRICTION = "0.9"
_MAX_TRAVEL = 1000.0  # m
_MAX_ANGLES = (math.pi, math.pi / 2, math.pi)
# URDF joints are unlimited if the lower limit exceeds the upper one.
_UNLIMITED = ("1", "-1")


def build_hand_urdf(joints: npt.NDArray[np.float64]) -> str:
    """Return the text of a hand's `mano.urdf`: 53 links, 16 of them with meshes.

    Args:
        joints: (16, 3) positions of MANO's joints of the hand at rest (m).
    """
    parts = [_make_link(0, _make_inertial("0"))]
    for number in range(1, _N_BASE_JOINTS + 1):
        parts += [_make_link(number, _make_inertial("0")), _make_base_joint(number, _UNLIMITED)]
    parts.append(_make_hand_link(_PALM_LINK, 1, _PALM_MASS))
    position = format_numbers(*joints[0])
    parts.append(_make_joint(_PALM_LINK, "fixed", axis=_ZERO, limits=_UNLIMITED, position=position))
    for finger_joint in range(1, len(joints)):
        parts += _make_finger_joint(finger_joint, joints)
    return format_robot('<?xml version="1.0" ?>', "mano", parts)


def build_object_urdf() -> str:
    """Return the text of `model_normalized.urdf`, which is the same for all YCB classes."""
    parts = [_make_link(0, _make_inertial("0", origin=False))]
    for number in range(1, _OBJECT_LINK):
        parts += [_make_link(number, _make_inertial("0", origin=False)), _make_base_joint(number, None)]
    parts += [_make_object_link(), _make_base_joint(_OBJECT_LINK, None)]
    return format_robot('<?xml version="1.0"?>', "model_normalized", parts)


def format_robot(header: str, name: str, parts: Iterable[ET.Element]) -> str:
    """Return the text of a URDF.

    Args:
        header: XML declaration.
        name: Name attribute of the URDF's `robot` element.
        parts: Elements of links and joints.
    """
    robot = _make_element("robot", {"name": name}, *parts)
    ET.indent(robot)
    # HandoverSim's writer puts no space before the end of an empty element.
    return f"{header}\n" + ET.tostring(robot, encoding="unicode").replace(" />", "/>") + "\n"


def format_numbers(*numbers: float) -> str:
    """Return the text of a URDF attribute: integers if all numbers are, else 64 decimals each."""
    pattern = "%.0f" if all(float(number).is_integer() for number in numbers) else "%.64f"
    return " ".join(pattern % float(number) for number in numbers)


def _make_element(tag: str, attributes: Mapping[str, str] | None = None, *children: ET.Element) -> ET.Element:
    element = ET.Element(tag, dict(attributes or {}))
    element.extend(children)
    return element


def _make_origin(xyz: str = _ZERO) -> ET.Element:
    return _make_element("origin", {"xyz": xyz, "rpy": _ZERO})


def _make_inertial(mass: str, *, origin: bool = True) -> ET.Element:
    """Return an inertial element with a moment of inertia of 1, or 0 if the mass is "0"."""
    moment = "0" if mass == "0" else "1"
    tensor = {"ixx": moment, "ixy": "0", "ixz": "0", "iyy": moment, "iyz": "0", "izz": moment}
    parts = [_make_element("mass", {"value": mass}), _make_element("inertia", tensor)]
    return _make_element("inertial", None, *([_make_origin()] if origin else []), *parts)


def _make_shape(kind: str, mesh: Mapping[str, str], *children: ET.Element) -> ET.Element:
    geometry = _make_element("geometry", None, _make_element("mesh", mesh))
    return _make_element(kind, None, _make_origin(), geometry, *children)


def _make_link(number: int, *parts: ET.Element) -> ET.Element:
    return _make_element("link", {"name": f"link{number}"}, *parts)


def _make_hand_link(number: int, mesh: int, mass: float) -> ET.Element:
    shapes = [_make_shape(kind, {"filename": f"meshes/{kind}/mesh{mesh}.obj"}) for kind in ("visual", "collision")]
    return _make_link(number, _make_inertial(format_numbers(mass)), *shapes)


def _make_object_link() -> ET.Element:
    white = _make_element("material", {"name": "white"}, _make_element("color", {"rgba": "1 1 1 1"}))
    return _make_link(
        _OBJECT_LINK,
        _make_element("contact", None, _make_element("lateral_friction", {"value": _OBJECT_FRICTION})),
        _make_inertial(_OBJECT_MASS),
        _make_shape("visual", {"filename": "textured_simple.obj", "scale": "1 1 1"}, white),
        _make_shape("collision", {"filename": "model_normalized_convex.obj", "scale": "1 1 1"}),
    )


def _make_joint(
    number: int,
    kind: str,
    *,
    axis: str,
    limits: tuple[str, str] | None,
    parent: int | None = None,
    position: str = _ZERO,
) -> ET.Element:
    """Return the joint that moves the link of the same number.

    Args:
        number: Number of the joint and of its child link.
        kind: "prismatic", "continuous", "revolute" or "fixed".
        axis: Axis of the joint.
        limits: Lower and upper limit (m or rad), or None to omit them.
        parent: Number of the parent link; default: the previous one.
        position: Position of the joint in the parent link (m).
    """
    parts = [
        _make_origin(position),
        _make_element("parent", {"link": f"link{number - 1 if parent is None else parent}"}),
        _make_element("child", {"link": f"link{number}"}),
        _make_element("axis", {"xyz": axis}),
    ]
    if limits is not None:
        parts.append(_make_element("limit", {"lower": limits[0], "upper": limits[1]}))
    return _make_element("joint", {"name": f"joint{number}", "type": kind}, *parts)


def _make_base_joint(number: int, continuous_limits: tuple[str, str] | None) -> ET.Element:
    axis = _AXES[(number - 1) % 3]
    if number <= 3:
        limits = (format_numbers(-_MAX_TRAVEL), format_numbers(_MAX_TRAVEL))
        return _make_joint(number, "prismatic", axis=axis, limits=limits)
    return _make_joint(number, "continuous", axis=axis, limits=continuous_limits)


def _find_last_link(finger_joint: int) -> int:
    """Return the link with the meshes of a joint of MANO; finger joints have three links each."""
    return _PALM_LINK + 3 * finger_joint


def _make_finger_joint(finger_joint: int, joints: npt.NDArray[np.float64]) -> list[ET.Element]:
    """Return the three links and revolute joints of a joint of MANO; the last link has the meshes."""
    parent = PARENTS[finger_joint]
    parts = []
    for turn, (axis, max_angle) in enumerate(zip(_AXES, _MAX_ANGLES, strict=True)):
        number = _find_last_link(finger_joint) - 2 + turn
        is_body = turn == 2
        parts.append(
            _make_hand_link(number, finger_joint + 1, _FINGER_MASS)
            if is_body
            else _make_link(number, _make_inertial("0"))
        )
        limits = format_numbers(-max_angle), format_numbers(max_angle)
        if turn == 0:
            position, parent_link = format_numbers(*(joints[finger_joint] - joints[parent])), _find_last_link(parent)
        else:
            position, parent_link = _ZERO, number - 1
        parts.append(_make_joint(number, "revolute", axis=axis, limits=limits, parent=parent_link, position=position))
    return parts
