"""Selection of the known grasp of lowest cost: near the gripper and clear of the person's hand.

Poses are poses of the Panda's hand link: position (m) and quaternion xyzw.
"""

import functools
from collections import OrderedDict

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose, rotate_points
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.grasp_library import GraspLibrary

Array = npt.NDArray[np.float64]

#: Clearance beyond which more clearance makes no difference (m).
MAX_CLEARANCE = 0.2

#: Extent of the gripper along the hand link's z axis, from behind its palm to the fingertips (m).
BACK_Z, TIP_Z = -0.05, 0.11
# Entries of the observation on which the selection depends.
_INPUTS = ("gripper_pose", "object_poses", "object_classes", "hand_present", "hand_keypoints")
# Number of cached selections: environments that run side by side query in turns.
_CACHE_SIZE = 256


class LowestCostGraspSelector:
    """Selector of the known grasp of lowest cost for single observations.

    The cost of a grasp is the gripper's translation plus weighted rotation plus missing clearance to
    the person's hand. Inverse kinematics is not solved, so the grasp may be out of reach. Grasps
    rotated by half a turn about the approach axis are candidates too. A selection depends on the
    observation alone and is cached, since features and action schemes of a policy query the same
    selection.

    Args:
        context: Context of a policy, with the objects and their grasps.

    Attributes:
        rotation_weight: Weight of the gripper's rotation in the cost (m/rad).
        desired_clearance: Desired distance of the hand's joints from the gripper's axis (m).
        clearance_weight: Weight of the amount by which the clearance is below the desired one.
    """

    rotation_weight = 0.25
    desired_clearance, clearance_weight = 0.09, 4.0

    def __init__(self, context: PolicyContext) -> None:
        self._library, self._object_names = GraspLibrary(context.grasps), context.object_names
        # Hand link poses (n, 7) and z axes (n, 3) of the grasps of each object class, in its frame.
        self._known: dict[int, tuple[Array, Array] | None] = {}
        self._cache: OrderedDict[bytes, tuple[Array, float] | None] = OrderedDict()

    def select(self, observation: Observation) -> tuple[Array, float] | None:
        """Select a grasp of the object to hand over, or return None if no grasps of it are known.

        Returns:
            World pose (7,) of the hand link at the grasp, which is read-only, and the distance (m)
            of the person's hand from the gripper there.
        """
        key = b"".join(np.asarray(observation[name]).tobytes() for name in _INPUTS)
        if key not in self._cache:
            self._cache[key] = self._compute(observation)
            if len(self._cache) > _CACHE_SIZE:
                self._cache.popitem(last=False)
        return self._cache[key]

    def _compute(self, observation: Observation) -> tuple[Array, float] | None:
        known = self.load_known(int(observation["object_classes"][0]))
        if known is None:
            return None
        grasps, axes = known
        # In the object's frame, so that only gripper and hand have to be transformed.
        object_pose = observation["object_poses"][0].astype(np.float64)
        gripper = compose(invert_pose(object_pose), observation["gripper_pose"].astype(np.float64))
        angles = 2.0 * np.arccos(np.minimum(np.abs(grasps[:, 3:] @ gripper[3:]), 1.0))
        clearances = self._compute_clearances(grasps, axes, object_pose, observation)
        missing = np.maximum(0.0, self.desired_clearance - clearances)
        distances = np.linalg.norm(grasps[:, :3] - gripper[:3], axis=1)
        best = int(np.argmin(distances + self.rotation_weight * angles + self.clearance_weight * missing))
        selected = compose(object_pose, grasps[best])
        selected.flags.writeable = False
        return selected, float(clearances[best])

    def load_known(self, object_class: int) -> tuple[Array, Array] | None:
        """Return the known grasps of an object class with their half turns, and their z axes.

        Args:
            object_class: YCB class number.

        Returns:
            Hand link poses (n, 7) and z axes (n, 3) in the object's frame, or None without grasps.
        """
        if object_class not in self._known:
            self._known[object_class] = self._load(self._object_names[object_class])
        return self._known[object_class]

    def _load(self, object_name: str) -> tuple[Array, Array] | None:
        poses = self._library.get_hand_poses_in_object(object_name)
        if poses is None:
            return None
        poses = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
        return poses, rotate_points(poses[:, 3:], np.array([0.0, 0.0, 1.0]))

    def _compute_clearances(self, grasps: Array, axes: Array, object_pose: Array, observation: Observation) -> Array:
        """Return the smallest distances (n,) in m of the hand's joints to the gripper's axis."""
        if not observation["hand_present"][0]:
            return np.full(len(grasps), MAX_CLEARANCE)
        joints = inverse_transform_points(object_pose, observation["hand_keypoints"])
        offsets = joints - grasps[:, None, :3]
        along = np.clip(np.einsum("gki,gi->gk", offsets, axes), BACK_Z, TIP_Z)
        across = offsets - along[..., None] * axes[:, None]
        distances = np.sqrt(np.einsum("gki,gki->gk", across, across).min(axis=1))
        clearances: Array = np.minimum(distances, MAX_CLEARANCE)
        return clearances


@functools.lru_cache(maxsize=16)
def get_lowest_cost_grasp_selector(context: PolicyContext) -> LowestCostGraspSelector:
    """Return the grasp selector of a policy context; all callers share one selector."""
    return LowestCostGraspSelector(context)
