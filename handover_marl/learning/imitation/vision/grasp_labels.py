"""Qualities of known grasps next to a person's hand, the targets of the grasp network.

The quality follows from the grasp cost of the receiver `reactive` without the terms that depend on
the arm: whether the grasp held in simulation, how well the pads enclose the object, and the
clearance to the hand. Next to a hand, offset copies of the grasps are candidates too.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from handover_marl.planning.clearance import Spheres, compute_grasp_clearances
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasp_contact import compute_hold_costs, find_offset_grasps, load_graspable_object

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GraspLabelConfig:
    """Configuration of the conversion of grasp costs into qualities.

    Attributes:
        scale: Cost of a grasp at which its quality is 1/e (s).
        min_clearance: Clearance of the gripper to the person's hand below which a grasp's quality is
            0 (m).
        min_quality: Quality below which a grasp is not a target of the network.
        max_offset_grasps: Largest number of shifted copies of grasps that are added next to a hand.
        receiver: Configuration of the receiver `reactive`, whose costs of grasps are used.
    """

    scale: float = 3.0
    min_clearance: float = 0.003
    min_quality: float = 0.02
    max_offset_grasps: int = 120
    receiver: ReactiveConfig = field(default_factory=ReactiveConfig)


@dataclass(frozen=True, eq=False)
class LabelledGrasps:
    """Grasps of one object with their costs, in the object's frame.

    Attributes:
        poses: (n, 7) poses of the hand link.
        costs: (n,) costs of the grasps if no hand is nearby (s).
        object_center: (3,) center of the object's bounding box (m).
    """

    poses: Array
    costs: Array
    object_center: Array


class GraspLabeller:
    """Labeller that rates the grasps of objects with qualities from 0 (bad) to 1 (good).

    Grasps are validated in simulation at first use.

    Args:
        context: Robot, objects and their known grasps.
        config: Conversion of costs into qualities.
    """

    def __init__(self, context: PolicyContext, config: GraspLabelConfig = GraspLabelConfig()) -> None:
        self._context, self.config = context, config

    def load_grasps(self, object_name: str) -> LabelledGrasps:
        """Return the grasps of an object class and their costs; no grasps if none are known.

        Raises:
            DataNotFoundError: Files of the object do not exist.
            SimulationError: The object's model cannot be loaded.
        """
        config = self.config.receiver
        found = load_graspable_object(self._context, object_name, config)
        costs = compute_hold_costs(found.grasps, found.pad_margins, config.selection)
        return LabelledGrasps(found.grasps.poses, costs, found.center)

    def load_grasps_near_hand(self, object_name: str, hand: Spheres | None, object_pose: Array) -> LabelledGrasps:
        """Return an object's grasps, and shifted copies of them that are clear of the person's hand.

        Args:
            object_name: Class of the object.
            hand: Spheres that cover the person's hand in the world; None adds no copies.
            object_pose: (7,) pose of the object in the world, quaternion xyzw.
        """
        known, config = self.load_grasps(object_name), self.config.receiver
        if hand is None or not len(known.poses):
            return known
        hand_in_object = hand.transform_to_frame(object_pose)
        found = load_graspable_object(self._context, object_name, config)
        offset, margins = find_offset_grasps(found, hand_in_object, config)
        costs = config.selection.offset_cost + compute_hold_costs(offset, margins, config.selection)
        clearances = compute_grasp_clearances(offset.poses, hand_in_object, config.approach.standoff)
        kept = np.flatnonzero(self._qualities(costs, clearances) > self.config.min_quality)
        kept = kept[:: max(1, -(-len(kept) // self.config.max_offset_grasps))]
        poses, costs = np.concatenate([known.poses, offset.poses[kept]]), np.concatenate([known.costs, costs[kept]])
        return LabelledGrasps(poses, costs, known.object_center)

    def compute_qualities(self, known: LabelledGrasps, hand: Spheres | None, object_pose: Array) -> Array:
        """Return the qualities (n,), from 0 to 1, of an object's grasps next to a hand.

        Args:
            known: Grasps of the object.
            hand: Spheres that cover the person's hand in the world, or None without a hand.
            object_pose: (7,) pose of the object in the world, quaternion xyzw.
        """
        if hand is None or not len(known.poses):
            return np.exp(-known.costs / self.config.scale)
        standoff = self.config.receiver.approach.standoff
        return self._qualities(
            known.costs, compute_grasp_clearances(known.poses, hand.transform_to_frame(object_pose), standoff)
        )

    def _qualities(self, costs: Array, clearances: Array) -> Array:
        """Return qualities (n,) for costs without a hand (n,) and clearances to a hand (n,)."""
        config = self.config.receiver.selection
        costs = costs + config.clearance_cost * np.maximum(0.0, config.desired_clearance - clearances)
        return np.where(clearances < self.config.min_clearance, 0.0, np.exp(-costs / self.config.scale))
