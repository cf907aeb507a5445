"""What a URDF says of its links beside their shapes: masses, and how they feel to the touch."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import KinematicTree, attribute

# What Bullet takes where a file says nothing.
_FRICTION, _SPINNING_FRICTION = "0.5", "0"


@dataclass(frozen=True)
class UrdfLink:
    """One link.

    Attributes:
        mass: In kg.
        center: (x, y, z) of its centre of mass in its frame (m).
        friction: Lateral friction; Bullet multiplies those of the two that touch.
        spinning_friction: Torque about the normal for each newton of it (m).
        limits: Range (rad, m) of the joint that carries it, or None if it has none.
    """

    mass: float = 0.0
    center: tuple[float, ...] = (0.0, 0.0, 0.0)
    friction: float = float(_FRICTION)
    spinning_friction: float = 0.0
    limits: tuple[float, float] | None = None


def read_urdf_links(urdf: Path, tree: KinematicTree) -> list[UrdfLink]:
    """The links of a model, as numbered, and behind them the base's.

    Args:
        urdf: Model file.
        tree: Its links.

    Raises:
        SimulationError: A number cannot be read.
    """
    numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
    links = [UrdfLink()] * (len(numbers) + 1)
    try:
        robot = ET.parse(urdf).getroot()
        limits = {attribute(joint, "child", "link"): _limits(joint) for joint in robot.findall("joint")}
        for element in robot.findall("link"):
            name = element.attrib["name"]
            links[numbers.get(name, -1)] = _link(element, limits.get(name))
    except (OSError, ET.ParseError, ValueError, KeyError) as error:
        raise SimulationError(f"{urdf}: cannot read its links ({error!r}); check the file") from error
    return links


def _link(element: ET.Element, limits: tuple[float, float] | None) -> UrdfLink:
    inertial, contact = element.find("inertial"), element.find("contact")
    mass, center = "0", "0 0 0"
    if inertial is not None:
        mass, center = attribute(inertial, "mass", "value", "0"), attribute(inertial, "origin", "xyz", center)
    friction, spinning = _FRICTION, _SPINNING_FRICTION
    if contact is not None:
        friction = attribute(contact, "lateral_friction", "value", friction)
        spinning = attribute(contact, "spinning_friction", "value", spinning)
    place = tuple(float(value) for value in center.split())
    if len(place) != 3:
        raise ValueError(f"expected 3 numbers, found {center!r}")
    return UrdfLink(float(mass), place, float(friction), float(spinning), limits)


def _limits(joint: ET.Element) -> tuple[float, float] | None:
    if joint.attrib["type"] not in ("revolute", "prismatic") or joint.find("limit") is None:
        return None
    lower, upper = (float(attribute(joint, "limit", name, "0")) for name in ("lower", "upper"))
    # A range upside down is none, as in the hands' files.
    return (lower, upper) if lower <= upper else None
