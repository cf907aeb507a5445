"""What the giver knows of its own recording: where wrist and object are about to be."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP, GiverConfig
from handover_marl.datasets.scene import Scene
from handover_marl.episode.carrying import wrist_points
from handover_marl.episode.playback import wrist_place


class Preview:
    """The recorded poses of a scene.

    Args:
        scene: The recording.
        config: How far ahead the giver looks.
    """

    def __init__(self, scene: Scene, config: GiverConfig) -> None:
        self._ahead = np.array([round(time / TIME_STEP) for time in config.preview])
        present = scene.hand_present(np.arange(scene.n_frames))
        wrist = _poses(wrist_points(scene.hand_dof, wrist_place(scene)), scene.hand_dof[:, 3:6])
        self._wrist = np.where(present[:, None], wrist, 0.0).astype(np.float32)
        self._object = _poses(scene.object_dof[:, 0, :3], scene.object_dof[:, 0, 3:])

    def wrist_poses(self, frame: int) -> npt.NDArray[np.float32]:
        """(k, 7) recorded wrist poses ahead of a frame, xyz (m), quaternion xyzw; zeros without a hand."""
        return self._at(self._wrist, frame)

    def object_poses(self, frame: int) -> npt.NDArray[np.float32]:
        """(k, 7) recorded poses of the object to be given ahead of a frame."""
        return self._at(self._object, frame)

    def _at(self, poses: npt.NDArray[np.float32], frame: int) -> npt.NDArray[np.float32]:
        coming: npt.NDArray[np.float32] = poses[np.minimum(frame + self._ahead, len(poses) - 1)]
        return coming


def _poses(positions: npt.NDArray[np.floating], angles: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    quaternions = Rotation.from_euler("XYZ", angles.astype(np.float64)).as_quat()
    poses: npt.NDArray[np.float32] = np.concatenate([positions, quaternions], axis=1).astype(np.float32)
    return poses
