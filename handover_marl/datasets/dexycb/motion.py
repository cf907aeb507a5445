"""Conversion of DexYCB's keyframes (25 Hz) to joint trajectories of HandoverSim's bodies (1 kHz).

MANO turns a hand about the origin of its template and then translates it. HandoverSim's hand is an
articulated body whose base turns about its own origin, so translations depend on the hand's shape.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dexycb.mano import ManoModel
from handover_marl.datasets.dexycb.rotations import (
    Float32,
    Float64,
    KeyframeSpan,
    TagFrame,
    count_frames,
    matrices_from_rotation_vectors,
    scipy_euler_from_rotations,
    transforms3d_euler_from_matrices,
)


def compute_object_trajectory(poses: Float32, tag: TagFrame) -> Float32:
    """Return the motion (T, 6) float32 of an object in the tag's frame at 1 kHz: position (m), unwrapped XYZ angles.

    The keyframes (F, 7) float32 are in the world frame: quaternion xyzw, position (m).
    """
    span = KeyframeSpan(0, len(poses) - 1)
    quaternions = tag.transform_rotations(Rotation.from_quat(poses[:, :4]))
    positions = tag.transform_points(poses[:, 4:])
    angles = scipy_euler_from_rotations(span.interpolate_rotations(quaternions)).astype(np.float32)
    return np.concatenate([span.interpolate_positions(positions), np.unwrap(angles, axis=0)], axis=1)


def compute_hand_trajectory(poses: Float32, tag: TagFrame, model: ManoModel, wrist: Float64, base: Float64) -> Float32:
    """Compute the joint trajectory (T, 51) float32 of the articulated hand in the tag's frame at 1 kHz.

    It is base position (m), unwrapped base angles and finger angles (rad, intrinsic XYZ); zero without a hand. The
    keyframes (F, 51) float32 are in the world frame: rotation vector (rad), 45 coefficients of the finger pose,
    translation (m); rows without a hand, at both ends only, are zero. `wrist` and `base` are the root joint (3,) at
    rest (m) for the hand's shape in this recording, and in the articulated body.
    """
    span = find_hand_span(poses)
    keyframes = poses[span.first : span.last + 1]
    rotation_vectors = _transform_base_rotations(keyframes, tag)
    positions = _transform_base_positions(keyframes, rotation_vectors, tag, wrist, base)
    trajectory = np.zeros((count_frames(len(poses)), HAND_DOF), dtype=np.float32)
    trajectory[span.frames, :3] = span.interpolate_positions(positions)
    base_angles = _resample_angles(span, Rotation.from_rotvec(rotation_vectors))
    trajectory[span.frames, 3:6] = np.unwrap(base_angles, axis=0)
    fingers = _compute_finger_angles(compute_finger_poses(model, keyframes[:, 3:48]))
    for joint in range(fingers.shape[1]):
        keys = Rotation.from_euler("XYZ", fingers[:, joint])
        trajectory[span.frames, 6 + 3 * joint : 9 + 3 * joint] = _resample_angles(span, keys)
    return trajectory


def find_hand_span(poses: Float32) -> KeyframeSpan:
    """Return the range of keyframes with a hand, from the first to the last non-zero row of (F, 51)."""
    present = np.flatnonzero(poses.any(axis=1))
    return KeyframeSpan(int(present[0]), int(present[-1]))


def compute_finger_poses(model: ManoModel, coefficients: Float32) -> Float32:
    """Return the finger rotation vectors (n, 45) in rad for coefficients (n, 45) of principal components.

    The sums are float32, from left to right.
    """
    components, mean = model.hands_components.astype(np.float32), model.hands_mean.astype(np.float32)
    total = np.zeros_like(coefficients)
    for k in range(len(components)):
        total += coefficients[:, k, None] * components[k]
    return np.asarray(total + mean)


def _transform_base_rotations(keyframes: Float32, tag: TagFrame) -> Float32:
    quaternions = tag.transform_rotations(Rotation.from_rotvec(keyframes[:, :3]))
    return np.asarray(Rotation.from_quat(quaternions).as_rotvec().astype(np.float32))


def _transform_base_positions(
    keyframes: Float32, rotation_vectors: Float32, tag: TagFrame, wrist: Float64, base: Float64
) -> Float32:
    offset = wrist.astype(np.float32)
    translations = tag.transform_points(keyframes[:, 48:] + offset) - offset
    products = matrices_from_rotation_vectors(rotation_vectors) * base
    rotated_base = (products[:, :, 0] + products[:, :, 1]) + products[:, :, 2]
    return np.asarray(((translations.astype(np.float64) + base) - rotated_base).astype(np.float32))


def _compute_finger_angles(vectors: Float32) -> Float32:
    matrices = matrices_from_rotation_vectors(vectors.reshape(-1, 3))
    return transforms3d_euler_from_matrices(matrices).astype(np.float32).reshape(len(vectors), -1, 3)


def _resample_angles(span: KeyframeSpan, keys: Rotation) -> Float32:
    # HandoverSim stores keyframes as float32 quaternions.
    rotations = span.interpolate_rotations(keys.as_quat().astype(np.float32))
    return scipy_euler_from_rotations(rotations).astype(np.float32)
