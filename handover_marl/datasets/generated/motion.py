"""Motion of the object and the hand of a generated handover: keyframes at 25 Hz, and their interpolation to 1 kHz.

The phases are reach, grasp, lift, handover and hold. Hand and object follow minimum-jerk profiles (Flash and Hogan,
1985) along curved paths. The recording starts during the first half of the reach, as in DexYCB, where the hand enters
the cameras' view. All poses are in the table's frame (m, rad). Keyframes are interpolated as in HandoverSim: positions
by cubic splines, rotations by slerp. Angles are intrinsic XYZ Euler angles, unwrapped for objects and the hand's base.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from handover_marl import config
from handover_marl.config import HAND_DOF, TIME_STEP
from handover_marl.datasets.dataset import TABLE_HEIGHT
from handover_marl.datasets.generated.placement import (
    JOINT_CLEARANCE,
    OBJECT_CLEARANCE,
    ClutterObject,
    ObjectPlacement,
    SimulatedGiver,
)
from handover_marl.datasets.generated.random_stream import FRAME_COUNTS, MIRROR_X, RandomStream, Seed, open_stream
from handover_marl.geometry.panda import SHOULDER_HEIGHT
from handover_marl.geometry.rotations import multiply_quaternions

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Time between keyframes (s), and frames of 1 ms between them.
KEYFRAME_PERIOD, _STRIDE = 0.04, 40

_PEAK_SPEED_RATIO = 1.875  # peak speed of a minimum-jerk motion divided by its mean speed
_LIFT_SPEED_RATIO = 0.95  # peak speed of the lift divided by that of the reach
_CLOSING_FRAMES = (5, 11)
_HOLD_FRAMES = 3
_MIN_REACH_LENGTH = 0.10  # m
_MIN_LIFT_TIME = 0.4  # s
_MAX_REACH_ROTATION = np.radians(60.0)
_SAMPLES = np.linspace(0.0, 1.0, 101)
# Spacing (rad or m) of a grid that values are rounded to. It hides the last bits of sines and splines, which differ
# between machines and versions of NumPy. It is a power of two, since decimal constants in the inputs would give ties.
_GRID = 2.0**-23
# Constants of scenes of the family `hard`. Duration of the motion (s).
_DURATION = 8.0
# Smallest and largest distance of the handover position from the robot's shoulder, and smallest height above the
# table (m).
_REACH, _MIN_HEIGHT = (0.70, 0.82), 0.12
#: Largest speed of the object's origin (m/s).
MAX_SPEED = 0.30
# Largest azimuth of the handover position from the robot's forward direction, and range of its elevation.
_MAX_AZIMUTH, _ELEVATION = 0.6, (-0.25, 0.25)  # rad
# Smallest and largest number of waypoints of the curve.
_N_WAYPOINTS = (3, 6)
# Largest distance of a waypoint from the handover position along x, y and z (m), and component of its rotation (rad).
_EXTENT, _MAX_TURN = (0.12, 0.08, 0.10), 0.9
# Smallest and largest value of a scene's peak angular speed (rad/s).
_TURN_SPEED = (np.radians(30.0), np.radians(90.0))


@dataclass(frozen=True, eq=False)
class KeyframeMotion:
    """T keyframes, 40 ms apart, of the handed-over object and the hand, in the table's frame (m, rad).

    Attributes:
        object_position: (T, 3) position of the object.
        object_rotation: T rotations of the object.
        base_position: (T, 3) position of the hand's base; valid from keyframe `hand_first` on.
        base_rotation: T rotations of the hand's base.
        fingers: (T, 45) finger joint angles.
        hand_first: First keyframe in which the hand is visible; it remains visible to the end.
    """

    object_position: Array
    object_rotation: Rotation
    base_position: Array
    base_rotation: Rotation
    fingers: Array
    hand_first: int


@dataclass(frozen=True)
class HandoverTiming:
    """Keyframe numbers of the events of a handover, and the visible part of the reach.

    Attributes:
        n_keyframes: Number of keyframes.
        onset_keyframe: Keyframe in which the hand becomes visible.
        grasp_keyframe: Keyframe in which the hand reaches the object and starts to close.
        lift_keyframe: Keyframe in which the fingers are closed and the object leaves the table.
        arrival_keyframe: Keyframe in which the object reaches the handover pose.
        onset_share: Fraction (0 to 1) of the reach's duration that has passed at the onset.
        reach: Length of the wrist's path from the onset to the grasp (m).
    """

    n_keyframes: int
    onset_keyframe: int
    grasp_keyframe: int
    lift_keyframe: int
    arrival_keyframe: int
    onset_share: float
    reach: float


def draw_motion(seed: Seed, placement: ObjectPlacement, giver: SimulatedGiver) -> KeyframeMotion:
    """Draw keyframes of the object and the hand, from the object's start pose to the handover pose of a placement."""
    random = open_stream(seed, "motion")
    side_sign = 1.0 if giver.grasps.side == "right" else -1.0
    speed = random.draw_quantile("peak_speed")
    handover_path = _HandoverPath(placement, giver)
    entry = np.array([random.draw_quantile(name) for name in ("entry_x", "entry_y", "entry_z")])
    entry[0] = MIRROR_X + side_sign * (entry[0] - MIRROR_X)
    wrist = placement.start[0] + placement.start[1] @ giver.keypoints[placement.grasp, 0]
    timing = _draw_timing(
        open_stream(seed, "timing"), speed, float(np.linalg.norm(entry - wrist)), handover_path.compute_duration(speed)
    )
    sway = np.array([random.uniform(-0.004, 0.004) for _ in range(3)])
    position, rotation = handover_path.sample_keyframes(timing, sway)
    return _add_hand_motion(timing, position, rotation, entry, placement, giver)


