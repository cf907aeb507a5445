"""Selection of the nearest known grasp in many episodes at once.

Poses are those of the hand link, position (m) and quaternion xyzw.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.receivers.grasp_library import BACK_Z, MAX_CLEARANCE, TIP_Z, GraspTable, NearestGraspSelector

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int_]

# Number of grasps per episode whose clearance is computed first: those of lowest cost without it.
_FIRST_CANDIDATES = 24


class GraspSelectionBatch:
    """Selector of the grasp that is nearest to the gripper, for each of n episodes.

    It selects what `NearestGraspSelector` selects; selections are cached until the observation
    changes, since features and action schemes query the same ones.

    Args:
        selector: Selector of single episodes, with the weights of the cost and the known grasps.
        count: Number n of episodes.
    """

    def __init__(self, selector: NearestGraspSelector, count: int) -> None:
        self._selector = selector
        self._inputs: Array | None = None
        self._selected, self._clearances = np.zeros((count, 7)), np.zeros(count)
        self._exists = np.zeros(count, dtype=bool)
        self._count = count
        # Grasps (c, g, 7) and their z axes (c, g, 3).
        self._table = GraspTable(selector.load_known)

    def select(self, rows: Rows, observation: Observation) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Select a grasp of the object to hand over in episodes.

        Args:
            rows: Indices (r,) of the episodes.
            observation: Arrays (r, ...) of their observations.

        Returns:
            World poses (r, 7) of the hand link at the grasps; distances (r,) of the person's hand
            from the gripper there (m); and whether there is a grasp, (r,).
        """
        inputs = np.concatenate(
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
            self._inputs = np.full((self._count, inputs.shape[1]), np.nan)
        changed = np.flatnonzero((self._inputs[rows] != inputs).any(axis=1))
        if len(changed):
            who = rows[changed]
            self._inputs[who] = inputs[changed]
            self._compute(who, {key: values[changed] for key, values in observation.items()})
        return self._selected[rows], self._clearances[rows], self._exists[rows]

    def _compute(self, rows: Rows, observation: Observation) -> None:
        index = self._table.find(observation["object_classes"][:, 0])
        self._exists[rows] = index >= 0
        known = np.flatnonzero(index >= 0)
        if not len(known):
            return
        item = observation["object_poses"][known, 0].astype(np.float64)
        gripper = compose(invert_pose(item), observation["gripper_pose"][known].astype(np.float64))
        index = index[known]
        grasps = self._table.arrays[0][index]
        costs = self._compute_motion_costs(grasps, gripper)
        costs[~self._table.is_grasp[index]] = np.inf
        joints = inverse_transform_points(item[:, None], observation["hand_keypoints"][known])
        present = observation["hand_present"][known, 0] != 0.0
        best, clearances = self._find_best(costs, index, joints, present)
        self._selected[rows[known]] = compose(item, grasps[np.arange(len(known)), best])
        self._clearances[rows[known]] = clearances

    def _compute_motion_costs(self, grasps: Array, gripper: Array) -> Array:
        """Return the costs (r, g) of the gripper's motions to grasps (r, g, 7), all in the object's frame."""
        x, y, z, w = (grasps[..., 3 + axis] * gripper[:, None, 3 + axis] for axis in range(4))
        angles = 2.0 * np.arccos(np.minimum(np.abs(x + y + z + w), 1.0))
        x, y, z = (grasps[..., axis] - gripper[:, None, axis] for axis in range(3))
        costs: Array = np.sqrt(x * x + y * y + z * z) + self._selector.rotation_weight * angles
        return costs

    def _find_best(
        self, costs: Array, index: Rows, joints: Array, present: npt.NDArray[np.bool_]
    ) -> tuple[Rows, Array]:
        """Return the best grasp (r,) of each episode and the person's clearance there.

        Clearances are computed for the grasps of lowest cost first. The others are not needed if the
        best of these costs less than any other grasp without its clearance.

        Args:
            costs: Costs (r, g) without the clearance.
            index: Index (r,) of each object class.
            joints: Joints (r, 16, 3) of the persons' hands in the objects' frames (m).
            present: Whether there is a hand, (r,).
        """
        count, number = costs.shape
        best, clearances = np.zeros(count, dtype=np.int_), np.zeros(count)
        left, candidates = np.arange(count), min(_FIRST_CANDIDATES, number)
        while len(left):
            order = np.argpartition(costs[left], min(candidates, number - 1), axis=1)
            bound = np.inf if candidates >= number else costs[left, order[:, candidates]]
            # Of equally good grasps, the first one counts.
            some = np.sort(order[:, :candidates], axis=1)
            distances = self._compute_clearances(index[left], some, joints[left])
            distances[~present[left]] = MAX_CLEARANCE
            missing = np.maximum(0.0, self._selector.desired_clearance - distances)
            totals = costs[left[:, None], some] + self._selector.clearance_weight * missing
            chosen = totals.argmin(axis=1)
            place = np.arange(len(left))
            best[left], clearances[left] = some[place, chosen], distances[place, chosen]
            left = left[~(totals[place, chosen] < bound)]
            if candidates >= number:
                break
            candidates = number
        return best, clearances

    def _compute_clearances(self, index: Rows, grasps: Rows, joints: Array) -> Array:
        """Return the smallest distances (r, k) in m of hand joints to the gripper's axis at k grasps."""
        origins, axes = (array[index[:, None], grasps] for array in self._table.arrays)
        x, y, z = (joints[:, None, :, axis] - origins[..., None, axis] for axis in range(3))
        u, v, w = (axes[..., None, axis] for axis in range(3))
        along = np.clip(x * u + y * v + z * w, BACK_Z, TIP_Z)
        x, y, z = x - along * u, y - along * v, z - along * w
        clearances: Array = np.minimum(np.sqrt((x * x + y * y + z * z).min(axis=-1)), MAX_CLEARANCE)
        return clearances
