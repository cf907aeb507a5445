"""Judging closed hands, fitting them to hands of other sizes and choosing a varied set of grasps."""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.hand_meshes import reference_hand
from handover_marl.assets.building.human_grasps_candidates import (
    GraspTarget,
    Palms,
    find_candidates,
    measure_openings,
)
from handover_marl.assets.building.human_grasps_closing import (
    YIELD,
    HandBalls,
    Posture,
    body_clearance,
    clearances,
    close,
    to_object,
)
from handover_marl.assets.hand_model import BoolArray, FloatArray, HandModel, IntArray
from handover_marl.assets.human_grasps_statistics import FREE_SHARE_MEDIAN, wrist_distance_quantile
from handover_marl.models.distance_field import DistanceField

#: A digit touches if its skin is at most this far from the object (m).
TOUCH_DISTANCE = 0.003

_FREE_DISTANCE = 0.03
# The palm's flesh gives way more than the fingers'.
_PALM_YIELD = 0.003
_MOST_ROUNDS, _ROUND = 5, 20_000
# A pool is enough when it holds so many grasps in each of so many quantile bins of the wrist distance.
_BINS, _LEAST_IN_BIN, _LARGEST_POOL = 8, 20, 1200
_VARIANTS = 3


@dataclass(frozen=True, eq=False)
class Grasps:
    """n closed right hands of one size on one object (n first in every array).

    Attributes:
        palms: Palm poses in the object's frame.
        opened: Postures before closing.
        closed: Postures after closing.
        touching: (n, 5) which digits touch.
        overlap: (n) deepest overlap (m) of hand and object.
        base: (n) number of the grasp that it is a variant of.
    """

    palms: Palms
    opened: Posture
    closed: Posture
    touching: BoolArray
    overlap: FloatArray
    base: IntArray

    def __len__(self) -> int:
        return len(self.overlap)

    def __getitem__(self, rows: IntArray) -> "Grasps":
        palms = (self.palms[0][rows], self.palms[1][rows])
        return Grasps(
            palms, self.opened[rows], self.closed[rows], self.touching[rows], self.overlap[rows], self.base[rows]
        )

    @property
    def wrist_distance(self) -> FloatArray:
        """(n) distance (m) from the palm's origin to the object's."""
        return np.asarray(np.linalg.norm(self.palms[0], axis=1))


def close_and_keep(target: GraspTarget, model: HandModel, palms: Palms, opened: Posture, base: IntArray) -> Grasps:
    """Close open hands and keep those that hold: thumb against at least two fingers, pads first."""
    balls, field = HandBalls(model), target.field
    closed = close(field, balls, palms, opened)
    angles = closed.angles()
    gaps = clearances(field, balls, palms, angles)
    centres, rotations = balls.phalanges(angles)
    outward = field.outward(to_object(palms, centres))
    by_digit = gaps.reshape(len(angles), 5, 9)
    nearest = by_digit.argmin(axis=2)
    touching = by_digit.min(axis=2) < TOUCH_DISTANCE
    normal = np.take_along_axis(outward.reshape(-1, 5, 9, 3), nearest[..., None, None], axis=2)[:, :, 0]
    pads = _pad_directions(closed, rotations, nearest)
    pads = np.einsum("nij,ndj->ndi", palms[1], pads)
    # The object must lie before the pad, not behind the nail.
    by_pad = touching & (np.einsum("ndi,ndi->nd", pads, -normal) > 0.1)
    opposed = _opposed(by_pad[:, :4], normal, field.outward(_nearest_palm_balls(field, palms, balls)))
    crossing = _thumb_crossing(centres, balls.radii)
    body = np.minimum(*(body_clearance(field, palms, part) for part in (balls.palm, balls.hull)))
    opposed[:, 1] &= body < TOUCH_DISTANCE
    holds = by_pad[:, 4] & (by_pad[:, :4].sum(axis=1) >= 2) & by_pad[:, :2].any(axis=1)
    keep = np.flatnonzero(holds & opposed.any(axis=1) & (crossing < 0.005) & (body > -_PALM_YIELD))
    overlap = np.maximum(0.0, -np.minimum(gaps.min(axis=(1, 2)), body))
    return Grasps(palms, opened, closed, touching, overlap, base)[keep]


