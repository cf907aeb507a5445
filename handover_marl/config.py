"""Configuration of the simulated world and the protocol, as frozen dataclasses.

SI units, radians, quaternions xyzw. The defaults are HandoverSim's (Chao et al., ICRA 2022); official
results exist for these values only. Constants in capitals cannot be configured.
"""

import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np

from handover_marl.errors import OptionError, check_name
from handover_marl.execution.files import shorten_text
from handover_marl.geometry.panda import HAND_LINK, MOUNT_LINKS

#: Largest image side (pixels); larger ones crash the software renderer.
MAX_IMAGE_SIDE = 8192

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

#: Duration of a physics step (s). Recordings have one row per step; control periods are whole numbers of steps.
TIME_STEP = 0.001
#: Longest control period of an environment or a policy (s).
MAX_CONTROL_PERIOD = 5.0

PANDA_DOF, ARM_DOF = 9, 7
#: Height of the table top, world z (m).
TABLE_HEIGHT = 0.92
HAND_DOF = 51
OBJECT_DOF = 6
MAX_OBJECTS = 5
N_KEYPOINTS = 16
_NO_LIMITS = (-math.inf, math.inf)


class CheckedConfig:
    """Base class of configurations that check their fields on construction, and raise an `OptionError` for wrong ones.

    Numbers must be finite. A tuple must be as long as its default, unless its field is in `any_length`. A field whose
    default is a dataclass must have a value of the same class.
    """

    #: Smallest and largest allowed number, both included, in fields that are not `bounded`.
    default_limits: ClassVar[tuple[float, float]] = _NO_LIMITS
    #: Names of fields that are tuples of any length, perhaps nested. Their numbers must be finite, but have no limits.
    any_length: ClassVar[frozenset[str]] = frozenset()
    #: Pairs of field names; the value of the first field must be at most that of the second.
    ordered_fields: ClassVar[tuple[tuple[str, str], ...]] = ()

    def __post_init__(self) -> None:
        for part in fields(self):  # type: ignore[arg-type]
            value = getattr(self, part.name)
            default = part.default_factory() if callable(part.default_factory) else part.default
            name = f"{part.name} of {type(self).__name__}"
            limits: tuple[float, float] = part.metadata.get("limits", self.default_limits)
            if part.name in self.any_length:
                if not isinstance(value, tuple):
                    raise OptionError(f"{name} must be a tuple, got {value!r}")
                _check_nested_numbers(name, value)
            elif is_dataclass(default):
                check_config(name, value, type(default))
            elif isinstance(default, str):
                if not isinstance(value, str):
                    raise OptionError(f"{name} must be a text, got {value!r}")
            elif isinstance(default, tuple):
                object.__setattr__(self, part.name, _check_tuple(name, value, len(default), limits))
            else:
                check_number(name, value, isinstance(default, int), limits)
            if part.metadata.get("in_steps"):
                for time in np.ravel(value).tolist():
                    count_physics_steps(name, time)
        for low, high in self.ordered_fields:
            first, second = getattr(self, low), getattr(self, high)
            if first > second:
                raise OptionError(f"{low} of {type(self).__name__} must be at most {high}, got {first} and {second}")


def bounded(default: float | tuple[float, ...], low: float, high: float = math.inf, in_steps: bool = False) -> Any:
    """Return a dataclass field of a `CheckedConfig` with a default; its numbers must be from `low` to `high`.

    If `in_steps` is True, the numbers are times in s, and must be whole numbers of physics steps (1 ms).
    """
    return field(default=default, metadata={"limits": (low, high), "in_steps": in_steps})


def count_physics_steps(name: str, time: float) -> int:
    """Return the number of physics steps in a time (s); raise OptionError about the argument `name` if not whole."""
    steps = round(time / TIME_STEP)
    if abs(steps * TIME_STEP - time) > 1e-6:  # single precision suffices
        raise OptionError(f"{name} must be a whole number of ms, in s, got {time!r}; take {steps * TIME_STEP:g}")
    return steps


def check_config(name: str, value: object, config_class: type) -> None:
    """Raise OptionError unless a value is an instance of `config_class`; the error message calls it `name`."""
    if not isinstance(value, config_class):
        raise OptionError(f"{name} must be a {config_class.__name__}, got {value!r}")


def _check_tuple(name: str, value: Any, size: int, limits: tuple[float, float]) -> tuple[float, ...]:
    try:
        numbers = tuple(value)
    except TypeError:
        numbers = ()
    if len(numbers) != size or isinstance(value, (str, bytes)):
        raise OptionError(f"{name} must be {size} numbers, got {value!r}")
    for number in numbers:
        check_number(f"every number in {name}", number, False, limits)
    return numbers


