"""PyBullet shapes and bounding spheres of URDF links, and visual bodies without collisions."""

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import BoundingSphere, KinematicTree
from handover_marl.geometry.model_files.urdf import UrdfShape, read_urdf_shapes
from handover_marl.geometry.poses import IDENTITY, compose, inverse_transform_points
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf, pybullet_error


def read_bounding_spheres(urdf: Path) -> dict[int, BoundingSphere]:
    """Return a sphere around the collision shapes of each link by link number; -1 is the base link.

    Links without collision shapes are left out.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    return _read_bounding_spheres(urdf, urdf.stat().st_mtime_ns)


@functools.cache
def _read_bounding_spheres(urdf: Path, changed: int) -> dict[int, BoundingSphere]:
    # A separate physics client keeps the body numbers of the worlds independent of this cache.
    client = connect()
    body = load_urdf(client, urdf, useFixedBase=True)
    spheres = {}
    for link in range(-1, client.getNumJoints(body)):
        if not client.getCollisionShapeData(body, link):
            continue
        lower, upper = np.array(client.getAABB(body, link))
        pose = IDENTITY
        if link >= 0:
            state = client.getLinkState(body, link, computeForwardKinematics=1)
            pose = np.array([*state[4], *state[5]])
        center = inverse_transform_points(pose, (lower + upper) / 2.0)
        spheres[link] = BoundingSphere(center, float(np.linalg.norm(upper - lower)) / 2.0)
    client.close()
    return spheres


def create_collision_shape(client: BulletClient, shape: UrdfShape) -> int:
    """Create a PyBullet collision shape that several bodies can share, and return its number.

    Raises:
        SimulationError: PyBullet cannot create the shape.
    """
    return _create_shape(client, client.createCollisionShape, shape)


def create_visual_shape(client: BulletClient, shape: UrdfShape) -> int:
    """Create a PyBullet visual shape that several bodies can share, and return its number.

    Raises:
        SimulationError: PyBullet cannot create the shape.
    """
    return _create_shape(client, client.createVisualShape, shape, rgbaColor=shape.color)


def _create_shape(client: BulletClient, create: Callable[..., int], shape: UrdfShape, **extra: Any) -> int:
    options: dict[str, Any]
    if shape.kind == "mesh":
        options = {"shapeType": client.GEOM_MESH, "fileName": str(shape.mesh), "meshScale": list(shape.size)}
    elif shape.kind == "box":
        options = {"shapeType": client.GEOM_BOX, "halfExtents": (np.array(shape.size) / 2.0).tolist()}
    else:
        options = {"shapeType": client.GEOM_SPHERE, "radius": shape.size[0]}
    try:
        number = int(create(**options, **extra))
    except pybullet_error as error:
        raise SimulationError(f"PyBullet cannot create the shape {options} ({error}); check its file") from error
    if number < 0:
        raise SimulationError(f"PyBullet cannot create the shape {options}; check its file")
    return number


@dataclass(frozen=True, eq=False)
class _VisualModel:
    shapes: list[UrdfShape]
    bodies: list[int]


class VisualBodies:
    """Visual bodies without collisions, which show unsimulated models in PyBullet's window."""

    def __init__(self, client: BulletClient) -> None:
        self._client = client
        self._models: dict[Hashable, _VisualModel] = {}

    def show(self, name: Hashable, urdf: Path, tree: KinematicTree, dof: npt.NDArray[np.floating]) -> None:
        """Show a model in the window at joint positions, or move its visual body there.

        Args:
            name: Name of the visual body.
            urdf: Model file.
            tree: Kinematic tree of the model.
            dof: (d,) joint positions of the model (m, rad).
        """
        model = self._models.get(name) or self._create(name, urdf, tree)
        poses = tree.compute_link_poses(dof[None], [shape.link for shape in model.shapes])[0]
        for shape, body, pose in zip(model.shapes, model.bodies, poses, strict=True):
            world_from_shape = compose(pose, shape.link_from_shape).tolist()
            self._client.resetBasePositionAndOrientation(body, world_from_shape[:3], world_from_shape[3:])

    def hide(self, name: Hashable) -> None:
        """Remove the visual body with a name from the window, if there is one."""
        model = self._models.pop(name, None)
        for body in [] if model is None else model.bodies:
            self._client.removeBody(body)

    def clear(self) -> None:
        """Remove all visual bodies from the window."""
        for name in list(self._models):
            self.hide(name)

    def _create(self, name: Hashable, urdf: Path, tree: KinematicTree) -> _VisualModel:
        shapes = [shape for shape in read_urdf_shapes(urdf, tree, "visual") if shape.link >= 0]
        bodies = [
            self._client.createMultiBody(
                baseMass=0.0, baseVisualShapeIndex=create_visual_shape(self._client, shape), useMaximalCoordinates=1
            )
            for shape in shapes
        ]
        self._models[name] = _VisualModel(shapes, bodies)
        return self._models[name]
