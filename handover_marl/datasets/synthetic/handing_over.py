"""When and along which way hand and object move: reach, grasp, lift, offer, hold, as key poses at 25 Hz.

Hand and object follow minimum-jerk profiles (Flash and Hogan, 1985) along bent ways; the reach is seen from
somewhere in its first half on, as cameras see it. The wrist's peak speed is the drawn one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.assets.hand_model import HandModel
from handover_marl.datasets.synthetic import calibration
from handover_marl.datasets.synthetic.draws import Draws
from handover_marl.datasets.synthetic.staging import (
    JOINT_CLEARANCE,
    OBJECT_CLEARANCE,
    HeldObject,
    Stage,
)

Array = npt.NDArray[np.float64]

#: Time between key poses (s).
KEY_PERIOD = 0.04

# Largest speed of a minimum-jerk movement of unit length and duration.
_PEAK = 1.875
# The lift stays this much slower than the reach, so that the reach has the peak.
_LIFT_SHARE = 0.95
_CLOSE_FRAMES = (5, 11)
_HOLD_FRAMES = 3
_SHORTEST_REACH = 0.10
_SAMPLES = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, eq=False)
class KeyMotion:
    """Key poses of one handed-over object and the hand, table frame (m), T frames of 40 ms.

    Attributes:
        object_position: (T, 3).
        object_rotation: T rotations.
        base_position: (T, 3) the hand's base; only frames from `hand_first` on count.
        base_rotation: T rotations of the hand's base.
        fingers: (T, 45) finger angles (rad).
        hand_first: First frame with a hand; it stays to the end.
    """

    object_position: Array
    object_rotation: Rotation
    base_position: Array
    base_rotation: Rotation
    fingers: Array
    hand_first: int


@dataclass(frozen=True)
class Timing:
    """Frames at which things happen, and the reach's part that is seen.

    Attributes:
        n_frames: Length of the recording.
        onset: The hand appears.
        grasp: It has reached the object.
        lift: The fingers are closed, the object leaves the table.
        arrive: The object is offered.
        seen_from: Share (0..1) of the reach's time that was over at the onset.
        reach: Length (m) of the way seen.
    """

    n_frames: int
    onset: int
    grasp: int
    lift: int
    arrive: int
    seen_from: float
    reach: float


def draw_motion(scene_id: int, stage: Stage, held: HeldObject, model: HandModel) -> KeyMotion:
    """Draw the key poses of a scene."""
    draws = Draws(scene_id, "motion")
    side_sign = 1.0 if held.grasps.side == "right" else -1.0
    speed = draws.quantile(calibration.PEAK_SPEED)
    offer_way = _OfferWay(stage, held)
    entry = np.array([draws.quantile(table) for table in (_ENTRY_X, _ENTRY_Y, _ENTRY_Z)])
    entry[0] = calibration.MIRROR_X + side_sign * (entry[0] - calibration.MIRROR_X)
    wrist = stage.start[0] + stage.start[1] @ held.keypoints[stage.grasp, 0]
    timing = _draw_timing(
        Draws(scene_id, "timing"), speed, float(np.linalg.norm(entry - wrist)), offer_way.slowest_duration(speed)
    )
    sway = np.array([draws.uniform(-0.004, 0.004) for _ in range(3)])
    position, rotation = offer_way.key_poses(timing, sway)
    return _with_hand(timing, position, rotation, entry, stage, held, model)


_ENTRY_X, _ENTRY_Y, _ENTRY_Z = calibration.ENTRY_X, calibration.ENTRY_Y, calibration.ENTRY_Z


def minimum_jerk(share: npt.ArrayLike) -> Array:
    """Way (0..1) of a minimum-jerk movement at a share of its time, standing still outside 0..1."""
    t = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0)
    return t * t * t * (10.0 + t * (6.0 * t - 15.0))


def _draw_timing(draws: Draws, speed: float, entry_distance: float, lift_time: float) -> Timing:
    """Fit reach, closing and offer between onset and end so that the reach has the drawn peak speed."""
    counts = calibration.FRAME_COUNTS
    n_frames = list(counts)[draws.weighted(list(counts.values()))]
    onset = round(draws.quantile(calibration.HAND_ONSET))
    seen_from = draws.uniform(0.05, 0.40)
    close = _CLOSE_FRAMES[0] + draws.integer(_CLOSE_FRAMES[1] - _CLOSE_FRAMES[0])
    offer_frames = int(np.ceil(lift_time / KEY_PERIOD)) + draws.integer(8)
    latest = n_frames - 1 - _HOLD_FRAMES
    seen_way = 1.0 - float(minimum_jerk(seen_from))
    reach = max(entry_distance, _SHORTEST_REACH)
    # The peak speed fixes how long a reach of a given length takes; a shorter reach is a quicker one.
    per_length = _PEAK * (1.0 - seen_from) / (seen_way * speed * KEY_PERIOD)
    while onset + reach * per_length + close + offer_frames > latest and reach > _SHORTEST_REACH:
        reach *= 0.95
    grasp = onset + max(4, round(reach * per_length))
    # Whole frames and the peak speed together fix the length.
    reach = (grasp - onset) / per_length
    spare = latest - (grasp + close + offer_frames)
    if spare < 0:
        offer_frames = max(8, offer_frames + spare)
        spare = 0
    pause = draws.integer(spare + 1) // 3
    lift = grasp + close + pause
    return Timing(n_frames, onset, grasp, lift, min(lift + offer_frames, n_frames - 1), seen_from, reach)


class _OfferWay:
    """The object's way from the table to the offer: up first, turning while it goes."""

    def __init__(self, stage: Stage, held: HeldObject) -> None:
        (start, start_rotation), (end, end_rotation) = stage.start, stage.offer
        self._start, self._end = start, end
        self._rotations = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start_rotation, end_rotation])))
        self._wrist = held.keypoints[stage.grasp, 0]
        self._points = np.concatenate([held.corners, held.keypoints[stage.grasp]])
        self._clearance = np.repeat(
            [OBJECT_CLEARANCE, JOINT_CLEARANCE], [len(held.corners), len(held.keypoints[stage.grasp])]
        )
        self._rise = self._needed_rise()

    def at(self, way: Array) -> tuple[Array, Rotation]:
        """Object positions (n, 3) and rotations at shares (n) of the way."""
        share = way[:, None]
        control = np.array([self._start[0], self._start[1], max(self._start[2], self._end[2])])
        bent = (1 - share) ** 2 * self._start + 2 * share * (1 - share) * control + share**2 * self._end
        bent[:, 2] += self._rise * (4.0 * way * (1.0 - way)) ** 0.5
        return bent, self._rotations(np.clip((way - 0.05) / 0.95, 0.0, 1.0))

    def slowest_duration(self, speed: float) -> float:
        """Time (s) that the wrist needs if it must stay below its peak speed."""
        position, rotation = self.at(minimum_jerk(_SAMPLES))
        wrist = position + rotation.apply(self._wrist)
        fastest = float(np.linalg.norm(np.diff(wrist, axis=0), axis=1).max()) / float(_SAMPLES[1])
        return max(fastest / (_LIFT_SHARE * speed), 0.4)

    def key_poses(self, timing: Timing, sway: Array) -> tuple[Array, Rotation]:
        """Object positions (T, 3) and rotations of all frames; while it is held out it sways a little."""
        frames = np.arange(timing.n_frames)
        way = minimum_jerk((frames - timing.lift) / (timing.arrive - timing.lift))
        position, rotation = self.at(way)
        rest = max(timing.n_frames - 1 - timing.arrive, 1)
        held = np.clip((frames - timing.arrive) / rest, 0.0, 1.0)
        position += sway * (0.5 - 0.5 * np.cos(2.0 * np.pi * held))[:, None]
        return position, rotation

    def _needed_rise(self) -> float:
        """Extra height (m) in the middle of the way that keeps object and hand off the table."""
        self._rise = 0.0
        way = minimum_jerk(_SAMPLES)[1:-1]
        position, rotation = self.at(way)
        heights = np.einsum("tj,pj->tp", rotation.as_matrix()[:, 2], self._points) - self._clearance
        missing = -(position[:, 2] + heights.min(axis=1))
        return max(0.0, float((missing / (4.0 * way * (1.0 - way)) ** 0.5).max()))


