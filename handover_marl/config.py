"""What can be chosen about the world and the rules, as frozen dataclasses (SI units, radians, quaternions xyzw).

The defaults are HandoverSim's (Chao et al., ICRA 2022); official figures exist for these values only. What cannot
be chosen, because the data or the robot fix it, stands in capitals.
"""

import math
from dataclasses import dataclass, field

from handover_marl.errors import OptionError

#: Larger pictures than this (pixels a side) end the software renderer.
LARGEST_SIDE = 8192

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

#: Seconds in a physics step. The recordings have a row for every step, and periods are told in whole steps.
TIME_STEP = 0.001

PANDA_DOF = 9
#: Of the table that the robot stands beside and objects lie on (m).
TABLE_HEIGHT = 0.92
ARM_JOINTS = 7
HAND_DOF = 51
OBJECT_DOF = 6
MAX_OBJECTS = 5
N_KEYPOINTS = 16
N_PREVIEW = 5


@dataclass(frozen=True)
class MotorConfig:
    """Position control of a group of joints.

    Attributes:
        force: Largest motor force (N) or torque (N m).
        position_gain: Share of the position error that one step corrects (1).
        velocity_gain: Share of the velocity error that one step corrects (1).
    """

    force: float
    position_gain: float
    velocity_gain: float = 1.0


@dataclass(frozen=True)
class PandaConfig:
    """Franka Panda: where it stands, how it starts and how its nine joints are driven."""

    base_position: Vector3 = (0.61, -0.50, 0.875)
    base_orientation: Quaternion = (0.0, 0.0, 0.7071068, 0.7071068)
    start_joints: tuple[float, ...] = (0.0, -1.285, 0.0, -2.356, 0.0, 1.571, 0.785, 0.04, 0.04)
    motor: MotorConfig = MotorConfig(force=250.0, position_gain=0.01)


@dataclass(frozen=True)
class ObjectConfig:
    """Objects on their six-joint chain: three prismatic, three continuous."""

    translation_motor: MotorConfig = MotorConfig(force=50.0, position_gain=0.2)
    rotation_motor: MotorConfig = MotorConfig(force=5.0, position_gain=0.2)


@dataclass(frozen=True)
class HandConfig:
    """The human hand: a base on six joints and 45 finger joints."""

    translation_motor: MotorConfig = MotorConfig(force=50.0, position_gain=0.2)
    rotation_motor: MotorConfig = MotorConfig(force=5.0, position_gain=0.2)
    finger_motor: MotorConfig = MotorConfig(force=0.5, position_gain=0.1)
    friction: float = 5.0
    restitution: float = 0.5
    base_damping: float = 10.0


@dataclass(frozen=True)
class PhysicsConfig:
    """The simulated world. `gravity` is along world z (m/s^2)."""

    gravity: float = -9.8
    table_position: Vector3 = (0.61, 0.28, 0.0)
    panda: PandaConfig = field(default_factory=PandaConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)
    hand: HandConfig = field(default_factory=HandConfig)


@dataclass(frozen=True)
class GiverConfig:
    """What the giver may do to the replayed motion, and how fast.

    Speeds and accelerations are below the peaks that 95 % of the people in DexYCB show in their own reaches: wrist
    0.86 m/s and 7.1 m/s^2, turning 2.6 rad/s (measured on every tenth recording, smoothed over 0.1 s).

    Attributes:
        displacement: Largest wrist displacement along each axis (m).
        rotation: Largest component of the wrist's rotation vector (rad).
        speed: Speed of the displacement (m/s).
        acceleration: Its acceleration (m/s^2).
        turn_speed: Speed of the rotation vector (rad/s).
        turn_acceleration: Its acceleration (rad/s^2).
        rate_change: How fast the playback rate changes (1/s); a stop from normal speed takes 0.2 s.
        opening: Share of the finger angles that a hand gives up when it opens.
        opening_time: How long that takes (s).
        preview: Times ahead at which the giver knows its recording (s).
    """

    displacement: float = 0.3
    rotation: float = 1.0
    speed: float = 0.8
    acceleration: float = 5.0
    turn_speed: float = 2.5
    turn_acceleration: float = 15.0
    rate_change: float = 5.0
    opening: float = 0.7
    opening_time: float = 0.3
    preview: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5)

    def __post_init__(self) -> None:
        # Spaces, features and learned givers count on five.
        if len(self.preview) != N_PREVIEW:
            raise OptionError(f"preview={self.preview}: a giver knows its recording at {N_PREVIEW} times ahead")


@dataclass(frozen=True)
class ProtocolConfig:
    """When the human lets go, and when an episode is won or lost.

    Attributes:
        release_steps: Steps in a row that a release condition must hold.
        region_lower: Lower corner of the grasp region in a finger link's frame (m), exclusive.
        region_upper: Upper corner of the grasp region in a finger link's frame (m), exclusive.
        goal_center: Where the gripper must bring the object, world frame (m).
        goal_radius: How near the Panda's hand link must be to the goal (m).
        success_steps: Steps in a row that the object must be held at the goal.
        drop_height: An object whose origin is lower than this has fallen, world z (m).
        horizon_steps: Steps after which an episode without success times out.
    """

    release_steps: int = 100
    region_lower: Vector3 = (-0.011, -0.009, 0.0)
    region_upper: Vector3 = (0.011, 0.009, 0.055)
    goal_center: Vector3 = (0.61, -0.20, 1.25)
    goal_radius: float = 0.15
    success_steps: int = 100
    drop_height: float = 0.92
    horizon_steps: int = 13_000


@dataclass(frozen=True)
class WorldConfig:
    """Everything that can be chosen about a handover but its scene and its policies.

    Attributes:
        physics: The simulated world.
        protocol: The rules.
        giver: What the giver may do to the recording.
    """

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    giver: GiverConfig = field(default_factory=GiverConfig)


#: HandoverSim's world.
OFFICIAL = WorldConfig()


@dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera; the default sees robot, table and hand from the side (m, degrees, pixels).

    Raises:
        OptionError: The picture has no size or is too large, or a number is not finite or makes no view; the renderer
            would end the process over it.
    """

    width: int = 640
    height: int = 480
    vertical_fov: float = 54.0
    near: float = 0.1
    far: float = 10.0
    position: Vector3 = (1.95, -0.2, 1.75)
    target: Vector3 = (0.45, -0.2, 1.15)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            side = getattr(self, name)
            if isinstance(side, bool) or not isinstance(side, int) or not 1 <= side <= LARGEST_SIDE:
                raise OptionError(f"{name}={side!r}: pictures have 1 to {LARGEST_SIDE} pixels a side")
        numbers = (self.vertical_fov, self.near, self.far, *self.position, *self.target)
        if not all(isinstance(number, (int, float)) and math.isfinite(number) for number in numbers):
            raise OptionError(f"{self}: not all numbers are finite")
        if not (0.0 < self.vertical_fov < 180.0 and 0.0 < self.near < self.far):
            raise OptionError(f"{self}: needs 0 < vertical_fov < 180 and 0 < near < far")
        if tuple(self.position) == tuple(self.target):
            raise OptionError(f"{self}: position and target are the same")
