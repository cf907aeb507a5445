"""PyBullet bodies of a handover scene: human hand, objects, Panda robot, table and ground.

Poses are (7,) arrays of xyz (m) and quaternion xyzw.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import find_bullet_data
from handover_marl.config import PANDA_DOF, TIME_STEP, HandConfig, MotorConfig, ObjectConfig, PandaConfig, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import SimulationError
from handover_marl.geometry.panda import CAMERA_LINK, FINGER_LINKS, HAND_FROM_CAMERA_LINK, HAND_LINK
from handover_marl.geometry.poses import IDENTITY, compose, transform_points
from handover_marl.geometry.rotations import multiply_quaternions
from handover_marl.geometry.ycb import SCENE_CLASSES
from handover_marl.simulation.bullet.client import BulletClient, load_urdf, to_float32_list
from handover_marl.simulation.reference_tracking import list_hand_motors, list_object_motors, select_keypoint_links

# Fields of PyBullet's joint info.
_JOINT_TYPE, _LINK_NAME = 2, 12
#: Fields of PyBullet's dynamics info: position and quaternion of a link's center of mass in its URDF frame.
INERTIAL_POSE = slice(3, 5)
#: Collision masks: the Panda collides with everything, the hand with the Panda only, a released object with all but
#: the hand. Before its release, an object collides with the Panda only; see `compute_object_masks`.
TABLE_MASK = 1
HAND_MASK = 2**22
PANDA_MASK = -1
# Bits that neither table nor hand use; those of no YCB class come first. Bit 31 is the sign.
_OBJECT_BITS = (21, *range(23, 31), *range(1, 21))
RELEASED_MASK = -1 - HAND_MASK


def reset_base(client: BulletClient, body_id: int, world_from_base: npt.ArrayLike) -> None:
    """Set the world pose (7,) (quaternion xyzw) of the URDF frame of a body's base link.

    Bullet's own function sets the pose of the center of mass.
    """
    pose = np.asarray(world_from_base, dtype=np.float64)
    offset = np.concatenate(client.getDynamicsInfo(body_id, -1)[INERTIAL_POSE])
    position, orientation = pose[:3], pose[3:]
    if not np.array_equal(offset, IDENTITY):
        position, orientation = transform_points(pose, offset[:3]), multiply_quaternions(orientation, offset[3:])
    client.resetBasePositionAndOrientation(body_id, position.tolist(), orientation.tolist())


class ArticulatedBody:
    """PyBullet body from a URDF file, with a fixed base and a position motor in each moving joint.

    The order of loading is HandoverSim's: base pose, joint states, collision masks, contact parameters. A change of
    masks adds a body to the broad phase with its current bounding box; another order would shift the step at which
    colliding pairs are found, which changes all later states by 1e-7 (m, rad).

    Args:
        client: Physics client.
        urdf: Model file.
        motors: One motor per moving joint, in joint order.
        mask: Bullet's collision group and collision mask of all links.
        joints: Positions of the moving joints after loading (m, rad).
        velocities: Velocities of the moving joints (m/s, rad/s); None means that the body is at rest.
        base: (7,) world pose (quaternion xyzw) of the base link.
        flags: Flags of PyBullet's `loadURDF`.

    Attributes:
        id: PyBullet body number.
        n_links: Number of links without the base link.
        joints: PyBullet joint numbers of the moving joints.
    """

    def __init__(
        self,
        client: BulletClient,
        urdf: Path | str,
        motors: Sequence[MotorConfig],
        mask: int,
        joints: Sequence[float] = (),
        velocities: Sequence[float] | None = None,
        base: npt.ArrayLike = IDENTITY,
        flags: int = 0,
    ) -> None:
        self.client = client
        self.id = load_urdf(client, urdf, useFixedBase=True, flags=flags)
        infos = [client.getJointInfo(self.id, joint) for joint in range(client.getNumJoints(self.id))]
        self.n_links = len(infos)
        self.joints = [joint for joint, info in enumerate(infos) if info[_JOINT_TYPE] != client.JOINT_FIXED]
        if len(self.joints) != len(motors):
            raise SimulationError(
                f"{self._describe_model()} must have {len(motors)} moving joints, got {len(self.joints)}; "
                "check its URDF"
            )
        self._link_names = {info[_LINK_NAME].decode(): joint for joint, info in enumerate(infos)}
        self._position_gains = to_float32_list([motor.position_gain for motor in motors])
        self._velocity_gains = to_float32_list([motor.velocity_gain for motor in motors])
        self._forces = to_float32_list([motor.force for motor in motors])
        self._target: list[float] | None = None
        reset_base(client, self.id, base)
        self.reset_joints(joints, velocities)
        self.set_collision_mask(mask)

    def get_link(self, name: str) -> int:
        """Return the number of a link by its URDF name; raise `SimulationError` if the model has no such link."""
        if name not in self._link_names:
            links = ", ".join(self._link_names)
            raise SimulationError(f"{self._describe_model()} has no link {name!r} (its links: {links}); check its URDF")
        return self._link_names[name]

    def reset_joints(self, positions: Sequence[float], velocities: Sequence[float] | None = None) -> None:
        """Set positions (m, rad) and velocities (m/s, rad/s; default 0) of the moving joints."""
        speeds = [0.0] * len(self.joints) if velocities is None else velocities
        for joint, position, velocity in zip(self.joints, positions, speeds, strict=True):
            self.client.resetJointState(self.id, joint, position, velocity)

    def set_motor_targets(self, target: list[float]) -> None:
        """Set the target positions (m, rad) of the body's joint motors, unless they equal those of the last call."""
        if target == self._target:
            return
        self._target = target
        self.client.setJointMotorControlArray(
            self.id,
            self.joints,
            self.client.POSITION_CONTROL,
            target,
            positionGains=self._position_gains,
            velocityGains=self._velocity_gains,
            forces=self._forces,
        )

    def set_collision_mask(self, mask: int) -> None:
        """Set collision group and collision mask of the base and all links to `mask`."""
        for link in range(-1, self.n_links):
            self.client.setCollisionFilterGroupMask(self.id, link, mask, mask)

    def read_joint_positions(self) -> npt.NDArray[np.float32]:
        """Return the positions (m, rad) of the body's moving joints, float32."""
        return self.read_joint_states()[0]

    def read_joints_float64(self) -> npt.NDArray[np.float64]:
        """Return the positions (m, rad) of the body's moving joints in double precision."""
        return np.array([state[0] for state in self.client.getJointStates(self.id, self.joints)], dtype=np.float64)

    def read_joint_states(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return positions (m, rad) and velocities (m/s, rad/s) of the moving joints, float32."""
        states = self.client.getJointStates(self.id, self.joints)
        return (
            np.array([state[0] for state in states], dtype=np.float32),
            np.array([state[1] for state in states], dtype=np.float32),
        )

    def read_link_poses(self, links: Sequence[int]) -> npt.NDArray[np.float32]:
        """Return the world poses (n, 7), quaternions xyzw, of the URDF frames of n links by number, float32."""
        states = self.client.getLinkStates(self.id, links, computeForwardKinematics=1)
        return np.array([state[4] + state[5] for state in states], dtype=np.float32)

    def remove(self) -> None:
        """Remove the body from the simulation."""
        self.client.removeBody(self.id)

    def _describe_model(self) -> str:
        model = self.client.getBodyInfo(self.id)[1].decode(errors="replace")
        return f"the model {model!r} loaded as {type(self).__name__}"


class HandBody(ArticulatedBody):
    """Human hand in PyBullet: six joints move the whole hand, and 15 finger joints have three axes each.

    Args:
        client: Physics client.
        urdf: Model file.
        start: Initial positions of the 51 joints (m, rad).
        config: Motors and contact parameters of the hand.
    """

    def __init__(self, client: BulletClient, urdf: Path, start: list[float], config: HandConfig) -> None:
        super().__init__(client, urdf, list_hand_motors(config), HAND_MASK, start)
        change, friction = client.changeDynamics, config.friction
        for link in range(-1, self.n_links):
            change(self.id, link, lateralFriction=friction, spinningFriction=friction, restitution=config.restitution)
        change(self.id, -1, linearDamping=config.base_damping, angularDamping=config.base_damping)
        self._keypoint_links = select_keypoint_links(self.joints)

    def read_keypoints(self) -> npt.NDArray[np.float32]:
        """Return the world positions (16, 3) of the hand's wrist and 15 finger joints (m), float32.

        The order is MANO's: wrist, then index, middle, little, ring finger and thumb, three joints each from the
        knuckle outwards.
        """
        return self.read_link_poses(self._keypoint_links)[:, :3]


class ObjectBody(ArticulatedBody):
    """Scene object with three prismatic and three revolute joints, moved by motors until its release.

    Args:
        client: Physics client.
        urdf: Model file.
        mask: Collision group and mask before the release, from `compute_object_masks`.
        config: Motors of the six joints.
        joints: Initial positions of the six joints (m, rad).
        velocities: Initial velocities of the six joints (m/s, rad/s); None means that the object is at rest.
    """

    def __init__(
        self,
        client: BulletClient,
        urdf: Path,
        mask: int,
        config: ObjectConfig,
        joints: Sequence[float],
        velocities: Sequence[float] | None = None,
    ) -> None:
        super().__init__(client, urdf, list_object_motors(config), mask, joints, velocities)

    def read_pose(self) -> npt.NDArray[np.float32]:
        """Return the world pose (7,) of the object, xyz (m) and quaternion xyzw, float32."""
        pose: npt.NDArray[np.float32] = self.read_link_poses([self.n_links - 1])[0]
        return pose

    def release(self) -> None:
        """Disable the object's motors, and let it collide with everything but the human hand."""
        self.set_collision_mask(RELEASED_MASK)
        self._forces = [0.0] * len(self.joints)
        if self._target is not None:
            target, self._target = self._target, None
            self.set_motor_targets(target)


def compute_object_masks(class_ids: Sequence[int]) -> list[int]:
    """Return the collision masks of objects, given their class numbers: 2**bit, with another bit for each object.

    Until their release, the objects collide with the robot but not with each other. YCB classes of DexYCB have
    HandoverSim's bits, 1 to 20. Other class numbers, and further objects of the same class, get the next unused bits.
    """
    bits: list[int | None] = []
    for class_id in class_ids:
        bit = SCENE_CLASSES.index(class_id) + 1 if class_id in SCENE_CLASSES else None
        bits.append(None if bit in bits else bit)
    unused = iter([bit for bit in _OBJECT_BITS if bit not in bits])
    try:
        return [2 ** (next(unused) if bit is None else bit) for bit in bits]
    except StopIteration:
        raise SimulationError(f"a scene can have at most {len(_OBJECT_BITS)} objects, got {len(class_ids)}") from None


class PandaBody(ArticulatedBody):
    """Franka Panda robot in PyBullet, loaded at its initial joint positions.

    Args:
        client: Physics client.
        urdf: Model file.
        config: Base pose, initial joint positions and motors of the robot.

    Attributes:
        hand_link: Link number of the gripper's base (`panda_hand`), whose pose is the gripper pose.
        finger_links: Link numbers of the left and the right finger.
    """

    def __init__(self, client: BulletClient, urdf: Path, config: PandaConfig) -> None:
        self._start = to_float32_list(config.start_joints)
        base = to_float32_list([*config.base_position, *config.base_orientation])
        flags = client.URDF_USE_SELF_COLLISION
        super().__init__(client, urdf, [config.motor] * PANDA_DOF, PANDA_MASK, self._start, base=base, flags=flags)
        self.hand_link = self.get_link(HAND_LINK)
        self.finger_links = (self.get_link(FINGER_LINKS[0]), self.get_link(FINGER_LINKS[1]))
        self._camera_link = self.get_link(CAMERA_LINK) if CAMERA_LINK in self._link_names else None
        self._camera_rgba: tuple[float, ...] | None = None

    def read_camera_pose(self) -> npt.NDArray[np.float32]:
        """Return the world pose (7,) of the wrist camera's link, float32: xyz (m), quaternion xyzw.

        The pose is computed from the hand link if the model has no camera link.
        """
        if self._camera_link is not None:
            pose: npt.NDArray[np.float32] = self.read_link_poses([self._camera_link])[0]
            return pose
        return np.asarray(compose(self.read_link_poses([self.hand_link])[0], HAND_FROM_CAMERA_LINK).astype(np.float32))

    @contextmanager
    def hide_camera_link(self) -> Iterator[None]:
        """Hide the wrist camera's housing in images rendered inside this context."""
        if self._camera_link is None:
            yield
            return
        if self._camera_rgba is None:
            shapes = self.client.getVisualShapeData(self.id)
            self._camera_rgba = next(tuple(shape[7]) for shape in shapes if shape[1] == self._camera_link)
        self._set_camera_color((*self._camera_rgba[:3], 0.0))
        try:
            yield
        finally:
            self._set_camera_color(self._camera_rgba)

    def _set_camera_color(self, rgba: tuple[float, ...]) -> None:
        self.client.changeVisualShape(self.id, self._camera_link, rgbaColor=rgba)

    def park(self) -> None:
        """Put the robot at its initial joint positions without collisions, until `reset_robot` is called."""
        self.reset_joints(self._start)
        self.set_collision_mask(0)

    def reset_robot(self, joints: Sequence[float]) -> None:
        """Set the robot to nine joint positions (rad, m), at rest, with collisions and without cached contacts."""
        self._target = None
        self.reset_joints(to_float32_list(joints))
        # A change of masks removes all contact pairs with their cached impulses, which would otherwise change the last
        # bits of later states.
        self.set_collision_mask(PANDA_MASK)


@dataclass(frozen=True)
class Workcell:
    """Ground, table and Panda, which are the same in every scene.

    Attributes:
        table_id: PyBullet body number of the table.
        panda: Panda, loaded at its initial joint positions.
    """

    table_id: int
    panda: PandaBody


def load_workcell(client: BulletClient, assets: SceneAssets, config: PhysicsConfig) -> Workcell:
    """Clear a physics client and load ground, table and Panda, at the positions in `config`.

    Bullet is deterministic for equal sequences of calls only, so the order of loading is fixed.
    """
    client.resetSimulation()
    client.setGravity(0.0, 0.0, config.gravity)
    client.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP, numSubSteps=1, deterministicOverlappingPairs=1)
    client.loadURDF(str(find_bullet_data("this", "take physics='mujoco'") / "plane_implicit.urdf"))
    base = [*to_float32_list(config.table_position), 0.0, 0.0, 0.0, 1.0]
    table = ArticulatedBody(client, assets.table, (), TABLE_MASK, base=base)
    return Workcell(table.id, PandaBody(client, assets.panda, config.panda))
