"""The parts of URDF files, as text whose every byte is settled.

`assets/building` writes URDFs too, but shorter ones, with other numbers and without the origins that say nothing; its
files are shipped and must not change, so it keeps a writer of its own.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

#: Axes of x, y and z, over and over.
AXES = ("1 0 0", "0 1 0", "0 0 1")
ZERO = "0 0 0"


@dataclass(frozen=True)
class Element:
    """An XML element without text.

    Attributes:
        tag: Its name.
        attributes: In the order in which they are written; values must need no escaping.
        children: The elements in it.
    """

    tag: str
    attributes: Mapping[str, str] = field(default_factory=dict)
    children: Sequence["Element"] = ()

    def lines(self, indent: str = "") -> list[str]:
        """The lines of its text, children two spaces further right."""
        opened = f"{indent}<{self.tag}" + "".join(f' {name}="{value}"' for name, value in self.attributes.items())
        if not self.children:
            return [f"{opened}/>"]
        inside = [line for child in self.children for line in child.lines(indent + "  ")]
        return [f"{opened}>", *inside, f"{indent}</{self.tag}>"]


def number_text(*numbers: float) -> str:
    """Numbers of one attribute: without decimals if all are whole, else each with 64, which tell it exactly."""
    pattern = "%.0f" if all(float(number).is_integer() for number in numbers) else "%.64f"
    return " ".join(pattern % float(number) for number in numbers)


def robot_text(header: str, name: str, parts: Iterable[Element]) -> str:
    """A whole file: the XML header as given, then the robot with its links and joints."""
    return "\n".join([header, *Element("robot", {"name": name}, tuple(parts)).lines(), ""])


def origin(xyz: str = ZERO) -> Element:
    """Where something lies in its link's frame; nothing is ever turned."""
    return Element("origin", {"xyz": xyz, "rpy": ZERO})


def inertial(mass: str, *, placed: bool = True) -> Element:
    """A mass with inertia 1 about every axis, or 0 for the mass "0"; with an origin if it is `placed`."""
    about = "0" if mass == "0" else "1"
    tensor = {"ixx": about, "ixy": "0", "ixz": "0", "iyy": about, "iyz": "0", "izz": about}
    parts = [Element("mass", {"value": mass}), Element("inertia", tensor)]
    return Element("inertial", {}, [origin(), *parts] if placed else parts)


def shape(kind: str, mesh: Mapping[str, str], *more: Element) -> Element:
    """A "visual" or "collision" mesh with the attributes given."""
    return Element(kind, {}, [origin(), Element("geometry", {}, [Element("mesh", mesh)]), *more])


def link(number: int, *parts: Element) -> Element:
    """The link of that number."""
    return Element("link", {"name": f"link{number}"}, parts)


def joint(
    number: int, kind: str, *, axis: str, limits: tuple[str, str] | None, parent: int | None = None, at: str = ZERO
) -> Element:
    """The joint of that number, which moves the link of the same number.

    Args:
        number: Number of joint and link.
        kind: "prismatic", "continuous", "revolute" or "fixed".
        axis: What it moves along or about.
        limits: Lower and upper end of its range, m or rad; None to leave them out.
        parent: Number of the link that it hangs on; default: the one before.
        at: Where on the parent it is, m.
    """
    parts = [
        origin(at),
        Element("parent", {"link": f"link{number - 1 if parent is None else parent}"}),
        Element("child", {"link": f"link{number}"}),
        Element("axis", {"xyz": axis}),
    ]
    if limits is not None:
        parts.append(Element("limit", {"lower": limits[0], "upper": limits[1]}))
    return Element("joint", {"name": f"joint{number}", "type": kind}, parts)
