"""Grasps that hold: the known ones, tilted copies of them, and what came of trying them out, in a few numbers each."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped_trials import Record
from handover_marl.models.poses import compose, inverse
from handover_marl.sim.grasp_trial import TrialConfig

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GraspTrials:
    """How known grasps become tried ones.

    Attributes:
        tilts: Angles of the copies about the line between the finger pads (rad).
        pads: Distance of that line from the hand's frame (m).
        apart: Copies nearer to another grasp than this (m), with a turn counted by `arm`, are left out.
        arm: Metres that a radian counts.
        most: So many copies at most.
        aside: Displacements in the gripper's frame (m) from which a grasp that holds is tried too.
        deeper: Grasps are moved on by the first of these ways (m) that leaves the open gripper free of the object, with
        spare: so much room before it (m): what the fingers hold by their very tips springs away when the person lets
            go, before they press as hard as in a trial.
        held_time: The object is held for so long while the fingers close, and then let go for
        free_time: so long (s), in which it may slip by
        slip: this (m), from the grasp's place and from
        around: places around it in the gripper's frame (m).
        trial: What a grasp must stand.
    """

    tilts: tuple[float, ...] = (-0.4, 0.4, -0.8, 0.8)
    pads: float = 0.1
    apart: float = 0.035
    arm: float = 0.1
    most: int = 150
    aside: tuple[tuple[float, float, float], ...] = ((0.005, 0.0, -0.004), (-0.005, 0.0, -0.004))
    deeper: tuple[float, ...] = (0.01, 0.0075, 0.005, 0.0025)
    spare: float = 0.004
    held_time: float = 0.22
    free_time: float = 0.06
    slip: float = 0.003
    around: tuple[tuple[float, float, float], ...] = ((0.003, 0.0, -0.002), (-0.003, 0.0, -0.002), (0.0, 0.003, 0.0))
    trial: TrialConfig = field(default_factory=lambda: TrialConfig(close_time=0.25, shake_time=0.06))


@dataclass(frozen=True, eq=False)
class TriedGrasps:
    """Poses (n, 7) of the hand link in the object's frame, and the share of trials that each has stood (n,)."""

    poses: Array
    holds: Array


def of_record(record: Record, known: Array, config: GraspTrials) -> TriedGrasps:
    """The grasps that a record (n, 4) tells of.

    Raises:
        ValueError: It is not about these known grasps (k, 7), tried this way.
    """
    n, copies = len(known), tilted(known, config)
    copy, stood, way, kept = np.asarray(record, dtype=np.int64).reshape(-1, 4).T
    if len(copy) < n or (copy[:n] != -1).any() or (copy[n:] < 0).any() or (copy >= len(copies)).any():
        raise ValueError("a record of other grasps")
    most = np.array([1 + len(config.aside), len(config.deeper), 1 + len(config.around)])
    if ((record[:, 1:] < 0) | (record[:, 1:] > most)).any():
        raise ValueError("a record of other trials")
    poses = np.concatenate([known, copies[copy[n:]]])
    ways = np.array([0.0, *config.deeper])
    moved = [onward(pose, ways[number]) if number else pose for pose, number in zip(poses, way, strict=True)]
    holds = (stood / (1 + len(config.aside))) * (kept / (1 + len(config.around)))
    return TriedGrasps(np.array(moved).reshape(-1, 7), holds)


def onward(pose: Array, way: float) -> Array:
    """(7,) a grasp (7,) that reaches farther by a way (m)."""
    moved: Array = compose(pose, np.array([0.0, 0.0, way, 0.0, 0.0, 0.0, 1.0]))
    return moved


def tilted(known: Array, config: GraspTrials) -> Array:
    """(m, 7) copies of grasps (n, 7), tilted about the line between the pads, that are no near doubles."""
    pads = np.array([0.0, 0.0, config.pads, 0.0, 0.0, 0.0, 1.0])
    copies = []
    for tilt in config.tilts:
        turn = np.concatenate([np.zeros(3), Rotation.from_euler("y", tilt).as_quat()])
        copies.append(compose(compose(compose(known, pads), turn), inverse(pads)))
    return np.concatenate(copies) if copies else np.zeros((0, 7))


def distances(pose: Array, poses: Array, arm: float) -> Array:
    """(n,) distances of poses (n, 7) to one (7,): the pads' way (m) plus the turn times `arm` (m/rad)."""
    ways = np.linalg.norm(poses[:, :3] - pose[:3], axis=1)
    cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
    found: Array = ways + 2.0 * arm * np.arccos(cosines)
    return found