def grasp_pool(target: GraspTarget, object_name: str, rng: np.random.Generator) -> Grasps:
    """Many grasps of the reference hand all over an object, at the distances people hold it at."""
    goals = wrist_distance_quantile(object_name, np.linspace(0.0, 1.0, _BINS + 1))
    limits = (float(goals[0]) - 0.01, float(goals[-1]) + 0.01)
    found: list[Grasps] = []
    for _ in range(_MOST_ROUNDS):
        palms, opened = find_candidates(target, _ROUND, limits, rng)
        # As many near as far ones, whatever the sampling favours.
        share = _bins(palms[0], goals)
        weight = 1.0 / np.bincount(share)[share]
        size = min(len(share), 1000)
        rows = rng.choice(len(share), size, replace=False, p=weight / weight.sum())
        palms, opened = (palms[0][rows], palms[1][rows]), opened[rows]
        found.append(close_and_keep(target, reference_hand(), palms, opened, np.arange(len(opened))))
        have = np.bincount(np.concatenate([_bins(part.palms[0], goals) for part in found]), minlength=_BINS)
        if have.min() >= _LEAST_IN_BIN:
            break
    pool = _joined(found)
    return pool[rng.permutation(len(pool))[:_LARGEST_POOL]]


def _bins(positions: FloatArray, goals: FloatArray) -> IntArray:
    """(n) which quantile bin the wrist distances of palm positions lie in."""
    return np.asarray(np.searchsorted(goals[1:-1], np.linalg.norm(positions, axis=1)))


def fit_to_hand(target: GraspTarget, model: HandModel, grasps: Grasps, rng: np.random.Generator) -> Grasps:
    """The same grasps by a hand of another size: the gap between thumb and fingers stays where it was."""
    row = np.repeat(np.arange(len(grasps)), _VARIANTS)
    base = grasps[row]
    first = np.arange(len(row)) % _VARIANTS == 0
    turn = rng.normal(0.0, 0.05, (len(row), 3)) * ~first[:, None]
    shift = rng.normal(0.0, 0.004, (len(row), 3)) * ~first[:, None]
    rotation = Rotation.from_rotvec(turn).as_matrix() @ base.palms[1]
    before = measure_openings(reference_hand(), base.opened).centre
    after = measure_openings(model, base.opened).centre
    grip = base.palms[0] + np.einsum("nij,nj->ni", base.palms[1], before)
    position = grip + shift - np.einsum("nij,nj->ni", rotation, after)
    balls, palms = HandBalls(model), (position, rotation)
    keep = body_clearance(target.field, palms, balls.palm) > -YIELD
    keep &= body_clearance(target.field, palms, balls.forearm) > 0.0
    keep &= clearances(target.field, balls, palms, base.opened.angles()).min(axis=(1, 2)) > -YIELD / 2
    rows = np.flatnonzero(keep)
    return close_and_keep(target, model, (position[rows], rotation[rows]), base.opened[rows], row[rows])


def choose(
    grasps: Grasps, object_name: str, count: int, rng: np.random.Generator, free: FloatArray | None = None
) -> Grasps:
    """A set whose wrist distances are spread as people's, otherwise varied and firmly held.

    The k-th grasp is the one that best meets a distance between the quantiles k/count and (k+1)/count. Grasps that
    leave less of the object free (`free`, shares (n)) than people do are avoided.
    """
    goals = wrist_distance_quantile(object_name, (np.arange(count) + rng.random(count)) / count)
    quality = 0.35 * grasps.touching.sum(axis=1) - 100.0 * grasps.overlap
    if free is not None:
        quality -= 12.0 * np.maximum(0.0, FREE_SHARE_MEDIAN[object_name] - free)
    crowd, chosen = np.zeros(len(grasps)), []
    for goal in goals[rng.permutation(count)]:
        cost = (np.abs(grasps.wrist_distance - goal) / 0.004) ** 2 - quality + crowd
        best = int(np.argmin(cost))
        chosen.append(best)
        crowd += 3.0 * _likeness(grasps, best) + 8.0 * (grasps.base == grasps.base[best])
        crowd[best] = np.inf
    order = np.argsort(grasps.wrist_distance[chosen])
    return grasps[np.array(chosen)[order]]


