"""Import of raw DexYCB recordings as scenes of HandoverSim's cache `dex-ycb-cache/`.

The import of a scene depends on no other scene, so scenes can be imported in parallel.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dexycb.mano import ManoModel
from handover_marl.datasets.dexycb.mano_rotations import (
    Float32,
    Float64,
    KeyframeSpan,
    TagFrame,
    count_frames,
    matrices_from_rotation_vectors,
    scipy_euler_from_rotations,
    transforms3d_euler_from_matrices,
)
from handover_marl.datasets.dexycb.raw_files import SequenceFolder, read_betas, read_meta, read_sequence
from handover_marl.datasets.official import CACHE_FOLDER, MAX_MOTION_BYTES
from handover_marl.errors import DataFormatError, DataNotFoundError, ResultsError
from handover_marl.execution.files import has_content, write_arrays, write_atomically
from handover_marl.execution.reading import read_arrays


def compute_object_trajectory(poses: Float32, tag: TagFrame) -> Float32:
    """Return an object's motion (T, 6) float32 in the tag's frame at 1 kHz: position (m), unwrapped XYZ Euler angles.

    The keyframes `poses` (F, 7) float32 are in DexYCB's world frame: quaternion xyzw, position (m).
    """
    span = KeyframeSpan(0, len(poses) - 1)
    quaternions = tag.transform_rotations(Rotation.from_quat(poses[:, :4]))
    positions = tag.transform_points(poses[:, 4:])
    angles = scipy_euler_from_rotations(span.interpolate_rotations(quaternions)).astype(np.float32)
    return np.concatenate([span.interpolate_positions(positions), np.unwrap(angles, axis=0)], axis=1)


def compute_hand_trajectory(poses: Float32, tag: TagFrame, model: ManoModel, wrist: Float64, base: Float64) -> Float32:
    """Compute the joint trajectory (T, 51) float32 of the person's articulated hand in the tag's frame at 1 kHz.

    A row is base position (m), unwrapped base angles and finger angles (rad, intrinsic XYZ); zero without a hand. The
    keyframes `poses` (F, 51) float32 are in DexYCB's world frame: rotation vector (rad), 45 coefficients of the finger
    pose, translation (m); rows without a hand, at both ends only, are zero. `wrist` is the root joint (3,) at rest (m)
    for the hand's shape in this recording, and `base` the root joint of the articulated body.
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
    """Return MANO's shape parameters by subject and side, from the first readable recording of each.

    HandoverSim places the root joint of a subject's hand model by the parameters of the first recording. In DexYCB the
    parameters of all recordings of a subject are equal, so unreadable recordings are skipped. For each subject, the
    side of the first readable recording comes first.
    """
    first: dict[tuple[str, str], tuple[float, ...]] = {}
    for sequence in sequences:
        if {(sequence.subject, "right"), (sequence.subject, "left")} <= first.keys():
            continue
        try:
            meta = read_meta(sequence)
            key = sequence.subject, meta["mano_sides"][0]
            if key not in first:
                first[key] = read_betas(sequence, meta)
        except (DataNotFoundError, DataFormatError):
            continue
    return first


def import_scene(
    sequence: SequenceFolder, models: Mapping[str, ManoModel], first_betas: BetasBySubject, out: Path
) -> None:
    """Import one recording: write the two files of its scene to `dex-ycb-cache/` in a data folder.

    Existing files must be equal. The motion is in the frame of the AprilTag on the table at 1 kHz: `pose_y` (T, n, 6),
    position (m) and intrinsic XYZ Euler angles (rad) of the objects, and `pose_m` (T, 1, 51), joint positions of the
    hand: 3 positions (m), 48 angles (rad). `models` are MANO's hand models by side, `first_betas` is from
    `find_first_betas`.

    Raises:
        DataNotFoundError, DataFormatError: A file of the recording is missing or damaged, or an existing file of the
            scene differs.
        ResultsError: A file cannot be written.
    """
    meta, world_from_tag, betas, objects, hand = read_sequence(sequence)
    (side,) = meta["mano_sides"]
    model, tag = models[side], TagFrame.from_extrinsics(world_from_tag)
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
