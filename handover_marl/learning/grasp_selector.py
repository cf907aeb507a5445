"""Selection of a grasp in each of many episodes: near, clear of the person's hand, within reach, and firm.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

import functools

import numpy as np

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, get_namespace, is_tensor, widen
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.learning.grasp_costs import MAX_CLEARANCE, GraspCosts, load_validated_grasps
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.grasp_library import GraspTable

# Numbers of grasps per episode whose clearance, and then whose reach, is computed: those of lowest cost so far.
_N_CLEARANCES, _N_REACHES = 96, 12


class LowestCostGraspSelector:
    """Selector of the grasp of lowest cost, for each of n episodes.

    Candidates are the validated grasps of the receiver `reactive`, tilted copies and half turns. The cost of a grasp
    (m) is the sum of: the distance of the gripper from it; the weighted angle between their orientations; the weighted
    cost of a grasp that may not hold; the weighted missing clearance to the person's hand, which is larger if the
    gripper would touch the hand; and the weighted distance of the nearest pose that the arm can reach. The weights are
    those of `GraspCosts`. Selections are kept until the observation changes, since features and action schemes query
    the same ones.

    Args:
        context: Context of a policy, with the objects and their grasps.
        count: Number n of episodes.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.
    """

    def __init__(self, context: PolicyContext, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._count, self._arrays = count, arrays
        self._inputs: AnyArray | None = None
        self._selected, self._clearances = arrays.zeros((count, 7)), arrays.zeros(count)
        self._exists = arrays.zeros(count, "bool")
        # Grasps (c, g, 7) and their costs (c, g) in seconds.
        self._table = GraspTable(functools.partial(load_validated_grasps, context), arrays)
        self._costs = GraspCosts(context, arrays)

    def select(self, rows: AnyArray, observation: Observation) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Select a grasp of the object to hand over in each of r episodes.

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of their observations.

        Returns:
            World poses (r, 7) of the hand link at the grasps; distances (r,) in m of the person's hand from the
            gripper there and on its straight approach, at most `MAX_CLEARANCE`; and whether a grasp of the object is
            known, (r,). Without a known grasp the other values have no meaning.
        """
        xp = self._arrays.xp
        inputs = xp.concat(
            [
                observation["gripper_pose"],
                observation["robot_joint_position"][:, :ARM_DOF],
                observation["object_poses"][:, 0],
                observation["object_classes"][:, :1],
                observation["hand_present"],
                observation["hand_keypoints"].reshape(len(rows), -1),
            ],
            axis=1,
        )
        if self._inputs is None:
            shape = (self._count, inputs.shape[1])
            self._inputs = xp.full(shape, xp.nan, dtype=inputs.dtype, device=self._arrays.device)
        changed = xp.nonzero(xp.any(self._inputs[rows] != inputs, axis=1))[0]
        if len(changed):
            who = rows[changed]
            self._inputs[who] = inputs[changed]
            self._compute(who, {key: values[changed] for key, values in observation.items()})
        return self._selected[rows], self._clearances[rows], self._exists[rows]

    def _compute(self, rows: AnyArray, observation: Observation) -> None:
        xp = self._arrays.xp
        index = self._table.find(observation["object_classes"][:, 0])
        self._exists[rows] = index >= 0
        known = xp.nonzero(index >= 0)[0]
        if not len(known):
            return
        observation = {key: widen(values[known]) for key, values in observation.items()}
        objects = observation["object_poses"][:, 0]
        poses, clearances = self._find_best(index[known], objects, observation)
        self._selected[rows[known]] = compose(objects, poses)
        self._clearances[rows[known]] = clearances

    def _find_best(self, index: AnyArray, objects: AnyArray, observation: Observation) -> tuple[AnyArray, AnyArray]:
        """Return the best grasps (r, 7) in the objects' frames, and the clearances (r,) of the persons' hands there.

        Clearances are computed for the grasps of lowest cost, and the reach for those of lowest cost then, as far as it
        can change the choice.

        Args:
            index: Index (r,) of each object class in the table of grasps.
            objects: World poses (r, 7) of the objects.
            observation: Arrays (r, ...) of observations, float64.
        """
        xp, (poses, hold_costs) = self._arrays.xp, (array[index] for array in self._table.arrays)
        gripper = compose(invert_pose(objects), observation["gripper_pose"])
        costs = self._costs.compute_motion_costs(poses, gripper) + GraspCosts.hold_weight * hold_costs
        costs[~self._table.is_grasp[index]] = xp.inf
        poses, costs = _take_lowest(_N_CLEARANCES, costs, poses)
        joints = inverse_transform_points(objects[:, None], observation["hand_keypoints"])
        clearances = self._costs.compute_clearances(poses, joints)
        clearances[observation["hand_present"][:, 0] == 0.0] = MAX_CLEARANCE
        costs = costs + self._costs.compute_clearance_costs(clearances)
        poses, clearances, costs = _take_lowest(_N_REACHES, costs, poses, clearances)
        place, first = self._arrays.arange(len(costs)), xp.argmin(costs, axis=1)
        robots = observation["robot_joint_position"]
        lowest = costs[place, first] + self._compute_reach_costs(poses[place, first], objects, robots)
        costs[place, first] = xp.inf
        # The reach matters only for grasps that may still cost less than the first one.
        rows, columns = xp.nonzero(costs <= lowest[:, None])
        costs[rows, columns] += self._compute_reach_costs(poses[rows, columns], objects[rows], robots[rows])
        costs[place, first] = lowest
        best = xp.argmin(costs, axis=1)
        return poses[place, best], clearances[place, best]

    def _compute_reach_costs(self, grasps: AnyArray, objects: AnyArray, robots: AnyArray) -> AnyArray:
        """Return the costs (m,) of the reach of grasps (m, 7) of objects (m, 7) for robots with joints (m, 9)."""
        distances = self._costs.compute_reach_distances(compose(objects, grasps)[:, None], robots)
        return self._costs.compute_reach_costs(distances)[:, 0]


def _take_lowest(count: int, costs: AnyArray, *arrays: AnyArray) -> tuple[AnyArray, ...]:
    """Return the columns of arrays (r, g, ...) with the `count` lowest costs (r, g) of each row, the costs last.

    The order of the columns remains, so that of equal costs the first one counts.
    """
    if costs.shape[1] > count:
        xp = get_namespace(costs)
        order = costs.argsort(dim=1) if is_tensor(costs) else np.argpartition(costs, count, axis=1)
        columns = xp.sort(order[:, :count], axis=1, stable=False)
        rows = xp.arange(len(costs), device=costs.device)[:, None]
        arrays, costs = tuple(array[rows, columns] for array in arrays), costs[rows, columns]
    return *arrays, costs
