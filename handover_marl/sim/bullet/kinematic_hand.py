"""A hand that follows its targets by kinematics and stands in Bullet only as far as the Panda could touch it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig
from handover_marl.models.kinematic_tree import KinematicTree, read_tree
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.hand_body import HAND_MASK
from handover_marl.sim.bullet.link_shapes import LinkShape, collision_shape, read_shapes
from handover_marl.sim.hand_path import BASE_JOINTS, HandPath
from handover_marl.sim.motion import Motion

# Bullet lets two bodies collide when either one's mask admits the other. The Panda's admits the hand; were the
# hand's own to do so too, its bodies, which overlap, would collide with each other.
_NONE_MASK = 0
# Links that move less than this (m, rad) stay where they are.
_STILL = 1e-7


@dataclass(frozen=True, eq=False)
class HandModel:
    """A hand's file as read into one physics server.

    Attributes:
        urdf: The file.
        tree: Its links.
        shapes: Its collision shapes.
        shape_ids: Their numbers in the physics server.
        reach: How far the hand reaches from the origin of its base joints (m).
    """

    urdf: Path
    tree: KinematicTree
    shapes: tuple[LinkShape, ...]
    shape_ids: tuple[int, ...]
    reach: float


def read_hand(client: BulletClient, urdf: Path) -> HandModel:
    """Read a hand's file.

    Raises:
        SimulationError: It cannot be loaded, or has shapes that cannot stand alone.
    """
    spheres = link_spheres(urdf)
    tree = read_tree(urdf)
    shapes = tuple(read_shapes(client, urdf, tree, "collision"))
    ids = tuple(collision_shape(client, shape) for shape in shapes)
    return HandModel(urdf, tree, shapes, ids, tree.reach(BASE_JOINTS - 1, spheres))


class KinematicHand(HandPath):
    """The hand of one scene.

    Args:
        client: The physics server.
        model: Its links and shapes.
        config: How the joints of the simulated hand are driven.

    Attributes:
        model: Its links and shapes.
        bodies: Its bodies in Bullet, a static one per shape; empty while it need not be there.
        awake: Whether it is in Bullet whenever there is a hand.
    """

    def __init__(self, client: BulletClient, model: HandModel, config: HandConfig, start: Motion) -> None:
        self.model = model
        self.bodies: list[int] = []
        self.awake = False
        self._client = client
        self._placed: npt.NDArray[np.float64] | None = None
        super().__init__(model.tree, config, start)

    @property
    def reach(self) -> float:
        """How far it reaches from the origin of its base joints (m)."""
        return self.model.reach

    def lead(self, motion: Motion) -> None:
        """Work out where it will be in the coming steps."""
        super().lead(motion)
        self._poses: npt.NDArray[np.float64] | None = None

    def wake(self, row: int) -> None:
        """Be in Bullet from step `row` on whenever there is a hand."""
        self.awake = True

    def move(self, row: int) -> None:
        """Put the bodies where the hand is after step `row`, before that step is simulated."""
        if not self.awake:
            return
        if not self._present[row + 1]:
            self.remove()
            return
        place = self._path[row + 1]
        if self._placed is not None and np.abs(place - self._placed).max() < _STILL:
            return
        self._placed = place
        poses = self._shape_poses()[row + 1].tolist()
        if not self.bodies:
            self._load(poses)
            return
        for body, pose in zip(self.bodies, poses, strict=True):
            self._client.resetBasePositionAndOrientation(body, pose[:3], pose[3:])

    def remove(self) -> None:
        """Take the bodies out of the world."""
        for body in self.bodies:
            self._client.removeBody(body)
        self.bodies = []
        self._placed = None

    def _shape_poses(self) -> npt.NDArray[np.float64]:
        if self._poses is None:
            model = self.model
            links = model.tree.poses(self._path, [shape.link for shape in model.shapes])
            self._poses = np.stack(
                [shape.world_poses(links[:, number]) for number, shape in enumerate(model.shapes)], axis=1
            )
        return self._poses

    def _load(self, poses: list[list[float]]) -> None:
        for shape_id, pose in zip(self.model.shape_ids, poses, strict=True):
            body = self._client.createMultiBody(
                baseMass=0.0,
                baseCollisionShapeIndex=shape_id,
                basePosition=pose[:3],
                baseOrientation=pose[3:],
                useMaximalCoordinates=1,
            )
            self._client.setCollisionFilterGroupMask(body, -1, HAND_MASK, _NONE_MASK)
            self.bodies.append(body)
