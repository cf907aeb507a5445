"""Grasps of objects: by human hands, whose fingers close around the object, and antipodal ones by the Panda's gripper.

Human grasps of a left hand are computed for a right hand and the mirrored object, and then mirrored. `rows` (n,)
are the indices of n open postures in `HandTemplates.openings`. Robot grasps that collide are excluded by signed
distances. A gripper pose is as in HandoverSim's grasp files: the fingers close along x, the hand approaches along z.
"""

from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from handover_marl.assets.hand_model import HandSize, HumanGrasps, Side
from handover_marl.datasets.generated.hands import (
    LIMITS,
    N_STEPS,
    STEP_ANGLES,
    ArrayBatch,
    HandTemplates,
    Palms,
    Posture,
    compute_shortest_rotations,
    make_hand_templates,
    place_digits,
)
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Solid, normalize
from handover_marl.geometry.model_files.meshes import find_farthest_points
from handover_marl.geometry.vectors import compute_cross_products

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# Spheres that suffice to detect most colliding hands: number of the digit and of the sphere on it.
_PROBED_SPHERES: Final = (np.array([4, 0, 0, 4, 4, 0]), np.array([4, 3, 7, 8, 1, 1]))

#: Largest penetration of the object into the fingers, and into the palm (m).
SKIN_YIELD, _PALM_YIELD = 0.002, 0.003
# Largest distance of opposite points, and range of the difference between the gap of the hand and the object (m).
_MAX_WIDTH, _SPARE_WIDTH = 0.1, (0.003, 0.045)
# Smallest distance of the forearm to the object, and of the centers of the open hand's spheres to a table (m).
_FOREARM_CLEARANCE, _TABLE_CLEARANCE = 0.002, 0.02
# Largest distance of a digit in contact (m).
_TOUCH_DISTANCE = 0.003
# Number of steps of further closing of end joints after a phalanx has touched, and step of closing in which a digit
# stays that misses the object.
_N_DISTAL_STEPS, _RELAXED_STEP = 10, 5


def draw_human_grasps(
    random: RandomStream,
    solid: Solid,
    up_axes: tuple[float, ...],
    size: HandSize,
    side: Side,
    n_pairs: int = 320,
    n_closed: int = 10,
    n_grasps: int = 3,
    n_rounds: int = 5,
) -> HumanGrasps | None:
    """Draw grasps of an object by a hand of this size and side, sorted by wrist distance; None if none is found.

    In each grasp, the open hand is clear of the table in at least one resting pose of the object. In a resting pose, an
    axis (+x, -x, +y, -y, +z, -z) with positive weight in `up_axes` points up. A round tries grasps at `n_pairs` surface
    points and closes the fingers of up to `n_closed` hands. Rounds end after `n_rounds`, or once `n_grasps` grasps are
    found; the last round can add more.
    """
    templates = make_hand_templates(size)
    target = solid.mirror() if side == "left" else solid
    axes = np.array(up_axes)[[1, 0, 2, 3, 4, 5]] if side == "left" else np.array(up_axes)
    directions = np.repeat(np.eye(3), 2, axis=0)[axes > 0.0] * np.tile([[1.0], [-1.0]], (3, 1))[axes > 0.0]
    floors = (target.corners @ directions.T).min(axis=0)
    found: list[HumanGrasps] = []
    for _ in range(n_rounds):
        palms, rows = _sample_open_hands(random, target, templates, n_pairs)
        heights = _find_lowest_points(templates, palms, rows, directions) - floors
        lifted = np.flatnonzero((heights > _TABLE_CLEARANCE).any(axis=1))[:n_closed]
        palms, rows = palms[lifted], rows[lifted]
        if len(rows):
            closed = close_fingers(target, templates, palms, rows)
            good = np.flatnonzero(_find_firm_grasps(target, templates, palms, closed))
            found.append(_encode_grasps(templates, palms[good], rows[good], closed[good], side))
        if sum(map(len, found)) >= n_grasps:
            break
    if not any(map(len, found)):
        return None
    order = np.argsort(np.concatenate([grasps.wrist_distance for grasps in found]), kind="stable")
    names = [field.name for field in fields(HumanGrasps) if field.name != "side"]
    return HumanGrasps(
        **{name: np.concatenate([getattr(grasps, name) for grasps in found])[order] for name in names}, side=side
    )


@dataclass(frozen=True, eq=False)
class ClosedHands(ArrayBatch):
    """Batch of n human hands whose fingers are closed on an object.

    Attributes:
        posture: Finger postures of the n hands.
        gaps: (n, 5, 9) distances between the object and nine spheres of each digit (m), negative on overlap.
        centers: (n, 5, 9, 3) centers of the spheres in the object's frame (m).
    """

    posture: Posture
    gaps: Array
    centers: Array


