"""Robot grasps of objects: antipodal grasps at which the gripper does not touch the object.

Collisions are excluded by signed distances.

A gripper pose has the convention of HandoverSim's grasp files: the fingers close along x, the hand approaches along z.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Solid, normalize
from handover_marl.geometry.poses import compute_cross_products

Array = npt.NDArray[np.float64]


def compute_farthest_point_order(grasps: Array) -> npt.NDArray[np.intp]:
    """Return the indices (k,) of grasps (k, 4, 4) in an order in which each grasp is farthest from all before it.

    The distance is that of the points between the fingers, plus that of closing and approach directions, of 5 cm each.
    """
    if not len(grasps):
        return np.zeros(0, dtype=np.intp)
    tips = grasps[:, :3, 3] + 0.1 * grasps[:, :3, 2]
    axes = np.einsum("ki,kj->kij", grasps[:, :3, 0], grasps[:, :3, 0]).reshape(-1, 9)
    features = np.concatenate([tips, 0.05 * grasps[:, :3, 2], 0.05 * axes], axis=1)
    order = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    for _ in range(len(grasps) - 1):
        order.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[order[-1]], axis=1))
        distance[order[-1]] = -1.0
    return np.array(order)


# Rows of `_make_gripper_points` that lie between the fingers at the palm.
_PALM_MIDDLE = slice(60, 63)
# Largest distance of the finger contacts (m); the Panda opens to 0.08.
_MAX_WIDTH = 0.074
# Standard deviation of the components by which the closing direction deviates from the surface normal, and largest
# angle between it and the surface normals (rad).
_TILT, _MAX_CONE_ANGLE = 0.08, 0.26
# Distance of the contacts from the gripper's origin along its approach (m). The finger pads end at 0.112, the palm at
# 0.066.
_DEPTH_RANGE = (0.084, 0.106)
# Smallest distance of the open gripper's points to the object (m).
_CLEARANCE = 0.002


@cache
def _make_gripper_points() -> Array:
    """Return points (n, 3) in m of the open gripper at a grasp, and of its fingers on the approach, in its frame."""
    fingers = [
        (side * x, y, z)
        for side in (-1, 1)
        for x in (0.0402, 0.052)
        for y in (-0.0105, 0.0, 0.0105)
        for z in (0.066, 0.08, 0.096, 0.1126)
    ]
    palm = [(x, y, 0.066) for x in np.linspace(-0.1, 0.1, 9) for y in (-0.03, 0.0, 0.03)]
    palm += [(x, y, 0.03) for x in (-0.1, -0.05, 0.0, 0.05, 0.1) for y in (-0.03, 0.03)]
    moved = [np.array(fingers) - [0.0, 0.0, standoff] for standoff in (0.025, 0.06, 0.1)]
    return np.concatenate([fingers, palm, *moved])


def draw_robot_grasps(
    random: RandomStream, solid: Solid, n_points: int = 1500, n_grasps: int = 60, is_varied: bool = True
) -> Array:
    """Draw gripper poses (n, 4, 4) in the object's frame (m) that are likely to hold it, not tried in simulation.

    Grasps are tried from `n_points` points of the surface, and up to `n_grasps` are chosen, with `is_varied` far from
    each other. They are rounded to float32; n can be 0.
    """
    first, second, cosines = solid.sample_opposite_points(random, n_points, _MAX_WIDTH, _TILT)
    noise, draws = random.normals(n_points, 3), random.uniforms(n_points, 2)
    good = np.flatnonzero(cosines > np.cos(_MAX_CONE_ANGLE))
    # The gripper is symmetric: swap the fingers at random.
    signs = np.where(draws[good, :1] < 0.5, -1.0, 1.0)
    closing = signs * normalize(second[good] - first[good])
    approach = normalize(compute_cross_products(closing, noise[good]))
    low, high = _DEPTH_RANGE
    depth = low + (high - low) * draws[good, 1:]
    grasps = np.tile(np.eye(4), (len(good), 1, 1))
    grasps[:, :3, 0], grasps[:, :3, 1], grasps[:, :3, 2] = closing, compute_cross_products(approach, closing), approach
    grasps[:, :3, 3] = 0.5 * (first + second)[good] - depth * approach
    # The middle of the palm rejects most of the grasps that are not free.
    for points in (_make_gripper_points()[_PALM_MIDDLE], _make_gripper_points()):
        placed = points @ grasps[:, :3, :3].swapaxes(1, 2) + grasps[:, None, :3, 3]
        grasps = grasps[(solid.compute_distances(placed) > _CLEARANCE).all(axis=1)]
    if is_varied:
        grasps = grasps[compute_farthest_point_order(grasps)]
    return grasps[:n_grasps].astype(np.float32).astype(np.float64)
