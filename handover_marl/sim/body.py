"""A jointed body in the simulation: its degrees of freedom, motors and collision masks."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import MotorConfig
from handover_marl.errors import SimulationError
from handover_marl.sim.client import BulletClient, float32_list

_JOINT_TYPE, _LINK_NAME = 2, 12


def inertial_offset(client: BulletClient, body_id: int, link: int) -> npt.NDArray[np.float64]:
    """Pose (7) of a link's centre of mass in the link's URDF frame, xyz (m) and quaternion xyzw; -1 is the base.

    Bullet places bases and reports link states by centres of mass; models and tasks speak of link frames.
    """
    info = client.getDynamicsInfo(body_id, link)
    return np.array([*info[3], *info[4]])


class Body:
    """A loaded URDF whose moving joints are driven to positions.

    Args:
        client: The physics server it was loaded into.
        body_id: PyBullet's number of the body.
        motors: One entry per moving joint, in joint order.

    Raises:
        SimulationError: The model has another number of moving joints than there are motors.
    """

    def __init__(self, client: BulletClient, body_id: int, motors: Sequence[MotorConfig]) -> None:
        self.client = client
        self.id = body_id
        infos = [client.getJointInfo(body_id, joint) for joint in range(client.getNumJoints(body_id))]
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

    def link(self, name: str) -> int:
        """PyBullet's number of a link by its URDF name (numbers differ between Panda files).

        Raises:
            SimulationError: The model has no such link.
        """
        if name not in self._link_names:
            raise SimulationError(
                f"{self._described()} has no link {name!r} (its links: {', '.join(self._link_names)}); "
                "check its URDF"
            )
        return self._link_names[name]

    def place(self, positions: Sequence[float], velocities: Sequence[float] | None = None) -> None:
        """Put the moving joints at positions (m, rad) with velocities (m/s, rad/s), zero by default."""
        speeds = [0.0] * len(self.joints) if velocities is None else velocities
        for joint, position, velocity in zip(self.joints, positions, speeds, strict=True):
            self.client.resetJointState(self.id, joint, position, velocity)

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

    def collide(self, mask: int, links: Sequence[int] | None = None) -> None:
        """Set collision group and mask of some links (default: all and the base) to `mask`."""
        for link in range(-1, self.n_links) if links is None else links:
            self.client.setCollisionFilterGroupMask(self.id, link, mask, mask)

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
