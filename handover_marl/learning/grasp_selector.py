"""Selection of the known grasp of lowest cost: near the gripper and clear of the person's hand.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

import functools

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, get_namespace, is_tensor
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.geometry.rotations import rotate_points
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.grasp_library import GraspTable, load_hand_poses

Array = npt.NDArray[np.float64]

#: Largest clearance that is computed: larger ones are set to this (m).
MAX_CLEARANCE = 0.2

#: Extent of the gripper along the hand link's z axis, from behind its palm to the fingertips (m).
BACK_Z, TIP_Z = -0.05, 0.11

# Number of grasps per episode whose clearance is computed first: those of lowest cost without it.
_FIRST_CANDIDATES = 24


class LowestCostGraspSelector:
    """Selector of the known grasp of lowest cost, for each of n episodes.

    The cost of a grasp (m) is the distance from the gripper's present position to the grasp, plus the weighted angle
    between both orientations, plus the weighted missing clearance to the person's hand. Inverse kinematics
    is not solved, so the grasp may be out of reach. Grasps rotated by half a turn about their z axis are candidates
    too. Selections are kept until the observation changes, since features and action schemes query the same ones.

    Args:
        context: Context of a policy, with the objects and their grasps.
        count: Number n of episodes.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.

    Attributes:
        rotation_weight: Weight of the gripper's rotation in the cost (m/rad).
        desired_clearance: Desired distance of the joints of the person's hand from the gripper's axis (m).
        clearance_weight: Weight of the amount by which the clearance is below the desired one.
    """

    rotation_weight = 0.25
    desired_clearance, clearance_weight = 0.09, 4.0

    def __init__(self, context: PolicyContext, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._count, self._arrays = count, arrays
        self._inputs: AnyArray | None = None
        self._selected, self._clearances = arrays.zeros((count, 7)), arrays.zeros(count)
        self._exists = arrays.zeros(count, "bool")
        # Grasps (c, g, 7) and their z axes (c, g, 3).
        self._table = GraspTable(functools.partial(load_known_grasps, context), arrays)

    def select(self, rows: AnyArray, observation: Observation) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Select a grasp of the object to hand over in each of r episodes.

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of their observations.

        Returns:
            World poses (r, 7) of the hand link at the grasps; distances (r,) in m of the person's hand from the
            gripper there, at most `MAX_CLEARANCE`; and whether a grasp of the object is known, (r,). Without a
            known grasp the other values have no meaning.
        """
        xp = self._arrays.xp
        inputs = xp.concat(
            [
                observation["gripper_pose"],
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
        object_poses = xp.astype(observation["object_poses"][known, 0], xp.float64)
        gripper = compose(invert_pose(object_poses), xp.astype(observation["gripper_pose"][known], xp.float64))
        index = index[known]
        grasps = self._table.arrays[0][index]
        costs = compute_motion_costs(grasps, gripper, self.rotation_weight)
        costs[~self._table.is_grasp[index]] = xp.inf
        joints = inverse_transform_points(object_poses[:, None], observation["hand_keypoints"][known])
        present = observation["hand_present"][known, 0] != 0.0
        best, clearances = self._find_best(costs, index, joints, present)
        self._selected[rows[known]] = compose(object_poses, grasps[self._arrays.arange(len(known)), best])
        self._clearances[rows[known]] = clearances

    def _find_best(
        self, costs: AnyArray, index: AnyArray, joints: AnyArray, present: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Return the index (r,) of the best grasp in each episode, and the clearance (r,) of the hand there (m).

        Clearances are computed for the grasps of lowest cost first. The others are not needed if the
        best of these costs less than any other grasp without its clearance.

        Args:
            costs: Costs (r, g) of g grasps without the clearance.
            index: Index (r,) of each object class in the table of grasps.
            joints: Joints (r, 16, 3) of the persons' hands in the objects' frames (m).
            present: Whether there is a person's hand, (r,).
        """
        xp, arrays, (count, number) = self._arrays.xp, self._arrays, costs.shape
        best, clearances = arrays.zeros(count, "int64"), arrays.zeros(count)
        left, candidates = arrays.arange(count), min(_FIRST_CANDIDATES, number)
        while len(left):
            order = _sort_by_cost(costs[left], min(candidates, number - 1))
            bound = xp.inf if candidates >= number else costs[left, order[:, candidates]]
            # Of equally good grasps, the first one counts.
            some = xp.sort(order[:, :candidates], axis=1, stable=False)
            origins, axes = (array[index[left, None], some] for array in self._table.arrays)
            distances = compute_clearances(origins, axes, joints[left])
            distances[~present[left]] = MAX_CLEARANCE
            missing = (self.desired_clearance - distances).clip(0.0)
            totals = costs[left[:, None], some] + self.clearance_weight * missing
            chosen = xp.argmin(totals, axis=1)
            place = arrays.arange(len(left))
            best[left], clearances[left] = some[place, chosen], distances[place, chosen]
            left = left[~(totals[place, chosen] < bound)]
            if candidates >= number:
                break
            candidates = number
        return best, clearances


def compute_motion_costs(grasps: AnyArray, gripper: AnyArray, rotation_weight: float) -> AnyArray:
    """Return the costs (r, g) in m of moving grippers (r, 7) to grasps (r, g, 7), both in the objects' frames."""
    xp = get_namespace(grasps)
    x, y, z, w = (grasps[..., 3 + axis] * gripper[:, None, 3 + axis] for axis in range(4))
    angles = 2.0 * xp.acos(xp.abs(x + y + z + w).clip(None, 1.0))
    x, y, z = (grasps[..., axis] - gripper[:, None, axis] for axis in range(3))
    return xp.sqrt(x * x + y * y + z * z) + rotation_weight * angles


def compute_clearances(origins: AnyArray, axes: AnyArray, joints: AnyArray) -> AnyArray:
    """Return the distances (r, k) in m of the nearest joint of a person's hand to the gripper's axis at k grasps.

    Args:
        origins: Positions (r, k, 3) of the hand link in the frames of the objects (m).
        axes: Directions (r, k, 3) of the hand link's z axes.
        joints: Joints (r, 16, 3) of the persons' hands (m).
    """
    xp = get_namespace(joints)
    x, y, z = (joints[:, None, :, axis] - origins[..., None, axis] for axis in range(3))
    u, v, w = (axes[..., None, axis] for axis in range(3))
    along = (x * u + y * v + z * w).clip(BACK_Z, TIP_Z)
    x, y, z = x - along * u, y - along * v, z - along * w
    return xp.sqrt(xp.min(x * x + y * y + z * z, axis=-1)).clip(None, MAX_CLEARANCE)


def _sort_by_cost(costs: AnyArray, place: int) -> AnyArray:
    """Return indices (r, g) that sort `costs` (r, g) partly: the first `place` ones have the lowest costs of a row."""
    return costs.argsort(dim=1) if is_tensor(costs) else np.argpartition(costs, place, axis=1)


@functools.lru_cache(maxsize=1024)
def load_known_grasps(context: PolicyContext, object_class: int) -> tuple[Array, Array] | None:
    """Return poses (n, 7) and z axes (n, 3) of the hand link at a class's grasps and their half turns, in its frame."""
    poses = load_hand_poses(context.grasps, context.object_names[object_class])
    if poses is None:
        return None
    poses = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
    return poses, rotate_points(poses[:, 3:], np.array([0.0, 0.0, 1.0]))
