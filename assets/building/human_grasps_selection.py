"""Evaluation of closed hands, adaptation to other hand sizes, and selection of a varied set."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.build_hands import make_reference_hand
from handover_marl.assets.building.human_grasps_candidates import GraspTarget, find_candidates
from handover_marl.assets.building.human_grasps_closing import (
    SKIN_YIELD,
    close_fingers,
    compute_body_clearance,
    compute_clearances,
    sample_palm_surface,
)
from handover_marl.assets.hand_model import BoolArray, FloatArray, HandGeometry, IntArray
from handover_marl.assets.hand_openings import measure_openings
from handover_marl.assets.hand_postures import ArrayBatch, Palms, Posture
from handover_marl.assets.hand_spheres import HandSpheres
from handover_marl.assets.human_grasps import FREE_SHARE_MEDIAN, interpolate_wrist_distance
from handover_marl.geometry.distance_field import DistanceField

#: Largest distance (m) of a digit in contact.
TOUCH_DISTANCE = 0.003

_FREE_DISTANCE = 0.03
# The palm yields more than the fingers (m).
_PALM_YIELD = 0.003
_MAX_ROUNDS, _N_ROUND_CANDIDATES = 5, 20_000
# Sampling ends when all quantile bins of the wrist distance hold enough grasps.
_N_BINS, _MIN_PER_BIN, _MAX_POOL = 8, 20, 1200
_N_VARIANTS = 3


@dataclass(frozen=True, eq=False)
class HumanGraspSet(ArrayBatch):
    """Closed right hands of one size on one object; n is the first dimension of all arrays.

    Attributes:
        palms: Palm poses in the object's frame.
        opened: Postures before closing.
        closed: Postures after closing.
        touching: (n, 5) masks of the digits in contact.
        overlap: (n,) largest penetrations (m) of hand and object.
        base: (n,) indices of the original grasps, of which these grasps are variants.
    """

    palms: Palms
    opened: Posture
    closed: Posture
    touching: BoolArray
    overlap: FloatArray
    base: IntArray

    @property
    def wrist_distance(self) -> FloatArray:
        """Distances (n,) (m) from the palm's origin to the object's origin."""
        return np.asarray(np.linalg.norm(self.palms.position, axis=1))


def close_and_filter(
    target: GraspTarget, model: HandGeometry, palms: Palms, opened: Posture, base: IntArray
) -> HumanGraspSet:
    """Close the fingers of open hands and return the hands that grasp the object.

    In a grasp the pads of the thumb and of at least two fingers touch the object, on opposite sides.

    Args:
        target: Object.
        model: Geometry of the hand.
        palms: Palm poses in the object's frame.
        opened: Open postures.
        base: (n,) indices of the original grasps, of which the hands are variants.
    """
    spheres, field = HandSpheres(model), target.field
    closed = close_fingers(field, spheres, palms, opened)
    angles = closed.compute_joint_angles()
    gaps = compute_clearances(field, spheres, palms, angles)
    centers, rotations = spheres.place_phalanges(angles)
    outward = field.compute_outward_normals(palms.transform(centers))
    by_digit = gaps.reshape(len(angles), 5, 9)
    nearest = by_digit.argmin(axis=2)
    touching = by_digit.min(axis=2) < TOUCH_DISTANCE
    normal = np.take_along_axis(outward.reshape(-1, 5, 9, 3), nearest[..., None, None], axis=2)[:, :, 0]
    pads = _compute_pad_directions(closed, rotations, nearest)
    pads = np.einsum("nij,ndj->ndi", palms.rotation, pads)
    # Contact with the pad, not with the nail.
    by_pad = touching & (np.einsum("ndi,ndi->nd", pads, -normal) > 0.1)
    opposed = _is_opposed(
        by_pad[:, :4], normal, field.compute_outward_normals(_find_nearest_palm_spheres(field, palms, spheres))
    )
    crossing = _compute_thumb_overlap(centers, spheres.radii)
    body = np.minimum(
        *(compute_body_clearance(field, palms, part) for part in (spheres.palm, sample_palm_surface(model)))
    )
    opposed[:, 1] &= body < TOUCH_DISTANCE
    holds = by_pad[:, 4] & (by_pad[:, :4].sum(axis=1) >= 2) & by_pad[:, :2].any(axis=1)
    keep = np.flatnonzero(holds & opposed.any(axis=1) & (crossing < 0.005) & (body > -_PALM_YIELD))
    overlap = np.maximum(0.0, -np.minimum(gaps.min(axis=(1, 2)), body))
    return HumanGraspSet(palms, opened, closed, touching, overlap, base)[keep]


def sample_grasp_pool(target: GraspTarget, object_name: str, rng: np.random.Generator) -> HumanGraspSet:
    """Sample grasps of the reference hand on all sides of an object.

    The distances of the wrist from the object's origin cover the distances in DexYCB.

    Args:
        target: Object.
        object_name: YCB class name.
        rng: Random generator.
    """
    goals = interpolate_wrist_distance(object_name, np.linspace(0.0, 1.0, _N_BINS + 1))
    limits = (float(goals[0]) - 0.01, float(goals[-1]) + 0.01)
    found: list[HumanGraspSet] = []
    for _ in range(_MAX_ROUNDS):
        palms, opened = find_candidates(target, _N_ROUND_CANDIDATES, limits, rng)
        # Balance the wrist distances.
        share = _assign_bins(palms.position, goals)
        weight = 1.0 / np.bincount(share)[share]
        size = min(len(share), 1000)
        rows = rng.choice(len(share), size, replace=False, p=weight / weight.sum())
        found.append(close_and_filter(target, make_reference_hand(), palms[rows], opened[rows], np.arange(size)))
        have = np.bincount(
            np.concatenate([_assign_bins(part.palms.position, goals) for part in found]), minlength=_N_BINS
        )
        if have.min() >= _MIN_PER_BIN:
            break
    pool = HumanGraspSet.concatenate(found)
    pool = replace(pool, base=np.arange(len(pool)))
    return pool[rng.permutation(len(pool))[:_MAX_POOL]]


def _assign_bins(positions: FloatArray, goals: FloatArray) -> IntArray:
    """Return the quantile bins (n,) of the wrist distances of palm positions."""
    return np.asarray(np.searchsorted(goals[1:-1], np.linalg.norm(positions, axis=1)))


def fit_to_hand(
    target: GraspTarget, model: HandGeometry, grasps: HumanGraspSet, rng: np.random.Generator
) -> HumanGraspSet:
    """Return variants of grasps for a hand of another size; grasps that fail are left out.

    In a variant the gap between thumb and fingers is near its place in the original grasp.

    Args:
        target: Object.
        model: Geometry of the hand.
        grasps: Grasps of the reference hand.
        rng: Random generator of the differences from the original grasps.
    """
    row = np.repeat(np.arange(len(grasps)), _N_VARIANTS)
    base = grasps[row]
    first = np.arange(len(row)) % _N_VARIANTS == 0
    turn = rng.normal(0.0, 0.05, (len(row), 3)) * ~first[:, None]
    shift = rng.normal(0.0, 0.004, (len(row), 3)) * ~first[:, None]
    rotation = Rotation.from_rotvec(turn).as_matrix() @ base.palms.rotation
    before = measure_openings(make_reference_hand(), base.opened).center
    after = measure_openings(model, base.opened).center
    grip = base.palms.position + np.einsum("nij,nj->ni", base.palms.rotation, before)
    position = grip + shift - np.einsum("nij,nj->ni", rotation, after)
    spheres, palms = HandSpheres(model), Palms(position, rotation)
    keep = compute_body_clearance(target.field, palms, spheres.palm) > -SKIN_YIELD
    keep &= compute_body_clearance(target.field, palms, spheres.forearm) > 0.0
    keep &= (
        compute_clearances(target.field, spheres, palms, base.opened.compute_joint_angles()).min(axis=(1, 2))
        > -SKIN_YIELD / 2
    )
    rows = np.flatnonzero(keep)
    return close_and_filter(target, model, palms[rows], base.opened[rows], row[rows])


def select_grasps(
    grasps: HumanGraspSet, object_name: str, count: int, rng: np.random.Generator, free_shares: FloatArray | None = None
) -> HumanGraspSet:
    """Select varied and firm grasps whose wrist distances are distributed as in DexYCB.

    The k-th grasp is the best grasp for a wrist distance that is drawn between the quantiles k/count
    and (k+1)/count of DexYCB.

    Args:
        grasps: Grasps to select from.
        object_name: YCB class name.
        count: Number of grasps to select.
        rng: Random generator.
        free_shares: (n,) fractions of the object's surface that are far from the hand; grasps with
            less than DexYCB's median are avoided. None does not consider them.
    """
    goals = interpolate_wrist_distance(object_name, (np.arange(count) + rng.random(count)) / count)
    quality = 0.35 * grasps.touching.sum(axis=1) - 100.0 * grasps.overlap
    if free_shares is not None:
        quality -= 12.0 * np.maximum(0.0, FREE_SHARE_MEDIAN[object_name] - free_shares)
    crowd, chosen = np.zeros(len(grasps)), []
    for goal in goals[rng.permutation(count)]:
        cost = (np.abs(grasps.wrist_distance - goal) / 0.004) ** 2 - quality + crowd
        best = int(np.argmin(cost))
        chosen.append(best)
        crowd += 3.0 * _compute_similarity(grasps, best) + 8.0 * (grasps.base == grasps.base[best])
        crowd[best] = np.inf
    order = np.argsort(grasps.wrist_distance[chosen])
    return grasps[np.array(chosen)[order]]


def compute_free_share(
    target: GraspTarget, model: HandGeometry, grasps: HumanGraspSet, samples: int = 400
) -> FloatArray:
    """Return the fractions (n,) of the object's surface more than 30 mm from the hand."""
    spheres, n = HandSpheres(model), len(grasps)
    points, _ = trimesh.sample.sample_surface(target.mesh, samples, seed=0)
    phalanges, _ = spheres.place_phalanges(grasps.closed.compute_joint_angles())
    palm = np.broadcast_to(spheres.palm[0], (n, *spheres.palm[0].shape))
    centers = grasps.palms.transform(np.concatenate([phalanges.reshape(n, -1, 3), palm], axis=1))
    reach = _FREE_DISTANCE + np.concatenate([spheres.radii.ravel(), spheres.palm[1]])
    squared = (
        (centers**2).sum(axis=2)[:, None] + (points**2).sum(axis=1)[:, None] - 2.0 * points @ centers.swapaxes(1, 2)
    )
    return np.asarray((squared > reach**2).all(axis=2).mean(axis=1))


