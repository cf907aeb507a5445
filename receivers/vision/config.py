"""Configuration of the receiver `vision`."""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

from handover_marl.config import CheckedConfig, bounded
from handover_marl.geometry.panda import PAD_DISTANCE
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.vision.finger_clearance import FingerGeometry
from handover_marl.receivers.vision.object_tracking import FilterGains

_NEVER = 1e6  # s, longer than any episode


@dataclass(frozen=True)
class GraspTrackerConfig(CheckedConfig):
    """Configuration of the tracker that turns point clouds into grasp candidates.

    Attributes:
        min_points: Minimum number of object points in a view; in views with fewer, the object counts as not visible.
        max_grasps: Maximum number of grasp candidates.
        min_quality: Minimum predicted quality of a grasp candidate, 0 to 1.
        cost_scale: Cost of a grasp whose predicted quality is 1/e (s).
        tilts: Rotations about the line between the pads of grasp copies that are added if no
            candidate is suitable (rad).
        tilt_cost: Additional cost of a tilted copy (s).
        pad_distance: Distance of the line between the pads from the origin of the hand link (m).
        fingers: Geometry and costs of finger collisions.
        n_finger_points: Number of object points that are checked for finger collisions.
        same_distance: Distance below which two grasps count as the same (m).
        rotation_weight: Weight of rotations in the distance of two grasps (m/rad).
        unseen_cost: Increase of the selected grasp's cost in each view in which the grasp is not predicted (s).
        failed_cost: Cost of a grasp that counts as the same as a failed one (s).
        far_gains: Filter gains while the object is far from the gripper.
        near_gains: Filter gains while the object is closer to the gripper than `near_distance`.
        final_gains: Filter gains while the selected grasp is closer to the gripper than `final_distance`.
        near_distance: Distance from the gripper below which the object hides the person's hand, so
            that no points are removed from the maps (m).
        final_distance: Distance of the selected grasp from the hand link at which `final_gains` apply (m).
        max_match_distance: Maximum distance of matched object points between two views (m).
        min_matched_share: Share of matched points below which registration has failed.
        keyframe_share: Share of matched points below which a new keyframe is taken.
        max_center_error: Largest distance between the tracked and the predicted center (m); with a
            larger distance, the tracked body counts as another body than the object.
        rest_speed: Speed below which the object is taken to be at rest (m/s).
        velocity_decay: Share of its estimated velocity that the object loses in each view in which it is not visible.
        lost_timeout: Time without a view of the object after which the tracker is reset (s).
        sphere_radius: Radius of the spheres that represent points of object and hand (m).
        voxel_size: Edge length of the voxels that keep one point each (m).
        hand_memory: Time after which points of the person's hand are removed (s).
        object_memory: Time after which points of the object are removed (s), shorter than for the
            hand since the object rotates while it is lifted.
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)
    any_length: ClassVar[frozenset[str]] = frozenset({"tilts"})

    min_points: int = 20
    max_grasps: int = bounded(48, 1)
    min_quality: float = bounded(0.02, 0.0, 1.0)
    cost_scale: float = 3.0
    tilts: tuple[float, ...] = (-0.35, 0.35, -0.7, 0.7)
    tilt_cost: float = 1.5
    pad_distance: float = PAD_DISTANCE
    fingers: FingerGeometry = field(default_factory=FingerGeometry)
    n_finger_points: int = bounded(400, 1)
    same_distance: float = 0.03
    rotation_weight: float = 0.06
    unseen_cost: float = 0.1
    failed_cost: float = 10.0
    far_gains: FilterGains = field(default_factory=lambda: FilterGains(0.5, 0.1, 0.4))
    near_gains: FilterGains = field(default_factory=lambda: FilterGains(0.9, 0.1, 0.1))
    final_gains: FilterGains = field(default_factory=lambda: FilterGains(0.9, 0.1, 0.02))
    near_distance: float = 0.3
    final_distance: float = 0.07
    max_match_distance: float = 0.03
    min_matched_share: float = bounded(0.3, 0.0, 1.0)
    keyframe_share: float = bounded(0.6, 0.0, 1.0)
    max_center_error: float = 0.05
    rest_speed: float = 0.04
    velocity_decay: float = bounded(0.4, 0.0, 1.0)
    lost_timeout: float = 0.12
    sphere_radius: float = bounded(0.01, 1e-6)
    voxel_size: float = bounded(0.012, 1e-6)
    hand_memory: float = 1.5
    object_memory: float = 0.4


@dataclass(frozen=True)
class VisionConfig(CheckedConfig):
    """Configuration of the perception of the receiver `vision`.

    Attributes:
        tracker: Configuration of the tracker of object, hand and grasps.
        search_timeout: Time out of sight after which the object is searched for (s).
        hidden_timeout: Value of `search_timeout` for an object that was at rest when it was last
            visible, in scenes with other objects, around which the paths are longer (s).
        finger_rest_distance: Finger motion between two decisions below which fingers are at rest (m).
        release_delay: Time for which the fingers rest before the person is assumed to have released the object (s).
        release_timeout: Time after the start of closing at which the person is assumed to have
            released the object, provided that the fingers are not fully closed (s).
        obstacle_voxel_size: Edge length of the voxels that keep one point each of the other objects (m).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    tracker: GraspTrackerConfig = field(default_factory=GraspTrackerConfig)
    search_timeout: float = 0.25
    hidden_timeout: float = 1.5
    finger_rest_distance: float = 0.0004
    release_delay: float = 0.15
    release_timeout: float = 0.5
    obstacle_voxel_size: float = bounded(0.025, 1e-6)


def make_vision_reactive_config() -> ReactiveConfig:
    """Return the configuration of grasp selection and motion of the receiver `vision`.

    The configuration differs from that of `reactive` for three reasons: camera images take longer than poses, predicted
    grasp qualities include the clearance to the person's hand, and the visible part of an object near the gripper does
    not determine its motion well enough to approach a moving object.
    """
    config = ReactiveConfig()
    return replace(
        config,
        near_period=0.05,
        selection=replace(
            config.selection,
            clearance_cost=10.0,
            min_clearance=0.0,
            hard_min_clearance=0.0,
            offset_delay=_NEVER,
        ),
        approach=replace(config.approach, max_object_speed=0.08, max_held_still_speed=0.15, close_period=0.05),
    )
