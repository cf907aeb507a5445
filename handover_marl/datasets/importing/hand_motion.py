"""A hand's recorded key poses as the joint positions that the simulator follows.

DexYCB tells where MANO's root joint, moved as if it lay at the origin, turns and goes; HandoverSim's hand is an
articulated body whose base turns about the origin itself, so translations change with the person's shape.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import HAND_DOF
from handover_marl.datasets.importing.euler_angles import angles_of_matrices, angles_of_rotations
from handover_marl.datasets.importing.mano_model import ManoModel
from handover_marl.datasets.importing.rodrigues import matrices_from_vectors
from handover_marl.datasets.importing.tag_frame import TagFrame
from handover_marl.datasets.importing.upsampling import Span, n_frames

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


def hand_trajectory(poses: Float32, tag: TagFrame, model: ManoModel, wrist: Float64, base: Float64) -> Float32:
    """Motion of the hand.

    Args:
        poses: (F, 51) float32 key poses in the world frame: rotation vector (rad), 45 coefficients of the finger
            pose, translation (m); zero where there is no hand, which is only before and after it is seen.
        tag: The frame to go to.
        model: MANO's hand of the right side.
        wrist: (3,) root joint of this recording's hand at rest (m).
        base: (3,) root joint of the articulated body (m): the same, unless one person has two shapes.

    Returns:
        (T, 51) float32 base position (m), unwrapped base angles and finger angles (rad, intrinsic XYZ) in the tag's
        frame at 1 kHz; zero where there is no hand.
    """
    span = hand_span(poses)
    shown = poses[span.first : span.last + 1]
    turns = _base_turns(shown, tag)
    positions = _base_positions(shown, turns, tag, wrist, base)
    trajectory = np.zeros((n_frames(len(poses)), HAND_DOF), dtype=np.float32)
    trajectory[span.frames, :3] = span.positions(positions)
    base_angles = _resampled_angles(span, Rotation.from_rotvec(turns))
    trajectory[span.frames, 3:6] = np.unwrap(base_angles, axis=0)
    fingers = _finger_angles(finger_poses(model, shown[:, 3:48]))
    for joint in range(fingers.shape[1]):
        keys = Rotation.from_euler("XYZ", fingers[:, joint])
        trajectory[span.frames, 6 + 3 * joint : 9 + 3 * joint] = _resampled_angles(span, keys)
    return trajectory


def hand_span(poses: Float32) -> Span:
    """The key poses (F, 51) from the first to the last that are not zero, of which there must be one."""
    present = np.flatnonzero(poses.any(axis=1))
    return Span(int(present[0]), int(present[-1]))


def finger_poses(model: ManoModel, coefficients: Float32) -> Float32:
    """Finger rotation vectors (n, 45) in rad of principal coefficients (n, 45), by float32 sums from left to right."""
    components, mean = model.hands_components.astype(np.float32), model.hands_mean.astype(np.float32)
    total = np.zeros_like(coefficients)
    for k in range(len(components)):
        total += coefficients[:, k, None] * components[k]
    return np.asarray(total + mean)


def _base_turns(shown: Float32, tag: TagFrame) -> Float32:
    quaternions = tag.quaternions(Rotation.from_rotvec(shown[:, :3]))
    return np.asarray(Rotation.from_quat(quaternions).as_rotvec().astype(np.float32))


def _base_positions(shown: Float32, turns: Float32, tag: TagFrame, wrist: Float64, base: Float64) -> Float32:
    offset = wrist.astype(np.float32)
    moved = tag.points(shown[:, 48:] + offset) - offset
    products = matrices_from_vectors(turns) * base
    turned = (products[:, :, 0] + products[:, :, 1]) + products[:, :, 2]
    return np.asarray(((moved.astype(np.float64) + base) - turned).astype(np.float32))


def _finger_angles(vectors: Float32) -> Float32:
    matrices = matrices_from_vectors(vectors.reshape(-1, 3))
    return angles_of_matrices(matrices).astype(np.float32).reshape(len(vectors), -1, 3)


def _resampled_angles(span: Span, keys: Rotation) -> Float32:
    # The original keeps key poses as float32 quaternions.
    return angles_of_rotations(span.rotations(keys.as_quat().astype(np.float32))).astype(np.float32)
