"""Recordings in a folder of raw DexYCB, and their import as scenes of HandoverSim's cache `dex-ycb-cache/`.

<raw>/<subject>/<sequence>/meta.yml, pose.npz   (camera folders are not read)
<raw>/calibration/                              camera extrinsics and hand shapes

A scene number is 100 * subject (0 to 9) + the rank (0 to 99) of the recording's name among the names of the
subject's recordings. Known DexYCB names have their official rank, even if other recordings are missing. A subject with
other names must have all 100 recordings. Except for hand shapes, see `find_first_betas`, scenes are independent.
"""

import contextlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dexycb.mano import N_BETAS, ManoModel
from handover_marl.datasets.dexycb.mano_rotations import (
    MIN_KEYFRAMES,
    Float32,
    Float64,
    KeyframeSpan,
    TagFrame,
    count_frames,
    matrices_from_rotation_vectors,
    scipy_euler_from_rotations,
    transforms3d_euler_from_matrices,
)
from handover_marl.datasets.official import CACHE_FOLDER, MAX_MOTION_BYTES, check_scene_meta, read_motion
from handover_marl.errors import DataFormatError, DataNotFoundError, ResultsError
from handover_marl.execution.files import has_content, shorten_text, write_arrays, write_atomically
from handover_marl.execution.reading import read_arrays, read_yaml, report_damage
from handover_marl.geometry.ycb import SUBJECTS

SEQUENCES_PER_SUBJECT = 100
_KIND_AND_ADVICE = "file of DexYCB", "the download may be incomplete, expand DexYCB's archives again"
_MAX_YAML_BYTES = 64_000  # official files have a few thousand


@dataclass(frozen=True)
class SequenceFolder:
    """Folder of one recording.

    Attributes:
        scene_id: Scene number, 0 to 999.
        name: `<subject>/<sequence>`.
        folder: Folder with `meta.yml` and `pose.npz`.
    """

    scene_id: int
    name: str
    folder: Path

    @property
    def subject(self) -> str:
        """Name of the subject, e.g. `20200709-subject-01`."""
        return self.name.partition("/")[0]

    @property
    def calibration(self) -> Path:
        """Folder of the camera extrinsics and hand shapes."""
        return self.folder.parents[1] / "calibration"


@cache
def read_sequence_names() -> MappingProxyType[str, tuple[str, ...]]:
    """Return the names of DexYCB's 100 recordings of each subject, in the order of their scene numbers, by subject."""
    lines = (files(__package__) / "sequence_names.txt").read_text().splitlines()
    pairs = [line.split("/") for line in lines if not line.startswith("#")]
    return MappingProxyType({subject: tuple(name for owner, name in pairs if owner == subject) for subject in SUBJECTS})


def find_sequences(raw: Path) -> tuple[list[SequenceFolder], list[str]]:
    """Find all recordings in a folder of raw DexYCB; raise `DataNotFoundError` if it has no `calibration/`.

    Returns:
        Recordings in the order of their scene numbers, and messages on what is missing, with path, reason and advice.
    """
    if not (raw / "calibration").is_dir():
        raise DataNotFoundError(
            f"{raw} is no raw DexYCB folder: it holds no calibration/. Give the folder that DexYCB's archives, also "
            "calibration.tar.gz, were expanded into."
        )
    sequences, missing = list[SequenceFolder](), list[str]()
    for number, subject in enumerate(SUBJECTS):
        folder, known = raw / subject, read_sequence_names()[subject]
        found = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
        names = found if len(found) == SEQUENCES_PER_SUBJECT and not {*found} & {*known} else known
        sequences += [
            SequenceFolder(SEQUENCES_PER_SUBJECT * number + rank, f"{subject}/{name}", folder / name)
            for rank, name in enumerate(names)
            if name in found
        ]
        absent = [name for name in names if name not in found]
        if absent:
            missing.append(
                f"{folder} lacks {len(absent)} of {SEQUENCES_PER_SUBJECT} recordings, such as {absent[0]}; expand "
                f"DexYCB's {subject}.tar.gz there"
            )
    return sequences, missing


def read_sequence(sequence: SequenceFolder) -> tuple[dict[str, Any], Float64, tuple[float, ...], Float32, Float32]:
    """Read a recording and its calibration.

    Returns:
        Content of meta.yml, see `read_meta`; pose [R | t] (3, 4) of the AprilTag in DexYCB's world frame (m); MANO's
        ten shape parameters of the person's hand; poses (F, n, 7) of the objects; poses (F, 51) of the hand. The poses
        are the float32 keyframes of `compute_object_trajectory` and `compute_hand_trajectory`, in DexYCB's world frame.
        The objects are in the order of `ycb_ids`.
    """
    meta = read_meta(sequence)
    objects, hand = _read_poses(sequence.folder / "pose.npz", len(meta["ycb_ids"]))
    extrinsics = sequence.calibration / f"extrinsics_{meta['extrinsics']}" / "extrinsics.yml"
    world_from_tag = _read_numbers(extrinsics, 12, "extrinsics", "apriltag").reshape(3, 4)
    return meta, world_from_tag, read_betas(sequence, meta), objects, hand


