"""Grasps that are goals of the imitation expert, and their costs."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose
from handover_marl.planning.clearance import Spheres, compute_grasp_clearances, compute_gripper_corners
from handover_marl.planning.goal_set import is_usable_grasp
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasp_contact import compute_hold_costs, load_graspable_object

Array = npt.NDArray[np.float64]

#: Distance of the point between the pads from the hand link's origin along its z axis (m).
PAD_OFFSET = 0.1
#: Cost of a rotation of the hand relative to that of the pads' travel (m/rad).
ROTATION_COST = 0.15


# Factor that converts costs of loose grasps, as for the receiver `reactive`, from seconds to metres (m/s).
_PACE = 0.1
# Clearance of the gripper to the occluding sphere below which grasps cost more (m), at the grasp and on the straight
# approach of a given length (m), and the cost per metre below it.
_CLEARANCE, _SWEEP, _CLEARANCE_COST = 0.01, 0.08, 20.0
# Clearance of the gripper to the table below which a grasp has an additional cost (m), and this cost (m).
_TABLE_CLEARANCE, _TABLE_COST = 0.005, 3.0


@dataclass(frozen=True, eq=False)
class CostedGrasps:
    """Grasps of one object, and the same grasps rotated by half a turn about the hand's z axis.

    Attributes:
        poses: (n, 7) poses of the hand link in the object's frame, quaternion xyzw.
        costs: (n,) costs of the grasps, higher the less likely a grasp holds the object (m).
    """

    poses: Array
    costs: Array


def load_costed_grasps(context: PolicyContext, object_name: str, is_validated: bool) -> CostedGrasps | None:
    """Return the usable grasps of an object class and their costs, or None if there are none.

    Args:
        context: Known grasps of the objects, and the robot with which they are validated.
        object_name: Class of the object.
        is_validated: Whether grasps are validated and improved in simulation first (20 to 90 s per object, once);
            otherwise the known grasps are used unchanged.

    Raises:
        SimulationError: The object's model cannot be loaded.
    """
    surface = ReactiveConfig(n_surface_spheres=150, surface_radius=0.004, n_surface_points=2000)
    found = load_graspable_object(context, object_name, surface, is_validated)
    kept = is_usable_grasp(object_name, compose(found.grasps.poses, np.array(HALF_TURN))) | is_validated
    poses = found.grasps.poses[kept]
    if not len(poses):
        return None
    costs = _PACE * compute_hold_costs(found.grasps.select(kept), found.pad_margins[kept], surface.selection)
    both = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
    return CostedGrasps(both, np.concatenate([costs, costs]))


def compute_grasp_costs(grasps: CostedGrasps, world: Array, hand: Array, occluder: Array) -> Array:
    """Return the costs (n,) in m of moving the hand to n grasps and of the grasps themselves.

    Args:
        grasps: Grasps of the object.
        world: (n, 7) world poses of the hand link at these grasps.
        hand: (7,) present world pose of the hand link.
        occluder: (4,) world center and radius of the occluding sphere (m); radius 0 for none.
    """
    costs: Array = grasps.costs + compute_travel_costs(hand, world)
    behind = compose(world, np.array([0.0, 0.0, -_SWEEP, 0.0, 0.0, 0.0, 1.0]))
    heights = np.minimum(*(compute_gripper_corners(poses)[..., 2].min(axis=1) for poses in (world, behind)))
    costs += _TABLE_COST * (heights < TABLE_HEIGHT + _TABLE_CLEARANCE)
    if occluder[3] > 0.0:
        clearances = compute_grasp_clearances(world, Spheres(occluder[None, :3], occluder[3:]), _SWEEP)
        costs += _CLEARANCE_COST * np.maximum(0.0, _CLEARANCE - clearances)
    return costs


def compute_travel_costs(hand: Array, goals: Array) -> Array:
    """Return the costs (n,) in m of moving the hand to each of n goals.

    A cost is the distance that the finger pads travel plus the weighted rotation of the hand.

    Args:
        hand: (7,) present pose of the hand link.
        goals: (n, 7) poses of the hand link at the goals, in the same frame.
    """
    to_pads = np.array([0.0, 0.0, PAD_OFFSET, 0.0, 0.0, 0.0, 1.0])
    distances = np.linalg.norm(compose(goals, to_pads)[:, :3] - compose(hand, to_pads)[:3], axis=1)
    angles = (Rotation.from_quat(hand[3:]).inv() * Rotation.from_quat(goals[:, 3:])).magnitude()
    costs: Array = distances + ROTATION_COST * angles
    return costs