def _compute_similarity(grasps: HumanGraspSet, other: int) -> FloatArray:
    """Return similarities (n,) to a grasp: 1 if equal, near 0 beyond 4 cm or 40 degrees."""
    position, rotation = grasps.palms.position, grasps.palms.rotation
    apart = np.linalg.norm(position - position[other], axis=1) / 0.04
    cosine = (np.einsum("nij,ij->n", rotation, rotation[other]) - 1.0) / 2.0
    turned = np.arccos(np.clip(cosine, -1.0, 1.0)) / 0.7
    return np.asarray(np.exp(-(apart**2) - turned**2))


def _find_nearest_palm_spheres(field: DistanceField, palms: Palms, spheres: HandSpheres) -> FloatArray:
    """Return the centers (n, 3) of the palm's spheres nearest to the object, in its frame."""
    centers, radii = spheres.palm
    points = palms.transform(np.broadcast_to(centers, (len(palms), *centers.shape)))
    nearest = (field.compute_clamped_distances(points) - radii).argmin(axis=1)
    return np.asarray(points[np.arange(len(points)), nearest])


def _is_opposed(by_pad: BoolArray, normal: FloatArray, palm_normal: FloatArray) -> BoolArray:
    """Return masks (n, 2): fingers press against the thumb, and fingers press against the palm."""
    count = by_pad.sum(axis=1)
    verdicts = []
    for other in (normal[:, 4], palm_normal):
        facing = np.where(by_pad, np.einsum("ndi,ni->nd", normal[:, :4], other), 0.0)
        verdicts.append((facing.sum(axis=1) < -0.2 * count) & (facing.min(axis=1) < -0.4))
    return np.stack(verdicts, axis=1)


