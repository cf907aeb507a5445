"""Configuration of the receiver `reactive`, in metres, radians and seconds."""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

from handover_marl.config import CheckedConfig, bounded
from handover_marl.errors import OptionError
from handover_marl.planning.arm_control import ServoConfig
from handover_marl.planning.collision_avoidance import SeparationConfig
from handover_marl.planning.handover_prediction import HandoverPosePredictorConfig
from handover_marl.receivers.reactive.grasps import GraspOffsets, GraspPreparationConfig, make_quick_preparation_config

#: Limits of control periods (s).
PERIODS = (0.001, 60.0)


@dataclass(frozen=True)
class GraspSelectorConfig(CheckedConfig):
    """Configuration of grasp selection; costs are in seconds, as the travel time of the arm.

    Attributes:
        max_candidates: Maximum number of grasps for which inverse kinematics is solved.
        rotation_cost: Cost of rotating the hand from its waiting pose (s/rad).
        desired_clearance: Desired clearance of the gripper to the person's hand (m).
        clearance_cost: Cost of clearance below `desired_clearance` (s/m).
        min_clearance: Initial minimum clearance of a grasp to the person's hand (m).
        desired_obstacle_clearance: Desired clearance of the gripper to the other objects (m).
        obstacle_cost: Cost of clearance below `desired_obstacle_clearance` (s/m).
        clearance_relaxation: Rate at which the minimum clearance decreases while no grasp satisfies
            that clearance (m/s).
        hard_min_clearance: Lower bound of the decreasing minimum clearance (m).
        unreachable_relaxation: Factor on `clearance_relaxation` while grasps exist that are out of reach.
        offset_delay: Time without a good grasp after which offset grasps are added (s).
        poor_hold_cost: Hold cost above which a selected grasp does not count as good (s).
        offset_cost: Additional cost of an offset grasp, which is not validated (s).
        offset_candidate_factor: Factor on `max_candidates` once offset grasps are added.
        table_clearance: Minimum height of the gripper above the table (m).
        arm_clearance: Minimum clearance of the arm's forearm and wrist to the person's hand and the object (m).
        path_clearance: Minimum clearance on the straight joint path to a standoff (m).
        blocked_path_cost: Cost of a path with a clearance below `path_clearance` (s).
        max_path_checks: Maximum number of paths that are checked in a decision.
        max_via_points: Maximum number of via points that are checked in a decision.
        desired_limit_margin: Desired distance to the joint limits (rad).
        limit_margin_cost: Cost of a distance to the joint limits below `desired_limit_margin` (s/rad).
        max_joint_change: Maximum joint change between standoff and grasp (rad).
        unstable_cost: Cost of a grasp that has failed its validation in simulation (s).
        partial_hold_cost: Cost of a grasp that holds the object from none of the offset poses in
            its validation (s); proportionally less for a grasp that holds from some.
        fingertip_cost: Cost of a grasp that holds the object by the tip or edge of a finger (s).
        desired_pad_margin: Distance of contacts from the tip and edges of a finger pad at which
            `fingertip_cost` vanishes (m).
        min_offset_pad_margin: Minimum distance of an offset grasp's contacts from the tip and edges
            of a finger pad (m).
        failed_cost: Cost of a grasp that has failed in this episode (s).
        switch_margin: Minimum cost difference for which the selected grasp is replaced (s).
        near_switch_margin: Increase of `switch_margin` once the gripper is in front of the selected grasp (s).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    max_candidates: int = bounded(32, 1)
    rotation_cost: float = 0.5
    desired_clearance: float = 0.045
    clearance_cost: float = 40.0
    min_clearance: float = 0.008
    desired_obstacle_clearance: float = 0.02
    obstacle_cost: float = 100.0
    clearance_relaxation: float = 0.01
    hard_min_clearance: float = 0.002
    unreachable_relaxation: float = 0.3
    offset_delay: float = 0.5
    poor_hold_cost: float = 1.5
    offset_cost: float = 1.5
    offset_candidate_factor: int = bounded(4, 1)
    table_clearance: float = 0.005
    arm_clearance: float = 0.005
    path_clearance: float = 0.01
    blocked_path_cost: float = 2.0
    max_path_checks: int = 6
    max_via_points: int = 24
    desired_limit_margin: float = 0.3
    limit_margin_cost: float = 2.0
    max_joint_change: float = 0.8
    unstable_cost: float = 5.0
    partial_hold_cost: float = 2.0
    fingertip_cost: float = 4.0
    desired_pad_margin: float = bounded(0.008, 1e-6)
    min_offset_pad_margin: float = 0.004
    failed_cost: float = 10.0
    switch_margin: float = 0.3
    near_switch_margin: float = 0.5


@dataclass(frozen=True)
class ApproachConfig(CheckedConfig):
    """Configuration of the approach from the standoff and of closing the fingers.

    Axial distances are measured along the approach axis of the gripper, lateral ones across it.

    Attributes:
        standoff: Distance of the standoff pose, at which the gripper waits for the object to rest, from the grasp (m).
        straight_margin: Axial distance beyond the standoff from which the gripper moves in a
            straight line relative to the object (m).
        straight_lateral: Maximum lateral distance at which the gripper starts the straight line (m).
        straight_rotation: Maximum rotation error at which the gripper moves in the straight line (rad).
        commit_distance: Axial distance from which the selected grasp is kept (m).
        commit_lateral: Maximum lateral distance at which the selected grasp is kept (m).
        commit_rotation: Maximum rotation error at which the selected grasp is kept (rad).
        enclosed_lateral: Lateral distance within which the object is between the fingers at half of
            `commit_distance`, so that the gripper does not go back to correct its pose (m).
        lateral_tolerance: Maximum lateral distance at the grasp (m).
        lateral_funnel: Increase of `lateral_tolerance` per axial metre before the grasp.
        rotation_tolerance: Maximum rotation error at the grasp (rad).
        rotation_funnel: Increase of `rotation_tolerance` per axial metre before the grasp (rad/m).
        speed: Maximum speed along the approach axis (m/s).
        deceleration: Deceleration before the grasp (m/s^2).
        position_gain: Gain on the remaining joint error (1/s).
        max_joint_speed: Maximum joint speed in addition to the speed that follows the object (rad/s).
        max_posture_change: Maximum joint change towards the selected configuration by which the
            seed of inverse kinematics is moved in a decision (rad).
        max_object_speed: Speed of the object above which the gripper does not come closer (m/s).
        max_held_still_speed: Value of `max_object_speed` for an object that is held almost still in the air (m/s).
        close_speed: Maximum speed of the object at which the fingers close (m/s), relative to the
            gripper if the object is held almost still in the air.
        axial_tolerance: Maximum axial distance at which the fingers close (m).
        held_still_tolerance_factor: Factor on `close_speed`, `axial_tolerance` and `lateral_tolerance`
            for an object that is held almost still in the air.
        close_timeout: Maximum time from closing the fingers until the person releases the object (s).
        max_grip_closing_rate: Maximum decrease of the finger positions per second, as a share of these, of
            fingers that the object blocks (1/s).
        max_relative_speed: Maximum speed of a held object relative to the person's hand (m/s); the gripper follows
            the hand instead of an object that is faster, which it pushes.
        catch_distance: Maximum distance from the grasp at which the fingers close around an object that the
            person has released already (m).
        close_period: Control period while the fingers close (s).
        close_gain: Gain with which the gripper follows the person's hand while the fingers close (1/s).
        close_acceleration: Maximum joint acceleration while the fingers close (rad/s^2), high
            enough that the gripper stops before the fingers push the object.
        empty_finger_position: Finger position below which the fingers hold nothing (m).
        empty_delay: Time after the start of closing from which `empty_finger_position` is checked (s).
        backout_distance: Distance by which the gripper backs out after a missed grasp (m).
        backout_speed: Speed at which the gripper backs out (m/s).
        backout_timeout: Maximum time for which the gripper backs out (s).
        opening_time: Time for which the fingers open before the gripper backs out (s).
        failed_duration: Time for which a failed grasp has a higher cost (s).
        stall_timeout: Time without progress after which a grasp is given up (s).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    standoff: float = bounded(0.08, 1e-6)
    straight_margin: float = 0.05
    straight_lateral: float = 0.06
    straight_rotation: float = 0.5
    commit_distance: float = 0.06
    commit_lateral: float = 0.03
    commit_rotation: float = 0.3
    enclosed_lateral: float = 0.015
    lateral_tolerance: float = 0.005
    lateral_funnel: float = 0.3
    rotation_tolerance: float = 0.12
    rotation_funnel: float = 1.0
    speed: float = 0.45
    deceleration: float = 2.0
    position_gain: float = 20.0
    max_joint_speed: float = 1.3
    max_posture_change: float = bounded(0.05, 1e-6)
    max_object_speed: float = 0.2
    max_held_still_speed: float = 0.6
    close_speed: float = 0.08
    axial_tolerance: float = 0.006
    held_still_tolerance_factor: float = 2.0
    close_timeout: float = 0.8
    max_grip_closing_rate: float = 3.0
    max_relative_speed: float = 0.25
    catch_distance: float = 0.02
    close_period: float = bounded(0.01, *PERIODS)
    close_gain: float = 10.0
    close_acceleration: float = 100.0
    empty_finger_position: float = 0.0015
    empty_delay: float = 0.35
    backout_distance: float = 0.1
    backout_speed: float = 0.3
    backout_timeout: float = 1.0
    opening_time: float = 0.1
    failed_duration: float = 4.0
    stall_timeout: float = 0.8


