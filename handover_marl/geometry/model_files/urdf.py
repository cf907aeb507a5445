"""Reader of URDF models: shapes, masses, friction and joint limits of links."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.execution.reading import cached_by_file, read_mtime, read_plain_file, report_damage
from handover_marl.geometry.kinematic_tree import KinematicTree, matrix_from_rpy
from handover_marl.geometry.model_files.urdf_xml import MAX_URDF_BYTES, parse_urdf, read_attribute
from handover_marl.geometry.rotations import quaternions_from_matrices

Color = tuple[float, ...]

_WHITE = (1.0, 1.0, 1.0, 1.0)
_PACKAGE = "package://"
_MESH_NAME = re.compile(rb"""filename\s*=\s*["']([^"']+)["']""")


@dataclass(frozen=True)
class UrdfLink:
    """Inertial and contact properties of one link of a URDF model.

    Attributes:
        mass: Mass in kg.
        center: Center of mass (x, y, z) in the link's frame (m).
        friction: Coefficient of lateral friction; Bullet multiplies the values of two touching links.
        spinning_friction: Torsional friction: torque about the contact normal per newton of normal force (m).
        limits: Lower and upper limit of the joint between the link and its parent link (rad, m); None without limits.
    """

    mass: float = 0.0
    center: tuple[float, ...] = (0.0, 0.0, 0.0)
    friction: float = 0.5
    spinning_friction: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class UrdfShape:
    """Collision or visual shape of a link of a URDF model.

    Attributes:
        link: Number of the link, -1 for the base.
        kind: "mesh", "box" or "sphere".
        size: Scale of a mesh along its axes, side lengths of a box (m), or radius of a sphere (m).
        mesh: File of a mesh, else None.
        link_from_shape: (7,) pose of the shape in the link's frame, xyz (m) and quaternion xyzw.
        color: Red, green, blue and opacity, 0 to 1, of the URDF material; white without one.
    """

    link: int
    kind: str
    size: tuple[float, ...]
    mesh: Path | None
    link_from_shape: npt.NDArray[np.float64]
    color: Color


def read_urdf_links(urdf: Path, tree: KinematicTree) -> list[UrdfLink]:
    """Read the properties of all links of a URDF model, in the order of link numbers; the base link is last."""
    numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
    links = [UrdfLink()] * (len(numbers) + 1)
    try:
        robot = parse_urdf(urdf)
        limits = {read_attribute(joint, "child", "link"): _read_limits(joint) for joint in robot.findall("joint")}
        for element in robot.findall("link"):
            name = element.attrib["name"]
            links[numbers.get(name, -1)] = _read_link(element, limits.get(name))
    except (OSError, ValueError, KeyError) as error:
        raise SimulationError(f"{urdf}: cannot read its links ({error!r}); check the file") from error
    return links


def _read_link(element: ET.Element, limits: tuple[float, float] | None) -> UrdfLink:
    center = read_attribute(element, "inertial/origin", "xyz", "0 0 0")
    return UrdfLink(
        mass=float(read_attribute(element, "inertial/mass", "value", "0")),
        center=_parse_numbers(center, 3),
        friction=float(read_attribute(element, "contact/lateral_friction", "value", "0.5")),
        spinning_friction=float(read_attribute(element, "contact/spinning_friction", "value", "0")),
        limits=limits,
    )


def _read_limits(joint: ET.Element) -> tuple[float, float] | None:
    if joint.attrib["type"] not in ("revolute", "prismatic") or joint.find("limit") is None:
        return None
    lower, upper = (float(read_attribute(joint, "limit", name, "0")) for name in ("lower", "upper"))
    # The URDF files of human hands mark joints without limits by a lower limit above the upper one.
    return (lower, upper) if lower <= upper else None


def list_mesh_references(urdf: Path) -> list[tuple[str, Path]]:
    """List every mesh file of a URDF file, even of an invalid one: its name in the URDF file, and its path."""
    meshes: list[tuple[str, Path]] = []
    for match in _MESH_NAME.findall(read_plain_file(urdf, MAX_URDF_BYTES)):
        name = match.decode(errors="replace")
        meshes.append((name, urdf.parent / name.removeprefix(_PACKAGE)))
    return meshes


def read_model_mtimes(urdf: Path) -> tuple[int, ...]:
    """Return the modification times (ns) of a URDF file and its mesh files; 0 for missing meshes."""
    with report_damage(urdf, "model", "check the file"):
        return (urdf.stat().st_mtime_ns, *map(read_mtime, _list_meshes(urdf)))


@cached_by_file(maxsize=256)
def _list_meshes(urdf: Path) -> tuple[str, ...]:
    """Return the distinct mesh paths of a URDF file as strings, with which `read_mtime` is faster than with `Path`."""
    return tuple(dict.fromkeys(str(mesh) for _, mesh in list_mesh_references(urdf)))


@cached_by_file(maxsize=256)
def read_urdf_shapes(urdf: Path, tree: KinematicTree, purpose: str) -> tuple[UrdfShape, ...]:
    """Read all "collision" or all "visual" shapes of a URDF model; an unchanged file is read once."""
    try:
        robot = parse_urdf(urdf)
        numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
        # The last definition of a name counts, as in PyBullet, which reads those in links after those of the model.
        materials = [*robot.findall("material"), *robot.findall("link/visual/material")]
        named = ((material.get("name"), _read_color(material)) for material in materials)
        colors = {name: color for name, color in named if color is not None}
        return tuple(
            _read_shape(element, numbers.get(link.attrib["name"], -1), urdf.parent, colors)
            for link in robot.findall("link")
            for element in link.findall(purpose)
        )
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise SimulationError(f"{urdf}: cannot read its {purpose} shapes ({error!r}); check the file") from error


def _read_shape(element: ET.Element, link: int, folder: Path, colors: Mapping[str | None, Color]) -> UrdfShape:
    geometry, material = element.find("geometry"), element.find("material")
    if geometry is None:
        raise ValueError("no geometry")
    shape, mesh = geometry[0], None
    if shape.tag == "mesh":
        size, mesh = shape.get("scale", "1 1 1"), folder / shape.attrib["filename"].removeprefix(_PACKAGE)
    elif shape.tag == "box":
        size = shape.attrib["size"]
    elif shape.tag == "sphere":
        size = shape.attrib["radius"]
    else:
        raise ValueError(f"<{shape.tag}> is neither mesh nor box nor sphere")
    numbers = _parse_numbers(size, 1 if shape.tag == "sphere" else 3)
    xyz, rpy = (read_attribute(element, "origin", name, "0 0 0") for name in ("xyz", "rpy"))
    _parse_numbers(rpy, 3)
    pose = np.concatenate([_parse_numbers(xyz, 3), quaternions_from_matrices(matrix_from_rpy(rpy))])
    color = None if material is None else colors.get(material.get("name"))
    return UrdfShape(link, shape.tag, numbers, mesh, pose, color or _WHITE)


def _parse_numbers(text: str, count: int) -> tuple[float, ...]:
    values = tuple(map(float, text.split()))
    if len(values) != count:
        raise ValueError(f"expected {count} numbers, found {text!r}")
    return values


def _read_color(material: ET.Element) -> Color | None:
    color = material.find("color")
    return None if color is None else _parse_numbers(color.attrib["rgba"], 4)