def _sample_open_hands(
    random: RandomStream, solid: Solid, templates: HandTemplates, n_pairs: int
) -> tuple[Palms, Ints]:
    """Sample open hands clear of the object, around pairs of surface points; return palm poses and `rows` (n,)."""
    thumb_side, finger_side, cosines = solid.sample_antipodal_points(random, n_pairs, _MAX_WIDTH, 0.18)
    noise, draws = random.uniforms(n_pairs, 6), random.uniforms(n_pairs, 4)
    across = finger_side - thumb_side
    width = np.linalg.norm(across, axis=1)
    openings = templates.openings
    first = np.searchsorted(openings.width, width + _SPARE_WIDTH[0])
    last = np.searchsorted(openings.width, width + _SPARE_WIDTH[1])
    fits = np.flatnonzero((last > first) & (cosines > 0.6))
    noise, draws = ndtri(noise[fits]), draws[fits]
    rows = (first[fits] + draws[:, 0] * (last - first)[fits]).astype(np.int64)
    goal = normalize(across[fits] / width[fits, None] + 0.12 * noise[:, :3])
    turns = Rotation.from_rotvec(goal * (2.0 * np.pi * draws[:, 1:2] - np.pi)).as_matrix()
    rotation = turns @ compute_shortest_rotations(openings.axis[rows], goal)
    # Fingertip grasps and grasps deep in the hand.
    depth = 0.065 * draws[:, 2] * (draws[:, 3] < 0.75)
    grip = openings.center[rows] + np.column_stack([depth, 0.35 * depth, np.zeros_like(depth)])
    middle = 0.5 * (thumb_side + finger_side)[fits] + 0.004 * noise[:, 3:]
    palms = Palms(middle - np.einsum("nij,nj->ni", rotation, grip), rotation)
    free = find_collision_free_hands(solid, templates, palms, rows)
    return palms[free], rows[free]


def _find_lowest_points(templates: HandTemplates, palms: Palms, rows: Ints, directions: Array) -> Array:
    """Return for n open hands (postures `rows`) the lowest sphere centers along k directions (k, 3): (n, k), in m."""
    palm = np.broadcast_to(templates.palm[0], (len(rows), *templates.palm[0].shape))
    centers = np.concatenate([palm, templates.path[rows, 0].reshape(len(rows), templates.radii.size, 3)], axis=1)
    return np.asarray((palms.transform(centers) @ directions.T).min(axis=1))


def find_collision_free_hands(solid: Solid, templates: HandTemplates, palms: Palms, rows: Ints) -> Ints:
    """Return the indices of those of n open hands that are clear of the object, up to a skin overlap of 1 to 2 mm."""
    # A few spheres of thumb and index finger reject five of six hands.
    digits, spheres = _PROBED_SPHERES
    points = palms.transform(templates.path[rows[:, None], 0, digits, spheres])
    gaps = solid.compute_distances(points) - templates.radii[digits, spheres]
    kept = np.flatnonzero(gaps.min(axis=1) > -0.5 * SKIN_YIELD)
    palms, rows = palms[kept], rows[kept]
    bodies = [templates.palm, templates.forearm]
    fixed = [np.broadcast_to(centers, (len(kept), *centers.shape)) for centers, _ in bodies]
    open_digits = templates.path[rows, 0].reshape(len(kept), templates.radii.size, 3)
    distances = solid.compute_distances(palms.transform(np.concatenate([*fixed, open_digits], axis=1)))
    radii = [*(radii for _, radii in bodies), templates.radii.ravel()]
    least = (-SKIN_YIELD, _FOREARM_CLEARANCE, -0.5 * SKIN_YIELD)
    limits = np.repeat(least, [len(part) for part in radii])
    return kept[(distances - np.concatenate(radii) > limits).all(axis=1)]


def compute_palm_distances(solid: Solid, palms: Palms, centers: Array, radii: Array) -> Array:
    """Return the smallest distances (n,) in m between an object and k spheres in the frame of each of n palms."""
    points = palms.transform(np.broadcast_to(centers, (len(palms), *centers.shape)))
    return np.asarray((solid.compute_distances(points) - radii).min(axis=1))