@dataclass(frozen=True)
class RetreatConfig(CheckedConfig):
    """Configuration of the retreat with the object to the goal.

    Attributes:
        backout_distance: Length of the straight path out of the person's hand, on which the motion
            blends into the one to the goal (m).
        speed: Maximum speed of the gripper on the straight path (m/s).
        acceleration: Acceleration of the gripper on the straight path (m/s^2).
        backout_timeout: Maximum time on the straight path (s), which may not lead towards the goal.
        rotation_gain: Gain with which rotations of the gripper are corrected on the straight path (1/s).
        rotation_weight: Weight of rotations relative to translations on the straight path (m/rad).
        goal_radius: Maximum distance of the hand's final position from the goal (m).
        desired_clearance: Desired clearance to the person's hand on the path to the goal (m).
        max_path_checks: Maximum number of final configurations whose paths are checked.
        stall_timeout: Time without progress after which another final configuration is selected (s).
        min_joint_difference: Minimum joint difference between a newly selected final configuration
            and all previous ones (rad).
        progress_ratio: Ratio of the remaining joint distance to its last value below which the arm makes progress.
        joint_tolerance: Joint error below which the final configuration is reached (rad).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    backout_distance: float = 0.05
    speed: float = 0.8
    acceleration: float = 6.0
    backout_timeout: float = 0.4
    rotation_gain: float = 2.0
    rotation_weight: float = 0.1
    goal_radius: float = 0.12
    desired_clearance: float = 0.02
    max_path_checks: int = bounded(40, 1)
    stall_timeout: float = 0.6
    min_joint_difference: float = 0.5
    progress_ratio: float = bounded(0.95, 0.0, 1.0)
    joint_tolerance: float = 0.05


@dataclass(frozen=True)
class ReactiveConfig(CheckedConfig):
    """Configuration of the receiver `reactive`.

    Attributes:
        period: Control period (s).
        near_period: Control period while something moves near the gripper (s).
        near_distance: Distance of the object from the hand link below which the object is near (m).
        near_speed: Speed above which the object or the person's hand counts as moving (m/s).
        min_lift: Distance from its first position at which an object counts as handed over (m).
        settle_time: Time at rest after which an object counts as settled (s).
        still_time: Time at rest beside a still hand after which an object that was not lifted
            counts as handed over, too (s).
        hand_distance: Maximum distance of the nearest keypoint of the person's hand from an object
            that was not lifted (m).
        still_start: Time of the episode before which an object that was not lifted is not approached (s).
        no_hand_start: Time of the episode from which an object without a hand is approached (s).
        limit_padding: Amount by which joint limits are narrowed on each side (rad).
        n_surface_spheres: Number of spheres that approximate an object.
        surface_radius: Radius of the spheres that approximate an object (m).
        n_obstacle_spheres: Number of spheres that approximate another object.
        obstacle_radius: Radius of the spheres that approximate another object (m).
        obstacle_reach: Distance from the robot's base beyond which other objects are ignored (m).
        n_surface_points: Number of random points on an object's surface from which finger contacts
            are computed, in addition to the vertices of the mesh.
        selection: Configuration of grasp selection.
        offsets: Offsets of additional copies of grasps.
        preparation: Configuration of tilted copies and of the validation of known grasps.
        quick_preparation: Configuration used instead for objects without a stored validation in data
            sets with very many objects.
        approach: Configuration of the approach and of closing the fingers.
        retreat: Configuration of the retreat to the goal.
        separation: Minimum clearances to the person, the object and the table.
        prediction: Motion model that predicts where the object is handed over.
        servo: Limits on joint speeds and accelerations.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    period: float = bounded(0.05, *PERIODS)
    near_period: float = bounded(0.02, *PERIODS)
    near_distance: float = 0.3
    near_speed: float = 0.1
    min_lift: float = 0.04
    settle_time: float = 0.2
    still_time: float = 0.6
    hand_distance: float = 0.15
    still_start: float = 1.5
    no_hand_start: float = 3.0
    limit_padding: float = 0.03
    n_surface_spheres: int = bounded(200, 1)
    surface_radius: float = 0.01
    n_obstacle_spheres: int = bounded(80, 1)
    obstacle_radius: float = 0.015
    obstacle_reach: float = 1.1
    n_surface_points: int = 5000
    selection: GraspSelectorConfig = GraspSelectorConfig()
    offsets: GraspOffsets = field(default_factory=GraspOffsets)
    preparation: GraspPreparationConfig = field(default_factory=GraspPreparationConfig)
    quick_preparation: GraspPreparationConfig = field(default_factory=make_quick_preparation_config)
    approach: ApproachConfig = ApproachConfig()
    retreat: RetreatConfig = RetreatConfig()
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    prediction: HandoverPosePredictorConfig = field(default_factory=HandoverPosePredictorConfig)
    servo: ServoConfig = field(default_factory=ServoConfig)