def minimum_jerk(time: npt.ArrayLike) -> Array:
    """Return the progress, 0 to 1, of a minimum-jerk motion at times in units of its duration, clipped to [0, 1]."""
    t = np.clip(np.asarray(time, dtype=np.float64), 0.0, 1.0)
    return t * t * t * (10.0 + t * (6.0 * t - 15.0))


def _draw_timing(random: RandomStream, speed: float, entry_distance: float, lift_time: float) -> HandoverTiming:
    """Draw a timing with a number of keyframes as in DexYCB; with few keyframes, reach and lift are shorter.

    `speed` is the wrist's peak speed (m/s), `entry_distance` the length of the reach (m), `lift_time` is in s.
    """
    n_keyframes = list(FRAME_COUNTS)[random.weighted_index(list(FRAME_COUNTS.values()))]
    onset = round(random.draw_quantile("hand_onset"))
    onset_share = random.uniform(0.05, 0.40)
    close = _CLOSING_FRAMES[0] + random.integer(_CLOSING_FRAMES[1] - _CLOSING_FRAMES[0])
    lift_frames = int(np.ceil(lift_time / KEYFRAME_PERIOD)) + random.integer(8)
    latest = n_keyframes - 1 - _HOLD_FRAMES
    visible_share = 1.0 - float(minimum_jerk(onset_share))
    reach = max(entry_distance, _MIN_REACH_LENGTH)
    frames_per_m = _PEAK_SPEED_RATIO * (1.0 - onset_share) / (visible_share * speed * KEYFRAME_PERIOD)
    while onset + reach * frames_per_m + close + lift_frames > latest and reach > _MIN_REACH_LENGTH:
        reach *= 0.95
    grasp = onset + max(4, round(reach * frames_per_m))
    # The duration in whole frames and the peak speed determine the length.
    reach = (grasp - onset) / frames_per_m
    spare = latest - (grasp + close + lift_frames)
    if spare < 0:
        lift_frames, spare = max(8, lift_frames + spare), 0
    pause = random.integer(spare + 1) // 3
    lift = grasp + close + pause
    return HandoverTiming(n_keyframes, onset, grasp, lift, min(lift + lift_frames, n_keyframes - 1), onset_share, reach)


