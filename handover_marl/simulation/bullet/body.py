"""Articulated bodies in PyBullet: joints, motors, link poses and collision masks.

Poses are (7,) arrays of xyz (m) and quaternion xyzw.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import MotorConfig
from handover_marl.errors import SimulationError
from handover_marl.geometry.poses import IDENTITY, multiply_quaternions, transform_points
from handover_marl.simulation.bullet.client import BulletClient, load_urdf, to_float32_list

# Fields of PyBullet's joint info.
_JOINT_TYPE, _LINK_NAME = 2, 12
#: Fields of PyBullet's dynamics info: position and quaternion of a link's centre of mass in its URDF frame.
INERTIAL_POSE = slice(3, 5)


def reset_base(client: BulletClient, body_id: int, world_from_base: npt.ArrayLike) -> None:
    """Set the world pose (7,) of the URDF frame of a body's base link.

    Bullet sets base poses at the centre of mass.
    """
    pose = np.asarray(world_from_base, dtype=np.float64)
    offset = np.concatenate(client.getDynamicsInfo(body_id, -1)[INERTIAL_POSE])
    position, orientation = pose[:3], pose[3:]
    if not np.array_equal(offset, IDENTITY):
        position, orientation = transform_points(pose, offset[:3]), multiply_quaternions(orientation, offset[3:])
    client.resetBasePositionAndOrientation(body_id, position.tolist(), orientation.tolist())


@dataclass(frozen=True)
class ContactParameters:
    """Friction and restitution of a body's links, and damping of its base link.

    Attributes:
        friction: Lateral and spinning friction coefficient of every link.
        restitution: Coefficient of restitution of every link.
        base_damping: Linear and angular damping of the base link.
    """

    friction: float
    restitution: float
    base_damping: float


@dataclass(frozen=True)
class InitialState:
    """Joint state and base pose of a body after loading.

    Attributes:
        joints: Positions of the moving joints (m, rad).
        velocities: Velocities of the moving joints (m/s, rad/s); None means that the body is at rest.
        base: (7,) world pose of the base link.
    """

    joints: Sequence[float] = ()
    velocities: Sequence[float] | None = None
    base: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class ArticulatedBody:
    """PyBullet body from a URDF file, with a fixed base and a position motor in each moving joint.

    The order of loading is HandoverSim's: base pose, joint states, collision masks, contact
    parameters. A change of masks adds a body to the broad phase with its current bounding box;
    another order would shift the step at which colliding pairs are found, and with it all later
    states by 1e-7.

    Args:
        client: Physics client.
        urdf: Model file.
        motors: One motor per moving joint, in joint order.
        mask: Collision group and mask of all links.
        start: Joint state and base pose.
        contact: Friction, restitution and damping; None keeps the values of the model file.
        flags: Flags of PyBullet's `loadURDF`.

    Attributes:
        client: Physics client.
        id: PyBullet body number.
        n_links: Number of links without the base link.
        joints: PyBullet joint numbers of the moving joints.

    Raises:
        SimulationError: The model cannot be loaded, or does not have one moving joint for each
            motor.
    """

    def __init__(
        self,
        client: BulletClient,
        urdf: Path | str,
        motors: Sequence[MotorConfig],
        mask: int,
        start: InitialState,
        contact: ContactParameters | None = None,
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
        reset_base(client, self.id, start.base)
        self.reset_joints(start.joints, start.velocities)
        self.set_collision_mask(mask)
        if contact is not None:
            self._set_contact_parameters(contact)

    def get_link(self, name: str) -> int:
        """Return the number of a link by its URDF name; numbers differ between Panda files.

        Raises:
            SimulationError: The model has no such link.
        """
        if name not in self._link_names:
            links = ", ".join(self._link_names)
            raise SimulationError(f"{self._describe_model()} has no link {name!r} (its links: {links}); check its URDF")
        return self._link_names[name]

    def reset_joints(self, positions: Sequence[float], velocities: Sequence[float] | None = None) -> None:
        """Set positions (m, rad) and velocities (m/s, rad/s; default 0) of the moving joints."""
        speeds = [0.0] * len(self.joints) if velocities is None else velocities
        for joint, position, velocity in zip(self.joints, positions, speeds, strict=True):
            self.client.resetJointState(self.id, joint, position, velocity)

    def reset_joints_at_rest(self, positions: Sequence[float]) -> None:
        """Set positions (m, rad) of the moving joints, at rest, to measure distances.

        Later simulated states differ in the last bits from those after `reset_joints`.
        """
        self.client.resetJointStatesMultiDof(self.id, self.joints, [[position] for position in positions])

    def set_motor_targets(self, target: list[float]) -> None:
        """Set the target positions (m, rad) of the body's joint motors, if they have changed."""
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

    def disable_motors(self) -> None:
        """Set the force of the body's motors to zero; later targets have no effect."""
        self._forces = [0.0] * len(self.joints)
        if self._target is not None:
            target, self._target = self._target, None
            self.set_motor_targets(target)

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
        """Return the world poses (n, 7) of the URDF frames of n links by number, float32."""
        states = self.client.getLinkStates(self.id, links, computeForwardKinematics=1)
        return np.array([state[4] + state[5] for state in states], dtype=np.float32)

    def remove(self) -> None:
        """Remove the body from the simulation."""
        self.client.removeBody(self.id)

    def _set_contact_parameters(self, contact: ContactParameters) -> None:
        change, friction = self.client.changeDynamics, contact.friction
        for link in range(-1, self.n_links):
            change(self.id, link, lateralFriction=friction, spinningFriction=friction, restitution=contact.restitution)
        change(self.id, -1, linearDamping=contact.base_damping, angularDamping=contact.base_damping)

    def _describe_model(self) -> str:
        model = self.client.getBodyInfo(self.id)[1].decode(errors="replace")
        return f"the model {model!r} loaded as {type(self).__name__}"
