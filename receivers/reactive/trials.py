"""Trying grasps out in a simulation of the gripper alone, or knowing what came of it.

What was found ships with the library for DexYCB's objects and its own, and is kept in the user's cache folder for all
others: by the contents of the object's files, its known grasps, the robot's model, and the engine that tried them if
that was not PyBullet.
"""

import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped_trials import Record, shipped_trials
from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import compose, inverse
from handover_marl.planning.array_cache import cache_file, keep, read_kept
from handover_marl.receivers.reactive.grasps import (
    GraspTrials,
    TriedGrasps,
    distances,
    of_record,
    onward,
    tilted,
)
from handover_marl.sim.grasp_trial import GraspTrial, grasp_trial, trial_engine

Array = npt.NDArray[np.float64]

# Changes when the same files give other grasps.
_VERSION = 3
_KIND, _WHAT = "grasps", "list of tried grasps"
_HAND_FROM_GRIPPER = inverse(np.array(GRIPPER_FROM_HAND))

_log = logging.getLogger(__name__)


def tried_grasps(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspTrials) -> TriedGrasps:
    """The known grasps (n, 7) of an object and their copies, tried and moved on.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    return of_record(trial_record(object_urdf, panda_urdf, known, config), known, config)


def trial_record(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspTrials) -> Record:
    """What came of trying them: as shipped, from the cache, or tried now.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    last = record_file(object_urdf, panda_urdf, known, config)
    shipped = shipped_trials(last.stem)
    return _tried(last, object_urdf, panda_urdf, known, config) if shipped is None else shipped


def record_file(object_urdf: Path, panda_urdf: Path, known: Array, config: GraspTrials) -> Path:
    """Where it is kept; the name without `.npz` is the name of what is shipped, too."""
    # The fingers of another robot weigh and rub otherwise. Where its meshes lie does not matter.
    robot = re.sub(rb'filename="[^"]*/', b'filename="', panda_urdf.read_bytes())
    return _file(object_urdf, str(config), known, robot)


def _file(object_urdf: Path, settings: str, known: Array, *more: bytes) -> Path:
    engine = "" if trial_engine() == "bullet" else f" {trial_engine()}"
    given = np.round(known, 6).astype(np.float32).tobytes()
    return cache_file(_KIND, object_urdf, f"{_VERSION}{engine} {settings}".encode(), given, *more)


def _tried(last: Path, object_urdf: Path, panda_urdf: Path, known: Array, config: GraspTrials) -> Record:
    shared = (config.tilts, config.pads, config.apart, config.arm, config.most, config.aside, config.trial)
    first = _file(object_urdf, " ".join(map(str, shared)), known)
    if not last.exists():
        _log.warning("trying out the grasps of %s, once and for a minute or two", object_urdf.parent.name)
    stood = _kept(first, known, config, lambda: _try(object_urdf, known, config))
    return _kept(last, known, config, lambda: _finish(object_urdf, panda_urdf, stood, known, config))


def _kept(path: Path, known: Array, config: GraspTrials, make: Callable[[], Record]) -> Record:
    found = _read(path, known, config)
    if found is None:
        found = make()
        keep(path, {"record": found}, _WHAT)
    return found


def _read(path: Path, known: Array, config: GraspTrials) -> Record | None:
    kept = read_kept(path, ("record",), _WHAT)
    if kept is None:
        return None
    try:
        of_record(kept["record"], known, config)
    except (ValueError, TypeError):
        _log.warning("%s: no %s; making it anew", path, _WHAT)
        return None
    return kept["record"].astype(np.int16)


def _try(object_urdf: Path, known: Array, config: GraspTrials) -> Record:
    """Which grasps hold, with which copies; not yet moved on nor let go (the record's last columns are 0)."""
    trial = grasp_trial(object_urdf, config.trial)
    try:
        rows = [(-1, _stood(trial, pose, config), 0, 0) for pose in known]
        poses = known
        for number, pose in enumerate(tilted(known, config)):
            if len(poses) == len(known) + config.most:
                break
            if (distances(pose, poses, config.arm) < config.apart).any() or not trial.is_free(_matrix(pose)):
                continue
            stood = _stood(trial, pose, config)
            if stood:
                poses = np.concatenate([poses, pose[None]])
                rows.append((number, stood, 0, 0))
    finally:
        trial.close()
    record: Record = np.array(rows, dtype=np.int16).reshape(-1, 4)
    return record


def _stood(trial: GraspTrial, pose: Array, config: GraspTrials) -> int:
    """How many trials a grasp stands; none where it does not hold from its very place."""
    if not trial.holds(_matrix(pose)):
        return 0
    moved = [compose(pose, np.array([*way, 0.0, 0.0, 0.0, 1.0])) for way in config.aside]
    return 1 + sum(trial.holds(_matrix(other)) for other in moved)


def _finish(object_urdf: Path, panda_urdf: Path, stood: Record, known: Array, config: GraspTrials) -> Record:
    """The same moved on, and with what holds when a person lets go."""
    record: Record = stood.copy()
    poses = of_record(stood, known, config).poses
    trial = grasp_trial(object_urdf, config.trial, panda_urdf)
    try:
        for row, pose in zip(record, poses, strict=True):
            row[2] = _way_on(trial, pose, config)
            if row[1]:
                row[3] = _n_kept(trial, onward(pose, config.deeper[row[2] - 1]) if row[2] else pose, config)
    finally:
        trial.close()
    return record


def _way_on(trial: GraspTrial, pose: Array, config: GraspTrials) -> int:
    """By which way the gripper is still free, counted from 1; 0 for none."""
    for number, way in enumerate(config.deeper, start=1):
        if trial.is_free(_matrix(onward(pose, way + config.spare))):
            return number
    return 0


def _n_kept(trial: GraspTrial, pose: Array, config: GraspTrials) -> int:
    """From how many places the object stays in the fingers; none where it does not from the grasp's very place."""
    ways = np.array([(0.0, 0.0, 0.0), *config.around])
    moved = compose(pose, np.concatenate([ways, np.tile([0.0, 0.0, 0.0, 1.0], (len(ways), 1))], axis=1))
    kept = 0
    for number, place in enumerate(moved):
        slip = trial.slip_on_release(_matrix(place), config.held_time, config.free_time)
        if number == 0 and slip > config.slip:
            return 0
        kept += slip <= config.slip
    return kept


def _matrix(hand: Array) -> Array:
    """(4, 4) of the gripper that grasp files tell, for a pose (7,) of the hand link."""
    gripper = compose(hand, _HAND_FROM_GRIPPER)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(gripper[3:]).as_matrix(), gripper[:3]
    return matrix