class _HandoverPath:
    """Path of the object from the table to the handover pose: a Bezier curve that rises first.

    Args:
        placement: Poses of the object on the table and at the handover, and the grasp.
        giver: Person with the object.
    """

    def __init__(self, placement: ObjectPlacement, giver: SimulatedGiver) -> None:
        (start, start_rotation), (end, end_rotation) = placement.start, placement.handover
        self._start, self._end = start, end
        self._first, last = Rotation.from_matrix(np.stack([start_rotation, end_rotation])).as_quat()
        between = multiply_quaternions(self._first * [-1.0, -1.0, -1.0, 1.0], last)
        self._turn = Rotation.from_quat(between).as_rotvec()
        keypoints = giver.keypoints[placement.grasp]
        self._wrist = keypoints[0]
        self._points = np.concatenate([giver.corners, keypoints])
        self._clearance = np.repeat([OBJECT_CLEARANCE, JOINT_CLEARANCE], [len(giver.corners), len(keypoints)])
        self._rise = 0.0
        self._rise = self._compute_rise()

    def sample(self, progress: Array) -> tuple[Array, Rotation]:
        """Return positions (n, 3) in m and n rotations of the object at `progress` (n,) along the path, from 0 to 1."""
        control = np.array([self._start[0], self._start[1], max(self._start[2], self._end[2])])
        positions = _bezier(progress, self._start, control, self._end)
        positions[:, 2] += self._rise * (4.0 * progress * (1.0 - progress)) ** 0.5
        shares = np.clip((progress - 0.05) / 0.95, 0.0, 1.0)
        turns = Rotation.from_rotvec(shares[:, None] * self._turn).as_quat()
        return positions, Rotation.from_quat(multiply_quaternions(self._first, turns))

    def compute_duration(self, speed: float) -> float:
        """Return the duration (s) of the path at a wrist's peak speed of 0.95 `speed` (m/s), but at least 0.4 s."""
        position, rotation = self.sample(minimum_jerk(_SAMPLES))
        wrist = position + rotation.apply(self._wrist)
        fastest = float(np.linalg.norm(np.diff(wrist, axis=0), axis=1).max()) / float(_SAMPLES[1])
        return max(fastest / (_LIFT_SPEED_RATIO * speed), _MIN_LIFT_TIME)

    def sample_keyframes(self, timing: HandoverTiming, sway: Array) -> tuple[Array, Rotation]:
        """Return T positions (T, 3) (m) and rotations of the object; held out, it moves by `sway` (3,) (m) and back."""
        frames = np.arange(timing.n_keyframes)
        progress = minimum_jerk((frames - timing.lift_keyframe) / (timing.arrival_keyframe - timing.lift_keyframe))
        position, rotation = self.sample(progress)
        rest = max(timing.n_keyframes - 1 - timing.arrival_keyframe, 1)
        held = np.clip((frames - timing.arrival_keyframe) / rest, 0.0, 1.0)
        position += sway * (0.5 - 0.5 * np.cos(2.0 * np.pi * held))[:, None]
        return position, rotation

    def _compute_rise(self) -> float:
        """Return the height (m) to add in the middle of the path for clearance above the table."""
        progress = minimum_jerk(_SAMPLES)[1:-1]
        position, rotation = self.sample(progress)
        heights = rotation.as_matrix()[:, 2] @ self._points.T - self._clearance
        missing = -(position[:, 2] + heights.min(axis=1))
        return max(0.0, float((missing / (4.0 * progress * (1.0 - progress)) ** 0.5).max()))


def _add_hand_motion(
    timing: HandoverTiming,
    position: Array,
    rotation: Rotation,
    entry: Array,
    placement: ObjectPlacement,
    giver: SimulatedGiver,
) -> KeyframeMotion:
    """Add a hand's motion to T object poses: it reaches from the direction of `entry` (3,), then follows the object."""
    grasps, row = giver.grasps, placement.grasp
    object_from_hand = Rotation.from_matrix(giver.object_from_hand[row])
    base_rotation = Rotation.from_quat(multiply_quaternions(rotation.as_quat(), object_from_hand.as_quat()))
    wrist = position + rotation.apply(giver.keypoints[row, 0])
    onset, grasp, n_closing = timing.onset_keyframe, timing.grasp_keyframe, timing.lift_keyframe - timing.grasp_keyframe
    reaching = np.arange(onset, grasp)
    # Progress along the visible part of the reach, 0 to 1.
    shares = minimum_jerk(timing.onset_share + (1.0 - timing.onset_share) * ((reaching - onset) / (grasp - onset)))
    progress = (shares - minimum_jerk(timing.onset_share)) / (1.0 - minimum_jerk(timing.onset_share))
    start_rotation = Rotation.from_matrix(placement.start[1])
    finger_direction = start_rotation.apply(grasps.finger_direction[row])
    wrist[reaching] = _compute_reach_path(entry, wrist[grasp], finger_direction, timing.reach, progress)
    turns = _compute_reach_rotations(wrist[onset], wrist[grasp], finger_direction, progress)
    rotations = base_rotation.as_quat()
    rotations[reaching] = multiply_quaternions(turns.as_quat(), rotations[grasp])
    closing = minimum_jerk((np.arange(timing.n_keyframes) - grasp) / n_closing)[:, None]
    fingers = (1.0 - closing) * grasps.open_angles[row] + closing * grasps.finger_angles[row]
    base_rotation = Rotation.from_quat(rotations)
    base = wrist - base_rotation.apply(giver.hand.palm_offset)
    base[reaching, 2] += _compute_height_offsets(giver, base, base_rotation, fingers, reaching)
    return KeyframeMotion(position, rotation, base, base_rotation, fingers, onset)


