"""Order of robot grasps in which each is far from all before it."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def compute_farthest_point_order(
    grasps: Array, tip_depth: float = 0.1, length_per_turn: float = 0.05
) -> npt.NDArray[np.intp]:
    """Return indices that order grasps so that each grasp is farthest from all previous grasps.

    The distance between two grasps combines the distance between the points between their fingers
    with the differences of their approach directions and closing axes.

    Args:
        grasps: (k, 4, 4) transforms `object_from_gripper` (m).
        tip_depth: Distance from the gripper frame's origin to the point between the fingers (m).
        length_per_turn: Weight of the differences of directions (m).
    """
    if not len(grasps):
        return np.zeros(0, dtype=np.intp)
    tips = grasps[:, :3, 3] + tip_depth * grasps[:, :3, 2]
    axes = np.einsum("ki,kj->kij", grasps[:, :3, 0], grasps[:, :3, 0]).reshape(-1, 9)
    features = np.concatenate([tips, length_per_turn * grasps[:, :3, 2], length_per_turn * axes], axis=1)
    order = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    for _ in range(len(grasps) - 1):
        order.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[order[-1]], axis=1))
        distance[order[-1]] = -1.0
    return np.array(order)
