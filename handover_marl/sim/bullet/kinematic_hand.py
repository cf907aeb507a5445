"""A hand that follows its targets by kinematics and stands in Bullet only as far as the Panda could touch it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, HandConfig
from handover_marl.models.kinematic_tree import KinematicTree, read_tree
from handover_marl.sim.bullet.bounds import link_spheres
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.hand_body import BASE_JOINTS, HAND_MASK, hand_motors, keypoint_links
from handover_marl.sim.bullet.link_shapes import LinkShape, collision_shape, read_shapes
from handover_marl.sim.follower import Follower
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


class KinematicHand:
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
        self._motors = hand_motors(config)
        self._follower: Follower | None = None
        self._placed: npt.NDArray[np.float64] | None = None
        # A hand at rest is looked at often: its joints and keypoints when last seen.
        self._seen: tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]] | None = None
        # One row more than the motion has: the first is where it was before.
        self._path, self._present = np.zeros((1, HAND_DOF)), np.zeros(1, dtype=bool)
        self.lead(start)
        self._path, self._present = self._path[-1:], self._present[-1:]

    @property
    def reach(self) -> float:
        """How far it reaches from the origin of its base joints (m)."""
        return self.model.reach

    def lead(self, motion: Motion) -> None:
        """Work out where it will be in the coming steps."""
        present, path = motion.hand_present, np.zeros(motion.hand.shape)
        cuts = (np.flatnonzero(np.diff(present)) + 1).tolist()
        for first, last in zip([0, *cuts], [*cuts, len(motion)], strict=True):
            if not present[first]:
                self._follower = None
                continue
            if self._follower is None:
                # A hand that appears does so at its target.
                self._follower = Follower(self._motors, motion.hand[first])
            self._follower.follow(motion.hand[first:last])
            path[first:last] = self._follower.path
        self._path = np.concatenate([self._path[-1:], path])
        self._present = np.concatenate([self._present[-1:], present])
        self._poses: npt.NDArray[np.float64] | None = None

    def centers(self, row: int) -> npt.NDArray[np.float64]:
        """(n - row, 3) where its base will be after the steps from `row` on (m); inf where there is no hand."""
        return np.where(self._present[row + 1 :, None], self._path[row + 1 :, :3], np.inf)

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

    def present_after(self, row: int) -> bool:
        """Whether there is a hand after step `row`, -1 being before the first."""
        return bool(self._present[row + 1])

    def dof(self, row: int) -> npt.NDArray[np.float32]:
        """(51,) its joints after step `row`, -1 being before the first (m, rad)."""
        joints: npt.NDArray[np.float32] = self._path[row + 1].astype(np.float32)
        return joints

    def keypoints(self, row: int) -> npt.NDArray[np.float32]:
        """(16, 3) world positions (m) of the wrist and of the 15 finger-joint origins, as `Hand.keypoints`."""
        joints = self._path[row + 1]
        if self._seen is None or not np.array_equal(joints, self._seen[0]):
            moving = [link for link, joint in enumerate(self.model.tree.joints) if joint.kind != "fixed"]
            origins, _ = self.model.tree.frames(joints[None])
            self._seen = joints, origins[0, keypoint_links(moving)].astype(np.float32)
        keypoints: npt.NDArray[np.float32] = self._seen[1].copy()
        return keypoints

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
