"""Selection of a grasp in each of many episodes: near, clear of the person's hand, within reach, and firm.

A grasp is a pose (7,) of the Panda's hand link: position (m) and quaternion xyzw. Costs are in meters, lower is better.
"""

import functools

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics, solve_damped
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, get_namespace, is_tensor, to_float64
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HALF_TURN, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.geometry.rotations import (
    conjugate_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    quaternions_from_matrices,
    rotation_vectors_from_quaternions,
)
from handover_marl.geometry.vectors import compute_box_distances, compute_lengths, limit_lengths
from handover_marl.grasps.graspable_object import compute_hold_costs, load_graspable_object
from handover_marl.grasps.known_grasps import GraspTable
from handover_marl.planning.robot_clearance import CLOSING_BOX, GRIPPER_BOX_CENTERS, GRIPPER_BOX_HALF_SIZES
from handover_marl.policies.policy import PolicyContext

Array = npt.NDArray[np.float64]

#: Largest clearance that is computed: larger ones are set to this (m).
MAX_CLEARANCE = 0.2

# Radius of a person's finger around its joints (m), and length of the straight approach that must be clear (m).
_FINGER_RADIUS, _APPROACH = 0.012, 0.08
# Boxes in the hand link's frame that the gripper sweeps: the hand body on its approach, and the fingers as they close.
_SHIFT = np.array([0.0, 0.0, 0.5 * _APPROACH])
_BOXES = ((GRIPPER_BOX_CENTERS[0] - _SHIFT, GRIPPER_BOX_HALF_SIZES[0] + _SHIFT), CLOSING_BOX)

# Iterations of inverse kinematics, its damping, and the largest translation (m) and rotation (rad) of one.
_N_ITERATIONS, _DAMPING, _MAX_TRANSLATION, _MAX_ROTATION = 10, 0.05, 0.3, 1.2
# Amount by which joint limits are narrowed (rad), weight of a rotation that remains (m/rad), and largest distance from
# a reachable pose that counts: larger ones cost the same (m).
_LIMIT_PADDING, _ERROR_ROTATION_WEIGHT, MAX_REACH_DISTANCE = 0.03, 0.1, 0.3
# Numbers of grasps per episode whose clearance, and then whose reach, is computed: those of lowest cost so far.
_N_CLEARANCES, _N_REACHES = 96, 12