def _check_nested_numbers(name: str, value: Any) -> None:
    if isinstance(value, tuple):
        for item in value:
            _check_nested_numbers(name, item)
    else:
        check_number(f"every number in {name}", value)


def check_number(name: str, value: Any, is_integer: bool = False, limits: tuple[float, float] = _NO_LIMITS) -> None:
    """Raise OptionError unless `value` is a finite number, or an integer, within limits; messages call it `name`."""
    low, high = limits
    is_number = isinstance(value, Integral if is_integer else Real) and not isinstance(value, bool)
    # `math.isfinite` fails for integers beyond the range of floats.
    if not is_number or not -math.inf < value < math.inf or not low <= value <= high:
        text = "an integer" if is_integer else "a finite number"
        if limits != _NO_LIMITS:
            text += f" from {low:.15g} to {high:.15g}" if math.isfinite(high) else f" of at least {low:.15g}"
        # The text of a huge integer raises an error.
        raise OptionError(f"{name} must be {text}, got {shorten_text(value) if is_number else repr(value)}")


@dataclass(frozen=True)
class MotorConfig(CheckedConfig):
    """Motor parameters of the position control of a group of joints.

    In fast and MuJoCo physics, `force` and `velocity_gain` have no effect on the human hand, and none on an object
    before a body is near the Panda or an object was released.

    Attributes:
        force: Largest motor force (N) or torque (N m), at least 0.001.
        position_gain: Share of the position error that is corrected in one physics step.
        velocity_gain: Share of the velocity error that is corrected in one physics step.
    """

    force: float = field(metadata={"limits": (0.001, math.inf)})
    position_gain: float = field(metadata={"limits": (0.0, 1.0)})
    velocity_gain: float = bounded(1.0, 0.0, 1.0)


@dataclass(frozen=True)
class PandaConfig(CheckedConfig):
    """Configuration of the Franka Panda: base pose, start joints and motors.

    Attributes:
        base_position: Position of the robot's base, world frame (m).
        base_orientation: Orientation of the robot's base, world frame, quaternion xyzw.
        start_joints: Joint positions at the start of an episode, 7 arm (rad) and 2 fingers (m).
        motor: Motor parameters of all nine joints.
    """

    base_position: Vector3 = (0.61, -0.50, 0.875)
    base_orientation: Quaternion = (0.0, 0.0, 0.7071068, 0.7071068)
    start_joints: tuple[float, ...] = (0.0, -1.285, 0.0, -2.356, 0.0, 1.571, 0.785, 0.04, 0.04)
    motor: MotorConfig = MotorConfig(force=250.0, position_gain=0.01)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not math.isclose(math.hypot(*self.base_orientation), 1.0, abs_tol=1e-3):
            raise OptionError(f"base_orientation must be a unit quaternion xyzw, got {self.base_orientation}")


@dataclass(frozen=True)
class ObjectConfig(CheckedConfig):
    """Motor parameters of the objects; an object moves on three prismatic and three continuous joints.

    Attributes:
        translation_motor: Motor parameters of an object's prismatic joints.
        rotation_motor: Motor parameters of an object's continuous joints.
    """

    translation_motor: MotorConfig = MotorConfig(force=50.0, position_gain=0.2)
    rotation_motor: MotorConfig = MotorConfig(force=5.0, position_gain=0.2)


@dataclass(frozen=True)
class HandConfig(CheckedConfig):
    """Motor and contact parameters of the human hand, which has 6 base and 45 finger joints.

    Attributes:
        translation_motor: Motor parameters of the three prismatic joints of the hand's base.
        rotation_motor: Motor parameters of the three revolute joints of the hand's base.
        finger_motor: Motor parameters of the finger joints.
        friction: Lateral friction coefficient of the hand.
        restitution: Restitution coefficient of the hand.
        base_damping: Linear and angular damping of the hand's base.
    """

    translation_motor: MotorConfig = MotorConfig(force=50.0, position_gain=0.2)
    rotation_motor: MotorConfig = MotorConfig(force=5.0, position_gain=0.2)
    finger_motor: MotorConfig = MotorConfig(force=0.5, position_gain=0.1)
    friction: float = bounded(5.0, 0.0)
    restitution: float = bounded(0.5, 0.0, 1.0)
    base_damping: float = bounded(10.0, 0.0)


