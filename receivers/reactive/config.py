"""Configuration of the receiver `reactive`, in meters, radians and seconds."""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

from handover_marl.config import CheckedConfig, bounded
from handover_marl.errors import OptionError
from handover_marl.grasps.graspable_object import PARTIAL_HOLD_COST
from handover_marl.grasps.validation import GraspPreparationConfig
from handover_marl.planning.arm_control import ServoConfig
from handover_marl.planning.collision_avoidance import SeparationConfig
from handover_marl.planning.handover_prediction import HandoverPosePredictorConfig

#: Limits of control periods (s).
PERIODS = (0.001, 60.0)


@dataclass(frozen=True)
class GraspSelectorConfig(CheckedConfig):
    """Configuration of grasp selection; the costs of a grasp (s) are added to the travel time of the arm.

    Attributes:
        max_candidates: Maximum number of grasps for which IK is solved in a decision; fourfold with offset grasps.
        desired_clearance: Desired clearance of the gripper to the person's hand (m).
        clearance_cost: Cost per meter by which the clearance is below `desired_clearance` (s/m).
        min_clearance: Initial minimum clearance of gripper to person's hand (m). It decreases while no grasp has it.
        hard_min_clearance: Lower bound of the decreasing minimum clearance (m).
        offset_delay: Time without a good grasp after which offset grasps (shifted and tilted copies) are added (s).
        offset_cost: Additional cost of an offset grasp, which is not validated (s).
        partial_hold_cost: Cost of grasps that do not always hold the object (s): factor on 1 minus the success rate.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    max_candidates: int = bounded(32, 1)
    desired_clearance: float = 0.045
    clearance_cost: float = 40.0
    min_clearance: float = 0.008
    hard_min_clearance: float = 0.002
    offset_delay: float = 0.5
    offset_cost: float = 1.5
    partial_hold_cost: float = PARTIAL_HOLD_COST


@dataclass(frozen=True)
class ApproachConfig(CheckedConfig):
    """Configuration of the approach from the standoff pose, and of closing the fingers.

    Attributes:
        standoff: Distance of the standoff pose from the grasp (m). There, the gripper waits until the object is slow.
        lateral_tolerance: Maximum position error across the approach axis at the grasp (m).
        rotation_tolerance: Maximum rotation error at the grasp (rad).
        speed: Maximum speed along the approach axis (m/s).
        max_object_speed: Speed of the object above which the gripper does not come closer (m/s).
        max_held_still_speed: Value of `max_object_speed` for an object that is held almost still in the air (m/s).
        close_speed: Maximum speed of the object at which the fingers close (m/s). For an object that is held almost
            still in the air, it is the speed relative to the gripper.
        close_period: Control period while the fingers close (s).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    standoff: float = bounded(0.08, 1e-6)
    lateral_tolerance: float = 0.005
    rotation_tolerance: float = 0.12
    speed: float = 0.45
    max_object_speed: float = 0.2
    max_held_still_speed: float = 0.6
    close_speed: float = 0.08
    close_period: float = bounded(0.01, *PERIODS)


@dataclass(frozen=True)
class RetreatConfig(CheckedConfig):
    """Configuration of the retreat with the object to the goal.

    Attributes:
        speed: Maximum speed of the gripper on the straight path out of the person's hand (m/s).
        acceleration: Acceleration of the gripper on this path (m/s^2).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    speed: float = 0.8
    acceleration: float = 6.0


@dataclass(frozen=True)
class ReactiveConfig(CheckedConfig):
    """Configuration of the receiver `reactive`.

    Attributes:
        period: Control period (s).
        near_period: Control period of the approach while object or hand moves near the gripper (s).
        min_lift: Distance of an object from its first position above which the object counts as lifted (m).
        selection: Configuration of grasp selection.
        preparation: Configuration of tilted copies and of the validation of known grasps.
        approach: Configuration of the approach and of closing the fingers.
        retreat: Configuration of the retreat to the goal.
        separation: Clearances to the person, the objects and the table.
        prediction: Constants of the motion model that predicts the handover pose.
        servo: Limits on joint speeds and accelerations.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    period: float = bounded(0.05, *PERIODS)
    near_period: float = bounded(0.02, *PERIODS)
    min_lift: float = 0.04
    selection: GraspSelectorConfig = GraspSelectorConfig()
    preparation: GraspPreparationConfig = field(default_factory=GraspPreparationConfig)
    approach: ApproachConfig = ApproachConfig()
    retreat: RetreatConfig = RetreatConfig()
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    prediction: HandoverPosePredictorConfig = field(default_factory=HandoverPosePredictorConfig)
    servo: ServoConfig = field(default_factory=ServoConfig)


def apply_risk(config: ReactiveConfig, risk: float) -> ReactiveConfig:
    """Return a copy of `config` with another trade-off between success rate and speed.

    The risk is a number from 0 to 1: 0.5 changes nothing, 0 divides the speeds of final approach and retreat and the
    speed limits of approached objects by four, 1 multiplies them by four. Time constants of clearances, and costs of
    low clearances and of uncertain grasps, change by the inverse factor. Above 0.5, larger errors at the grasp are
    allowed, too. Other numbers raise `OptionError`.
    """
    if isinstance(risk, bool) or not isinstance(risk, (int, float)) or not 0.0 <= risk <= 1.0:
        raise OptionError(f"risk must be a number from 0 to 1, got {risk!r}")
    # 1/4 at risk 0, 1 at 0.5 and 4 at 1.
    pace = 4.0 ** (2.0 * risk - 1.0)
    tolerance = max(1.0, pace) ** 0.5
    speeds = dict.fromkeys(("speed", "max_object_speed", "close_speed", "max_held_still_speed"), pace)
    factors = {
        "approach": speeds | {"lateral_tolerance": tolerance, "rotation_tolerance": tolerance},
        "retreat": {"speed": pace, "acceleration": pace},
        "separation": {"time_constant": 1.0 / pace, "approach_time_constant": 1.0 / pace},
        "selection": {"clearance_cost": 1.0 / pace, "partial_hold_cost": 1.0 / pace},
    }
    for name, own in factors.items():
        section = getattr(config, name)
        changed = replace(section, **{key: factor * getattr(section, key) for key, factor in own.items()})
        config = replace(config, **{name: changed})
    return config
