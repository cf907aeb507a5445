"""The shapes that a URDF gives its links, as PyBullet's shape functions take them."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.geometry import compose, poses_from_rotations
from handover_marl.kinematic_tree import KinematicTree, attribute, euler_matrix
from handover_marl.sim.client import BulletClient, pybullet_error

_WHITE = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class LinkShape:
    """One shape of a model.

    Attributes:
        link: Number of the link, -1 for the base.
        options: Arguments of `createCollisionShape` and `createVisualShape`.
        link_from_shape: (7,) its pose in the link's frame.
        color: Red, green, blue and opacity, 0 to 1.
    """

    link: int
    options: dict[str, Any]
    link_from_shape: npt.NDArray[np.float64]
    color: tuple[float, ...]

    def world_poses(self, world_from_link: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Poses (..., 7) of the shape for poses (..., 7) of its link."""
        return compose(world_from_link, self.link_from_shape)


def read_shapes(client: BulletClient, urdf: Path, tree: KinematicTree, kind: str) -> list[LinkShape]:
    """The shapes of a model.

    Args:
        client: Any physics server; only its constants are used.
        urdf: Model file.
        tree: Its links.
        kind: "collision" or "visual".

    Raises:
        SimulationError: A shape is of a kind that PyBullet cannot make by itself.
    """
    robot = ET.parse(urdf).getroot()
    numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
    colors = {material.get("name"): _color(material) for material in robot.findall("material")}
    shapes = []
    for link in robot.findall("link"):
        for element in link.findall(kind):
            try:
                options = _options(client, element, urdf.parent)
                pose = _origin(element)
            except (ValueError, KeyError, IndexError, TypeError) as error:
                raise SimulationError(
                    f"{urdf}: cannot read a {kind} shape of link {link.get('name')!r} ({error!r}); check the file"
                ) from error
            color = _shape_color(element.find("material"), colors)
            shapes.append(LinkShape(numbers.get(link.attrib["name"], -1), options, pose, color))
    return shapes


def collision_shape(client: BulletClient, shape: LinkShape) -> int:
    """Make a shape that bodies can share and return its number.

    Raises:
        SimulationError: PyBullet cannot make it.
    """
    return _make(client.createCollisionShape, shape, {})


def visual_shape(client: BulletClient, shape: LinkShape) -> int:
    """Make a shape to be drawn and return its number.

    Raises:
        SimulationError: PyBullet cannot make it.
    """
    return _make(client.createVisualShape, shape, {"rgbaColor": shape.color})


def _make(function: Any, shape: LinkShape, extra: dict[str, Any]) -> int:
    try:
        number = int(function(**shape.options, **extra))
    except pybullet_error as error:
        raise SimulationError(f"PyBullet cannot make the shape {shape.options} ({error})") from error
    if number < 0:
        raise SimulationError(f"PyBullet cannot make the shape {shape.options}; check its file")
    return number


def _options(client: BulletClient, element: ET.Element, folder: Path) -> dict[str, Any]:
    geometry = element.find("geometry")
    if geometry is None:
        raise ValueError("no geometry")
    shape = geometry[0]
    if shape.tag == "mesh":
        scale = [float(value) for value in shape.get("scale", "1 1 1").split()]
        return {
            "shapeType": client.GEOM_MESH,
            "fileName": str(folder / shape.attrib["filename"]),
            "meshScale": scale,
        }
    if shape.tag == "box":
        sides = np.array(shape.attrib["size"].split(), dtype=np.float64)
        return {"shapeType": client.GEOM_BOX, "halfExtents": (sides / 2.0).tolist()}
    if shape.tag == "sphere":
        return {"shapeType": client.GEOM_SPHERE, "radius": float(shape.attrib["radius"])}
    raise ValueError(f"<{shape.tag}> is neither mesh nor box nor sphere")


def _origin(element: ET.Element) -> npt.NDArray[np.float64]:
    xyz, rpy = (attribute(element, "origin", name, "0 0 0") for name in ("xyz", "rpy"))
    return poses_from_rotations(np.array(xyz.split(), dtype=np.float64), euler_matrix(rpy))


def _shape_color(
    material: ET.Element | None, named: dict[str | None, tuple[float, ...] | None]
) -> tuple[float, ...]:
    if material is None:
        return _WHITE
    return _color(material) or named.get(material.get("name")) or _WHITE


def _color(material: ET.Element) -> tuple[float, ...] | None:
    color = material.find("color")
    return None if color is None else tuple(float(value) for value in color.attrib["rgba"].split())
