"""Grasps that hold: the known ones and tilted copies of them, tried out in a simulation of the gripper alone.

What was found is kept in the user's cache folder, by the contents of the object's files, its known grasps, the robot's
model, and the engine that tried them if that was not PyBullet.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import IDENTITY, compose, inverse
from handover_marl.planning.array_cache import cache_file, keep, read_kept
from handover_marl.sim.grasp_trial import GraspTrial, TrialConfig, grasp_trial, trial_engine

Array = npt.NDArray[np.float64]

# Changes when the same files give other grasps.
_VERSION = 2
_KIND, _WHAT = "grasps", "list of tried grasps"
_HAND_FROM_GRIPPER = inverse(np.array(GRIPPER_FROM_HAND))

_log = logging.getLogger(__name__)


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


def tried_grasps(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspTrials) -> TriedGrasps:
    """The known grasps (n, 7) of an object and their copies, tried and moved on; from the cache if it has them.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    shared = (config.tilts, config.pads, config.apart, config.arm, config.most, config.aside, config.trial)
    given = np.round(known, 6).astype(np.float32).tobytes()
    made = f"{_VERSION}{'' if trial_engine() == 'bullet' else f' {trial_engine()}'}"
    first = cache_file(_KIND, object_urdf, f"{made} {' '.join(map(str, shared))}".encode(), given)
    # The fingers of another robot weigh and rub otherwise.
    last = cache_file(_KIND, object_urdf, f"{made} {config}".encode(), given, panda_urdf.read_bytes())
    if not last.exists():
        _log.warning("trying out the grasps of %s, once and for a minute or two", object_urdf.parent.name)
    tried = _kept(first, lambda: _try(object_urdf, known, config))
    return _kept(last, lambda: _finish(object_urdf, panda_urdf, tried, config))


def _kept(path: Path, make: Callable[[], TriedGrasps]) -> TriedGrasps:
    found = _read(path)
    if found is None:
        found = make()
        keep(path, {"poses": found.poses, "holds": found.holds}, _WHAT)
    return found


def _finish(object_urdf: Path, panda_urdf: Path, tried: TriedGrasps, config: GraspTrials) -> TriedGrasps:
    """The same moved on, and worth what holds when a person lets go."""
    trial = grasp_trial(object_urdf, config.trial, panda_urdf)
    poses, holds = tried.poses.copy(), tried.holds.copy()
    try:
        for number, pose in enumerate(tried.poses):
            for way in config.deeper:
                if trial.is_free(_matrix(_onward(pose, way + config.spare))):
                    poses[number] = _onward(pose, way)
                    break
            if holds[number] > 0.0:
                holds[number] *= _share_kept(trial, poses[number], config)
    finally:
        trial.close()
    return TriedGrasps(poses, holds)


def _share_kept(trial: GraspTrial, pose: Array, config: GraspTrials) -> float:
    """Of releases in which the object stays in the fingers; none where it does not from the grasp's very place."""
    ways = np.array([(0.0, 0.0, 0.0), *config.around])
    moved = compose(pose, np.concatenate([ways, np.tile([0.0, 0.0, 0.0, 1.0], (len(ways), 1))], axis=1))
    kept = 0
    for number, place in enumerate(moved):
        slip = trial.slip_on_release(_matrix(place), config.held_time, config.free_time)
        if number == 0 and slip > config.slip:
            return 0.0
        kept += slip <= config.slip
    return kept / len(moved)


def _onward(pose: Array, way: float) -> Array:
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


def _try(object_urdf: Path, known: Array, config: GraspTrials) -> TriedGrasps:
    trial = grasp_trial(object_urdf, config.trial)
    try:
        holds = [_share(trial, pose, config) for pose in known]
        poses, kept = known, 0
        for pose in tilted(known, config):
            if kept == config.most:
                break
            if (distances(pose, poses, config.arm) < config.apart).any() or not trial.is_free(_matrix(pose)):
                continue
            share = _share(trial, pose, config)
            if share > 0.0:
                poses = np.concatenate([poses, pose[None]])
                holds.append(share)
                kept += 1
    finally:
        trial.close()
    return TriedGrasps(poses, np.array(holds, dtype=np.float64))


def _share(trial: GraspTrial, pose: Array, config: GraspTrials) -> float:
    """Of trials that a grasp stands; none where it does not hold from its very place."""
    if not trial.holds(_matrix(pose)):
        return 0.0
    moved = [compose(pose, np.array([*way, 0.0, 0.0, 0.0, 1.0])) for way in config.aside]
    return (1 + sum(trial.holds(_matrix(other)) for other in moved)) / (1 + len(moved))


def _matrix(hand: Array) -> Array:
    """(4, 4) of the gripper that grasp files tell, for a pose (7,) of the hand link."""
    gripper = compose(hand, _HAND_FROM_GRIPPER)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(gripper[3:]).as_matrix(), gripper[:3]
    return matrix


def _read(path: Path) -> TriedGrasps | None:
    kept = read_kept(path, ("poses", "holds"), _WHAT)
    if kept is None:
        return None
    poses, holds = kept["poses"], kept["holds"]
    if poses.ndim != 2 or poses.shape[1] != len(IDENTITY) or holds.shape != poses.shape[:1]:
        _log.warning("%s: no %s; making it anew", path, _WHAT)
        return None
    return TriedGrasps(poses, holds)