def close_fingers(solid: Solid, templates: HandTemplates, palms: Palms, rows: Ints) -> ClosedHands:
    """Close each digit of n open hands until one of its phalanges touches, then only the joints beyond that phalanx.

    The hands have poses `palms` in the object's frame and open postures with indices `rows` (n,) in
    `templates.openings`. A digit that misses the object stays slightly bent.
    """
    n = len(rows)
    points = palms.transform(templates.path[rows])
    gaps = (solid.compute_distances(points) - templates.radii).reshape(n, N_STEPS, 5, 3, 3).min(axis=4)
    steps = templates.bends[rows]
    shares, touches = _find_contacts(gaps.min(axis=3), SKIN_YIELD)
    below = np.floor(shares).astype(np.int64)
    above = np.minimum(below + 1, N_STEPS - 1)
    hand, digit = np.arange(n)[:, None], np.arange(5)
    part = (shares - below)[..., None]
    bends = (1.0 - part) * steps[hand, below, digit] + part * steps[hand, above, digit]
    phalanx = np.where(touches, gaps[hand, above, digit].argmin(axis=2), 2)
    bends = _close_end_joints(solid, templates, palms, rows, bends, phalanx)
    relaxed = steps[:, _RELAXED_STEP]
    posture = replace(templates.openings.posture[rows], bends=np.where(touches[..., None], bends, relaxed))
    centers = palms.transform(place_digits(templates.model, posture, posture.bends[:, None])[:, 0])
    return ClosedHands(posture, solid.compute_distances(centers) - templates.radii, centers)


def _close_end_joints(
    solid: Solid, templates: HandTemplates, palms: Palms, rows: Ints, bends: Array, phalanx: Ints
) -> Array:
    """Close the joints beyond the `phalanx` (n, 5), 0 to 2, that touches, until another phalanx of the digit touches.

    Returns the flexions (n, 5, 3) in rad of hands that had the flexions `bends`; for the rest see `close_fingers`.
    """
    n, count = len(rows), _N_DISTAL_STEPS
    beyond = np.arange(3) > phalanx[..., None]
    steps = np.arange(count)[:, None, None] * 1.6 * STEP_ANGLES * beyond[:, None]
    trial = np.minimum(bends[:, None] + steps, np.maximum(LIMITS, bends[:, None]))
    centers = place_digits(templates.model, templates.openings.posture[rows], trial)
    gaps = (solid.compute_distances(palms.transform(centers)) - templates.radii).reshape(n, count, 5, 3, 3).min(axis=4)
    shares, _ = _find_contacts(np.where(beyond[:, None], gaps, np.inf).min(axis=3), SKIN_YIELD)
    part = shares[..., None] * 1.6 * STEP_ANGLES * beyond
    return np.asarray(np.minimum(bends + part, np.maximum(LIMITS, bends)))


def _find_contacts(gaps: Array, least: float) -> tuple[Array, Flags]:
    """Return steps (n, 5), fractional, at which gaps (n, s, 5) (m) fall below `-least`, and a mask; s - 1 if never."""
    hits = gaps < -least
    touches = np.asarray(hits.any(axis=1))
    step = np.where(touches, hits.argmax(axis=1), gaps.shape[1] - 1)
    before = np.maximum(step - 1, 0)
    hand, digit = np.arange(len(gaps))[:, None], np.arange(5)
    low, high = gaps[hand, before, digit], gaps[hand, step, digit]
    crosses = touches & (step > 0)
    low, high = np.where(crosses, low, 0.0), np.where(crosses, high, -1.0)
    share = np.where(crosses, np.clip((low + least) / (low - high), 0.0, 1.0), 0.0)
    return np.asarray(np.where(touches, before + share, gaps.shape[1] - 1.0)), touches


def _find_firm_grasps(solid: Solid, templates: HandTemplates, palms: Palms, closed: ClosedHands) -> Flags:
    """Return a mask (n,) of the hands whose thumb and two or more fingers press on opposite sides, not too deeply."""
    n = len(palms)
    nearest = closed.gaps.argmin(axis=2)
    touching = closed.gaps.min(axis=2) < _TOUCH_DISTANCE
    points = closed.centers[np.arange(n)[:, None], np.arange(5), nearest]
    normals = solid.compute_normals(points)
    facing = np.where(touching[:, :4], np.einsum("ndi,ni->nd", normals[:, :4], normals[:, 4]), 0.0)
    count = touching[:, :4].sum(axis=1)
    opposed = (facing.sum(axis=1) < -0.2 * count) & (facing.min(axis=1) < -0.4)
    holds = touching[:, 4] & (count >= 2) & touching[:, :2].any(axis=1)
    palm_distances = compute_palm_distances(solid, palms, *templates.palm)
    # Rounding of the steps can press a finger deeper than the skin yields.
    shallow = closed.gaps.min(axis=(1, 2)) > -2.0 * SKIN_YIELD
    thumb, fingers = closed.centers[:, 4].reshape(n, -1, 1, 3), closed.centers[:, :4].reshape(n, 1, -1, 3)
    apart = np.linalg.norm(thumb - fingers, axis=-1) - templates.radii[4][:, None] - templates.radii[:4].ravel()
    crossing = -apart.min(axis=(1, 2))
    return np.asarray(holds & opposed & shallow & (palm_distances > -_PALM_YIELD) & (crossing < 0.005))