class GraspCosts:
    """Cost function of grasps of objects in r episodes, and the distances on which the costs depend.

    Args:
        context: Context of a policy, with the robot.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.

    Attributes:
        rotation_weight: Weight of the gripper's rotation in the cost of its motion (m/rad).
        hold_weight: Weight (m/s) of the hold cost (s), which is high for grasps from which the object may slip.
        desired_clearance: Desired distance of the person's fingers from the gripper on its approach (m).
        clearance_weight: Weight of the amount by which the clearance is below the desired one.
        min_clearance, contact_cost: Clearance below which a grasp costs more (m), and this additional cost (m).
        reach_weight: Weight of the distance between the grasp and the nearest pose that the arm can reach.
        reach_tolerance, unreachable_cost: Such a distance above which a grasp costs more (m), and this cost (m).
    """

    rotation_weight, hold_weight = 0.25, 0.1
    desired_clearance, clearance_weight = 0.03, 10.0
    min_clearance, contact_cost = 0.003, 5.0
    reach_weight, reach_tolerance, unreachable_cost = 3.0, 0.01, 0.3

    def __init__(self, context: PolicyContext, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._xp = arrays.xp
        base = np.array([*context.panda.base_position, *context.panda.base_orientation])
        self._base_from_world = arrays.asarray(invert_pose(base))
        self._arm = ArmKinematics(read_tree(context.panda_urdf))
        self._boxes = [(arrays.asarray(center), arrays.asarray(half)) for center, half in _BOXES]
        self._low = arrays.asarray(np.array(LOWER_LIMITS[:ARM_DOF]) + _LIMIT_PADDING)
        self._high = arrays.asarray(np.array(UPPER_LIMITS[:ARM_DOF]) - _LIMIT_PADDING)

    def compute_motion_costs(self, grasps: AnyArray, gripper: AnyArray) -> AnyArray:
        """Return the costs (r, g) in m of moving grippers (r, 7) to grasps (r, g, 7), both in the objects' frames."""
        xp = self._xp
        x, y, z, w = (grasps[..., 3 + axis] * gripper[:, None, 3 + axis] for axis in range(4))
        angles = 2.0 * xp.acos(xp.abs(x + y + z + w).clip(None, 1.0))
        x, y, z = (grasps[..., axis] - gripper[:, None, axis] for axis in range(3))
        return xp.sqrt(x * x + y * y + z * z) + self.rotation_weight * angles

    def compute_clearance_costs(self, clearances: AnyArray) -> AnyArray:
        """Return the costs (...) in m of clearances (...) in m, see `compute_clearances`."""
        costs = self.clearance_weight * (self.desired_clearance - clearances).clip(0.0)
        return costs + self.contact_cost * to_float64(clearances < self.min_clearance)

    def compute_reach_costs(self, distances: AnyArray) -> AnyArray:
        """Return the costs (...) in m of distances (...) in m from reachable poses, see `compute_reach_distances`."""
        costs = self.reach_weight * distances.clip(None, MAX_REACH_DISTANCE)
        return costs + self.unreachable_cost * to_float64(distances > self.reach_tolerance)

    def compute_clearances(self, poses: AnyArray, joints: AnyArray) -> AnyArray:
        """Return clearances (r, k) in m: distances of human hands from the gripper at k grasps and on its way there.

        The way is a straight approach of 8 cm. Clearances are negative in penetration, and at most `MAX_CLEARANCE`.
        Grasps `poses` (r, k, 7) and positions `joints` (r, 16, 3) of the hands' joints are in the objects' frames.
        """
        xp = self._xp
        points = inverse_transform_points(poses[:, :, None], joints[:, None])
        distances = [xp.min(compute_box_distances(points - center, half), axis=2) for center, half in self._boxes]
        return (xp.minimum(*distances) - _FINGER_RADIUS).clip(None, MAX_CLEARANCE)

    def compute_reach_distances(self, poses: AnyArray, joints: AnyArray) -> AnyArray:
        """Return the distances (r, k) in m of world poses (r, k, 7) from the nearest poses that the arms reach.

        Inverse kinematics starts at the robots' joints (r, 9), so that other configurations of the elbow are not found.
        A remaining angle to the pose counts as 0.1 m per rad.
        """
        xp, (count, number) = self._xp, poses.shape[:2]
        target = compose(self._base_from_world, poses.reshape(count * number, 7))
        angles = xp.repeat(joints[:, :ARM_DOF], number, axis=0)
        for iteration in range(_N_ITERATIONS + 1):
            jacobian, position, axes = self._arm.compute_hand_jacobians(angles)
            inverse = conjugate_quaternions(quaternions_from_matrices(axes))
            rotation = rotation_vectors_from_quaternions(
                multiply_quaternions(inverse, normalize_quaternions(target[:, 3:]))
            )
            translation = target[:, :3] - position
            if iteration == _N_ITERATIONS:
                break
            rotation = xp.sum(axes * limit_lengths(rotation, _MAX_ROTATION)[:, None], axis=2)
            twist = xp.concat([limit_lengths(translation, _MAX_TRANSLATION), rotation], axis=1)
            angles = (angles + solve_damped(jacobian, twist, _DAMPING)).clip(self._low, self._high)
        errors = compute_lengths(translation) + _ERROR_ROTATION_WEIGHT * compute_lengths(rotation)
        return errors.reshape(count, number)


@functools.lru_cache(maxsize=1024)
def load_validated_grasps(context: PolicyContext, object_class: int) -> tuple[Array, Array] | None:
    """Return the validated grasps of an object class and their hold costs; None if it has no grasps.

    Grasps are poses (n, 7) in the object's frame; the second half is the first one turned by 180 degrees about the
    approach axis. Hold costs (n,) in s are higher for grasps from which the object may slip. The validation in
    simulation takes minutes the first time for an object of the user.
    """
    graspable = load_graspable_object(context, context.object_names[object_class])
    if not len(graspable.grasps.poses):
        return None
    costs = compute_hold_costs(graspable.grasps, graspable.pad_margins)
    poses = graspable.grasps.poses
    return np.concatenate([poses, compose(poses, np.array(HALF_TURN))]), np.concatenate([costs, costs])


class LowestCostGraspSelector:
    """Selector of the grasp of lowest cost, for each of n episodes.

    Candidates are the validated grasps of the receiver `reactive`, which include tilted copies, and each of them turned
    by 180 degrees about its approach axis. The cost of a grasp (m) is the sum of: the distance of the gripper from it;
    the weighted angle between their orientations; the weighted hold cost, high if the object may slip; the weighted
    missing clearance to the person's hand, plus a fixed cost if the gripper would touch the hand; and the weighted
    distance of the nearest pose that the arm can reach, plus a fixed cost above a tolerance. `GraspCosts` has the
    weights. A selection is cached until the observation changes, because features and action schemes both request it.

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
        """Select a grasp of the object to hand over in each of the r episodes `rows`, from observations (r, ...).

        Returns:
            World poses (r, 7) of the hand link at the grasps; clearances (r,) in m between the person's hand and the
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
        observation = {key: to_float64(values[known]) for key, values in observation.items()}
        objects = observation["object_poses"][:, 0]
        poses, clearances = self._find_best(index[known], objects, observation)
        self._selected[rows[known]] = compose(objects, poses)
        self._clearances[rows[known]] = clearances

    def _find_best(self, index: AnyArray, objects: AnyArray, observation: Observation) -> tuple[AnyArray, AnyArray]:
        """Return the best grasps (r, 7) in the objects' frames, and their clearances (r,) in m to the persons' hands.

        Clearances are computed only for the `_N_CLEARANCES` grasps of lowest motion and hold cost, and reach costs only
        for those of the best `_N_REACHES` of them that could still be chosen.

        Args:
            index: Index (r,) of each object's class in the table of grasps.
            objects: World poses (r, 7) of the objects.
            observation: Arrays (r, ...) of observations, float64.
        """
        xp, (poses, hold_costs) = self._arrays.xp, (array[index] for array in self._table.arrays)
        gripper = compose(invert_pose(objects), observation["gripper_pose"])
        costs = self._costs.compute_motion_costs(poses, gripper) + GraspCosts.hold_weight * hold_costs
        costs[~self._table.is_grasp[index]] = xp.inf
        poses, costs = _select_lowest(_N_CLEARANCES, costs, poses)
        joints = inverse_transform_points(objects[:, None], observation["hand_keypoints"])
        clearances = self._costs.compute_clearances(poses, joints)
        clearances[observation["hand_present"][:, 0] == 0.0] = MAX_CLEARANCE
        costs = costs + self._costs.compute_clearance_costs(clearances)
        poses, clearances, costs = _select_lowest(_N_REACHES, costs, poses, clearances)
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
        """Return reach costs (k,) in m of one grasp (k, 7) on each of k objects (k, 7), for robot joints (k, 9)."""
        distances = self._costs.compute_reach_distances(compose(objects, grasps)[:, None], robots)
        return self._costs.compute_reach_costs(distances)[:, 0]


def _select_lowest(count: int, costs: AnyArray, *arrays: AnyArray) -> tuple[AnyArray, ...]:
    """Select from arrays (r, g, ...) the `count` entries of lowest cost (r, g) in each row; return also their costs.

    The costs are last. The order of the entries remains, so that `argmin` finds the first of equal costs.
    """
    if costs.shape[1] > count:
        xp = get_namespace(costs)
        order = costs.argsort(dim=1) if is_tensor(costs) else np.argpartition(costs, count, axis=1)
        columns = xp.sort(order[:, :count], axis=1, stable=False)
        rows = xp.arange(len(costs), device=costs.device)[:, None]
        arrays, costs = tuple(array[rows, columns] for array in arrays), costs[rows, columns]
    return *arrays, costs
