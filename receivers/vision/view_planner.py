"""Views of object and hand that the wrist camera of the receiver `vision` takes while no grasp is suitable."""

import itertools

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import (
    Spheres,
    compute_arm_clearances,
    compute_lowest_heights,
    compute_open_gripper_clearances,
)
from handover_marl.receivers.reactive.selector import FALLBACK_IK_SEEDS, HOME, IK_SEEDS
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = npt.NDArray[np.float64]

# Views that are tried: distances of the camera from the target (m); directions from the target to the camera, as the
# horizontal angle from the robot's base and the elevation (rad); rotations about the viewing axis (rad).
_DISTANCES, _AZIMUTHS, _ELEVATIONS = (0.4, 0.5), (0.0, 0.6, -0.6, 1.2, -1.2), (0.3, 0.8, -0.2)
_ROLLS = (0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi)
_IK_ITERATIONS, _MAX_CHECKED = 12, 64
# Minimum clearances of gripper and arm to bodies, and to the table (m).
_CLEARANCE, _TABLE_CLEARANCE = 0.08, 0.03
# Cost of a view in a direction that was tried before (s), and angle between directions over which it decreases (rad).
_TRIED_COST, _TRIED_ANGLE = 4.0, 0.5
# Joint error at which the arm has reached a view (rad), time for which it stays there (s), and largest time until the
# next view (s).
_REACHED_ERROR, _STAY_TIME, _GIVE_UP_TIME = 0.05, 0.4, 1.5
# Time without a suitable grasp after which the search begins (s), and time between two calls of the planner after which
# a new search begins (s).
_DELAY, _MAX_CALL_INTERVAL = 0.5, 0.3


class ViewPlanner:
    """Planner of arm configurations in an episode from which the wrist camera has a near view of object and hand.

    Args:
        arm: Kinematics of the arm.
        speeds: (7,) maximum joint speeds (rad/s).
    """

    def __init__(self, arm: ArmInWorld, speeds: Array) -> None:
        self._arm, self._speeds = arm, speeds
        self._begin = self._last_call = self._planned_at = self._arrived_at = -np.inf
        self._tried: list[Array] = []
        self._view: Array | None = None

    def plan(self, time: float, joints: Array, target: Array, bodies: Spheres, can_begin: bool) -> Array:
        """Return the configuration (7,) (rad) to move to now, while no grasp is suitable.

        This is the waiting pose for the first 0.5 s and if no view is found, else one view after the other.

        Args:
            time: Time of the episode (s).
            joints: (7,) present configuration of the arm (rad).
            target: (3,) point that the camera looks at, in the world (m).
            bodies: Spheres in the world that arm and gripper keep clear of.
            can_begin: Whether a search may begin; otherwise the arm moves to the waiting pose, unless one has begun.
        """
        is_new = time - self._last_call > _MAX_CALL_INTERVAL
        self._last_call = time
        if is_new:
            self._view = None
        if self._view is None:
            self._begin = time if is_new or not can_begin else self._begin
            if time - self._begin < _DELAY:
                return HOME
        else:
            if float(np.abs(joints - self._view).max()) > _REACHED_ERROR:
                self._arrived_at = time
            if time - self._arrived_at < _STAY_TIME and time - self._planned_at < _GIVE_UP_TIME:
                return self._view
        self._view = self._choose_view(joints, target, bodies)
        self._planned_at = self._arrived_at = time
        return HOME if self._view is None else self._view

    def _choose_view(self, joints: Array, target: Array, bodies: Spheres) -> Array | None:
        """Return the configuration (7,) (rad) of the best view, None without a clear one; store the direction as tried.

        The best view has the lowest travel time, to which a cost is added in directions that were tried before.
        """
        poses, directions = self._make_hand_poses(target)
        seeds = np.concatenate([joints[None], IK_SEEDS, FALLBACK_IK_SEEDS])
        views, is_found = self._arm.solve(
            np.tile(poses, (len(seeds), 1)), np.repeat(seeds, len(poses), axis=0), _IK_ITERATIONS
        )
        views, directions = views[is_found], np.tile(directions, (len(seeds), 1))[is_found]
        costs = (np.abs(views - joints) / self._speeds).max(axis=1)
        for tried in self._tried:
            angles = np.arccos(np.clip(directions @ tried, -1.0, 1.0))
            costs = costs + _TRIED_COST * np.exp(-0.5 * (angles / _TRIED_ANGLE) ** 2)
        best = np.argsort(costs, kind="stable")[:_MAX_CHECKED]
        best = best[self._are_clear(views[best], bodies)] if len(best) else best
        if not len(best):
            return None
        self._tried.append(directions[best[0]])
        return np.asarray(views[best[0]])

    def _are_clear(self, views: Array, bodies: Spheres) -> npt.NDArray[np.bool_]:
        """Return a mask (n,) of configurations (n, 7) (rad) in which arm and gripper are clear of bodies and table."""
        gripper = compute_open_gripper_clearances(self._arm.compute_hand_poses(views), bodies)
        clearances = np.minimum(gripper, compute_arm_clearances(self._arm, views, bodies))
        heights = compute_lowest_heights(self._arm, views) - TABLE_HEIGHT
        return np.asarray((clearances > _CLEARANCE) & (heights > _TABLE_CLEARANCE))

    def _make_hand_poses(self, target: Array) -> tuple[Array, Array]:
        """Return world poses (n, 7) of the hand link for all views, and directions (n, 3) from target to camera."""
        towards = self._arm.base[:2] - target[:2]
        angles = np.array(list(itertools.product(_AZIMUTHS, _ELEVATIONS, _DISTANCES, _ROLLS)))
        azimuths, elevations = angles[:, 0] + np.arctan2(towards[1], towards[0]), angles[:, 1]
        level = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
        directions = np.column_stack([np.cos(elevations)[:, None] * level, np.sin(elevations)])
        across = np.column_stack([-level[:, 1], level[:, 0], np.zeros(len(level))])
        axes = np.stack([across, np.cross(-directions, across), -directions], axis=2)
        rotations = Rotation.from_matrix(axes) * Rotation.from_euler("z", angles[:, 3:])
        cameras = target + angles[:, 2:3] * directions
        positions = cameras - rotations.apply(np.array(WRIST_CAMERA.position))
        return np.concatenate([positions, rotations.as_quat()], axis=1), directions
