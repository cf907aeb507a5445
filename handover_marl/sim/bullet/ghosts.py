"""Bodies that are drawn and touch nothing, for what is not simulated."""

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.link_shapes import LinkShape, read_shapes, visual_shape


@dataclass(frozen=True, eq=False)
class _Ghost:
    shapes: list[LinkShape]
    bodies: list[int]


class Ghosts:
    """The ghosts in a physics server, by name."""

    def __init__(self, client: BulletClient) -> None:
        self._client = client
        self._ghosts: dict[Hashable, _Ghost] = {}

    def show(self, name: Hashable, urdf: Path, tree: KinematicTree, dof: npt.NDArray[np.floating]) -> None:
        """Draw a model with its joints at (d,) positions."""
        ghost = self._ghosts.get(name) or self._make(name, urdf, tree)
        poses = tree.poses(dof[None], [shape.link for shape in ghost.shapes])[0]
        for shape, body, pose in zip(ghost.shapes, ghost.bodies, poses, strict=True):
            world_from_shape = shape.world_poses(pose).tolist()
            self._client.resetBasePositionAndOrientation(body, world_from_shape[:3], world_from_shape[3:])

    def hide(self, name: Hashable) -> None:
        """Draw it no more."""
        ghost = self._ghosts.pop(name, None)
        for body in [] if ghost is None else ghost.bodies:
            self._client.removeBody(body)

    def clear(self) -> None:
        """Draw none."""
        for name in list(self._ghosts):
            self.hide(name)

    def _make(self, name: Hashable, urdf: Path, tree: KinematicTree) -> _Ghost:
        shapes = [shape for shape in read_shapes(self._client, urdf, tree, "visual") if shape.link >= 0]
        bodies = [
            self._client.createMultiBody(
                baseMass=0.0, baseVisualShapeIndex=visual_shape(self._client, shape), useMaximalCoordinates=1
            )
            for shape in shapes
        ]
        self._ghosts[name] = _Ghost(shapes, bodies)
        return self._ghosts[name]