def _encode_grasps(templates: HandTemplates, palms: Palms, rows: Ints, closed: ClosedHands, side: Side) -> HumanGrasps:
    """Return the grasps of n closed right hands, mirrored in x with the object for the side "left"."""
    base = palms.position - np.einsum("nij,j->ni", palms.rotation, templates.model.palm_offset)
    quaternion = Rotation.from_matrix(palms.rotation).as_quat()
    flip = np.array([-1.0, 1.0, 1.0]) if side == "left" else np.ones(3)
    turned = np.array([1.0, -1.0, -1.0]) if side == "left" else np.ones(3)
    gaps = closed.gaps.min(axis=2)
    return HumanGrasps(
        object_from_base=np.concatenate([base * flip, quaternion * [*turned, 1.0]], axis=1),
        finger_angles=closed.posture.compute_joint_angles() * np.tile(turned, 15),
        open_angles=templates.openings.posture[rows].compute_joint_angles() * np.tile(turned, 15),
        wrist_distance=np.linalg.norm(palms.position, axis=1),
        touching=gaps < _TOUCH_DISTANCE,
        overlap=np.maximum(0.0, -gaps.min(axis=1)),
        side=side,
    )


def sort_by_farthest_point(grasps: Array) -> Array:
    """Sort grasps (k, 4, 4): the first stays, each next one is the remaining one farthest from those before it.

    Distances are Euclidean in (p, 0.05 a, 0.05 c c^T): the fingers' midpoint p (m), approach axis a, closing axis c.
    """
    if not len(grasps):
        return grasps
    tips = grasps[:, :3, 3] + 0.1 * grasps[:, :3, 2]
    axes = np.einsum("ki,kj->kij", grasps[:, :3, 0], grasps[:, :3, 0]).reshape(-1, 9)
    features = np.concatenate([tips, 0.05 * grasps[:, :3, 2], 0.05 * axes], axis=1)
    return np.asarray(grasps[find_farthest_points(features, len(grasps))])


# Rows of `_make_gripper_points` that lie between the fingers at the palm.
_PALM_MIDDLE = slice(60, 63)
# Largest distance of the finger contacts (m); the Panda opens to 0.08.
_MAX_OPENING = 0.074
# Standard deviation of each component of the closing direction's random deviation from the surface normal (rad), and
# largest angle between closing direction and surface normal (rad).
_CLOSING_TILT, _MAX_CONE_ANGLE = 0.08, 0.26
# Distance of the contacts from the gripper's origin along its approach (m). The finger pads end at 0.112, the palm at
# 0.066.
_TIP_DEPTHS = (0.084, 0.106)
# Smallest distance of the open gripper's points to the object (m).
_OPEN_CLEARANCE = 0.002


@cache
def _make_gripper_points() -> Array:
    """Return points (n, 3) in m, in the frame of a grasp, of the open gripper and of its fingers on the approach."""
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
    """Draw antipodal robot grasps without collisions: gripper poses (n, 4, 4) in the object's frame (m).

    Grasps are tried from `n_points` points of the surface, and up to `n_grasps` are chosen; if `is_varied`, those that
    are far from each other. No simulation checks them. Poses are rounded to float32; n can be 0.
    """
    first, second, cosines = solid.sample_antipodal_points(random, n_points, _MAX_OPENING, _CLOSING_TILT)
    noise, draws = random.normals(n_points, 3), random.uniforms(n_points, 2)
    good = np.flatnonzero(cosines > np.cos(_MAX_CONE_ANGLE))
    # The gripper is symmetric: swap the fingers at random.
    signs = np.where(draws[good, :1] < 0.5, -1.0, 1.0)
    closing = signs * normalize(second[good] - first[good])
    approach = normalize(compute_cross_products(closing, noise[good]))
    low, high = _TIP_DEPTHS
    depth = low + (high - low) * draws[good, 1:]
    grasps = np.tile(np.eye(4), (len(good), 1, 1))
    grasps[:, :3, 0], grasps[:, :3, 1], grasps[:, :3, 2] = closing, compute_cross_products(approach, closing), approach
    grasps[:, :3, 3] = 0.5 * (first + second)[good] - depth * approach
    # The middle of the palm rejects most of the grasps that are not free.
    for points in (_make_gripper_points()[_PALM_MIDDLE], _make_gripper_points()):
        placed = points @ grasps[:, :3, :3].swapaxes(1, 2) + grasps[:, None, :3, 3]
        grasps = grasps[(solid.compute_distances(placed) > _OPEN_CLEARANCE).all(axis=1)]
    if is_varied:
        grasps = sort_by_farthest_point(grasps)
    return grasps[:n_grasps].astype(np.float32).astype(np.float64)
