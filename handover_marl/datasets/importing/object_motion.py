"""An object's recorded key poses as the joint positions that the simulator follows."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.euler_angles import angles_of_rotations
from handover_marl.datasets.importing.tag_frame import TagFrame
from handover_marl.datasets.importing.upsampling import Span

Float32 = npt.NDArray[np.float32]


def object_trajectory(poses: Float32, tag: TagFrame) -> Float32:
    """Motion of one object, present throughout.

    Args:
        poses: (F, 7) float32 key poses in the world frame, quaternion xyzw, then position (m).
        tag: The frame to go to.

    Returns:
        (T, 6) float32 position (m) and unwrapped intrinsic XYZ Euler angles (rad) in the tag's frame at 1 kHz.
    """
    span = Span(0, len(poses) - 1)
    quaternions = tag.quaternions(Rotation.from_quat(poses[:, :4]))
    positions = tag.points(poses[:, 4:])
    angles = angles_of_rotations(span.rotations(quaternions)).astype(np.float32)
    return np.concatenate([span.positions(positions), np.unwrap(angles, axis=0)], axis=1)
