"""Hand and objects that are added to a PyBullet simulation only while the Panda may touch them, and shapes of models.

Otherwise they follow their references kinematically. Row k is step k of the current reference
motion; row -1 is the state before its first step.
"""

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig, ObjectConfig
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import BoundingSphere, KinematicTree, read_tree
from handover_marl.geometry.model_files.urdf import UrdfShape, read_urdf_shapes
from handover_marl.geometry.poses import IDENTITY, compose, inverse_transform_points
from handover_marl.simulation.bullet.bodies import HAND_MASK, InitialState, ObjectBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf, pybullet_error
from handover_marl.simulation.reference_tracking import (
    BASE_JOINTS,
    HandTrajectory,
    ObjectTrajectory,
    ReferenceMotion,
    set_hand_references,
)

# Bullet tests two bodies for collision if either one's mask admits the other. The Panda's mask admits the hand; an
# empty mask keeps the overlapping bodies of the hand from colliding with each other.
_EMPTY_MASK = 0
# Joint displacement (m, rad) below which the bodies of the hand are not moved.
_REST_TOLERANCE = 1e-7


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


class Sleepable(Protocol):
    """Body that is added to the PyBullet simulation only when it is woken."""

    @property
    def is_awake(self) -> bool:
        """Whether the body is in the PyBullet simulation."""

    @property
    def reach(self) -> float:
        """Largest distance (m) of any point of the body from its reference point.

        The reference point is the one whose positions `predict_positions` returns.
        """

    def predict_positions(self, row: int) -> npt.NDArray[np.float64]:
        """Predict the world positions of the body's reference point after each step from `row` on.

        Returns:
            (n - row, 3) positions (m), for n steps of the current reference motion; inf while the
            body is absent.
        """

    def wake(self, row: int) -> None:
        """Add the body to the simulation before step `row` of the reference motion."""


class SleepableObject:
    """Scene object that is simulated while it is awake and follows its reference kinematically while it sleeps.

    Args:
        client: Physics client.
        urdf: Model file.
        mask: Collision group and mask before the release, see `compute_object_masks`.
        start: (6,) initial joint positions: xyz (m) and Euler angles (rad).
        config: Motors of the six joints.

    Attributes:
        urdf: Model file.
        tree: Kinematic tree of the model.
        body: Body in the simulation; None while the object sleeps.
        reach: Largest distance (m) of any point of the object from its origin.
    """

    def __init__(
        self, client: BulletClient, urdf: Path, mask: int, start: npt.NDArray[np.float32], config: ObjectConfig
    ) -> None:
        self.urdf = urdf
        self.body: ObjectBody | None = None
        self.tree = read_tree(urdf)
        self.reach = self.tree.compute_reach(len(self.tree.joints) - 1, read_bounding_spheres(urdf))
        self._client, self._mask, self._config = client, mask, config
        self._trajectory = ObjectTrajectory(config, start)
        self._targets: list[list[float]] = []

    @property
    def is_awake(self) -> bool:
        """Whether the object is in the PyBullet simulation."""
        return self.body is not None

    def set_reference(self, targets: npt.NDArray[np.float32]) -> None:
        """Set the object's joint targets (n, 6) of n coming steps: xyz (m), angles (rad)."""
        self._targets = targets.tolist()
        if self.body is None:
            self._trajectory.set_reference(targets)

    def predict_positions(self, row: int) -> npt.NDArray[np.float64]:
        """Predict the world positions of a sleeping object's origin after each step from `row` on.

        Returns:
            (n - row, 3) positions (m), for n steps of the current reference.
        """
        return self._trajectory.predict_positions(row)

    def wake(self, row: int) -> None:
        """Add the object to the simulation before step `row` of the reference motion."""
        if self.body is None:
            joints, velocities = self._trajectory.get_joints(row - 1), self._trajectory.compute_velocities(row - 1)
            start = InitialState(joints.tolist(), velocities.tolist())
            self.body = ObjectBody(self._client, self.urdf, self._mask, start, self._config)

    def set_motor_targets(self, row: int) -> None:
        """Set the motor targets of step `row` of the reference if the object is simulated."""
        if self.body is not None:
            self.body.set_motor_targets(self._targets[row])

    def read_joints(self, row: int) -> npt.NDArray[np.float32]:
        """Return the object's joints (6,) after step `row` of the reference, float32 (m, rad).

        Row -1 is the state before the first step.
        """
        if self.body is not None:
            return self.body.read_joint_positions()
        return self._trajectory.get_joints(row).astype(np.float32)

    def read_pose(self, row: int) -> npt.NDArray[np.float32]:
        """Return the object's world pose (7,) after step `row` of the reference, float32.

        The pose is xyz (m) and quaternion xyzw. Row -1 is the state before the first step.
        """
        if self.body is not None:
            return self.body.read_pose()
        poses = self.tree.compute_link_poses(self._trajectory.get_joints(row)[None], [len(self.tree.joints) - 1])
        pose: npt.NDArray[np.float32] = poses[0, 0].astype(np.float32)
        return pose

    def remove(self) -> None:
        """Remove the object from the PyBullet simulation."""
        if self.body is not None:
            self.body.remove()
            self.body = None


