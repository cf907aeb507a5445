"""Parts that all batches of givers share: their actions, and the distances of the grippers from the objects."""

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, widen
from handover_marl.geometry.poses import compute_lengths
from handover_marl.policies.batch import Actions


def make_giver_actions(
    count: int,
    rate: float | AnyArray = 0.0,
    displacement: float | AnyArray = 0.0,
    rotation: float | AnyArray = 0.0,
    release: float | AnyArray = 0.0,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> Actions:
    """Make actions (r, 8) of r givers of their components; see `policies.policy.make_giver_action`.

    Args:
        count: Number r of givers.
        rate: Playback rates minus 1, (r,) or one for all.
        displacement: Set-points (r, 3) of the wrists' displacements, world frame (m).
        rotation: Set-points (r, 3) of the rotation vectors about the wrists, world frame (rad).
        release: Whether to release the objects, (r,).
        arrays: Creator of the array.
    """
    actions = arrays.zeros((count, GIVER_ACTION_SIZE), "float32")
    actions[:, 0], actions[:, 1:4], actions[:, 4:7], actions[:, 7] = rate, displacement, rotation, release
    return actions


def compute_gripper_object_distances(observation: Observation) -> AnyArray:
    """Return the distances (r,) of the grippers from the objects' origins (m), float64."""
    return widen(compute_lengths(observation["gripper_pose"][:, :3] - observation["object_poses"][:, 0, :3]))
