"""Hand and objects that are added to a PyBullet simulation (woken) only when the Panda may soon touch them.

Before that, they sleep: they follow their references kinematically. Once woken, they stay awake until the next scene.
Row k is step k of the current reference motion; row -1 is the state before its first step.
"""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, HandConfig, ObjectConfig
from handover_marl.errors import SimulationError
from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.kinematic_tree import BoundingSphere, read_tree
from handover_marl.geometry.model_files.urdf import UrdfShape, read_model_mtimes, read_urdf_shapes
from handover_marl.geometry.poses import IDENTITY, compose, inverse_transform_points
from handover_marl.simulation.bullet.bodies import HAND_MASK, ObjectBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf, pybullet_error
from handover_marl.simulation.reference_tracking import (
    BASE_JOINTS,
    BodyTrajectory,
    list_hand_motors,
    list_object_motors,
    select_keypoint_links,
)

# Bullet tests two bodies for collision if either one's mask admits the other. The Panda's mask admits the hand; an
# empty mask keeps the overlapping bodies of the hand from colliding with each other.
_EMPTY_MASK = 0
# Joint displacement (m, rad) below which the bodies of the hand are not moved.
_REST_TOLERANCE = 1e-7


@cached_by_file(None, read_model_mtimes)
def read_bounding_spheres(urdf: Path) -> dict[int, BoundingSphere]:
    """Return bounding spheres, measured by PyBullet, of all links with collision shapes, by number; -1 is the base."""
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


class SleepableObject(BodyTrajectory):
    """Scene object that sleeps (follows its reference motion kinematically) until it is woken (simulated).

    Args:
        client: Physics client.
        urdf: Model file.
        mask: Collision group and mask before the release, from `compute_object_masks`.
        start: Initial joint positions (6,): xyz (m) and intrinsic XYZ Euler angles (rad).
        config: Motors of the six joints.

    Attributes:
        body: Body in the simulation; None while the object sleeps.
        reach: Upper bound (m) on the distance of any point of the object from its origin.
        targets: Six joint targets (m, rad) for each step of the current reference motion, set by the world.
    """

    def __init__(
        self, client: BulletClient, urdf: Path, mask: int, start: npt.NDArray[np.float32], config: ObjectConfig
    ) -> None:
        super().__init__(list_object_motors(config), start)
        self.body: ObjectBody | None = None
        self._tree = read_tree(urdf)
        self.reach = self._tree.compute_reach(len(self._tree.joints) - 1, read_bounding_spheres(urdf))
        self.targets: list[list[float]] = []
        self._client, self._urdf, self._mask, self._config = client, urdf, mask, config

    @property
    def is_awake(self) -> bool:
        """Whether the object is in the PyBullet simulation."""
        return self.body is not None

    def wake(self, row: int) -> None:
        """Add the object to the PyBullet simulation before step `row` of the reference motion, unless it is there."""
        if self.body is None:
            joints, before = self.get_joints(row - 1), self.get_joints(row - 2)
            velocities = ((joints - before) / TIME_STEP).tolist()
            self.body = ObjectBody(self._client, self._urdf, self._mask, self._config, joints.tolist(), velocities)

    def read_joints(self, row: int) -> npt.NDArray[np.float32]:
        """Return the object's current joint positions (6,), float32 (m, rad); `row` is the last simulated step."""
        if self.body is not None:
            return self.body.read_joint_positions()
        return self.get_joints(row).astype(np.float32)

    def read_pose(self, row: int) -> npt.NDArray[np.float32]:
        """Return the object's world pose (7,), float32: xyz (m), quaternion xyzw; `row` is the last simulated step."""
        if self.body is not None:
            return self.body.read_pose()
        poses = self._tree.compute_link_poses(self.get_joints(row)[None], [len(self._tree.joints) - 1])
        pose: npt.NDArray[np.float32] = poses[0, 0].astype(np.float32)
        # Of q and -q, Bullet returns the one with a positive w if the trace of the matrix is positive.
        if pose[6] < -0.5:
            pose[3:] *= -1.0
        return pose


def create_collision_shape(client: BulletClient, shape: UrdfShape) -> int:
    """Create a PyBullet collision shape that several bodies can share, and return its number."""
    options: dict[str, Any]
    if shape.kind == "mesh":
        options = {"shapeType": client.GEOM_MESH, "fileName": str(shape.mesh), "meshScale": list(shape.size)}
    elif shape.kind == "box":
        options = {"shapeType": client.GEOM_BOX, "halfExtents": (np.array(shape.size) / 2.0).tolist()}
    else:
        options = {"shapeType": client.GEOM_SPHERE, "radius": shape.size[0]}
    try:
        number = int(client.createCollisionShape(**options))
    except pybullet_error as error:
        raise SimulationError(f"PyBullet cannot create the shape {options} ({error}); check its file") from error
    if number < 0:
        raise SimulationError(f"PyBullet cannot create the shape {options}; check its file")
    return number