@dataclass(frozen=True)
class PhysicsConfig(CheckedConfig):
    """Configuration of the simulated world.

    Attributes:
        gravity: Gravitational acceleration along world z (m/s^2).
        table_position: Position of the table, world frame (m).
        panda: Configuration of the robot.
        objects: Configuration of the objects.
        hand: Configuration of the human hand.
    """

    gravity: float = -9.8
    table_position: Vector3 = (0.61, 0.28, 0.0)
    panda: PandaConfig = field(default_factory=PandaConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)
    hand: HandConfig = field(default_factory=HandConfig)


@dataclass(frozen=True)
class GiverConfig(CheckedConfig):
    """Limits of the giver's deviation from the recorded motion.

    In 95 % of DexYCB's reaches, the wrist's peak speed exceeds 0.86 m/s, its peak acceleration 7.1 m/s^2 and its peak
    turn speed 2.6 rad/s (every tenth recording, smoothed over 0.1 s). The defaults of these three limits are lower.

    Attributes:
        displacement: Largest wrist displacement along each axis (m).
        rotation: Largest component of the wrist's rotation vector (rad).
        speed: Largest speed of the wrist's displacement (m/s).
        acceleration: Largest acceleration of the wrist's displacement (m/s^2).
        turn_speed: Largest speed of the wrist's rotation vector (rad/s).
        turn_acceleration: Largest acceleration of the wrist's rotation vector (rad/s^2).
        rate_change: Largest slope of the playback rate (1/s); a stop takes 0.2 s at the default.
        opening: Share by which finger angles shrink when the hand opens after a voluntary release.
        opening_time: Time in which the hand opens (s).
        preview: Times (s), ahead of the current frame, of the recorded poses that the giver observes; whole ms.
    """

    displacement: float = bounded(0.3, 0.0)
    rotation: float = bounded(1.0, 0.0)
    speed: float = bounded(0.8, 0.0)
    acceleration: float = bounded(5.0, 0.0)
    turn_speed: float = bounded(2.5, 0.0)
    turn_acceleration: float = bounded(15.0, 0.0)
    rate_change: float = bounded(5.0, 0.0)
    opening: float = bounded(0.7, 0.0, 1.0)
    opening_time: float = bounded(0.3, 0.001)
    # Must have five times: observation spaces, features and learned givers expect five previewed poses.
    preview: tuple[float, ...] = bounded((0.1, 0.2, 0.3, 0.4, 0.5), 0.0, in_steps=True)