def free_share(target: GraspTarget, model: HandModel, grasps: Grasps, samples: int = 400) -> FloatArray:
    """(n) share of the object's surface further than 30 mm from the hand: room for a gripper."""
    balls, n = HandBalls(model), len(grasps)
    points, _ = trimesh.sample.sample_surface(target.mesh, samples, seed=0)
    phalanges, _ = balls.phalanges(grasps.closed.angles())
    palm = np.broadcast_to(balls.palm[0], (n, *balls.palm[0].shape))
    centres = to_object(grasps.palms, np.concatenate([phalanges.reshape(n, -1, 3), palm], axis=1))
    reach = _FREE_DISTANCE + np.concatenate([balls.radii.ravel(), balls.palm[1]])
    squared = (
        (centres**2).sum(axis=2)[:, None] + (points**2).sum(axis=1)[:, None] - 2.0 * points @ centres.swapaxes(1, 2)
    )
    return np.asarray((squared > reach**2).all(axis=2).mean(axis=1))


def _likeness(grasps: Grasps, other: int) -> FloatArray:
    """(n) 1 for the same hand pose as another grasp's, falling to 0 within about 4 cm or 40 degrees."""
    position, rotation = grasps.palms
    apart = np.linalg.norm(position - position[other], axis=1) / 0.04
    cosine = (np.einsum("nij,ij->n", rotation, rotation[other]) - 1.0) / 2.0
    turned = np.arccos(np.clip(cosine, -1.0, 1.0)) / 0.7
    return np.asarray(np.exp(-(apart**2) - turned**2))


def _nearest_palm_balls(field: DistanceField, palms: Palms, balls: HandBalls) -> FloatArray:
    """(n, 3) centre, in the object's frame, of the palm's ball nearest to the object."""
    centres, radii = balls.palm
    points = to_object(palms, np.broadcast_to(centres, (len(palms[0]), *centres.shape)))
    nearest = (field.clamped(points) - radii).argmin(axis=1)
    return np.asarray(points[np.arange(len(points)), nearest])


def _opposed(by_pad: BoolArray, normal: FloatArray, palm_normal: FloatArray) -> BoolArray:
    """(n, 2) whether the touching fingers press against the thumb, and whether against the palm."""
    count = by_pad.sum(axis=1)
    verdicts = []
    for other in (normal[:, 4], palm_normal):
        facing = np.where(by_pad, np.einsum("ndi,ni->nd", normal[:, :4], other), 0.0)
        verdicts.append((facing.sum(axis=1) < -0.2 * count) & (facing.min(axis=1) < -0.4))
    return np.stack(verdicts, axis=1)


def _pad_directions(closed: Posture, rotations: FloatArray, nearest: IntArray) -> FloatArray:
    """(n, 5, 3) where the touching phalanx's soft side looks, in the palm's frame."""
    n, phalanx = len(closed), nearest // 3
    frames = rotations.reshape(n, 5, 3, 3, 3)
    at = np.take_along_axis(frames, phalanx[..., None, None, None], axis=2)[:, :, 0]
    pads = -at[..., :, 1]
    axis = np.einsum("nji,nj->ni", closed.thumb_root, closed.thumb_axis)
    bone = reference_hand().tips[12] / np.linalg.norm(reference_hand().tips[12])
    pads[:, 4] = np.einsum("nij,nj->ni", at[:, 4], np.cross(axis, bone))
    return np.asarray(pads)


def _thumb_crossing(centres: FloatArray, radii: FloatArray) -> FloatArray:
    """(n) how deep (m) the thumb enters the fingers."""
    thumb, fingers = (
        centres[:, 13:].reshape(len(centres), -1, 1, 3),
        centres[:, :12].reshape(len(centres), 1, -1, 3),
    )
    distance = np.linalg.norm(thumb - fingers, axis=-1) - radii[13:].reshape(-1, 1) - radii[:12].reshape(1, -1)
    return np.asarray(-distance.min(axis=(1, 2)))


def _joined(parts: list[Grasps]) -> Grasps:
    """One set of all grasps, numbered anew."""

    def stack(pick: str) -> Posture:
        postures = [getattr(part, pick) for part in parts]
        return Posture(
            *(
                np.concatenate([getattr(p, name) for p in postures])
                for name in ("bends", "spread", "thumb_root", "thumb_axis")
            )
        )

    palms = (np.concatenate([p.palms[0] for p in parts]), np.concatenate([p.palms[1] for p in parts]))
    overlap = np.concatenate([p.overlap for p in parts])
    touching = np.concatenate([p.touching for p in parts])
    return Grasps(palms, stack("opened"), stack("closed"), touching, overlap, np.arange(len(overlap)))
