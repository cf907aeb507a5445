"""Inverse kinematics of candidate grasps, and costs of the resulting arm configurations."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import TABLE_HEIGHT
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.geometry.poses import compose
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.clearance import Spheres, compute_arm_clearances, compute_lowest_heights
from handover_marl.receivers.reactive.config import GraspSelectorConfig

Array = npt.NDArray[np.float64]

HOME = np.array(WAITING_JOINTS[:7])
#: Configurations at which inverse kinematics starts: a greedy cover of what the arm reaches quickly
#: from its waiting pose.
IK_SEEDS = np.array(
    [
        HOME,
        (-0.386, 0.559, 0.048, -2.175, -1.173, 1.994, 0.797),
        (0.276, 0.693, 0.397, -2.782, 1.358, 2.557, -0.02),
    ]
)
#: Further configurations that are used where none of `IK_SEEDS` has led to a grasp.
FALLBACK_IK_SEEDS = np.array(
    [
        (0.641, -1.612, -0.197, -2.53, -0.095, 1.678, 0.587),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 1.678, -0.913),
        (-0.059, -1.612, -1.097, -2.53, -0.095, 1.678, 0.587),
        (0.7, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 0.878, 0.587),
        (2.0, 0.23, -2.85, -1.69, 0.056, 1.46, -1.27),
    ]
)

_STANDOFF_ITERATIONS, _GRASP_ITERATIONS = 12, 6


class GraspReachability:
    """Solver of the arm configurations at candidate grasps and at their standoffs.

    Args:
        arm: Kinematics of the arm.
        speeds: (7,) maximum joint speeds (rad/s).
        config: Configuration of grasp selection, with bounds and costs.
        standoff: Distance of a standoff from its grasp (m).

    Attributes:
        grasp_from_standoff: (7,) pose of the standoff in the frame of its grasp.
    """

    def __init__(self, arm: ArmInWorld, speeds: Array, config: GraspSelectorConfig, standoff: float) -> None:
        self._arm, self._speeds, self._config = arm, speeds, config
        self.grasp_from_standoff = np.array([0.0, 0.0, -standoff, 0.0, 0.0, 0.0, 1.0])

    def solve(
        self, grasps: Array, joints: Array, previous: Array | None, use_fallback: bool
    ) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Solve inverse kinematics of grasps (n, 7) of the hand link and their standoffs from several seeds.

        For each grasp, the solution that the arm at `joints` reaches soonest is returned: configurations (n, 7)
        in rad at the standoffs and at the grasps, and whether they exist (n,). Searches also start at the
        `previous` configuration, if any, and at the fallback ones, if wanted.
        """
        seeds = np.concatenate([IK_SEEDS, FALLBACK_IK_SEEDS]) if use_fallback else IK_SEEDS
        if previous is not None:
            seeds = np.concatenate([previous[None], seeds])
        count, copies = len(grasps), len(seeds)
        poses = np.tile(grasps, (copies, 1))
        standoff_poses = compose(poses, self.grasp_from_standoff)
        standoffs, found = self._arm.solve(standoff_poses, np.repeat(seeds, count, axis=0), _STANDOFF_ITERATIONS)
        goals, is_goal_found = self._arm.solve(poses, standoffs, _GRASP_ITERATIONS)
        found &= is_goal_found & (np.abs(goals - standoffs).max(axis=1) < self._config.max_joint_change)
        times = np.where(found, self.compute_travel_times(standoffs, joints), np.inf).reshape(copies, count)
        best = np.argmin(times, axis=0) * count + np.arange(count)
        return standoffs[best], goals[best], found[best]

    def compute_travel_times(self, standoffs: Array, joints: Array) -> Array:
        """Return the travel times (n,) in s of the arm from joints (7,) to standoff configurations (n, 7)."""
        return np.asarray((np.abs(standoffs - joints) / self._speeds).max(axis=1))

    def compute_limit_margin_costs(self, standoffs: Array, goals: Array) -> Array:
        """Return the costs (n,) in s of grasps whose configurations (n, 7) are close to joint limits."""
        low, high = self._arm.limits
        margins = np.minimum(*(np.minimum(joints - low, high - joints).min(axis=1) for joints in (standoffs, goals)))
        missing = np.maximum(0.0, self._config.desired_limit_margin - margins)
        return np.asarray(self._config.limit_margin_cost * missing)

    def is_arm_clear(self, goals: Array, bodies: Spheres) -> npt.NDArray[np.bool_]:
        """Return whether (n,) forearm and wrist at configurations (n, 7) keep clear of bodies and table."""
        is_clear = compute_arm_clearances(self._arm, goals, bodies) > self._config.arm_clearance
        lowest = compute_lowest_heights(self._arm, goals)
        return np.asarray(is_clear & (lowest > TABLE_HEIGHT + self._config.table_clearance))
