"""The shapes that a URDF gives its links, as the file says it."""

import functools
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import KinematicTree, attribute, euler_matrix
from handover_marl.models.poses import poses_from_rotations

Color = tuple[float, ...]

_WHITE = (1.0, 1.0, 1.0, 1.0)
_HERE = "package://"
_MESH_NAME = re.compile(rb"""filename\s*=\s*["']([^"']+)["']""")


@dataclass(frozen=True, eq=False)
class UrdfShape:
    """One shape of a model.

    Attributes:
        link: Number of the link, -1 for the base.
        kind: "mesh", "box" or "sphere".
        size: Scale of a mesh along its axes, sides of a box (m), or radius of a sphere (m).
        mesh: File of a mesh.
        link_from_shape: (7,) its pose in the link's frame.
        color: Red, green, blue and opacity, 0 to 1.
    """

    link: int
    kind: str
    size: tuple[float, ...]
    mesh: Path | None
    link_from_shape: npt.NDArray[np.float64]
    color: Color


def named_meshes(urdf: Path) -> list[tuple[str, Path]]:
    """The mesh files that a model names, as it names them and where they are, whatever else is in it.

    Raises:
        OSError: The model cannot be read.
    """
    names = [name.decode(errors="replace") for name in _MESH_NAME.findall(urdf.read_bytes())]
    return [(name, urdf.parent / name.removeprefix(_HERE)) for name in names]


def read_urdf_shapes(urdf: Path, tree: KinematicTree, purpose: str) -> list[UrdfShape]:
    """The shapes of a model.

    Args:
        urdf: Model file.
        tree: Its links.
        purpose: "collision" or "visual".

    Raises:
        SimulationError: A shape is none of the kinds above, or lacks something.
    """
    # A scene's models are wanted again and again.
    return list(_read(urdf, urdf.stat().st_mtime_ns if urdf.exists() else 0, tree, purpose))


@functools.lru_cache(maxsize=256)
def _read(urdf: Path, changed: int, tree: KinematicTree, purpose: str) -> tuple[UrdfShape, ...]:
    robot = ET.parse(urdf).getroot()
    numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
    colors = _named_colors(urdf, robot)
    shapes = []
    for link in robot.findall("link"):
        for element in link.findall(purpose):
            try:
                color = _shape_color(element.find("material"), colors)
                shapes.append(_shape(element, numbers.get(link.attrib["name"], -1), urdf.parent, color))
            except (ValueError, KeyError, IndexError, TypeError) as error:
                raise SimulationError(
                    f"{urdf}: cannot read a {purpose} shape of link {link.get('name')!r} ({error!r}); check the file"
                ) from error
    return tuple(shapes)


def _named_colors(urdf: Path, robot: ET.Element) -> dict[str | None, Color | None]:
    try:
        return {material.get("name"): _color(material) for material in robot.findall("material")}
    except (ValueError, KeyError) as error:
        raise SimulationError(f"{urdf}: cannot read a material's colour ({error!r}); check the file") from error


def _shape(element: ET.Element, link: int, folder: Path, color: Color) -> UrdfShape:
    geometry = element.find("geometry")
    if geometry is None:
        raise ValueError("no geometry")
    shape, mesh = geometry[0], None
    if shape.tag == "mesh":
        size, mesh = shape.get("scale", "1 1 1"), folder / shape.attrib["filename"].removeprefix(_HERE)
    elif shape.tag == "box":
        size = shape.attrib["size"]
    elif shape.tag == "sphere":
        size = shape.attrib["radius"]
    else:
        raise ValueError(f"<{shape.tag}> is neither mesh nor box nor sphere")
    numbers = _numbers(size, 1 if shape.tag == "sphere" else 3)
    return UrdfShape(link, shape.tag, numbers, mesh, _origin(element), color)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in text.split())
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise ValueError(f"expected {count} finite numbers, found {text!r}")
    return values


def _origin(element: ET.Element) -> npt.NDArray[np.float64]:
    xyz, rpy = (attribute(element, "origin", name, "0 0 0") for name in ("xyz", "rpy"))
    _numbers(rpy, 3)
    return poses_from_rotations(np.array(_numbers(xyz, 3)), euler_matrix(rpy))


def _shape_color(material: ET.Element | None, named: dict[str | None, Color | None]) -> Color:
    if material is None:
        return _WHITE
    return _color(material) or named.get(material.get("name")) or _WHITE


def _color(material: ET.Element) -> Color | None:
    color = material.find("color")
    return None if color is None else _numbers(color.attrib["rgba"], 4)
