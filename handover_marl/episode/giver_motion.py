"""Reference motion of hands and objects: joint targets, computed from recordings and the givers' actions.

A recording has a frame for each physics step (1 ms). The target object is the one that is handed over.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF, TIME_STEP, GiverConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.episode.wrist_offset import delay_steps, move_with_wrists, track_set_points
from handover_marl.geometry.arrays import (
    NUMPY_ARRAYS,
    AnyArray,
    AnyIndices,
    AnyIntegers,
    ArrayFactory,
    GrowableArray,
    Indices,
    get_namespace,
    is_tensor,
    make_constant,
    to_float64,
)
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.rotations import quaternions_from_euler, rotate_points
from handover_marl.simulation.reference_tracking import BASE_JOINTS, WRIST_LINK, ReferenceMotion

#: Number of physics steps for which the giver's motion is planned at a time.
PLANNED_STEPS = 200
#: Action of the giver that replays the recording.
NO_DEVIATION = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)
NO_DEVIATION.flags.writeable = False
#: Pick-up frame of objects that are never picked up.
NEVER = np.iinfo(np.int64).max
_BASE_LINK = 5
_HALF = OBJECT_DOF // 2


class NumpyRecordings:
    """Recordings of n givers as NumPy arrays.

    The argument `rows` (r,) of methods has indices of r givers, and `frames` (r, k) has indices of recorded frames.

    Args:
        count: Number n of givers.
    """

    def __init__(self, count: int) -> None:
        self._scenes: list[Scene | None] = [None] * count
        self._hand_present: list[npt.NDArray[np.bool_]] = [np.zeros(0, dtype=bool)] * count
        self._hands: list[npt.NDArray[np.float32]] = [np.zeros((0, HAND_DOF), dtype=np.float32)] * count
        self._poses: list[npt.NDArray[np.float32]] = [np.zeros((0, 2, 7), dtype=np.float32)] * count

    def set_scene(self, row: int, scene: Scene) -> None:
        """Set the scene whose recording the giver with index `row` plays back."""
        self._scenes[row], self._hand_present[row] = scene, scene.is_hand_present(np.arange(scene.n_frames))
        self._hands[row], self._poses[row] = extend_hand_bases(scene), compute_recorded_poses(scene)

    def read(self, rows: Indices, frames: Indices) -> ReferenceMotion:
        """Return copies (r, k, ...) of the joint positions of hand and objects in k recorded frames of each giver."""
        shape = frames.shape
        hand, present = np.empty((*shape, HAND_DOF), dtype=np.float32), np.empty(shape, dtype=bool)
        objects = np.zeros((*shape, MAX_OBJECTS, OBJECT_DOF), dtype=np.float32)
        for index, row in enumerate(rows.tolist()):
            scene, own = self._scenes[row], frames[index]
            if scene is None:
                raise ValueError(f"giver {row} has no scene; call reset() first")
            hand[index], present[index] = self._hands[row][own], self._hand_present[row][own]
            objects[index, :, : scene.object_dof.shape[1]] = scene.object_dof[own]
        return ReferenceMotion(objects, hand, present)

    def read_poses(self, rows: Indices, frames: Indices) -> AnyArray:
        """Return the world poses (r, k, 2, 7; xyz, xyzw) of wrist and target object in k recorded frames per giver."""
        poses = np.empty((*frames.shape, 2, 7), dtype=np.float32)
        for index, row in enumerate(rows.tolist()):
            poses[index] = self._poses[row][frames[index]]
        return poses


class TensorRecordings:
    """Recordings of n = `count` givers as tensors, with the methods of `NumpyRecordings`.

    `arrays` creates the tensors. They stay on the device; a recording of DexYCB takes 1.1 MB.
    """

    def __init__(self, count: int, arrays: ArrayFactory) -> None:
        self._firsts = arrays.zeros(count, "int64")
        self._first_by_scene: dict[int, int] = {}
        self._hand, self._present = GrowableArray(arrays, (HAND_DOF,), "float32"), GrowableArray(arrays, (), "bool")
        self._objects = GrowableArray(arrays, (MAX_OBJECTS, OBJECT_DOF), "float32")
        self._poses = GrowableArray(arrays, (2, 7), "float32")

    def set_scene(self, row: int, scene: Scene) -> None:
        """Set the scene whose recording the giver with index `row` plays back; copy each scene to the device once."""
        key = scene.info.scene_id
        if key not in self._first_by_scene:
            objects = np.zeros((scene.n_frames, MAX_OBJECTS, OBJECT_DOF), dtype=np.float32)
            objects[:, : scene.object_dof.shape[1]] = scene.object_dof
            self._objects.extend(objects)
            self._present.extend(scene.is_hand_present(np.arange(scene.n_frames)))
            self._poses.extend(compute_recorded_poses(scene))
            self._first_by_scene[key] = self._hand.extend(extend_hand_bases(scene))
        self._firsts[row] = self._first_by_scene[key]

    def read(self, rows: AnyArray, frames: AnyArray) -> ReferenceMotion:
        """Return copies (r, k, ...) of the joint positions of hand and objects in k recorded frames of each giver."""
        places = self._firsts[rows][:, None] + frames
        return ReferenceMotion(self._objects.rows[places], self._hand.rows[places], self._present.rows[places])

    def read_poses(self, rows: AnyArray, frames: AnyArray) -> AnyArray:
        """Return the world poses (r, k, 2, 7; xyz, xyzw) of wrist and target object in k recorded frames per giver."""
        return self._poses.rows[self._firsts[rows][:, None] + frames]


class GiverState(NamedTuple):
    """Playback state of n givers, arrays (n, ...), or their states after each of k planned steps, (n, k, ...).

    Attributes:
        clock: Playback time as a frame index, which need not be a whole number.
        frame: Index of the current frame: `clock`, rounded, and at most the last frame.
        rate_offset: Playback rate minus 1.
        opening_progress: Progress of the hand's opening after a voluntary release, 0 to 1.
        offset: Displacement (m) and rotation vector (rad) of the wrist, (..., 2, 3).
        velocity: Velocity of this offset (m/s, rad/s), (..., 2, 3).
        has_deviated: Whether the wrist has had an offset in this episode.
        angles: Euler angles (rad, intrinsic XYZ) of hand base and object, (..., 2, 3). The next step uses the
            equivalent angles that are nearest to these, so that no angle jumps.
    """

    clock: AnyArray
    frame: AnyArray
    rate_offset: AnyArray
    opening_progress: AnyArray
    offset: AnyArray
    velocity: AnyArray
    has_deviated: AnyArray
    angles: AnyArray


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """Planned motion of r givers in k physics steps.

    Attributes:
        rows: Indices (r,) of the givers.
        reference: Joint targets (r, k, ...) of hands and objects.
        states: States (r, k, ...) of the givers after each step.
    """

    rows: AnyIndices
    reference: ReferenceMotion
    states: GiverState

    @property
    def steps(self) -> int:
        """Number k of physics steps."""
        return int(self.states.frame.shape[1])


class GiverMotion:
    """Playback of one recording for each of n givers, with the deviations that the givers' actions request.

    `plan` returns the motion of the next physics steps; `commit` advances the playback by those that were simulated.
    Hand and held object deviate together, rigidly about the wrist, but only after the pick-up of the object: until then
    the hand must follow the recording to reach it. After its end, a recording stays at the last frame.

    Args:
        count: Number n of givers.
        config: Limits of the deviation from the recordings.
        arrays: Creator of the arrays of the motion.

    Attributes:
        state: State of the playback of each giver.
    """

    def __init__(self, count: int, config: GiverConfig, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._config, self._arrays = config, arrays
        is_numpy = arrays.xp is np
        self._recorded = NumpyRecordings(count) if is_numpy else TensorRecordings(count, arrays)
        self._last_frame, self._pick_up = arrays.zeros(count, "int64"), arrays.zeros(count, "int64")
        self._wrists_in_base = arrays.zeros((count, 3))
        self.state = GiverState(
            clock=arrays.zeros(count),
            frame=arrays.zeros(count, "int64"),
            rate_offset=arrays.zeros(count),
            opening_progress=arrays.zeros(count),
            offset=arrays.zeros((count, 2, 3)),
            velocity=arrays.zeros((count, 2, 3)),
            has_deviated=arrays.zeros(count, "bool"),
            angles=arrays.zeros((count, 2, 3), "float32"),
        )
        limits = [[config.speed, config.turn_speed], [config.acceleration, config.turn_acceleration]]
        self._limits = arrays.asarray(limits, "float64")
        self._ahead = arrays.asarray([round(time / TIME_STEP) for time in config.preview], "int64")

    def reset(self, row: int, scene: Scene) -> ReferenceMotion:
        """Start the playback of a scene by the giver with index `row`; return the first frame, a motion of one step."""
        self._recorded.set_scene(row, scene)
        self._last_frame[row], self._pick_up[row] = scene.n_frames - 1, find_pick_up_frame(scene)
        self._wrists_in_base[row] = self._arrays.asarray(compute_wrist_in_base(read_tree(scene.assets.hand)))
        for values in self.state:
            values[row] = 0
        angles = np.stack([scene.hand_dof[0, _HALF:BASE_JOINTS], scene.object_dof[0, 0, _HALF:]])
        self.state.angles[row] = self._arrays.asarray(angles)
        return ReferenceMotion(scene.object_dof[:1], scene.hand_dof[:1], scene.is_hand_present(np.array([0])))

    @property
    def holding(self) -> AnyArray:
        """Whether each person has picked up the object in the recording, (n,); stays True after a release."""
        return self.state.frame >= self._pick_up

    @property
    def deviation(self) -> AnyArray:
        """Current deviations (n, 7), float32: playback rate minus 1, wrist displacement (m), rotation vector (rad)."""
        xp, state = self._arrays.xp, self.state
        return xp.astype(xp.concat([state.rate_offset[:, None], state.offset.reshape(-1, 6)], axis=1), xp.float32)

    def read_previews(self, rows: AnyIndices) -> tuple[AnyArray, AnyArray]:
        """Return recorded world poses of the givers `rows` (r,), ahead of the current frame by `GiverConfig.preview`.

        Returns:
            (r, k, 7) poses of the wrists, zeros without a hand, and (r, k, 7) poses of the target objects at the k
            times of the preview: xyz (m) and quaternion xyzw, float32.
        """
        frames = self.state.frame[rows][:, None] + self._ahead
        poses = self._recorded.read_poses(rows, self._arrays.xp.minimum(frames, self._last_frame[rows][:, None]))
        return poses[:, :, 0], poses[:, :, 1]

    def plan(
        self, rows: AnyIndices, steps: int, actions: AnyArray, released: AnyArray, is_opening: AnyArray
    ) -> PlannedMotion:
        """Return the motion of r givers in the next physics steps, without advancing the playback.

        Args:
            rows: Indices (r,) of the givers.
            steps: Number of physics steps k.
            actions: (r, 8) actions of these givers.
            released: Whether each object has been released, so that it does not follow the hand, (r,).
            is_opening: Whether each hand opens after a voluntary release, (r,).
        """
        xp, state = self._arrays.xp, GiverState(*(values[rows] for values in self.state))
        actions = to_float64(actions)
        rates, clocks = self._plan_clocks(state, actions[:, 0], steps)
        # Playback times often end in .5; they are rounded to 9 digits first, so that rounding errors do not decide.
        frames = xp.astype(xp.round(xp.round(clocks * 1e9) / 1e9), xp.int64)
        frames = xp.minimum(frames, self._last_frame[rows][:, None])
        reference = self._recorded.read(rows, frames)
        progress = xp.broadcast_to(state.opening_progress[:, None], frames.shape)
        if _is_any_set(is_opening):
            progress = self._open_hands(reference, progress, is_opening)
        offsets, velocities = self._arrays.zeros((2, len(rows), steps, 2, 3))
        is_moving = state.has_deviated | xp.any(actions[:, 1:7] != 0.0, axis=1)
        if _is_any_set(is_moving):
            # An object that is picked up during these steps must not move early: until then, the offset stays zero.
            delays = count_steps_until_pick_up(self._pick_up[rows], state.frame, frames)
            set_points = xp.where(delays[:, None] < steps, actions[:, 1:7], 0.0).reshape(-1, 2, 3)
            is_moving = state.has_deviated | xp.any(set_points != 0.0, axis=(1, 2))
            moving = xp.nonzero(is_moving)[0]
            if len(moving):
                who = state.offset[moving], state.velocity[moving], set_points[moving]
                track = track_set_points(*who, steps, self._limits)
                offsets[moving], velocities[moving] = (delay_steps(part, delays[moving]) for part in track)
                self._move_with_wrists(rows, moving, reference, offsets[moving], released)
        states = GiverState(
            clock=clocks,
            frame=frames,
            rate_offset=rates,
            opening_progress=progress,
            offset=offsets,
            velocity=velocities,
            has_deviated=xp.broadcast_to(is_moving[:, None], frames.shape),
            angles=xp.stack([reference.hand[..., _HALF:BASE_JOINTS], reference.objects[..., 0, _HALF:]], axis=-2),
        )
        return PlannedMotion(rows, reference, states)

    def plan_until_release(self, rows: AnyIndices, steps: int, actions: AnyArray, *flags: AnyArray) -> PlannedMotion:
        """Return the motion of `steps`, at most 200, physics steps; arguments as for `plan`.

        A release that is requested before the pick-up takes effect at the pick-up; in this case, the motion ends there.
        """
        motion = self.plan(rows, min(steps, PLANNED_STEPS), actions, *flags)
        if _is_any_set(is_requested := requests_release(actions)):
            until = count_steps_until_pick_up(self._pick_up[rows], self.state.frame[rows], motion.states.frame)
            if len(until := until[is_requested & (until > 0) & (until < motion.steps)]):
                return self.plan(rows, int(until.min()), actions, *flags)
        return motion

    def commit(self, motion: PlannedMotion, steps: AnyIntegers) -> None:
        """Advance the playback by the planned steps that were simulated.

        Args:
            motion: Motion as returned by `plan`.
            steps: Number of simulated steps (r,) of each giver.
        """
        simulated = self._arrays.xp.nonzero(steps)[0]
        rows, last = motion.rows[simulated], steps[simulated] - 1
        for values, planned in zip(self.state, motion.states, strict=True):
            values[rows] = planned[simulated, last]

    def _plan_clocks(self, state: GiverState, targets: AnyArray, steps: int) -> tuple[AnyArray, AnyArray]:
        """Return playback rates minus 1 and playback times (frames) after each of k steps, (r, k) each.

        Args:
            state: States of r givers.
            targets: Rates minus 1 (r,) to reach.
            steps: Number k of physics steps.
        """
        xp, clocks = self._arrays.xp, state.clock[:, None]
        if not _is_any_set((state.rate_offset != 0.0) | (targets != 0.0)):
            clocks = clocks + xp.astype(self._arrays.arange(steps) + 1, xp.float64)
            return self._arrays.zeros(clocks.shape), clocks
        rates = ramp_rates(state.rate_offset, targets, self._config.rate_change, steps)
        return rates, clocks + xp.cumsum(1.0 + rates, axis=1)

    def _open_hands(self, reference: ReferenceMotion, progress: AnyArray, is_opening: AnyArray) -> AnyArray:
        """Move the finger angles of opening hands towards zero, which is a flat hand in MANO.

        Args:
            reference: Reference motion of r givers in k steps, which is changed in place.
            progress: Progress of the opening (r, k) before the first step.
            is_opening: Whether each hand opens, (r,).

        Returns:
            Progress of the opening (r, k) after each step.
        """
        xp, config, opening = self._arrays.xp, self._config, is_opening[:, None]
        ticks = xp.astype(self._arrays.arange(progress.shape[1]) + 1, xp.float64) * opening
        progress = xp.clip(progress + TIME_STEP / config.opening_time * ticks, 0.0, 1.0)
        scale = 1.0 - config.opening * progress * opening
        reference.hand[..., BASE_JOINTS:] *= xp.astype(scale[..., None], xp.float32)
        return progress

    def _move_with_wrists(
        self, rows: AnyIndices, moving: AnyIndices, reference: ReferenceMotion, offsets: AnyArray, released: AnyArray
    ) -> None:
        """Move hands and held objects with the offsets of their wrists, in the reference motion.

        Args:
            rows: Indices (r,) of the givers.
            moving: Indices (d,) in `rows` of the givers whose wrists have an offset.
            reference: Reference motion of r givers, which is changed in place.
            offsets: Displacements (m) and rotation vectors (rad) of these wrists, (d, k, 2, 3).
            released: Whether each object has been released, (r,).
        """
        xp, who = self._arrays.xp, rows[moving]
        bodies = xp.stack([reference.hand[moving][..., :BASE_JOINTS], reference.objects[moving][..., 0, :]], axis=2)
        moved = move_with_wrists(bodies, offsets, self._wrists_in_base[who], self.state.angles[who])
        reference.hand[moving, :, :BASE_JOINTS] = moved[:, :, 0]
        is_held = ~released[moving][:, None, None]
        reference.objects[moving, :, 0] = xp.where(is_held, moved[:, :, 1], bodies[:, :, 1])


def _is_any_set(flags: AnyArray) -> bool:
    """Return whether any flag (r,) is set; always True for tensors, since reading them from a GPU would take long."""
    return is_tensor(flags) or bool(flags.any())


def requests_release(giver_actions: AnyArray) -> AnyArray:
    """Return whether each of the givers' actions (..., 8) requests the release of the object, (...)."""
    return giver_actions[..., 7] > 0.5