def _compute_reach_path(entry: Array, end: Array, finger_direction: Array, length: float, progress: Array) -> Array:
    """Return the wrist's positions (n, 3) on a Bezier curve to `end` (3,) at shares `progress` (n,) of its length (m).

    The curve starts in the direction of `entry` (3,), seen from `end`, at a distance that gives the length. It ends
    along the straight fingers' direction (3,), tilted down.
    """
    direction = (entry - end) / max(float(np.linalg.norm(entry - end)), 1e-9)
    bend = 0.35 * min(length, 0.4)

    def curve(distance: float) -> Array:
        middle = end - finger_direction * bend + np.array([0.0, 0.0, 0.25 * bend])
        return _bezier(_SAMPLES, end + direction * distance, middle, end)

    low, high = 0.0, 2.0 * length
    for _ in range(40):
        distance = 0.5 * (low + high)
        too_long = _cumulative_lengths(curve(distance))[-1] > length
        low, high = (low, distance) if too_long else (distance, high)
    points = curve(low)
    lengths = _cumulative_lengths(points)
    return np.stack([np.interp(progress * lengths[-1], lengths, column) for column in points.T], axis=1)


def _bezier(parameter: Array, start: Array, control: Array, end: Array) -> Array:
    """Return points (n, 3) at parameters (n,), 0 to 1, of a quadratic Bezier curve of three control points (3,)."""
    s = parameter[:, None]
    return np.asarray((1 - s) ** 2 * start + 2 * s * (1 - s) * control + s**2 * end)