@dataclass(frozen=True)
class ProtocolConfig(CheckedConfig):
    """Rules of a handover: release of the object, success and failure.

    Attributes:
        release_steps: Consecutive physics steps for which a release condition must hold.
        region_lower: Lower corner (m) of the grasp region, an open box in each finger link's frame.
        region_upper: Upper corner (m) of the grasp region; contacts with the object in it count for an active release.
        goal_center: Center of the spherical goal region, world frame (m).
        goal_radius: Largest distance of the Panda's hand link from the goal's center (m).
        success_steps: Consecutive physics steps for which the gripper must hold the object at the goal.
        drop_height: World z (m) of the object's origin below which the object counts as dropped.
        horizon_steps: Physics steps after which an episode times out.
    """

    release_steps: int = bounded(100, 1)
    region_lower: Vector3 = (-0.011, -0.009, 0.0)
    region_upper: Vector3 = (0.011, 0.009, 0.055)
    goal_center: Vector3 = (0.61, -0.20, 1.25)
    goal_radius: float = bounded(0.15, 0.0)
    success_steps: int = bounded(100, 1)
    drop_height: float = 0.92
    horizon_steps: int = bounded(13_000, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(lower < upper for lower, upper in zip(self.region_lower, self.region_upper, strict=True)):
            raise OptionError(f"region_lower must be below region_upper, got {self.region_lower}, {self.region_upper}")


@dataclass(frozen=True)
class WorldConfig(CheckedConfig):
    """Configuration of simulated world, protocol and giver, shared by all scenes and policies.

    Attributes:
        physics: Configuration of the simulated world.
        protocol: Rules of release, success and failure.
        giver: Limits of the giver's deviation from the recording.
        initial_joint_noise: Largest deviation (rad, at most 0.3) of each arm joint from `start_joints` at the start
            of an episode; each episode draws the seven deviations uniformly.
    """

    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    giver: GiverConfig = field(default_factory=GiverConfig)
    # Not in `repr`: result folders store a hash of `repr` for the other fields, and this number as it is.
    initial_joint_noise: float = field(default=0.0, repr=False, metadata={"limits": (0.0, 0.3)})

    def draw_initial_joints(self, seed: int) -> tuple[float, ...]:
        """Return the robot's start joints (9,), 7 arm (rad) and 2 fingers (m); `seed` draws the noise on the arm."""
        joints = self.physics.panda.start_joints
        if self.initial_joint_noise == 0.0:
            return joints
        drawn = np.random.default_rng(seed).uniform(-self.initial_joint_noise, self.initial_joint_noise, ARM_DOF)
        return (*np.add(joints[:ARM_DOF], drawn).tolist(), *joints[ARM_DOF:])


#: Configuration with the values of HandoverSim.
OFFICIAL_CONFIG = WorldConfig()


@dataclass(frozen=True)
class CameraConfig(CheckedConfig):
    """Configuration of a pinhole camera; the default shows robot, table and hand from the side.

    Position, target and `up` are in the frame of `link`, or in the world frame if `link` is "". Pixels are square, so
    the horizontal field of view follows from the image's aspect ratio.

    Attributes:
        width: Width of the image (pixels).
        height: Height of the image (pixels).
        vertical_fov: Vertical field of view (degrees).
        near: Distance of the near clipping plane (m).
        far: Distance of the far clipping plane (m).
        position: Position of the camera (m).
        target: Point at the image's center (m).
        up: Direction of the image's upper edge, not parallel to the viewing direction.
        link: Link of the robot on which the camera is mounted, e.g. "panda_hand"; "" for a camera that is fixed in the
            world. Overview images need a fixed camera.
        name: Name of the camera. The keys of its observations begin with this name, e.g. "front_rgb".
        period: Time between two images (s), a whole number of milliseconds; observations in between repeat the last
            image. 0 for a new image in every observation.
    """

    width: int = bounded(640, 1, MAX_IMAGE_SIDE)
    height: int = bounded(480, 1, MAX_IMAGE_SIDE)
    vertical_fov: float = bounded(54.0, 5.0, 175.0)  # so that radians are an error
    near: float = bounded(0.1, 1e-6)
    far: float = 10.0
    position: Vector3 = bounded((1.95, -0.2, 1.75), -100.0, 100.0)
    target: Vector3 = bounded((0.45, -0.2, 1.15), -100.0, 100.0)
    up: Vector3 = (0.0, 0.0, 1.0)
    link: str = ""
    name: str = "side"
    period: float = bounded(0.0, 0.0, 10.0, in_steps=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.near >= self.far:
            raise OptionError(f"near of a camera must be less than far, got {self.near} and {self.far}")
        if self.position == self.target:
            raise OptionError(f"position and target of a camera must differ, got {self.position}")
        if np.linalg.norm(np.cross(np.subtract(self.target, self.position), self.up)) < 1e-9:
            raise OptionError(f"up of a camera must not be parallel to the viewing direction, got {self.up}")
        if not self.name.isidentifier():
            raise OptionError(f"name of a camera must be letters, digits and _, got {self.name!r}")
        if self.link not in ("", *MOUNT_LINKS):
            raise OptionError(f"link of a camera must be '' or one of {', '.join(MOUNT_LINKS)}, got {self.link!r}")


#: Cameras by name: HandoverSim's on the wrist; one that looks at the robot from the person's side; and one behind the
#: robot's shoulder, at the height of a person's eyes.
CAMERAS = {
    "wrist": CameraConfig(
        *(224, 224, 90.0, 0.035, 2.0, (0.036, 0.0, 0.036), (0.036, 0.0, 1.036)),
        up=(1.0, 0.0, 0.0),
        link=HAND_LINK,
        name="wrist",
    ),
    "front": CameraConfig(224, 224, 50.0, 0.1, 4.0, (0.61, 1.45, 1.65), (0.61, -0.1, 1.15), name="front"),
    "over_shoulder": CameraConfig(224, 224, 50.0, 0.1, 4.0, (1.05, -1.25, 1.9), (0.55, 0.1, 1.1), name="over_shoulder"),
}


def make_camera(name: str, /, **fields: Any) -> CameraConfig:
    """Return a copy of a camera in `CAMERAS` with some fields changed, e.g. `make_camera("wrist", width=128)`.

    Raises:
        UnknownNameError: There is no camera of that name.
        OptionError: A value is out of range.
    """
    check_name("camera", name, CAMERAS)
    return replace(CAMERAS[name], **fields)
