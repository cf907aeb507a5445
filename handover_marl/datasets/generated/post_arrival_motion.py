"""Motions in scenes of the family `hard`: handovers at the edge of the robot's reach, objects that keep moving.

After the object has arrived at the handover pose, hand and object follow a smooth curve together until 8 s have passed,
as in the set t0 of GenH2R (Wang et al., CVPR 2024), and then rest. All poses are in the table's frame.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT, PandaConfig
from handover_marl.datasets.generated.motion import KEYFRAME_PERIOD, KeyframeMotion, minimum_jerk
from handover_marl.datasets.generated.placement import JOINT_CLEARANCE, SimulatedGiver
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.geometry.panda import SHOULDER_HEIGHT
from handover_marl.geometry.rotations import multiply_quaternions

Array = npt.NDArray[np.float64]

#: Duration of a scene's motion (s).
DURATION: Final = 8.0
#: Smallest and largest distance of the handover position from the robot's shoulder, and smallest height above the
#: table (m).
REACH, MIN_HEIGHT = (0.70, 0.82), 0.12
#: Largest speed of the object's origin (m/s).
MAX_SPEED: Final = 0.30
# Largest angle between the robot's forward direction and the handover position, and its elevation from the shoulder.
_MAX_AZIMUTH, _ELEVATION = 0.6, (-0.25, 0.25)  # rad
# Smallest and largest number of waypoints of the curve.
_N_WAYPOINTS = (3, 6)
# Largest distance of a waypoint from the handover position along x, y and z (m), and component of its rotation (rad).
_EXTENT, _MAX_TURN = (0.12, 0.08, 0.10), 0.9
# Smallest and largest value of a scene's peak angular speed (rad/s).
_TURN_SPEED = (np.radians(30.0), np.radians(90.0))


def draw_far_positions(random: RandomStream) -> tuple[Array, Array]:
    """Draw start x, y (2,) and handover position (3,) at the edge of the robot's reach, in the table's frame (m)."""
    start = np.array([random.draw_quantile("start_x"), random.draw_quantile("start_y")])
    distance, azimuth = random.uniform(*REACH), random.uniform(-_MAX_AZIMUTH, _MAX_AZIMUTH)
    elevation = random.uniform(*_ELEVATION)
    x, y, z = PandaConfig().base_position
    flat = distance * np.cos(elevation)
    height = z + SHOULDER_HEIGHT - TABLE_HEIGHT + distance * np.sin(elevation)
    return start, np.array([x + flat * np.sin(azimuth), y + flat * np.cos(azimuth), max(height, MIN_HEIGHT)])


def add_post_arrival_motion(
    random: RandomStream, motion: KeyframeMotion, giver: SimulatedGiver, grasp: int
) -> KeyframeMotion:
    """Continue a motion to a length of `DURATION` by a smooth curve of the object in the grasp with this index."""
    count = round(DURATION / KEYFRAME_PERIOD) + 1 - len(motion.fingers)
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
    """Draw displacements (n, 3) (m) and rotation vectors (n, 3) (rad) from the start of a curve between two rests."""
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