def apply_risk(config: ReactiveConfig, risk: float) -> ReactiveConfig:
    """Return a copy of a configuration, which is for a risk of 0.5, for another trade-off of success rate and speed.

    The risk is a number from 0 (approaches slowly, and only objects at rest) to 1 (fastest).

    Raises:
        OptionError: `risk` is not a number from 0 to 1.
    """
    if isinstance(risk, bool) or not isinstance(risk, (int, float)) or not 0.0 <= risk <= 1.0:
        raise OptionError(f"risk must be a number from 0 to 1, got {risk!r}")
    # 1/4 at risk 0, 1 at 0.5 and 4 at 1.
    pace = 4.0 ** (2.0 * risk - 1.0)
    approach, retreat, selection, separation = config.approach, config.retreat, config.selection, config.separation
    return replace(
        config,
        approach=replace(
            approach,
            speed=pace * approach.speed,
            max_object_speed=pace * approach.max_object_speed,
            close_speed=pace * approach.close_speed,
            max_held_still_speed=pace * approach.max_held_still_speed,
            lateral_tolerance=approach.lateral_tolerance * max(1.0, pace) ** 0.5,
            rotation_tolerance=approach.rotation_tolerance * max(1.0, pace) ** 0.5,
        ),
        retreat=replace(retreat, speed=pace * retreat.speed, acceleration=pace * retreat.acceleration),
        separation=replace(
            separation,
            time_constant=separation.time_constant / pace,
            approach_time_constant=separation.approach_time_constant / pace,
        ),
        selection=replace(
            selection,
            clearance_cost=selection.clearance_cost / pace,
            partial_hold_cost=selection.partial_hold_cost / pace,
        ),
    )
