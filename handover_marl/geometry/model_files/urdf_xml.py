"""Reader of the XML of URDF files, with the ranges of all numbers that a physics engine reads from it."""

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

from handover_marl.execution.reading import read_plain_file

#: Largest accepted size of a URDF file (bytes); the file of a human hand has 50 kB.
MAX_URDF_BYTES = 10_000_000
# Ranges of lengths, of any quantity, and of quantities that are not negative.
_LENGTH, _ANY, _POSITIVE = (1e-6, 1000.0), (-1e9, 1e9), (0.0, 1e9)
#: Ranges of the numbers in URDF files by attribute, or by tag and attribute: kg, kg m^2, m, rad, N, s. Files of
#: HandoverSim have masses up to 3.5, inertia 1 and joint limits of 1000; inverted limits mark joints without limits.
URDF_RANGES = {
    **{"size": _LENGTH, "radius": _LENGTH, "length": _LENGTH, "xyz": (-100.0, 100.0), "rpy": (-100.0, 100.0)},
    **dict.fromkeys(("ixx", "iyy", "izz"), (0.0, 1000.0)),
    **dict.fromkeys(("ixy", "ixz", "iyz", "scale"), (-1000.0, 1000.0)),
    **dict.fromkeys(("effort", "velocity", "damping", "friction", "value"), _POSITIVE),
    **{"lower": _ANY, "upper": _ANY, "rgba": (0.0, 1.0)},
    **{"mass value": (0.0, 1000.0), "restitution value": (0.0, 1.0)},
}
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")


def parse_urdf(urdf: Path) -> ET.Element:
    """Parse a URDF file, check its numbers, and return its root element.

    Raises `ValueError` for text that is not XML, and for numbers that are not finite or out of range (`URDF_RANGES`),
    such as a negative mass. Physics engines load such numbers without an error.
    """
    content = read_plain_file(urdf, MAX_URDF_BYTES)
    try:
        robot = ET.fromstring(content)
    except (ET.ParseError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(f"it is not XML: {error}") from error
    for element in robot.iter():
        for attribute, text in element.attrib.items():
            limits = URDF_RANGES.get(f"{element.tag} {attribute}", URDF_RANGES.get(attribute))
            if limits is not None:
                _check_numbers(f"{attribute} of <{element.tag}>", text, *limits)
    return robot


def _check_numbers(name: str, text: str, low: float, high: float) -> None:
    for word in text.split() or [""]:
        # Engines read numbers with an underscore or of other scripts otherwise than Python.
        value = float(word) if _NUMBER.fullmatch(word) else math.nan
        if not low <= value <= high or (value == 0.0 and name.startswith("scale")):
            raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {word[:40]!r}")


def read_attribute(element: ET.Element, tag: str, name: str, default: str | None = None) -> str:
    """Return attribute `name` of an XML element's child `tag`, or `default`; raise `ValueError` if both are missing."""
    found = element.find(tag)
    value = default if found is None else found.get(name, default)
    if value is None:
        raise ValueError(f"<{element.tag}> without <{tag} {name}=...>")
    return value