def _with_hand(
    timing: Timing,
    position: Array,
    rotation: Rotation,
    entry: Array,
    stage: Stage,
    held: HeldObject,
    model: HandModel,
) -> KeyMotion:
    """Add the hand: rigid with the object from the grasp on, before that on its way to it."""
    grasps, row = held.grasps, stage.grasp
    object_from_hand = Rotation.from_matrix(held.object_from_hand[row])
    base_rotation = rotation * object_from_hand
    wrist = position + rotation.apply(held.keypoints[row, 0])
    reaching = np.arange(timing.onset, timing.grasp)
    share = _reach_share(timing, reaching)
    start_rotation = Rotation.from_matrix(stage.start[1])
    pointing = start_rotation.apply(grasps.pointing[row])
    wrist[reaching] = _reach_way(entry, wrist[timing.grasp], pointing, timing.reach, share)
    turns = _reach_turns(wrist[timing.onset], wrist[timing.grasp], pointing, share)
    rotations = base_rotation.as_quat()
    rotations[reaching] = (turns * base_rotation[timing.grasp]).as_quat()
    closing = minimum_jerk((np.arange(timing.n_frames) - timing.grasp) / (timing.lift - timing.grasp))[:, None]
    fingers = (1.0 - closing) * grasps.open_angles[row] + closing * grasps.finger_angles[row]
    base_rotation = Rotation.from_quat(rotations)
    base = wrist - base_rotation.apply(model.palm_offset)
    base[reaching, 2] += _missing_height(model, base, base_rotation, fingers, reaching)
    return KeyMotion(position, rotation, base, base_rotation, fingers, timing.onset)


