"""Motion of many givers on one device.

The functions compute what `handover_marl.episode.giver_motion` computes for NumPy arrays, without choosing rows
by their values, which would have to be read from the device.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF, TIME_STEP, GiverConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import (
    NEVER,
    count_steps_until_pick_up,
    find_pick_up_frame,
    find_wrist_in_base,
    ramp_rates,
)
from handover_marl.episode.wrist_offset import delay_steps, track_set_points
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, RowBank, expand_mask
from handover_marl.geometry.poses import (
    find_nearest_euler,
    multiply_quaternions,
    quaternions_from_euler,
    rotate_points,
)
from handover_marl.geometry.rotations import euler_from_quaternions, quaternions_from_rotation_vectors
from handover_marl.simulation.reference_tracking import BASE_JOINTS
from handover_marl.simulation.tensor_state import ReferenceBatch


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


_HALF = BASE_JOINTS // 2


@dataclass(frozen=True, eq=False)
class TensorPlan:
    """Planned motion of r givers in k physics steps.

    Attributes:
        rows: Indices (r,) of the givers.
        reference: Targets of hands and objects.
        states: States (r, k, ...) of the givers after each step, by the names of their attributes.
    """

    rows: AnyArray
    reference: ReferenceBatch
    states: dict[str, AnyArray]


class TensorGiverMotion:
    """Playback of one recorded scene for each of n givers, with their deviations; see `GiverMotion`.

    Args:
        count: Number n of givers.
        config: Limits of the deviation from the recordings.
        arrays: Creator of tensors on the device.

    Attributes:
        frame: Current frame (n,) of each recording.
        rate: Playback rates minus 1 (n,).
        offset: Wrist displacement (m) and rotation vector (rad) of each giver, (n, 2, 3).
        opening_progress: Progress (n,) of each hand's opening, 0 to 1.
    """

    def __init__(self, count: int, config: GiverConfig, arrays: ArrayFactory) -> None:
        self._config, self._arrays = config, arrays
        self._bank = RecordingBank(config, arrays)
        self._recordings, self.frame = arrays.zeros(count, "int64"), arrays.zeros(count, "int64")
        self._clock, self.rate, self.opening_progress = arrays.zeros(count), arrays.zeros(count), arrays.zeros(count)
        self.offset, self._velocity = arrays.zeros((count, 2, 3)), arrays.zeros((count, 2, 3))
        self._has_deviated = arrays.zeros(count, "bool")
        # Last Euler angles of the hands' bases, from which the next ones continue without a jump.
        self._angles = arrays.zeros((count, 3), "float32")
        limits = [[config.speed, config.turn_speed], [config.acceleration, config.turn_acceleration]]
        self._limits = arrays.asarray(limits, "float64")

    def reset(self, row: int, scene: Scene) -> None:
        """Start to play a scene."""
        self._recordings[row] = self._bank.add(scene)
        self._has_deviated[row] = False
        for state in (self.frame, self._clock, self.rate, self.opening_progress, self.offset, self._velocity):
            state[row] = 0
        self._angles[row] = self._arrays.asarray(scene.hand_dof[0, _HALF:BASE_JOINTS])

    @property
    def holding(self) -> AnyArray:
        """Whether each person has picked up the object, so that displacements take effect, (n,)."""
        return self.frame >= self._bank.get_pick_up_frames(self._recordings)

    @property
    def deviation(self) -> AnyArray:
        """(n, 7) playback rates minus 1, wrist displacements (m) and rotation vectors (rad), float32."""
        xp = self._arrays.xp
        return xp.astype(xp.concat([self.rate[:, None], self.offset.reshape(-1, 6)], axis=1), xp.float32)

    def read_previews(self, rows: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return the previews (r, k, 7) of wrists and target objects; see `RecordingBank.read_previews`."""
        return self._bank.read_previews(self._recordings[rows], self.frame[rows])

    def plan(
        self, rows: AnyArray, steps: int, actions: AnyArray, released: AnyArray, is_opening: AnyArray
    ) -> TensorPlan:
        """Return the motion of r givers in the next physics steps, without advancing the playback.

        Args:
            rows: Indices (r,) of the givers.
            steps: Number of physics steps k.
            actions: (r, 8) actions.
            released: Whether each object has been released, so that it does not follow the hand, (r,).
            is_opening: Whether each hand opens after a voluntary release, (r,).
        """
        xp, recordings = self._arrays.xp, self._recordings[rows]
        actions = xp.astype(actions, xp.float64)
        rates = ramp_rates(self.rate[rows], actions[:, 0], self._config.rate_change, steps)
        clocks = self._clock[rows, None] + xp.cumsum(1.0 + rates, axis=1)
        # Rates often sum to halves; rounding to 9 digits first keeps float noise from deciding.
        frames = xp.astype(xp.round(xp.round(clocks * 1e9) / 1e9), xp.int64)
        frames = xp.minimum(frames, self._bank.get_last_frames(recordings)[:, None])
        recorded = self._bank.read_frames(recordings, frames)
        # An object that is picked up during these steps must not move early. Before, the offset is zero and at rest.
        delays = count_steps_until_pick_up(self._bank.get_pick_up_frames(recordings), self.frame[rows], frames)
        set_points = xp.where(delays[:, None] < steps, actions[:, 1:7], 0.0).reshape(-1, 2, 3)
        moving = self._has_deviated[rows] | xp.any(set_points != 0.0, axis=(1, 2))
        # The only value that is read from the device here; most givers follow their recordings.
        offsets, wrist_states = None, dict[str, AnyArray]()
        if bool(xp.any(moving)):
            track = track_set_points(self.offset[rows], self._velocity[rows], set_points, steps, self._limits)
            offsets, velocities = (delay_steps(part, delays).swapaxes(0, 1) for part in track)
            wrist_states = {"offset": offsets, "_velocity": velocities}
        ticks = xp.astype(self._arrays.arange(steps) + 1, xp.float64) * is_opening[:, None]
        pace = TIME_STEP / self._config.opening_time
        progress = xp.clip(self.opening_progress[rows, None] + pace * ticks, 0.0, 1.0)
        finger_scale = 1.0 - self._config.opening * progress * is_opening[:, None]
        reference = self._make_reference(rows, recorded, offsets, moving, moving & ~released, finger_scale)
        states = {
            "_clock": clocks,
            "frame": frames,
            "rate": rates,
            "opening_progress": progress,
            **wrist_states,
            "_has_deviated": xp.broadcast_to(moving[:, None], frames.shape),
            "_angles": reference.hand[..., _HALF:BASE_JOINTS],
        }
        return TensorPlan(rows, reference, states)

    def commit(self, plan: TensorPlan, steps: AnyArray) -> None:
        """Advance the playback by the planned steps that were simulated.

        Args:
            plan: Motion as returned by `plan`.
            steps: Number of simulated steps (r,) of each giver.
        """
        xp, rows = self._arrays.xp, plan.rows
        places, last = self._arrays.arange(len(rows)), xp.clip(steps - 1, 0)
        for name, values in plan.states.items():
            state = getattr(self, name)
            state[rows] = xp.where(expand_mask(steps > 0, state), values[places, last], state[rows])

    def _make_reference(
        self,
        rows: AnyArray,
        recorded: RecordedFrames,
        offsets: AnyArray | None,
        moving: AnyArray,
        moves_object: AnyArray,
        finger_scale: AnyArray,
    ) -> ReferenceBatch:
        """Move hands and held objects with their wrists' offsets, and open hands.

        Args:
            rows: Indices (r,) of the givers.
            recorded: Recorded frames (r, k).
            offsets: Offsets (r, k, 2, 3) of the wrists; None if no wrist has one.
            moving: Whether each wrist has an offset, (r,).
            moves_object: Whether the object moves with it, (r,).
            finger_scale: Factors (r, k) of the finger angles, 1 for hands that do not open.
        """
        xp, objects = self._arrays.xp, recorded.objects
        positions = xp.astype(objects[..., :_HALF], xp.float64)
        orientations = quaternions_from_euler(objects[..., _HALF:])
        base = recorded.hand[..., :BASE_JOINTS]
        if offsets is not None:
            base_position = xp.astype(base[..., :_HALF], xp.float64)
            turns = quaternions_from_euler(base[..., _HALF:])
            wrist = self._bank.get_wrists_in_base(self._recordings[rows])[:, None]
            pivots = base_position + rotate_points(turns, wrist)
            rotation = quaternions_from_rotation_vectors(offsets[..., 1, :])
            moved = pivots + offsets[..., 0, :] + rotate_points(rotation, base_position - pivots)
            angles = self._continue_angles(rows, multiply_quaternions(rotation, turns))
            moved_base = xp.astype(xp.concat([moved, angles], axis=-1), xp.float32)
            base = xp.where(moving[:, None, None], moved_base, base)
            held, turned = positions[..., 0, :], multiply_quaternions(rotation, orientations[..., 0, :])
            moved = pivots + offsets[..., 0, :] + rotate_points(rotation, held - pivots)
            mask = moves_object[:, None, None]
            positions[..., 0, :] = xp.where(mask, moved, held)
            orientations[..., 0, :] = xp.where(mask, turned, orientations[..., 0, :])
        fingers = recorded.hand[..., BASE_JOINTS:] * xp.astype(finger_scale[..., None], xp.float32)
        hand = xp.concat([base, fingers], axis=-1)
        return ReferenceBatch(hand, recorded.hand_present, positions, orientations)

    def _continue_angles(self, rows: AnyArray, quaternions: AnyArray) -> AnyArray:
        """Return Euler angles (r, k, 3) of quaternions (r, k, 4) that continue the last ones without a jump."""
        xp = self._arrays.xp
        angles = euler_from_quaternions(quaternions.reshape(-1, 4)).reshape(*quaternions.shape[:-1], 3)
        before, continued = xp.astype(self._angles[rows], xp.float64), []
        for step in range(angles.shape[1]):
            before = find_nearest_euler(angles[:, step], before)
            continued.append(before)
        return xp.stack(continued, axis=1)