def count_steps_until_pick_up(pick_up_frames: AnyArray, current_frames: AnyArray, frames: AnyArray) -> AnyArray:
    """Count how many (r,) of the next k physics steps of each of r givers start before the pick-up of the object.

    Args:
        pick_up_frames: Frames (r,) in which the objects are picked up.
        current_frames: Current frames (r,).
        frames: Frames (r, k) after each step.
    """
    xp = get_namespace(frames)
    return xp.sum(xp.concat([current_frames[:, None], frames[:, :-1]], axis=1) < pick_up_frames[:, None], axis=1)


def ramp_rates(rates: AnyArray, targets: AnyArray, max_slope: float, steps: int) -> AnyArray:
    """Return playback rates minus 1 (r, k) after each of k steps; the rates approach `targets` with limited slope.

    Args:
        rates: Current rates minus 1 (r,).
        targets: Rates minus 1 (r,) to reach.
        max_slope: Largest change of a rate (1/s).
        steps: Number k of physics steps.
    """
    xp, change = get_namespace(rates), (targets - rates)[:, None]
    limits = make_constant(tuple(range(1, steps + 1)), rates) * (max_slope * TIME_STEP)
    limited = xp.minimum(xp.maximum(change, -limits), limits)
    return xp.where(xp.abs(limited) < xp.abs(change), rates[:, None] + limited, targets[:, None])