def _compute_pad_directions(closed: Posture, rotations: FloatArray, nearest: IntArray) -> FloatArray:
    """Return the pad directions (n, 5, 3) of the touching phalanges in the palm's frame."""
    n, phalanx = len(closed), nearest // 3
    frames = rotations.reshape(n, 5, 3, 3, 3)
    at = np.take_along_axis(frames, phalanx[..., None, None, None], axis=2)[:, :, 0]
    pads = -at[..., :, 1]
    axis = np.einsum("nji,nj->ni", closed.thumb_root, closed.thumb_axis)
    bone = make_reference_hand().tips[12] / np.linalg.norm(make_reference_hand().tips[12])
    pads[:, 4] = np.einsum("nij,nj->ni", at[:, 4], np.cross(axis, bone))
    return np.asarray(pads)


def _compute_thumb_overlap(centers: FloatArray, radii: FloatArray) -> FloatArray:
    """Return the penetrations (n,) (m) of thumb and fingers."""
    thumb, fingers = (
        centers[:, 13:].reshape(len(centers), -1, 1, 3),
        centers[:, :12].reshape(len(centers), 1, -1, 3),
    )
    distance = np.linalg.norm(thumb - fingers, axis=-1) - radii[13:].reshape(-1, 1) - radii[:12].reshape(1, -1)
    return np.asarray(-distance.min(axis=(1, 2)))
