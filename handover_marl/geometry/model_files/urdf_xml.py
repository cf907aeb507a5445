"""Reader of the XML of URDF files, with the ranges of all numbers that a physics engine reads from it."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

from handover_marl.execution.reading import read_plain_file

#: Largest accepted size of a URDF file (bytes); that of a human hand has 50 kB.
MAX_URDF_BYTES = 10_000_000
_HUGE = 1e9


class NumberRange(NamedTuple):
    """Range of the numbers of an attribute: all from `low` to `high`, and none nearer to 0 than `least`."""

    low: float
    high: float
    least: float = 0.0

    def __str__(self) -> str:
        least = f", at least {self.least:g} in magnitude" if self.least > max(self.low, 0.0) else ""
        return f"from {self.low:g} to {self.high:g}{least}"


_LENGTH = NumberRange(1e-6, 1000.0, 1e-6)
_FRICTION = NumberRange(0.0, 100.0)
_SHARE = NumberRange(0.0, 1.0)
_POSITIVE = NumberRange(0.0, _HUGE)
_FINITE = NumberRange(-_HUGE, _HUGE)
#: Ranges of the numbers in URDF files by tag and attribute: kg, kg m^2, m, rad, N, s. Files of HandoverSim have masses
#: up to 3.5, inertia 1 and joint limits of 1000, also inverted ones for joints without limits.
URDF_RANGES = {
    ("mass", "value"): NumberRange(0.0, 1000.0),
    **{("inertia", name): NumberRange(0.0, 1000.0) for name in ("ixx", "iyy", "izz")},
    **{("inertia", name): NumberRange(-1000.0, 1000.0) for name in ("ixy", "ixz", "iyz")},
    ("inertia_scaling", "value"): _FRICTION,
    ("mesh", "scale"): NumberRange(-1000.0, 1000.0, 1e-6),
    ("box", "size"): _LENGTH,
    **{(shape, "radius"): _LENGTH for shape in ("sphere", "cylinder", "capsule")},
    **{(shape, "length"): _LENGTH for shape in ("cylinder", "capsule")},
    ("origin", "xyz"): NumberRange(-100.0, 100.0),
    ("origin", "rpy"): NumberRange(-100.0, 100.0),
    ("axis", "xyz"): NumberRange(-1000.0, 1000.0),
    **{(f"{kind}_friction", "value"): _FRICTION for kind in ("lateral", "spinning", "rolling")},
    ("friction_anchor", "value"): _FRICTION,
    **{(name, "value"): _SHARE for name in ("restitution", "contact_erp", "contact_cfm")},
    **{(name, "value"): _POSITIVE for name in ("stiffness", "damping")},
    **{("limit", name): _FINITE for name in ("lower", "upper")},
    **{("limit", name): _POSITIVE for name in ("effort", "velocity")},
    **{("dynamics", name): _POSITIVE for name in ("damping", "friction")},
    ("color", "rgba"): _SHARE,
}
# Smallest mass (kg) of a link that moves and touches others.
_MIN_MASS = 1e-6


def parse_urdf(urdf: Path) -> ET.Element:
    """Parse a URDF file, check its numbers, and return its root element.

    Engines load numbers that are not finite or make no sense, such as a negative mass, without an error.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is not a plain file, is too large, or is not XML; or a number is out of `URDF_RANGES`, or
            a link that moves and has a collision shape has no mass.
    """
    content = read_plain_file(urdf, MAX_URDF_BYTES)
    try:
        robot = ET.fromstring(content)
    except (ET.ParseError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(f"it is not XML: {error}") from error
    for element in robot.iter():
        for attribute, text in element.attrib.items():
            limits = URDF_RANGES.get((element.tag, attribute))
            if limits is not None:
                _check_numbers(f"{attribute} of <{element.tag}>", text, limits)
    for joint in robot.findall("joint"):
        if joint.get("type") != "fixed":
            _check_mass(robot, read_attribute(joint, "child", "link"))
    return robot


def _check_numbers(name: str, text: str, limits: NumberRange) -> None:
    for word in text.split() or [""]:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        # Engines read numbers with an underscore or of other scripts otherwise than Python.
        is_plain = word.isascii() and "_" not in word
        if not (is_plain and limits.low <= value <= limits.high and abs(value) >= limits.least):
            raise ValueError(f"{name} must be a number {limits}, got {word[:40]!r}")


def _check_mass(robot: ET.Element, name: str) -> None:
    """Check that a link that moves and has a collision shape has a mass, if it states one."""
    for link in robot.findall("link"):
        mass = link.find("inertial/mass") if link.get("name") == name else None
        if mass is not None and link.find("collision") is not None and float(mass.get("value", "0")) < _MIN_MASS:
            raise ValueError(f"mass of link {name!r} must be at least {_MIN_MASS:g} kg, got {mass.get('value')}")


def read_attribute(element: ET.Element, tag: str, name: str, default: str | None = None) -> str:
    """Read an attribute of a child of an XML element, or return a default.

    Args:
        element: Parent element.
        tag: Tag of the child.
        name: Name of the attribute.
        default: Value of a missing child or attribute.

    Raises:
        ValueError: The attribute is missing and there is no default.
    """
    found = element.find(tag)
    value = default if found is None else found.get(name, default)
    if value is None:
        raise ValueError(f"<{element.tag}> without <{tag} {name}=...>")
    return value