def _reach_share(timing: Timing, frames: npt.NDArray[np.int64]) -> Array:
    """Share (0..1) of the seen way that is behind the hand."""
    time = timing.seen_from + (1.0 - timing.seen_from) * (frames - timing.onset) / (timing.grasp - timing.onset)
    seen = float(minimum_jerk(timing.seen_from))
    share: Array = (minimum_jerk(time) - seen) / (1.0 - seen)
    return share


def _reach_way(entry: Array, end: Array, pointing: Array, length: float, share: Array) -> Array:
    """Wrist positions (n, 3) on a bent way of a given length that ends along the fingers."""
    direction = (entry - end) / max(float(np.linalg.norm(entry - end)), 1e-9)
    bend = 0.35 * min(length, 0.4)

    def way(distance: float) -> Array:
        start = end + direction * distance
        middle = end - pointing * bend + np.array([0.0, 0.0, 0.25 * bend])
        s = _SAMPLES[:, None]
        return np.asarray((1 - s) ** 2 * start + 2 * s * (1 - s) * middle + s**2 * end)

    low, high = 0.0, 2.0 * length
    for _ in range(40):
        middle_distance = 0.5 * (low + high)
        too_long = _lengths(way(middle_distance))[-1] > length
        low, high = (low, middle_distance) if too_long else (middle_distance, high)
    points = way(low)
    walked = _lengths(points)
    at = share * walked[-1]
    return np.stack([np.interp(at, walked, points[:, axis]) for axis in range(3)], axis=1)


def _lengths(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _reach_turns(start: Array, end: Array, pointing: Array, share: Array) -> Rotation:
    """World rotations on top of the grasping one: at first the fingers rather point where the hand goes."""
    travel = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    axis = np.cross(pointing, travel)
    sine = float(np.linalg.norm(axis))
    angle = min(float(np.arctan2(sine, pointing @ travel)), np.radians(60.0))
    axis = axis / sine if sine > 1e-6 else np.array([0.0, 0.0, 1.0])
    fading = 1.0 - minimum_jerk(share / 0.85)
    return Rotation.from_rotvec(fading[:, None] * angle * axis)


def _missing_height(
    model: HandModel, base: Array, rotation: Rotation, fingers: Array, frames: npt.NDArray[np.int64]
) -> Array:
    """How much (m) each reaching frame must be raised so that no joint comes too near to the table."""
    if len(frames) == 0:
        return np.zeros(0)
    dof = np.concatenate([base[frames], rotation[frames].as_euler("XYZ"), fingers[frames]], axis=1)
    lowest = model.keypoints(dof)[..., 2].min(axis=1)
    return np.asarray(np.maximum(0.0, JOINT_CLEARANCE - lowest), dtype=np.float64)
