"""How handy a grasp lies for the Panda, as Yang et al. (ICRA 2021) rank grasps in HandoverSim."""

import numpy as np
import numpy.typing as npt

Poses = npt.NDArray[np.float64]

#: The standoff in the hand link's frame at the grasp (7): 20 cm back (m, quaternion xyzw).
STANDOFF = (0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0)

#: The world pose (7) of the hand link that standoffs are drawn to, near where it waits (m, quaternion xyzw).
PREFERRED_POSE = (
    *(0.6914180, -0.4314530, 1.5511079),
    *(0.6429956, 0.6701149, 0.2626269, -0.2617819),
)

#: Weight of rotations against squared distances.
ROTATION_WEIGHT = 0.5

#: How many grasps are looked at, handiest first.
CANDIDATES = 25


def pose_distance(pose: npt.ArrayLike, poses: Poses, rotation_weight: float = ROTATION_WEIGHT) -> Poses:
    """(n,) squared distances (m^2) of poses (n, 7) to one (7,), with a share for how they are turned."""
    one = np.asarray(pose, dtype=np.float64)
    translation: Poses = ((poses[:, :3] - one[:3]) ** 2).sum(axis=1)
    return translation + rotation_weight * (1.0 - (poses[:, 3:] @ one[3:]) ** 2)
