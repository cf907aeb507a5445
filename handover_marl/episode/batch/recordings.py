"""Recordings of many scenes on one device, copied there once."""

from typing import NamedTuple

import numpy as np

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF, TIME_STEP, GiverConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import NEVER, find_pick_up_frame, find_wrist_in_base
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, RowBank
from handover_marl.geometry.poses import quaternions_from_euler, rotate_points


class RecordedFrames(NamedTuple):
    """Recorded frames in any batch (...).

    Attributes:
        hand: Joint positions (..., 51) of the hand (m, rad), float32.
        hand_present: Whether the hand is in the scene, (...).
        objects: Joint positions (..., 5, 6) of the objects, zeros for no object: xyz (m), Euler angles (rad), float32.
    """

    hand: AnyArray
    hand_present: AnyArray
    objects: AnyArray


class RecordingBank:
    """Recordings by number, which stay on the device. One of DexYCB takes 0.9 MB.

    Args:
        config: Configuration of the giver, with the times of the preview.
        arrays: Creator of the arrays on the device.
    """

    def __init__(self, config: GiverConfig, arrays: ArrayFactory) -> None:
        self._arrays = arrays
        self._numbers: dict[int, int] = {}
        self._frames = RecordedFrames(
            RowBank(arrays, (HAND_DOF,), "float32"),
            RowBank(arrays, (), "bool"),
            RowBank(arrays, (MAX_OBJECTS, OBJECT_DOF), "float32"),
        )
        # First row, last frame and pick-up frame of each recording, and the wrist in the frame of the hand's base (m).
        self._bounds, self._wrists = RowBank(arrays, (3,), "int64"), RowBank(arrays, (3,), "float64")
        self._ahead = arrays.asarray([round(time / TIME_STEP) for time in config.preview], "int64")

    def add(self, scene: Scene) -> int:
        """Copy the recording of a scene to the device, unless it is there, and return its number."""
        key = scene.info.scene_id
        if key not in self._numbers:
            objects = np.zeros((scene.n_frames, MAX_OBJECTS, OBJECT_DOF), dtype=np.float32)
            objects[:, : scene.object_dof.shape[1]] = scene.object_dof
            values = (scene.hand_dof, scene.is_hand_present(np.arange(scene.n_frames)), objects)
            (first,) = {bank.extend(array) for bank, array in zip(self._frames, values, strict=True)}
            pick_up = find_pick_up_frame(scene)
            self._bounds.extend(np.array([first, scene.n_frames - 1, NEVER if pick_up is None else pick_up]))
            self._numbers[key] = self._wrists.extend(find_wrist_in_base(scene))
        return self._numbers[key]

    def get_last_frames(self, recordings: AnyArray) -> AnyArray:
        """Return the last frames (n,) of recordings with numbers (n,)."""
        return self._bounds.rows[recordings, 1]

    def get_pick_up_frames(self, recordings: AnyArray) -> AnyArray:
        """Return the frames (n,) in which the objects are picked up, `NEVER` if they are not."""
        return self._bounds.rows[recordings, 2]

    def get_wrists_in_base(self, recordings: AnyArray) -> AnyArray:
        """Return the positions (n, 3) of the wrists in the frames of the hands' bases (m)."""
        return self._wrists.rows[recordings]

    def read_frames(self, recordings: AnyArray, frames: AnyArray) -> RecordedFrames:
        """Return frames (n, k) of recordings with numbers (n,)."""
        rows = self._bounds.rows[recordings, 0][:, None] + frames
        return RecordedFrames(*(bank.rows[rows] for bank in self._frames))

    def read_previews(self, recordings: AnyArray, frames: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return recorded poses at the k preview times after frames (n,); see `observations.MotionPreview`.

        Returns:
            (n, k, 7) poses of the wrists, zeros without a hand, and (n, k, 7) poses of the target objects.
        """
        xp = self._arrays.xp
        last = self.get_last_frames(recordings)[:, None]
        frames_ahead = self.read_frames(recordings, xp.minimum(frames[:, None] + self._ahead, last))
        bases, objects = frames_ahead.hand[..., :OBJECT_DOF], frames_ahead.objects[..., 0, :]
        orientations = quaternions_from_euler(bases[..., 3:])
        wrists = bases[..., :3] + rotate_points(orientations, self.get_wrists_in_base(recordings)[:, None])
        poses = xp.astype(xp.concat([wrists, orientations], axis=-1), xp.float32)
        objects = xp.astype(
            xp.concat([objects[..., :3], quaternions_from_euler(objects[..., 3:])], axis=-1), xp.float32
        )
        return xp.where(frames_ahead.hand_present[..., None], poses, 0.0), objects