def _cumulative_lengths(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _compute_reach_rotations(start: Array, end: Array, finger_direction: Array, progress: Array) -> Rotation:
    """Return n rotations of `finger_direction` towards `end` - `start`, fading out until `progress` (n,) is 0.85."""
    travel = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    axis = np.cross(finger_direction, travel)
    sine = float(np.linalg.norm(axis))
    angle = min(float(np.arctan2(sine, finger_direction @ travel)), _MAX_REACH_ROTATION)
    axis = axis / sine if sine > 1e-6 else np.array([0.0, 0.0, 1.0])
    fading = 1.0 - minimum_jerk(progress / 0.85)
    return Rotation.from_rotvec(fading[:, None] * angle * axis)


def _compute_height_offsets(
    giver: SimulatedGiver, base: Array, rotation: Rotation, fingers: Array, frames: npt.NDArray[np.int64]
) -> Array:
    """Return heights (n,) in m by which to raise the hand in the keyframes `frames` (n,) to be clear of the table."""
    dof = np.concatenate([base[frames], rotation[frames].as_euler("XYZ"), fingers[frames]], axis=1)
    lowest = giver.hand.compute_keypoints(dof)[..., 2].min(axis=1)
    return np.asarray(np.maximum(0.0, JOINT_CLEARANCE - lowest), dtype=np.float64)


def draw_far_positions(random: RandomStream) -> tuple[Array, Array]:
    """Draw start x, y (2,) and handover position (3,) at the edge of the robot's reach, in the table's frame (m)."""
    start = np.array([random.draw_quantile("start_x"), random.draw_quantile("start_y")])
    distance, azimuth = random.uniform(*_REACH), random.uniform(-_MAX_AZIMUTH, _MAX_AZIMUTH)
    elevation = random.uniform(*_ELEVATION)
    x, y, z = config.PandaConfig().base_position
    flat = distance * np.cos(elevation)
    height = z + SHOULDER_HEIGHT - config.TABLE_HEIGHT + distance * np.sin(elevation)
    return start, np.array([x + flat * np.sin(azimuth), y + flat * np.cos(azimuth), max(height, _MIN_HEIGHT)])


def add_post_arrival_motion(
    random: RandomStream, motion: KeyframeMotion, giver: SimulatedGiver, grasp: int
) -> KeyframeMotion:
    """Continue a motion to 8 s: the hand with the object moves along a smooth curve and rests for the last 0.2 s.

    `grasp` is the index of the grasp. The set t0 of GenH2R (Wang et al., CVPR 2024) has such motions.
    """
    count = round(_DURATION / KEYFRAME_PERIOD) + 1 - len(motion.fingers)
    offsets, vectors = _draw_curve(random, count)
    start, start_rotation = motion.object_position[-1], motion.object_rotation[-1]
    turns = Rotation.from_rotvec(vectors).as_quat()
    rotation = Rotation.from_quat(multiply_quaternions(turns, start_rotation.as_quat()))
    position = start + offsets
    points = np.concatenate([giver.corners, giver.keypoints[grasp]])
    lowest = position[:, 2] + (rotation.as_matrix()[:, 2] @ points.T).min(axis=1)
    # Lift the curve where it would touch the table; its beginning is where the motion ends.
    missing = float(np.maximum(0.0, JOINT_CLEARANCE - lowest).max())
    position[:, 2] += missing * minimum_jerk(np.arange(1, count + 1) * KEYFRAME_PERIOD / 0.6)
    object_from_base = start_rotation.inv() * motion.base_rotation[-1]
    base_rotation = Rotation.from_quat(multiply_quaternions(rotation.as_quat(), object_from_base.as_quat()))
    base_offset = start_rotation.inv().apply(motion.base_position[-1] - start)
    return KeyframeMotion(
        object_position=np.concatenate([motion.object_position, position]),
        object_rotation=Rotation.concatenate([motion.object_rotation, rotation]),
        base_position=np.concatenate([motion.base_position, position + rotation.apply(base_offset)]),
        base_rotation=Rotation.concatenate([motion.base_rotation, base_rotation]),
        fingers=np.concatenate([motion.fingers, np.repeat(motion.fingers[-1:], count, axis=0)]),
        hand_first=motion.hand_first,
    )


def _draw_curve(random: RandomStream, count: int) -> tuple[Array, Array]:
    """Draw a curve from rest to rest: displacements (m) and rotation vectors (rad) from its start, (count, 3) each."""
    low, high = _N_WAYPOINTS
    n = low + random.integer(high - low + 1)
    moves = (2.0 * random.uniforms(n, 3) - 1.0) * np.array(_EXTENT)
    turns = (2.0 * random.uniforms(n, 3) - 1.0) * _MAX_TURN
    peak = random.uniform(*_TURN_SPEED)
    times = np.linspace(0.0, 1.0, n + 1)
    # The last 0.2 s are at rest.
    grid = np.minimum(np.arange(count + 1) / max(count - 5, 1), 1.0)
    curve = CubicSpline(times, np.concatenate([np.zeros((1, 6)), np.hstack([moves, turns])]), bc_type="clamped")(grid)
    offsets, vectors = curve[:, :3], curve[:, 3:]
    speed = float(np.linalg.norm(np.diff(offsets, axis=0), axis=1).max()) / KEYFRAME_PERIOD
    offsets = offsets * min(1.0, MAX_SPEED / speed)
    # Speeds grow a little slower than the rotation vectors, so that two corrections suffice.
    for _ in range(3):
        vectors = vectors * (peak / max(_find_peak_turn_speed(vectors), 1e-6))
    vectors = vectors * min(1.0, _TURN_SPEED[1] / _find_peak_turn_speed(vectors))
    return offsets[1:], vectors[1:]


def _find_peak_turn_speed(vectors: Array) -> float:
    """Return the largest angular speed (rad/s) between consecutive keyframes with rotation vectors (n, 3) (rad)."""
    quaternions = Rotation.from_rotvec(vectors).as_quat()
    between = multiply_quaternions(quaternions[:-1] * [-1.0, -1.0, -1.0, 1.0], quaternions[1:])
    return float(Rotation.from_quat(between).magnitude().max()) / KEYFRAME_PERIOD


def compute_swept_points(motion: KeyframeMotion, giver: SimulatedGiver) -> Array:
    """Return the positions (3, n) of the hand's joints and the object's corners in all keyframes, table's frame (m)."""
    positions, rotations = motion.object_position, motion.object_rotation.as_matrix()
    moves = np.concatenate([[True], (positions[1:] != positions[:-1]).any(axis=1)])
    shown = slice(motion.hand_first, None)
    # Keypoints of each finger posture with the base at the origin.
    fingers = motion.fingers[shown]
    changes = np.concatenate([[True], (fingers[1:] != fingers[:-1]).any(axis=1)])
    dof = np.concatenate([np.zeros((np.count_nonzero(changes), 6)), fingers[changes]], axis=1)
    keypoints = giver.hand.compute_keypoints(dof)[np.cumsum(changes) - 1]
    hand = keypoints @ motion.base_rotation.as_matrix()[shown].swapaxes(1, 2) + motion.base_position[shown, None]
    return np.stack(
        [
            np.concatenate(
                [(giver.corners @ rotations[moves, axis].T + positions[moves, axis]).ravel(), hand[..., axis].ravel()]
            )
            for axis in range(3)
        ]
    )


def compute_trajectories(motion: KeyframeMotion, clutter: Sequence[ClutterObject]) -> tuple[Float32, Float32, int]:
    """Interpolate keyframes in the table's frame to a scene's motion at 1 kHz in the world frame, as in `Scene`.

    Returns the motion of the objects (T, n, 6), first the handed-over one and then the resting `clutter`; the motion of
    the hand (T, 51); and the first frame with the hand.
    """
    n, first = len(motion.object_position), motion.hand_first
    key_times = np.arange(n, dtype=np.float64) * KEYFRAME_PERIOD
    times = np.arange((n - 1) * _STRIDE + 1, dtype=np.float64) * TIME_STEP
    target = resample_poses(key_times, motion.object_position, motion.object_rotation, times)
    object_dof = np.repeat(target[:, None], 1 + len(clutter), axis=1)
    if clutter:
        angles = Rotation.from_matrix(np.stack([rotation for _, _, rotation in clutter])).as_euler("XYZ")
        object_dof[:, 1:] = _round_to_grid(np.concatenate([[position for _, position, _ in clutter], angles], axis=1))
    hand_first = first * _STRIDE
    hand_dof = np.zeros((len(times), HAND_DOF), dtype=np.float32)
    # Times since the hand became visible, which the scenes were made with.
    key_times, times = key_times[: n - first], times[: len(times) - hand_first]
    base = resample_poses(key_times, motion.base_position[first:], motion.base_rotation[first:], times)
    hand_dof[hand_first:] = np.concatenate([base, resample_fingers(key_times, motion.fingers[first:], times)], axis=1)
    object_dof[:, :, 2] += TABLE_HEIGHT
    hand_dof[hand_first:, 2] += TABLE_HEIGHT
    return object_dof, hand_dof, hand_first


def resample_poses(key_times: Array, positions: Array, rotations: Rotation, times: Array) -> Float32:
    """Interpolate the poses of n keyframes, which are at `key_times` (n,), at `times` (T,), all in s.

    Returns positions (m) and unwrapped intrinsic XYZ Euler angles (rad), (T, 6). Before the first and after the last
    keyframe, poses are constant.
    """
    points = CubicSpline(key_times, positions)(np.clip(times, key_times[0], key_times[-1]))
    angles = np.unwrap(_resample_angles(key_times, rotations, times), axis=0)
    return _round_to_grid(np.concatenate([points, angles], axis=1))


def resample_fingers(key_times: Array, fingers: Array, times: Array) -> Float32:
    """Return finger joint angles (T, 45) in rad at times (T,) in s from keyframes (n, 45) at `key_times` (n,) in s."""
    joints = np.split(fingers, fingers.shape[1] // 3, axis=1)
    angles = [_resample_angles(key_times, Rotation.from_euler("XYZ", joint), times) for joint in joints]
    return _round_to_grid(np.concatenate(angles, axis=1))


def _resample_angles(key_times: Array, rotations: Rotation, times: Array) -> Array:
    """Return intrinsic XYZ Euler angles (T, 3) (rad) at `times` by slerp, but exactly before and after the motion."""
    quaternions, still = rotations.as_quat(), rotations.as_euler("XYZ")
    moves = np.flatnonzero((quaternions[1:] != quaternions[:-1]).any(axis=1))
    if not len(moves):
        return np.repeat(still[:1], len(times), axis=0)
    first, last = int(moves[0]), int(moves[-1]) + 1
    is_moving = (times >= key_times[first]) & (times <= key_times[last])
    angles: Array = np.where((times < key_times[first])[:, None], still[0], still[-1])
    slerp = Slerp(key_times[first : last + 1], rotations[first : last + 1])
    angles[is_moving] = slerp(times[is_moving]).as_euler("XYZ")
    return angles


def _round_to_grid(values: npt.ArrayLike) -> Float32:
    """Return values rounded to multiples of `_GRID`, without negative zeros."""
    return (np.round(np.asarray(values, dtype=np.float64) / _GRID) * _GRID + 0.0).astype(np.float32)
