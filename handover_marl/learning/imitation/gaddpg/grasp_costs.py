"""Grasps that are goals of the imitation expert, and their costs."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose
from handover_marl.planning.clearance import Spheres, compute_grasp_clearances, compute_gripper_corners
from handover_marl.planning.goal_set import is_usable_grasp
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.reactive.config import GraspSelectorConfig, ReactiveConfig
from handover_marl.receivers.reactive.grasp_contact import compute_hold_costs, load_graspable_object
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig

Array = npt.NDArray[np.float64]

#: Distance of the point between the pads from the hand link's origin along its z axis (m).
PAD_OFFSET = 0.1
#: Cost of a rotation of the hand relative to that of the pads' travel (m/rad).
ROTATION_COST = 0.15


@dataclass(frozen=True)
class GraspCostConfig:
    """Configuration of grasp costs, in metres of travel of the gripper's pads.

    Attributes:
        validated: Whether grasps are validated and improved in simulation first (20 to 90 s per
            object, once); otherwise the known grasps are used unchanged.
        validation: Configuration of the validation.
        pad_offset: Distance from the hand's origin to the finger pads, whose travel is the cost of
            a motion (m).
        rotation_cost: Cost of a rotation of the hand (m/rad).
        hold: Costs of grasps that hold the object loosely, as for the receiver `reactive` (s).
        pace: Factor that converts the costs `hold` from seconds to metres (m/s).
        clearance: Clearance of the gripper to the occluding sphere below which grasps cost more (m).
        sweep: Length of the straight approach to the grasp, on which `clearance` is required too (m).
        clearance_cost: Cost per metre by which the clearance to the sphere is below `clearance`.
        table_clearance: Clearance of the gripper to the table below which grasps cost more (m).
        table_cost: Additional cost of a grasp whose clearance to the table is below
            `table_clearance` (m).
    """

    validated: bool = True
    validation: GraspPreparationConfig = field(default_factory=GraspPreparationConfig)
    pad_offset: float = PAD_OFFSET
    rotation_cost: float = ROTATION_COST
    hold: GraspSelectorConfig = field(default_factory=GraspSelectorConfig)
    pace: float = 0.1
    clearance: float = 0.01
    sweep: float = 0.08
    clearance_cost: float = 20.0
    table_clearance: float = 0.005
    table_cost: float = 3.0


@dataclass(frozen=True, eq=False)
class CostedGrasps:
    """Grasps of one object, and the same grasps rotated by half a turn about the hand's z axis.

    Attributes:
        poses: (n, 7) poses of the hand link in the object's frame, quaternion xyzw.
        costs: (n,) costs of the grasps, higher the less likely a grasp holds the object (m).
    """

    poses: Array
    costs: Array


class GraspCostTable:
    """Table of the grasps of each object class and of their costs.

    Args:
        context: Known grasps of the objects, and the robot with which they are validated.
        config: Configuration of the costs.
    """

    def __init__(self, context: PolicyContext, config: GraspCostConfig) -> None:
        self._context, self._config = context, config

    def load_grasps(self, object_name: str) -> CostedGrasps | None:
        """Return the usable grasps of an object class and their costs, or None if there are none.

        Raises:
            SimulationError: The object's model cannot be loaded.
        """
        config = self._config
        surface = ReactiveConfig(
            preparation=config.validation, n_surface_spheres=150, surface_radius=0.004, n_surface_points=2000
        )
        found = load_graspable_object(self._context, object_name, surface, config.validated)
        kept = is_usable_grasp(object_name, compose(found.grasps.poses, np.array(HALF_TURN))) | config.validated
        poses = found.grasps.poses[kept]
        if not len(poses):
            return None
        costs = config.pace * compute_hold_costs(found.grasps.select(kept), found.pad_margins[kept], config.hold)
        both = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
        return CostedGrasps(both, np.concatenate([costs, costs]))

    def compute_costs(self, grasps: CostedGrasps, world: Array, hand: Array, occluder: Array) -> Array:
        """Return the total costs (n,) of n grasps (m), including the motion of the hand to them.

        Args:
            grasps: Grasps of the object.
            world: (n, 7) world poses of the hand link at these grasps.
            hand: (7,) present world pose of the hand link.
            occluder: (4,) world center and radius of the occluding sphere (m); radius 0 for none.
        """
        config = self._config
        costs: Array = grasps.costs + compute_travel_costs(hand, world, config.pad_offset, config.rotation_cost)
        behind = compose(world, np.array([0.0, 0.0, -config.sweep, 0.0, 0.0, 0.0, 1.0]))
        heights = np.minimum(*(compute_gripper_corners(poses)[..., 2].min(axis=1) for poses in (world, behind)))
        costs += config.table_cost * (heights < TABLE_HEIGHT + config.table_clearance)
        if occluder[3] > 0.0:
            clearances = compute_grasp_clearances(world, Spheres(occluder[None, :3], occluder[3:]), config.sweep)
            costs += config.clearance_cost * np.maximum(0.0, config.clearance - clearances)
        return costs


def compute_travel_costs(
    hand: Array, goals: Array, pad_offset: float = PAD_OFFSET, rotation_cost: float = ROTATION_COST
) -> Array:
    """Return the costs (n,) in m of moving the hand to each of n goals.

    A cost is the distance that the finger pads travel plus the weighted rotation of the hand.

    Args:
        hand: (7,) present pose of the hand link.
        goals: (n, 7) poses of the hand link at the goals, in the same frame.
        pad_offset: Distance from the hand's origin to the finger pads (m).
        rotation_cost: Weight of the rotation (m/rad).
    """
    to_pads = np.array([0.0, 0.0, pad_offset, 0.0, 0.0, 0.0, 1.0])
    distances = np.linalg.norm(compose(goals, to_pads)[:, :3] - compose(hand, to_pads)[:3], axis=1)
    angles = (Rotation.from_quat(hand[3:]).inv() * Rotation.from_quat(goals[:, 3:])).magnitude()
    costs: Array = distances + rotation_cost * angles
    return costs
