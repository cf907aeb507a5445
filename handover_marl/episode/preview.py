"""What the giver knows of its own recording: where wrist and object are about to be."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, GiverConfig
from handover_marl.datasets.scene import Scene
from handover_marl.episode.carrying import wrist_points
from handover_marl.episode.playback import wrist_place
from handover_marl.models.chain_angles import quaternions

# Frames for which poses are worked out at once: most episodes end long before the recording.
_BLOCK = 1000


class Preview:
    """The recorded poses of a scene.

    Args:
        scene: The recording.
        config: How far ahead the giver looks.
    """

    def __init__(self, scene: Scene, config: GiverConfig) -> None:
        self._scene, self._wrist_place = scene, wrist_place(scene)
        self._ahead = np.array([round(time / TIME_STEP) for time in config.preview])
        self._first = self._end = 0
        self._wrist = self._object = np.zeros((0, 7), dtype=np.float32)

    def wrist_poses(self, frame: int) -> npt.NDArray[np.float32]:
        """(k, 7) recorded wrist poses ahead of a frame, xyz (m), quaternion xyzw; zeros without a hand."""
        rows = self._rows(frame)
        return self._wrist[rows]

    def object_poses(self, frame: int) -> npt.NDArray[np.float32]:
        """(k, 7) recorded poses of the object to be given ahead of a frame."""
        rows = self._rows(frame)
        return self._object[rows]

    def _rows(self, frame: int) -> npt.NDArray[np.int_]:
        frames: npt.NDArray[np.int_] = np.minimum(frame + self._ahead, self._scene.n_frames - 1)
        first, last = int(frames.min()), int(frames.max())
        if first < self._first or last >= self._end:
            self._work_out(first, min(last + _BLOCK, self._scene.n_frames))
        return frames - self._first

    def _work_out(self, first: int, end: int) -> None:
        scene, self._first, self._end = self._scene, first, end
        hand, item = scene.hand_dof[first:end], scene.object_dof[first:end, 0]
        present = scene.hand_present(np.arange(first, end))
        wrist = _poses(wrist_points(hand, self._wrist_place), hand[:, 3:6])
        self._wrist = np.where(present[:, None], wrist, np.float32(0.0))
        self._object = _poses(item[:, :3], item[:, 3:])


def _poses(positions: npt.NDArray[np.floating], angles: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    poses: npt.NDArray[np.float32] = np.concatenate([positions, quaternions(angles)], axis=1).astype(np.float32)
    return poses
