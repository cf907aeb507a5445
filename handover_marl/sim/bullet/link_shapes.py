"""The shapes that a URDF gives its links, as PyBullet's shape functions take them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.models.poses import compose
from handover_marl.models.urdf_shapes import UrdfShape, read_urdf_shapes
from handover_marl.sim.bullet.client import BulletClient, pybullet_error


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
    return [
        LinkShape(shape.link, _options(client, shape), shape.link_from_shape, shape.color)
        for shape in read_urdf_shapes(urdf, tree, kind)
    ]


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


def _options(client: BulletClient, shape: UrdfShape) -> dict[str, Any]:
    if shape.kind == "mesh":
        return {"shapeType": client.GEOM_MESH, "fileName": str(shape.mesh), "meshScale": list(shape.size)}
    if shape.kind == "box":
        return {"shapeType": client.GEOM_BOX, "halfExtents": (np.array(shape.size) / 2.0).tolist()}
    return {"shapeType": client.GEOM_SPHERE, "radius": shape.size[0]}
