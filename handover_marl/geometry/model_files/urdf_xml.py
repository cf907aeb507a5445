"""Reader of the XML of URDF files."""

import xml.etree.ElementTree as ET
from pathlib import Path

from handover_marl.execution.reading import read_plain_file

#: Largest accepted size of a URDF file (bytes); that of a human hand has 50 kB.
MAX_URDF_BYTES = 10_000_000


def parse_urdf(urdf: Path) -> ET.Element:
    """Parse a URDF file and return its root element; raise `ValueError` for text that is not XML."""
    try:
        return ET.fromstring(read_plain_file(urdf, MAX_URDF_BYTES))
    except (ET.ParseError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(f"it is not XML: {error}") from error


def read_attribute(element: ET.Element, tag: str, name: str, default: str | None = None) -> str:
    """Return attribute `name` of an XML element's child `tag`, or `default`; raise `ValueError` if both are missing."""
    found = element.find(tag)
    value = default if found is None else found.get(name, default)
    if value is None:
        raise ValueError(f"<{element.tag}> without <{tag} {name}=...>")
    return value
