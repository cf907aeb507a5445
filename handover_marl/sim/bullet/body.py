"""A jointed body in the simulation: its degrees of freedom, motors and collision masks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import MotorConfig
from handover_marl.errors import SimulationError
from handover_marl.models.poses import IDENTITY, compose
from handover_marl.sim.bullet.client import BulletClient, float32_list, load_urdf

_JOINT_TYPE, _LINK_NAME = 2, 12


def inertial_offset(client: BulletClient, body_id: int, link: int) -> npt.NDArray[np.float64]:
    """Pose (7) of a link's centre of mass in the link's URDF frame, xyz (m) and quaternion xyzw; -1 is the base.

    Bullet places bases and reports link states by centres of mass; models and tasks speak of link frames.
    """
    info = client.getDynamicsInfo(body_id, link)
    return np.array([*info[3], *info[4]])


def place_base(client: BulletClient, body_id: int, world_from_base: npt.ArrayLike) -> None:
    """Put the base link's frame at a world pose (7,), xyz (m) and quaternion xyzw."""
    pose = np.asarray(world_from_base, dtype=np.float64)
    offset = inertial_offset(client, body_id, -1)
    if not np.array_equal(offset, IDENTITY):
        pose = compose(pose, offset)
    client.resetBasePositionAndOrientation(body_id, pose[:3].tolist(), pose[3:].tolist())


@dataclass(frozen=True)
class Surface:
    """How a body's links feel to the touch, and how its base is damped.

    Attributes:
        friction: Lateral and spinning friction of every link.
        restitution: Of every link.
        base_damping: Linear and angular damping of the base.
    """

    friction: float
    restitution: float
    base_damping: float


@dataclass(frozen=True)
class Start:
    """Where a body is put when it is loaded.

    Attributes:
        joints: Positions of the moving joints (m, rad).
        velocities: Their velocities (m/s, rad/s); zero by default.
        base: (7,) world pose of the base link, xyz (m) and quaternion xyzw.
    """

    joints: Sequence[float] = ()
    velocities: Sequence[float] | None = None
    base: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Body:
    """A URDF whose base is fixed and whose moving joints are driven to positions.

    Loading goes in the reference's order: without a pose, base pose, joint states, masks, surface. Masks take a
    body into the broad phase anew where it stands; set earlier, other bounding boxes stay behind, pairs are found
    a step earlier or later, and everything departs by 1e-7 without having touched.

    Args:
        client: The physics server to load it into.
        urdf: Model file.
        motors: One entry per moving joint, in joint order.
        mask: Collision group and mask of all links.
        start: Where it is put.
        surface: Friction and damping; None leaves the model's own.
        flags: PyBullet's flags for loading.

    Raises:
        SimulationError: The model cannot be loaded, or has another number of moving joints than there are motors.
    """

    def __init__(
        self,
        client: BulletClient,
        urdf: Path | str,
        motors: Sequence[MotorConfig],
        mask: int,
        start: Start,
        surface: Surface | None = None,
        flags: int = 0,
    ) -> None:
        self.client = client
        self.id = load_urdf(client, urdf, useFixedBase=True, flags=flags)
        infos = [client.getJointInfo(self.id, joint) for joint in range(client.getNumJoints(self.id))]
        self.n_links = len(infos)
        self.joints = [joint for joint, info in enumerate(infos) if info[_JOINT_TYPE] != client.JOINT_FIXED]
        if len(self.joints) != len(motors):
            raise SimulationError(
                f"{self._described()} has {len(self.joints)} moving joints, expected {len(motors)}; check its URDF"
            )
        self._link_names = {info[_LINK_NAME].decode(): joint for joint, info in enumerate(infos)}
        self._position_gains = float32_list([motor.position_gain for motor in motors])
        self._velocity_gains = float32_list([motor.velocity_gain for motor in motors])
        self._forces = float32_list([motor.force for motor in motors])
        self._target: list[float] | None = None
        self._drive = client.setJointMotorControlArray
        place_base(client, self.id, start.base)
        self.place(start.joints, start.velocities)
        self.collide(mask)
        if surface is not None:
            self._cover(surface)

    def link(self, name: str) -> int:
        """PyBullet's number of a link by its URDF name (numbers differ between Panda files).

        Raises:
            SimulationError: The model has no such link.
        """
        if name not in self._link_names:
            raise SimulationError(
                f"{self._described()} has no link {name!r} (its links: {', '.join(self._link_names)}); check its URDF"
            )
        return self._link_names[name]

    def place(self, positions: Sequence[float], velocities: Sequence[float] | None = None) -> None:
        """Put the moving joints at positions (m, rad) with velocities (m/s, rad/s), zero by default."""
        speeds = [0.0] * len(self.joints) if velocities is None else velocities
        for joint, position, velocity in zip(self.joints, positions, speeds, strict=True):
            self.client.resetJointState(self.id, joint, position, velocity)

    def put(self, positions: Sequence[float]) -> None:
        """As `place`, at rest and in one call; for where only geometry counts: the bits of what follows differ."""
        self.client.resetJointStatesMultiDof(self.id, self.joints, [[position] for position in positions])

    def drive(self, target: list[float]) -> None:
        """Set the motors' target positions (m, rad), unless they have them already: Bullet keeps targets."""
        if target == self._target:
            return
        self._target = target
        self._drive(
            self.id,
            self.joints,
            self.client.POSITION_CONTROL,
            target,
            positionGains=self._position_gains,
            velocityGains=self._velocity_gains,
            forces=self._forces,
        )

    def go_limp(self) -> None:
        """Take all force from the motors, now and for targets to come."""
        self._forces = [0.0] * len(self.joints)
        if self._target is not None:
            target, self._target = self._target, None
            self.drive(target)

    def collide(self, mask: int) -> None:
        """Set collision group and mask of the base and all links to `mask`."""
        for link in range(-1, self.n_links):
            self.client.setCollisionFilterGroupMask(self.id, link, mask, mask)

    def _cover(self, surface: Surface) -> None:
        change = self.client.changeDynamics
        for link in range(-1, self.n_links):
            friction, restitution = surface.friction, surface.restitution
            change(self.id, link, lateralFriction=friction, spinningFriction=friction, restitution=restitution)
        change(self.id, -1, linearDamping=surface.base_damping, angularDamping=surface.base_damping)

    def joint_positions(self) -> npt.NDArray[np.float32]:
        """Positions (m, rad) of the moving joints, float32."""
        return self.joint_states()[0]

    def exact_joints(self) -> npt.NDArray[np.float64]:
        """Positions (m, rad) of the moving joints as the engine has them."""
        return np.array([state[0] for state in self.client.getJointStates(self.id, self.joints)], dtype=np.float64)

    def joint_states(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Positions (m, rad) and velocities (m/s, rad/s) of the moving joints, float32."""
        states = self.client.getJointStates(self.id, self.joints)
        return (
            np.array([state[0] for state in states], dtype=np.float32),
            np.array([state[1] for state in states], dtype=np.float32),
        )

    def link_poses(self, links: Sequence[int]) -> npt.NDArray[np.float32]:
        """(n, 7) world poses of link frames, xyz (m) and quaternion xyzw, float32."""
        states = self.client.getLinkStates(self.id, links, computeForwardKinematics=1)
        return np.array([state[4] + state[5] for state in states], dtype=np.float32)

    def _described(self) -> str:
        model = self.client.getBodyInfo(self.id)[1].decode(errors="replace")
        return f"the model {model!r} loaded as {type(self).__name__}"