class KinematicHand(BodyTrajectory):
    """Human hand that follows its reference motion kinematically; its shapes are loaded once for many scenes.

    Once woken, the hand has one static body in the PyBullet simulation for each collision shape.

    Args:
        client: Physics client.
        urdf: Model file.
        config: Motors of the simulated hand, which the kinematic hand reproduces.

    Attributes:
        bodies: PyBullet body numbers; empty before the hand is woken and while it is absent.
        is_awake: Whether the hand has been woken: it is in the PyBullet simulation whenever it is in the scene.
        reach: Upper bound (m) on the distance of any point of the hand from the origin of its wrist joints.
    """

    def __init__(self, client: BulletClient, urdf: Path, config: HandConfig) -> None:
        self._client, self._tree = client, read_tree(urdf)
        self.reach = self._tree.compute_reach(BASE_JOINTS - 1, read_bounding_spheres(urdf))
        self._shapes = read_urdf_shapes(urdf, self._tree, "collision")
        self._shape_ids = [create_collision_shape(client, shape) for shape in self._shapes]
        self.bodies: list[int] = []
        self._bodies_at: npt.NDArray[np.float64] | None = None
        # Trajectory for which the poses (n + 2, k, 7) of the k collision shapes were computed.
        self._shape_poses: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None
        # Joints and keypoints of the last call, since observations often read a hand at rest.
        self._cached_keypoints: tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]] | None = None
        super().__init__(list_hand_motors(config), None)

    def reset(self, start: npt.NDArray[np.float32] | None) -> None:
        """Let the hand sleep at joints (51,) (m, rad) for the start of a scene; None if it is absent at first."""
        super().reset(start)
        self.remove()
        self.is_awake = False

    def wake(self, row: int) -> None:
        """Wake the hand: from now on, `move_bodies` puts its bodies into the simulation. `row` is not used."""
        self.is_awake = True

    def move_bodies(self, row: int) -> None:
        """Add, move or remove a woken hand's bodies for its state after step `row`; call it before that step."""
        if not self.is_awake:
            return
        if not self.is_present_after(row):
            self.remove()
            return
        joints = self.get_joints(row)
        if self._bodies_at is not None and np.abs(joints - self._bodies_at).max() < _REST_TOLERANCE:
            return
        self._bodies_at = joints
        if self._shape_poses is None or self._shape_poses[0] is not self.joints:
            links = self._tree.compute_link_poses(self.joints, [shape.link for shape in self._shapes])
            poses = [compose(links[:, number], shape.link_from_shape) for number, shape in enumerate(self._shapes)]
            self._shape_poses = self.joints, np.stack(poses, axis=1)
        coming = self._shape_poses[1][row + 2].tolist()
        if not self.bodies:
            self._create_bodies(coming)
            return
        for body, pose in zip(self.bodies, coming, strict=True):
            self._client.resetBasePositionAndOrientation(body, pose[:3], pose[3:])

    def remove(self) -> None:
        """Remove the hand's bodies from the PyBullet simulation."""
        for body in self.bodies:
            self._client.removeBody(body)
        self.bodies, self._bodies_at = [], None

    def compute_keypoints(self, row: int) -> npt.NDArray[np.float32]:
        """Return the world positions (16, 3) in m, float32, of wrist and finger joints after step `row`."""
        joints = self.get_joints(row)
        if self._cached_keypoints is None or not np.array_equal(joints, self._cached_keypoints[0]):
            origins, _ = self._tree.compute_link_frames(joints[None])
            links = select_keypoint_links(self._tree.moving_links)
            self._cached_keypoints = joints, origins[0, links].astype(np.float32)
        keypoints: npt.NDArray[np.float32] = self._cached_keypoints[1].copy()
        return keypoints

    def _create_bodies(self, poses: list[list[float]]) -> None:
        for shape_id, pose in zip(self._shape_ids, poses, strict=True):
            body = self._client.createMultiBody(
                baseMass=0.0,
                baseCollisionShapeIndex=shape_id,
                basePosition=pose[:3],
                baseOrientation=pose[3:],
                useMaximalCoordinates=1,
            )
            self._client.setCollisionFilterGroupMask(body, -1, HAND_MASK, _EMPTY_MASK)
            self.bodies.append(body)
