"""Grasps that hold: the known ones and tilted copies of them, tried out in a simulation of the gripper alone.

What was found is kept in the user's cache folder, by the contents of the object's files and its known grasps.
"""

import hashlib
import io
import logging
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import HandoverError
from handover_marl.files import write_atomically
from handover_marl.models.meshes import mesh_files
from handover_marl.models.panda import GRIPPER_FROM_HAND
from handover_marl.models.poses import IDENTITY, compose, inverse
from handover_marl.planning.field_cache import cache_folder
from handover_marl.sim.bullet.grasp_trial import GraspTrial, TrialConfig

Array = npt.NDArray[np.float64]

# Changes when the same files give other grasps.
_VERSION = 5
_ON_EDGE = 0.5
_HAND_FROM_GRIPPER = inverse(np.array(GRIPPER_FROM_HAND))

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GraspTrials:
    """How known grasps become tried ones.

    Attributes:
        copies: How copies differ: an angle about the line between the finger pads (rad), and a way on (m).
        pads: Distance of that line from the hand's frame (m).
        apart: Copies nearer than this to a grasp worth as much (m), with a turn counted by `arm`, are left out.
        arm: Metres that a radian counts.
        most: So many copies at most.
        margin: The fingers should touch so far within their pads (m).
        trial: What a grasp must stand.
    """

    copies: tuple[tuple[float, float], ...] = ((0.0, 0.012), (-0.4, 0.0), (0.4, 0.0), (-0.8, 0.0), (0.8, 0.0))
    pads: float = 0.1
    apart: float = 0.03
    arm: float = 0.1
    most: int = 120
    margin: float = 0.004
    trial: TrialConfig = TrialConfig(close_time=0.25, shake_time=0.06)


@dataclass(frozen=True, eq=False)
class TriedGrasps:
    """Poses (n, 7) of the hand link in the object's frame, and what each is worth (n,): 0 what does not hold, 1 what does, in
    between what the fingers hold by the edges of their pads."""

    poses: Array
    holds: Array


def tried_grasps(object_urdf: Path, known: Array, config: GraspTrials) -> TriedGrasps:
    """The known grasps (n, 7) of an object and their copies, tried; from the cache if it has them.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    path = _path(object_urdf, known, config)
    kept = _read(path)
    if kept is None:
        kept = _try(object_urdf, known, config)
        _keep(path, kept)
    return kept


def changed(known: Array, config: GraspTrials) -> Array:
    """(m, 7) copies of grasps (n, 7), tilted about the line between the pads and moved on."""
    back = np.array([0.0, 0.0, -config.pads, 0.0, 0.0, 0.0, 1.0])
    copies = [np.zeros((0, 7))]
    for tilt, way in config.copies:
        turn = np.array([0.0, 0.0, config.pads + way, *Rotation.from_euler("y", tilt).as_quat()])
        copies.append(compose(compose(known, turn), back))
    return np.concatenate(copies)


def distances(pose: Array, poses: Array, arm: float) -> Array:
    """(n,) distances of poses (n, 7) to one (7,): the pads' way (m) plus the turn times `arm` (m/rad)."""
    ways = np.linalg.norm(poses[:, :3] - pose[:3], axis=1)
    cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
    found: Array = ways + 2.0 * arm * np.arccos(cosines)
    return found


def _try(object_urdf: Path, known: Array, config: GraspTrials) -> TriedGrasps:
    trial = GraspTrial(object_urdf, config.trial)
    try:
        holds = [_worth(trial, pose, config) for pose in known]
        poses, kept = known, 0
        for pose in changed(known, config):
            if kept == config.most:
                break
            near = np.array(holds)[distances(pose, poses, config.arm) < config.apart].max(initial=0.0)
            if near == 1.0 or not trial.is_free(_matrix(pose)):
                continue
            worth = _worth(trial, pose, config)
            if worth > near:
                poses = np.concatenate([poses, pose[None]])
                holds.append(worth)
                kept += 1
    finally:
        trial.close()
    return TriedGrasps(poses, np.array(holds, dtype=np.float64))


def _worth(trial: GraspTrial, pose: Array, config: GraspTrials) -> float:
    matrix = _matrix(pose)
    if not trial.holds(matrix):
        return 0.0
    return 1.0 if trial.pads_meet(matrix, config.margin) else _ON_EDGE


def _matrix(hand: Array) -> Array:
    """(4, 4) of the gripper that grasp files tell, for a pose (7,) of the hand link."""
    gripper = compose(hand, _HAND_FROM_GRIPPER)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(gripper[3:]).as_matrix(), gripper[:3]
    return matrix


def _path(object_urdf: Path, known: Array, config: GraspTrials) -> Path:
    digest = hashlib.sha256(f"{_VERSION} {config}".encode())
    digest.update(np.round(known, 6).astype(np.float32).tobytes())
    for path in (object_urdf, *mesh_files(object_urdf, "collision")):
        digest.update(path.read_bytes())
    return cache_folder().parent / "grasps" / f"{object_urdf.parent.name}-{digest.hexdigest()[:16]}.npz"


def _read(path: Path) -> TriedGrasps | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            found = TriedGrasps(content["poses"], content["holds"])
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s: no whole list of grasps (%s); trying them anew", path, error)
        return None
    if found.poses.ndim != 2 or found.poses.shape[1] != len(IDENTITY) or found.holds.shape != found.poses.shape[:1]:
        _log.warning("%s: no list of grasps; trying them anew", path)
        return None
    return found


def _keep(path: Path, grasps: TriedGrasps) -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, poses=grasps.poses, holds=grasps.holds)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, stream.getvalue())
    except (OSError, HandoverError):
        _log.warning("grasps %s not kept: cannot write to that folder; they are tried anew each time", path)