@dataclass(frozen=True, eq=False)
class HandCollisionModel:
    """Kinematic tree and collision shapes of a human hand, loaded into one PyBullet client.

    Attributes:
        urdf: Model file.
        tree: Kinematic tree of the model.
        shapes: Collision shapes of the model.
        shape_ids: PyBullet numbers of the collision shapes in the physics client.
        reach: Largest distance (m) of any point of the hand from the origin of its wrist joints.
    """

    urdf: Path
    tree: KinematicTree
    shapes: tuple[UrdfShape, ...]
    shape_ids: tuple[int, ...]
    reach: float


def load_hand_collision_model(client: BulletClient, urdf: Path) -> HandCollisionModel:
    """Load the collision shapes of a human hand's model into a physics client.

    Raises:
        SimulationError: The model or one of its shapes cannot be loaded.
    """
    spheres = read_bounding_spheres(urdf)
    tree = read_tree(urdf)
    shapes = tuple(read_urdf_shapes(urdf, tree, "collision"))
    ids = tuple(create_collision_shape(client, shape) for shape in shapes)
    return HandCollisionModel(urdf, tree, shapes, ids, tree.compute_reach(BASE_JOINTS - 1, spheres))


class KinematicHand(HandTrajectory):
    """Kinematic human hand of one scene.

    An awake hand has one static body in the PyBullet simulation for each collision shape.

    Args:
        client: Physics client.
        model: Model with its collision shapes.
        config: Motors of the simulated hand, which the kinematic hand reproduces.
        start: Reference motion of one row: the initial state of the hand.

    Attributes:
        model: Model with its collision shapes.
        bodies: PyBullet body numbers; empty while the hand sleeps or is absent.
        is_awake: Whether the hand is in the PyBullet simulation while it is present in the scene.
    """

    def __init__(
        self, client: BulletClient, model: HandCollisionModel, config: HandConfig, start: ReferenceMotion
    ) -> None:
        self.model = model
        self.bodies: list[int] = []
        self.is_awake = False
        self._client = client
        self._bodies_at: npt.NDArray[np.float64] | None = None
        self._shape_poses: npt.NDArray[np.float64] | None = None
        super().__init__(model.tree, config, start)

    @property
    def reach(self) -> float:
        """Largest distance (m) of any point of the hand from the origin of its wrist joints."""
        return self.model.reach

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Compute the hand's joint positions in all steps of a new reference motion."""
        set_hand_references([self], [motion])
        self._shape_poses = None

    def wake(self, row: int) -> None:
        """Add the hand to the simulation from step `row` of the reference motion on."""
        self.is_awake = True

    def move_bodies(self, row: int) -> None:
        """Move the hand's bodies to their poses after step `row`, before that step is simulated."""
        if not self.is_awake:
            return
        if not self._present[row + 1]:
            self.remove()
            return
        joints = self._joints[row + 1]
        if self._bodies_at is not None and np.abs(joints - self._bodies_at).max() < _REST_TOLERANCE:
            return
        self._bodies_at = joints
        if self._shape_poses is None:
            self._shape_poses = self._compute_shape_poses()
        poses = self._shape_poses[row + 1].tolist()
        if not self.bodies:
            self._create_bodies(poses)
            return
        for body, pose in zip(self.bodies, poses, strict=True):
            self._client.resetBasePositionAndOrientation(body, pose[:3], pose[3:])

    def remove(self) -> None:
        """Remove the hand's bodies from the PyBullet simulation."""
        for body in self.bodies:
            self._client.removeBody(body)
        self.bodies = []
        self._bodies_at = None

    def _compute_shape_poses(self) -> npt.NDArray[np.float64]:
        """Compute the world poses (n + 1, k, 7) of the hand's k collision shapes.

        The poses are those before the first and after each of n steps.
        """
        shapes = self.model.shapes
        links = self.model.tree.compute_link_poses(self._joints, [shape.link for shape in shapes])
        poses = [compose(links[:, number], shape.link_from_shape) for number, shape in enumerate(shapes)]
        return np.stack(poses, axis=1)

    def _create_bodies(self, poses: list[list[float]]) -> None:
        for shape_id, pose in zip(self.model.shape_ids, poses, strict=True):
            body = self._client.createMultiBody(
                baseMass=0.0,
                baseCollisionShapeIndex=shape_id,
                basePosition=pose[:3],
                baseOrientation=pose[3:],
                useMaximalCoordinates=1,
            )
            self._client.setCollisionFilterGroupMask(body, -1, HAND_MASK, _EMPTY_MASK)
            self.bodies.append(body)