def read_betas(sequence: SequenceFolder, meta: dict[str, Any]) -> tuple[float, ...]:
    """Read MANO's ten shape parameters of the person's hand in a recording; `meta` is from `read_meta`."""
    path = sequence.calibration / f"mano_{meta['mano_calib'][0]}" / "mano.yml"
    return tuple(_read_numbers(path, N_BETAS, "betas").tolist())


def read_meta(sequence: SequenceFolder) -> dict[str, Any]:
    """Read a recording's meta.yml: `ycb_ids`, `ycb_grasp_ind`, `mano_sides`, `mano_calib` and `extrinsics`."""
    path = sequence.folder / "meta.yml"
    with report_damage(path, *_KIND_AND_ADVICE):
        content: Any = read_yaml(path, _MAX_YAML_BYTES)
        meta = {key: content[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides", "mano_calib", "extrinsics")}
        check_scene_meta(meta["ycb_ids"], meta["ycb_grasp_ind"], meta["mano_sides"])
        (_,) = meta["mano_calib"]
    return meta


def _read_numbers(path: Path, count: int, *keys: str) -> Float64:
    """Read a list of `count` numbers from a YAML file of nested mappings, in which `keys` lead to the list."""
    with report_damage(path, *_KIND_AND_ADVICE):
        values: Any = read_yaml(path, _MAX_YAML_BYTES)
        for key in keys:
            values = values[key]
        numbers = np.array(values, dtype=np.float64)
        if numbers.shape != (count,) or not np.isfinite(numbers).all():
            raise ValueError(f"{shorten_text(values)} where {count} numbers belong")
    return numbers


def _read_poses(path: Path, n_objects: int) -> tuple[Float32, Float32]:
    objects, hand = read_motion(path, {"pose_y": (n_objects, 7), "pose_m": (1, HAND_DOF)}, _KIND_AND_ADVICE[1])
    if hand.any(axis=(1, 2)).sum() < MIN_KEYFRAMES:
        raise DataFormatError(f"{path}: {len(hand)} frames, of which few have a hand; {_KIND_AND_ADVICE[1]}")
    if not objects[..., :4].any(axis=2).all():
        raise DataFormatError(f"{path}: poses of objects must never be zero; {_KIND_AND_ADVICE[1]}")
    return objects, hand[:, 0]


def compute_object_trajectory(poses: Float32, tag: TagFrame) -> Float32:
    """Return an object's motion (T, 6) float32 in the tag's frame at 1 kHz: position (m), Euler angles (rad).

    The angles are intrinsic XYZ and unwrapped. `poses` (F, 7) float32 are keyframes at 25 Hz in DexYCB's world frame:
    quaternion xyzw, position (m).
    """
    span = KeyframeSpan(0, len(poses) - 1)
    quaternions = tag.transform_rotations(Rotation.from_quat(poses[:, :4]))
    positions = tag.transform_points(poses[:, 4:])
    angles = scipy_euler_from_rotations(span.interpolate_rotations(quaternions)).astype(np.float32)
    return np.concatenate([span.interpolate_positions(positions), np.unwrap(angles, axis=0)], axis=1)


def compute_hand_trajectory(poses: Float32, tag: TagFrame, model: ManoModel, wrist: Float64, base: Float64) -> Float32:
    """Compute the joint trajectory (T, 51) float32 of the person's articulated hand in the tag's frame at 1 kHz.

    A row is base position (m), unwrapped base angles and finger angles (rad, intrinsic XYZ), zeros without a hand.
    `poses` (F, 51) float32 are keyframes at 25 Hz in DexYCB's world frame: rotation vector (rad), 45 coefficients of
    the finger pose, translation (m); zeros without a hand, which is only allowed at the start and at the end. `wrist`
    and `base` (3,) are positions of the wrist joint of `model` at rest (m): `wrist` for the shape parameters of this
    recording, `base` for the shape parameters of the subject's URDF.
    """
    present = np.flatnonzero(poses.any(axis=1))
    span = KeyframeSpan(int(present[0]), int(present[-1]))
    keyframes = poses[span.first : span.last + 1]
    quaternions = tag.transform_rotations(Rotation.from_rotvec(keyframes[:, :3]))
    rotation_vectors: Float32 = Rotation.from_quat(quaternions).as_rotvec().astype(np.float32)
    positions = _transform_base_positions(keyframes, rotation_vectors, tag, wrist, base)
    trajectory = np.zeros((count_frames(len(poses)), HAND_DOF), dtype=np.float32)
    trajectory[span.frames, :3] = span.interpolate_positions(positions)
    base_angles = _resample_angles(span, Rotation.from_rotvec(rotation_vectors))
    trajectory[span.frames, 3:6] = np.unwrap(base_angles, axis=0)
    finger_matrices = matrices_from_rotation_vectors(compute_finger_poses(model, keyframes[:, 3:48]).reshape(-1, 3))
    fingers = transforms3d_euler_from_matrices(finger_matrices).astype(np.float32).reshape(len(keyframes), -1, 3)
    for joint in range(fingers.shape[1]):
        keys = Rotation.from_euler("XYZ", fingers[:, joint])
        trajectory[span.frames, 6 + 3 * joint : 9 + 3 * joint] = _resample_angles(span, keys)
    return trajectory


def compute_finger_poses(model: ManoModel, coefficients: Float32) -> Float32:
    """Return the finger rotation vectors (n, 45) in rad for coefficients (n, 45) of MANO's principal components.

    The sums are float32, from left to right.
    """
    components, mean = model.hands_components.astype(np.float32), model.hands_mean.astype(np.float32)
    total = np.zeros_like(coefficients)
    for k in range(len(components)):
        total += coefficients[:, k, None] * components[k]
    return np.asarray(total + mean)


def _transform_base_positions(
    keyframes: Float32, rotation_vectors: Float32, tag: TagFrame, wrist: Float64, base: Float64
) -> Float32:
    offset = wrist.astype(np.float32)
    translations = tag.transform_points(keyframes[:, 48:] + offset) - offset
    products = matrices_from_rotation_vectors(rotation_vectors) * base
    rotated_base = (products[:, :, 0] + products[:, :, 1]) + products[:, :, 2]
    return np.asarray(((translations.astype(np.float64) + base) - rotated_base).astype(np.float32))


def _resample_angles(span: KeyframeSpan, keys: Rotation) -> Float32:
    # HandoverSim stores keyframes as float32 quaternions.
    rotations = span.interpolate_rotations(keys.as_quat().astype(np.float32))
    return scipy_euler_from_rotations(rotations).astype(np.float32)


#: MANO's 10 shape parameters by subject and side.
BetasBySubject = Mapping[tuple[str, str], tuple[float, ...]]


def find_first_betas(sequences: Iterable[SequenceFolder]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Return MANO's shape parameters by (subject, side), from the first readable recording of each such pair.

    HandoverSim places the root joint of a subject's hand model by the parameters of the first recording. In DexYCB the
    parameters of all recordings of a subject are equal, so unreadable recordings are skipped. For each subject, the
    side of the first readable recording comes first.
    """
    first: dict[tuple[str, str], tuple[float, ...]] = {}
    for sequence in sequences:
        if {(sequence.subject, "right"), (sequence.subject, "left")} <= first.keys():
            continue
        with contextlib.suppress(DataNotFoundError, DataFormatError):
            meta = read_meta(sequence)
            key = sequence.subject, meta["mano_sides"][0]
            if key not in first:
                first[key] = read_betas(sequence, meta)
    return first


def import_scene(
    sequence: SequenceFolder, models: Mapping[str, ManoModel], first_betas: BetasBySubject, out: Path
) -> None:
    """Import one recording: write its `meta_NNN.json` and `pose_NNN.npz` to `dex-ycb-cache/` in the data folder `out`.

    Existing files are kept; if they differ, `DataFormatError` is raised. The pose file has the motion at
    1 kHz: `pose_y` (T, n, 6) of the objects, see `compute_object_trajectory`, and `pose_m` (T, 1, 51) of the hand, see
    `compute_hand_trajectory`. `models` are MANO's models by side, `first_betas` is from `find_first_betas`.
    """
    meta, world_from_tag, betas, objects, hand = read_sequence(sequence)
    (side,) = meta["mano_sides"]
    model, tag = models[side], TagFrame(world_from_tag)
    base = model.locate_wrist(first_betas.get((sequence.subject, side), betas))
    trajectories = [compute_object_trajectory(objects[:, number], tag) for number in range(objects.shape[1])]
    hand_trajectory = compute_hand_trajectory(hand, tag, model, model.locate_wrist(betas), base)
    arrays = {"pose_y": np.stack(trajectories, axis=1), "pose_m": np.ascontiguousarray(hand_trajectory[:, None])}
    kept = {key: meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides")}
    text = json.dumps({"name": sequence.name, **kept, "mano_betas": [list(betas)]}).encode()
    cache = out / CACHE_FOLDER
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot make the folder {cache} ({error.strerror or error}); choose another") from error
    pose, meta_file = cache / f"pose_{sequence.scene_id:03d}.npz", cache / f"meta_{sequence.scene_id:03d}.json"
    if not pose.exists():
        write_arrays(pose, arrays)
    is_same = _has_arrays(pose, arrays)
    # The meta file is written last: it marks the scene as complete.
    if is_same and not meta_file.exists():
        write_atomically(meta_file, text)
    if not (is_same and has_content(meta_file, text)):
        raise DataFormatError(
            f"{meta_file if is_same else pose} exists, but differs from the result of this recording; remove it to "
            "have it written again, or choose another folder"
        )


def _has_arrays(path: Path, expected: dict[str, Float32]) -> bool:
    # The bytes of the archive depend on the time and the compressor, so arrays are compared.
    try:
        found = read_arrays(path, tuple(expected), MAX_MOTION_BYTES)
    except Exception:  # NumPy and zipfile raise exceptions of many types on damaged files
        return False
    # As bytes, since 0.0 equals -0.0.
    return all(
        found[name].shape == array.shape and found[name].tobytes() == array.tobytes()
        for name, array in expected.items()
    )