def extend_hand_bases(scene: Scene) -> npt.NDArray[np.float32]:
    """Return the hand's joint positions (n, 51; m, rad) in the n frames of a scene, with base poses in all frames.

    Frames without a hand get the base pose of the nearest frame with one: an object moved with the wrist cannot jump.
    """
    if scene.hand_first is None or scene.hand_last is None:
        return scene.hand_dof
    hand, last = scene.hand_dof.copy(), min(scene.hand_last, scene.n_frames - 1)
    hand[:, :BASE_JOINTS] = hand[np.arange(scene.n_frames).clip(min(scene.hand_first, last), last), :BASE_JOINTS]
    return hand


def compute_recorded_poses(scene: Scene) -> npt.NDArray[np.float32]:
    """Compute the recorded poses (n, 2, 7) of wrist and target object in the n frames of a scene.

    Poses are xyz (m) and quaternion xyzw in the world frame; zeros for the wrist in frames without a hand.
    """
    bases = np.stack([scene.hand_dof[:, :BASE_JOINTS], scene.object_dof[:, 0]], axis=1).astype(np.float64)
    poses = np.concatenate([bases[..., :_HALF], quaternions_from_euler(bases[..., _HALF:])], axis=-1)
    poses[:, 0, :_HALF] += rotate_points(poses[:, 0, _HALF:], compute_wrist_in_base(read_tree(scene.assets.hand)))
    poses[~scene.is_hand_present(np.arange(scene.n_frames)), 0] = 0.0
    return poses.astype(np.float32)


@functools.lru_cache(maxsize=64)
def compute_wrist_in_base(hand: KinematicTree) -> npt.NDArray[np.float64]:
    """Compute the position (3,) of a human wrist in the frame of the base of the hand's model (m)."""
    origins, _ = hand.compute_link_frames(np.zeros((1, hand.n_dof)))
    wrist_in_base: npt.NDArray[np.float64] = origins[0, WRIST_LINK] - origins[0, _BASE_LINK]
    return wrist_in_base


def find_pick_up_frame(scene: Scene, distance: float = 0.005) -> int:
    """Return the first frame in which the target object is over `distance` (m) from its start, or `NEVER`."""
    moved = np.linalg.norm(scene.object_dof[:, 0, :3] - scene.object_dof[0, 0, :3], axis=1) > distance
    return int(np.argmax(moved)) if moved.any() else NEVER
